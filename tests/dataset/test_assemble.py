"""Assembling the files from the shards."""

from __future__ import annotations

import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from io import BufferedReader
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from helpers.assertions import arrays_of, contents
from helpers.datasets import OTM, OTO, SLIP, TRIALS, make_dataset
from helpers.shards import read_shard

from drakegrasp.dataset import assemble as module
from drakegrasp.dataset import hdf5, shards
from drakegrasp.dataset.assemble import assemble, assemble_locked, survey
from drakegrasp.dataset.manifest import read_manifest, with_postprocessing
from drakegrasp.dataset.rejections import (
    AttemptKey,
    Decisions,
    read_decisions,
    write_decisions,
)
from drakegrasp.dataset.schema import CAMERAS
from drakegrasp.dataset.successes import in_image, read_summary
from drakegrasp.errors import ConfigError, DataError
from drakegrasp.filters import Removal
from drakegrasp.frames import (
    invert_pose,
    make_pose,
    pack_pose,
    rotation_about,
    transform_points,
    unpack_pose,
)
from drakegrasp.grasp import unpack_grasp
from drakegrasp.runtime.files import open_sealed, seal

FILES = (OTO, OTM, TRIALS)


def test_each_seal_is_verified_once(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Though the second pass opens each shard again, when all successes are known."""
    opened, verified = Counter[Path](), Counter[Path]()

    def count(path: Path, what: str, *, verify: bool) -> BufferedReader:
        opened[path] += 1
        verified[path] += verify
        return open_sealed(path, what, verify=verify)

    monkeypatch.setattr(hdf5, "open_sealed", count)
    assert assemble(out).removed == {Removal.KEPT: 9}
    assert verified == Counter(out.glob("shards/*/*.h5"))
    assert [*opened.values()] == [2] * 6


def test_shard_that_is_damaged_after_its_unit_ended_is_not_copied(out: Path) -> None:
    """A build knows the units that it ran, and reads their shards to copy them only."""
    manifest = read_manifest(out)
    known = {h: read_summary(out, h, manifest.config) for h in manifest.headers()}
    surveyed, before = survey(out, manifest, known), (out / TRIALS).read_bytes()
    path = sorted(out.glob("shards/*/*.h5"))[-1]
    content = bytearray(path.read_bytes())
    content[-100] ^= 1
    path.write_bytes(content)
    with pytest.raises(DataError, match="damaged or cut off"):
        assemble_locked(out, surveyed)
    assert (out / TRIALS).read_bytes() == before


def test_assembling_again_gives_the_same_bytes(out: Path) -> None:
    before = [(out / name).read_bytes() for name in FILES]
    for name in FILES:
        (out / name).unlink()
    assemble(out)
    assert [(out / name).read_bytes() for name in FILES] == before


def test_shards_without_a_column_that_they_may_lack_are_assembled(out: Path) -> None:
    for path in out.glob("shards/*/*.h5"):
        with h5py.File(path, "a") as file:
            del file["trials/unused"]
        seal(path)
    assert assemble(out).removed == {Removal.KEPT: 9}


def test_shard_without_a_success_has_trials_only(tmp_path: Path) -> None:
    """The third of the four candidates fails at each stand-off: its shard has no success."""
    (tmp_path / "meshes").mkdir()
    out = make_dataset(tmp_path / "out", tmp_path / "meshes", overrides=["unit_candidates=1"])
    assert len(list(out.glob("shards/*/*.h5"))) == 12
    assert assemble(out).removed == {Removal.KEPT: 9}


@pytest.mark.parametrize("camera", CAMERAS)
def test_palm_and_contacts_of_a_sample_are_as_far_apart_as_in_its_trial(
    out: Path, camera: str
) -> None:
    """Seen from the palm, a contact is where it was in the trial, in any camera and at any end."""
    with h5py.File(out / f"grasping_{camera}.hdf5") as data, h5py.File(out / TRIALS) as trials:
        sample, trial = data["test"], trials["trials"]
        number = int(sample["trial_id"][2])
        p_GQ = {}
        for when, end in (("closed", ""), ("lifted", "_lifted")):
            X_GC = invert_pose(unpack_pose(sample[f"grasp_props/X_CG{end}"][2]))
            p_CQ, _ = unpack_grasp(sample[f"grasps{end}"][2])
            X_GO = invert_pose(unpack_pose(trial["X_OG" if not end else "X_OG_lifted"][number]))
            p_GQ[when] = transform_points(X_GC, p_CQ)
            expected = transform_points(X_GO, trial[f"{when}_p_OQ"][number])
            np.testing.assert_allclose(p_GQ[when], expected, atol=1e-6)
    assert np.abs(p_GQ["closed"] - p_GQ["lifted"]).max() > SLIP / 4


Spoil = Callable[[dict[str, np.ndarray], dict[str, np.ndarray]], Any]


def spoil(out: Path, edits: Sequence[Spoil]) -> None:
    """Change the first successes, one by each edit, given their rows of /trials and of /looks."""
    left = list(edits)
    for header in read_manifest(out).headers():
        shard = read_shard(header.path(out), header)
        for k, row in enumerate(shard.looks["row"].tolist()):
            if left:
                trial = {name: values[row : row + 1] for name, values in shard.trials.items()}
                left.pop(0)(
                    trial, {name: values[k : k + 1] for name, values in shard.looks.items()}
                )
        shards.write_shard(out, shard)


def empty_mask(camera: str) -> Any:
    return lambda _, look: look[f"mask_{camera}"].fill(0)


def turned_camera(camera: str) -> Any:
    """Turn a camera about its own y axis, so that it looks past the object, or at its back."""

    def turn(_: Any, look: dict[str, np.ndarray]) -> None:
        X = make_pose(rotation_about([0.0, 1.0, 0.0], 1.2), np.zeros(3))
        look[f"X_TC_{camera}"][0] = pack_pose(unpack_pose(look[f"X_TC_{camera}"][0]) @ X)

    return turn


def flat(camera: str) -> Any:
    """Give a depth image one value; its colours still vary."""

    def fill(_: Any, look: dict[str, np.ndarray]) -> None:
        image = look[f"image_{camera}"][0]
        image[:3] = np.linspace(0.0, 1.0, image[:3].size).reshape(image[:3].shape)
        image[3] = 0.3

    return fill


def one_finger(name: str, value: float) -> Any:
    return lambda trial, _: trial[name][0].__setitem__(1, value)


def lost_finger(when: str) -> Any:
    return lambda trial, _: trial[f"{when}_touching"][0].__setitem__(2, False)


SPOILT: list[tuple[Spoil, Removal]] = [
    (empty_mask("oto"), Removal.NOT_SEEN),
    (empty_mask("otm"), Removal.NOT_SEEN),
    (turned_camera("oto"), Removal.OUT_OF_VIEW),
    (turned_camera("otm"), Removal.OUT_OF_VIEW),
    (flat("otm"), Removal.FLAT_DEPTH),
    (flat("oto"), Removal.KEPT),
    (one_finger("surface_distance", 2.1e-3), Removal.OFF_SURFACE),
    (one_finger("normal_angle", 0.6), Removal.NORMAL_OFF),
    (one_finger("closed_nhat_Q_O", np.nan), Removal.OFF_SURFACE),
    (one_finger("lifted_nhat_Q_O", np.nan), Removal.OFF_SURFACE),
    (lambda trial, _: trial["lifted_other_links"].fill(1), Removal.OTHER_LINKS),
    (lambda trial, _: trial["slip"].fill(0.011), Removal.SLID),
    (lambda trial, _: trial["turn"].fill(0.2), Removal.TURNED),
    (lost_finger("closed"), Removal.MISSING_FINGER),
    (lost_finger("lifted"), Removal.MISSING_FINGER),
]


@pytest.mark.parametrize("first", [0, 8])
def test_a_success_that_is_spoiled_is_removed_for_that_reason(out: Path, first: int) -> None:
    """By one number of one finger or camera; the other grasps of the dataset stay."""
    edits, reasons = zip(*SPOILT[first : first + 8], strict=True)
    spoil(out, edits)
    removed = assemble(out, overrides=["filters.min_depth_variance=1e-6"]).removed
    expected = [*reasons, *[Removal.KEPT] * (9 - len(reasons))]
    assert removed == Counter(expected)
    with h5py.File(out / TRIALS) as file:
        assert file["successes/removal"][:].tolist() == expected


@pytest.fixture
def removed(sound: Path) -> Callable[..., Counter[Removal]]:
    """Returns how many successes assembling with other filters removes, by the reason."""

    def count(*overrides: str) -> Counter[Removal]:
        manifest = with_postprocessing(read_manifest(sound), overrides)
        return Counter(map(Removal, survey(sound, manifest).successes["removal"].tolist()))

    return count


def test_each_part_of_the_anomaly_reaches_its_filter(
    removed: Callable[..., Counter[Removal]],
) -> None:
    """The score of a made-up grasp is 1.2, its depth 0.1 mm, its forces do not carry the weight."""
    limits = ("max_anomaly", "max_penetration", "max_imbalance", "max_normal_sum")
    for low in (None, *limits):
        overrides = [f"filters.{name}={'1e-5' if name == low else '1e9'}" for name in limits]
        reason = Removal.KEPT if low is None else Removal.ANOMALOUS
        assert removed(*overrides) == {reason: 9}


def test_camera_height_is_above_the_table(
    sound: Path, removed: Callable[..., Counter[Removal]]
) -> None:
    """A limit a millimetre above the lowest camera removes its grasps, one below keeps all."""
    with h5py.File(sound / OTM) as file:
        heights = [
            X[11] for split in file for X in file[f"{split}/object_props/frame_work2cam_otm"]
        ]
    for by, some in ((1e-3, True), (-1e-3, False)):
        limit = min(heights) + by
        counts = removed(f"filters.min_camera_height={limit}")
        lower = sum(height < limit for height in heights)
        assert counts[Removal.BISECTS_TABLE] == lower
        assert (lower > 0) == some


def test_contact_is_in_view_within_the_image_and_before_the_camera() -> None:
    """A camera of 33 pixels that sees 45 degrees to each side: half a metre at that distance."""
    K = np.array([[16.0, 0.0, 16.0], [0.0, 16.0, 16.0], [0.0, 0.0, 1.0]])
    seen = [[0.0, 0.0, 0.3], [0.1, 0.0, 0.3], [0.49, 0.0, 0.5]]
    beside = [[0.51, 0.0, 0.5], [-0.51, 0.0, 0.5], [0.0, 0.51, 0.5], [0.0, -0.51, 0.5]]
    p_CQ = np.array([*seen, *beside, [0.0, 0.0, -0.3], [np.nan] * 3])
    assert in_image(K, 33, p_CQ).tolist() == [True] * 3 + [False] * 6


@pytest.mark.parametrize("override", ["filters.require=lifted", "filters.max_slip=null"])
def test_filters_that_lifts_were_ended_by_cannot_be_looser(tmp_path: Path, override: str) -> None:
    """Of the lifts that ended nobody knows whether they would be samples then."""
    out = make_dataset(
        tmp_path / "out", tmp_path / "meshes", overrides=["lift.stop_when=lost_sample"]
    )
    before = contents(out)
    with pytest.raises(ConfigError, match=rf"{override.partition('=')[0]} must be"):
        assemble(out, overrides=[override])
    assert contents(out) == before
    assert assemble(out, overrides=["filters.max_slip=0.009"]).samples


def test_what_is_refused_changes_nothing(out: Path) -> None:
    """A rejected failure; a damaged shard."""
    before = [(out / name).read_bytes() for name in FILES]
    with pytest.raises(DataError, match="rejected trials must be successes, got trial 1"):
        assemble(out, rejected=[0, 1])
    path = sorted(out.glob("shards/*/*.h5"))[-1]
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(DataError, match="damaged or cut off"):
        assemble(out)
    assert [(out / name).read_bytes() for name in FILES] == before


#: Assembles a dataset with less and less room for a file: each in a process of its own, because a
#: fault of HDF5 would end it. Prints for each amount how the process ended and what it said.
FULL_DISK = """
import os, resource, signal, sys
from pathlib import Path
from drakegrasp.dataset.assemble import assemble
from drakegrasp.errors import DiskFullError

for limit in map(int, sys.argv[2:]):
    child = os.fork()
    if not child:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
        try:
            assemble(Path(sys.argv[1]))
        except DiskFullError as error:
            print(error, end=" ", flush=True)
        os._exit(0)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""


@pytest.mark.nightly
def test_full_disk_is_one_line_wherever_it_fills(out: Path) -> None:
    before = {name: (out / name).read_bytes() for name in FILES}
    largest = max(map(len, before.values()))
    limits = [largest * share // 12 for share in range(1, 12)]
    run = subprocess.run(
        [sys.executable, "-c", FULL_DISK, str(out), *map(str, limits)],
        capture_output=True,
        text=True,
        check=True,
    )
    line = f"{out}: the disk or the quota is full (No space left on device); make room, and the "
    line += "same command continues from here 0"
    assert run.stdout.splitlines() == [line] * len(limits)
    assert not run.stderr
    assert {name: (out / name).read_bytes() for name in FILES} == before
    assert not list(out.glob(".*"))


def test_rows_of_many_chunks_are_those_of_one(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Chunks of five rows, in blocks of ten: a block begins and ends within a shard."""
    before = {name: arrays_of(out / name) for name in FILES}
    monkeypatch.setattr(hdf5, "COLUMN_CHUNK", 5)
    monkeypatch.setattr(module, "BLOCK", 10)
    seen: list[tuple[int, int | None]] = []
    assemble(out, progress=lambda done, total, **_: seen.append((done, total)))
    assert seen == sorted(seen)
    assert seen[-1] == (12, 12)
    with h5py.File(out / TRIALS) as file:
        assert file["trials/X_TO"].chunks == (5, 12)
        assert len(file["trials/X_TO"]) == 36
    np.testing.assert_equal({name: arrays_of(out / name) for name in FILES}, before)


@pytest.mark.parametrize("camera", CAMERAS)
def test_pose_of_the_object_in_the_world_is_that_of_its_trial(out: Path, camera: str) -> None:
    """The table's frame is 0.65 m above the world's and not turned; the object is."""
    with h5py.File(out / f"grasping_{camera}.hdf5") as data, h5py.File(out / TRIALS) as trials:
        numbers = data["test/trial_id"][:].astype(int)
        expected = unpack_pose(trials["trials/X_TO"][:][numbers])
        assert np.abs(expected[:, :3, :3] - np.eye(3)).max() > 0.5
        expected[:, 2, 3] += 0.65
        found = unpack_pose(data["test/object_props/frame_world2obj"][:])
        np.testing.assert_allclose(found, expected, atol=1e-6)


# Decisions of an inspection

A, B = AttemptKey("1_box_a", 0, 0), AttemptKey("3_brick", 1, 0)


def test_decisions_are_read_as_they_were_written(tmp_path: Path) -> None:
    path = tmp_path / "reject.json"
    assert read_decisions(path) == Decisions()
    decisions = Decisions().with_decision(B, "rejected").with_decision(A, "kept")
    write_decisions(path, decisions)
    assert read_decisions(path) == decisions
    assert read_decisions(path).rejected == {B}
    assert [p.name for p in tmp_path.iterdir()] == ["reject.json"]


def test_a_decision_replaces_the_one_before() -> None:
    rejected = Decisions().with_decision(A, "rejected")
    assert rejected.of(A) == "rejected"
    assert rejected.with_decision(A, "kept") == Decisions(kept=frozenset([A]))
    assert rejected.with_decision(A, "") == Decisions()
    assert rejected.of(B) == ""
    with pytest.raises(ValueError, match="decision must be rejected, kept or empty, got 'no'"):
        rejected.with_decision(A, "no")
