"""Damage meshes and hands at random; every reader must accept them, or reject them in one line.

\b
    python pipelines/measurements/fuzz_models.py --meshes 200 --hands 100 --seed 0 > models.jsonl

A mesh is a small solid with geometric faults (missing, doubled and reversed faces, NaN, indices
that do not exist). It is written as OBJ, STL (text, binary), PLY (text, binary), GLB or OFF, and
then damaged as a file: bits, ends, numbers, lines, headers, another format's name, another kind of
file. `drakegrasp audit` reads it. A hand is one of the package's hands with a damaged hand file,
model or mesh; it is loaded and checked without trial grasps. Or it is a vendor's URDF, SDFormat or
MJCF model, which is read as `hand new` reads it. The script prints a line of JSON for each finding,
as `fuzz_files.py` does. The exit code is 1 if there is a finding.
"""  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)

from __future__ import annotations

import json
import random
import re
import shutil
import struct
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import click
import numpy as np
import trimesh
from fuzz_files import change_tree, flip, judge, other_kind, preload, read, say_findings, truncate

from drakegrasp.cli.main import main as command
from drakegrasp.hand.checks import check_geometry, check_limits
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.draft.source import read_model
from drakegrasp.hand.draft.urdf import write_urdf
from drakegrasp.hand.files import MODELS
from drakegrasp.hand.shapes import link_shapes
from drakegrasp.mesh.loading import load_mesh

#: Numbers and words that replace others in a text.
ODD = ("nan", "inf", "-1", "0", "1e999", "1e-320", "99999999999999", "4294967295", "x", "", "-0.5")
#: Sizes that a header is made to claim.
CLAIMS = (0, 3, 10**6, 2**31 - 1, 2**32 - 1)
HANDS = ("allegro", "barrett", "franka", "leap")
#: A gripper in MJCF.
GRIPPER = """<mujoco model="jaws">
  <default><geom condim="4"/><default class="jaw"><geom mass="0.05"/></default></default>
  <worldbody><body name="body">
    <geom type="box" size="0.03 0.07 0.02" pos="0 0 -0.02" mass="0.5"/>
    <body name="left"><joint name="slide" type="slide" axis="0 1 0" range="0 0.05"/>
      <geom class="jaw" type="box" size="0.01 0.006 0.03" pos="0 0.006 0.03"/></body>
    <body name="right"><joint name="follower" type="slide" axis="0 -1 0" range="0 0.05"/>
      <geom class="jaw" type="box" size="0.01 0.006 0.03" pos="0 -0.006 0.03"/></body>
  </body></worldbody>
  <equality><joint joint1="follower" joint2="slide" polycoef="0 1 0 0 0"/></equality>
  <actuator><motor joint="slide" forcerange="-60 60"/></actuator>
</mujoco>
"""


# --- Damaged meshes ---


