"""A build warns of what the user should know before it spends hours."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from helpers.entries import object_entry
from helpers.hands import write_pincer

from drakegrasp.config import SplitConfig
from drakegrasp.dataset.manifest import Manifest
from drakegrasp.generation.cautions import nothing_trains, too_heavy
from drakegrasp.hand.settings import load_config
from drakegrasp.objects.sources import MeshSource


def manifest(hand: str, *masses: float) -> Manifest:
    objects = tuple(object_entry(f"{i}_thing", mass=mass) for i, mass in enumerate(masses))
    return Manifest(config=load_config(hand=hand), objects=objects, versions={})


def test_objects_beyond_the_payload_are_named_in_one_line() -> None:
    text = too_heavy(manifest("allegro", 1.0, 0.5, 0.6))
    assert text == (
        "heavier than the payload of the hand allegro, 0.5 kg: 2 of 3 objects (0_thing, 2_thing); "
        "objects.mass makes them lighter"
    )
    assert too_heavy(manifest("allegro", *[1.0] * 30)).count("thing") == 10
    assert too_heavy(manifest("allegro", 0.5)) == ""
    assert too_heavy(manifest("barrett", 1.0)) == ""


def test_a_hand_without_a_payload_has_no_warning(tmp_path: Path) -> None:
    assert too_heavy(manifest(str(write_pincer(tmp_path)), 50.0)) == ""


@pytest.mark.parametrize(
    ("classes", "split", "warning"),
    [
        (["a", "b"], {"by": "class"}, "every class has one object, which is tested"),
        (["a", "b"], {}, ""),
        (["a", "b", "b"], {}, ""),
        (["a", "b"], {"by": "class", "train_classes": ("b",)}, ""),
        (["a", "b"], {"by": "class", "train_classes": ()}, ""),
        (
            ["a", "a"],
            {"by": "class", "train_classes": ("c",)},
            "split.train_classes names none of the classes",
        ),
    ],
)
def test_a_split_that_trains_nothing_is_a_warning(
    classes: list[str], split: dict[str, Any], warning: str
) -> None:
    sources = [
        MeshSource(name=f"{i}_{name}", class_name=name, path=Path("x.obj"))
        for i, name in enumerate(classes)
    ]
    said = nothing_trains(sources, SplitConfig(**split))
    assert bool(said) == bool(warning)
    if said:
        assert said.startswith(f"nothing will train: {warning}. ")
        assert "--per-class" in said and "--set split.train_classes=[a]" in said
