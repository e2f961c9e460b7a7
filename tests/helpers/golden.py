"""Whole outputs that tests compare with stored texts, `tests/golden/NAME.txt`.

`pytest --write-golden` writes the texts anew; then `git diff` shows what has changed.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.text import Text
from scipy.spatial import KDTree

FOLDER = Path(__file__).parents[1] / "golden"
#: A number with decimals, which need only be near.
DECIMAL = re.compile(r"-?\d+\.\d+(?:e[-+]?\d+)?")

Golden = Callable[[str, str], None]


def compare(name: str, text: str, *, write: bool) -> None:
    """Fail at the first line that is not as stored; with `write`, store the text instead."""
    path = FOLDER / f"{name}.txt"
    text = text.rstrip() + "\n"
    if write:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    stored = path.read_text(encoding="utf-8").splitlines()
    for number, (expected, found) in enumerate(zip_longest(stored, text.splitlines()), start=1):
        assert _near(expected, found), f"{path.name}:{number}\nstored: {expected}\nfound:  {found}"


def rounded(text: str) -> str:
    """Return a text whose numbers with decimals have five digits."""
    return DECIMAL.sub(lambda found: short(float(found[0])), text)


def short(value: float) -> str:
    """Return a number with five digits and a decimal; what is only rounding is 0."""
    text = f"{0.0 if abs(value) < 1e-7 else value:#.5g}"
    return f"{text}0" if text.endswith(".") else text


def _near(expected: str | None, found: str | None) -> bool:
    """Return whether lines are equal but for numbers that differ by a thousandth, or 1e-6."""
    if expected is None or found is None or expected == found:
        return expected == found
    numbers = [[float(n) for n in DECIMAL.findall(line)] for line in (expected, found)]
    return DECIMAL.sub("", expected) == DECIMAL.sub("", found) and np.allclose(
        *numbers, rtol=1e-3, atol=1e-6
    )


# Figures.


def drawn(figure: Figure) -> str:
    """Return what a figure shows: positions, limits, words, and the data of all marks."""
    lines = [f"figure {_list(figure.get_size_inches())}", *_texts(figure.texts, "")]
    for legend in figure.legends:
        lines += _legend(legend, "")
    for axes in figure.axes:
        lines += _axes(axes)
    return "\n".join(lines)


def _axes(axes: Axes) -> Iterator[str]:
    limits = f"x {_list(axes.get_xlim())} y {_list(axes.get_ylim())}"
    yield f"axes {_list(axes.get_position().bounds)} {limits}"
    words = (axes.get_title(), axes.get_xlabel(), axes.get_ylabel())
    yield f"  words {words} {axes.get_xscale()}"
    for kind, labels in (("x", axes.get_xticklabels()), ("y", axes.get_yticklabels())):
        if said := [label.get_text() for label in labels if label.get_text()]:
            yield f"  {kind} {said}"
    yield from _texts(axes.texts, "  ")
    if (legend := axes.get_legend()) is not None:
        yield from _legend(legend, "  ")
    for line in axes.lines:
        look = f"{to_hex(line.get_color())} {line.get_marker()} {line.get_linewidth():g}"
        yield f"  line {look} {points(line.get_xydata())}"
    for patch in axes.patches:
        path = patch.get_path().transformed(patch.get_patch_transform())
        yield f"  patch {to_hex(patch.get_facecolor(), True)} {_list(path.get_extents().bounds)}"
    for found in axes.collections:
        colours = [*found.get_facecolor(), *found.get_edgecolor()][:1]
        corners = [np.asarray(path.vertices) for path in found.get_paths()]
        places = points(np.concatenate(corners)) if corners else "none"
        yield f"  {type(found).__name__} {len(corners)} {list(map(to_hex, colours))} {places}"
    for image in axes.images:
        values = np.asarray(image.get_array())
        content = points(values.reshape(-1, values.shape[-1]))
        yield f"  image {values.shape} {_list(image.get_extent())} {content}"


def _texts(texts: Iterable[Text], indent: str) -> Iterator[str]:
    for text in texts:
        if text.get_text():
            where = f"{_list(text.get_position())} {text.get_ha()} {text.get_va()}"
            how = f"{text.get_fontsize():g} {to_hex(text.get_color())}"
            yield f"{indent}text {text.get_text()!r} {where} {how}"


def _legend(legend: Any, indent: str) -> Iterator[str]:
    for handle, text in zip(legend.legend_handles, legend.get_texts(), strict=True):
        colour = _colour(handle)
        yield f"{indent}legend {text.get_text()!r} {colour}"


def _colour(handle: Artist) -> str:
    for get in ("get_facecolor", "get_color"):
        if hasattr(handle, get):
            return str(to_hex(getattr(handle, get)()))
    return type(handle).__name__


def points(values: Any) -> str:
    """Return the points of an array (n, d): all of a few, else their number, mean and ends."""
    found = np.asarray(values, dtype=float)
    if len(found) <= 6:
        return " ".join(map(_list, found))
    whole = np.nanmean(found, axis=0), np.nanmin(found, axis=0), np.nanmax(found, axis=0)
    return f"n={len(found)} " + " ".join(map(_list, (*whole, found[0], found[-1])))


def _list(values: Any) -> str:
    return "(" + ", ".join(short(float(value)) for value in np.ravel(values)) + ")"


# Data.


def flat(value: Any, name: str = "") -> Iterator[str]:
    """Yield a line for each value of nested data; a list of numbers is one value."""
    if isinstance(value, dict):
        for key, part in value.items():
            yield from flat(part, f"{name}/{key}")
    elif isinstance(value, list) and any(isinstance(part, dict | list) for part in value):
        for number, part in enumerate(value):
            yield from flat(part, f"{name}/{number}")
    else:
        yield f"{name} = {value!r}"


# Values of any kind.

#: An array of more numbers is told by its means, and more words by their counts.
FEW = 8
#: Types of what is not told: files, and trees of points that are told.
UNTOLD = (bytes, KDTree)


def told(values: Mapping[str, Any]) -> str:
    """Return lines with the numbers and words of values by their names.

    A large array has a line of means, and many words have their counts.
    """
    return "\n".join(_lines(values, ""))


def _lines(value: Any, name: str) -> Iterator[str]:
    if isinstance(value, Enum):
        value = value.name
    if hasattr(value, "model_dump"):
        value = value.model_dump()
    if is_dataclass(value):
        value = {f.name: getattr(value, f.name) for f in fields(value)}
    if isinstance(value, Mapping):
        for key in value:
            yield from _lines(value[key], f"{name}/{key}" if name else str(key))
    elif isinstance(value, np.ndarray) and value.dtype.names:
        yield from _lines({part: value[part] for part in value.dtype.names}, name)
    elif _is_numbers(value):
        yield f"{name}: {_numbers(np.asarray(value))}"
    elif isinstance(value, list | tuple | np.ndarray):
        if all(isinstance(each, str) for each in value):
            yield f"{name}: {dict(Counter(value)) if len(value) > FEW else [*value]}"
        else:
            for number, each in enumerate(value):
                yield from _lines(each, f"{name}/{number}")
    elif isinstance(value, str | None):
        yield f"{name}: {value!r}"
    elif not isinstance(value, UNTOLD):
        raise TypeError(f"{name}: must be of numbers and words, got a {type(value).__name__}")


def _is_numbers(value: Any) -> bool:
    try:
        return np.asarray(value).dtype.kind in "biuf"
    except ValueError:  # of several lengths
        return False


def _numbers(value: np.ndarray) -> str:
    """Return an array as text: its shape, then its values, or three means and what is not finite.

    The means are of values, of their sizes, and of values with weights that grow from the first, 0,
    to the last, 1.
    """
    if value.size <= FEW:
        return f"{value.shape} {' '.join(map(_number, value.ravel().tolist()))}"
    flat = value.ravel().astype(float)
    here = np.isfinite(flat)
    known, weight = flat[here], np.linspace(0.0, 1.0, flat.size)[here]
    lost = f" without {flat.size - len(known)}" if len(known) < flat.size else ""
    sums = known.sum(), np.abs(known).sum(), known @ weight
    return f"{value.shape}{lost} {' '.join(short(each / max(len(known), 1)) for each in sums)}"


def _number(value: float) -> str:
    return short(value) if isinstance(value, float) and np.isfinite(value) else str(value)
