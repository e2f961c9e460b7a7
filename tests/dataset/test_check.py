"""The check of files and rows: what passes, what is missing, damaged, wrong or of another state."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import h5py
import numpy as np
import pytest
from helpers.datasets import (
    AFTER_LIFT,
    BELOW,
    BOXES,
    HAND,
    MISSING,
    OTM,
    OTO,
    OUTCOMES,
    SLIPPED,
    SUCCESS,
    TRIALS,
    Edit,
    change,
    edit_file,
    edit_manifest,
    found,
    make_dataset,
    mirrored,
    moved,
    must_find,
    set_at,
)
from helpers.physics import broken_physics
from helpers.shards import read_shard

from drakegrasp.dataset import check
from drakegrasp.dataset.assemble import IMAGES, assemble
from drakegrasp.dataset.check import check_dataset
from drakegrasp.dataset.hdf5 import AnyArray
from drakegrasp.dataset.manifest import read_manifest, write_manifest
from drakegrasp.dataset.paths import model_path, plan_path
from drakegrasp.dataset.schema import DATA_FIELDS, HITS_NOTHING, HITS_TABLE, NOT_TRIED
from drakegrasp.dataset.shards import write_shard
from drakegrasp.errors import DataError
from drakegrasp.frames import invert_pose, pack_pose, unpack_pose
from drakegrasp.generation.scenes import make_scenes
from drakegrasp.hand.settings import override_config
from drakegrasp.objects.model import load_object, save_object
from drakegrasp.runtime.executor import processes

T, R = TypeVar("T"), TypeVar("R")
FILES = (OTO, OTM, TRIALS)
#: Everything is drawn. Small turns: the boxes' contacts stay in view.
DRAWN = (
    *("randomize.object_colour=1", "randomize.table_colour=1", "randomize.light_angle_deg=60"),
    *("randomize.light_strength=[0.2,1.5]", "randomize.camera_shift=0.005"),
    *("randomize.camera_turn_deg=2", "randomize.depth_noise=[0.002,0.004]"),
    *("randomize.depth_baseline=0.02", "randomize.friction_hand=[0.7,1.3]"),
    *("randomize.friction_table=[0.7,1.3]", "randomize.mass=[0.5,1.5]"),
)
AS_WRITTEN = "the file must be as it was written"


@pytest.mark.parametrize(
    "overrides", [None, ["split.by=class"], ["close.scrape_depth=null"], DRAWN]
)
def test_a_sound_dataset_passes(sound: Path, tmp_path: Path, overrides: list[str] | None) -> None:
    out = sound
    if overrides is not None:
        out = make_dataset(tmp_path / "out", tmp_path / "meshes", overrides=overrides)
    assert check_dataset(out) == []
    assert broken_physics(out) == {}


@pytest.mark.nightly
def test_two_processes_find_what_one_does(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Small tasks, with faults in the first and the last rows, in an object and in a shard."""
    (out / "shards/2_box_b/0000002-0000004.h5").unlink()
    model_path(out, "1_box_a").write_bytes(b"")
    edit_file(out / TRIALS, lambda f: f["trials/object"].__setitem__(35, 9))
    for name in (OTO, OTM):
        edit_file(out / name, lambda f: f["test/grasps"].__setitem__((-1, 0), np.nan))
    expected = check_dataset(out)
    assert {(v.file, v.group) for v in expected} == {
        ("objects/1_box_a.npz", ""),
        ("shards/2_box_b/0000002-0000004.h5", ""),
        (TRIALS, "/trials"),
        *((name, "/test") for name in (OTO, OTM)),
    }

    monkeypatch.setattr(check, "TASK_ROWS", 7)
    assert check_dataset(out) == expected
    assert check_dataset(out, execute=backwards) == expected
    with processes(2) as execute:
        assert check_dataset(out, execute=execute) == expected


