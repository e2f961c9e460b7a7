"""Episodes for LeRobot: attempts over time, as a LeRobotDataset of version 3.0.

Input: a dataset. Output: a folder that `LeRobotDataset(name, root=folder)` of lerobot 0.6 reads.
Every attempt is simulated again, with results that are equal bit for bit, and becomes an episode
with a fixed number of frames per second. In an episode the palm approaches, the fingers close, and
the object is lifted. Poses are interpolated between the steps of the simulation. Two parts of an
episode are not simulated: the approach, and the closing as far as geometry shows that the fingers
touch nothing.

We write the files without lerobot, because it needs PyTorch, and versions of Python and of
libraries that we do not use. A part of the dataset has a Parquet file of frames, one of episodes,
and a video of each camera. It lasts at most ten minutes, because lerobot computes times in a video
in single precision.

Depth is lossless 12-bit video, as in lerobot's own datasets. Needs the extra `[lerobot]`.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypeAlias, get_args

import av
import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq
from scipy.spatial.transform import Rotation, Slerp

from drakegrasp.arithmetic import Array, sin_cos_deg
from drakegrasp.config import LiftConfig, ScenesConfig
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.schema import SPLITS
from drakegrasp.dataset.trials import Trials
from drakegrasp.errors import DataError
from drakegrasp.filters import Removal
from drakegrasp.generation.replay import TracedTrial, trace_trial
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.outcomes import Outcome, Stage
from drakegrasp.runtime.progress import Report
from drakegrasp.simulation.conditions import usual_conditions
from drakegrasp.simulation.lift import LiftPath, lift_duration
from drakegrasp.simulation.posture import joint_order
from drakegrasp.simulation.scene_cache import cached_renderer
from drakegrasp.vision.camera import Lens, fixed_viewpoints, look_at
from drakegrasp.vision.rendering import paint, pose_hand, render

#: Description of the format in `drakegrasp export --help`.
HELP = "LeRobot v3: an attempt is an episode, with colour and depth video"
#: Name of the things that the command counts.
COUNTS = "episode"

#: Choices of the attempts that become episodes.
Attempts: TypeAlias = Literal["samples", "failed", "all"]
#: Maximum number of frames per second, which is a whole number.
MOST_FPS = 120
#: Version of the format.
VERSION = "v3.0"
#: Distance that the palm approaches along +Gz [m].
APPROACH = 0.1
#: Values of the feature `phase`.
PHASES = ("approach", "close", "lift")
#: The cameras, see `viewpoints`, and the beginning of the names of their features.
VIEWS, IMAGES = ("close", "front", "side"), "observation.images."
#: Lens of all cameras: 320 x 240 pixels.
LENS = Lens.of(ScenesConfig())
#: Margin beside the path of the lift that cameras of the whole lift see [m], and their elevation
#: [deg].
BESIDE, ELEVATION_DEG = 0.2, 20.0
#: Length of a part [s], and maximum number of files in a folder.
PART_SECONDS, CHUNK = 600, 1000
#: Depth per unit of a depth video [m], and the largest value of 12 bits.
DEPTH_UNIT, DEPTH_LEVELS = 5e-4, 4095
#: Quantiles of the statistics.
QUANTILES = (0.01, 0.1, 0.5, 0.9, 0.99)

#: Lerobot's names of the numbers of a pose.
POSE_NAMES = ("x", "y", "z", "qw", "qx", "qy", "qz")
#: Columns that number frames and episodes.
INDICES = ("frame_index", "episode_index", "index", "task_index")
#: Name of a file in its folder.
FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
#: Properties of each video that lerobot's reader needs, in addition to its size.
COLOUR = {"video.codec": "h264", "video.pix_fmt": "yuv420p", "video.g": 2, "video.crf": 18}
DEPTH = {
    "video.codec": "hevc",
    "video.pix_fmt": "gray12le",
    "video.g": 2,
    "video.extra_options": {"x265-params": "lossless=1"},
    "video.depth_min": 0.0,
    "video.depth_max": DEPTH_LEVELS * DEPTH_UNIT,
    "video.shift": 0.0,
    "video.use_log": False,
    "depth_unit": "m",
}
#: Options of the encoders. With one thread they always produce the same bytes.
ONE_THREAD = "pools=none:frame-threads=1:log-level=error"
COLOUR_OPTIONS = {"g": "2", "crf": "18", "threads": "1"}
DEPTH_OPTIONS = {"g": "2", "threads": "1", "x265-params": f"lossless=1:{ONE_THREAD}"}
#: Metadata that make pandas read the column `task` as the index, as lerobot requires.
TASK = {"name": "task", "field_name": "task", "pandas_type": "unicode", "numpy_type": "object"}
PANDAS = {"index_columns": ["task"], "column_indexes": [], "columns": [TASK]}


def write_lerobot(
    out: Path,
    folder: Path,
    progress: Report,
    *,
    attempts: Attempts = "samples",
    fps: int = 10,
) -> int:
    """Write the folder and return the number of episodes; see `export.export_dataset`.

    Args:
        out: See `export.export_dataset`.
        folder: See `export.export_dataset`.
        progress: See `export.export_dataset`.
        attempts: Which are episodes: the samples; those that were closed and failed; or all of
            which it is known whether they hold.
        fps: Frames per second.

    Raises:
        DataError: If there is no such attempt, an option has another value, or in every attempt
            the fingers no longer close, which another version of Drake can cause.
    """
    if attempts not in get_args(Attempts):
        known = ", ".join(get_args(Attempts))
        raise DataError(f"attempts must be one of {known}, got {attempts!r}")
    if not isinstance(fps, int) or not 1 <= fps <= MOST_FPS:
        raise DataError(f"fps must be a whole number from 1 to {MOST_FPS}, got {fps!r}")

    # The attempts, and what sees them.
    config = read_manifest(out).config
    hand, chosen = load_hand(config.hand_source), _chosen(out, attempts)
    views, writer = viewpoints(config.lift), _Writer(folder, fps, hand)
    progress(0, len(chosen))

    # Each is simulated again, drawn and written.
    count = 0
    for done, row in enumerate(chosen, start=1):
        trial = trace_trial(out, row["trial_id"])
        if trial is not None:
            count += 1
            outcome, frames = trial.record.outcome, episode_frames(trial, hand, fps)
            said = {**row, "outcome": outcome.label, "success": outcome is Outcome.SUCCESS}
            task = f"lift the {row['class_name'].replace('_', ' ')}"
            writer.add(task, said, frames, _images(trial, hand, frames, views))
        progress(done, len(chosen), episodes=count)
    if not count:
        raise DataError(f"{out}: must have attempts that run again as they did, got none")
    writer.finish()
    return count


def _chosen(out: Path, attempts: Attempts) -> list[dict[str, Any]]:
    """Return the data of the attempts to export, with samples first, split by split."""
    trials = Trials(out)
    names = ("outcome", "removal", "split", "object_name", "class_name")
    columns = trials.columns(names)
    outcomes = [Outcome(int(value)) for value in columns["outcome"]]
    sample = columns["removal"] == Removal.KEPT
    held = np.array([outcome is Outcome.SUCCESS for outcome in outcomes])

    # A hand that never closed shows nothing.
    known = np.array([outcome.stage >= Stage.CLOSED for outcome in outcomes])
    chosen = {"samples": sample, "failed": known & ~held, "all": known}[attempts]
    if not chosen.any():
        raise DataError(f"{out}: must have attempts to export ({attempts}), got none")

    # Samples come first, split by split.
    splits = np.where(sample, columns["split"], len(SPLITS))
    return [
        {
            "trial_id": row,
            "split": (*SPLITS, "")[splits[row]],
            "object_name": str(columns["object_name"][row]),
            "class_name": str(columns["class_name"][row]),
        }
        for row in np.lexsort((np.arange(len(trials)), splits)).tolist()
        if chosen[row]
    ]


# An attempt over time


def episode_frames(trial: TracedTrial, hand: Hand, fps: int) -> dict[str, npt.NDArray[Any]]:
    """Return the columns of an episode by their names in the dataset, with n frames each.

    Args:
        trial: The trial with its motion over time.
        hand: The hand, with all its fingers.
        fps: Frames per second. The last frame shows the end.
    """
    # Times of the frames, and of the steps of the simulation.
    trace = trial.trace
    approach = lift_duration(APPROACH, trial.config)
    steps = approach + trial.free + trace.times
    count = int(np.ceil(steps[-1] * fps - 1e-9)) + 1
    times = np.arange(count) / fps
    closed, lift = trial.record.closed, trial.record.lift
    closes = np.inf if closed is None or lift is None else closed.duration
    phase = (times >= approach).astype(np.int64) + (times > approach + trial.free + closes)

    # The palm approaches along +Gz, never from below, and does not rotate.
    X_TG = trace.X_TG[0].copy()
    back = -X_TG[:3, 2] * [1.0, 1.0, X_TG[2, 2] < 0.0]
    start = X_TG.copy()
    start[:3, 3] += APPROACH * back / max(float(np.linalg.norm(back)), 1e-9)
    path = LiftPath(X_WO=start, p_WO_end=X_TG[:3, 3], duration=approach)
    p_TG = _between(times, steps, trace.X_TG[:, :3, 3])
    p_TG[phase == 0] = [path.at(time)[0] for time in times[phase == 0]]
    palm = _poses(p_TG, Rotation.from_matrix([X_TG[:3, :3]] * count))

    # The joints, which begin to close when it is there, and where motors drive them until the
    # next frame.
    knots = np.append(approach, steps) if trial.free else steps
    q = _between(times, knots, np.vstack([trial.q_open, trace.q]) if trial.free else trace.q)
    moving = np.clip((times + 1.0 / fps - approach) * fps, 0.0, 1.0)[:, None]
    target = q + moving * trace.rates / fps
    commanded = _between(times + 1.0 / fps, steps, trace.commanded)
    target = np.where(np.isnan(commanded), target, commanded)
    limits = dict(zip(hand.joint_names, hand.joint_limits, strict=True))
    target = np.clip(target, *np.array([limits[name] for name in trace.joints]).T)

    # The object, the forces on it, and how it ends.
    turns = Slerp(steps, Rotation.from_matrix(trace.X_TO[:, :3, :3]))
    R_TO = turns(np.clip(times, steps[0], steps[-1]))
    forces = _between(times, steps, trace.f_T.reshape(len(steps), -1))
    done = np.arange(count) == count - 1
    success = done & (trial.record.outcome is Outcome.SUCCESS)
    return {
        "observation.state": np.hstack([palm, q]),
        "action": np.hstack([np.vstack([palm[1:], palm[-1:]]), target]),
        "observation.fingertip_forces": forces,
        "object_pose": _poses(_between(times, steps, trace.X_TO[:, :3, 3]), R_TO),
        "phase": phase,
        "next.reward": success.astype(np.float32),
        "next.done": done,
        "next.success": success,
    }


def _between(times: Array, steps: Array, values: Array) -> Array:
    """Return the values (n, d) of n steps, interpolated at m times (m, d) and constant outside."""
    return np.column_stack([np.interp(times, steps, column) for column in values.T])


def _poses(p: Array, R: Rotation) -> Array:
    """Return positions (n, 3) and rotations as rows (n, 7), see `POSE_NAMES`."""
    quaternions = R.as_quat(canonical=True, scalar_first=True)
    # Both signs of a quaternion mean the same rotation; keep the sign of the previous frame.
    jumps = np.einsum("ij,ij->i", quaternions[1:], quaternions[:-1]) < 0.0
    quaternions[1:] *= np.where(np.cumsum(jumps) % 2, -1.0, 1.0)[:, None]
    return np.hstack([p, quaternions])


# What cameras see


def viewpoints(config: LiftConfig) -> dict[str, Array]:
    """Return the poses X_TC (4, 4) of the cameras by their names; they are fixed for a dataset.

    `close` is the single fixed camera of scenes; `front` and `side` see the whole lift.
    """
    p_TG = np.array(config.p_TG)
    sine, _ = sin_cos_deg(ELEVATION_DEG)
    seen = float(np.linalg.norm(p_TG)) + 2.0 * BESIDE
    distance = seen / LENS.height * float(LENS.K[1, 1])
    whole = [look_at(p_TG / 2.0, distance, turn, float(sine)) for turn in (0.0, np.pi / 2.0)]
    return dict(zip(VIEWS, (fixed_viewpoints()[-1], *whole), strict=True))


def _images(
    trial: TracedTrial, hand: Hand, frames: Mapping[str, Array], views: Mapping[str, Array]
) -> Iterator[dict[str, npt.NDArray[Any]]]:
    """Yield the images of each frame, (h, w, c), by the names of their features."""
    model = trial.model
    conditions = trial.attempt.conditions or usual_conditions(model, trial.config.physics)
    renderer = cached_renderer(model, trial.config.camera, hand)
    paint(renderer, conditions.appearance)
    for state, at in zip(frames["observation.state"], frames["object_pose"], strict=True):
        pose_hand(renderer, _pose(state[:7]), state[7:])
        images = {}
        for name, X_TC in views.items():
            seen = render(renderer, _pose(at), X_TC, LENS)
            levels = np.rint(np.minimum(seen.depth / DEPTH_UNIT, DEPTH_LEVELS)).astype(np.uint16)
            images[f"{IMAGES}{name}"] = seen.rgb
            images[f"{IMAGES}{name}_depth"] = levels[:, :, None]
        yield images


def _pose(row: Array) -> Array:
    X = np.eye(4)
    X[:3, 3], X[:3, :3] = row[:3], Rotation.from_quat(row[3:], scalar_first=True).as_matrix()
    return X


# Files


class _Video:
    """A video file, and the counts of each value in its images."""

    def __init__(self, path: Path, fps: int, shape: Sequence[int]) -> None:
        height, width, channels = shape
        coloured = channels == 3
        known, options = (COLOUR, COLOUR_OPTIONS) if coloured else (DEPTH, DEPTH_OPTIONS)
        self._file = av.open(str(path), "w")
        self._stream = self._file.add_stream(known["video.codec"], rate=fps, options=options)
        self._stream.width, self._stream.height = width, height
        self._stream.pix_fmt = known["video.pix_fmt"]
        self._format = "rgb24" if coloured else known["video.pix_fmt"]
        self._frames = 0
        self.counts = np.zeros((channels, 256 if coloured else DEPTH_LEVELS + 1), dtype=np.int64)

    def add(self, image: npt.NDArray[Any]) -> None:
        """Add an image (h, w, c)."""
        channels, levels = self.counts.shape
        values = image.reshape(-1, channels).T
        self.counts += [np.bincount(channel, minlength=levels) for channel in values]
        plain = np.ascontiguousarray(image if channels == 3 else image[:, :, 0])
        frame = av.VideoFrame.from_ndarray(plain, format=self._format)
        frame.pts = self._frames
        self._file.mux(self._stream.encode(frame))
        self._frames += 1

    def close(self) -> None:
        """Write the remaining data and close the file."""
        self._file.mux(self._stream.encode(None))
        self._file.close()


def features(hand: Hand) -> dict[str, dict[str, Any]]:
    """Return the entries of `info.json` for the features of a hand with j joints and k fingers."""
    # Columns of the data.
    posture = [*(f"palm.{name}" for name in POSE_NAMES), *joint_order(hand)]
    forces = [f"{link}.f{axis}" for link in hand.fingertip_links for axis in "xyz"]
    numbers = {
        "observation.state": ("float32", posture),
        "action": ("float32", posture),
        "observation.fingertip_forces": ("float32", forces),
        "object_pose": ("float32", [*POSE_NAMES]),
        "phase": ("int64", None),
        "next.reward": ("float32", None),
        "next.done": ("bool", None),
        "next.success": ("bool", None),
        "timestamp": ("float32", None),
        **dict.fromkeys(INDICES, ("int64", None)),
    }
    found: dict[str, dict[str, Any]] = {
        name: {"dtype": dtype, "shape": [len(names or "1")], "names": names}
        for name, (dtype, names) in numbers.items()
    }

    # Videos.
    for view in VIEWS:
        found[f"{IMAGES}{view}"] = _video_feature(3, COLOUR)
        found[f"{IMAGES}{view}_depth"] = _video_feature(1, DEPTH)
    return found


def _video_feature(channels: int, known: Mapping[str, Any]) -> dict[str, Any]:
    size = {"height": LENS.height, "width": LENS.width, "channels": channels}
    info = {f"video.{name}": value for name, value in size.items()}
    info |= {"has_audio": False, "is_depth_map": channels == 1, **known}
    return {"dtype": "video", "shape": [*size.values()], "names": [*size], "info": info}


class _Writer:
    """Writes episodes one after the other.

    Args:
        folder: Folder of the dataset.
        fps: Frames per second.
        hand: The hand.
    """

    def __init__(self, folder: Path, fps: int, hand: Hand) -> None:
        self._folder, self._fps, self._hand = folder, fps, hand
        self._features = features(hand)
        # For all episodes: tasks, splits, numbers of frames, and counts of each value in images.
        self._tasks: dict[str, int] = {}
        self._splits: list[str] = []
        self._numbers: dict[str, list[npt.NDArray[Any]]] = {}
        self._counts: dict[str, npt.NDArray[np.int64]] = {}
        # For the open part: its number, its files, its episodes and their frames.
        self._part, self._length, self._frames = 0, 0, 0
        self._data: pq.ParquetWriter | None = None
        self._videos: dict[str, _Video] = {}
        self._episodes: list[dict[str, Any]] = []

    def add(
        self,
        task: str,
        said: Mapping[str, Any],
        columns: Mapping[str, npt.NDArray[Any]],
        images: Iterable[Mapping[str, npt.NDArray[Any]]],
    ) -> None:
        """Write an episode.

        Args:
            task: Description of the task in words.
            said: Other data of the episode, as columns of the episodes, including `split`.
            columns: Columns of the n frames, see `episode_frames`.
            images: Images of each frame, see `_images`.
        """
        data = self._data or self._open_part()
        number, length = len(self._splits), len(columns["phase"])

        # The frames.
        steps, place = np.arange(length), self._tasks.setdefault(task, len(self._tasks))
        whole = np.full(length, 1)
        columns = {
            **columns,
            "timestamp": steps / self._fps,
            "frame_index": steps,
            "episode_index": number * whole,
            "index": self._frames + steps,
            "task_index": place * whole,
        }
        arrays = {field.name: _arrow(columns[field.name], field.type) for field in data.schema}
        data.write_table(pa.table(arrays, schema=data.schema))
        for seen in images:
            for name, image in seen.items():
                self._videos[name].add(image)

        # The row of the episode.
        for name, values in columns.items():
            self._numbers.setdefault(name, []).append(values)
        file = dict(zip(("chunk_index", "file_index"), divmod(self._part, CHUNK), strict=True))
        ends = (self._length / self._fps, (self._length + length) / self._fps)
        span = dict(zip(("from_timestamp", "to_timestamp"), ends, strict=True))
        nested: dict[str, Mapping[str, Any]] = {
            **dict.fromkeys(("data", "meta/episodes"), file),
            **{f"videos/{name}": {**file, **span} for name in self._videos},
        }
        self._episodes.append(
            {
                "episode_index": number,
                "tasks": [task],
                "length": length,
                "dataset_from_index": self._frames,
                "dataset_to_index": self._frames + length,
                **said,
                **{f"{name}/{key}": v for name, each in nested.items() for key, v in each.items()},
            }
        )
        self._splits.append(said["split"])
        self._frames, self._length = self._frames + length, self._length + length
        if self._length >= PART_SECONDS * self._fps:
            self._close_part()

    def finish(self) -> None:
        """Write the files about all episodes."""
        self._close_part()
        tasks = {"task_index": [*self._tasks.values()], "task": [*self._tasks]}
        table = pa.table(tasks).replace_schema_metadata({"pandas": json.dumps(PANDAS)})
        pq.write_table(table, self._folder / "meta/tasks.parquet")

        numbers = {name: np.concatenate(parts) for name, parts in self._numbers.items()}
        stats = {name: _number_stats(values) for name, values in numbers.items()}
        stats |= {name: _pixel_stats(counts, self._frames) for name, counts in self._counts.items()}
        first = {split: self._splits.index(split) for split in SPLITS if split in self._splits}
        info = {
            "codebase_version": VERSION,
            "robot_type": f"drakegrasp_{self._hand.name}",
            "total_episodes": len(self._splits),
            "total_frames": self._frames,
            "total_tasks": len(self._tasks),
            "chunks_size": CHUNK,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "fps": self._fps,
            "splits": {
                split: f"{start}:{start + self._splits.count(split)}"
                for split, start in first.items()
            },
            "data_path": f"data/{FILE}.parquet",
            "video_path": f"videos/{{video_key}}/{FILE}.mp4",
            "features": self._features,
        }
        for name, content in (("stats", stats), ("info", info)):
            text = json.dumps(content, indent=4)
            (self._folder / f"meta/{name}.json").write_text(text, encoding="utf-8")

    def _open_part(self) -> pq.ParquetWriter:
        fields, videos = {}, {}
        for name, each in self._features.items():
            if each["dtype"] == "video":
                videos[name] = _Video(self._path(f"videos/{name}", "mp4"), self._fps, each["shape"])
            else:
                kind, (size,) = pa.type_for_alias(each["dtype"]), each["shape"]
                fields[name] = pa.list_(kind, size) if each["names"] else kind
        self._videos, self._length, self._episodes = videos, 0, []
        self._data = pq.ParquetWriter(self._path("data", "parquet"), pa.schema(fields))
        return self._data

    def _close_part(self) -> None:
        """Complete the files of a part, if one is open."""
        if self._data is None:
            return
        for file in (self._data, *self._videos.values()):
            file.close()
        for name, video in self._videos.items():
            self._counts[name] = self._counts.get(name, 0) + video.counts
        episodes = pa.Table.from_pylist(self._episodes)
        pq.write_table(episodes, self._path("meta/episodes", "parquet"))
        self._data, self._part = None, self._part + 1

    def _path(self, folder: str, suffix: str) -> Path:
        """Return the path of a file of the open part, and create its folder."""
        chunk, file = divmod(self._part, CHUNK)
        path = self._folder / folder / FILE.format(chunk_index=chunk, file_index=file)
        path.parent.mkdir(parents=True, exist_ok=True)
        return path.with_suffix(f".{suffix}")


def _arrow(values: npt.NDArray[Any], kind: pa.DataType) -> pa.Array:
    """Return the n values of a column, (n,) or (n, d)."""
    if not pa.types.is_fixed_size_list(kind):
        return pa.array(values, kind)
    return pa.FixedSizeListArray.from_arrays(pa.array(values.ravel(), kind.value_type), type=kind)


def _number_stats(values: npt.NDArray[Any]) -> dict[str, list[float]]:
    """Return the statistics of the numbers of n frames, (n,) or (n, d)."""
    table = values.reshape(len(values), -1).astype(np.float64)
    quantiles = np.quantile(table, QUANTILES, axis=0)
    return {
        **{name: getattr(table, name)(axis=0).tolist() for name in ("min", "max", "mean", "std")},
        "count": [len(table)],
        **{f"q{q * 100:02.0f}": row.tolist() for q, row in zip(QUANTILES, quantiles, strict=True)},
    }


def _pixel_stats(counts: npt.NDArray[np.int64], frames: int) -> dict[str, list[Any]]:
    """Return the statistics of images from the counts of each value per channel (c, levels).

    Colours are in 0..1, depths in metres, and each statistic has the shape (c, 1, 1).
    """
    levels = np.arange(counts.shape[1]) * (1.0 / 255.0 if len(counts) == 3 else DEPTH_UNIT)
    shares = np.cumsum(counts, axis=1) / counts.sum(axis=1, keepdims=True)
    mean = counts @ levels / counts.sum(axis=1)
    variance = (counts * (levels - mean[:, None]) ** 2).sum(axis=1) / counts.sum(axis=1)
    found = {
        "min": levels[(counts > 0).argmax(axis=1)],
        "max": levels[(shares >= 1.0).argmax(axis=1)],
        "mean": mean,
        "std": np.sqrt(variance),
        **{f"q{q * 100:02.0f}": levels[(shares >= q).argmax(axis=1)] for q in QUANTILES},
    }
    return {name: values.reshape(-1, 1, 1).tolist() for name, values in found.items()} | {
        "count": [frames]
    }
