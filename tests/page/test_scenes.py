"""Scenes on the page: which are shown, what is drawn into their views, and what is refused."""

from __future__ import annotations

import io
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.pages import Tags, open_pages, scene_in, state_of
from PIL import Image
from starlette.testclient import TestClient

from drakegrasp.dataset.schema import HITS_NOTHING, HITS_TABLE, NO_OBJECT, NOT_TRIED
from drakegrasp.generation.clutter import ClutterRequest, make_clutter
from drakegrasp.generation.scenes import make_scenes
from drakegrasp.outcomes import Outcome
from drakegrasp.page.scenes import CLEAN, FAILS, FREE, HITS, HOLDS, KEPT, NOT_KEPT, UNKNOWN
from drakegrasp.simulation.fixtures import load_surroundings

pytestmark = pytest.mark.sim


@pytest.fixture(scope="module")
def made(sound: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dataset with scenes. Read only."""
    out = Path(shutil.copytree(sound, tmp_path_factory.mktemp("scenes") / "sound"))
    make_scenes(out, overrides=["scenes.views=3"])
    return out


@pytest.fixture
def spoiled(made: Path, tmp_path: Path) -> Path:
    """A copy that a test may change."""
    return Path(shutil.copytree(made, tmp_path / "out"))


@pytest.fixture
def client(made: Path) -> TestClient:
    return open_pages(made)


def cards(client: TestClient, query: str = "") -> list[str]:
    """Return the HTML of the cards of a gallery."""
    return client.get(f"/scenes?{query}").text.split('<li class="card"')[1:]


def label_of(card: str) -> str:
    (label,) = re.findall(r'data-label="([^"]+)"', card)
    return str(label)


def test_gallery_counts_the_grasps_of_each_scene(client: TestClient, made: Path) -> None:
    with h5py.File(made / "scenes.hdf5") as file:
        scene, kept = file["grasps/scene"][:], file["grasps/kept"][:]
        counts = np.bincount(scene), np.bincount(scene[file["grasps/tested"][:]], minlength=3)
    found = cards(client, "sort=row&order=up")
    for i, card in enumerate(found):
        grasps, tested, _, samples = map(int, re.findall(r"<dd>(\d+)</dd>", card))
        assert (grasps, tested) == (counts[0][i], counts[1][i])
        assert samples == (kept & (scene == i)).sum()
    assert len(found) == 3 and max(counts[0]) > max(counts[1]) > 0
    # The first have the most samples, and ties are in the order of the file.
    best = np.argsort(-np.bincount(scene[kept], minlength=3), kind="stable")
    assert [label_of(card) for card in cards(client)] == [label_of(found[i]) for i in best]


def test_filters_choose(client: TestClient, made: Path) -> None:
    (own,) = cards(client, f"object={state_of(client).names[1]}")
    assert label_of(own) == "1"
    with h5py.File(made / "scenes.hdf5") as file:
        tested = int((file["scenes/split"][:] == 2).sum())
    assert len(cards(client, "split=test")) == tested and 0 < tested < 3
    assert not cards(client, "class=none")
    assert client.get("/scenes?split=other").status_code == 400


def test_views_show_what_the_file_says_of_contacts(client: TestClient, made: Path) -> None:
    """Pictures are those of the file; hollow dots are contacts that it says are hidden."""
    label = label_of(cards(client, "sort=row&order=up")[0])
    page = client.get(f"/scene/{label}").text
    with h5py.File(made / "scenes.hdf5") as file:
        views = np.flatnonzero(file["views/scene"][:] == 0)
        grasps = np.flatnonzero(file["grasps/scene"][:] == 0)
        first = grasps[np.argmax(file["grasps/kept"][:][grasps])]
        pairs, seen = file["visible"], file["visible/visible"][:]
        own = pairs["grasp"][:] == first
        hidden = [(~seen[own & (pairs["view"][:] == view)]).sum() for view in views]
        rgb = [file["views/rgb"][view] for view in views]
    figures = page.split("<figure>")[1:]
    assert [figure.count('class="hidden"') for figure in figures] == hidden
    assert all(figure.count('class="palm"') == 1 for figure in figures) and sum(hidden) > 0
    for k, pixels in enumerate(rgb):
        png = client.get(f"/view/{label}-{k}.png").content
        np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(png)))[..., :3], pixels)
    assert client.get(f"/view/{label}-{len(rgb)}.png").status_code == 404


def test_page_shows_the_best_hands_first_and_all_palms(client: TestClient, made: Path) -> None:
    label = label_of(cards(client, "sort=row&order=up")[0])
    page = client.get(f"/scene/{label}").text
    scene = scene_in(page)
    with h5py.File(made / "scenes.hdf5") as file:
        own = file["grasps/scene"][:] == 0
        lifted, tested, trial = (
            file["grasps"][n][:][own] for n in ("lifted", "tested", "trial_id")
        )
        p_TG = file["grasps/X_TG"][:][own].reshape(-1, 3, 4)[:, :, 3]
        points = file["grasps/p_TQ"][:][own]
    colours = [palm["colour"] for palm in scene["palms"]]
    counts = [lifted.sum(), (tested & ~lifted).sum(), (~tested).sum()]
    looks = zip((HOLDS, FAILS, UNKNOWN), counts, strict=True)
    wanted = [look[2] for look, count in looks for _ in range(count)]
    assert colours == wanted and len(set(colours)) > 1
    assert sorted(palm["p"] for palm in scene["palms"]) == sorted(p_TG.astype(float).tolist())
    # The hands are those of the file, and a link leads to the page of the best.
    state = scene["states"][f"trial {trial[np.argmax(lifted)]}"]
    found = [contact["p"] for contact in state["contacts"]]
    assert found == points[np.argmax(lifted)].astype(float).tolist() and len(state["links"]) > 5
    (link,) = [
        a["href"] for tag, a in Tags(page).tags if tag == "a" and "/grasp/" in str(a["href"])
    ]
    assert client.get(link).status_code == 200


def damage(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 3])


def change(name: str, value: object) -> Callable[[Path], None]:
    def spoil(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            if name in file:
                file[name][0] = value
            else:
                file.attrs[name] = value

    return spoil


def test_grasp_without_a_pose_is_not_drawn(spoiled: Path) -> None:
    def palms() -> int:
        client = open_pages(spoiled)
        label = label_of(cards(client, "sort=row&order=up")[0])
        return client.get(f"/scene/{label}").text.count('"z": ')

    before = palms()
    change("grasps/X_TG", np.nan)(spoiled / "scenes.hdf5")
    assert palms() == before - 1


# Scenes of several objects


CLUTTER = "clutter.hdf5"


def label(file: h5py.File, row: int, **labels: object) -> None:
    """Write labels of a grasp."""
    for name, value in labels.items():
        file["grasps"][name][row] = value


@pytest.fixture(scope="module")
def cluttered(sound: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
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
def clutter_client(cluttered: Path) -> TestClient:
    return open_pages(cluttered)


def scene_of(cluttered: Path) -> int:
    """Return the scene that has labels of all kinds."""
    with h5py.File(cluttered / CLUTTER) as file:
        return int(file["grasps/scene"][np.argmax(file["grasps/clean"][:])])


def test_gallery_counts_the_labels_of_each_scene(
    clutter_client: TestClient, cluttered: Path
) -> None:
    cards = clutter_client.get("/clutter?sort=row&order=up").text.split('<li class="card"')[1:]
    with h5py.File(cluttered / CLUTTER) as file:
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


def test_filters_find_any_object_of_a_scene(clutter_client: TestClient, cluttered: Path) -> None:
    with h5py.File(cluttered / CLUTTER) as file:
        names, objects = file["objects/name"].asstr()[:], file["scenes/object"][:]
        inside = (file["scenes/surroundings"].asstr()[:] == "bin").sum()
    for k, name in enumerate(names):
        due = (objects == k).any(axis=1).sum()
        assert clutter_client.get(f"/clutter?object={name}").text.count('<li class="card"') == due
    assert clutter_client.get("/clutter?surroundings=bin").text.count('<li class="card"') == inside
    assert clutter_client.get("/clutter?surroundings=own").text.count('<li class="card"') == 0


def test_pictures_show_colours_beside_a_mask_of_each_object(
    clutter_client: TestClient, cluttered: Path
) -> None:
    i = scene_of(cluttered)
    with h5py.File(cluttered / CLUTTER) as file:
        for k, view in enumerate(np.flatnonzero(file["views/scene"][:] == i)):
            png = clutter_client.get(f"/instances/{i}-{k}.png").content
            picture = np.asarray(Image.open(io.BytesIO(png)))
            rgb, mask = file["views/rgb"][view], file["views/mask"][view]
            np.testing.assert_array_equal(picture[:, : mask.shape[1], :3], rgb)
            shown = picture[:, mask.shape[1] :]
            looks = [np.unique(shown[mask == code], axis=0) for code in np.unique(mask)]
            assert all(len(look) == 1 for look in looks)
            assert len(np.unique(np.concatenate(looks), axis=0)) == len(looks) > 1


def test_page_tells_what_happened_to_each_grasp(
    clutter_client: TestClient, cluttered: Path
) -> None:
    """The best come first; objects are counted, and neighbours and walls drawn."""
    i = scene_of(cluttered)
    page = clutter_client.get(f"/clutter/{i}").text
    objects, grasps = re.findall(r'<table class="told">(.*?)</table>', page, re.DOTALL)
    with h5py.File(cluttered / CLUTTER) as file:
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

    scene = scene_in(page)
    poses = [scene["object"], *(each["pose"] for each in scene["others"])]
    np.testing.assert_allclose([pose[12:15] for pose in poses], p_TO, atol=1e-6)
    assert len(scene["walls"]) == walls and len(scene["colours"]) == len(known)
    assert all(clutter_client.get(each["mesh"]).status_code == 200 for each in scene["others"])
    due = [look[2] for look in (CLEAN, KEPT, NOT_KEPT, FREE)] + [HITS[2]] * (own.sum() - 4)
    assert [palm["colour"] for palm in scene["palms"]] == due
    # Equal objects have grasps of the same trials, which are told apart.
    assert len(scene["states"]) == min(8, own.sum())
    assert len(set(trial[own])) < own.sum()


# What cannot be shown


def of_one_object(path: Path) -> None:
    make_scenes(path.parent, overrides=["scenes.views=1"])
    (path.parent / "scenes.hdf5").replace(path)


@pytest.mark.parametrize(
    ("name", "spoil", "line"),
    [
        ("scenes", damage, "must be the scenes of a dataset, got none"),
        ("scenes", change("shards", "others"), "must be of the trials in its folder, got other sc"),
        ("scenes", change("grasps/outcome", 250), "/grasps/outcome must be one of 0, 1"),
        ("scenes", change("grasps/trial_id", 36), "/grasps/trial_id must be 0 to 35, got 36"),
        ("scenes", change("objects/name", "3_other"), "must be of objects of"),
        ("scenes", change("scenes/X_TO", np.nan), "/scenes/X_TO must be finite"),
        ("clutter", of_one_object, "must be scenes of several objects, got none"),
        ("clutter", change("signature", "x"), "got other scenes; run `drakegrasp clutter` again"),
        ("clutter", change("grasps/object", 7), "/grasps/object must be 0 to 2, got 7 in row 0"),
        ("clutter", change("scenes/object", NO_OBJECT), "/scenes/object must be 0 to 2, got -1"),
    ],
)
def test_file_that_cannot_be_shown_is_a_line(
    made: Path,
    cluttered: Path,
    tmp_path: Path,
    name: str,
    spoil: Callable[[Path], None],
    line: str,
) -> None:
    out = Path(shutil.copytree(made if name == "scenes" else cluttered, tmp_path / "out"))
    spoil(out / f"{name}.hdf5")
    client = open_pages(out)
    answer = client.get(f"/{name}")
    assert answer.status_code == 400 and line in Tags(answer.text).text
    assert f'href="/{name}"' in client.get("/").text


@pytest.mark.parametrize("name", ["scenes", "clutter"])
def test_without_the_file_there_is_no_link_and_the_page_says_what_makes_it(
    sound: Path, name: str
) -> None:
    client = open_pages(sound)
    answer = client.get(f"/{name}")
    assert answer.status_code == 404 and f"drakegrasp {name} makes them" in answer.text
    assert f'href="/{name}"' not in client.get("/").text
