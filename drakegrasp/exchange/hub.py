"""A folder for the Hugging Face Hub, which `datasets.load_dataset(folder, "oto")` reads.

Input: a dataset. Output: Parquet files `<configuration>/<split>-00000-of-00001.parquet`, written by
`datasets`, and `README.md`, the dataset card, whose head lists them.
Each camera is a configuration. If the dataset has a scenes.hdf5, there is also a configuration of
views and one of the grasps in the scenes, in which columns that refer to rows of /scenes and
/objects are replaced by the content of these rows. A scene has the same number in both.

Colour is an 8-bit PNG, depth a 16-bit PNG in units of `DEPTH_UNIT`, the mask an 8-bit PNG with the
values 0 and 255. Images of scenes have the values stored in scenes.hdf5. All other columns are
fields of the schema; a column has the last part of the field's name. Needs the extra `[hub]`.
"""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import yaml
from PIL import Image

from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.paths import DATA_FILES, SCENES_FILE
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.scenes import SceneDataset, validate_state
from drakegrasp.dataset.schema import (
    CAMERAS,
    CONVENTIONS,
    DATA_FIELDS,
    DEPTH_UNIT,
    SCENE_FIELDS,
    SCENE_GRASP_FIELDS,
    SPLITS,
    VIEW_FIELDS,
    Field,
)
from drakegrasp.dataset.statistics import count_splits
from drakegrasp.dataset.trials import Trials
from drakegrasp.errors import MachineError, counted
from drakegrasp.runtime.progress import Report

#: Description of the format in `drakegrasp export --help`.
HELP = "Parquet, as the Hugging Face Hub has it; needs pip install 'drakegrasp[hub]'"
#: Rows of a file, which are in memory together, and of a group of rows, which is read as a whole.
FILE_ROWS, GROUP_ROWS = 2000, 100
#: Columns that hold PNG files.
IMAGES = ("image", "depth", "mask")
#: Fields by the names of columns that are no images; those of samples, views and grasps of scenes.
Columns = Mapping[str, Field]
_NAMES = {"grasps": "grasp", "grasps_held": "grasp_held"}
COLUMNS: Columns = {
    _NAMES.get(field.name, field.name.rpartition("/")[2]): field
    for field in DATA_FIELDS
    if not field.sample
}
_OBJECTS = tuple(
    Field(name, "str", f"{what} of the objects", "o")
    for name, what in (("object_name", "names"), ("class_name", "classes"))
)
_OF_SCENE = tuple(field for field in SCENE_FIELDS if field.name != "object")
VIEW_COLUMNS, GRASP_COLUMNS = (
    {field.name: field for field in (*own, *_OBJECTS, *_OF_SCENE) if not field.sample}
    for own in (VIEW_FIELDS, SCENE_GRASP_FIELDS)
)

_TEXT = """Samples of a dataset of [drakegrasp](https://pypi.org/project/drakegrasp), one
configuration for each camera{scenes}. `depth` is in units of {unit:g} m; where nothing is before
{far:g} m, it is {far:g} m. The cameras' matrix K is {K} [px]. `mask` is 255 where the object is
seen. A grasp is contact points [m] and normals of the fingers {fingers} in the camera's frame.

{conventions}

| split | samples | distinct | objects | classes |
|---|--:|--:|--:|--:|
{splits}

Made by {versions} with the hand `{hand}`, configuration `{config}`; split by {by}. Everything is
simulated: no grasp was tried on a real robot. Licences of the meshes:

{licences}
"""
_SCENES = """, `views` of scenes by cameras that know no grasp, and the hands that closed there,
`scene_grasps`; the column `scene` joins both"""


