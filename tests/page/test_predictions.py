"""Predictions beside their rows: which are shown, in which order, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.datasets import TRIALS
from helpers.pages import Tags, open_pages, scene_in
from helpers.predictions import write_predictions
from starlette.testclient import TestClient

from drakegrasp.errors import DataError
from drakegrasp.page.app import Inspection


@pytest.fixture
def results(out: Path, tmp_path: Path) -> Path:
    return write_predictions(out, tmp_path / "run.h5")


@pytest.fixture
def client(out: Path, results: Path) -> TestClient:
    return open_pages(out, results)


def shown(client: TestClient, query: str = "") -> list[str]:
    """Return the numbers of the predictions of a gallery, in its order."""
    tags = Tags(client.get(f"/predictions?{query}").text).tags
    return [str(attributes["data-label"]) for tag, attributes in tags if tag == "li"
            and "data-label" in attributes]  # fmt: skip


def test_the_worst_come_first(client: TestClient) -> None:
    """Never closed, failed, then those that hold, by how far the contacts are off."""
    assert shown(client) == ["2", "3", "1", "0"]
    assert shown(client, "order=up") == ["0", "1", "3", "2"]
    assert shown(client, "sort=contact_error") == ["1", "3", "0", "2"]


@pytest.mark.parametrize(
    ("query", "numbers"),
    [
        ("verdict=fails", ["2", "3"]),
        ("verdict=precision", ["0"]),
        ("outcome=dropped", ["3"]),
        ("object=nothing", []),
        ("class=box&verdict=lifted", ["1", "0"]),
    ],
)
def test_filters_choose(client: TestClient, query: str, numbers: list[str]) -> None:
    assert shown(client, query) == numbers


def test_a_palm_that_never_closed_is_shown_open(out: Path, results: Path) -> None:
    """A palm pose alone has no contacts to show; the open hand shows where it was tried."""
    with h5py.File(results, "a") as file:
        palms = file["grasps/X_OG"]
        palms[2] = palms[3]
        for name in ("p_OQ", "nhat_Q_O"):
            file["grasps"][name][2] = np.nan
        file["grasps/confidence"][:] = [0.3, 0.9, 0.5, 0.1]
    client = open_pages(out, results)
    assert shown(client, "sort=confidence") == ["1", "2", "0", "3"]
    states = scene_in(client.get("/prediction/2").text)["states"]
    closed = scene_in(client.get("/prediction/3").text)["states"]["closed"]
    assert set(states) == {"start", "dataset's grasp"}
    # The first link is the palm's.
    assert states["start"]["links"][0] == closed["links"][0]
    assert states["start"]["links"] != closed["links"]


def test_without_results_there_are_no_predictions(out: Path) -> None:
    client = open_pages(out)
    assert client.get("/predictions").status_code == 404
    assert "/predictions" not in client.get("/").text


def _flat(file: h5py.File) -> None:
    values = file["grasps/closed_p_OQ"][:, 0]
    del file["grasps/closed_p_OQ"]
    file["grasps/closed_p_OQ"] = values


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda f: f.pop("rows"), "must say which rows of a dataset it is for, got none"),
        (lambda f: f["rows"].attrs.update(shards="other"), "as it is now, got another"),
        (lambda f: f["rows/trial_id"].write_direct(np.full(4, 36)), "must be for rows of"),
        (lambda f: f["grasps/object"].__setitem__(1, "3_brick"), "must be for rows of"),
        (_flat, "/grasps/closed_p_OQ: shape must be"),
        (lambda f: f.pop("grasps/outcome"), "must be a result file of drakegrasp verify, got anot"),
    ],
)
def test_results_of_something_else_are_refused(
    out: Path, results: Path, spoil: Callable[[h5py.File], object], message: str
) -> None:
    with h5py.File(results, "r+") as file:
        spoil(file)
    with pytest.raises(DataError, match=message):
        Inspection(out, results)


def test_a_field_that_a_file_lacks_is_a_dash(out: Path, results: Path) -> None:
    with h5py.File(results, "r+") as file:
        for name in set(file["grasps"]) - {"object", "outcome", "p_OQ", "nhat_Q_O"}:
            del file[f"grasps/{name}"]
    client = open_pages(out, results)
    assert shown(client, "verdict=lifted") == ["0", "1"]
    assert "4.0 mm" in client.get("/prediction/0").text  # from the true contact
    assert client.get("/prediction/0").text.count("<td>–</td>") > 10


@pytest.mark.parametrize("name", ["results", "out/trials.hdf5"])
def test_pages_of_replaced_files_are_refused(
    client: TestClient, out: Path, results: Path, name: str
) -> None:
    with h5py.File(results if name == "results" else out / TRIALS, "r+") as file:
        file.attrs["other"] = 1
    for path in ("/predictions", "/", "/strip/0-oto.png"):
        answer = client.get(path)
        assert answer.status_code == 400
        assert "must stay while it is shown, got another; run inspect again" in answer.text
