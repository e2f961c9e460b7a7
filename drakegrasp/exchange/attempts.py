"""Reads and writes files of postures, in our own layouts and those of other tools, as attempts.

Input: a file or a folder of files, their hand, and the object or dataset rows that they are for.
Output: one `GraspTable`, or an error in one line that names the file and the mistake. Each
format is an importer in the registry, found by the suffix of the file, which returns the arguments
of `make_attempts`, and what of these is not for the table: `BESIDE`. This module reads our own
layouts; the layouts of other tools are read by the modules named after them.
docs/how-to/postures.md lists all layouts.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from drakegrasp import __version__, registry
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.errors import (
    DrakegraspError,
    GraspError,
    HandError,
    listed,
    one_line,
)
from drakegrasp.exchange import columns
from drakegrasp.exchange.columns import (
    ARRAYS,
    CONTACTS,
    HDF5_SUFFIXES,
    array_names,
    is_graspgen,
    read_contacts,
)
from drakegrasp.frames import Array, as_numbers, unpack_pose
from drakegrasp.hand.description import Hand
from drakegrasp.protocols.postures import is_grasp_file
from drakegrasp.runtime.files import atomic_path
from drakegrasp.simulation.attempts import (
    CONDITIONS,
    UNTOLD,
    GraspTable,
    join_attempts,
    make_attempts,
    quaternion_poses,
    read_confidence,
    taken,
)
from drakegrasp.verification.prediction import ContactRows, choose_rows, read_grasps, read_several

#: Values that a file states once for all its rows.
_OF_FILE = ("frame", "link", "joints", "hand", "gripper", "of_objects")
#: Suffixes of YAML files.
YAMLS = (".yaml", ".yml")
#: What an importer may say besides the arguments of `make_attempts`: the name of the hand; what
#: another tool calls it; (n,) trials from which samples were exported; whether each grasp is for
#: its object in any pose.
BESIDE = ("hand", "gripper", "trial", "of_objects")
#: Words that the names of many hands have.
_COMMON_WORDS = {"hand", "palm", "gripper", "base", "link", "left", "right", "model", "robot"}
#: The arrays of our own layout that are neither poses nor joints.
_TEXTS = ("object", "joints", "source", "frame", "link", "preshape")
_SCALARS = ("resting", "scale")
_KNOWN = (
    *_TEXTS,
    *("X_FG", "position", "quaternion", "q_grasp", "q_pregrasp", "q_squeeze"),
    *_SCALARS,
    *CONDITIONS,
    *("X_TC", "X_TO", "row", "confidence", "q_arm"),
)


def read_predictions(
    path: Path,
    hand: Hand,
    *,
    of: str | GraspDataset,
    split: str | None = None,
    several: bool = False,
    read_as: Mapping[str, str] | None = None,
) -> GraspTable | ContactRows:
    """Return the postures or the contacts of a file as a table; contacts do not name their objects.

    Args:
        path: The file, or a folder of files of postures.
        hand: The hand.
        of: See `read_attempts`; contacts are all for this object, or for the rows of this split.
        split: Name of the group to read in an HDF5 file of contacts; if `of` is a split of a
            dataset, the group of this split is read.
        several: Whether the contacts are for rows of a dataset, of which each may have several
            grasps (n, m, 6k), with a confidence.
        read_as: See `read_attempts`.

    Raises:
        GraspError: If the file has no contacts or postures of this hand.
        DataError: If the dataset cannot be used.
        MachineError: If a package is missing that the format needs.
    """
    if holds_postures(path):
        return read_attempts(path, hand, of=of, read_as=read_as)
    data = of if isinstance(of, GraspDataset) else None
    said = read_contacts(path, split=data.split if data else split, axes=3 if several else 2)
    with named(path):
        if several and data is not None:
            return read_several(**said, fingers=hand.num_fingers, data=data)
        table = read_grasps(said["grasps"], hand.num_fingers, rows=said["rows"])
        if (stated := said["confidence"]) is None:
            return table
        return replace(table, confidence=read_confidence(stated, (len(table),)))


def read_attempts(
    path: Path,
    hand: Hand,
    *,
    of: str | GraspDataset | None = None,
    read_as: Mapping[str, str] | None = None,
) -> GraspTable:
    """Return the postures of a file, or of a folder of files, as a table.

    An invalid row stays in the table, with the reason. An invalid file of a folder is one such row.

    Args:
        path: The file or the folder.
        hand: The hand.
        of: Name of the object of rows that do not name one, or the split of a dataset whose rows
            the grasps are for; None: each row must name its object. For a split, the file may have
            a column `row`, or one grasp per row of the split, or exported samples, of which those
            of the split are used, or grasps that only name their object, each of which is used for
            every row of this object. Objects, and the camera for grasps in the frame "camera", are
            those of the rows, and `GraspTable.of_row` has the row numbers.
        read_as: Values for all postures. `frame` and `link` replace those of the file; `preshape`
            is used for rows that do not name one.

    Raises:
        GraspError: If the file has no postures of this hand, or does not name an object.
        DataError: If the dataset cannot be used.
        MachineError: If a package is missing that the format needs.
    """
    read_as = read_as or {}
    if isinstance(of, GraspDataset):
        return _for_rows(path, hand, of, read_as)
    if not path.is_dir():
        with named(path):
            return _made(hand, _named(_raw(path, hand, read_as), of))
    found = list[GraspTable | str]()
    for each in files_in(path):
        try:
            with named(each):
                found.append(_made(hand, _named(_raw(each, hand, read_as), of)))
        except GraspError as error:
            found.append(str(error))
    return join_attempts(found)


def _raw(path: Path, hand: Hand, read_as: Mapping[str, str]) -> dict[str, Any]:
    """Return what the importer of a file says, with the values of the caller.

    Raises:
        GraspError: If the file is not a file of postures.
        MachineError: If a package is missing that the format needs.
    """
    if not path.is_file():
        raise GraspError(f"postures must be a file or a folder of files, got {str(path)!r}")

    # Importers of other packages are asked first; they return None for a file that is not theirs.
    for name in reversed(registry.names("importers")):
        if Path(name).suffix == path.suffix.lower():
            try:
                raw = registry.find("importers", name)(path, hand)
                if raw is not None:
                    return _as_asked({**raw, "objects": list(raw["objects"])}, read_as)
            except DrakegraspError:
                raise
            except (Exception, SystemExit) as error:
                got = f"{type(error).__name__} ({one_line(error)})"
                owned = registry.with_owner("importers", name)
                raise GraspError(f"must be readable by the importer {owned}, got {got}") from error
    raise GraspError(f"must be a file of postures ({', '.join(suffixes())}), got another")


def _as_asked(raw: dict[str, Any], read_as: Mapping[str, str]) -> dict[str, Any]:
    """Return the content of a file, with the values of the caller, see `read_attempts`."""
    if "frame" in read_as:
        raw["frame"] = read_as["frame"]
    if read_as.get("frame") == "object" and raw.get("scale") is not None:
        # Meshes in {O} are exported in metres, so a scale of 1 does not refer to the source mesh.
        raw["scale"] = np.where(np.asarray(raw["scale"]) == 1.0, np.nan, raw["scale"])
    if "link" in read_as:
        # A caller who names the frame of the poses knows the gripper.
        raw |= {"link": _link([read_as["link"]]), "gripper": None}
    if shape := read_as.get("preshape"):
        named = raw.get("preshape") or [""] * len(raw["objects"])
        raw["preshape"] = [name or shape for name in named]
    return raw


def suffixes() -> tuple[str, ...]:
    """Return the suffixes of files of postures."""
    return tuple(dict.fromkeys(Path(name).suffix for name in registry.names("importers")))


def read_arrays(path: Path, hand: Hand) -> dict[str, Any]:
    """Return the postures of arrays in our own layout."""
    return _of_arrays(columns.read_arrays(path))


def write_attempts(
    path: Path, table: GraspTable, hand: Hand, *, arm_joints: Sequence[str] = ()
) -> None:
    """Write postures as an HDF5 file of arrays in our own layout, which `read_attempts` reads.

    Attributes of the file state the hand and the version of drakegrasp, and the joints of an arm.
    `link` is not written, since the poses are those of the palm frame.

    Args:
        path: The file; an older one is replaced.
        table: Postures with joints, in a frame whose poses do not need the mesh file.
        hand: The hand.
        arm_joints: (a,), names of the joints of `q_arm`.

    Raises:
        GraspError: If a row is not a valid posture.
        OSError: If the file cannot be written.
    """
    if bad := table.refused:
        raise GraspError(f"postures must be valid to be written: {bad}")
    texts = {
        "object": table.objects,
        "joints": hand.joint_order,
        "source": table.said,
        "preshape": table.preshape if any(table.preshape) else None,
    }
    numbers = {
        "q_pregrasp": table.q_pregrasp,
        "q_squeeze": table.q_squeeze,
        "X_TO": table.X_TO,
        "scale": table.scale,
        **dict(zip(CONDITIONS, table.conditions.T, strict=True)),
    }
    arrays = {
        "X_FG": table.X_FG,
        "q_grasp": table.q_grasp,
        **{name: values for name, values in numbers.items() if not np.isnan(values).all()},
        "X_TC": table.X_TC,
        "resting": None if (table.resting == UNTOLD).all() else table.resting,
        "row": table.of_row,
        "confidence": table.confidence,
        "q_arm": table.q_arm,
    }

    # Columns without values are left out.
    with atomic_path(path) as temporary, h5py.File(temporary, "w") as file:
        file["frame"] = table.frame
        file.attrs.update({"hand": hand.name, "drakegrasp": __version__})
        if arm_joints:
            file.attrs["arm_joints"] = json.dumps(arm_joints)
        for name, words in texts.items():
            if words is not None:
                file[name] = np.array(words, dtype=h5py.string_dtype())
        for name, values in arrays.items():
            if values is not None:
                file[name] = values


def _named(raw: dict[str, Any], of: str | None) -> dict[str, Any]:
    """Return the rows, each with an object name; `of` is the name for rows that have none."""
    objects = [name or of or "" for name in raw["objects"]]
    if not any(objects):
        raise GraspError("postures must name an `object` in each row, got none")
    return {**raw, "objects": objects, "of_row": None}


def _made(hand: Hand, raw: dict[str, Any]) -> GraspTable:
    """Return the table of the content of a file."""
    told = raw.get("hand")
    if told not in (None, hand.name):
        raise GraspError(f"hand must be {told}, as the file says, got {hand.name} (--hand)")
    if (gripper := raw.get("gripper")) and not _is_called(hand, str(gripper)):
        raise GraspError(
            f"grasps must be of the hand {hand.name} (--hand), got those of the gripper {gripper}: "
            "if both are the same, name the frame of the poses (--link)"
        )
    said = {name: value for name, value in raw.items() if name not in BESIDE}
    try:
        return make_attempts(hand, **said)
    except (HandError, TypeError, ValueError) as error:
        raise GraspError(one_line(error)) from None


def _is_called(hand: Hand, gripper: str) -> bool:
    """Return whether a gripper of another tool has a word of the hand's names in its name."""
    names = f"{hand.name} {hand.model.path.stem} {hand.palm_link}".lower()
    words = set(re.findall(r"[a-z0-9]{3,}", names)) - _COMMON_WORDS
    return any(word in gripper.lower() for word in words)


