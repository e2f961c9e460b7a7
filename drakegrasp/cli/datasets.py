"""The commands on datasets: `assemble`, `merge`, `scenes`, `check`, `stats` and `replay`."""

from __future__ import annotations

import math
import sys
from dataclasses import asdict
from typing import Annotated

from cyclopts import Parameter

import drakegrasp as dg
from drakegrasp.cli.arguments import AsJson, Count, Dataset, File, Folder, NewFile, Settings
from drakegrasp.cli.console import processes, progress_bar, say, say_json
from drakegrasp.errors import counted


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
        overrides: Change a setting of the filters or the split, e.g. filters.outlier_sigma=3; may
            be given several times. Your own filters must be given again:
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
        overrides: Change a setting of the filters or the split, e.g. filters.outlier_sigma=3; may
            be given several times. Your own filters must be given again:
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
    trial: Annotated[Count, Parameter(metavar="ID")],
    html: NewFile | None = None,
) -> None:
    """Run a trial again and compare every value.

    The exit code is 1 if any value differs from the stored one.

    Args:
        out: Directory of the dataset.
        trial: Row of trials.hdf5.
        html: Write a recording of the trial that plays in a browser.
    """
    # All differences are printed: values first, then versions, which may explain them.
    again = dg.replay_trial(out, trial)
    say(f"trial {trial} of {again.object_name}: was {again.recorded.label}, is {again.found.label}")
    for name, difference in again.differences.items():
        how = "is missing in one" if math.isnan(difference) else f"by up to {difference:.3g}"
        say(f"  {name} differs: {how}")
    for package, change in again.versions.items():
        say(f"  {package}: {change}")

    if html is not None:
        from drakegrasp.generation.replay import record_trial

        record_trial(out, trial, html)
        say(str(html))
    if not again.same:
        sys.exit(1)
