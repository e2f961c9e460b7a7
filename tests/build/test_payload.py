"""A build says which objects are too heavy for its hand."""

from __future__ import annotations

from pathlib import Path

from helpers.hands import write_pincer

from drakegrasp.build.payload import too_heavy
from drakegrasp.dataset.manifest import Manifest, ObjectEntry
from drakegrasp.hand.settings import load_config


def entry(name: str, mass: float) -> ObjectEntry:
    return ObjectEntry(
        name=name,
        class_name="thing",
        mesh_sha256="0",
        scale=1.0,
        up="+z",
        mass=mass,
        density=1000.0,
        friction=None,
        collision_error=0.0,
        resting=(),
        candidates=1,
        combinations=1,
        valid=1,
        distinct=1,
        notes=(),
    )


def manifest(hand: str, *masses: float) -> Manifest:
    objects = tuple(entry(f"{i}_thing", mass) for i, mass in enumerate(masses))
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