def _for_rows(path: Path, hand: Hand, data: GraspDataset, read_as: Mapping[str, str]) -> GraspTable:
    """Return the postures that are for rows of a split, see `read_attempts`."""
    tables, files = list[GraspTable](), files_in(path) if path.is_dir() else [path]
    without = set[str]()
    for each in files:
        with named(each):
            told = _raw(each, hand, read_as)
            raw = _of_split(told, data)
            if raw.get("of_objects"):
                without |= set(told["objects"]) - set(raw["objects"])
            if len(raw["objects"]):
                # The confidences of different files cannot be compared, unless each file is for
                # objects of its own.
                kept = len(files) == 1 or raw.get("of_objects")
                known = raw if kept else {**raw, "confidence": None}
                tables.append(_on_rows(known, data, hand))
    if not tables:
        raise GraspError(
            f"{path}: samples must be of {data.split} in {data.path.name} (--split), got none"
        )
    table = join_attempts(tables) if len(tables) > 1 else tables[0]
    return replace(table, without_rows=tuple(sorted(without)))


def _of_split(raw: dict[str, Any], data: GraspDataset) -> dict[str, Any]:
    """Return the postures that are for rows of the split, with these rows.

    The row of an exported sample is found by its trial. A grasp for an object is repeated for each
    row of this object. Postures that all name an object are also for objects, unless there is one
    for each row of the split. Other postures are returned unchanged.
    """
    told, column = raw["objects"], "object_props/object_name"
    of_objects = raw.get("of_objects") or (
        all(told) and len(told) != len(data) and "trial" not in raw and raw.get("frame") != "camera"
    )
    if raw.get("of_row") is not None or not (of_objects or "trial" in raw):
        return raw
    if not of_objects:
        if raw["trial"] is None:
            return raw
        told, column = np.asarray(raw["trial"]).tolist(), "trial_id"

    # Repeat each posture for each of its rows.
    rows_of = dict[Any, list[int]]()
    for row, one in enumerate(data.column(column).tolist()):
        rows_of.setdefault(one, []).append(row)
    pairs = [(i, row) for i, one in enumerate(told) for row in rows_of.get(one, ())]
    there = [i for i, _ in pairs]
    known = {
        name: value if value is None or name in _OF_FILE else taken(value, there)
        for name, value in raw.items()
    }
    of_row = np.array([row for _, row in pairs], np.int64)
    return {**known, "of_row": of_row, "of_objects": of_objects}


