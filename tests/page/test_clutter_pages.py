"""Scenes of several objects on the page: which are shown, what is told of them, what is refused."""

from __future__ import annotations

import io
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.pages import Tags, open_pages
from PIL import Image
from starlette.testclient import TestClient

from drakegrasp.dataset.schema import HITS_NOTHING, HITS_TABLE, NO_OBJECT, NOT_TRIED
from drakegrasp.generation.clutter import ClutterRequest, make_clutter
from drakegrasp.generation.scenes import make_scenes
from drakegrasp.objects.surroundings import load_surroundings
from drakegrasp.outcomes import Outcome
from drakegrasp.page.scenes import CLEAN, FREE, HITS, KEPT, NOT_KEPT

pytestmark = pytest.mark.sim
CLUTTER = "clutter.hdf5"


def label(file: h5py.File, row: int, **labels: object) -> None:
    """Write labels of a grasp."""
    for name, value in labels.items():
        file["grasps"][name][row] = value


@pytest.fixture(scope="module")
def made(sound: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dataset with scenes of two and three objects, and labels of all kinds. Read only."""
    out = Path(shutil.copytree(sound, tmp_path_factory.mktemp("clutter") / "boxes"))
    around = [load_surroundings(name) for name in ("bin", "table")]
    make_clutter(out, ClutterRequest(scenes=4, objects=(2, 3), surroundings=around, tries=0))
    with h5py.File(out / CLUTTER, "r+") as file:
        scene, objects = file["grasps/scene"][:], file["scenes/object"][:]
        several = np.flatnonzero((objects != NO_OBJECT).sum(axis=1) == 3)[0]
        # Scenes are of one split, here of one object: let the last one be another.
        file["scenes/object"][several, 2] = (objects[several, 2] + 1) % 3
        rows = np.flatnonzero(scene == several)[:5]
        for row in np.flatnonzero(scene == several):
            label(file, row, hit=HITS_TABLE, free=False)
        tried = {"free": True, "hit": HITS_NOTHING, "tested": True}
        moved = {"neighbour": 1, "neighbour_shift": 0.0123, "neighbour_turn": 0.0}
        good = {"outcome": Outcome.SUCCESS, "lifted": True, "kept": True}
        label(file, rows[0], **tried, outcome=Outcome.DROPPED, **moved)
        label(file, rows[1], hit=1, free=False)
        label(file, rows[2], hit=HITS_NOTHING, free=True)
        label(file, rows[3], **tried, **good, **moved)
        label(file, rows[4], **tried, **good, clean=True, **moved)
        label(file, rows[4], neighbour_shift=0.001)
    return out


@pytest.fixture
def client(made: Path) -> TestClient:
    return open_pages(made)


def scene_of(made: Path) -> int:
    """Return the scene that has labels of all kinds."""
    with h5py.File(made / CLUTTER) as file:
        return int(file["grasps/scene"][np.argmax(file["grasps/clean"][:])])


def test_gallery_counts_the_labels_of_each_scene(client: TestClient, made: Path) -> None:
    cards = client.get("/clutter?sort=row&order=up").text.split('<li class="card"')[1:]
    with h5py.File(made / CLUTTER) as file:
        grasps = {name: data[:] for name, data in file["grasps"].items()}
        names, objects = file["objects/name"].asstr()[:], file["scenes/object"][:]
        around = file["scenes/surroundings"].asstr()[:]
    assert len(cards) == len(objects) == 4
    for i, card in enumerate(cards):
        own = grasps["scene"] == i
        tried = (own & (grasps["outcome"] != NOT_TRIED)).sum()
        free, kept, clean = ((own & grasps[name]).sum() for name in ("free", "kept", "clean"))
        found = re.findall(r"<dd>(.*?)</dd>", card)
        assert found == [str(own.sum()), str(free), f"{kept} of {tried}", str(clean)]
        there = ", ".join(names[k] for k in objects[i] if k != NO_OBJECT)
        assert there in card and around[i] in card


def test_filters_find_any_object_of_a_scene(client: TestClient, made: Path) -> None:
    with h5py.File(made / CLUTTER) as file:
        names, objects = file["objects/name"].asstr()[:], file["scenes/object"][:]
        inside = (file["scenes/surroundings"].asstr()[:] == "bin").sum()
    for k, name in enumerate(names):
        due = (objects == k).any(axis=1).sum()
        assert client.get(f"/clutter?object={name}").text.count('<li class="card"') == due
    assert client.get("/clutter?surroundings=bin").text.count('<li class="card"') == inside
    assert client.get("/clutter?surroundings=own").text.count('<li class="card"') == 0


def test_pictures_show_colours_beside_a_mask_of_each_object(client: TestClient, made: Path) -> None:
    i = scene_of(made)
    with h5py.File(made / CLUTTER) as file:
        for k, view in enumerate(np.flatnonzero(file["views/scene"][:] == i)):
            png = client.get(f"/instances/{i}-{k}.png").content
            picture = np.asarray(Image.open(io.BytesIO(png)))
            rgb, mask = file["views/rgb"][view], file["views/mask"][view]
            np.testing.assert_array_equal(picture[:, : mask.shape[1], :3], rgb)
            shown = picture[:, mask.shape[1] :]
            looks = [np.unique(shown[mask == code], axis=0) for code in np.unique(mask)]
            assert all(len(look) == 1 for look in looks)
            assert len(np.unique(np.concatenate(looks), axis=0)) == len(looks) > 1


def test_page_tells_what_happened_to_each_grasp(client: TestClient, made: Path) -> None:
    """The best come first; objects are counted, and neighbours and walls drawn."""
    i = scene_of(made)
    page = client.get(f"/clutter/{i}").text
    objects, grasps = re.findall(r'<table class="told">(.*?)</table>', page, re.DOTALL)
    with h5py.File(made / CLUTTER) as file:
        own = file["grasps/scene"][:] == i
        index, trial = file["grasps/object"][:], file["grasps/trial_id"][:]
        free = file["grasps/free"][:]
        names = file["objects/name"].asstr()[:]
        known = [names[k] for k in file["scenes/object"][i] if k != NO_OBJECT]
        walls = 4 * (file["scenes/surroundings"].asstr()[i] == "bin")
        p_TO = file["scenes/X_TO"][i].reshape(-1, 3, 4)[: len(known), :, 3]
    for k, line in enumerate(objects.split("<tr>")[2:]):
        cells = [int(cell) for cell in re.findall(r"<td>(\d+)</td>", line)]
        assert known[k] in line
        assert cells[:2] == [(own & (index == k)).sum(), (own & free & (index == k)).sum()]
    told = [" ".join(Tags(line).text.split()) for line in grasps.split("<tr>")[2:]]
    other = known[1] + f" ({known[:2].count(known[1])})" * (known.count(known[1]) > 1)
    for line, parts in zip(
        told,
        (
            ("success kept clean", f"{other} by 1.0 mm"),
            ("success kept every", f"{other} by 12.3 mm"),
            ("dropped", f"{other} by 12.3 mm"),
            ("free, not tried",),
        ),
        strict=False,
    ):
        assert all(part in line for part in parts), line
    assert sum(f"the hand meets {other}" in line for line in told) == 1
    assert sum("the hand meets table or wall" in line for line in told) == own.sum() - 5

    (text,) = re.findall(r'<script type="application/json" id="scene">(.*?)</script>', page)
    scene = json.loads(text)["scene"]
    poses = [scene["object"], *(each["pose"] for each in scene["others"])]
    np.testing.assert_allclose([pose[12:15] for pose in poses], p_TO, atol=1e-6)
    assert len(scene["boxes"]) == walls and len(scene["colours"]) == len(known)
    assert all(client.get(each["mesh"]).status_code == 200 for each in scene["others"])
    due = [look[2] for look in (CLEAN, KEPT, NOT_KEPT, FREE)] + [HITS[2]] * (own.sum() - 4)
    assert [palm["colour"] for palm in scene["palms"]] == due
    # Equal objects have grasps of the same trials, which are told apart.
    assert len(scene["states"]) == min(8, own.sum())
    assert len(set(trial[own])) < own.sum()


def forget(name: str) -> Callable[[Path], None]:
    def spoil(out: Path) -> None:
        with h5py.File(out / CLUTTER, "r+") as file:
            del file.attrs[name]

    return spoil


def change(name: str, value: object) -> Callable[[Path], None]:
    def spoil(out: Path) -> None:
        with h5py.File(out / CLUTTER, "r+") as file:
            file[name][0] = value

    return spoil


def of_one_object(out: Path) -> None:
    make_scenes(out, overrides=["scenes.views=1"])
    (out / "scenes.hdf5").replace(out / CLUTTER)


@pytest.mark.parametrize(
    ("spoil", "line"),
    [
        (of_one_object, "must be scenes of several objects, got none"),
        (forget("signature"), "got other scenes; run `drakegrasp clutter` again"),
        (change("grasps/object", 7), "/grasps/object must be 0 to 2, got 7 in row 0"),
        (change("grasps/outcome", 250), "/grasps/outcome must be one of 0, 1"),
        (change("scenes/X_TO", np.nan), "/scenes/X_TO must be finite"),
        (change("scenes/object", NO_OBJECT), "/scenes/object must be 0 to 2, got -1"),
    ],
)
def test_file_that_cannot_be_shown_is_a_line(
    made: Path, tmp_path: Path, spoil: Callable[[Path], None], line: str
) -> None:
    out = Path(shutil.copytree(made, tmp_path / "out"))
    spoil(out)
    answer = open_pages(out).get("/clutter")
    assert answer.status_code == 400 and line in Tags(answer.text).text


def test_without_the_file_the_page_says_what_makes_it(sound: Path) -> None:
    answer = open_pages(sound).get("/clutter")
    assert answer.status_code == 404 and "drakegrasp clutter makes them" in answer.text
