"""Scenes for the Hugging Face Hub: a configuration of views, and one of the grasps in them.

In: scenes.hdf5 of a dataset. Out: tables for `folder`. Their columns are those of the schema, with
what /scenes and /objects say of a row's scene in place of the numbers of their rows. A scene has
the same number in both. Images are PNG files of the values that the file holds.
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from drakegrasp.dataset.paths import SCENES_FILE
from drakegrasp.dataset.scenes.reader import SceneDataset
from drakegrasp.dataset.scenes.rows import refuse_other_state
from drakegrasp.dataset.schema import (
    SCENE_FIELDS,
    SCENE_GRASP_FIELDS,
    SPLITS,
    TRIAL_FIELDS,
    VIEW_FIELDS,
    Field,
)
from drakegrasp.dataset.trials import Trials
from drakegrasp.exchange.hub.table import Columns, HubTable, png_cell

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
