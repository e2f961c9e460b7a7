"""Plots of a dataset: bars are as long as what they count, names are text."""

from __future__ import annotations

import numpy as np
import pytest

from drakegrasp.pictures.charts import (
    GROUPS,
    MAX_OBJECTS,
    draw_counts,
    draw_distributions,
    draw_objects,
    svg_bytes,
)


def test_bars_are_as_long_as_their_counts() -> None:
    (axes,) = draw_counts({"success": 12, "ray_miss": 3400}, "attempts").axes
    assert [bar.get_width() for bar in axes.patches] == [12, 3400]
    assert [text.get_text() for text in axes.texts] == ["12", "3,400"]
    assert [text.get_text() for text in axes.get_yticklabels()] == ["success", "ray miss"]


def test_objects_are_in_the_order_of_their_grasps() -> None:
    counts = {"held": [1, 9, 4], "precision": [1, 5, 3], "stable": [0, 2, 3]}
    (axes,) = draw_objects(["a", "b", "c"], counts).axes
    assert [text.get_text() for text in axes.get_yticklabels()] == ["b", "c", "a"]
    assert [bar.get_width() for bar in axes.patches] == [9, 4, 1, 5, 3, 1, 2, 3, 0]


def test_the_objects_with_most_grasps_are_drawn() -> None:
    number = MAX_OBJECTS + 7
    counts = {name: list(range(number)) for name in GROUPS}
    figure = draw_objects([f"object {i}" for i in range(number)], counts)
    labels = [text.get_text() for text in figure.axes[0].get_yticklabels()]
    assert len(labels) == MAX_OBJECTS
    assert labels[0] == f"object {number - 1}"
    assert b"<svg" in svg_bytes(figure)


def test_what_is_beyond_a_histogram_is_in_its_last_bin() -> None:
    values = np.append(np.linspace(0.0, 1.0, 99), [50.0, np.nan])
    groups = {"held": np.ones(101, bool), "stable": values < 0.5}
    figure = draw_distributions([("slip [mm]", values)], groups)
    held, stable = (patch.get_data().values for patch in figure.axes[0].patches)
    assert held.sum() == 100
    assert stable.sum() == (values < 0.5).sum()
    assert figure.axes[0].get_xlim()[1] < 2.0


@pytest.mark.parametrize("name", ["<script>alert(1)</script>", "a $x^2$ b", "$", "ä & ö"])
def test_names_are_drawn_as_they_are(name: str) -> None:
    counts = {group: [1] for group in GROUPS}
    svg = svg_bytes(draw_objects([name], counts)).decode()
    assert "<script" not in svg
    assert svg == svg_bytes(draw_objects([name], counts)).decode()
