"""Counts of a dataset: the funnel by object and the paper's Table III; what is missing, and why.

While a build runs, or after it was stopped, the funnel is counted from the shards. Messages say
which objects have no sample, which part of a split is too small, and what would help.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import Array, multiply
from drakegrasp.config import Config, SplitConfig, ways_to_grasps
from drakegrasp.dataset.assembly.survey import shards_sha256
from drakegrasp.dataset.hdf5 import AnyArray, open_hdf5, read_columns, read_names
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.opening import open_samples, open_trials
from drakegrasp.dataset.paths import ASSEMBLED_FILES, DATA_FILES, FILE_NAME, TRIALS_FILE
from drakegrasp.dataset.schema import NO_PRESHAPE, SPLITS, TRIAL_FIELDS
from drakegrasp.dataset.shards import open_shard
from drakegrasp.dataset.trials import NONE, Trials
from drakegrasp.distinct import (
    BANDS,
    approach_cells,
    distinct_grasps,
    elevation_bands,
)
from drakegrasp.errors import DataError, HandError, counted
from drakegrasp.filters import Removal
from drakegrasp.frames import unpack_pose
from drakegrasp.hand.file_format import read_hand_file
from drakegrasp.hand.files import hand_file
from drakegrasp.outcomes import Outcome, Stage

#: Name shown for postures without a preshape, for which all fingers close.
NO_NAME = "-"
#: Columns of the attempts that a funnel counts.
_COUNTED = (
    *("object", "outcome", "removal", "standoff_index", "precision"),
    *("stable", "preshape"),
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Funnel:
    """Numbers of candidates, outcomes and removals of each of m objects.

    Attributes:
        names, classes: (m,), names and classes of the objects.
        candidates: (m,), palm poses that were tried or are to be tried.
        outcomes: (m, 1 + max(Outcome)), attempts by object and outcome.
        precision, stable: (m,), successes that are precision grasps, and those that are also
            stable.
        removals: (m, 1 + max(Removal)), successes by object and reason of removal.
        elevations: (m, 3), distinct grasps among the samples, see `distinct_samples`, by object and
            by the band of `BANDS` from which the palm approaches.
        approach_cells: (m,), cells in which the object has a sample, see `approach_cells`.
        preshapes: (256, 4), by index of the preshape: attempts, successes, stable grasps and
            samples.
    """

    names: tuple[str, ...]
    classes: tuple[str, ...]
    candidates: npt.NDArray[np.int64]
    outcomes: npt.NDArray[np.int64]
    precision: npt.NDArray[np.int64]
    stable: npt.NDArray[np.int64]
    removals: npt.NDArray[np.int64]
    elevations: npt.NDArray[np.int64]
    approach_cells: npt.NDArray[np.int64]
    preshapes: npt.NDArray[np.int64]

    @property
    def samples(self) -> npt.NDArray[np.int64]:
        """(m,), samples of each object."""
        return self.removals[:, Removal.KEPT]

    @property
    def distinct(self) -> npt.NDArray[np.int64]:
        """(m,), distinct grasps among the samples of each object."""
        return self.elevations.sum(axis=1)


@dataclass(frozen=True)
class PreshapeCount:
    """How the attempts of a preshape ended.

    Attributes:
        preshape: Name of the preshape, or `NO_NAME` for postures without a preshape.
        attempts, held, stable, samples: Number of attempts, and how many of them are held, stable,
            and samples.
    """

    preshape: str
    attempts: int
    held: int
    stable: int
    samples: int


@dataclass(frozen=True, kw_only=True)
class SplitCount:
    """A row of the paper's Table III: samples, distinct ones, objects and classes of a split."""

    split: str
    samples: int
    distinct: int
    objects: int
    classes: int


@dataclass(frozen=True, kw_only=True, eq=False)
class Unfinished:
    """The state of a build that runs or was stopped.

    Attributes:
        funnel: Counts of the finished work units; no success is a sample yet.
        done: Number of finished work units.
        total: Number of all work units; None if it follows from their results, see `Target`.
    """

    funnel: Funnel
    done: int
    total: int | None