def draw_mesh(draw: random.Random) -> tuple[str, np.ndarray, np.ndarray]:
    """Return a name, vertices (n, 3) [m] and faces (m, 3) of a solid, possibly with faults."""
    kind = draw.choice(["box", "ball", "ring", "two", "soup", "fan"])
    generator = np.random.default_rng(draw.randrange(2**32))
    make: dict[str, Callable[[], trimesh.Trimesh]] = {
        "box": lambda: trimesh.creation.box([0.06, 0.05, 0.1]),
        "ball": lambda: trimesh.creation.icosphere(2, radius=0.04),
        "ring": lambda: trimesh.creation.annulus(0.02, 0.04, 0.05),
        "two": lambda: trimesh.util.concatenate(
            [trimesh.creation.box([0.05] * 3), trimesh.creation.icosphere(1, radius=0.03)]
        ),
        "soup": lambda: trimesh.Trimesh(
            generator.uniform(-0.05, 0.05, (600, 3)), np.arange(600).reshape(-1, 3), process=False
        ),
        "fan": lambda: trimesh.Trimesh(
            generator.uniform(-0.05, 0.05, (60, 3)),
            np.column_stack([np.zeros(400, int), generator.integers(0, 60, (400, 2))]),
            process=False,
        ),
    }
    mesh = make[kind]()
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)
    for _ in range(draw.choice([0, 0, 1, 1, 2])):
        some = generator.choice(len(faces), max(1, len(faces) // 8), replace=False)
        fault = draw.choice(["missing", "doubled", "turned", "value", "index", "flat", "far"])
        kind += f", {fault}"
        if fault == "missing":
            faces = np.delete(faces, some, axis=0)
        elif fault == "doubled":
            faces = np.vstack([faces, faces[some]])
        elif fault == "turned":
            faces[some] = faces[some, ::-1]
        elif fault == "value":
            vertices[draw.randrange(len(vertices)), draw.randrange(3)] = float(
                draw.choice(["nan", "inf", "1e300", "1e-320"])
            )
        elif fault == "index":
            faces[some[0], 0] = draw.choice([-1, len(vertices), 2**31 - 1])
        elif fault == "flat":
            vertices[:, draw.randrange(3)] *= draw.choice([0.0, 1e-9])
        else:
            vertices *= draw.choice([1e-30, 1e3, 1e30])
    return kind, vertices, faces


def obj(vertices: np.ndarray, faces: np.ndarray) -> bytes:
    """Return a mesh as OBJ."""
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices]
    lines += [f"f {a}//1 {b}//1 {c}//1" for a, b, c in faces + 1]
    return "\n".join(["o part", "vn 0 0 1", *lines, ""]).encode()


def off(vertices: np.ndarray, faces: np.ndarray) -> bytes:
    """Return a mesh as OFF."""
    lines = [f"{x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices]
    lines += [f"3 {a} {b} {c}" for a, b, c in faces]
    return "\n".join(["OFF", f"{len(vertices)} {len(faces)} 0", *lines, ""]).encode()


def ply(vertices: np.ndarray, faces: np.ndarray, binary: bool) -> bytes:
    """Return a mesh as PLY, as text or binary."""
    header = (
        f"ply\nformat {'binary_little_endian' if binary else 'ascii'} 1.0\n"
        f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    ).encode()
    if not binary:
        return header + b"\n".join(off(vertices, faces).split(b"\n")[2:])
    with np.errstate(over="ignore"):
        points = vertices.astype("<f4").tobytes()
    return header + points + b"".join(struct.pack("<B3i", 3, *map(int, face)) for face in faces)


def stl(vertices: np.ndarray, faces: np.ndarray, binary: bool) -> bytes:
    """Return a mesh as STL, as text or binary; indices without a vertex use the first vertex."""
    corners = vertices[np.where((faces >= 0) & (faces < len(vertices)), faces, 0)]
    if binary:
        record = np.zeros(len(faces), dtype=[("n", "<f4", 3), ("p", "<f4", (3, 3)), ("a", "<u2")])
        with np.errstate(over="ignore"):
            record["p"] = corners
        return b"\0" * 80 + struct.pack("<I", len(faces)) + record.tobytes()
    lines = ["solid part"]
    for face in corners:
        lines += ["facet normal 0 0 1", "outer loop"]
        lines += [f"vertex {x:.9g} {y:.9g} {z:.9g}" for x, y, z in face]
        lines += ["endloop", "endfacet"]
    return "\n".join([*lines, "endsolid part", ""]).encode()


def glb(vertices: np.ndarray, faces: np.ndarray) -> bytes:
    """Return a mesh as GLB."""
    with np.errstate(over="ignore"):
        points = vertices.astype("<f4").tobytes()
    indices = (faces % 2**32).astype("<u4").tobytes()
    views = [
        {"buffer": 0, "byteOffset": 0, "byteLength": len(points)},
        {"buffer": 0, "byteOffset": len(points), "byteLength": len(indices)},
    ]
    accessors = [
        {"bufferView": 0, "componentType": 5126, "count": len(vertices), "type": "VEC3"},
        {"bufferView": 1, "componentType": 5125, "count": 3 * len(faces), "type": "SCALAR"},
    ]
    tree = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "translation": [0.0, 0.0, 0.1]}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "mode": 4}]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(points) + len(indices)}],
    }
    return pack_glb(tree, points + indices)


def pack_glb(tree: Any, data: bytes) -> bytes:
    """Return a GLB built from a description and its data."""
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    data += b"\0" * (-len(data) % 4)
    chunks = struct.pack("<I", len(text)) + b"JSON" + text
    chunks += struct.pack("<I", len(data)) + b"BIN\0" + data
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks


#: Formats by name: the suffix of the file and the function that writes it.
FORMATS: dict[str, tuple[str, Callable[[np.ndarray, np.ndarray], bytes]]] = {
    "obj": (".obj", obj),
    "ascii stl": (".stl", lambda v, f: stl(v, f, False)),
    "binary stl": (".stl", lambda v, f: stl(v, f, True)),
    "ascii ply": (".ply", lambda v, f: ply(v, f, False)),
    "binary ply": (".ply", lambda v, f: ply(v, f, True)),
    "glb": (".glb", glb),
    "off": (".off", off),
}


