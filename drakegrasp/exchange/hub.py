"""A folder for the Hugging Face Hub, which `datasets.load_dataset(folder, "oto")` reads.

Input: a dataset. Output: Parquet files `<camera>/<split>-00000-of-00001.parquet`, written by
`datasets`, and `README.md`, the dataset card, whose head lists them. Each camera is a
configuration.

Colour is an 8-bit PNG, depth a 16-bit PNG in units of `DEPTH_UNIT`, the mask an 8-bit PNG with the
values 0 and 255. All other columns are fields of the schema; a column has the last part of the
field's name. Needs the extra `[hub]`.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import astuple
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import yaml
from PIL import Image

from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.paths import DATA_FILES
from drakegrasp.dataset.reach import count_reach
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.schema import (
    CAMERAS,
    CONVENTIONS,
    DATA_FIELDS,
    DEPTH_UNIT,
    SPLITS,
    Field,
)
from drakegrasp.dataset.statistics import count_funnel
from drakegrasp.errors import MachineError, counted
from drakegrasp.runtime.progress import Report

#: Description of the format in `drakegrasp export --help`.
HELP = "Parquet, as the Hugging Face Hub has it; needs pip install 'drakegrasp[hub]'"
#: Rows of a file, which are in memory together, and of a group of rows, which is read as a whole.
FILE_ROWS, GROUP_ROWS = 2000, 100
#: Columns that hold PNG files.
IMAGES = ("image", "depth", "mask")
_NAMES = {"grasps": "grasp", "grasps_lifted": "grasp_lifted"}
#: Fields by the names of columns that are no images.
COLUMNS: Mapping[str, Field] = {
    _NAMES.get(field.name, field.name.rpartition("/")[2]): field
    for field in DATA_FIELDS
    if not field.sample
}

_TEXT = """Samples of a dataset of [drakegrasp](https://pypi.org/project/drakegrasp), one
configuration for each camera. `depth` is in units of {unit:g} m; where nothing is before
{far:g} m, it is {far:g} m. The cameras' matrix K is {K} [px]. `mask` is 255 where the object is
seen. A grasp is contact points [m] and normals of the fingers {fingers} in the camera's frame.

{conventions}

| split | samples | distinct | objects | classes |
|---|--:|--:|--:|--:|
{splits}
{reach}
Made by {versions} with the hand `{hand}`, configuration `{config}`; split by {by}. Everything is
simulated: no grasp was tried on a real robot. Licences of the meshes:

{licences}
"""


def write_hub(out: Path, folder: Path, progress: Report, *, licence: str | None = None) -> int:
    """Write the folder and return the number of samples; see `export.export_dataset`.

    Args:
        out: See `export.export_dataset`.
        folder: See `export.export_dataset`.
        progress: See `export.export_dataset`.
        licence: Identifier of the licence that the card names, e.g. cc-by-4.0.

    Raises:
        MachineError: If the package datasets is not installed.
    """
    try:
        import datasets
    except ModuleNotFoundError:
        raise MachineError(
            "format hf needs datasets, got none: pip install 'drakegrasp[hub]'"
        ) from None

    # The progress bar is ours.
    datasets.disable_progress_bars()
    splits = {
        (camera, split): GraspDataset(out / DATA_FILES[camera], split=split, fewer_fingers=True)
        for camera in CAMERAS
        for split in SPLITS
    }
    done, total, files = 0, sum(map(len, splits.values())), dict[str, list[dict[str, str]]]()
    for (camera, split), data in splits.items():
        (folder / camera).mkdir(exist_ok=True)
        if len(data):
            path = f"{camera}/{split}-*.parquet"
            files.setdefault(camera, []).append({"split": split, "path": path})

        # The Hub's names contain the number of files.
        count = -(-len(data) // FILE_ROWS)
        for number in range(count):
            start, stop = number * FILE_ROWS, min((number + 1) * FILE_ROWS, len(data))
            rows = datasets.Dataset.from_dict(_rows(data, start, stop), _features())
            name = f"{split}-{number:05d}-of-{count:05d}.parquet"
            rows.to_parquet(folder / camera / name, batch_size=GROUP_ROWS)
            done += stop - start
            progress(done, total)
    (folder / "README.md").write_text(_card(out, files, licence), encoding="utf-8")
    return total // len(CAMERAS)


def _features() -> Any:
    """Return the types of the columns."""
    import datasets

    features: dict[str, Any] = {name: datasets.Image() for name in IMAGES}
    for name, field in COLUMNS.items():
        features[name] = datasets.Value({"str": "string"}.get(field.dtype, field.dtype))
        for _ in field.axes:
            features[name] = datasets.List(features[name])
    return datasets.Features(features)


def _rows(data: GraspDataset, start: int, stop: int) -> dict[str, Any]:
    """Return the columns of some rows of a split; an image is a cell of `_png_cell`."""
    samples = (data[row] for row in range(start, stop))
    images = [_encode_images(sample.image, sample.mask) for sample in samples]
    return {
        **dict(zip(IMAGES, map(list, zip(*images, strict=True)), strict=True)),
        **{name: _cells(data.rows(field.name, start, stop)) for name, field in COLUMNS.items()},
    }


def _cells(values: npt.NDArray[Any]) -> Any:
    """Return a column in a form that `datasets` takes; as a list it rejects seeds of 64 bits."""
    if values.dtype != np.uint64:
        return values.tolist()
    import pyarrow

    return pyarrow.array(values)


def _encode_images(image: npt.ArrayLike, mask: npt.ArrayLike) -> list[dict[str, Any]]:
    """Return the cells of an image (4, S, S), with depth [m] as last channel, and a mask (S, S)."""
    channels = np.asarray(image)
    colour = np.rint(np.moveaxis(channels[:3], 0, -1) * 255.0).astype(np.uint8)
    depth = np.clip(np.rint(channels[3] / DEPTH_UNIT), 0, np.iinfo(np.uint16).max)
    seen = (np.asarray(mask) * 255).astype(np.uint8)
    return [_png_cell(pixels) for pixels in (colour, depth.astype(np.uint16), seen)]


def _png_cell(pixels: npt.NDArray[np.uint8] | npt.NDArray[np.uint16]) -> dict[str, Any]:
    """Return an image as a cell, in the form that `datasets` reads."""
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, format="PNG")
    return {"bytes": file.getvalue(), "path": None}


def _card(out: Path, files: Mapping[str, list[dict[str, str]]], licence: str | None) -> str:
    """Return the text of the card: the files of each configuration, and what the rows are."""
    # The licences of the meshes, and the samples by split.
    manifest, objects = read_manifest(out), dict[str, list[str]]()
    for entry in manifest.objects:
        objects.setdefault(entry.licence or "not stated", []).append(entry.name)
    splits = (astuple(count) for count in count_funnel(out).splits)

    head = {
        "license": licence or "unknown",
        "pretty_name": f"Simulated grasps of {counted(len(manifest.objects), 'object')}",
        "task_categories": ["robotics"],
        "tags": ["robotics", "grasping", "simulation"],
        "configs": [{"config_name": name, "data_files": each} for name, each in files.items()],
    }
    text = _TEXT.format(
        unit=DEPTH_UNIT,
        far=manifest.config.camera.far,
        K=GraspDataset(out / DATA_FILES["oto"], fewer_fingers=True).K.tolist(),
        fingers=", ".join(manifest.fingers),
        conventions="\n".join(f"* **{name}**: {said}" for name, said in CONVENTIONS.items()),
        splits="\n".join(f"| {' | '.join(map(str, row))} |" for row in splits),
        reach="".join(f"\n* arm {count.explain()}" for count in count_reach(out)) + "\n",
        versions=", ".join(f"{name} {version}" for name, version in manifest.versions.items()),
        hand=Path(manifest.config.hand).stem,
        config=manifest.config.simulation_hash(),
        by=manifest.config.split.by,
        licences="\n".join(f"* {licence}: {', '.join(own)}" for licence, own in objects.items()),
    )
    head_text = yaml.safe_dump(head, sort_keys=False)
    return f"---\n{head_text}---\n\n# {head['pretty_name']}\n\n{text}"
