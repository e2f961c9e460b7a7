"""The table of fields: shapes, values that are missing, and where the contacts come from."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from drakegrasp.dataset.schema import CONTACT_NAMES, TRIAL_FIELDS, VERIFICATION_FIELDS, Field, sizes
from drakegrasp.outcomes import Stage
from drakegrasp.simulation.contacts import Contacts

SIZES = sizes(fingers=3, joints=4, image=8)


@pytest.mark.parametrize(
    ("shape", "axes", "row"),
    [
        ("", (), ()),
        ("12", (12,), (12,)),
        ("k 3", ("k", 3), (3, 3)),
        ("6k", ("6k",), (18,)),
        ("4 S S", (4, "S", "S"), (4, 8, 8)),
        ("j", ("j",), (4,)),
    ],
)
def test_letters_of_a_shape_become_lengths(
    shape: str, axes: tuple[int | str, ...], row: tuple[int, ...]
) -> None:
    field = Field("name", shape, "float64", "m", "O", "nothing")
    assert field.axes == axes
    assert field.row_shape(SIZES) == row
    values = field.empty(2, SIZES)
    assert values.shape == (2, *row)
    assert np.isnan(values).all()


def test_letter_without_a_length_is_an_error() -> None:
    with pytest.raises(KeyError, match="k"):
        Field("name", "k 3", "float64", "m", "O", "nothing").row_shape({"j": 4})


def test_contact_fields_are_those_that_the_simulation_reads() -> None:
    """All but the force of the table, which no file keeps."""
    names = {field.name for field in dataclasses.fields(Contacts)}
    assert set(CONTACT_NAMES) == names - {"table_force"}


@pytest.mark.parametrize("table", [TRIAL_FIELDS, VERIFICATION_FIELDS])
def test_contacts_have_values_from_their_stage_on(table: tuple[Field, ...]) -> None:
    stages = {field.name: field.stage for field in table}
    for prefix, stage in (("closed", Stage.CLOSED), ("lifted", Stage.LIFTED)):
        assert {stages[f"{prefix}_{name}"] for name in ("q", *CONTACT_NAMES)} == {stage}
