"""A folder for the Hugging Face Hub: Parquet files, a dataset card and Croissant metadata.

In: a dataset. Out: `<camera>/<split>-00000-of-00001.parquet` for both cameras and all splits that
have samples, `README.md` (whose head in YAML the Hub and `datasets` read) and `croissant.json`.
`datasets.load_dataset(folder, "oto")` reads it. With a scenes.hdf5 there is a configuration of
views, and one of the grasps in them. Their columns are those of the schema, with what /scenes and
/objects say of a row's scene in place of the numbers of their rows; a scene has the same number in
both.

Colour is an 8-bit PNG, depth a 16-bit PNG in units of `DEPTH_UNIT`, the mask an 8-bit PNG of 0 and
255; images of scenes have the values that their file holds. All other columns are those of the data
file, by their last names. Needs the extra `[hub]`.
"""

from __future__ import annotations

import io
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import yaml

from drakegrasp.dataset.card.content import card_content
from drakegrasp.dataset.card.text import card_text
from drakegrasp.dataset.opening import open_samples
from drakegrasp.dataset.paths import DATA_FILES, SCENES_FILE
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.scenes.reader import SceneDataset
from drakegrasp.dataset.scenes.rows import refuse_other_state
from drakegrasp.dataset.schema import (
    CAMERAS,
    DATA_FIELDS,
    DEPTH_UNIT,
    SCENE_FIELDS,
    SCENE_GRASP_FIELDS,
    SPLITS,
    TRIAL_FIELDS,
    VIEW_FIELDS,
    Field,
)
from drakegrasp.dataset.trials import Trials
from drakegrasp.errors import MachineError
from drakegrasp.exchange.croissant import Publication, croissant
from drakegrasp.runtime.progress import Report

if TYPE_CHECKING:
    import pyarrow as pa

#: Fields by the names of columns. An image is None, or a field that is an image.
Columns = Mapping[str, Field | None]
#: Rows in a file, which takes about 150 MB, and in a group of rows, which is read as a whole.
FILE_ROWS, GROUP_ROWS = 4000, 100


