"""Episodes for LeRobot: their frames are the trials, and their files say the same of them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.commands import run

from drakegrasp.arithmetic import multiply
from drakegrasp.config import ScenesConfig
from drakegrasp.dataset.trials import Trials
from drakegrasp.errors import DataError
from drakegrasp.exchange.export import export_dataset
from drakegrasp.frames import unpack_pose
from drakegrasp.hand.description import load_hand
from drakegrasp.outcomes import Outcome
from drakegrasp.vision.camera import Lens

av = pytest.importorskip("av")
pq = pytest.importorskip("pyarrow.parquet")
lerobot = pytest.importorskip("drakegrasp.exchange.lerobot")

FPS = 5
CAMERAS = [
    f"observation.images.{view}{kind}"
    for view in ("close", "front", "side")
    for kind in ("", "_depth")
]


@pytest.fixture(scope="module")
def rows(small_dataset: Path) -> dict[str, dict[str, Any]]:
    """The last success that is a sample, and the last attempt that failed when it had closed."""
    trials = Trials(small_dataset)
    samples = trials[np.flatnonzero(trials["removal"] == 0)]
    failed = trials.where(outcome="missing_fingertip")
    return {"samples": samples[-1], "failed": failed[-1]}


@pytest.fixture(scope="module")
def export(
    small_dataset: Path, rows: dict[str, dict[str, Any]], tmp_path_factory: pytest.TempPathFactory
) -> Callable[..., Path]:
    """Returns a new export of both attempts, or of one, with small images."""

    def write(attempts: str = "all") -> Path:
        folder = tmp_path_factory.mktemp("lerobot") / "to"
        with pytest.MonkeyPatch.context() as patch:
            chosen = lerobot._chosen
            wanted = {row["trial_id"] for row in rows.values()}
            patch.setattr(
                lerobot,
                "_chosen",
                lambda *args: [row for row in chosen(*args) if row["trial_id"] in wanted],
            )
            patch.setattr(lerobot, "LENS", Lens.of(ScenesConfig(width=48, height=32)))
            export_dataset(small_dataset, folder, "lerobot", attempts=attempts, fps=FPS)
        return folder

    return write


@pytest.fixture(scope="module")
def folder(export: Callable[..., Path]) -> Path:
    return export()


def table(folder: Path, kind: str) -> dict[str, Any]:
    (path,) = sorted((folder / kind).rglob("*.parquet"))
    return {
        name: np.array(column) if kind == "data" else column
        for name, column in pq.read_table(path).to_pydict().items()
    }


def decoded(folder: Path, camera: str) -> list[np.ndarray]:
    kind = "gray12le" if camera.endswith("depth") else "rgb24"
    with av.open(str(folder / f"videos/{camera}/chunk-000/file-000.mp4")) as video:
        frames = list(video.decode(video=0))
        assert [float(frame.time) for frame in frames] == pytest.approx(
            np.arange(len(frames)) / FPS
        )
        return [frame.to_ndarray(format=kind) for frame in frames]


def test_episodes_are_the_trials(folder: Path, rows: dict[str, dict[str, Any]]) -> None:
    frames, episodes = table(folder, "data"), table(folder, "meta/episodes")
    assert episodes["trial_id"] == [rows["samples"]["trial_id"], rows["failed"]["trial_id"]]
    assert episodes["outcome"] == ["success", "missing_fingertip"]
    assert episodes["success"] == [True, False]
    for number, row in enumerate(rows.values()):
        own = frames["episode_index"] == number
        state, phase = frames["observation.state"][own], frames["phase"][own]
        start, end = (episodes[f"dataset_{side}_index"][number] for side in ("from", "to"))
        assert np.array_equal(frames["index"][own], np.arange(start, end))
        assert (np.diff(phase) >= 0).all()
        assert phase[-1] == (2 if number == 0 else 1)

        # The palm comes by 0.1 m along +Gz, but not from below, stays, and is lifted.
        X_TG = multiply(unpack_pose(row["X_TO"]), unpack_pose(row["X_OG"]))
        back = -X_TG[:3, 2] * [1.0, 1.0, X_TG[2, 2] < 0.0]
        start = X_TG[:3, 3] + 0.1 * back / np.linalg.norm(back)
        assert state[0, :3] == pytest.approx(start, abs=1e-6)
        assert state[phase == 1][:, :3] == pytest.approx(
            np.tile(X_TG[:3, 3], (sum(phase == 1), 1)), abs=1e-4
        )
        lasted = row["time_lift"] if number == 0 else 0.0
        assert 0.0 <= sum(phase == 2) - FPS * lasted < 2.0
        stage = "lifted" if number == 0 else "closed"
        assert state[-1, 7:] == pytest.approx(row[f"{stage}_q"], abs=1e-6)
        if number == 0:
            p_TO = unpack_pose(row["X_TO_lifted"])[:3, 3]
            assert frames["object_pose"][own][-1, :3] == pytest.approx(p_TO, abs=1e-6)
        # A success weighs on the fingertips alone.
        if number == 0:
            f = frames["observation.fingertip_forces"][own][-1].reshape(-1, 3).sum(axis=0)
            assert f == pytest.approx([0.0, 0.0, 9.81 * row["mass"]], abs=0.1)

        # The action is where the palm is next; motors drive on.
        action = frames["action"][own]
        assert np.array_equal(action[:-1, :7], state[1:, :7])
        assert (action[phase > 0][:, 7:] >= state[phase > 0][:, 7:] - 1e-6).all()
        assert action[-1, 7:].sum() > state[-1, 7:].sum() + 0.1
        for name in ("next.done", "next.success", "next.reward"):
            column = frames[name][own]
            assert not column[:-1].any()
            assert column[-1] == (name == "next.done" or number == 0)


def test_files_say_how_many_frames_there_are(folder: Path) -> None:
    info = json.loads((folder / "meta/info.json").read_text())
    frames, episodes = table(folder, "data"), table(folder, "meta/episodes")
    count = info["total_frames"]
    assert info["codebase_version"] == "v3.0"
    assert (info["total_episodes"], info["fps"], sum(episodes["length"])) == (2, FPS, count)
    (split,) = info["splits"]
    assert info["splits"] == {split: "0:1"}
    assert set(info["features"]) == {*frames, *CAMERAS}
    for name, values in frames.items():
        assert list(values.reshape(count, -1).shape[1:]) == info["features"][name]["shape"]
    for camera in CAMERAS:
        assert len(decoded(folder, camera)) == count
        assert episodes[f"videos/{camera}/from_timestamp"] == [0.0, episodes["length"][0] / FPS]
        assert episodes[f"videos/{camera}/to_timestamp"][1] == count / FPS
    stats = json.loads((folder / "meta/stats.json").read_text())
    assert set(stats) == set(info["features"])
    action = frames["action"]
    assert stats["action"]["mean"] == pytest.approx(action.mean(axis=0), abs=1e-6)
    assert stats["action"]["q90"] == pytest.approx(np.quantile(action, 0.9, axis=0), abs=1e-6)
    tasks = pq.read_table(folder / "meta/tasks.parquet")
    assert b'"index_columns": ["task"]' in tasks.schema.metadata[b"pandas"]
    assert all(task.startswith("lift the ") for task in tasks.column("task").to_pylist())


def test_images_are_seen_where_the_cameras_stand(folder: Path) -> None:
    """Depth is kept to 0.25 mm; the lifted object is high in `front`, and gone from `close`."""
    stats = json.loads((folder / "meta/stats.json").read_text())
    last = table(folder, "meta/episodes")["length"][0] - 1
    for camera in CAMERAS:
        images = np.array(decoded(folder, camera), dtype=float)
        if camera.endswith("depth"):
            said = stats[camera]
            assert 5e-4 * images.mean() == pytest.approx(np.ravel(said["mean"])[0], abs=1e-9)
            assert 5e-4 * images.min() == pytest.approx(np.ravel(said["min"])[0], abs=1e-9)
        changed = np.abs(images[last] - images[0]).reshape(*images.shape[1:3], -1).max(axis=2)
        changed = changed > (60 if camera.endswith("depth") else 40)
        assert changed.any()
        if "close" not in camera:
            assert changed[: len(changed) // 2].any()
    assert np.ravel(stats["observation.images.front"]["max"]).max() <= 1.0


def test_long_exports_have_parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each with times from 0, in folders of a few files."""
    monkeypatch.setattr(lerobot, "LENS", Lens.of(ScenesConfig(width=48, height=32)))
    monkeypatch.setattr(lerobot, "PART_SECONDS", 1)
    monkeypatch.setattr(lerobot, "CHUNK", 2)
    hand, lengths = load_hand("franka"), (3, 2, 6, 5, 4)
    writer = lerobot._Writer(tmp_path, FPS, hand)
    known = lerobot.features(hand)
    for length in lengths:
        columns = {
            name: np.zeros((length, *each["shape"][: each["names"] is not None]))
            for name, each in known.items()
            if each["dtype"] != "video"
        }
        image = {
            name: np.zeros(known[name]["shape"], np.uint16 if "depth" in name else np.uint8)
            for name in CAMERAS
        }
        writer.add("lift it", {"split": "train"}, columns, [image] * length)
    writer.finish()

    parts = [(0, 0), (0, 1), (1, 0), (1, 1)]
    episodes = {"chunk_index": [], "file_index": [], "from_timestamp": [], "index": []}
    for chunk, file in parts:
        name = f"chunk-{chunk:03d}/file-{file:03d}"
        rows = pq.read_table(tmp_path / f"meta/episodes/{name}.parquet").to_pydict()
        data = pq.read_table(tmp_path / f"data/{name}.parquet").to_pydict()
        episodes["index"] += data["index"]
        for key in ("chunk_index", "file_index", "from_timestamp"):
            episodes[key] += rows[f"videos/{CAMERAS[1]}/{key}"]
        with av.open(str(tmp_path / f"videos/{CAMERAS[1]}/{name}.mp4")) as video:
            assert len(list(video.decode(video=0))) == len(data["index"])
    assert [*zip(episodes["chunk_index"], episodes["file_index"], strict=True)] == [
        parts[k] for k in (0, 0, 1, 2, 3)
    ]
    assert episodes["from_timestamp"] == [0.0, 3 / FPS, 0.0, 0.0, 0.0]
    assert episodes["index"] == [*range(sum(lengths))]