# --- Methods that damage a text file, or a file with a header ---


def change_number(path: Path, draw: random.Random) -> str:
    """Replace a number by an odd value, or swap two numbers."""
    content = path.read_bytes()
    found = list(re.finditer(rb"(?<![\w.])-?\d+(\.\d+)?(e-?\d+)?(?![\w.])", content))
    if len(found) < 2:
        return flip(path, draw)
    one, other = sorted(draw.sample(found, 2), key=lambda match: match.start())
    if draw.random() < 0.3:
        parts = [content[: one.start()], other[0], content[one.end() : other.start()], one[0]]
        path.write_bytes(b"".join(parts) + content[other.end() :])
        return f"{one[0]!r} and {other[0]!r} swapped"
    value = draw.choice(ODD)
    path.write_bytes(content[: one.start()] + value.encode() + content[one.end() :])
    return f"{one[0]!r} at {one.start()} set to {value!r}"


def change_lines(path: Path, draw: random.Random) -> str:
    """Delete some lines, repeat them, or move them."""
    lines = path.read_bytes().splitlines(keepends=True)
    start = draw.randrange(len(lines))
    some = lines[start : start + draw.choice([1, 1, 3, 10])]
    rest = lines[:start] + lines[start + len(some) :]
    how = draw.choice(["deleted", "repeated", "moved"])
    if how == "repeated":
        rest = lines[:start] + some * draw.choice([2, 1000]) + lines[start:]
    elif how == "moved":
        place = draw.randrange(len(rest) + 1)
        rest = rest[:place] + some + rest[place:]
    path.write_bytes(b"".join(rest))
    return f"{len(some)} lines at {start} {how}"


def delete_bytes(path: Path, draw: random.Random) -> str:
    """Delete some bytes inside a file."""
    content = path.read_bytes()
    start, count = draw.randrange(len(content)), draw.choice([1, 4, 100])
    path.write_bytes(content[:start] + content[start + count :])
    return f"{count} byte at {start} deleted"


def change_word(path: Path, draw: random.Random) -> str:
    """Replace a word of a file by another word of the file."""
    content = path.read_bytes()
    found = list(re.finditer(rb"[A-Za-z_]\w+", content))
    one, other = draw.choice(found), draw.choice(found)
    path.write_bytes(content[: one.start()] + other[0] + content[one.end() :])
    return f"{one[0]!r} at {one.start()} set to {other[0]!r}"


def claim_size(path: Path, draw: random.Random) -> str:
    """Make the header of a binary STL, a GLB, a PLY or an OFF claim another size."""
    content, size = path.read_bytes(), draw.choice(CLAIMS)
    if path.suffix == ".stl":
        content = content[:80] + struct.pack("<I", size) + content[84:]
    elif path.suffix == ".glb":
        place = draw.choice([8, 12])
        content = content[:place] + struct.pack("<I", size) + content[place + 4 :]
    else:
        content = re.sub(rb"(?m)^(element \w+ )?\d+", rf"\g<1>{size}".encode(), content, count=1)
    path.write_bytes(content)
    return f"a header of {size}"


def change_description(path: Path, draw: random.Random) -> str:
    """Change one value of the description of a GLB to another value."""
    content = path.read_bytes()
    size = int.from_bytes(content[12:16], "little")
    tree = json.loads(content[20 : 20 + size])
    said = change_tree(tree, draw)
    path.write_bytes(pack_glb(tree, content[28 + size :]))
    return said


def rename(path: Path, draw: random.Random) -> str:
    """Give a file the name of another format."""
    suffix = draw.choice([".obj", ".stl", ".ply", ".glb"])
    path.rename(path.with_suffix(suffix))
    return f"named {suffix}"


TEXT = (change_number, change_number, change_lines, delete_bytes, change_word)
ANY = (flip, truncate, rename, other_kind)


def spoil_mesh(folder: Path, draw: random.Random) -> str:
    """Write a damaged mesh to an empty folder, and return how it was damaged."""
    name = draw.choice(list(FORMATS))
    suffix, write = FORMATS[name]
    kind, vertices, faces = draw_mesh(draw)
    path = folder / f"1_part{suffix}"
    path.write_bytes(write(vertices, faces))
    own: tuple[Callable[[Path, random.Random], str], ...] = (claim_size,)
    if name == "glb":
        own = (claim_size, change_description, change_description, change_description)
    elif not name.startswith("binary"):
        own = TEXT
    how = "not spoilt"
    if draw.random() < 0.8:
        how = draw.choice((*own, *own, *ANY))(path, draw)
    return f"{name}: {kind}; {how}"