@dataclass(frozen=True, kw_only=True)
class HubTable:
    """The rows of a configuration in a split.

    Attributes:
        config, split: Names.
        what: What the rows are, in a sentence.
        count: Number of rows.
        columns: What they have.
        read: Returns the columns of the rows from one to before another, as lists of JSON types;
            an image is a cell of `png_cell`.
    """

    config: str
    split: str
    what: str
    count: int
    columns: Columns
    read: Callable[[int, int], Mapping[str, Sequence[Any]]]

    def write(self, folder: Path, wrote: Callable[[int], None]) -> Iterator[ParquetFile]:
        """Write the files of the table below a folder, and yield them.

        Args:
            folder: Of all configurations.
            wrote: Called with the number of rows of each group that is written.
        """
        import pyarrow.parquet as pq

        schema, files = _schema(self.columns), -(-self.count // FILE_ROWS)
        for number in range(files):
            rows = range(number * FILE_ROWS, min((number + 1) * FILE_ROWS, self.count))
            path = f"{self.config}/{self.split}-{number:05d}-of-{files:05d}.parquet"
            (folder / self.config).mkdir(exist_ok=True)
            with pq.ParquetWriter(folder / path, schema) as writer:
                for group in self._groups(rows, schema):
                    writer.write_table(group, row_group_size=GROUP_ROWS)
                    wrote(len(group))
            yield ParquetFile(table=self, path=path, rows=len(rows))

    def _groups(self, rows: range, schema: pa.Schema) -> Iterator[pa.Table]:
        """Yield the rows as tables of `GROUP_ROWS`."""
        import pyarrow as pa

        for start in range(rows.start, rows.stop, GROUP_ROWS):
            content = self.read(start, min(start + GROUP_ROWS, rows.stop))
            yield pa.Table.from_pydict(dict(content), schema=schema)


@dataclass(frozen=True, kw_only=True)
class ParquetFile:
    """A file of a hub folder.

    Attributes:
        table: Whose rows it holds.
        path: Below the folder.
        rows: Number of rows.
    """

    table: HubTable
    path: str
    rows: int


def png_cell(pixels: npt.NDArray[np.uint8] | npt.NDArray[np.uint16]) -> dict[str, Any]:
    """Return the cell of an image, as `datasets` reads it."""
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(pixels).save(file, format="PNG")
    return {"bytes": file.getvalue(), "path": None}


def _schema(columns: Columns) -> pa.Schema:
    """Return the schema of the files, with the types that `datasets` reads them as."""
    import pyarrow as pa

    features: dict[str, Any] = {}
    fields = []
    for name, field in columns.items():
        if field is None or field.sample:
            kind = pa.struct({"bytes": pa.binary(), "path": pa.string()})
            features[name] = {"_type": "Image"}
        else:
            text = field.dtype == "str"
            dtype = {"str": "string", "bool": "bool"}.get(field.dtype, field.dtype)
            kind = pa.string() if text else pa.from_numpy_dtype(np.dtype(field.dtype))
            features[name] = {"dtype": dtype, "_type": "Value"}
            for _ in field.axes:
                kind = pa.list_(kind)
                features[name] = {"feature": features[name], "_type": "Sequence"}
        fields.append(pa.field(name, kind))
    metadata: Mapping[str, str] = {"huggingface": json.dumps({"info": {"features": features}})}
    return pa.schema(fields, metadata=dict(metadata))


#: Configurations, and what their rows are.
SCENE_CONFIGS = {
    "views": "images of scenes, by cameras that know no grasp",
    "scene_grasps": "the hands that closed in these scenes; the column scene joins both",
}
#: Columns that have another name than their field: as those of samples.
_NAMES = {"rgb": "image"}
#: What is said of columns whose fields refer to files that are not in the folder.
_MEANINGS = {
    "scene": "number of the scene",
    **{field.name: field.meaning for field in TRIAL_FIELDS if field.name in ("outcome", "source")},
}
#: What is said of the objects of a scene in place of their rows.
_OBJECTS = tuple(
    Field(name, "o", "str", "-", "-", f"{what} of the objects")
    for name, what in (("object_name", "names"), ("class_name", "classes"))
)
_OF_SCENE = tuple(field for field in SCENE_FIELDS if field.name != "object")
VIEW_COLUMNS, GRASP_COLUMNS = (
    {
        _NAMES.get(field.name, field.name): replace(
            field, meaning=_MEANINGS.get(field.name, field.meaning)
        )
        for field in (*own, *_OBJECTS, *_OF_SCENE)
    }
    for own in (VIEW_FIELDS, SCENE_GRASP_FIELDS)
)


def scene_tables(out: Path) -> list[HubTable]:
    """Return the tables of a dataset's scenes; none without a scenes.hdf5.

    Raises:
        DataError: If the file is damaged, or of another state of the dataset.
    """
    path = out / SCENES_FILE
    if not os.path.lexists(path):
        return []
    data = SceneDataset(path, points=None)
    refuse_other_state(path, Trials(out))
    return [
        *(_table(data, "views", "views", VIEW_COLUMNS, split) for split in SPLITS),
        *(_table(data, "scene_grasps", "grasps", GRASP_COLUMNS, split) for split in SPLITS),
    ]


def _table(data: SceneDataset, config: str, group: str, columns: Columns, split: str) -> HubTable:
    """Return the rows of a group that are of a split."""
    of_rows = data.tables["scenes"]["split"][data.tables[group]["scene"]]
    rows = np.flatnonzero(of_rows == SPLITS.index(split))

    def read(start: int, stop: int) -> dict[str, list[Any]]:
        return _read(data, group, columns, rows[start:stop])

    return HubTable(
        config=config,
        split=split,
        what=f"Split {split}: {SCENE_CONFIGS[config]}.",
        count=len(rows),
        columns=columns,
        read=read,
    )


def _read(
    data: SceneDataset, group: str, columns: Columns, rows: npt.NDArray[np.int64]
) -> dict[str, list[Any]]:
    """Return the columns of some rows of a group, see `HubTable.read`."""
    own, scenes = data.tables[group], data.tables["scenes"]
    scene = own["scene"][rows]
    objects = scenes["object"][scene]
    found: dict[str, list[Any]] = {
        "object_name": np.array(data.names, dtype=object)[objects].tolist(),
        "class_name": np.array(data.classes, dtype=object)[objects].tolist(),
    }
    for name, field in columns.items():
        if field is not None and name not in found and not field.sample:
            table, at = (own, rows) if field.name in own else (scenes, scene)
            found[name] = table[field.name][at].tolist()
    if group == "views":
        images = zip(*map(data.stored_images, rows.tolist()), strict=True)
        named = zip(("image", "depth", "mask"), images, strict=True)
        found |= {name: [png_cell(pixels) for pixels in every] for name, every in named}
    return found


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
