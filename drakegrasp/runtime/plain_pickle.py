"""Pickled dictionaries from untrusted sources, read without running any code.

Input: a .npy file whose one element is a Python object, as DexGraspBench writes them. Output: the
object, if it consists of dictionaries, lists, texts, numbers and NumPy arrays; anything else is
rejected before it is created. NumPy writes such files by the protocols 3 and 4 of pickle.
"""

from __future__ import annotations

import io
import math
import pickle
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from drakegrasp.errors import GraspError, one_line

#: Maximum size of a file of grasps [bytes].
MOST_BYTES = 64_000_000
#: Types of an array: floats, integers, booleans and texts, as NumPy's pickles name them.
_CODE = re.compile(r"f[248]|[iu][1248]|b1|[US][1-9][0-9]{0,6}|O8?")


class _StandIn:
    """What a pickle gets for a NumPy name: a function of ours whose attributes it cannot set."""

    def __init__(self, make: Callable[..., Any]) -> None:
        self._make = make

    def __call__(self, *args: Any) -> Any:
        return self._make(*args)

    def __setstate__(self, state: Any) -> None:
        raise ValueError("a name of NumPy must not be changed")


class _Type:
    """Type of an array; NumPy's own would accept fields and flags that make pointers of bytes."""

    def __init__(self, code: Any, *_: Any) -> None:
        if not isinstance(code, str) or not _CODE.fullmatch(code):
            raise pickle.UnpicklingError(f"numpy.dtype of {str(code)[:40]!r}")
        self.dtype = np.dtype(code)

    def __setstate__(self, state: Any) -> None:
        # Version, byte order, subarray, names, fields; size, alignment and flags follow the code.
        _, order, *parts = state[:5]
        if order not in ("<", ">", "=", "|") or any(part is not None for part in parts):
            raise pickle.UnpicklingError("numpy.dtype with fields")
        self.dtype = self.dtype.newbyteorder(order)


class _Array:
    """A future array: NumPy's pickles create it first and specify its content later."""

    def __init__(self, *_: Any) -> None:
        self.parts: tuple[Any, ...] = ()

    def __setstate__(self, state: Any) -> None:
        _, *self.parts = state


def _array(shape: Any, kind: Any, fortran: Any, data: Any) -> np.ndarray:
    """Return an array all of whose bytes are in the file."""
    shape = shape if isinstance(shape, tuple) else (shape,)
    if not isinstance(kind, _Type) or not all(type(n) is int and n >= 0 for n in shape):
        raise ValueError("an array must have a shape and a type")
    objects = kind.dtype.hasobject
    needed = math.prod(shape) * (1 if objects else kind.dtype.itemsize)
    if not isinstance(data, list if objects else bytes) or len(data) != needed:
        raise ValueError("an array must have as many bytes as its shape says")
    array = np.empty(math.prod(shape), kind.dtype)
    if objects:
        for i, each in enumerate(data):
            array[i] = each
    elif data:
        array[:] = np.frombuffer(bytes(data), kind.dtype)
    array = array.reshape(shape, order="F" if fortran else "C")
    if array.dtype.kind == "U":
        array.tolist()  # raises an error if a number is not a character
    return array


def _scalar(kind: Any, data: Any) -> Any:
    if not isinstance(kind, _Type) or kind.dtype.hasobject:
        raise pickle.UnpicklingError("numpy scalar of another type")
    return _array((), kind, False, data)[()]


#: All names that a file of arrays of NumPy 1 or 2 needs. No value is NumPy's own.
_ALLOWED = {
    ("numpy", "ndarray"): _StandIn(_Array),
    ("numpy", "dtype"): _StandIn(_Type),
    **{
        (f"numpy.{core}.multiarray", name): _StandIn(make)
        for core in ("core", "_core")
        for name, make in (("_reconstruct", _Array), ("scalar", _scalar))
    },
}


class _PlainUnpickler(pickle.Unpickler):
    """Rejects every name except those of NumPy's arrays, and calls replacements for these."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ALLOWED:
            raise pickle.UnpicklingError(f"{module}.{name}")
        return _ALLOWED[module, name]


def _plain(value: Any, made: dict[int, Any]) -> Any:
    """Return a value with its arrays created; an object shared in the pickle is created once."""
    if value is None or isinstance(value, str | bytes | int | float | np.generic):
        return value
    if id(value) not in made:
        if isinstance(value, dict):
            new: Any = {_plain(key, made): _plain(each, made) for key, each in value.items()}
        elif isinstance(value, list | tuple):
            new = type(value)([_plain(each, made) for each in value])
        elif isinstance(value, _Array):
            shape, kind, fortran, data = value.parts
            new = _array(shape, kind, fortran, _plain(data, made))
        else:
            raise pickle.UnpicklingError(type(value).__name__)
        made[id(value)] = new
    return made[id(value)]


def read_plain_pickle(path: Path) -> Any:
    """Return the object of a .npy file that contains one object.

    Raises:
        GraspError: If the file is not such a file, is too large, or its object contains anything
            but plain values.
    """
    try:
        with path.open("rb") as file:
            data = file.read(MOST_BYTES + 1)
        if len(data) > MOST_BYTES:
            raise GraspError(f"{path}: must be at most {MOST_BYTES:,} bytes, got more")

        # The file must have one element, which is a Python object.
        stream = io.BytesIO(data)
        shape, dtype = npy_header(stream)
        if dtype.hasobject and shape == ():
            found = _plain(_PlainUnpickler(stream).load(), {})
            return found.item() if isinstance(found, np.ndarray) else found
    except GraspError:
        raise
    except pickle.UnpicklingError as error:
        raise GraspError(
            f"{path}: must hold dictionaries, texts, numbers and arrays alone, "
            f"got {one_line(error)}; nothing of it was run"
        ) from None
    except OSError as error:
        raise GraspError(f"{path}: must be a readable file, got: {one_line(error)}") from None
    except Exception as error:
        raise GraspError(f"{path}: must be a .npy file, got: {one_line(error)}") from None
    raise GraspError(f"{path}: must hold one dictionary, got an array of {dtype}, shape {shape}")


def npy_header(file: BinaryIO) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Return the shape and type of the array of a .npy file; the file is then at its data."""
    version = np.lib.format.read_magic(file)
    read = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }
    shape, _, dtype = read[version](file)
    return tuple(shape), dtype