@pytest.mark.nightly
def test_same_attempts_give_the_same_bytes(export: Callable[..., Path]) -> None:
    def digests(folder: Path) -> dict[str, str]:
        files = (path for path in folder.rglob("*") if path.is_file())
        return {
            str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in files
        }

    one, other = (digests(export("failed")) for _ in range(2))
    assert len(one) == 5 + len(CAMERAS)
    assert one == other


@pytest.mark.parametrize(
    ("form", "option", "message"),
    [
        ("lerobot", {"attempts": "held"}, "attempts must be one of samples, failed, all, got"),
        ("lerobot", {"fps": 0}, "fps must be a whole number from 1 to 120, got 0"),
        ("lerobot", {"fps": 12.5}, "fps must be a whole number from 1 to 120, got 12.5"),
        ("lerobot", {"licence": "mit"}, "licence must be left out with format lerobot, got 'mit'"),
        ("glb", {"fps": 10}, "fps must be left out with format glb, got 10"),
    ],
)
def test_other_options_are_refused(
    small_dataset: Path, tmp_path: Path, form: str, option: dict[str, Any], message: str
) -> None:
    with pytest.raises(DataError, match=message):
        export_dataset(small_dataset, tmp_path / "to", form, **option)
    assert not list(tmp_path.iterdir())