def is_assembled(out: Path, *, verify_shards: bool = False) -> bool:
    """Return whether the three files exist and are what assembling would write now.

    Args:
        out: Directory of the dataset.
        verify_shards: Whether to compare the shards as well, which opens each of them.

    Raises:
        DataError: If a file stores values outside of itself, or a shard is missing.
    """
    manifest = read_manifest(out)
    expected = {"signature": manifest.signature()}
    if verify_shards:
        expected["shards"] = shards_sha256(out, manifest)
    try:
        for name in ASSEMBLED_FILES:
            with open_hdf5(out / name) as file:
                if any(str(file.attrs[key]) != value for key, value in expected.items()):
                    return False
    except (OSError, KeyError):
        return False
    return True


def palms_in_files(out: Path) -> dict[str, int]:
    """Return the number of palm poses of each object in the files; empty if there are none.

    Raises:
        DataError: If trials.hdf5 is damaged.
    """
    if not os.path.lexists(out / TRIALS_FILE):
        return {}
    with open_trials(out / TRIALS_FILE) as file:
        names = read_names(file["objects/name"])
        objects, candidates = (file[f"trials/{name}"][:] for name in ("object", "candidate"))
    palms = np.zeros(len(names), dtype=np.int64)
    np.maximum.at(palms, objects, candidates + 1)
    return dict(zip(names, palms.tolist(), strict=True))


def _refuse_broken_files(out: Path) -> None:
    """Raise an error if an existing file cannot be read, since a build would overwrite it.

    Raises:
        DataError: If there is such a file.
    """
    for name in ASSEMBLED_FILES:
        if os.path.lexists(out / name):
            with open_trials(out / name) if name == TRIALS_FILE else open_samples(out / name):
                pass


def count_unfinished(out: Path) -> Unfinished | None:
    """Return the state of a build; None if the files are complete or there is no build.

    The seals of the shards are not verified, since this would read all of them.

    Raises:
        DataError: If the directory holds no dataset.
    """
    if not os.path.lexists(out / FILE_NAME):
        return None
    _refuse_broken_files(out)
    if is_assembled(out):
        return None

    # Count the attempts of the complete shards; no success is a sample yet.
    manifest = read_manifest(out)
    entries = manifest.objects
    funnel, done = _empty_funnel([e.name for e in entries], [e.class_name for e in entries]), 0
    for header in manifest.headers():
        path = header.path(out)
        with suppress(DataError), open_shard(path, header, verify_seal=False) as (file, _):
            names = [name for name in _COUNTED if name not in ("object", "removal")]
            block = read_columns(file["trials"], TRIAL_FIELDS, names)
            number = np.full(block.count, funnel.names.index(header.object_name))
            removal = np.full(block.count, NONE)
            _count_block(funnel, block.with_columns(object=number, removal=removal))
            done += 1

    # A build with a target tries as many palm poses as it needs. Without one, those that are still
    # to be tried count as well.
    if manifest.config.has_target and any(entry.tried is None for entry in entries):
        return Unfinished(funnel=funnel, done=done, total=None)
    planned = np.array([entry.candidates for entry in entries], dtype=np.int64)
    funnel = replace(funnel, candidates=planned)
    return Unfinished(funnel=funnel, done=done, total=manifest.units)


def count_funnel(out: Path) -> Funnel:
    """Return the funnel of a dataset.

    Raises:
        DataError: If trials.hdf5 is missing or damaged.
    """
    return funnel_of(Trials(out, any_name=True))


def funnel_of(trials: Trials) -> Funnel:
    """Return the funnel of attempts, see `count_funnel`."""
    funnel = _empty_funnel(*(trials.objects[key].tolist() for key in ("name", "class_name")))
    for block in trials.blocks(_COUNTED):
        _count_block(funnel, block)

    # From where the palms of the samples approach.
    samples = _samples(trials)
    cells = np.unique(np.column_stack([samples.objects, approach_cells(samples.X_OG)]), axis=0)
    _count(funnel.approach_cells, cells[:, 0])
    bands = elevation_bands(multiply(samples.X_TO, samples.X_OG))
    own = samples.distinct
    _count(funnel.elevations, (samples.objects[own], bands[own]))
    return funnel


