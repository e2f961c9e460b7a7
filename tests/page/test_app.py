"""The pages, what they contain, and what is refused."""

from __future__ import annotations

import json
import os
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.datasets import (
    OTM,
    TRIALS,
    change,
    set_at,
)
from helpers.pages import (
    ATTACK,
    Tags,
    coded,
    get,
    inspection_of,
    numbered,
    open_pages,
    state_of,
    surface_of,
)
from starlette.testclient import TestClient

from drakegrasp.dataset.assemble import assemble
from drakegrasp.dataset.rejections import AttemptKey, read_decisions
from drakegrasp.errors import DataError
from drakegrasp.filters import Removal
from drakegrasp.page.app import HEADERS, TOKEN_HEADER, Inspection
from drakegrasp.page.gallery import PAGE

PAGES = ("/", "/?outcome=any&page=2", "/grasp/0-0-0", "/grasp/0-0-1")


def token(client: TestClient) -> str:
    return inspection_of(client).token


def decide(client: TestClient, label: str, decision: str) -> Any:
    """Return the answer to a decision of a page on an attempt."""
    content = {"label": coded(state_of(client), label), "decision": decision}
    return client.post("/decide", json=content, headers={TOKEN_HEADER: token(client)})


def test_gallery_shows_what_is_selected_page_by_page(client: TestClient) -> None:
    everything = Tags(client.get("/").text)
    labels = [a["data-label"] for tag, a in everything.tags if tag == "li"]
    assert len(labels) == 9
    assert "9 of 36 attempts" in " ".join(everything.text.split())
    first = Tags(client.get("/?outcome=any&sort=row&order=up").text)
    second = Tags(client.get("/?outcome=any&sort=row&order=up&page=2").text)
    both = [a["data-label"] for p in (first, second) for tag, a in p.tags if tag == "li"]
    assert len(both) == len(set(both)) == 36
    assert len([tag for tag, _ in first.tags if tag == "li"]) == PAGE
    # A page beyond the last is the last.
    assert "page 2 of 2" in client.get("/?outcome=any&page=99").text
    assert "No attempt fits" in client.get("/?object=nothing").text


def test_page_says_which_images_cannot_be_read(out: Path) -> None:
    os.truncate(out / OTM, 3000)
    page = get(open_pages(out), "/grasp/0-0-0").text
    assert "The images of camera otm cannot be read from grasping_otm.hdf5." in page
    assert page.count("<image") == 1


def test_a_success_that_is_no_sample_has_no_images(out: Path) -> None:
    assert assemble(out, rejected=[0]).removed[Removal.REJECTED] == 1
    client = open_pages(out)
    assert "no sample: no images" in client.get("/").text
    assert "Only samples have images." in get(client, "/grasp/0-0-0").text
    assert get(client, "/strip/0-0-0-oto.png").status_code == 404


def test_next_and_previous_go_through_the_selection(client: TestClient) -> None:
    query = "object=2_box_b&sort=row&order=up"
    page = get(client, f"/grasp/1-1-0?{query}").text
    assert "2 of 3" in page
    links = {a.get("id"): a.get("href") for tag, a in Tags(page).tags if tag == "a"}
    for name, label in (("previous", "1-0-0"), ("next", "1-3-2")):
        assert numbered(state_of(client), str(links[name])) == f"/grasp/{label}?{query}"
    assert links["gallery"] == f"/?{query}"
    assert "not in the selection" in get(client, f"/grasp/0-0-0?{query}").text


def test_meshes_are_there(client: TestClient) -> None:
    for address in ("link-0", "link-8"):
        assert len(surface_of(client.get(f"/mesh/{address}.json").text).faces)
    box = surface_of(client.get("/mesh/object-0.json").text)
    assert box.extents.tolist() == pytest.approx([0.06, 0.05, 0.10])
    for address in ("object-9", "link-99", "link-x", "other-0"):
        assert client.get(f"/mesh/{address}.json").status_code == 404


# Decisions


