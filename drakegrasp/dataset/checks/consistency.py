"""Rules between the rows and the files of a dataset: splits, successes, objects, configurations.

In: open files of a dataset, and its manifest. Out: a `Violation` for each contradiction. Columns
of numbers and names are read whole; images are not read.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

import numpy as np

from drakegrasp.dataset.assembly.weights import weigh_samples
from drakegrasp.dataset.checks.findings import AnyArray, Violation, of_file
from drakegrasp.dataset.checks.open_file import OpenFile, column
from drakegrasp.dataset.manifest import Manifest
from drakegrasp.dataset.paths import FILE_NAME, TRIALS_FILE
from drakegrasp.dataset.schema import OBJECT_FIELDS, SPLITS
from drakegrasp.frames import unpack_pose
from drakegrasp.outcomes import Removal


def splits(
    data: OpenFile, groups: Mapping[str, str], meshes: Mapping[str, str]
) -> Iterator[Violation]:
    """A trial is one sample; a tested object, or a class left out, is in no other split.

    Args:
        data: The data file.
        groups: Group of each object by its name, as far as they are known.
        meshes: Name of its mesh, likewise; under several seeds it is one object.
    """
    # Each trial once; meanwhile gather the objects and their classes by split.
    seen: dict[int, str] = {}
    objects: dict[str, dict[str, str]] = {}
    for split, group in data.groups.items():
        for row, number in enumerate(group["trial_id"][:].tolist()):
            if number in seen:
                what = "trial_id must be unique in all splits"
                got = f"{number}, which is in /{seen[number]} too"
                yield Violation(file=data.name, group=f"/{split}", row=row, what=what, got=got)
            seen.setdefault(number, split)
        names, classes = (
            group[f"object_props/{key}"].asstr()[:] for key in ("object_name", "class_name")
        )
        objects[split] = dict(zip(names.tolist(), classes.tolist(), strict=True))

    # By object: no object in two splits, nor another one of its mesh.
    if str(data.file.attrs.get("split_by")) == "object":
        home: dict[str, str] = {}
        for split, members in objects.items():
            for group in sorted({groups.get(name, name) for name in members}):
                if home.setdefault(group, split) != split:
                    what = "an object and its group must be in one split"
                    yield of_file(data.name, what, f"{group}, in /{home[group]} too", f"/{split}")
        return

    # By class, outside of the test split: no tested object, and only the classes to train on.
    objects = {
        split: {meshes.get(name, name): kind for name, kind in members.items()}
        for split, members in objects.items()
    }
    tested = objects.pop("test", {})
    allowed = data.config.split.train_classes if data.config else None
    for split, members in objects.items():
        for name, class_name in sorted(members.items()):
            if name in tested:
                what = "an object of /test must be in no other split"
                yield of_file(data.name, what, f"{name} in both", f"/{split}")
            if allowed is not None and class_name not in allowed:
                what = "a class must be one of split.train_classes"
                yield of_file(data.name, what, class_name, f"/{split}")

    # A class to train on has exactly one tested object; none if it is named and has one object.
    trained = {c for members in objects.values() for c in members.values()}
    if len(data.groups) == len(SPLITS):
        for class_name in sorted(trained):
            count = sum(c == class_name for c in tested.values())
            outside = {
                n for members in objects.values() for n, c in members.items() if c == class_name
            }
            alone = allowed is not None and len(outside) == 1 and count == 0
            if count != 1 and not alone:
                what = f"class {class_name} must have one object in /test, as it has others outside"
                yield of_file(data.name, what, str(count))


def successes(trials: OpenFile, expected: AnyArray) -> Iterator[Violation]:
    """Every success is in /successes, in order, with a legal reason of removal and certificate.

    Args:
        trials: The file of the trials.
        expected: (n,), ids of the trials that are successes.
    """
    # The same trials in the same order.
    group = trials.groups["successes"]
    ids, removal = group["trial_id"][:], group["removal"][:]
    if not np.array_equal(ids, expected):
        different = sorted(set(ids.tolist()) ^ set(expected.tolist()))
        got = f"differences at trials {different[:5]}" if different else "another order"
        yield of_file(trials.name, "trial_id must list the successes of /trials", got, "/successes")

    # Legal values.
    for row in np.flatnonzero(~np.isin(removal, [r.value for r in Removal])).tolist():
        yield Violation(
            file=trials.name,
            group="/successes",
            row=row,
            what=f"removal must be 0..{max(Removal)}",
            got=str(removal[row]),
        )
    for name, largest in (("certified_share", 1.0), ("certified_friction", np.inf)):
        values = group[name][:]
        bad = ~np.isnan(values) & ~((values >= 0.0) & (values <= largest))
        for row in np.flatnonzero(bad).tolist():
            yield Violation(
                file=trials.name,
                group="/successes",
                row=row,
                what=f"{name} must be 0..{largest:g} or NaN",
                got=f"{values[row]:g}",
            )


def kept_are_samples(data: OpenFile, trials: OpenFile) -> Iterator[Violation]:
    """The samples are exactly the successes that no filter removed."""
    if len(data.groups) < len(SPLITS) or "successes" not in trials.groups:
        return
    group = trials.groups["successes"]
    kept = set(group["trial_id"][:][group["removal"][:] == Removal.KEPT].tolist())
    ids = {i for split in data.groups.values() for i in split["trial_id"][:].tolist()}
    for what, others in (
        (f"every success that /successes of {trials.name} keeps must be a sample", kept - ids),
        (f"every sample must be a success that /successes of {trials.name} keeps", ids - kept),
    ):
        if others:
            yield of_file(data.name, what, f"{len(others)} otherwise: trials {sorted(others)[:5]}")


def likeness(data: OpenFile, trials: OpenFile, manifest: Manifest) -> Iterator[Violation]:
    """No family is in two splits, no refined grasp is tested, and weights count what is alike."""
    names = ("object", "candidate", "standoff_index", "child", "resting", "X_OG")
    columns = {name: trials.groups["trials"][name][:] for name in names}
    ids = {split: group["trial_id"][:] for split, group in data.groups.items()}
    ids = {split: own[(own >= 0) & (own < len(columns["child"]))] for split, own in ids.items()}

    # Families and their splits.
    seen: dict[tuple[int, ...], str] = {}
    for split, own in ids.items():
        rows = np.column_stack([columns[name][own] for name in names[:3]]).tolist()
        for row, key in enumerate(map(tuple, rows)):
            if seen.setdefault(key, split) != split:
                what = "a first-round attempt and all refined from it must be in one split"
                got = f"others of the family in /{seen[key]}"
                yield Violation(file=data.name, group=f"/{split}", row=row, what=what, got=got)
        if split == "test":
            for row in np.flatnonzero(columns["child"][own] > 0).tolist():
                what, got = "a tested grasp must be of the first round", "a refined one"
                yield Violation(file=data.name, group="/test", row=row, what=what, got=got)

    # The weights, from the palms of all samples.
    every = np.concatenate([np.zeros(0, dtype=np.int64), *ids.values()])
    numbers = manifest.pose_numbers()
    rows = zip(columns["object"][every], columns["resting"][every], strict=True)
    poses = np.array([numbers[i][k] for i, k in rows], dtype=np.int64)
    due = weigh_samples(poses, unpack_pose(columns["X_OG"][every])).astype(np.float32)
    for split, own in ids.items():
        weights = data.groups[split]["grasp_props/weight"][:]
        expected, due = np.split(due, [len(own)])
        if len(weights) == len(expected):
            for row in np.flatnonzero(weights != expected).tolist():
                what = f"weight must be {expected[row]:g}, 1 / number of samples that are near"
                got = f"{weights[row]:g}"
                yield Violation(file=data.name, group=f"/{split}", row=row, what=what, got=got)


def same_objects(trials: OpenFile, manifest: Manifest) -> Iterator[Violation]:
    """/objects agrees with the manifest."""
    if "objects" not in trials.groups:
        return
    if trials.count("objects") != len(manifest.objects):
        what = f"number of objects must be that of {FILE_NAME}, {len(manifest.objects)}"
        yield of_file(trials.name, what, str(trials.count("objects")), "/objects")
        return
    for f in OBJECT_FIELDS:
        values = column(trials.groups["objects"][f.name], f)[:].tolist()
        for row, (value, entry) in enumerate(zip(values, manifest.objects, strict=True)):
            expected = getattr(entry, f.name)
            if value != expected and not (expected is None and np.isnan(value)):
                what = f"{f.name} must be that of {FILE_NAME}, {expected!r}"
                yield Violation(
                    file=trials.name, group="/objects", row=row, what=what, got=repr(value)
                )


def same_configuration(files: Iterable[OpenFile], manifest: Manifest) -> Iterator[Violation]:
    """All files are of the manifest's configuration, and of one state of the shards."""
    expected = manifest.config.simulation_hash()
    states = set()
    for file in files:
        states.add(tuple(str(file.file.attrs.get(key)) for key in ("signature", "shards")))
        if file.config is None:
            continue

        # The configuration, and the split that follows from it.
        own = file.config.simulation_hash()
        if own != expected:
            what = f"configuration must be that of {FILE_NAME}, {expected}"
            yield of_file(file.name, what, own)
        elif file.config != manifest.config:
            what = f"filters, split and limits must be those of {FILE_NAME}"
            yield of_file(file.name, what, "others; run `drakegrasp assemble` again")
        rule = str(file.file.attrs.get("split_by", manifest.split_rule))
        if rule != manifest.split_rule:
            what = f"split_by must be that of {FILE_NAME}, {manifest.split_rule}"
            yield of_file(file.name, what, rule)
    if len(states) > 1:
        what = "the three files must be of one assembly"
        yield of_file(TRIALS_FILE, what, f"{len(states)}; run `drakegrasp assemble` again")


def same_shards(files: Iterable[OpenFile], expected: str) -> Iterator[Violation]:
    """The files were made from the shards that are there, whose seals have a hash in common."""
    for file in files:
        if str(file.file.attrs.get("shards")) != expected:
            what = "the file must be made from the shards that are there"
            yield of_file(file.name, what, "others; run `drakegrasp assemble` again")
