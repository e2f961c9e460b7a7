"""Recordings: the file holds what happened, and recording it changes nothing."""

from __future__ import annotations

import base64
import os
import pickle
import re
import socket
from dataclasses import replace
from pathlib import Path
from urllib.parse import urlsplit

import msgpack
import numpy as np
import pytest
from helpers.objects import CUBE, from_above, standing

from drakegrasp.config import Config
from drakegrasp.frames import X_WT, invert_pose
from drakegrasp.hand.description import load_hand
from drakegrasp.objects.model import ObjectModel
from drakegrasp.outcomes import Outcome
from drakegrasp.pictures import recording
from drakegrasp.pictures.recording import record_attempt, record_object
from drakegrasp.simulation.attempt import Attempt
from drakegrasp.simulation.construction import MESHCAT_RATE, build_scene
from drakegrasp.simulation.trial import run_attempt

pytestmark = pytest.mark.sim

#: Two contacts on opposite faces of the cube, a third beside the first, and their normals.
P_OQ = CUBE / 2.0 * np.array([[0.3, 1.0, 0.0], [0.0, -1.0, 0.0], [-0.3, 1.0, 0.0]])
NHAT_Q_O = np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [0.0, 1.0, 0.0]])
#: What Meshcat calls the object, the palm, and the command that sends a recording.
OBJECT, HAND, ANIMATION = b"visualizer/object/object", b"palm_plate", b"set_animation"
#: No file is larger [bytes]; three.js alone is some two million.
LARGEST = 5_000_000


@pytest.fixture(scope="module")
def attempt(cube: ObjectModel) -> Attempt:
    """One that holds the cube."""
    return from_above(cube, 0.06)


def commands_of(path: Path) -> list[bytes]:
    """Return what the page tells Meshcat, decoded."""
    text = path.read_text(encoding="utf-8")
    assert len(text) < LARGEST
    assert not re.search(r"<(script|link)[^>]+(src|href)=", text), "the page loads something"
    return [base64.b64decode(b) for b in re.findall(r"octet-binary;base64,([\w+/=]+)", text)]


def places_of(path: Path) -> dict[str, np.ndarray]:
    """Return the poses (4, 4) that the page gives to Drake's bodies, by their paths."""
    said = map(msgpack.unpackb, commands_of(path))
    return {
        command["path"].partition("visualizer/")[2]: np.reshape(command["matrix"], (4, 4)).T
        for command in said
        if command["type"] == "set_transform"
    }


def keys_of(path: Path) -> bytes:
    """Return the one command that holds the recording."""
    (animation,) = (c for c in commands_of(path) if ANIMATION in c)
    return animation


def test_recording_a_trial_changes_no_bit_of_it(
    cube: ObjectModel, attempt: Attempt, config: Config, tmp_path: Path
) -> None:
    hand = load_hand(config.hand)
    plain = run_attempt(build_scene(cube, config.physics, hand), standing(cube), attempt, config)
    path = tmp_path / "new" / "trial.html"
    recorded = record_attempt(
        cube, standing(cube), attempt, config, path, p_OQ=P_OQ, nhat_Q_O=NHAT_Q_O
    )
    assert plain.outcome is recorded.outcome is Outcome.SUCCESS
    assert pickle.dumps(recorded) == pickle.dumps(plain)
    everything = b"".join(commands_of(path))
    assert all(part in everything for part in (OBJECT, HAND, b"predicted/3/shaft"))
    # Object and fingers move; contacts go with the object.
    keys = keys_of(path)
    # Two diagrams take turns in a lift, and no picture is missing.
    clips = {
        part["path"]: part["clip"]
        for part in msgpack.unpackb(keys, strict_map_key=False)["animations"]
    }
    times = [key["time"] for key in clips["/drake/visualizer/object/object"]["tracks"][0]["keys"]]
    end = plain.closed.duration + plain.lift.duration
    assert times == list(range(len(times)))
    assert len(times) / MESHCAT_RATE == pytest.approx(end, abs=2.0 / MESHCAT_RATE)
    assert OBJECT in keys
    assert b"finger" in keys
    assert b"predicted" not in keys
    assert not list(path.parent.glob("*tmp*"))


def test_object_at_rest_is_shown_without_a_hand(
    cube: ObjectModel, config: Config, tmp_path: Path
) -> None:
    record_object(cube, standing(cube), config, tmp_path / "still.html", caption="It rests.")
    everything = b"".join(commands_of(tmp_path / "still.html"))
    assert OBJECT in everything and HAND not in everything and b"predicted" not in everything
    assert ">It rests.</p>" in (tmp_path / "still.html").read_text()


def test_attempt_that_is_not_simulated_is_shown_at_its_start_and_arrows_begin_at_contacts(
    cube: ObjectModel, attempt: Attempt, config: Config, tmp_path: Path
) -> None:
    missed, path = replace(attempt, ray_hits=False), tmp_path / "miss.html"
    contacts = {"p_OQ": P_OQ, "nhat_Q_O": NHAT_Q_O}
    trial = record_attempt(cube, standing(cube), missed, config, path, **contacts)
    assert trial.outcome is Outcome.RAY_MISS
    everything, places = b"".join(commands_of(path)), places_of(path)
    assert OBJECT in everything and HAND in everything
    X_WO, X_GB = X_WT @ standing(cube), invert_pose(load_hand(config.hand).X_BG)
    X_WB = places["barrett_hand/base"]
    np.testing.assert_allclose(X_WB, X_WO @ missed.X_OG @ X_GB, atol=1e-9)
    np.testing.assert_allclose(places["object/object"], X_WO, atol=1e-9)

    first = "object/object/predicted/1"
    np.testing.assert_allclose(places[first][:3, [2, 3]].T, [NHAT_Q_O[0], P_OQ[0]], atol=1e-12)
    shaft = (recording.ARROW - recording.HEAD) / 2.0
    assert places[f"{first}/shaft"][2, 3] == pytest.approx(shaft)
    assert places[f"{first}/head"][2, 3] == pytest.approx(recording.ARROW)


def test_only_this_machine_is_served_and_only_meanwhile(
    cube: ObjectModel,
    attempt: Attempt,
    config: Config,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("DRAKE_ALLOW_NETWORK", "none")
    urls = []
    make = recording._make_meshcat

    def spy() -> object:
        meshcat = make()
        urls.append(urlsplit(meshcat.web_url()))
        return meshcat

    monkeypatch.setattr(recording, "_make_meshcat", spy)
    missed = replace(attempt, ray_hits=False)
    record_attempt(cube, standing(cube), missed, config, tmp_path / "a.html")
    record_object(cube, standing(cube), config, tmp_path / "b.html")
    assert os.environ["DRAKE_ALLOW_NETWORK"] == "none"
    assert [url.hostname for url in urls] == ["localhost"] * 2
    for url in urls:
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(("127.0.0.1", url.port), timeout=5.0).close()
    assert "listening" not in "".join(capfd.readouterr())