def test_decisions_are_on_disk_at_once_and_undone(client: TestClient, out: Path) -> None:
    path = out / "reject.json"
    assert not path.exists()
    for label, decision in (("0-0-0", "rejected"), ("1-1-0", "rejected"), ("1-1-0", "")):
        assert decide(client, label, decision).status_code == 200
    assert f'name="token" content="{token(client)}"' in client.get("/").text
    a, b = AttemptKey("1_box_a", 0, 0), AttemptKey("2_box_b", 1, 0)
    assert read_decisions(path).rejected == {a}
    assert "card rejected" in client.get("/").text
    assert 'data-decision="rejected"' in get(client, "/grasp/0-0-0").text

    headers = {TOKEN_HEADER: token(client)}
    undone = client.post("/undo", headers=headers).json()
    assert numbered(state_of(client), str(undone["label"])) == "1-1-0"
    assert undone["decision"] == "rejected"
    assert client.post("/undo", headers=headers).json() == {"name": None}
    assert read_decisions(path).rejected == {a, b}


def test_assembly_drops_exactly_the_rejected(client: TestClient, out: Path) -> None:
    for label in ("0-0-0", "2-3-2"):
        decide(client, label, "rejected")
    assembly = assemble(out, rejected=sorted(read_decisions(out / "reject.json").rejected))
    assert assembly.removed == {Removal.KEPT: 7, Removal.REJECTED: 2}
    assert "run inspect again" in client.get("/").text
    again = open_pages(out)
    page = " ".join(Tags(again.get("/?removal=rejected").text).text.split())
    assert "2 of 36 attempts" in page
    # After assembling they are samples no more.
    assert decide(again, "2-0-0", "rejected").json()["counts"] == {"rejected": 3, "samples": 1}


def test_an_edited_file_is_not_overwritten(client: TestClient, out: Path) -> None:
    decide(client, "0-0-0", "rejected")
    (out / "reject.json").write_text('{"version": 1, "rejected": [], "kept": []}')
    decide(client, "1-1-0", "rejected")
    assert read_decisions(out / "reject.json").rejected == {AttemptKey("2_box_b", 1, 0)}
    (out / "reject.json").write_text("mine")
    assert decide(client, "0-0-0", "rejected").status_code == 400
    assert (out / "reject.json").read_text() == "mine"


@pytest.mark.parametrize(
    ("content", "status"),
    [
        ({"label": "0-0-1", "decision": "rejected"}, 404),
        ({"label": "9-9-9", "decision": "rejected"}, 404),
        ({"label": None}, 404),
        ({"label": "0-0-0", "decision": "kept"}, 400),
        ({"label": "0-0-0"}, 400),
        ([1], 400),
        ({"label": "0-0-0", "decision": "rejected", "more": "x" * 5000}, 413),
    ],
)
def test_what_cannot_be_decided_is_refused(
    client: TestClient, out: Path, content: object, status: int
) -> None:
    text, headers = coded(state_of(client), json.dumps(content)), {TOKEN_HEADER: token(client)}
    assert client.post("/decide", content=text, headers=headers).status_code == status
    assert not (out / "reject.json").exists()


# What keeps others out


def test_changes_need_the_token_of_the_page(client: TestClient, out: Path) -> None:
    content = {"label": coded(state_of(client), "0-0-0"), "decision": "rejected"}
    for wrong in (None, "", "x", "ü"):
        headers = {} if wrong is None else {TOKEN_HEADER: wrong.encode()}
        assert client.post("/decide", json=content, headers=headers).status_code == 403
        assert client.post("/undo", headers=headers).status_code == 403
    for path in ("/decide", "/undo"):
        assert client.get(path).status_code == 405
    assert not (out / "reject.json").exists()


def test_a_foreign_host_gets_nothing(client: TestClient) -> None:
    """A name of another site that resolves to this machine (DNS rebinding)."""
    for host in ("evil.example", "evil.example:8321", "127.0.0.1.evil.example", "", "10.0.0.1"):
        answer = client.get("/", headers={"host": host})
        assert answer.status_code == 400, host
        assert "token" not in answer.text
    for host in ("localhost:8321", "127.0.0.1", "127.0.0.1:99"):
        assert client.get("/", headers={"host": host}).status_code == 200


