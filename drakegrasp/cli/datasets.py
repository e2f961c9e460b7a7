"""The commands on datasets.

They filter and merge them, render scenes, check and count, replay, show, draw and export.
"""

from __future__ import annotations

import math
import sys
from dataclasses import asdict
from functools import partial
from textwrap import fill
from typing import Annotated

from cyclopts import Parameter
from cyclopts.validators import Number

import drakegrasp as dg
from drakegrasp import registry
from drakegrasp.cli.arguments import (
    AnyPath,
    AsJson,
    Count,
    Dataset,
    File,
    Folder,
    NewFile,
    Settings,
    given,
)
from drakegrasp.cli.console import UsageError, new_group, processes, progress_bar, say, say_json
from drakegrasp.errors import MachineError, counted, one_line

#: Default of --port: a fixed number, so that a tunnel to another machine can stay open.
PORT = 8321


def assemble(
    out: Dataset,
    /,
    *,
    reject: File | None = None,
    overrides: Settings = (),
) -> None:
    """Filter and split again, without simulating.

    The command writes trials.hdf5 and both data files again from the shards in OUT. Entries of
    reject.json that are not successes are skipped and listed.

    Args:
        out: Directory of the dataset.
        reject: Trials that must not become samples: the reject.json of an inspection.
        overrides: Change a setting that changes nothing simulated, e.g. filters.outlier_sigma=3 or
            split.seed=1; may be given several times. Your own filters must be given again:
            filters.own=FILE.py:NAME.
    """
    from drakegrasp.cli import tables
    from drakegrasp.dataset.assemble import assemble as assemble_files
    from drakegrasp.dataset.check import check_hand
    from drakegrasp.dataset.manifest import read_manifest
    from drakegrasp.dataset.rejections import read_decisions, unused_rejections

    rejected = () if reject is None else sorted(read_decisions(reject).rejected)
    with progress_bar("assemble", "shards") as progress:
        assemble_files(out, overrides=overrides, rejected=rejected, progress=progress)
        manifest = read_manifest(out)
    tables.print_stats(out)
    for sentence in unused_rejections(out, rejected, manifest.rejected):
        say(sentence)
    for changed in check_hand(manifest):
        say(str(changed))


def scenes(
    out: Dataset,
    /,
    *,
    overrides: Settings = (),
    workers: Count | None = None,
    quiet: bool = False,
) -> None:
    """Render views of training scenes, independent of grasps.

    The command writes OUT/scenes.hdf5: each object of OUT in each resting pose, seen by sixteen
    cameras (five fixed cameras for testing), with all attempts that closed the hand on it.

    Args:
        out: Directory of the dataset.
        overrides: Change a key of `scenes`, e.g. scenes.views=8; may be given several times.
        workers: Number of processes on this machine. [default: one per core]
        quiet: Show no progress.
    """
    from drakegrasp.dataset.paths import SCENES_FILE
    from drakegrasp.generation.scenes import make_scenes

    with processes(workers, "scenes", "objects", show=not quiet) as more:
        made = make_scenes(out, overrides=overrides, **more)
    for split, row in made.items():
        say(f"{split}: {counted(row['scenes'], 'scene')}, {counted(row['views'], 'view')}")
    grasps = sum(row["grasps"] for row in made.values())
    say(f"{counted(grasps, 'grasp')} in {out / SCENES_FILE}")


def merge(
    into: Folder,
    outs: Annotated[tuple[Folder, ...], Parameter(name="OUTS")],
    /,
    *,
    overrides: Settings = (),
) -> None:
    """Merge several datasets that were built separately.

    The datasets may differ only in their objects, and in the settings that --set changes for all of
    them. INTO must be new or empty, and appears when it is complete; OUTS do not change.

    Args:
        into: Directory of the new dataset.
        outs: Directories of datasets.
        overrides: Change a setting that changes nothing simulated, e.g. filters.outlier_sigma=3 or
            split.seed=1; may be given several times. Your own filters must be given again:
            filters.own=FILE.py:NAME.
    """
    from drakegrasp.cli import tables
    from drakegrasp.generation.merge import merge as merge_datasets

    with progress_bar("merge", "shards") as progress:
        merge_datasets(into, outs, overrides=overrides, progress=progress)
    tables.print_stats(into)


def stats(out: Dataset, /, *, as_json: AsJson = False) -> None:
    """Count outcomes, how well grasps hold, and samples.

    Args:
        out: Directory of the dataset.
        as_json: Print one document of JSON instead of text.
    """
    from drakegrasp.cli import tables
    from drakegrasp.dataset.statistics import counts_as_dict

    if as_json:
        say_json(counts_as_dict(out))
    else:
        tables.print_stats(out)


def check(
    out: Dataset,
    /,
    *,
    workers: Count | None = None,
    as_json: AsJson = False,
) -> None:
    """Check every invariant of a dataset.

    The exit code is 1 if an invariant is broken.

    Args:
        out: Directory of the dataset.
        workers: Number of processes on this machine. [default: one per core]
        as_json: Print one document of JSON instead of text.
    """
    with processes(workers, "check", "steps") as how:
        violations = dg.check_dataset(out, **how)
    if as_json:
        say_json({"path": str(out), "broken": [asdict(violation) for violation in violations]})
    else:
        for violation in violations:
            say(str(violation))
        found = counted(len(violations), "broken invariant")
        say(f"{out}: {found if violations else 'no broken invariants'}")
    if violations:
        sys.exit(1)


