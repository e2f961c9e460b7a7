"""Dictionaries that NumPy 1 or 2 saved are read as they were; a pickle cannot make a pointer."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drakegrasp.runtime.plain_pickle import read_plain_pickle

CONTENT = {
    "f4": np.arange(6, dtype=np.float32).reshape(2, 3),
    "fortran": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    "big": np.arange(3, dtype=">f8"),
    "nested": {"i8": [np.arange(3), np.array([True, False])], "pair": (1, 2.5, None)},
    "zero_d": np.array(3.5),
    "scalar": np.float32(0.25),
    "int": np.int64(-7),
    "texts": np.array(["mug", "käse"]),
    "objects": np.array(["a", np.arange(2)], dtype=object),
    "none": np.zeros((0, 3)),
    "text": "can",
}
CONTENT["again"] = CONTENT["f4"]
HEADER = {"descr": "|O", "fortran_order": False, "shape": ()}


def boxed(content: Any) -> np.ndarray:
    array = np.empty((), dtype=object)
    array[()] = content
    return array


def write(path: Path, data: bytes) -> Path:
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, HEADER)
        file.write(data)
    return path


def assert_same(found: Any, wanted: Any) -> None:
    assert type(found) is type(wanted)
    if isinstance(wanted, dict):
        assert list(found) == list(wanted)
        for key in wanted:
            assert_same(found[key], wanted[key])
    elif isinstance(wanted, list | tuple) or getattr(wanted, "dtype", None) == "O":
        assert len(found) == len(wanted)
        for one, other in zip(found, wanted, strict=True):
            assert_same(one, other)
    else:
        np.testing.assert_array_equal(found, wanted)
        assert getattr(found, "dtype", None) == getattr(wanted, "dtype", None)


def test_what_numpy_saves_is_read_as_it_was(tmp_path):
    np.save(tmp_path / "a.npy", boxed(CONTENT), allow_pickle=True)
    assert_same(read_plain_pickle(tmp_path / "a.npy"), CONTENT)
    for protocol in (3, 4):
        data = pickle.dumps(boxed(CONTENT), protocol=protocol)
        assert_same(read_plain_pickle(write(tmp_path / "b.npy", data)), CONTENT)


@pytest.mark.parametrize(("core", "other"), [("core", "_core"), ("_core", "core")])
def test_numpy_1_and_2_name_the_same_things(tmp_path, core, other):
    # np.save of NumPy 1 writes protocol 3, whose names are plain lines.
    data = pickle.dumps(boxed(CONTENT), protocol=3)
    data = data.replace(f"cnumpy.{other}.".encode(), f"cnumpy.{core}.".encode())
    assert_same(read_plain_pickle(write(tmp_path / "a.npy", data)), CONTENT)


class Call:
    """A call, with a state for what it returns, as a pickle can say it."""

    def __init__(self, *reduced: Any) -> None:
        self.reduced = reduced

    def __reduce__(self) -> tuple[Any, ...]:
        return self.reduced


def object_field() -> Call:
    """The type V8 whose one field is an object, with flags that do not say so."""
    fields = {"x": (np.dtype("O"), 0)}
    return Call(np.dtype, ("V8", False, True), (3, "|", None, ("x",), fields, 8, 1, 0))


RECONSTRUCT, (SCALAR, _) = np.zeros(1).__reduce__()[0], np.float64(0.0).__reduce__()
ATTACKS = {
    "scalar": lambda: Call(SCALAR, (object_field(), b"A" * 8)),
    "array": lambda: Call(
        RECONSTRUCT, (np.ndarray, (0,), b"b"), (1, (1,), object_field(), False, b"A" * 8)
    ),
    "object scalar": lambda: Call(SCALAR, (np.dtype("O"), b"A" * 8)),
    "object scalar of a list": lambda: Call(SCALAR, (np.dtype("O"), [0.5])),
    "short array": lambda: Call(
        RECONSTRUCT, (np.ndarray, (0,), b"b"), (1, (1000,), np.dtype("f8"), False, b"A" * 8)
    ),
    "zlib": lambda: Call(pickle.loads(b"c_codecs\nencode\n."), ("x", "zlib")),
    "call": lambda: Call(os.mkdir, ("ran",)),
    "state of a name": lambda: Call(RECONSTRUCT, (np.ndarray, (0,), b"b"), {"parts": 1}),
}


@pytest.mark.parametrize("attack", ATTACKS)
def test_pickle_that_makes_a_pointer_is_refused_in_a_line(tmp_path, attack):
    path = write(tmp_path / "a.npy", pickle.dumps({"obj_scale": ATTACKS[attack]()}, protocol=3))
    code = (
        "import sys, pathlib, numpy as np\n"
        "from drakegrasp.errors import GraspError\n"
        "from drakegrasp.runtime.plain_pickle import read_plain_pickle\n"
        "try:\n"
        "    np.asarray(read_plain_pickle(pathlib.Path(sys.argv[1]))['obj_scale'], float)\n"
        "except GraspError as error:\n"
        "    print(error)\n"
    )
    command = [sys.executable, "-c", code, str(path)]
    ran = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert (ran.returncode, ran.stderr) == (0, "")
    assert ran.stdout.startswith(f"{path}: must ")
    assert ran.stdout.count("\n") == 1
    assert not (tmp_path / "ran").exists()
