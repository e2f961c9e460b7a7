"""A folder for the Hugging Face Hub: Parquet files, a dataset card and Croissant metadata.

Input: a dataset. Output: `<camera>/<split>-00000-of-00001.parquet` for both cameras and all splits
that have samples, `README.md` (whose head in YAML the Hub and `datasets` read) and `croissant.json`
(mlcommons.org/croissant, version 1.1, with the fields of its RAI vocabulary 1.0).
`datasets.load_dataset(folder, "oto")` reads it. If the dataset has a scenes.hdf5, there is also a
configuration of views and a configuration of the grasps in the scenes. Their columns are those of
the schema, but the columns that refer to rows of /scenes and /objects are replaced by the content
of these rows. A scene has the same number in both configurations.

Colour is an 8-bit PNG, depth a 16-bit PNG in units of `DEPTH_UNIT`, the mask an 8-bit PNG with the
values 0 and 255. Images of scenes have the values stored in scenes.hdf5. All other columns are
fields of the data file; a column has the last part of the field's name. Needs the extra `[hub]`.
"""

from __future__ import annotations

import hashlib
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

from drakegrasp.dataset.card import card_content, card_text
from drakegrasp.dataset.opening import open_samples
from drakegrasp.dataset.paths import DATA_FILES, SCENES_FILE
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.scenes import SceneDataset, refuse_other_state
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
from drakegrasp.exchange.export import Publication
from drakegrasp.runtime.progress import Report

if TYPE_CHECKING:
    import pyarrow as pa

#: Croissant's data types by the kind letter of NumPy's types.
_CROISSANT_TYPES = {"f": "sc:Float", "i": "sc:Integer", "u": "sc:Integer", "b": "sc:Boolean"}
#: Terms that are defined in Croissant's own vocabulary.
_TERMS = (
    *("arrayShape", "citeAs", "column", "containedIn", "equivalentProperty", "extract", "field"),
    *("fileProperty", "fileObject", "fileSet", "format", "includes", "isArray", "isLiveDataset"),
    *("jsonPath", "key", "md5", "parentField", "path", "recordSet", "references", "regex"),
    *("repeated", "replace", "samplingRate", "separator", "source", "subField", "transform"),
)
#: The context that the specification prescribes.
_CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "dct": "http://purl.org/dc/terms/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "sc": "https://schema.org/",
    "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "description": {"@container": "@language"},
    "name": {"@container": "@language"},
    **{term: f"cr:{term}" for term in _TERMS},
}


def croissant(
    folder: Path,
    files: Sequence[tuple[HubTable, str]],
    card: Mapping[str, Any],
    publication: Publication,
) -> dict[str, Any]:
    """Return the content of `croissant.json`.

    Args:
        folder: Folder of the files.
        files: Table and path of each file that was written.
        card: Content of the data card (`card_content`).
        publication: What the publishers state; keys that they do not state are left out.
    """
    # Each file with its hash, so that a damaged download is detected.
    distribution = [
        {
            "@type": "cr:FileObject",
            "@id": path,
            "name": path,
            "contentUrl": path,
            "encodingFormat": "application/x-parquet",
            "sha256": hashlib.sha256((folder / path).read_bytes()).hexdigest(),
        }
        for _, path in files
    ]

    # The dataset, with the columns of each file.
    said = {
        "license": publication.licence,
        "version": publication.version,
        "url": publication.url,
        "creator": [{"@type": "sc:Organization", "name": name} for name in publication.creators],
        "datePublished": publication.published and publication.published.isoformat(),
        "citeAs": publication.citation,
    }
    return {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "name": publication.name or card["title"],
        "description": "Simulated multi-finger grasps, each with the images of its camera.",
        "conformsTo": [
            "http://mlcommons.org/croissant/1.1",
            "http://mlcommons.org/croissant/RAI/1.0",
        ],
        **{key: value for key, value in said.items() if value},
        **_responsibility(card),
        "distribution": distribution,
        "recordSet": [_record_set(table, path) for table, path in files],
    }