def backwards(function: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
    """Run as workers may: the last item is done first."""
    return map(function, reversed(list(items)))


def test_file_that_is_replaced_meanwhile_is_one_error(out: Path) -> None:
    def replacing(function: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
        for item in items:
            shutil.copy(out / OTO, out / "copy")
            (out / "copy").replace(out / OTO)
            yield function(item)

    with pytest.raises(DataError, match=r"_oto.hdf5: must stay while it is read, got another"):
        check_dataset(out, execute=replacing)


@pytest.mark.parametrize("name", FILES)
def test_seal_of_a_file_finds_one_changed_bit(out: Path, name: str) -> None:
    """Here in an image of a sample, or in the friction of an attempt, which no rule is about."""
    column = "trials/friction_hand" if name == TRIALS else "train/images"
    with h5py.File(out / name) as file:
        chunk = file[column].id.get_chunk_info(0)
    content = bytearray((out / name).read_bytes())
    content[chunk.byte_offset + chunk.size // 2] ^= 1
    (out / name).write_bytes(content)
    assert (name, "", None, AS_WRITTEN) in found(out)


def test_files_of_other_shards_are_found(out: Path) -> None:
    """A shard that is whole, and not the one that the files were made from."""
    header = next(read_manifest(out).headers())
    shard = read_shard(header.path(out), header)
    slip = np.array(shard.trials["slip"])
    slip[np.isfinite(slip)] += 1e-3
    write_shard(out, replace(shard, trials={**shard.trials, "slip": slip}))
    what = "attribute shards must be that of the shards that are there"
    must_find(out, *((name, "", None, what) for name in FILES))


def _one_more(file: h5py.File) -> None:
    group = file["objects"]
    for name in [*group]:
        values, attrs = group[name][:], dict(group[name].attrs)
        dtype = group[name].dtype
        del group[name]
        group.create_dataset(name, data=np.append(values, values[:1]), dtype=dtype)
        group[name].attrs.update(attrs)


@pytest.mark.parametrize(
    "edit",
    [
        lambda file: file["objects/name"].__setitem__(1, b"a\x1b]0;x\x07"),
        lambda file: file["objects/mass"].write_direct(2.0 * file["objects/mass"][:]),
        _one_more,
    ],
    ids=["name", "mass", "one more"],
)
def test_objects_of_trials_are_those_of_the_manifest(out: Path, edit: Callable[..., Any]) -> None:
    edit_file(out / TRIALS, edit)
    must_find(out, (TRIALS, "", None, "the objects must be those of manifest.json"), of=TRIALS)


def test_files_are_of_the_manifests_configuration(out: Path) -> None:
    manifest = read_manifest(out)
    config = override_config(manifest.config, ["split.valid_fraction=0.3"])
    write_manifest(replace(manifest, config=config), out)
    what = "attribute signature must be that of manifest.json"
    must_find(out, *((name, "", None, what) for name in FILES))
    config = override_config(manifest.config, ["verify.max_contact_error=0.02"])
    write_manifest(replace(manifest, config=config), out)
    must_find(out)


def test_a_group_of_objects_in_two_splits_is_reported(out: Path) -> None:
    assemble(out, overrides=["split.by=object"])
    assert not found(out)
    homes = {entry.split: entry.name for entry in read_manifest(out).objects}
    assert {*homes} == {"train", "valid", "test"}

    def join(tree: dict[str, Any]) -> None:
        for entry in tree["objects"]:
            if entry["name"] in (homes["train"], homes["valid"]):
                entry["group"] = "one"

    edit_manifest(out, join)
    (violation,) = (v for v in check_dataset(out) if v.file == "manifest.json")
    assert str(violation) == (
        "manifest.json: objects of one group must be in one split, got them in "
        f"{' and '.join(e.split or '' for e in read_manifest(out).objects if e.group)}"
    )


def linked(path: Path) -> None:
    edit_file(path, lambda f: f.__setitem__("link", h5py.SoftLink("/train")))


def truncated(path: Path) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])


@pytest.mark.parametrize("spoil", [linked, truncated, Path.unlink])
def test_a_file_that_cannot_be_read_hides_no_other_fault(
    out: Path, spoil: Callable[[Path], None]
) -> None:
    spoil(out / OTM)
    change(out, OTO, "train/masks", 0, set_at(0, 0, to=2))
    must_find(
        out,
        (OTM, "", None, "the file must be there, readable"),
        (OTO, "/train", 0, "masks must be 0..1"),
    )


def test_rows_that_cannot_be_read_are_found(out: Path) -> None:
    with h5py.File(out / OTO) as file:
        offset = file["train/object_props/work2mass"].id.get_chunk_info(0).byte_offset
    with open(out / OTO, "r+b") as raw:
        raw.seek(offset)
        raw.write(b"\xff" * 64)
    what = "rows 0 to 2 must be readable"
    must_find(out, (OTO, "", None, AS_WRITTEN), (OTO, "/train", None, what))


def test_any_path_of_a_dataset_may_have_faults(out: Path, tmp_path: Path) -> None:
    odd = Path(shutil.copytree(out, tmp_path / "a: b, got c" / "out"))
    model_path(odd, "1_box_a").unlink()
    plan_path(odd, "2_box_b").write_bytes(b"")
    places = {v.file: v.got for v in check_dataset(odd)}
    assert {"objects/1_box_a.npz", "objects/2_box_b.plan.h5"} <= set(places)
    assert "a: b" not in places["objects/2_box_b.plan.h5"]


def test_each_file_of_an_object_is_checked(out: Path) -> None:
    """Shards that are damaged or of another unit, meshes, and a flipped bit in a plan."""
    damaged, other = ("shards/1_box_a/0000000-0000002.h5", "shards/2_box_b/0000000-0000002.h5")
    for path in (out / damaged, plan_path(out, "2_box_b")):
        content = bytearray(path.read_bytes())
        content[-100] ^= 1
        path.write_bytes(content)
    shard = read_shard(out / other)
    write_shard(out, replace(shard, header=replace(shard.header, mesh_sha256="0")))
    model_path(out, "3_brick").unlink()
    box = load_object(model_path(out, "1_box_a"))
    save_object(replace(box, mesh_sha256="0"), model_path(out, "1_box_a"))

    written, whole = "the meshes must be as they were written", "the shard must be there, whole"
    of_manifest = "the meshes must be those of manifest.json"
    violations = {(v.file, v.what): v.got for v in check_dataset(out) if v.file not in FILES}
    assert violations.keys() == {
        *((path, f"{whole} and of its work unit") for path in (damaged, other)),
        ("objects/2_box_b.plan.h5", "the plan must be as it was written"),
        *((f"objects/{name}.npz", written) for name in ("1_box_a", "3_brick")),
        *((f"objects/{name}.npz", of_manifest) for name in ("1_box_a", "3_brick")),
    }
    assert "damaged or cut off" in violations[damaged, f"{whole} and of its work unit"]


def test_rows_that_break_one_rule_are_counted(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def lose(file: h5py.File) -> None:
        file["trials/spread"][...] = np.nan

    monkeypatch.setattr(check, "TASK_ROWS", 10)
    edit_file(out / TRIALS, lose)
    violation = next(v for v in check_dataset(out) if v.file == TRIALS)
    assert str(violation) == (
        "trials.hdf5 /trials row 0 and 35 more: spread must be finite always, got nan"
    )


def retype(file: h5py.File) -> None:
    values, attrs = file["valid/masks"][:], dict(file["valid/masks"].attrs)
    del file["valid/masks"]
    file["valid/masks"] = values.astype(np.int32)
    file["valid/masks"].attrs.update(attrs)


#: Cases that are found together, since each is of another file or another attribute.
LAYOUT_CASES: Sequence[Sequence[tuple[str, Callable[[h5py.File], Any], str, str]]] = (
    (
        (OTO, lambda f: f.pop("valid"), "/valid", "the group must be there"),
        (OTM, lambda f: f.pop("valid/masks"), "/valid/masks", "the dataset must be"),
        (TRIALS, lambda f: f.attrs.update(schema_version=0), "", "the file must be there"),
    ),
    (
        (OTO, retype, "/valid/masks", "type must be uint8"),
        (OTM, lambda f: f["valid/masks"].resize(2, 0), "/valid/masks", "shape must be (3, 32"),
        (TRIALS, lambda f: f.attrs.update(seed=5), "", "attribute seed must be that of"),
    ),
    (
        (OTO, lambda f: f.attrs.pop("near"), "", "attribute near must be a positive"),
        (OTO, lambda f: f.attrs.update(config="{"), "", "attribute config must be a mapp"),
        (OTO, lambda f: f.attrs.update(versions="1"), "", "attribute versions must be "),
        (OTM, lambda f: f.attrs.update(K=f.attrs["K"] + 1e-3), "", "attribute K must be that of"),
        (TRIALS, lambda f: f.attrs.update(config_hash="0"), "", "attribute config_hash must"),
    ),
    (
        (OTO, lambda f: f.attrs.update(camera="otm"), "", "attribute camera must be that"),
        (OTM, lambda f: f.attrs.update(split_by="class"), "", "attribute split_by must be"),
        (TRIALS, lambda f: f.attrs.update(far=1.0), "", "attribute far must be that of"),
    ),
)


@pytest.mark.parametrize("cases", LAYOUT_CASES)
def test_a_wrong_layout_or_attribute_is_found(
    out: Path, cases: Sequence[tuple[str, Callable[[h5py.File], Any], str, str]]
) -> None:
    for name, edit, _, _ in cases:
        edit_file(out / name, edit)
    must_find(out, *((name, group, None, what) for name, _, group, what in cases))


@pytest.mark.sim
def test_scenes_are_checked(out: Path) -> None:
    make_scenes(out, overrides=["scenes.views=2"])
    must_find(out)
    path, name = out / "scenes.hdf5", "scenes.hdf5"

    def spoil(file: h5py.File) -> None:
        file["scenes/split"][0] = 3
        file["views/scene"][1] = 99
        file["views/X_TC"][0] = 1.1 * file["views/X_TC"][0]

    edit_file(path, spoil)
    spoilt = [
        (name, "/scenes", 0, "split must be 0..2"),
        (name, "/views", 1, "scene must be one of the rows of /scenes"),
        (name, "/views", 0, "X_TC must have an orthonormal rotation"),
    ]
    must_find(out, *spoilt)
    with h5py.File(path, "r+") as file:
        file.attrs["shards"] = "0" * 64
    other = (name, "", None, "attribute shards must be that of the shards that are there")
    must_find(out, *spoilt, other, (name, "", None, AS_WRITTEN))


# Rows: one wrong value breaks the one rule that is about it


TRIAL_CASES: Sequence[tuple[str, int, Edit, str]] = [
    ("trial_id", MISSING, lambda i: i + 1, "trial_id must be the number of the row"),
    ("outcome", BELOW, lambda _: 99, "outcome must be one of 0, 1, 2"),
    ("object", BELOW, lambda _: 3, "object must be one of the rows of /obj"),
    ("closed_q", SUCCESS, set_at(1, to=np.nan), "closed_q must be finite from"),
    ("spread", BELOW, lambda _: np.inf, "spread must be finite"),
    ("turn", MISSING, lambda _: 0.0, "turn must be finite from the stage tried"),
    ("closed_other_links", BELOW, lambda _: 1, "closed_other_links must be 0"),
    ("slip", AFTER_LIFT, lambda _: np.nan, "slip must be finite from"),
    ("closed_p_OQ", MISSING, set_at(2, to=0.0), "closed_p_OQ must be finite where"),
    ("lifted_p_OQ", SUCCESS, set_at(2, 0, to=np.nan), "lifted_p_OQ must be finite where"),
    ("closed_nhat_Q_O", SUCCESS, set_at(2, to=[0, 0.9, 0]), "normals in closed_nhat_Q_O must"),
    ("closed_penetration", SUCCESS, set_at(1, to=-1e-3), "closed_penetration must be 0..inf"),
    ("X_OG", BELOW, lambda p: 1.1 * p, "X_OG must have an orthonormal rotation"),
    ("X_OG_lifted", SUCCESS, mirrored, "X_OG_lifted must have an orthon"),
    ("slip_released", SUCCESS, lambda s: -s, "slip_released must be 0..inf"),
    ("object", BELOW, lambda _: -1, "object must be one of the rows of /obj"),
    ("turn_released", SUCCESS, lambda _: 4.0, "turn_released must be 0..3.142"),
    ("stable", MISSING, lambda _: True, "stable must be 0 before the stage tried"),
    ("X_TO_lifted", SUCCESS, mirrored, "X_TO_lifted must have an orthonormal"),
    ("clearance_lift", HAND, lambda _: 0.1, "clearance_lift must be NaN before"),
    ("slip_use", SLIPPED, lambda u: u + 1e-6, "slip_use must follow from"),
]


@pytest.mark.parametrize("first", range(0, len(TRIAL_CASES), len(BOXES)))
def test_a_wrong_value_of_a_trial_is_found(out: Path, first: int) -> None:
    """One of each object at once: all have the same attempts."""
    expected, cases = [], TRIAL_CASES[first : first + len(BOXES)]
    for k, (name, row, edit, what) in enumerate(cases):
        own = row + k * len(OUTCOMES)
        change(out, TRIALS, f"trials/{name}", own, edit)
        expected.append((TRIALS, "/trials", own, what))
    must_find(out, *expected, of=TRIALS)


def test_a_removal_without_a_meaning_is_found(out: Path) -> None:
    change(out, TRIALS, "successes/removal", 2, lambda _: 14)  # was one, and is none
    must_find(out, (TRIALS, "/successes", 2, "removal must be one of 0, 1, 2"))


PROPS, GRASP = "object_props/", "grasp_props/"
SAMPLE_CASES: Sequence[tuple[str, str, Edit, str]] = [
    # where it is, how it is broken, what is found
    (OTO, "grasps", set_at(0, to=np.inf), "grasps must be finite"),
    (OTM, PROPS + "frame_cam2img_otm", set_at(0, to=np.nan), PROPS + "frame_cam2img_otm must be f"),
    (OTO, "masks", set_at(3, 3, to=2), "masks must be 0..1"),
    (OTM, "masks", lambda m: 0 * m, "contacts must project within 2 px of the mask"),
    (
        OTO,
        "grasps",
        lambda g: np.hstack([g[:12], 1.01 * g[12:15], g[15:]]),
        "normals in grasps must have length 1",
    ),
    (OTM, "grasps_lifted", set_at(slice(9, 12), to=0.0), "normals in grasps_lifted"),
    (OTO, PROPS + "frame_world2obj", lambda p: 1.01 * p, f"{PROPS}frame_world2obj must"),
    (OTO, PROPS + "frame_cam2img_otm", mirrored, f"{PROPS}frame_cam2img_otm must"),
    (OTO, GRASP + "X_CG", mirrored, GRASP + "X_CG must have an orthonormal"),
    (OTO, PROPS + "frame_world2work", moved(0, 0, 0.01), "frame_world2work must be the"),
    (
        OTM,
        PROPS + "frame_cam2work_otm",
        moved(0, 0, 0.01),
        "frame_work2cam_otm times frame_cam2work_otm must be the identity",
    ),
    (OTO, PROPS + "work2mass", lambda m: 0 * m, PROPS + "work2mass must be above"),
    (OTM, GRASP + "slip_released", lambda s: -s, GRASP + "slip_released must be 0.."),
    (OTO, GRASP + "X_CG", moved(0, 1e-4, 0), GRASP + "X_CG must follow from its trial"),
    (OTO, PROPS + "frame_world2obj", moved(0, 1e-4, 0), PROPS + "frame_world2obj must follow from"),
    (OTO, "grasps", set_at(0, to=0.1), "contacts must project within 2 px of the mask"),
    (OTM, "grasps", set_at(2, to=-0.1), "contacts must project within 2 px of the mask"),
    (
        OTM,
        "grasps",
        lambda g: np.hstack([0.97 * g[:3], g[3:]]),
        "contacts must be on the object's mesh within 0.002 m",
    ),
    (
        OTM,
        "grasps",
        lambda g: np.hstack([g[:9], -g[9:12], g[12:]]),
        "normals must point out of the object",
    ),
    (OTM, "trial_id", lambda _: 36, "trial_id must be one of the rows of /trials"),
]
#: Where the samples of a file are.
SAMPLES = [(split, row) for split in ("train", "valid", "test") for row in range(3)]


@pytest.mark.parametrize("first", range(0, len(SAMPLE_CASES), len(SAMPLES)))
def test_a_wrong_value_of_a_sample_is_found(out: Path, first: int) -> None:
    """Each in a sample of its own."""
    expected, names = [], set()
    cases = SAMPLE_CASES[first : first + len(SAMPLES)]
    for (name, place, edit, what), (split, row) in zip(cases, SAMPLES, strict=False):
        change(out, name, f"{split}/{place}", row, edit)
        expected.append((name, f"/{split}", row, what))
        names |= {name} if place == "trial_id" else set()
    kept = "the samples must be the successes that no filter removes"
    must_find(out, *expected, *((name, "", None, kept) for name in names))


def slightly_wrong(values: AnyArray) -> AnyArray:
    """Change the first number of a field: by some units in the last place of the largest one."""
    wrong = np.array(values)
    first, largest = wrong.reshape(-1)[:1], np.abs(wrong).max()
    if wrong.dtype.kind == "f":
        first += 4 * np.spacing(largest)
    else:
        first[:] = not first[0]
    return wrong


def test_a_last_place_of_a_sample_that_its_trial_does_not_have_is_found(out: Path) -> None:
    copied = [f.name for f in DATA_FIELDS if f.of and f.name not in IMAGES]
    assert len(copied) > 20
    # This column decides what is due.
    places = [name for name in copied if name != GRASP + "unused"]
    for place in places:
        change(out, OTM, f"train/{place}", 1, slightly_wrong)
    must_find(out, *((OTM, "/train", 1, f"{name} must follow from its trial") for name in places))


def test_samples_are_the_kept_successes_each_once(out: Path) -> None:
    def repeat(file: h5py.File) -> None:
        file["train"].visititems(
            lambda _, item: (
                item.write_direct(item[:][[0, 0, 2]])
                if isinstance(item, h5py.Dataset) and item.dtype != object
                else None
            )
        )

    edit_file(out / OTO, repeat)
    must_find(out, (OTO, "", None, "the samples must be the successes that no filter removes"))


def test_cameras_of_a_sample_have_one_place_and_view(out: Path) -> None:
    def shift(file: h5py.File) -> None:
        props = file["test/object_props"]
        packed = moved(0.0, 0.0, 0.01)(props["frame_work2cam_otm"][2])
        props["frame_work2cam_otm"][2] = packed
        props["frame_cam2work_otm"][2] = pack_pose(invert_pose(unpack_pose(packed)))

    edit_file(out / OTO, shift)
    must_find(out, (OTO, "/test", 2, "both cameras must have the same place and view"))


# Scenes of several objects


CLUTTER, GRASPS = "clutter.hdf5", "/grasps"


@pytest.fixture
def cluttered(small_clutter: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(small_clutter, tmp_path / "out"))


@pytest.mark.sim
def test_a_sound_file_passes_also_if_scenes_differ_in_their_objects(cluttered: Path) -> None:
    assert check_dataset(cluttered) == []
    edit_file(cluttered / CLUTTER, lambda file: _without_second_object(file, scene=1))
    assert check_dataset(cluttered) == []


def _without_second_object(file: Any, scene: int) -> None:
    file["scenes/object"][scene, 1] = -1
    file["scenes/resting"][scene, 1] = 255
    for name in ("X_TO", "mass", "friction_hand", "friction_table"):
        file["scenes"][name][scene, 1] = np.nan
    file["grasps/object"][file["grasps/scene"][:] == scene] = 0


@pytest.mark.sim
def test_one_changed_byte_of_scenes_is_found(cluttered: Path) -> None:
    content = bytearray((cluttered / CLUTTER).read_bytes())
    content[len(content) // 2] ^= 1
    (cluttered / CLUTTER).write_bytes(content)
    assert any(v.file == CLUTTER for v in check_dataset(cluttered))


@pytest.mark.sim
@pytest.mark.parametrize(
    ("column", "value", "what"),
    [
        ("lifted", False, "lifted must be true exactly where outcome is success"),
        ("kept", True, "kept must be false where outcome is not success"),
        ("clean", True, "clean must be false where the grasp is not kept"),
        ("free", False, "free must be true exactly where hit is 255"),
        ("hit", HITS_TABLE, "free must be true exactly where hit is 255"),
        ("tested", True, "tested must be false where outcome is not that of a lift"),
        ("outcome", 200, "outcome must be one of 0, "),
        ("object", 2, "object must be that of an object in its scene"),
    ],
)
def test_labels_that_contradict_each_other_are_found(
    cluttered: Path, column: str, value: Any, what: str
) -> None:
    row = change_label(cluttered, column, value)
    must_find(cluttered, (CLUTTER, GRASPS, row, what))


def change_label(cluttered: Path, column: str, value: Any) -> int:
    """Change the column of a grasp that has another value; return its row."""
    row = -1

    def edit(file: Any) -> None:
        nonlocal row
        kept, tried = file["grasps/kept"][:], file["grasps/outcome"][:] != NOT_TRIED
        free = file["grasps/hit"][:] == HITS_NOTHING
        one = {"lifted": kept, "kept": ~tried, "clean": ~tried, "free": free, "hit": free}
        row = int(np.flatnonzero(one.get(column, ~tried))[0])
        file["grasps"][column][row] = value

    edit_file(cluttered / CLUTTER, edit)
    return row


@pytest.mark.sim
def test_objects_and_states_of_others_are_found(cluttered: Path) -> None:
    edit_file(cluttered / CLUTTER, lambda file: file["scenes/object"].__setitem__((0, 0), 99))
    must_find(cluttered, (CLUTTER, "/scenes", 0, "object must be one of the rows of /objects"))
    edit_file(cluttered / CLUTTER, lambda file: file["scenes/object"].__setitem__((0, 0), 0))
    edit_file(cluttered / CLUTTER, lambda file: file.attrs.__setitem__("signature", "other"))
    must_find(cluttered, (CLUTTER, "", None, "attribute signature must be that of manifest.json"))
    shutil.move(cluttered / CLUTTER, cluttered / "away")
    assert check_dataset(cluttered) == []
