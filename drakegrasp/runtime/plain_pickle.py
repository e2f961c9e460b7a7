"""Pickled dictionaries of strangers, read without running anything.

In: a .npy file whose one element is a Python object, as DexGraspBench writes them. Out: the object,
if it is made of dictionaries, lists, texts, numbers and NumPy arrays; anything else is refused
before it is made.
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

#: Files of grasps are smaller [bytes].
MOST_BYTES = 64_000_000
#: The types of an array: floats, integers, booleans and texts, as NumPy's pickles name them.
_CODE = re.compile(r"f[248]|[iu][1248]|b1|[US][1-9][0-9]{0,6}|O8?")


class _StandIn:
    """What a pickle gets for a name of NumPy's: a call of ours, whose attributes it cannot set."""

    def __init__(self, make: Callable[..., Any]) -> None:
        self._make = make

    def __call__(self, *args: Any) -> Any:
        return self._make(*args)

    def __setstate__(self, state: Any) -> None:
        raise ValueError("a name of NumPy must not be changed")


class _Type:
    """A type of an array; NumPy's own would take fields and flags that make pointers of bytes."""

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
    """An array to be: NumPy's pickles make it first and say later what is in it."""

    def __init__(self, *_: Any) -> None:
        self.parts: tuple[Any, ...] = ()

    def __setstate__(self, state: Any) -> None:
        _, *self.parts = state


def _buffered(data: Any, kind: Any, shape: Any, order: Any, *_: Any) -> _Array:
    """Stand in for `_frombuffer` of NumPy, by which pickles of protocol 5 make arrays."""
    if order not in ("C", "F"):
        raise ValueError(f"order of an array must be C or F, got {order!r}")
    array = _Array()
    array.parts = (shape, kind, order == "F", data)
    return array


def _array(shape: Any, kind: Any, fortran: Any, data: Any) -> np.ndarray:
    """Return an array of which each byte is in the file."""
    shape = shape if isinstance(shape, tuple) else (shape,)
    if not isinstance(kind, _Type) or not all(type(n) is int and n >= 0 for n in shape):
        raise ValueError("an array must have a shape and a type")
    objects = kind.dtype.hasobject
    needed = math.prod(shape) * (1 if objects else kind.dtype.itemsize)
    if not isinstance(data, list if objects else bytes | bytearray) or len(data) != needed:
        raise ValueError("an array must have as many bytes as its shape says")
    if objects:
        array = np.empty(len(data), dtype=object)
        for i, each in enumerate(data):
            array[i] = each
        return array.reshape(shape, order="F" if fortran else "C")
    array = np.frombuffer(bytes(data), kind.dtype) if data else np.empty(0, kind.dtype)
    array = array.reshape(shape, order="F" if fortran else "C").copy(order="K")
    if array.dtype.kind == "U":
        array.tolist()  # raises where a number is no character
    return array


def _scalar(kind: Any, data: Any) -> Any:
    if not isinstance(kind, _Type) or kind.dtype.hasobject:
        raise pickle.UnpicklingError("numpy scalar of another type")
    return _array((), kind, False, data)[()]


def _encode(text: Any, encoding: Any) -> bytes:
    """Stand in for `_codecs.encode`, by which old protocols write bytes; others run zlib."""
    if encoding != "latin1" or not isinstance(text, str):
        raise pickle.UnpicklingError(f"_codecs.encode to {str(encoding)[:40]!r}")
    return text.encode("latin1")


#: All that a pickle of NumPy arrays, of NumPy 1 or 2, needs by name. None of it is NumPy's own.
_ALLOWED = {
    ("numpy", "ndarray"): _StandIn(_Array),
    ("numpy", "dtype"): _StandIn(_Type),
    ("_codecs", "encode"): _StandIn(_encode),
    **{
        (f"numpy.{core}.{module}", name): _StandIn(make)
        for core in ("core", "_core")
        for module, name, make in (
            ("multiarray", "_reconstruct", _Array),
            ("multiarray", "scalar", _scalar),
            ("numeric", "_frombuffer", _buffered),
        )
    },
}


class _PlainUnpickler(pickle.Unpickler):
    """Refuses every name but those of NumPy's arrays, and calls stand-ins for these."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ALLOWED:
            raise pickle.UnpicklingError(f"{module}.{name}")
        return _ALLOWED[module, name]


def _plain(value: Any, made: dict[int, Any]) -> Any:
    """Return a value with its arrays made; what the pickle has once is made once."""
    if value is None or isinstance(value, str | bytes | bytearray | int | float | np.generic):
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
    """Return the object of a .npy file that holds one.

    Raises:
        GraspError: If the file is not one, is too large, or its object is of anything but plain
            values.
    """
    try:
        with path.open("rb") as file:
            data = file.read(MOST_BYTES + 1)
        if len(data) > MOST_BYTES:
            raise GraspError(f"{path}: must be at most {MOST_BYTES:,} bytes, got more")

        # One element, and that a Python object.
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