@dataclass(frozen=True, kw_only=True)
class HubTable:
    """The rows of a configuration in a split.

    Attributes:
        config, split: Names of the configuration and the split.
        count: Number of rows.
        columns: Fields of the columns that are no images.
        has_images: Whether there are the columns `IMAGES`.
        read: Function that takes a start and an end (excluded) and returns the columns of these
            rows; an image is a cell of `png_cell`.
    """

    config: str
    split: str
    count: int
    columns: Columns
    has_images: bool
    read: Callable[[int, int], dict[str, Any]]

    def write(self, folder: Path, wrote: Callable[[int], None]) -> None:
        """Write the files of the table into the folder of its configuration.

        Args:
            folder: Folder of all configurations.
            wrote: Called with the number of rows of each file that is written.
        """
        import datasets

        # The Hub's names contain the number of files.
        files = -(-self.count // FILE_ROWS)
        (folder / self.config).mkdir(exist_ok=True)
        for number in range(files):
            start, stop = number * FILE_ROWS, min((number + 1) * FILE_ROWS, self.count)
            rows = datasets.Dataset.from_dict(self.read(start, stop), self.features())
            name = f"{self.split}-{number:05d}-of-{files:05d}.parquet"
            rows.to_parquet(folder / self.config / name, batch_size=GROUP_ROWS)
            wrote(stop - start)

    def features(self) -> Any:
        """Return the types of the columns."""
        import datasets

        features: dict[str, Any] = {name: datasets.Image() for name in IMAGES if self.has_images}
        for name, field in self.columns.items():
            features[name] = datasets.Value({"str": "string"}.get(field.dtype, field.dtype))
            for _ in field.axes:
                features[name] = datasets.List(features[name])
        return datasets.Features(features)


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
    tables = [_sample_table(out, camera, split) for camera in CAMERAS for split in SPLITS]
    samples, done = sum(table.count for table in tables) // len(CAMERAS), 0
    tables = [table for table in (*tables, *scene_tables(out)) if table.count]
    total = sum(table.count for table in tables)

    def wrote(rows: int) -> None:
        nonlocal done
        done += rows
        progress(done, total)

    for table in tables:
        table.write(folder, wrote)
    (folder / "README.md").write_text(_card(out, tables, licence), encoding="utf-8")
    return samples


def _card(out: Path, tables: Sequence[HubTable], licence: str | None) -> str:
    """Return the text of the card: the files of each configuration, and what the rows are."""
    files: dict[str, list[dict[str, str]]] = {}
    for table in tables:
        path = f"{table.config}/{table.split}-*.parquet"
        files.setdefault(table.config, []).append({"split": table.split, "path": path})

    # The licences of the meshes, and the samples by split.
    manifest, objects = read_manifest(out), dict[str, list[str]]()
    for entry in manifest.objects:
        objects.setdefault(entry.licence or "not stated", []).append(entry.name)
    splits = (astuple(count) for count in count_splits(out))

    head = {
        "license": licence or "unknown",
        "pretty_name": f"Simulated grasps of {counted(len(manifest.objects), 'object')}",
        "task_categories": ["robotics"],
        "tags": ["robotics", "grasping", "simulation"],
        "configs": [{"config_name": name, "data_files": each} for name, each in files.items()],
    }
    text = _TEXT.format(
        scenes=_SCENES if "views" in files else "",
        unit=DEPTH_UNIT,
        far=manifest.config.camera.far,
        K=GraspDataset(out / DATA_FILES["oto"], fewer_fingers=True).K.tolist(),
        fingers=", ".join(manifest.fingers),
        conventions="\n".join(f"* **{name}**: {said}" for name, said in CONVENTIONS.items()),
        splits="\n".join(f"| {' | '.join(map(str, row))} |" for row in splits),
        versions=", ".join(f"{name} {version}" for name, version in manifest.versions.items()),
        hand=Path(manifest.config.hand).stem,
        config=manifest.config.simulation_hash(),
        by=manifest.config.split.by,
        licences="\n".join(f"* {licence}: {', '.join(own)}" for licence, own in objects.items()),
    )
    head_text = yaml.safe_dump(head, sort_keys=False)
    return f"---\n{head_text}---\n\n# {head['pretty_name']}\n\n{text}"


def _sample_table(out: Path, camera: str, split: str) -> HubTable:
    """Return the table of a split's samples with the images of a camera."""
    data = GraspDataset(out / DATA_FILES[camera], split=split, fewer_fingers=True)

    def read(start: int, stop: int) -> dict[str, Any]:
        samples = (data[row] for row in range(start, stop))
        images = [encode_images(sample.image, sample.mask) for sample in samples]
        return by_name(images) | {
            name: _cells(data.rows(field.name, start, stop)) for name, field in COLUMNS.items()
        }

    return HubTable(
        config=camera, split=split, count=len(data), columns=COLUMNS, has_images=True, read=read
    )


def _cells(values: npt.NDArray[Any]) -> Any:
    """Return a column in a form that `datasets` takes; as a list it rejects seeds of 64 bits."""
    if values.dtype != np.uint64:
        return values.tolist()
    import pyarrow

    return pyarrow.array(values)


def by_name(images: Sequence[Iterable[Any]]) -> dict[str, list[Any]]:
    """Return the columns `IMAGES` of rows with three cells each."""
    return dict(zip(IMAGES, map(list, zip(*images, strict=True)), strict=True))


def encode_images(image: npt.ArrayLike, mask: npt.ArrayLike) -> list[dict[str, Any]]:
    """Return the cells of an image (4, S, S), with depth [m] as last channel, and a mask (S, S)."""
    channels = np.asarray(image)
    colour = np.rint(np.moveaxis(channels[:3], 0, -1) * 255.0).astype(np.uint8)
    depth = np.clip(np.rint(channels[3] / DEPTH_UNIT), 0, np.iinfo(np.uint16).max)
    seen = (np.asarray(mask) * 255).astype(np.uint8)
    return [png_cell(pixels) for pixels in (colour, depth.astype(np.uint16), seen)]


def png_cell(pixels: npt.NDArray[np.uint8] | npt.NDArray[np.uint16]) -> dict[str, Any]:
    """Return an image as a cell, in the form that `datasets` reads."""
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, format="PNG")
    return {"bytes": file.getvalue(), "path": None}