def _on_rows(raw: dict[str, Any], data: GraspDataset, hand: Hand) -> GraspTable:
    """Return the postures of a file with the objects and cameras of their rows."""
    if raw.get("X_TC") is not None:
        raise GraspError("X_TC must be left out: the camera is that of the row; got it")
    said = "`row` in the file says for which row each is, or `object` for which object"
    rows = choose_rows(data, raw.get("of_row"), len(raw["objects"]), said=said)

    # Object and camera of each row.
    objects = data.column("object_props/object_name")[rows].tolist()
    X_TC = unpack_pose(data.column(f"object_props/frame_work2cam_{data.camera}")[rows])
    other = [
        f"object must be that of row {row}, {true}, got {told}" if told not in ("", true) else ""
        for row, told, true in zip(rows.tolist(), raw["objects"], objects, strict=True)
    ]
    camera = X_TC if raw.get("frame") == "camera" else None
    made = _made(hand, {**raw, "objects": objects, "X_TC": camera, "of_row": rows})
    return made.refuse(other)


@contextmanager
def named(path: Path) -> Iterator[None]:
    """Put the name of a file before errors about its postures, unless they begin with it."""
    try:
        yield
    except GraspError as error:
        text = str(error)
        raise GraspError(text if text.startswith(str(path)) else f"{path}: {text}") from None


