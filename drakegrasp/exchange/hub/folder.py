"""A folder for the Hugging Face Hub: Parquet files, a dataset card and Croissant metadata.

In: a dataset. Out: `<camera>/<split>-00000-of-00001.parquet` for both cameras and all splits that
have samples, `README.md` (whose head in YAML the Hub and `datasets` read) and `croissant.json`.
`datasets.load_dataset(folder, "oto")` reads it. With a scenes.hdf5 there are the configurations of
`scenes`, too.

Colour is an 8-bit PNG, depth a 16-bit PNG in units of `DEPTH_UNIT`, the mask an 8-bit PNG of 0 and
255. All other columns are those of the data file, by their last names. Needs the extra `[hub]`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import yaml

from drakegrasp.dataset.card.content import card_content
from drakegrasp.dataset.card.text import card_text
from drakegrasp.dataset.opening import open_samples
from drakegrasp.dataset.paths import DATA_FILES
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.schema import CAMERAS, DATA_FIELDS, DEPTH_UNIT, SPLITS, Field
from drakegrasp.errors import MachineError
from drakegrasp.exchange.hub.croissant import croissant
from drakegrasp.exchange.hub.scenes import SCENE_CONFIGS, scene_tables
from drakegrasp.exchange.hub.table import Columns, HubTable, png_cell
from drakegrasp.exchange.publication import Publication
from drakegrasp.runtime.progress import Report

#: What `drakegrasp export --help` says of the format.
HELP = (
    "Parquet, a dataset card and Croissant metadata, as the Hugging Face Hub has them; needs "
    "pip install 'drakegrasp[hub]'"
)

#: Columns that are images, made of the fields `images` and `masks`, and what they hold.
IMAGES = {
    "image": "colour, 8-bit PNG",
    "depth": "16-bit PNG in units of 0.1 mm",
    "mask": "8-bit PNG, 255 where the object is seen, else 0",
}
#: The files of a folder, in words.
FILES = {
    "oto/, otm/": "the samples, as each camera sees them, in Parquet files",
    "croissant.json": "the same for programs, with a hash of each file",
}
#: What is not as in the files of a dataset.
CONVENTIONS = {
    "depth": "z of the camera frame in units of 0.1 mm; see Camera for pixels that show nothing",
    "images": "PNG files; row 0 is the top",
}
#: What a data file says of its camera: intrinsics [px] and the range of depths [m].
_CAMERA = ("K", "near", "far")
#: What the other fields are called here, where it is not their last name.
NAMES = {"grasps": "grasp", "grasps_held": "grasp_held"}


def write_hub(out: Path, folder: Path, progress: Report, *, publication: Publication) -> int:
    """Write the folder and return the number of samples; see `export.export_dataset`.

    Raises:
        MachineError: If pyarrow is not installed.
    """
    try:
        import pyarrow  # noqa: F401
    except ModuleNotFoundError:
        raise MachineError(
            "format hf needs pyarrow, got none: pip install 'drakegrasp[hub]'"
        ) from None

    # The Parquet files of each camera and split, and those of scenes.
    tables = [_sample_table(out, camera, split) for camera in CAMERAS for split in SPLITS]
    samples, done = sum(table.count for table in tables) // len(CAMERAS), 0
    tables += scene_tables(out)
    total = sum(table.count for table in tables)

    def wrote(rows: int) -> None:
        nonlocal done
        done += rows
        progress(done, total)

    written = [file for table in tables for file in table.write(folder, wrote)]

    # What they are, for people and for programs.
    content = card_content(out)
    text = _card(out, tables, content, publication)
    (folder / "README.md").write_text(text, encoding="utf-8")
    description = croissant(folder, written, content, publication)
    (folder / "croissant.json").write_text(json.dumps(description, indent=1), encoding="utf-8")
    return samples


def columns() -> Columns:
    """Return the fields of the columns by the columns' names; None for an image."""
    found: dict[str, Field | None] = dict.fromkeys(IMAGES)
    for field in DATA_FIELDS:
        if not field.sample:
            found[NAMES.get(field.name, field.name.rpartition("/")[2])] = field
    return found


def _card(
    out: Path, tables: Sequence[HubTable], card: Mapping[str, Any], publication: Publication
) -> str:
    """Return the text of the dataset card: that of the dataset, its files and its columns."""
    configs = {table.config: table.columns for table in tables}
    scenes = [name for name in configs if name not in CAMERAS]
    content = {**card, "files": FILES | {f"{name}/": SCENE_CONFIGS[name] for name in scenes}}
    content["depth_unit"] = DEPTH_UNIT
    content["title"] = publication.name or card["title"]
    content["conventions"] = {**content["conventions"], **CONVENTIONS}
    rows = {(table.config, table.split): table.count for table in tables}
    content["samples_by_camera"] = {c: {s: rows[c, s] for s in SPLITS} for c in CAMERAS}
    with open_samples(out / DATA_FILES["oto"]) as data:
        content["camera"] = {key: np.asarray(data.attrs[key]).tolist() for key in _CAMERA}
    content["columns"] = _described(columns())
    content["columns_of"] = {name: _described(configs[name]) for name in scenes}

    # The head names the files of each configuration and split.
    files = [
        {
            "config_name": config,
            "data_files": [
                {"split": split, "path": f"{config}/{split}-*.parquet"}
                for split in SPLITS
                if rows[config, split]
            ],
        }
        for config in configs
    ]
    head = {
        "license": publication.licence or "unknown",
        "pretty_name": content["title"],
        "task_categories": ["robotics"],
        "tags": ["robotics", "grasping", "simulation", "croissant"],
        "configs": files,
    }
    return f"---\n{yaml.safe_dump(head, sort_keys=False).strip()}\n---\n\n{card_text(content)}"


def _described(columns: Columns) -> dict[str, tuple[str, str, str, str]]:
    """Return shape, unit, frame and meaning of columns, by their names."""
    return {
        name: ("", "", "", IMAGES[name])
        if field is None
        else (" x ".join(map(str, field.axes)), field.unit, field.frame, field.meaning)
        for name, field in columns.items()
    }


def _sample_table(out: Path, camera: str, split: str) -> HubTable:
    """Return the samples of a split as a camera sees them."""
    data = GraspDataset(out / DATA_FILES[camera], split=split, fewer_fingers=True)

    def read(start: int, stop: int) -> dict[str, list[Any]]:
        images, masks = (data.rows(name, start, stop) for name in ("images", "masks"))
        cells = [encode_images(*pair) for pair in zip(images, masks, strict=True)]
        return {name: [each[name] for each in cells] for name in IMAGES} | {
            name: data.rows(field.name, start, stop).tolist()
            for name, field in columns().items()
            if field is not None
        }

    return HubTable(
        config=camera,
        split=split,
        what=f"Samples of split {split} as camera {camera} sees them.",
        count=len(data),
        columns=columns(),
        read=read,
    )


def encode_images(image: npt.ArrayLike, mask: npt.ArrayLike) -> dict[str, dict[str, Any]]:
    """Return the cells of an image (4, S, S) with depth [m] and its mask (S, S)."""
    channels = np.asarray(image)
    colour = np.rint(np.moveaxis(channels[:3], 0, -1) * 255.0).astype(np.uint8)
    depth = np.clip(np.rint(channels[3] / DEPTH_UNIT), 0, np.iinfo(np.uint16).max)
    pixels = (colour, depth.astype(np.uint16), (np.asarray(mask) * 255).astype(np.uint8))
    return {name: png_cell(each) for name, each in zip(IMAGES, pixels, strict=True)}