def _empty_funnel(names: Sequence[str], classes: Sequence[str]) -> Funnel:
    """Return the funnel of objects without attempts."""
    count = len(names)

    def zeros(*shape: int) -> npt.NDArray[np.int64]:
        return np.zeros(shape, dtype=np.int64)

    return Funnel(
        names=tuple(names),
        classes=tuple(classes),
        candidates=zeros(count),
        outcomes=zeros(count, 1 + max(Outcome)),
        precision=zeros(count),
        stable=zeros(count),
        removals=zeros(count, 1 + max(Removal)),
        elevations=zeros(count, len(BANDS)),
        approach_cells=zeros(count),
        preshapes=zeros(1 + NO_PRESHAPE, 4),
    )


def _count_block(funnel: Funnel, block: Mapping[str, AnyArray]) -> None:
    """Add attempts to a funnel, given their columns _COUNTED."""
    number, outcome, removal = (block[name] for name in ("object", "outcome", "removal"))
    held, stable, preshape = outcome == Outcome.SUCCESS, block["stable"], block["preshape"]

    # Palm poses, outcomes, labels of the hold, removals, and preshapes.
    _count(funnel.candidates, number[block["standoff_index"] == 0])
    _count(funnel.outcomes, (number, outcome))
    _count(funnel.precision, number[block["precision"]])
    _count(funnel.stable, number[stable])
    decided = removal != NONE
    _count(funnel.removals, (number[decided], removal[decided]))
    chosen = np.ones_like(held), held, held & stable, removal == Removal.KEPT
    for column, own in zip(funnel.preshapes.T, chosen, strict=True):
        _count(column, preshape[own])


class _Samples(NamedTuple):
    """The samples among some attempts.

    Attributes:
        ids: (n,), trials of the samples.
        objects: (n,), rows of /objects.
        X_TO, X_OG: (n, 4, 4), poses of object and palm before the hand closed.
        distinct: (n,), which of them are distinct grasps.
    """

    ids: npt.NDArray[np.int64]
    objects: npt.NDArray[np.int64]
    X_TO: Array
    X_OG: Array
    distinct: npt.NDArray[np.bool_]


def _samples(trials: Trials) -> _Samples:
    kept = trials.where(sample=True)
    columns = kept.columns(("object", "resting", "X_TO", "X_OG"))
    X_TO, X_OG = (unpack_pose(columns[name]) for name in ("X_TO", "X_OG"))
    groups = np.column_stack([columns["object"], columns["resting"]])
    objects = columns["object"].astype(np.int64)
    return _Samples(kept.trial_ids, objects, X_TO, X_OG, distinct_grasps(groups, X_OG))


def distinct_samples(trials: Trials) -> npt.NDArray[np.int64]:
    """Return the trials (n,) of the distinct grasps among the samples, see `distinct_grasps`.

    Grasps of an object in one resting pose are compared, in the order of their trials.
    """
    samples = _samples(trials)
    return samples.ids[samples.distinct]


def preshapes_of(funnel: Funnel, config: Config) -> list[PreshapeCount]:
    """Return the counts of each preshape of a dataset's hand, by its configuration.

    The list is empty if the hand has no preshapes, or if its file can no longer be read.
    """
    try:
        shapes = read_hand_file(hand_file(config.hand_source)).preshapes
    except HandError:
        return []
    named = list(enumerate(shape.name for shape in shapes))
    if named and funnel.preshapes[NO_PRESHAPE, 0]:
        named.append((NO_PRESHAPE, NO_NAME))
    counts = []
    for i, name in named:
        counts.append(PreshapeCount(name, *funnel.preshapes[i].tolist()))
    return counts


def by_band(counts: npt.NDArray[np.int64]) -> dict[str, int]:
    """Return counts (3,) of elevations by the names of their bands, e.g. "30-60"."""
    return {f"{low}-{high}": int(n) for (low, high), n in zip(BANDS, counts, strict=True)}


def _count(counts: npt.NDArray[np.int64], cells: Any) -> None:
    """Add to an array of counts how often each of its cells occurs."""
    flat = np.ravel_multi_index(cells, counts.shape) if counts.ndim > 1 else cells
    counts += np.bincount(flat, minlength=counts.size).reshape(counts.shape)


