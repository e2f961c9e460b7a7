"""Pickled dictionaries of strangers, read without running anything.

In: a .npy file whose one element is a Python object, as DexGraspBench writes them. Out: the object,
if it is made of dictionaries, lists, texts, numbers and NumPy arrays; anything else is refused
before it is made.
"""

from __future__ import annotations

import io
import pickle
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from drakegrasp.errors import GraspError, one_line

#: Files of grasps are smaller [bytes].
MOST_BYTES = 64_000_000
#: All that a pickle of NumPy arrays, of NumPy 1 or 2, needs by name.
_ALLOWED = {
    *(
        (f"numpy.{core}.multiarray", name)
        for core in ("core", "_core")
        for name in ("_reconstruct", "scalar")
    ),
    *((f"numpy.{core}.numeric", "_frombuffer") for core in ("core", "_core")),
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("_codecs", "encode"),
}


class _PlainUnpickler(pickle.Unpickler):
    """Refuses every name but those of NumPy's arrays, so nothing else can be called."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ALLOWED:
            raise pickle.UnpicklingError(f"{module}.{name}")
        return super().find_class(module, name)


def read_plain_pickle(path: Path) -> Any:
    """Return the object of a .npy file that holds one.

    Raises:
        GraspError: If the file is none, is too large, or its object is of anything but plain
            values.
    """
    try:
        with path.open("rb") as file:
            data = file.read(MOST_BYTES + 1)
        if len(data) > MOST_BYTES:
            raise GraspError(f"{path}: must be at most {MOST_BYTES:,} bytes, got more")

        # One element, and that a Python object.
        stream = io.BytesIO(data)
        shape, dtype = _header(stream)
        if dtype.hasobject and shape == ():
            found = _PlainUnpickler(stream).load()
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


def _header(file: BinaryIO) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Return the shape and type of the array of a .npy file; the file is then at its data."""
    version = np.lib.format.read_magic(file)
    read = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }
    shape, _, dtype = read[version](file)
    return tuple(shape), dtype
