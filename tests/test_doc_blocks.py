"""Every code block of README and docs is run by a test, or is in a list here that says why not."""

from __future__ import annotations

import os
import re
import shlex
import shutil
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import pytest
import trimesh
import yaml
from helpers.commands import run
from helpers.datasets import BOXES
from helpers.isaac import isaac_grasp, write_isaac
from helpers.meshes import write_fixed
from helpers.tables import table
from helpers.tiers import in_second_tier

from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.rejections import Decisions, write_decisions
from drakegrasp.frames import make_pose
from drakegrasp.hand.settings import load_config
from drakegrasp.objects.sources import find_meshes
from drakegrasp.simulation.fixtures import load_surroundings

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]

#: Lines of plain blocks that are not run as they stand, by how they begin; blocks that are no code,
#: by their first lines; and blocks marked `py`, Python that is not run, by a part of it. And why.
NOT_RUN, NO_CODE, PY_NOT_RUN = (
    table("doc_blocks")[kind] for kind in ("not run", "no code", "py not run")
)
#: Pages whose commands measure for minutes to hours; test_docs.py knows their options.
MEASURED = "docs/results/"
#: A page whose Python blocks are the scripts beside it; test_examples.py runs them.
GALLERY = "docs/examples/index.md"
#: Commands that simulate, which want a dataset that was simulated.
SIMULATED = ("replay", "verify")


@dataclass(frozen=True)
class Block:
    """A fenced block: its page, its line there, its language and its lines."""

    page: str
    line: int
    language: str
    text: str

    @property
    def lines(self) -> list[str]:
        """Without those that are empty, and with those in one that a backslash joins."""
        joined = self.text.replace("\\\n", " ").splitlines()
        return [line.strip() for line in joined if line.strip()]


def blocks() -> list[Block]:
    found = []
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for match in re.finditer(r"^( *)```(\w*)\n(.*?)^ *```$", text, re.DOTALL | re.MULTILINE):
            line = text[: match.start()].count("\n") + 1
            found.append(Block(page.relative_to(ROOT).as_posix(), line, match[2], match[3]))
    return found


BLOCKS = blocks()


def why_not(line: str) -> str | None:
    """Return why a line of a plain block is not run; None if it is."""
    if line.startswith("drakegrasp build ") and "--dry-run" in line:
        return None
    return next((why for start, why in NOT_RUN.items() if line.startswith(start)), None)


def is_code(block: Block) -> bool:
    return not any(block.lines[0].startswith(start) for start in NO_CODE)


#: The lines that are run, each once, with the page and line of their block.
LINES = {
    shlex.join(shlex.split(line, comments=True)): f"{block.page}:{block.line}"
    for block in BLOCKS
    if block.language == "" and not block.page.startswith(MEASURED) and is_code(block)
    for line in block.lines
    if why_not(line) is None
}


def test_fences_are_paired() -> None:
    """Else a block would begin where another ends."""
    for page in PAGES:
        fences = re.findall(r"^ *```.*$", page.read_text(encoding="utf-8"), re.MULTILINE)
        assert len(fences) == 2 * sum(b.page == page.relative_to(ROOT).as_posix() for b in BLOCKS)


def test_every_block_is_run_or_in_a_list() -> None:
    assert len(BLOCKS) > 60
    for block in BLOCKS:
        where = f"{block.page}:{block.line}"
        # Python: test_docs.py runs the blocks of a page. XML: the hand of the tutorial. Text:
        # formulas.
        if block.language == "py" and block.page == GALLERY:
            continue
        if block.language == "py":
            assert any(part in block.text for part in PY_NOT_RUN), where
        elif block.page.startswith(MEASURED):
            assert block.language == "", where
        elif block.language == "":
            known = [line for line in block.lines if line.startswith("drakegrasp ")]
            if is_code(block):
                rest = [line for line in block.lines if line not in known]
                assert not [line for line in rest if why_not(line) is None], where
        else:
            assert block.language in ("python", "toml", "yaml", "xml", "text"), where


def test_lists_name_nothing_that_is_gone() -> None:
    texts = "\n".join(line for block in BLOCKS for line in ["", *block.lines])
    for start in (*NOT_RUN, *NO_CODE):
        assert f"\n{start}" in texts, start
    for part in PY_NOT_RUN:
        assert any(part in block.text for block in BLOCKS if block.language == "py"), part


