"""Which predictions a page shows, and in which order.

In: the parameters of an address. Out: a `PredictionQuery`, and the numbers of the predictions that
it selects.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from drakegrasp.outcomes import Outcome
from drakegrasp.page.predictions.results import QUANTITIES, VERDICTS, Predictions
from drakegrasp.page.query import (
    GalleryQuery,
    address_of,
    in_ranges,
    of_objects,
    read_shared,
)

#: Quantities with a range among the filters.
RANGES = ("error", "normal_error", "true_error", "surface", "slip", "turn")
#: Orders by name.
SORTS = ("worst", *QUANTITIES, "row")


@dataclass(frozen=True, kw_only=True)
class PredictionQuery(GalleryQuery):
    """What is asked for.

    Attributes:
        verdict: Another filter.
        sort: One of SORTS.
    """

    verdict: str = ""
    sort: str = "worst"

    def params(self, **changes: object) -> str:
        """Return the query as part of an address, with some values changed; see `address_of`."""
        values = {**self.shared, "verdict": self.verdict}
        return address_of(values, self.ranges, changes, {"sort": "worst", "page": 1})


def parse_prediction_query(params: Mapping[str, str]) -> PredictionQuery:
    """Return the query of an address.

    Raises:
        DataError: If a value is none that can be asked for.
    """
    outcomes = tuple(outcome.label for outcome in Outcome)
    choices = {"verdict": VERDICTS, "outcome": outcomes, "sort": SORTS}
    shared = read_shared(params, choices, RANGES)
    shared["sort"] = shared["sort"] or "worst"
    return PredictionQuery(verdict=params.get("verdict", ""), **shared)


def select_predictions(predictions: Predictions, query: PredictionQuery) -> npt.NDArray[np.int32]:
    """Return the numbers of the predictions that a query asks for, in its order.

    Those without a value of what is sorted by come last; ties are in the order of the file.
    """
    # The filters.
    chosen = in_ranges(query.ranges, QUANTITIES, predictions.features.__getitem__, len(predictions))
    snapshot = predictions.snapshot
    chosen &= of_objects(snapshot, query.object_name, query.class_name)[predictions.objects]
    if query.outcome:
        chosen &= predictions.outcome == Outcome[query.outcome.upper()]
    if query.verdict:
        chosen &= predictions.words.get(query.verdict, np.zeros(len(predictions), dtype=bool))

    # The order.
    numbers = np.flatnonzero(chosen).astype(np.int32)
    values = order_values(predictions, query.sort)[numbers]
    ranks = np.where(np.isnan(values), np.inf, values if query.ascending else -values)
    return numbers[np.argsort(ranks, kind="stable")]


def order_values(predictions: Predictions, sort: str) -> npt.NDArray[np.float64]:
    """Return the values (n,) that an order sorts by.

    The worst are those that fail, and of these those whose hand reached no contact; then the
    distance of asked from reached contacts decides.
    """
    if sort == "row":
        return predictions.rows.row.astype(float)
    if sort != "worst":
        return predictions.features[sort]
    error, held = predictions.features["error"], predictions.words["held"]
    # Below 1, in the order of the errors.
    share = np.where(np.isnan(error), 1.0, error / (1.0 + error))
    return np.asarray(np.where(held, share, 2.0 + share))
