"""Whole drafted hands, compared with stored texts; see `helpers/golden.py`."""

from __future__ import annotations

from pathlib import Path

import pytest
import trimesh
from helpers.golden import Golden, points, rounded
from helpers.vendors import JAWS, JAWS_MJCF, MITTEN, write_model

from drakegrasp.hand_setup import draft_hand


@pytest.mark.parametrize(
    ("name", "text", "suffix"),
    [("jaws", JAWS, "urdf"), ("jaws_mjcf", JAWS_MJCF, "xml"), ("mitten", MITTEN, "urdf")],
)
def test_draft(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    golden: Golden,
    name: str,
    text: str,
    suffix: str,
) -> None:
    """The hand file with its comments, the model, the meshes, notes and findings."""
    monkeypatch.setattr("drakegrasp.hand_setup.GRASPS", ())
    model = write_model(tmp_path / "vendor", text, f"{name}.{suffix}")
    drafted = draft_hand(model, tmp_path / "out")
    lines = [*drafted.notes, *(f"{f.ok} {f.name}: {f.text}" for f in drafted.findings)]
    for path in sorted(drafted.path.parent.rglob("*")):
        if path.suffix in (".yaml", ".urdf"):
            lines += [f"== {path.name}", path.read_text(encoding="utf-8")]
        elif path.suffix == ".obj":
            lines.append(f"{path.name} {points(trimesh.load_mesh(path, process=False).bounds)}")
    golden(f"drafts/{name}", rounded("\n".join(lines).replace(str(tmp_path), "FOLDER")))