def replay(
    out: Dataset,
    /,
    *,
    trial: Annotated[Count | None, Parameter(metavar="ID")] = None,
    clutter: Annotated[Count | None, Parameter(metavar="ROW")] = None,
    html: NewFile | None = None,
) -> None:
    """Run a trial again and compare every value.

    The exit code is 1 if any value differs from the stored one.

    Args:
        out: Directory of the dataset.
        trial: Row of trials.hdf5.
        clutter: Row of a grasp in clutter.hdf5 that was tried; its labels are compared.
        html: Write a recording of the trial that plays in a browser.
    """
    from drakegrasp.generation.replay import record_clutter, record_trial

    # All differences are printed: values first, then versions, which may explain them.
    if trial is not None and clutter is None:
        again, record = dg.replay_trial(out, trial), partial(record_trial, out, trial)
    elif clutter is not None and trial is None:
        again, record = dg.replay_clutter(out, clutter), partial(record_clutter, out, clutter)
    else:
        raise UsageError("either --trial or --clutter must be given")
    was, now = again.recorded.label, again.found.label
    say(f"trial {again.trial_id} of {again.object_name}: was {was}, is {now}")
    for name, difference in again.differences.items():
        how = "is missing in one" if math.isnan(difference) else f"by up to {difference:.3g}"
        say(f"  {name} differs: {how}")
    for package, change in again.versions.items():
        say(f"  {package}: {change}")

    if html is not None:
        record(html)
        say(str(html))
    if not again.same:
        sys.exit(1)


def inspect(
    out: Dataset,
    /,
    *,
    results: Annotated[AnyPath | None, Parameter(name="--predictions", metavar="RESULTS")] = None,
    port: Annotated[Count, Parameter(validator=Number(gte=0, lte=65535))] = PORT,
    no_browser: bool = False,
) -> None:
    """Look at grasps in a browser, and reject them.

    The page shows every attempt in OUT with images, contacts, forces and a 3D view, the most
    anomalous first. Rejections are written to OUT/reject.json immediately; assemble --reject reads
    that file. The page can be reached from this machine only. Ctrl-C ends the command.

    Args:
        out: Directory of the dataset.
        results: Show predictions next to their rows of the dataset: the results that verify
            --dataset FILE --out NAME wrote.
        port: Port on this machine; 0 selects any free port.
        no_browser: Only print the address.
    """
    try:
        from drakegrasp.page.app import serve
    except ImportError as error:
        if (error.name or "").partition(".")[0] == "drakegrasp":
            raise
        raise MachineError(
            f"inspect needs its packages: pip install 'drakegrasp[inspect]' ({one_line(error)})"
        ) from None

    serve(out, results=results, port=port, browser=not no_browser, announce=say)


def figures(
    out: Dataset,
    /,
    *,
    folder: Annotated[Folder | None, Parameter(name="--out")] = None,
    quiet: bool = False,
) -> None:
    """Draw a dataset: pictures as PNG and SVG, numbers as JSON.

        sheet          colour, depth and mask of samples of all objects in turn
        outcomes       how the attempts ended: samples, removed, failed
        distributions  slip, turn, forces of the samples
        clutter        how many grasps are free, kept and clean among other objects
        scenes         colour and masks of scenes of several objects

    Args:
        out: Directory of the dataset.
        folder: Folder of the figures. [default: OUT/figures]
        quiet: Show no progress.
    """
    from drakegrasp.foreign_files import validate_no_link
    from drakegrasp.pictures.figures import write_figures

    if folder is None:
        folder = out / "figures"
        validate_no_link(folder)
    with progress_bar("draw", "figures", show=not quiet) as progress:
        written = write_figures(out, folder, progress=progress)
    for name, why in written.left_out.items():
        say(f"{name} is left out: {why}")
    say(f"{counted(len(written.names), 'figure')} in {written.folder}")


def _formats() -> str:
    """Return a line or more on each format."""
    names = registry.names("exporters")
    rows = (f"  {name:<15}{registry.summary('exporters', name)}" for name in names)
    return "Formats:\n" + "\n".join(fill(row, 79, subsequent_indent=" " * 17) for row in rows)


export = new_group(
    "export",
    None,
    usage="drakegrasp export --to FORMAT [OPTIONS] OUT [DIRECTORY]",
    help_epilogue=_formats(),
)


@export.default
def export_samples(
    out: Dataset,
    directory: Folder | None = None,
    /,
    *,
    form: Annotated[str, Parameter(name="--to", metavar="FORMAT")],
    licence: Annotated[str | None, Parameter(name=("--licence", "--license"), metavar="ID")] = None,
    quiet: bool = False,
) -> None:
    """Write the samples of a dataset in another format.

    Args:
        out: Directory of the dataset.
        directory: New or empty folder. [default: OUT/export_FORMAT]
        form: The format, see below.
        licence: Licence that the card of format hf names, e.g. cc-by-4.0.
        quiet: Show no progress.
    """
    from drakegrasp.exchange.export import export_dataset, options_of
    from drakegrasp.foreign_files import validate_no_link

    # What only some formats take.
    options = given(licence=licence)
    for name, value in options.items():
        if name not in options_of(form):
            raise UsageError(f"--{name} must be left out with --to {form}, got {value}")

    if directory is None:
        directory = out / f"export_{form}"
        validate_no_link(directory)
    counts = registry.summary("exporters", form, "COUNTS") or "sample"
    with progress_bar("export", f"{counts}s", show=not quiet) as progress:
        count = export_dataset(out, directory, form, progress=progress, **options)
    say(f"{counted(count, counts)} in {directory}")