def test_command_refuses_options_of_other_formats(small_dataset: Path) -> None:
    done = run("export", small_dataset, "--to", "glb", "--attempts", "failed")
    assert done.exit_code == 2
    assert "--attempts must be left out with --to glb, got failed" in done.output


def test_which_attempts_are_episodes(out: Path) -> None:
    """Made-up outcomes; of a hand that was not lifted nothing is known."""
    outcomes = Trials(out)["outcome"]
    chosen = {which: lerobot._chosen(out, which) for which in ("samples", "failed", "all")}
    labels = {
        which: {Outcome(int(outcomes[row["trial_id"]])).label for row in found}
        for which, found in chosen.items()
    }
    assert labels["samples"] == {"success"}
    failed = {"missing_fingertip", "slipped", "dropped", "hand_contact", "table_contact"}
    assert labels["failed"] == failed
    assert labels["all"] == {"success", *failed}
    splits = [row["split"] for row in chosen["all"]]
    known = [split for split in splits if split]
    assert known == sorted(known, key=["train", "valid", "test"].index)
    assert splits == [*known, *[""] * (len(splits) - len(known))]


@pytest.mark.nightly
def test_lerobot_reads_it(folder: Path) -> None:
    """By their own reader, where it is installed."""
    datasets = pytest.importorskip("lerobot.datasets.lerobot_dataset")
    data = datasets.LeRobotDataset("drakegrasp/two", root=folder, depth_output_unit="m")
    assert data.meta.total_episodes == 2
    frames = table(folder, "data")
    for row in (0, len(data) - 1):
        assert np.array_equal(data[row]["action"].numpy(), frames["action"][row].astype("f4"))
        depth = data[row]["observation.images.front_depth"].numpy()[0]
        level = decoded(folder, "observation.images.front_depth")[row]
        assert depth == pytest.approx(5e-4 * level, abs=1e-6)
