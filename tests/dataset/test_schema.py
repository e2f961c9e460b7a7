"""The table of fields: shapes, values that are missing, and where the contacts come from."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from helpers.datasets import OTM, OTO, TRIALS, edit_file, edit_manifest, make_dataset

from drakegrasp.dataset.assemble import assemble
from drakegrasp.dataset.check import check_dataset
from drakegrasp.dataset.manifest import claim_directory
from drakegrasp.dataset.paths import MANIFEST_FILE
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.schema import (
    DATA_FIELDS,
    SCHEMA_VERSION,
    TRIAL_FIELDS,
    VERIFICATION_FIELDS,
    Field,
)
from drakegrasp.dataset.statistics import count_funnel
from drakegrasp.errors import DataError
from drakegrasp.generation.replay import replay_trial
from drakegrasp.hand.settings import load_config
from drakegrasp.outcomes import Stage
from drakegrasp.simulation.contacts import Contacts


def test_contact_fields_are_those_that_the_simulation_reads() -> None:
    """All but the force of the table, which no file keeps."""
    names = {field.name for field in dataclasses.fields(Contacts)}
    path = "trial.lift.contacts."
    read = {f.of.removeprefix(path) for f in TRIAL_FIELDS if f.of.startswith(path)}
    assert read == names - {"table_force"}


@pytest.mark.parametrize("table", [TRIAL_FIELDS, VERIFICATION_FIELDS])
def test_stage_of_a_field_is_that_of_its_measurement(table: tuple[Field, ...]) -> None:
    for path, stage in (("trial.closed.", Stage.CLOSED), ("trial.lift.", Stage.TRIED)):
        stages = {field.stage for field in table if field.of.startswith(path)}
        assert stages == {stage}
    # A hand that closes on a fixed object takes nothing off the table.
    assert "closed_object_on_table" not in {field.name for field in table}


def test_number_of_a_sample_is_a_column_of_its_trial_in_single_precision() -> None:
    columns = {field.name: field for field in TRIAL_FIELDS}
    for field in DATA_FIELDS:
        if field.of:
            of = columns[field.of]
            assert np.dtype(field.dtype) == (np.float32 if of.dtype == "float64" else of.dtype)
            assert field.unit == of.unit


@pytest.fixture(scope="module")
def old(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset whose files say that they are of version 1."""
    out = make_dataset(tmp_path_factory.mktemp("old"), tmp_path_factory.mktemp("meshes"))
    edit_manifest(out, lambda tree: tree.update(schema_version=1))
    for name in (OTO, OTM, TRIALS):
        edit_file(out / name, lambda f: f.attrs.update(schema_version=1))
    return out


@pytest.mark.parametrize(
    ("opens", "name"),
    [
        (GraspDataset, OTO),
        (check_dataset, MANIFEST_FILE),
        (assemble, MANIFEST_FILE),
        (count_funnel, TRIALS),
        (partial(claim_directory, config=load_config()), MANIFEST_FILE),
        (partial(replay_trial, trial_id=0), MANIFEST_FILE),
    ],
)
def test_dataset_of_another_version_gets_one_line(
    old: Path, opens: Callable[[Path], object], name: str
) -> None:
    """Which file, what it must be, what it is, and what to do."""
    alone = opens is GraspDataset
    with pytest.raises(DataError) as error:
        opens(old / name if alone else old)
    assert str(error.value) == (
        f"{old / name}: schema must be {SCHEMA_VERSION}, got 1; build the dataset again "
        "with this version of drakegrasp, in another directory"
    )


def test_friction_in_use_is_a_share_of_the_cone() -> None:
    """A force at half the angle's tangent of the cone, one on its border, and no contact."""
    nhat = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [np.nan] * 3])
    f = np.array([[0.3, 0.4, -2.0], [-4.0, 2.0, 0.0], [0.0, 0.0, 0.0]])
    (field,) = (field for field in TRIAL_FIELDS if field.name == "slip_use")
    assert field.derive is not None
    rows = {
        "lifted_touching": np.array([[True, True, False]]),
        "lifted_f_Q_O": f[None],
        "lifted_nhat_Q_O": nhat[None],
        "friction_hand": np.array([0.5]),
    }
    assert {*rows} == {*field.needs}
    np.testing.assert_allclose(field.derive(rows), [[0.5, 1.0, np.nan]])