def held_note(funnel: Funnel) -> str:
    """Return why there may be more held grasps than were counted; empty if there is no reason."""
    moved = int(funnel.outcomes[:, Outcome.MOVED].sum())
    if not moved:
        return ""
    ended = f"{counted(moved, 'lift')} ended early, without a verdict (moved)"
    why = "because the object moved more in the hand than a sample may"
    return f"the number of held grasps is a lower bound: {ended}, {why}"


def count_splits(out: Path) -> list[SplitCount]:
    """Return samples, distinct ones, objects and classes of each split.

    Raises:
        DataError: If a file is missing or damaged.
    """
    distinct = distinct_samples(Trials(out, any_name=True))
    with open_samples(out / DATA_FILES["oto"]) as file:
        return splits_of(file, distinct)


def splits_of(file: h5py.File, distinct: npt.NDArray[np.int64]) -> list[SplitCount]:
    """Return the counts of a data file's splits, see `count_splits` and `distinct_samples`."""
    return [
        SplitCount(
            split=split,
            samples=len(file[split]["grasps"]),
            distinct=int(np.isin(file[split]["trial_id"][:], distinct).sum()),
            objects=len(set(read_names(file[split]["object_props/object_name"]))),
            classes=len(set(read_names(file[split]["object_props/class_name"]))),
        )
        for split in SPLITS
    ]


def counts_as_dict(out: Path) -> dict[str, Any]:
    """Return the counts of a dataset as JSON types; labels without a count are left out.

    Args:
        out: Directory of the dataset; during a build, only finished work units count.

    Raises:
        DataError: If there is no dataset, or a file cannot be read.
    """
    unfinished = count_unfinished(out)
    funnel = count_funnel(out) if unfinished is None else unfinished.funnel
    preshapes = preshapes_of(funnel, read_manifest(out).config)

    def labelled(members: type[Outcome] | type[Removal], counts: AnyArray) -> dict[str, int]:
        return {each.label: int(counts[each]) for each in members if counts[each]}

    objects = [
        {
            "name": name,
            "class": funnel.classes[i],
            "candidates": int(funnel.candidates[i]),
            "outcomes": labelled(Outcome, funnel.outcomes[i]),
            **{key: int(getattr(funnel, key)[i]) for key in ("precision", "stable")},
            "removals": labelled(Removal, funnel.removals[i]),
            **{
                key: int(getattr(funnel, key)[i])
                for key in ("samples", "distinct", "approach_cells")
            },
            "elevations": by_band(funnel.elevations[i]),
        }
        for i, name in enumerate(funnel.names)
    ]
    splits = [] if unfinished else [asdict(split) for split in count_splits(out)]
    units = {"done": unfinished.done, "total": unfinished.total} if unfinished else None
    return {
        "path": str(out),
        "unfinished": units,
        "objects": objects,
        "preshapes": list(map(asdict, preshapes)),
        "splits": splits,
    }


#: If a split's fraction of the samples is off by more than this factor, it is reported.
MUCH = 2.0


class Shortfall(NamedTuple):
    """Why an object has no sample, and what would help, as parts of a sentence."""

    reason: str
    advice: str


def objects_without_samples(funnel: Funnel, config: Config) -> dict[str, Shortfall]:
    """Return, for each object without a sample, why it has none, by its name."""
    return {
        funnel.names[i]: why_no_sample(funnel.outcomes[i], funnel.removals[i], config)
        for i in np.flatnonzero(funnel.samples == 0).tolist()
    }


