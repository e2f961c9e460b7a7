"""The pages, what they contain, how a query chooses attempts, and what is refused."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import urllib.request
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

import h5py
import numpy as np
import pytest
from helpers.commands import run
from helpers.datasets import OTM, TRIALS, change, make_dataset, set_at
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
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.rejections import AttemptKey, Decisions, read_decisions
from drakegrasp.dataset.trials import NONE
from drakegrasp.errors import DataError
from drakegrasp.filters import Removal
from drakegrasp.frames import invert_pose, transform_points, unpack_pose
from drakegrasp.page.app import ASSETS, HEADERS, LOOPBACK, TOKEN_HEADER, Inspection, listen
from drakegrasp.page.attempts import AttemptGallery
from drakegrasp.page.gallery import PAGE
from drakegrasp.page.renders import THUMBNAIL, contact_dots, read_render, read_rows
from drakegrasp.page.snapshot import Snapshot, read_snapshot
from drakegrasp.vision.camera import intrinsics, project

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


def test_a_grasp_that_is_not_selected_says_so(client: TestClient) -> None:
    assert "not in the selection" in get(client, "/grasp/0-0-0?object=2_box_b").text


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


def test_arrows_lead_through_all_rows_and_back(client: TestClient) -> None:
    def follow(arrow: str, address: str) -> list[str]:
        places = []
        while address:
            page = Tags(client.get(address).text)
            places += re.findall(r"\d+ of 9", page.text)
            links = [a["href"] for _, a in page.tags if a.get("id") == arrow]
            address = (links or [""])[0] or ""
        return places

    order = [f"{k} of 9" for k in range(1, 10)]
    rows = [a["data-label"] for tag, a in Tags(client.get("/").text).tags if tag == "li"]
    assert follow("next", f"/grasp/{rows[0]}") == order
    assert follow("previous", f"/grasp/{rows[-1]}") == order[::-1]


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
        ("x" * 4094, 400),  # 4096 bytes with its quotes
        ("x" * 4095, 413),
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
def test_names_stay_text(out: Path, path: str) -> None:
    """An object and a class have names that are scripts."""
    with h5py.File(out / TRIALS, "r+") as file:
        file["objects/name"][0] = ATTACK
        file["objects/class_name"][0] = f"\"'&{ATTACK}"
    page = get(open_pages(out), path).text
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


# The attempts in memory: how a query chooses and sorts them


NOTHING = Decisions()


def test_rows_and_images_are_those_of_the_attempt(sound: Path) -> None:
    with h5py.File(sound / TRIALS) as trials, h5py.File(sound / OTM) as data:
        X_OG = trials["trials/X_OG"][15]
        split = next(s for s in data if 15 in data[s]["trial_id"][:])
        place = data[split]["trial_id"][:].tolist().index(15)
        image, mask = data[split]["images"][place], data[split]["masks"][place]
    snapshot = read_snapshot(sound)
    i = snapshot.find(AttemptKey("2_box_b", 1, 0))
    assert i == 15 and str(snapshot.key(i)) == "2_box_b, palm pose 1, stand-off 0"
    assert snapshot.find(AttemptKey("2_box_b", 99, 0)) is None
    (row,) = read_rows(snapshot, [i], ("X_OG",))
    np.testing.assert_array_equal(row["X_OG"], X_OG)
    found = read_render(snapshot, i, "otm")
    assert found is not None
    np.testing.assert_array_equal(found.image, image)
    np.testing.assert_array_equal(found.mask, mask)
    assert read_render(snapshot, i + 1, "otm") is None


def test_trials_that_are_a_link_to_nowhere_are_damaged_and_not_still_to_come(out: Path) -> None:
    (out / "trials.hdf5").unlink()
    (out / "trials.hdf5").symlink_to("trials.hdf5")
    with pytest.raises(DataError, match=r"trials\.hdf5: must be the trials of a dataset"):
        read_snapshot(out)


# Attempts with a mass and a camera of their own.


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The boxes, each attempt with a mass and cameras of its own. Read only."""
    folder = tmp_path_factory.mktemp("drawn")
    draws = ("mass=[0.5, 1.5]", "camera_shift=0.02", "camera_turn_deg=10")
    return make_dataset(folder / "out", folder, overrides=[f"randomize.{draw}" for draw in draws])