def _responsibility(card: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of Croissant's RAI vocabulary, all from the data card."""
    # Counts, classes and versions for the texts below.
    counts = card["counts"]
    everything, removals = counts["all"], counts["removed"]
    samples = [row["samples"] for row in counts["classes"].values()]
    versions = ", ".join(f"{name} {card['versions'][name]}" for name in ("drakegrasp", "drake"))
    reasons = ", ".join(f"{count} {reason}" for reason, count in removals.items()) or "none"

    # Only statements that are true of every dataset that drakegrasp builds.
    return {
        "rai:dataCollection": (
            f"Simulated with {versions}, hand {card['hand']}: {everything['attempts']} attempts to "
            f"grasp, of which {everything['held']} hold. No people and no robot took part."
        ),
        "rai:dataCollectionType": "Software Collection",
        "rai:dataPreprocessingProtocol": (
            f"Filters removed {sum(removals.values())} held grasps: {reasons}."
        ),
        "rai:dataAnnotationProtocol": (
            "Each label is the outcome of a simulated lift; no network made or corrected one."
        ),
        "rai:dataBiases": [
            f"{len(counts['objects'])} objects of {len(counts['classes'])} classes, with "
            f"{min(samples)} to {max(samples)} samples each."
        ],
        "rai:dataLimitations": [entry["limit"] for entry in card["limits"]],
        "rai:dataUseCases": ["Training and testing of networks that predict grasps from images."],
        "rai:personalSensitiveInformation": ["None."],
    }


def _record_set(table: HubTable, path: str) -> dict[str, Any]:
    # A field for each column; images are read from the bytes of their cells.
    name, fields = path.removesuffix(".parquet"), []
    for column, field in table.columns.items():
        source: dict[str, Any] = {"fileObject": {"@id": path}, "extract": {"column": column}}
        if field.sample:
            source["transform"] = {"jsonPath": "bytes"}
        fields.append(
            {
                "@type": "cr:Field",
                "@id": f"{name}/{column}",
                "name": column,
                "description": f"{field.meaning} [{field.unit}]".removesuffix(" [-]"),
                "dataType": _croissant_type(field),
                "repeated": bool(field.axes) and not field.sample,
                "source": source,
            }
        )

    return {
        "@type": "cr:RecordSet",
        "@id": name,
        "name": name,
        "description": table.what,
        "field": fields,
    }


def _croissant_type(field: Field) -> str:
    if field.sample:
        return "sc:ImageObject"
    return "sc:Text" if field.dtype == "str" else _CROISSANT_TYPES[np.dtype(field.dtype).kind]


#: Fields by the names of columns; columns that are images (`sample`) hold PNG files.
Columns = Mapping[str, Field]
#: Size of a file [byte] at which the next file begins, as the Hub recommends it, and the number of
#: rows in a row group, which is read as a whole.
FILE_BYTES, GROUP_ROWS = 500_000_000, 100


@dataclass(frozen=True, kw_only=True)
class HubTable:
    """The rows of a configuration in a split.

    Attributes:
        config, split: Names of the configuration and the split.
        what: Description of the rows in a sentence.
        count: Number of rows.
        columns: Fields of the columns.
        read: Function that takes a start and an end (excluded) and returns the columns of these
            rows as lists of JSON types; an image is a cell of `png_cell`.
    """

    config: str
    split: str
    what: str
    count: int
    columns: Columns
    read: Callable[[int, int], Mapping[str, Sequence[Any]]]

    def write(self, folder: Path, wrote: Callable[[int], None]) -> Iterator[tuple[HubTable, str]]:
        """Write the files of the table; yield, for each file, the table and the file's path.

        Args:
            folder: Folder of all configurations; the paths are relative to it.
            wrote: Called with the number of rows of each group that is written.
        """
        import pyarrow as pa
        import pyarrow.parquet as pq

        schema, parts, start = _schema(self.columns), list[Path](), 0
        (folder / self.config).mkdir(exist_ok=True)
        while start < self.count:
            parts.append(folder / self.config / f"{self.split}-{len(parts):05d}")
            with parts[-1].open("wb") as file, pq.ParquetWriter(file, schema) as writer:
                for first in range(start, self.count, GROUP_ROWS):
                    content = self.read(first, min(first + GROUP_ROWS, self.count))
                    group = pa.Table.from_pydict(dict(content), schema=schema)
                    writer.write_table(group, row_group_size=GROUP_ROWS)
                    wrote(len(group))
                    start = first + len(group)
                    if file.tell() >= FILE_BYTES:
                        break

        # The names of the files contain the number of files, which is known only now.
        for number, part in enumerate(parts):
            path = f"{self.config}/{self.split}-{number:05d}-of-{len(parts):05d}.parquet"
            part.rename(folder / path)
            yield self, path


def png_cell(pixels: npt.NDArray[np.uint8] | npt.NDArray[np.uint16]) -> dict[str, Any]:
    """Return an image as a cell, in the form that `datasets` reads."""
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(pixels).save(file, format="PNG")
    return {"bytes": file.getvalue(), "path": None}


def _schema(columns: Columns) -> pa.Schema:
    """Return the schema of the files, with the types that `datasets` gives the columns."""
    import pyarrow as pa

    features: dict[str, Any] = {}
    fields = []
    for name, field in columns.items():
        if field.sample:
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


#: Configurations of scenes, and descriptions of their rows.
SCENE_CONFIGS = {
    "views": "images of scenes, by cameras that know no grasp",
    "scene_grasps": "the hands that closed in these scenes; the column scene joins both",
}
#: Columns whose name differs from that of their field, to be the same as in samples.
_NAMES = {"rgb": "image"}
#: Meanings of columns whose fields refer to files that are not in the folder.
_MEANINGS = {
    "scene": "number of the scene",
    **{field.name: field.meaning for field in TRIAL_FIELDS if field.name in ("outcome", "source")},
}
#: Columns that replace the rows of a scene's objects in /objects.
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
    """Return the tables of a dataset's scenes; an empty list without a scenes.hdf5.

    Raises:
        DataError: If the file is damaged, or was built from another state of the dataset.
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
    """Return the table of those rows of a group that belong to a split."""
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
        if name not in found and not field.sample:
            table, at = (own, rows) if field.name in own else (scenes, scene)
            found[name] = table[field.name][at].tolist()
    if group == "views":
        images = zip(*map(data.stored_images, rows.tolist()), strict=True)
        named = zip(("image", "depth", "mask"), images, strict=True)
        found |= {name: [png_cell(pixels) for pixels in every] for name, every in named}
    return found


#: Description of the format in `drakegrasp export --help`.
HELP = (
    "Parquet, a dataset card and Croissant metadata, as the Hugging Face Hub has them; needs "
    "pip install 'drakegrasp[hub]'"
)

#: Image columns of samples, computed from the fields `images` and `masks`.
IMAGES = {
    name: Field(name, "", "uint8", "-", "C", meaning, sample=True)
    for name, meaning in (
        ("image", "colour, 8-bit PNG"),
        ("depth", "16-bit PNG in units of 0.1 mm"),
        ("mask", "8-bit PNG, 255 where the object is seen, else 0"),
    )
}
#: Descriptions of the files of a folder.
FILES = {
    "oto/, otm/": "the samples, as each camera sees them, in Parquet files",
    "croissant.json": "the same for programs, with a hash of each file",
}
#: Conventions that differ from those of the files of a dataset.
CONVENTIONS = {
    "depth": "z of the camera frame in units of 0.1 mm; see Camera for pixels that show nothing",
    "images": "PNG files; row 0 is the top",
}
#: Attributes of the camera in a data file: intrinsics [px] and the range of depths [m].
_CAMERA = ("K", "near", "far")
#: Column names of fields for which the column does not have the last part of the field's name.
NAMES = {"grasps": "grasp", "grasps_held": "grasp_held"}
#: Columns of samples.
COLUMNS: Columns = IMAGES | {
    NAMES.get(field.name, field.name.rpartition("/")[2]): field
    for field in DATA_FIELDS
    if not field.sample
}


def write_hub(
    out: Path, folder: Path, progress: Report, *, publication: Publication | None = None
) -> int:
    """Write the folder and return the number of samples; see `export.export_dataset`.

    Args:
        out: See `export.export_dataset`.
        folder: See `export.export_dataset`.
        progress: See `export.export_dataset`.
        publication: Statement of the publishers for the card and the metadata.

    Raises:
        MachineError: If pyarrow is not installed.
    """
    try:
        import pyarrow  # noqa: F401
    except ModuleNotFoundError:
        raise MachineError(
            "format hf needs pyarrow, got none: pip install 'drakegrasp[hub]'"
        ) from None

    # Write the Parquet files of each camera and split, and those of scenes.
    publication = publication or Publication()
    tables = [_sample_table(out, camera, split) for camera in CAMERAS for split in SPLITS]
    samples, done = sum(table.count for table in tables) // len(CAMERAS), 0
    tables += scene_tables(out)
    total = sum(table.count for table in tables)

    def wrote(rows: int) -> None:
        nonlocal done
        done += rows
        progress(done, total)

    written = [file for table in tables for file in table.write(folder, wrote)]

    # Describe them for people and for programs.
    content = card_content(out)
    text = _card(out, tables, content, publication)
    (folder / "README.md").write_text(text, encoding="utf-8")
    description = croissant(folder, written, content, publication)
    (folder / "croissant.json").write_text(json.dumps(description, indent=1), encoding="utf-8")
    return samples


def _card(
    out: Path, tables: Sequence[HubTable], card: Mapping[str, Any], publication: Publication
) -> str:
    """Return the text of the dataset card: the dataset's own card, the files and the columns."""
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
    content["columns"] = _described(COLUMNS)
    content["columns_of"] = {name: _described(configs[name]) for name in scenes}

    # The head lists the files of each configuration and split.
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
    """Return shape, unit, frame and meaning of each column by its name."""
    return {
        name: (" x ".join(map(str, field.axes)), field.unit, field.frame, field.meaning)
        for name, field in columns.items()
    }


def _sample_table(out: Path, camera: str, split: str) -> HubTable:
    """Return the table of a split's samples with the images of a camera."""
    data = GraspDataset(out / DATA_FILES[camera], split=split, fewer_fingers=True)

    def read(start: int, stop: int) -> dict[str, list[Any]]:
        images, masks = (data.rows(name, start, stop) for name in ("images", "masks"))
        cells = [encode_images(*pair) for pair in zip(images, masks, strict=True)]
        return {name: [each[name] for each in cells] for name in IMAGES} | {
            name: data.rows(field.name, start, stop).tolist()
            for name, field in COLUMNS.items()
            if not field.sample
        }

    return HubTable(
        config=camera,
        split=split,
        what=f"Samples of split {split} as camera {camera} sees them.",
        count=len(data),
        columns=COLUMNS,
        read=read,
    )


def encode_images(image: npt.ArrayLike, mask: npt.ArrayLike) -> dict[str, dict[str, Any]]:
    """Return the cells of an image (4, S, S), with depth [m] as last channel, and a mask (S, S)."""
    channels = np.asarray(image)
    colour = np.rint(np.moveaxis(channels[:3], 0, -1) * 255.0).astype(np.uint8)
    depth = np.clip(np.rint(channels[3] / DEPTH_UNIT), 0, np.iinfo(np.uint16).max)
    pixels = (colour, depth.astype(np.uint16), (np.asarray(mask) * 255).astype(np.uint8))
    return {name: png_cell(each) for name, each in zip(IMAGES, pixels, strict=True)}