def holds_postures(path: Path) -> bool:
    """Return whether a file holds postures; otherwise it holds predictions of contacts.

    A folder always holds postures, because predictions of contacts are single files.

    Raises:
        GraspError: If the file cannot be read.
    """
    if path.is_dir():
        return True
    suffix = path.suffix.lower()
    try:
        if suffix == ".npy" and path.is_file():
            return is_grasp_file(path)
        if suffix in HDF5_SUFFIXES and path.is_file():
            there = set(array_names(path))
            return bool(there & {"q_grasp", "X_FG", "quaternion", "object", "qw"}) or is_graspgen(
                there
            )
    except Exception as error:  # parsers raise all kinds of exceptions on foreign bytes
        raise GraspError(f"{path}: {one_line(error)}") from None
    return suffix in suffixes() and suffix not in CONTACTS


def has_rows(path: Path) -> bool:
    """Return whether a file of postures states the dataset row of each posture.

    Raises:
        GraspError: If the file cannot be read.
    """
    with named(path):
        known = path.is_file() and path.suffix.lower() in ARRAYS
        return known and "row" in array_names(path)


def files_in(folder: Path) -> list[Path]:
    """Return the files of the first layout that a folder and its subfolders have.

    Raises:
        GraspError: If there are no such files.
    """
    known = (".npy", *YAMLS, *ARRAYS)
    others = [(suffix,) for suffix in suffixes() if suffix not in known]
    for group in ((".npy",), YAMLS, *others):
        paths = (path for path in folder.rglob("*") if path.suffix.lower() in group)
        if found := sorted(paths):
            return found
    raise GraspError(f"{folder}: must hold .npy or .yaml files of grasps, got none")


def digest_of(path: Path) -> str:
    """Return the SHA-256 of a file, or of all files of postures in a folder."""
    if path.is_file():
        return _sha256(path).hex()
    return hashlib.sha256(b"".join(map(_sha256, files_in(path)))).hexdigest()


def _sha256(path: Path) -> bytes:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").digest()


# Arrays