@pytest.mark.parametrize("camera", ["oto", "otm"])
def test_dots_are_where_the_moved_camera_sees_the_contacts(drawn: Path, camera: str) -> None:
    snapshot = read_snapshot(drawn)
    data = GraspDataset(drawn / f"grasping_{camera}.hdf5", split="test")
    trial = int(data.column("trial_id")[0])
    (row,) = read_rows(snapshot, [trial], THUMBNAIL)
    X_TC = unpack_pose(data.column(f"object_props/frame_work2cam_{camera}")[0].astype(float))
    X_CO = invert_pose(X_TC) @ unpack_pose(row["X_TO"])
    expected = project(
        intrinsics(snapshot.config.camera), transform_points(X_CO, row["closed_p_OQ"])
    )
    dots = contact_dots(snapshot, row, camera)
    assert len(dots) == 3
    np.testing.assert_allclose([[dot.u, dot.v] for dot in dots], expected, atol=0.01)


# Filters and order: each filter chooses by its own column, in the units that are shown.


@pytest.fixture
def snapshot(sound: Path) -> Snapshot:
    return read_snapshot(sound)


def chosen(snapshot: Snapshot, text: str, decisions: Decisions = NOTHING) -> list[str]:
    places = AttemptGallery(snapshot, decisions).select(AttemptGallery.query(dict(parse_qsl(text))))
    return [numbered(snapshot, str(i)) for i in places]


@pytest.mark.parametrize(
    ("text", "labels"),
    [
        ("outcome=slipped", ["0-1-1", "1-1-1", "2-1-1"]),
        ("object=2_box_b", ["1-0-0", "1-1-0", "1-3-2"]),
        ("class=brick", ["2-0-0", "2-1-0", "2-3-2"]),
        ("class=brick&object=2_box_b", []),
        ("object=nothing", []),
        ("split=none", []),
        ("removal=other_links", []),
    ],
)
def test_each_filter_chooses_its_own(snapshot: Snapshot, text: str, labels: list[str]) -> None:
    assert chosen(snapshot, f"{text}&sort=row&order=up") == labels


def test_any_sample_is_one_choice(snapshot: Snapshot) -> None:
    split = snapshot.table.split.copy()
    split[[0, 3]] = NONE
    changed = replace(snapshot, table=snapshot.table.with_columns(split=split))
    assert len(chosen(changed, "split=samples&outcome=any")) == 7
    assert set(chosen(changed, "split=none")) == {"0-0-0", "0-1-0"}


def test_order_is_by_the_quantity_and_those_without_come_last(snapshot: Snapshot) -> None:
    score = snapshot.table.anomaly.copy()
    score[[0, 3, 11]] = [5.0, np.nan, 7.0]
    changed = replace(snapshot, table=snapshot.table.with_columns(anomaly=score))
    down, up = chosen(changed, ""), chosen(changed, "order=up")
    assert down[:2] == ["0-3-2", "0-0-0"]
    assert up[-3:] == ["0-0-0", "0-3-2", "0-1-0"]
    assert down[-1] == up[-1] == "0-1-0"
    rows = chosen(snapshot, "sort=row&order=up")
    assert rows[:3] == ["0-0-0", "0-1-0", "0-3-2"]  # "smallest first"
    assert chosen(snapshot, "sort=row") == rows[::-1]


def test_decisions_choose_what_is_left(snapshot: Snapshot) -> None:
    a, b = AttemptKey("1_box_a", 0, 0), AttemptKey("3_brick", 1, 0)
    gone = AttemptKey("no object", 0, 0)
    decisions = Decisions(rejected=frozenset([a, gone]), kept=frozenset([b]))
    assert chosen(snapshot, "decision=rejected", decisions) == ["0-0-0"]
    # Failures are never decided, so they are not open either.
    for text in ("decision=open", "decision=open&outcome=any"):
        assert len(chosen(snapshot, text, decisions)) == 8


