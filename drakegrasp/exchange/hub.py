"""A folder for the Hugging Face Hub: Parquet files, a dataset card and Croissant metadata.

In: a dataset. Out: `<camera>/<split>-00000-of-00001.parquet` for both cameras and all splits that
have samples, `README.md` (whose head in YAML the Hub and `datasets` read) and `croissant.json`.
`datasets.load_dataset(folder, "oto")` reads it.

Colour is an 8-bit PNG, depth a 16-bit PNG in units of `DEPTH_UNIT`, the mask an 8-bit PNG of 0 and
255. All other columns are those of the data file, by their last names. Needs the extra `[hub]`.
"""

from __future__ import annotations

import io
import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import yaml

from drakegrasp.dataset.card.content import card_content
from drakegrasp.dataset.card.text import card_text
from drakegrasp.dataset.layout.opening import open_samples
from drakegrasp.dataset.paths import DATA_FILES
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.schema import CAMERAS, DATA_FIELDS, SPLITS, Field
from drakegrasp.errors import MachineError
from drakegrasp.exchange.croissant import ParquetFile, croissant
from drakegrasp.exchange.publication import Publication
from drakegrasp.runtime.progress import Report

if TYPE_CHECKING:
    import pyarrow as pa

#: Depth of one unit of a depth image [m]: a tenth of a millimetre, up to 6.5 m.
DEPTH_UNIT = 1e-4
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
#: Samples in a file, which takes about 150 MB, and in a group of rows, which is read as a whole.
FILE_ROWS, GROUP_ROWS = 4000, 100
#: What a data file says of its camera: intrinsics [px] and the range of depths [m].
_CAMERA = ("K", "near", "far")
#: What the other fields are called here, where it is not their last name.
NAMES = {"grasps": "grasp", "grasps_held": "grasp_held"}

Pixels = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]


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

    # The Parquet files of each camera and split.
    splits = {
        (camera, split): GraspDataset(out / DATA_FILES[camera], split=split, fewer_fingers=True)
        for camera in CAMERAS
        for split in SPLITS
    }
    done, total = 0, sum(len(data) for data in splits.values())
    written: list[ParquetFile] = []
    for (camera, split), data in splits.items():
        count = -(-len(data) // FILE_ROWS)
        for number in range(count):
            start, stop = number * FILE_ROWS, min((number + 1) * FILE_ROWS, len(data))
            path = f"{camera}/{split}-{number:05d}-of-{count:05d}.parquet"
            _write_file(folder / path, data, range(start, stop))
            written.append(ParquetFile(camera=camera, split=split, path=path, rows=stop - start))
            done += stop - start
            progress(done, total)

    # What they are, for people and for programs.
    content = card_content(out)
    text = _card(out, written, content, publication)
    (folder / "README.md").write_text(text, encoding="utf-8")
    description = croissant(folder, written, columns(), content, publication)
    (folder / "croissant.json").write_text(json.dumps(description, indent=1), encoding="utf-8")
    return total // len(CAMERAS)


def columns() -> dict[str, Field | None]:
    """Return the fields of the columns by the columns' names; None for an image."""
    found: dict[str, Field | None] = dict.fromkeys(IMAGES)
    for field in DATA_FIELDS:
        if not field.sample:
            found[NAMES.get(field.name, field.name.rpartition("/")[2])] = field
    return found


def _card(
    out: Path, files: Sequence[ParquetFile], card: Mapping[str, Any], publication: Publication
) -> str:
    """Return the text of the dataset card: that of the dataset, its files and its columns."""
    content = {**card, "files": FILES, "depth_unit": DEPTH_UNIT}
    content["title"] = publication.name or card["title"]
    content["conventions"] = {**content["conventions"], **CONVENTIONS}
    rows: Counter[tuple[str, str]] = Counter()
    for file in files:
        rows[file.camera, file.split] += file.rows
    content["samples_by_camera"] = {c: {s: rows[c, s] for s in SPLITS} for c in CAMERAS}
    with open_samples(out / DATA_FILES["oto"]) as data:
        content["camera"] = {key: np.asarray(data.attrs[key]).tolist() for key in _CAMERA}
    content["columns"] = {
        name: ("", "", "", IMAGES[name])
        if field is None
        else (" x ".join(map(str, field.axes)), field.unit, field.frame, field.meaning)
        for name, field in columns().items()
    }

    # The head names the files of each configuration and split.
    configs = [
        {
            "config_name": camera,
            "data_files": [
                {"split": split, "path": f"{camera}/{split}-*.parquet"}
                for split in SPLITS
                if rows[camera, split]
            ],
        }
        for camera in CAMERAS
    ]
    head = {
        "license": publication.licence or "unknown",
        "pretty_name": content["title"],
        "task_categories": ["robotics"],
        "tags": ["robotics", "grasping", "simulation", "croissant"],
        "configs": configs,
    }
    return f"---\n{yaml.safe_dump(head, sort_keys=False).strip()}\n---\n\n{card_text(content)}"


def encode_images(image: npt.ArrayLike, mask: npt.ArrayLike) -> dict[str, bytes]:
    """Return the PNG files of an image (4, S, S) with depth [m] and its mask (S, S)."""
    channels = np.asarray(image)
    colour = np.rint(np.moveaxis(channels[:3], 0, -1) * 255.0).astype(np.uint8)
    depth = np.clip(np.rint(channels[3] / DEPTH_UNIT), 0, np.iinfo(np.uint16).max)
    pixels: tuple[Pixels, ...] = (
        colour,
        depth.astype(np.uint16),
        (np.asarray(mask) * 255).astype(np.uint8),
    )
    return {name: _png(each) for name, each in zip(IMAGES, pixels, strict=True)}


def _write_file(path: Path, data: GraspDataset, rows: range) -> None:
    import pyarrow.parquet as pq

    path.parent.mkdir(exist_ok=True)
    schema = _schema()
    with pq.ParquetWriter(path, schema) as writer:
        for group in _groups(data, rows, schema):
            writer.write_table(group, row_group_size=GROUP_ROWS)


def _groups(data: GraspDataset, rows: range, schema: pa.Schema) -> Iterator[pa.Table]:
    """Yield the rows as tables of `GROUP_ROWS`."""
    import pyarrow as pa

    for start in range(rows.start, rows.stop, GROUP_ROWS):
        stop = min(start + GROUP_ROWS, rows.stop)
        images, masks = (data.rows(name, start, stop) for name in ("images", "masks"))
        files = [encode_images(*pair) for pair in zip(images, masks, strict=True)]
        content: dict[str, Any] = {
            name: [{"bytes": file[name], "path": None} for file in files] for name in IMAGES
        }
        for name, field in columns().items():
            if field is not None:
                content[name] = data.rows(field.name, start, stop).tolist()
        yield pa.Table.from_pydict(content, schema=schema)


def _schema() -> pa.Schema:
    """Return the schema of the files, with the types that `datasets` reads them as."""
    import pyarrow as pa

    features: dict[str, Any] = {}
    fields = []
    for name, field in columns().items():
        if field is None:
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


def _png(pixels: Pixels) -> bytes:
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(pixels).save(file, format="PNG")
    return file.getvalue()