def _of_arrays(arrays: Mapping[str, Any]) -> dict[str, Any]:
    """Return the rows of our own layout."""
    if unknown := [name for name in arrays if name not in _KNOWN]:
        others = ", ".join(f"{name!r} of shape {np.shape(arrays[name])}" for name in unknown)
        raise GraspError(
            f"arrays must be some of {', '.join(_KNOWN)}, got {others}; contact points and normals "
            "go into a .npy file, or as `grasps` into an HDF5 file"
        )
    if "X_FG" not in arrays and not {"position", "quaternion"} <= set(arrays):
        there = listed(sorted(arrays))
        raise GraspError(f"X_FG (or position and quaternion) must be there, got only {there}")
    if "X_FG" in arrays and not {"position", "quaternion"}.isdisjoint(arrays):
        raise GraspError("poses must be X_FG, or position and quaternion, got both")
    texts = {name: _texts(arrays[name], name) for name in _TEXTS if name in arrays}

    # The palm poses, in either form.
    invalid = None
    if "X_FG" in arrays:
        X_FG = _stacked(arrays["X_FG"], "X_FG")
    else:
        X_FG, invalid = quaternion_poses(arrays["position"], arrays["quaternion"])
    numbers = {name: arrays[name] for name in _SCALARS if name in arrays}
    if "X_TO" in arrays:
        numbers["X_TO"] = _stacked(arrays["X_TO"], "X_TO")

    stages = ("q_grasp", "q_pregrasp", "q_squeeze")
    return {
        "objects": texts["object"] if "object" in texts else [""] * len(X_FG),
        "X_FG": X_FG,
        "link": _link(texts.get("link")),
        "frame": _only(texts.get("frame"), "frame") or "object",
        **{name: arrays[name] for name in stages if name in arrays},
        "joints": texts.get("joints"),
        "X_TC": None if "X_TC" not in arrays else _stacked(arrays["X_TC"], "X_TC"),
        **numbers,
        **_conditions(arrays, len(X_FG)),
        "said": texts.get("source"),
        "invalid": invalid,
        "of_row": arrays.get("row"),
        "confidence": arrays.get("confidence"),
        "preshape": texts.get("preshape"),
    }


def _conditions(columns: Mapping[str, Any], count: int) -> dict[str, Any]:
    """Return the conditions (n, 3) of the rows as a keyword; empty if there are no such columns."""
    if not set(CONDITIONS) & set(columns):
        return {}
    must, unknown = f"{', '.join(CONDITIONS)} must be {count} numbers each", np.full(count, np.nan)
    told = [as_numbers(columns.get(name, unknown), must) for name in CONDITIONS]
    if any(each.shape != (count,) for each in told):
        raise GraspError(f"{must}, got other shapes")
    return {"conditions": np.column_stack(told)}


def _texts(value: Any, name: str) -> list[str]:
    array = np.atleast_1d(np.asarray(value))
    if array.dtype.kind == "S":
        array = np.char.decode(array, "utf-8", "replace")
    if array.ndim != 1 or array.dtype.kind not in "UO":
        raise GraspError(f"{name} must be texts, got {array.dtype} of shape {array.shape}")
    return [str(each) for each in array.tolist()]


def _only(values: Sequence[str | None] | None, name: str) -> str | None:
    """Return the text that all rows of a column share, or None if the column has no rows."""
    different = {value or "" for value in values or ()}
    if len(different) > 1:
        raise GraspError(f"{name} must be the same in all rows, got {', '.join(sorted(different))}")
    return different.pop() if different else None


def _link(values: Sequence[str | None] | None) -> str | None:
    """Return the link that a column names; None for the palm frame ("palm" in our files)."""
    name = _only(values, "link")
    return None if name in (None, "", "palm") else name


def _stacked(value: Any, name: str) -> Array:
    """Return poses (n, 4, 4) from numbers (n, 4, 4), (n, 3, 4) or (n, 12)."""
    X = as_numbers(value, f"{name} must be poses, 4 x 4 numbers each")
    if X.ndim == 3 and X.shape[1:] == (3, 4):
        X = X.reshape(len(X), 12)
    if X.ndim == 2 and X.shape[1] == 12:
        X = unpack_pose(X)
    if X.ndim != 3 or X.shape[1:] != (4, 4):
        raise GraspError(f"{name} must be of shape (n, 4, 4), got {X.shape}")
    return X