def test_address_of_a_query_gives_the_query_again() -> None:
    text = "outcome=any&object=a%26b%3Dc&sort=slip&order=up&page=3&hold=stable"
    query = AttemptGallery.query(dict(parse_qsl(text)))
    assert AttemptGallery.query(dict(parse_qsl(query.params()))) == query
    assert query["object"] == "a&b=c" and not query["outcome"]
    assert AttemptGallery.query().params() == ""


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("outcome=good", "outcome must be one of any, success, .* got 'good'"),
        ("sort=x", "sort must be one of"),
        ("page=-1", "page must be a number"),
    ],
)
def test_what_cannot_be_asked_for_is_refused(text: str, words: str) -> None:
    with pytest.raises(DataError, match=words):
        AttemptGallery.query(dict(parse_qsl(text)))


# Serving


#: The program, with Ctrl-C as at a terminal: a test that runs in the background inherits a shell's
#: choice to ignore it.
CODE = (
    "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
    "from drakegrasp.cli.main import run; run()"
)


def test_only_the_loopback_address_is_listened_on() -> None:
    with listen(0) as listener:
        assert listener.getsockname()[0] == LOOPBACK == "127.0.0.1"


def test_a_taken_port_is_one_line(sound: Path) -> None:
    with socket.socket() as other:
        other.bind((LOOPBACK, 0))
        other.listen()
        port = str(other.getsockname()[1])
        result = run("inspect", str(sound), "--port", port, "--no-browser")
    assert result.exit_code == 1
    assert result.stderr.startswith(f"error: --port must be free on this machine, got {port}")


def test_a_build_that_has_not_ended_is_one_line_that_says_how_to_end_it(out: Path) -> None:
    (out / TRIALS).unlink()
    result = run("inspect", str(out))
    assert result.exit_code == 1
    (line,) = result.stderr.splitlines()
    assert line == (
        f"error: {out}: must be a finished dataset, got one without trials.hdf5; finish it first, "
        "with the same command that began to build it"
    )


@pytest.mark.parametrize("library", ["starlette", "uvicorn", "jinja2"])
def test_missing_extra_is_one_line(
    library: str, sound: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in list(sys.modules):
        if name.startswith("drakegrasp.page"):
            monkeypatch.delitem(sys.modules, name)
        if name.partition(".")[0] == library:
            monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setitem(sys.modules, library, None)
    monkeypatch.setattr("socket.socket.listen", None)  # else a mistake would serve for ever
    result = run("inspect", str(sound), "--no-browser")
    assert result.exit_code == 1
    (line,) = result.stderr.splitlines()
    assert line.startswith("error: inspect needs its packages: pip install 'drakegrasp[inspect]' (")
    assert library in line


def test_command_serves_until_it_is_stopped(sound: Path) -> None:
    command = [sys.executable, "-c", CODE, "inspect", str(sound), "--port", "0", "--no-browser"]
    server = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ
    )
    assert server.stdout is not None
    try:
        address = server.stdout.readline().strip()
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+/", address)
        with urllib.request.urlopen(address, timeout=60.0) as answer:
            assert b"1_box_a" in answer.read()
    finally:
        server.send_signal(signal.SIGINT)
        _, errors = server.communicate(timeout=60.0)
    assert server.returncode == 130
    assert errors.strip() == "stopped"


def test_vendored_files_are_those_of_their_readme() -> None:
    folder = ASSETS / "vendor"
    rows = re.findall(r"\| `(\S+)` \|.*\| ([0-9a-f]{64}) \|", (folder / "README.md").read_text())
    assert {name for name, _ in rows} == {path.name for path in folder.glob("*.js")}
    for name, digest in rows:
        assert hashlib.sha256((folder / name).read_bytes()).hexdigest() == digest
    assert (folder / "LICENSE").read_text(encoding="utf-8").startswith("The MIT License")