def why_no_sample(outcomes: AnyArray, removals: AnyArray, config: Config) -> Shortfall:
    """Return why the attempts at an object yielded no sample.

    Args:
        outcomes: (1 + max(Outcome),), attempts by outcome.
        removals: (1 + max(Removal),), successes by reason of removal.
        config: Configuration of the dataset, which states what was already tried.
    """
    total = int(outcomes.sum())
    if not total and "closing" in config.candidates.method:
        ways = "palm poses that face the surface (--set candidates.method=normals)"
        return Shortfall(
            "the hand closes well on it from no side", f"{ways}, or another hand (--set hand=NAME)"
        )
    if not total:
        return Shortfall("nothing was tried", "more palm poses (--candidates)")

    # Held grasps, if any, are closest to a sample and say more than the most frequent outcome.
    held = int(outcomes[Outcome.SUCCESS])
    if held:
        removal = Removal(int(np.argmax(removals)))
        reason = f"{held:,} held, none a sample: mostly {removal.label} ({removals[removal]:,})"
        if removal is Removal.FLAT_DEPTH:
            ways = "`drakegrasp assemble OUT --set filters.min_depth_variance=0`"
            return Shortfall(reason, f"{ways}, which keeps flat depth images")
        return Shortfall(reason, "more palm poses (--candidates), or other limits in `filters`")

    most = Outcome(int(np.argmax(outcomes)))
    met = "" if most.inconclusive else f", {most.text}"
    reason = f"{outcomes[most]:,} of {total:,} attempts ({outcomes[most] / total:.0%}) end in "
    reason += f"{most.label}{met}"
    by_stage = {
        stage: sum(int(outcomes[o]) for o in Outcome if o.stage is stage) for stage in Stage
    }
    if most.inconclusive:
        return Shortfall(reason, "another machine or a simpler mesh: this says nothing of grasps")
    if by_stage[Stage.LIFTED] and most.stage is not Stage.LIFTED:
        reason += f"; lifted: {by_stage[Stage.LIFTED]:,}, none held"
    elif by_stage[Stage.CLOSED] and most.stage is Stage.PLACED:
        reason += f"; closed: {by_stage[Stage.CLOSED]:,}, none lifted"
    elif not by_stage[Stage.CLOSED] and not by_stage[Stage.LIFTED]:
        reason += "; the hand never closed on it"
    return Shortfall(reason, ways_to_grasps(config))


def split_shortfall(counts: Sequence[SplitCount], rule: str, config: SplitConfig) -> list[str]:
    """Return a line for each split that is empty, or one if other fractions were requested.

    Args:
        counts: Counts of the splits.
        rule: Rule of the split, `class` or `object`.
        config: The requested fractions.
    """
    samples = {count.split: count.samples for count in counts}
    total = sum(samples.values())
    if not total:
        return []
    asked = {"train": 1.0, "valid": config.valid_fraction, "test": config.test_fraction}
    if rule == "object":
        asked["train"] -= asked["valid"] + asked["test"]
        why = dict.fromkeys(asked, _why_empty(sum(count.objects for count in counts)))
    else:
        asked["test"] = 1.0
        why = EMPTY_BY_CLASS
    empty = [name for name, count in samples.items() if asked[name] and not count]
    if empty or rule == "class":  # by class, no fraction is requested for testing
        return [f"split {name} is empty: {why[name]}" for name in empty]

    off = [
        name
        for name, share in asked.items()
        if share and not share / MUCH <= samples[name] / total <= share * MUCH
    ]
    if not off:
        return []
    told = ", ".join(f"{name} {samples[name] / total:.0%} ({asked[name]:.0%})" for name in samples)
    objects = sum(count.objects for count in counts)
    return [
        f"the fractions of the split differ from the requested ones (in brackets): {told}. Whole "
        f"objects are drawn, and {objects:,} objects have samples. What would help: more objects, "
        "or equally many samples of each (--samples-per-object)"
    ]


def _why_empty(objects: int) -> str:
    """Return why a split by object may be empty, given the number of objects with samples."""
    if objects < len(SPLITS):
        verb = "has" if objects == 1 else "have"
        return f"{counted(objects, 'object')} {verb} samples, and three fill all splits"
    return (
        "objects stay in the split in which they were first; `drakegrasp assemble OUT --set "
        "split.seed=1` draws all splits anew"
    )


#: Why a split by class may be empty.
EMPTY_BY_CLASS = {
    "train": "a class trains if two of its objects have samples, or if split.train_classes names "
    "it; --set split.by=object trains on any",
    "valid": "more samples would help, or a larger split.valid_fraction",
    "test": "classes of which two objects have samples would help, or --set split.by=object",
}