@pytest.mark.parametrize("path", [*PAGES, "/static/inspect.js", "/strip/0-0-0-oto.png", "/nothing"])
def test_every_answer_has_the_strictest_policy(client: TestClient, path: str) -> None:
    answer = get(client, path)
    for name, value in HEADERS.items():
        assert answer.headers[name] == value
    policy = answer.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy


@pytest.mark.parametrize("path", PAGES)
def test_pages_ask_nothing_of_other_hosts_and_run_no_script_of_their_own(
    client: TestClient, path: str
) -> None:
    for tag, attributes in Tags(get(client, path).text).tags:
        for name in ("src", "href", "action"):
            address = attributes.get(name) or "/"
            assert address.startswith(("/", "?")) and not address.startswith("//"), (tag, address)
        assert not [name for name in attributes if name.startswith("on") or name == "style"], tag
        if tag == "script":
            assert attributes.get("src") or attributes.get("type") == "application/json"
        assert tag != "style"


@pytest.mark.parametrize("path", ["/", "/grasp/0-0-0", f"/?object={ATTACK}"])
def test_names_stay_text(hostile: Path, path: str) -> None:
    client = open_pages(hostile)
    page = get(client, path).text
    assert "<script>alert" not in page
    assert ATTACK in Tags(page).text


@pytest.mark.parametrize(
    ("path", "status"),
    [
        ("/?sort=<b>x</b>", 400),
        ("/grasp/9-9-9", 404),
        ("/grasp/<b>x</b>", 404),
        ("/static/../app.py", 404),
        ("/static/%2e%2e/app.py", 404),
    ],
)
def test_errors_are_pages_without_foreign_tags(client: TestClient, path: str, status: int) -> None:
    answer = get(client, path)
    assert answer.status_code == status
    assert "<b>x</b>" not in answer.text


def test_a_page_names_the_file_of_meshes_that_is_not_there(client: TestClient, out: Path) -> None:
    label = coded(state_of(client), "0-0-0")
    page = client.get(f"/grasp/{label}").text
    assert "There is no file" not in page
    path = sorted((out / "objects").glob("*.npz"))[0]
    path.unlink()
    page = client.get(f"/grasp/{label}").text
    assert f"There is no file objects/{path.name}" in page


@pytest.mark.parametrize("path", ["/", "/grasp/0-0-0"])
def test_pages_say_how_to_take_rejected_grasps_out(sound: Path, tmp_path: Path, path: str) -> None:
    """The command can be pasted into a shell, whatever the directory is called."""
    out = Path(shutil.copytree(sound, tmp_path / "my data;x"))
    client = open_pages(out)
    hidden = [a for _, a in Tags(get(client, path).text).tags if a.get("id") == "nextstep"]
    assert "hidden" in hidden[0]
    decide(client, "0-0-0", "rejected")
    page = get(client, path).text
    shown = [a for _, a in Tags(page).tags if a.get("id") == "nextstep"]
    assert "hidden" not in shown[0]
    command = f"drakegrasp assemble '{out}' --reject '{out / 'reject.json'}'"
    text = " ".join(Tags(page).text.split())
    assert f"1 rejected, 1 of them samples now. To take them out of the files: {command}" in text
    assert f"drakegrasp replay '{out}' --trial 0" in Tags(get(client, "/grasp/0-0-0").text).text


def test_a_contact_without_a_normal_is_a_reason(out: Path) -> None:
    change(out, TRIALS, "trials/normal_angle", 0, set_at(0, to=np.nan))
    client = open_pages(out)
    card = client.get("/?sort=normal_angle").text.partition("</li>")[0]
    assert 'data-label="0"' in card and "normal angle: none" in card
    parts = get(client, "/grasp/0-0-0").text
    assert re.search(r"<th>normal angle</th><td>none</td>", parts)


def test_broken_rejections_are_refused_at_the_start(out: Path) -> None:
    (out / "reject.json").write_text("3")
    with pytest.raises(DataError, match="must be a list of rejections"):
        Inspection(out)