def spoil_hand(folder: Path, draw: random.Random) -> str:
    """Write a hand with a damaged file, or a damaged model, to an empty folder; return how."""
    ways = (*TEXT, *TEXT, flip, flip, truncate, other_kind)
    if draw.random() < 0.4:
        path = folder / draw.choice(["hand.xml", "franka_hand.urdf", "allegro_hand.sdf"])
        if path.suffix == ".xml":
            path.write_text(GRIPPER, encoding="ascii")
        else:
            _copy(path.name.split("_")[0], folder)
            (folder / "hand.yaml").unlink()
        return f"{path.name}: {draw.choice(ways)(path, draw)}"
    name = draw.choice(HANDS)
    _copy(name, folder)
    found = sorted(folder.iterdir())
    # The hand file is the smallest file and has the most rules, so it is chosen often.
    path = draw.choice([*found, *[folder / "hand.yaml"] * len(found)])
    return f"{name}/{path.name}: {draw.choice(ways)(path, draw)}"


def _copy(name: str, folder: Path) -> None:
    """Copy a hand's files to a folder; its hand file is `hand.yaml`."""
    for path in MODELS.glob(f"{name}_*"):
        if path.suffix in (".sdf", ".urdf", ".obj"):
            shutil.copyfile(path, folder / path.name)
    shutil.copyfile(MODELS / f"{name}_hand.yaml", folder / "hand.yaml")


# --- Readers ---


def audit(folder: Path) -> None:
    """Audit the mesh of a folder; a format that `audit` does not list is loaded directly."""
    (path,) = folder.iterdir()
    if path.suffix == ".off":
        load_mesh(path)
        raise AssertionError(f"{path.name} was read")
    command.main(["audit", str(folder)], prog_name="drakegrasp", standalone_mode=True)


def check(folder: Path) -> None:
    """Load and check a hand without trial grasps; if there is no hand file, read the model."""
    if not (folder / "hand.yaml").exists() and not (folder / "hand.yaml").is_symlink():
        (path,) = (p for p in folder.iterdir() if p.suffix in (".urdf", ".sdf", ".xml"))
        model = read_model(path)
        with tempfile.TemporaryDirectory() as out:
            write_urdf(model, Path(out) / "hand.urdf", ())
        return
    hand = load_hand(folder / "hand.yaml")
    link_shapes(hand.model)
    limits = check_limits(hand)
    for finding in (limits, *(check_geometry(hand) if limits.ok else ())):
        sys.stdout.write(f"{finding.name}: {finding.text}\n")


def fuzz(kind: str, count: int, seed: int, first: int = 0) -> Iterator[dict[str, Any] | None]:
    """Yield for each case the finding, or None.

    Args:
        kind: "meshes" or "hands".
        count: Number of cases.
        seed: Seed of all random draws.
        first: Number of the first case.
    """
    spoil, run = {"meshes": (spoil_mesh, audit), "hands": (spoil_hand, check)}[kind]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / kind
        for number in range(first, first + count):
            draw = random.Random(f"{seed}/{number}")
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            if number == first:
                _write_sound(kind, folder)
                preload([read(run, folder)])
                shutil.rmtree(folder)
                folder.mkdir()
            how, began = spoil(folder, draw), time.monotonic()
            finding = {
                "case": number,
                "file": kind,
                "how": how,
                "wrong": judge(read(run, folder)),
                "seconds": round(time.monotonic() - began, 1),
            }
            yield finding if finding["wrong"] else None


def _write_sound(kind: str, folder: Path) -> None:
    """Write a sound mesh or hand."""
    if kind == "hands":
        _copy("franka", folder)
    else:
        trimesh.creation.box([0.06, 0.05, 0.1]).export(folder / "1_box.obj")


@click.command(help=__doc__)
@click.option("--meshes", default=200, show_default=True, help="Number of meshes.")
@click.option("--hands", default=100, show_default=True, help="Number of hands.")
@click.option("--first", default=0, show_default=True, help="Number of the first case.")
@click.option("--seed", default=0, show_default=True, help="Seed of all random draws.")
def main(meshes: int, hands: int, first: int, seed: int) -> None:
    """Run the script."""
    counts = {"meshes": meshes, "hands": hands}
    cases = (case for kind, n in counts.items() for case in fuzz(kind, n, seed, first))
    say_findings(cases, sum(counts.values()))


if __name__ == "__main__":
    main()