def test_yaml_blocks_are_read(tmp_path: Path) -> None:
    """As what each is; the hand file is the tutorial's."""
    kinds = []
    for block in BLOCKS:
        if block.language != "yaml":
            continue
        content = yaml.safe_load(block.text)
        if "objects" in content:
            kinds.append("objects")
            for name in content["objects"]:
                trimesh.creation.box([0.05, 0.05, 0.1]).export(tmp_path / f"{name}.stl")
            (tmp_path / "objects.yaml").write_text(block.text, encoding="utf-8")
            said = next(iter(content["objects"].values()))
            (source,) = find_meshes(tmp_path)
            assert (source.name, source.class_name, source.up, source.licence) == tuple(
                said[key] for key in ("name", "class", "up", "licence")
            )
        elif "extent" in content:
            kinds.append("surroundings")
            path = tmp_path / "mine.yaml"
            path.write_text(block.text, encoding="utf-8")
            if "model" in content:
                (model,) = (b for b in BLOCKS if b.page == block.page and b.language == "xml")
                (tmp_path / content.pop("model")).write_text(model.text, encoding="utf-8")
            own = load_surroundings(path)
            assert {key: own.tree()[key] for key in content} == content and own.boxes
        elif "fingers" in content:
            kinds.append("hand")
        else:
            kinds.append("config")
            path = tmp_path / "mine.yaml"
            path.write_text(block.text, encoding="utf-8")
            assert load_config(str(path)).to_dict() != load_config().to_dict()
    assert sorted(kinds) == ["config", "hand", "objects", *["surroundings"] * 2]


def meshes(folder: Path) -> Path:
    """Write two meshes in centimetres."""
    folder.mkdir()
    for name in ("1_box_a", "2_box_b"):
        trimesh.creation.box(100.0 * np.array(BOXES[name][0])).export(folder / f"{name}.stl")
    return folder


@pytest.mark.parametrize(
    "line",
    # All figures are drawn once.
    [
        in_second_tier(line) if line.startswith("drakegrasp figures OUT --out") else line
        for line in LINES
        if line.split()[1] not in SIMULATED
    ],
    ids=lambda line: f"{LINES[line]} {line[:40]}",
)
def test_commands_of_the_docs_run(
    line: str, sound: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    out = Path(shutil.copytree(sound, tmp_path / "OUT"))
    if "MESHES" in line and not line.startswith("drakegrasp export "):
        meshes(tmp_path / "MESHES")
    for folder in (out, tmp_path):
        write_decisions(folder / "reject.json", Decisions())

    # `a|b|c` stands for each of them.
    words = shlex.split(line)[1:]
    choices = next((word.split("|") for word in words if "|" in word), [""])
    for choice in choices:
        done = run(*(choice if "|" in word else word for word in words))
        assert done.exit_code == 0, f"{LINES[line]}: {done.output}"
        if "FOLDER" in words:
            assert any((tmp_path / "FOLDER").iterdir())
            shutil.rmtree(tmp_path / "FOLDER")


@pytest.mark.nightly
@pytest.mark.sim
@pytest.mark.slow
@pytest.mark.parametrize(
    "line",
    [line for line in LINES if line.split()[1] in SIMULATED],
    ids=lambda line: f"{LINES[line]} {line[:40]}",
)
def test_commands_that_simulate_run(
    line: str, small_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "demo").mkdir()
    for name in ("OUT", "demo/dataset"):
        os.symlink(small_dataset, tmp_path / name, target_is_directory=True)
    data = GraspDataset(small_dataset / "grasping_oto.hdf5", split="test")
    words = shlex.split(line)[1:]

    # The numbers of trials in the docs are of other datasets.
    if "--trial" in words:
        words[words.index("--trial") + 1] = str(data[0].trial_id)

    # Predictions: of the dataset a stored grasp, of a mesh one of its sides.
    if "--object" in words:
        write_fixed(tmp_path, "10_box_tall")
        box = trimesh.load_mesh(tmp_path / "10_box_tall.obj")
        box.apply_scale(100.0).export(tmp_path / "mug.obj")
        x = box.extents[0] / 200.0
        grasp = [x, 0.01, 0.0, x, -0.01, 0.0, -x, 0.0, 0.0, 1, 0, 0, 1, 0, 0, -1, 0, 0]
        np.save(tmp_path / "predictions.npy", np.array([grasp]))
    elif "predictions.npy" in words:
        grasps = data.column("grasps")
        grasps[1:, :9] += 0.03  # [m]; off the surface, which is known without a simulation
        np.save(tmp_path / "predictions.npy", grasps)
    # Palm poses as GraspGen writes them: one from above, of a mesh and of an object of the dataset.
    above = isaac_grasp(make_pose(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 0.2]))
    name = str(data.column("object_props/object_name")[0])
    for path in (tmp_path / "mug.yaml", tmp_path / "PREDICTED" / f"{name}.yaml"):
        write_isaac(path, grasp_0=above)
    with h5py.File(tmp_path / "predictions.h5", "w") as file:
        file["test/grasps"], file["test/rows"] = data.column("grasps")[:1], np.array([0])

    done = run(*words)
    assert done.exit_code == 0, f"{LINES[line]}: {done.output}"
    for option in ("--html", "--out"):
        if option in words:
            assert list(tmp_path.glob(f"{words[words.index(option) + 1]}*"))
