"""Scenes on the page: which are shown, what is drawn into their views, and what is refused."""

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
from helpers.pages import Tags, open_pages, state_of
from PIL import Image
from starlette.testclient import TestClient

from drakegrasp.generation.scenes import make_scenes
from drakegrasp.page.scenes import FAILS, HOLDS, UNKNOWN

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
    (text,) = re.findall(r'<script type="application/json" id="scene">(.*?)</script>', page)
    scene = json.loads(text)["scene"]
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


@pytest.mark.parametrize(
    ("spoil", "line"),
    [
        (damage, "must be the scenes of a dataset, got none"),
        (change("shards", "others"), "must be of the trials in its folder, got other scenes"),
        (change("grasps/outcome", 250), "/grasps/outcome must be one of 0, 1"),
        (change("grasps/trial_id", 36), "/grasps/trial_id must be 0 to 35, got 36"),
        (change("objects/name", "3_other"), "must be of objects of"),
        (change("scenes/X_TO", np.nan), "/scenes/X_TO must be finite"),
    ],
)
def test_file_that_cannot_be_shown_is_a_line(
    spoiled: Path, spoil: Callable[[Path], None], line: str
) -> None:
    spoil(spoiled / "scenes.hdf5")
    client = open_pages(spoiled)
    answer = client.get("/scenes")
    assert answer.status_code == 400 and line in Tags(answer.text).text
    assert 'href="/scenes"' in client.get("/").text


def test_without_scenes_there_is_no_link(sound: Path, tmp_path: Path) -> None:
    client = open_pages(sound)
    assert "scenes" not in client.get("/").text
    assert client.get("/scenes").status_code == 404