def scene_tables(out: Path) -> list[HubTable]:
    """Return the tables of a dataset's scenes; an empty list without a scenes.hdf5.

    Raises:
        DataError: If the file is damaged, or was built from another state of the dataset.
    """
    path = out / SCENES_FILE
    if not os.path.lexists(path):
        return []
    data = SceneDataset(path, points=None)
    validate_state(path, Trials(out))
    kinds = (("views", "views", VIEW_COLUMNS), ("scene_grasps", "grasps", GRASP_COLUMNS))
    return [_scene_table(data, *kind, split) for kind in kinds for split in SPLITS]


def _scene_table(
    data: SceneDataset, config: str, group: str, columns: Columns, split: str
) -> HubTable:
    """Return the table of those rows of a group of scenes.hdf5 that belong to a split."""
    own, scenes = data.tables[group], data.tables["scenes"]
    rows = np.flatnonzero(scenes["split"][own["scene"]] == SPLITS.index(split))

    def read(start: int, stop: int) -> dict[str, Any]:
        at = rows[start:stop]
        scene = own["scene"][at]
        objects = scenes["object"][scene]
        found: dict[str, Any] = {
            "object_name": np.array(data.names, dtype=object)[objects].tolist(),
            "class_name": np.array(data.classes, dtype=object)[objects].tolist(),
        }
        for name in columns.keys() - found.keys():
            found[name] = _cells(own[name][at] if name in own else scenes[name][scene])
        if group == "views":
            found |= by_name([map(png_cell, data.stored_images(row)) for row in at.tolist()])
        return found

    return HubTable(
        config=config,
        split=split,
        count=len(rows),
        columns=columns,
        has_images=group == "views",
        read=read,
    )
