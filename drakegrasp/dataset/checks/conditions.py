"""Rules of the conditions of attempts: friction, mass, looks, cameras and noise are those drawn.

In: a `Batch` of rows of `/trials`. Out: a `Violation` for every row that is wrong. No
file is read.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from drakegrasp.config import Config, RandomizeConfig
from drakegrasp.dataset.checks.findings import Batch, Violation, all_per_row
from drakegrasp.dataset.schema import CONDITION_FIELDS
from drakegrasp.objects.model import ObjectModel
from drakegrasp.simulation.randomization.draws import draw_conditions


def as_drawn(
    batch: Batch,
    names: Sequence[str],
    model: Callable[[str], ObjectModel | None],
    config: Callable[[str], Config],
) -> Iterator[Violation]:
    """The conditions of a trial are what the seed gives it, or the usual ones.

    Args:
        batch: Rows of `/trials`.
        names: Names of the objects, by row of `/objects`.
        model: Returns an object by its name, None where its file is broken.
        config: Returns what is drawn of an object, and the seed, by its name.
    """
    expected = {f.name: np.array(batch[f.name]) for f in CONDITION_FIELDS}
    for index in np.unique(batch["object"]).tolist():
        known = model(names[index])
        if known is None:
            continue  # a finding already
        rows, own = np.flatnonzero(batch["object"] == index), config(names[index])
        # Where nothing is drawn all attempts of an object have the same conditions.
        if own.randomize == RandomizeConfig():
            for name, value in draw_conditions(known, own, 0, 0).values().items():
                expected[name][rows] = value
            continue
        for row in rows:
            numbers = (int(batch[key][row]) for key in ("candidate", "standoff_index", "child"))
            for name, value in draw_conditions(known, own, *numbers).values().items():
                expected[name][row] = value

    for name, values in expected.items():
        yield from batch.broken(
            f"{name} must be what the seed gives the attempt",
            ~all_per_row(batch[name] == values),
            lambda i, name=name: str(batch[name][i]),  # type: ignore[misc]
        )
