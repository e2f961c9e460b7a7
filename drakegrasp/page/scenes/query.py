"""Which scenes a page shows, and in which order.

In: the parameters of an address. Out: a `SceneQuery`, and the numbers of the scenes it selects.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from drakegrasp.dataset.schema import SPLITS
from drakegrasp.page.query import GalleryQuery, address_of, of_objects, read_shared
from drakegrasp.page.scenes.file import Scenes

#: Orders by name, as people read them.
SORTS = {
    "sample": "samples",
    "held": "grasps that hold",
    "tested": "tested grasps",
    "grasps": "grasps",
    "row": "row of the file",
}


@dataclass(frozen=True, kw_only=True)
class SceneQuery(GalleryQuery):
    """What is asked for.

    Attributes:
        split: Another filter.
        sort: One of SORTS.
    """

    split: str = ""
    sort: str = "sample"

    def params(self, **changes: object) -> str:
        """Return the query as part of an address, with some values changed; see `address_of`."""
        values = {**self.shared, "split": self.split}
        return address_of(values, self.ranges, changes, {"sort": "sample", "page": 1})


def parse_scene_query(params: Mapping[str, str]) -> SceneQuery:
    """Return the query of an address.

    Raises:
        DataError: If a value is none that can be asked for.
    """
    shared = read_shared(params, {"split": SPLITS, "sort": tuple(SORTS)}, ())
    shared["sort"] = shared["sort"] or "sample"
    return SceneQuery(split=params.get("split", ""), **shared)


def select_scenes(scenes: Scenes, query: SceneQuery) -> npt.NDArray[np.int32]:
    """Return the numbers of the scenes that a query asks for, in its order; ties by their rows."""
    chosen = of_objects(scenes.snapshot, query.object_name, query.class_name)[scenes.objects]
    if query.split:
        chosen &= scenes.split == SPLITS.index(query.split)
    numbers = np.flatnonzero(chosen).astype(np.int32)
    values = numbers if query.sort == "row" else scenes.counts[query.sort][numbers]
    return numbers[np.argsort(values if query.ascending else -values, kind="stable")]
