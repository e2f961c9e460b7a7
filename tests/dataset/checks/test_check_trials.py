"""Rules of trials."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.datasets import (
    AFTER_LIFT,
    BELOW,
    HAND,
    MISSING,
    SLIPPED,
    SUCCESS,
    TRIALS,
    Edit,
    change,
    end_lift,
    found,
    make_dataset,
    mirrored,
    moved,
    must_find,
    must_find_without_shards,
    set_at,
    turned,
)

from drakegrasp.dataset.manifest import claim_directory, read_manifest
from drakegrasp.dataset.trials import Trials
from drakegrasp.errors import DataError
from drakegrasp.hand.settings import override_config
from drakegrasp.outcomes import Outcome

TRIAL_CASES: Mapping[str, tuple[str, int, Edit, str]] = {
    "trial_id": ("trial_id", MISSING, lambda i: i + 1, "trial_id must follow from the row's"),
    "outcome": ("outcome", BELOW, lambda _: 99, "outcome must be one of 0, 1, 2"),
    "object": ("object", BELOW, lambda _: 3, "object must be one of the rows of /obj"),
    "negative object": ("object", BELOW, lambda _: -1, "object must be one of the rows of /obj"),
    "candidate": ("candidate", BELOW, lambda _: 4, "candidate must be one of the cand"),
    "negative candidate": (
        "candidate",
        BELOW,
        lambda _: -1,
        "candidate must be one of the cand",
    ),
    "standoff": ("standoff_index", BELOW, lambda _: 3, "standoff_index must be one of the stand"),
    "lost value": ("closed_q", SUCCESS, set_at(1, to=np.nan), "closed_q must be finite from"),
    "infinite": ("spread", BELOW, lambda _: np.inf, "spread must be finite"),
    "early value": ("slip", MISSING, lambda _: 0.0, "slip must be finite from the stage lifted"),
    "early count": ("closed_other_links", BELOW, lambda _: 1, "closed_other_links must be 0"),
    "late value": ("slip", AFTER_LIFT, lambda _: np.nan, "slip must be finite from"),
    "no touch": ("closed_p_OQ", MISSING, set_at(2, to=0.0), "closed_p_OQ must be finite where"),
    "touch": ("lifted_p_OQ", SUCCESS, set_at(2, 0, to=np.nan), "lifted_p_OQ must be finite where"),
    "normal": (
        "closed_nhat_Q_O",
        SUCCESS,
        set_at(2, to=[0, 0.9, 0]),
        "closed_nhat_Q_O of finger 3 must have length 1",
    ),
    "pull": (
        "lifted_f_Q_O",
        SUCCESS,
        set_at(1, to=[-10, 0, 0]),
        "lifted_f_Q_O of finger 2 must push",
    ),
    "pull when closed": (
        "closed_f_Q_O",
        SUCCESS,
        set_at(1, to=[-10, 0, 0]),
        "closed_f_Q_O of finger 2 must push",
    ),
    "area": ("closed_area", SUCCESS, set_at(0, to=0), "closed_area of finger 1 must be positive"),
    "depth": (
        "closed_penetration",
        SUCCESS,
        set_at(1, to=-1e-3),
        "closed_penetration must be 0..inf",
    ),
    "pose": ("X_OG", BELOW, lambda p: 1.1 * p, "X_OG must have an orthonormal rotation"),
    "palm after the lift": ("X_OG_lifted", SUCCESS, mirrored, "X_OG_lifted must have an orthon"),
    "slip": ("slip", SUCCESS, lambda s: s + 1e-3, "slip must follow from X_OG and X_OG_lifted"),
    "turn": ("turn", SLIPPED, lambda t: t + 1e-2, "turn must follow from X_OG and X_OG_lifted"),
    "slip back": ("slip_released", SUCCESS, lambda s: -s, "slip_released must be 0..inf"),
    "turn too far": ("turn_released", SUCCESS, lambda _: 4.0, "turn_released must be 0..3.142"),
    "precision": ("precision", SUCCESS, lambda _: False, "precision must follow from outcome"),
    "stable": ("stable", SLIPPED, lambda _: True, "stable must follow from outcome"),
    "early word": ("stable", MISSING, lambda _: True, "stable must be 0 before the stage lifted"),
    "lifted pose": ("X_TO_lifted", SUCCESS, mirrored, "X_TO_lifted must have an orthonormal"),
    "resting": ("X_TO", SUCCESS, moved(0.001, 0, 0), "X_TO must follow from the resting poses"),
    "other link": ("closed_other_links", SUCCESS, lambda _: 1, "outcome must follow from the con"),
    "hand on table": ("closed_hand_on_table", SUCCESS, lambda _: True, "outcome must follow from"),
    "on table": ("lifted_object_on_table", SUCCESS, lambda _: True, "outcome must follow"),
    "scraped": ("clearance_close", SUCCESS, lambda _: -6e-4, "outcome must follow from"),
    "scraped in the lift": ("clearance_lift", SUCCESS, lambda _: -6e-4, "outcome must follow"),
    "no clearance": ("clearance_close", HAND, lambda _: np.nan, "clearance_close must be finite"),
    "early clearance": ("clearance_lift", HAND, lambda _: 0.1, "clearance_lift must be NaN before"),
    "preshape": ("preshape", SUCCESS, lambda _: 255, "preshape must be 255 of postures only"),
    "verdict": ("outcome", SLIPPED, lambda _: Outcome.DROPPED, "outcome must follow from the"),
}


def rounds() -> list[dict[int, str]]:
    """Return the cases by the row that they spoil: the three objects have the same attempts."""
    dealt: list[dict[int, str]] = []
    for case, (_, row, *_) in TRIAL_CASES.items():
        free = ((cases, row + 12 * k) for cases in dealt for k in range(3))
        cases, own = next((f for f in free if f[1] not in f[0]), ({}, row))
        if not cases:
            dealt.append(cases)
        cases[own] = case
    return dealt


@pytest.mark.parametrize("cases", rounds(), ids=lambda cases: ", ".join(cases.values()))
def test_a_wrong_value_of_a_trial_is_found(out: Path, cases: dict[int, str]) -> None:
    """Each in a row of its own."""
    spoilt = [(row, *TRIAL_CASES[case]) for row, case in cases.items()]
    for row, name, _, edit, _ in spoilt:
        change(out, TRIALS, f"trials/{name}", row, edit)
    from_shard = ((row, f"{name} must follow from its shard") for row, name, *_ in spoilt)
    must_find(out, *((TRIALS, "/trials", row, what) for row, what in from_shard))
    must_find_without_shards(out, *((TRIALS, "/trials", row, what) for row, *_, what in spoilt))


def test_slip_is_the_objects_motion_in_the_hand(out: Path) -> None:
    """A palm that turns about its own origin moves an object beside this origin."""
    turn = turned(0.2, [1.0, 0.0, 0.0])
    change(out, TRIALS, "trials/X_OG_lifted", SUCCESS, turn)
    broken = [f"{name} must follow from X_OG and X_OG_lifted" for name in ("slip", "turn")]
    must_find_without_shards(out, *((TRIALS, "/trials", SUCCESS, what) for what in broken))


def end(slip: float) -> Callable[[Path, int], None]:
    return lambda out, row: end_lift(out, row, slip)


def put(name: str, value: Any) -> Callable[[Path, int], None]:
    return lambda out, row: change(out, TRIALS, f"trials/{name}", row, lambda _: value)


ENDED = "lift.stop_when=lost_sample"


@pytest.mark.parametrize(
    ("settings", "edits", "sound"),
    [
        # A lift is ended where the configuration says so, whatever its contacts say then, and
        # only by a hand that may lift.
        ([ENDED], [end(0.011)], True),
        ([ENDED], [end(0.010)], False),
        (["lift.stop_when=never"], [end(0.011)], False),
        ([ENDED], [end(0.02), put("closed_other_links", 1)], False),
    ],
)
def test_lift_is_ended_only_where_the_configuration_says_so(
    tmp_path: Path,
    settings: Sequence[str],
    edits: Sequence[Callable[[Path, int], None]],
    sound: bool,
) -> None:
    out = make_dataset(tmp_path / "out", tmp_path / "meshes", overrides=settings)
    for edit in edits:
        edit(out, SLIPPED)
    what = (TRIALS, "/trials", SLIPPED, "outcome must follow from the contacts")
    must_find(out / TRIALS, *([] if sound else [what]))


def test_contact_that_slides_or_of_a_failed_attempt_may_be_pressed_from_any_side(
    out: Path,
) -> None:
    change(out, TRIALS, "trials/closed_f_Q_O", HAND, set_at(0, to=[6.5, 0, 0]))
    change(out, TRIALS, "trials/lifted_f_Q_O", SLIPPED, set_at(1, to=[-10, 0, 0]))
    # It uses nothing of its cone: the force has no part along the normal.
    change(out, TRIALS, "trials/slip_use", SLIPPED, set_at(1, to=np.nan))
    must_find(out / TRIALS)


def test_successes_and_removals_are_checked(out: Path) -> None:
    change(out, TRIALS, "successes/removal", 2, lambda _: 4)
    must_find(out, (TRIALS, "/successes", 2, "removal must follow from the shards"))
    change(out, TRIALS, "successes/removal", 2, lambda _: 14)  # was one, and is none
    must_find(
        out / TRIALS,
        (TRIALS, "/successes", 2, "removal must be one of 0, 1, 2"),
    )
    change(out, TRIALS, "successes/trial_id", 0, lambda i: i + 1)
    assert (TRIALS, "/successes", None, "trial_id must list the successes of /trials") in found(
        out / TRIALS
    )


def test_certificates_are_checked(out: Path) -> None:
    change(out, TRIALS, "successes/certified_share", 1, lambda _: 1.0)
    change(out, TRIALS, "successes/certified_friction", 1, lambda _: np.inf)
    must_find(out / TRIALS)
    change(out, TRIALS, "successes/certified_share", 1, lambda _: 1.5)
    change(out, TRIALS, "successes/certified_friction", 1, lambda _: -0.1)
    must_find(
        out, *((TRIALS, "/successes", 1, f"certified_{name}") for name in ("share", "friction"))
    )
    must_find(
        out / TRIALS,
        (TRIALS, "/successes", 1, "certified_share must be 0..1"),
        (TRIALS, "/successes", 1, "certified_friction must be 0..inf"),
    )


@pytest.mark.parametrize(("friction", "reported"), [(0.71, True), (7.1, False)])
def test_force_that_pulls_at_a_mean_normal_is_wrong_where_friction_is_usual(
    tmp_path: Path, friction: float, reported: bool
) -> None:
    (tmp_path / "meshes").mkdir()
    out = make_dataset(
        tmp_path / "out", tmp_path / "meshes", overrides=[f"physics.friction_hand={friction}"]
    )
    change(out, TRIALS, "trials/lifted_f_Q_O", SUCCESS, lambda f: -f)
    said = [what for *_, what in found(out / TRIALS)]
    assert any("must push into the object" in what for what in said) == reported


def test_dataset_that_did_not_measure_the_table_is_sound_and_goes_on(tmp_path: Path) -> None:
    """But a build that measures it is another one."""
    rules = ["close.scrape_depth=null"]
    out = make_dataset(tmp_path / "out", tmp_path / "meshes", overrides=rules)
    must_find(out)
    assert np.isnan(Trials(out)["clearance_close"]).all()
    begun = read_manifest(out)
    assert claim_directory(out, begun.config) == begun
    stated = override_config(begun.config, ["close.scrape_depth=0.001"])
    with pytest.raises(DataError, match=r"close\.scrape_depth \(None there, 0\.001 here\)"):
        claim_directory(out, stated)
