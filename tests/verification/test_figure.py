"""The figure of a verification: contacts where they are, the hand where it was, the verdict."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.hands import write_tongs
from helpers.machine import needs_egl
from helpers.objects import CUBE, box_model, from_above, standing
from helpers.verdicts import some_fit, some_forces, some_try, some_verdict
from matplotlib.image import imread

from drakegrasp.frames import X_WT
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.settings import load_config
from drakegrasp.outcomes import Outcome
from drakegrasp.pictures.style import save_figure
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.scene import palm_pose
from drakegrasp.simulation.trial import TrialRecord, run_attempt
from drakegrasp.verification.figure import FAILS, HELD, STABLE, verification_figure

pytestmark = pytest.mark.sim

#: Contacts on the cube's front, back and underside.
NHAT_Q_O = np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
P_OQ = CUBE / 2.0 * NHAT_Q_O


@pytest.fixture(scope="module")
def config():
    return load_config()


@pytest.fixture(scope="module")
def cube(tmp_path_factory):
    return box_model(tmp_path_factory.mktemp("cube"), [CUBE] * 3)


@pytest.fixture(scope="module")
def scene(cube, config):
    return build_scene(cube, config.physics, load_hand(config.hand))


@pytest.fixture(scope="module")
def held(scene, cube, config):
    return run_attempt(scene, standing(cube), from_above(cube, 0.06), config)


@pytest.fixture
def verified(cube):
    """Return a function that makes a result, of a grasp that was not tried unless told."""

    def make(**values):
        return some_verdict(cube, **{"p_OQ": P_OQ, "nhat_Q_O": NHAT_Q_O, **values})

    return make


def dots_of(figure, panel):
    """Return the dots of a panel, and whether each is drawn as one that is seen."""
    lines = {str(line.get_gid()): line for line in figure.axes[panel].lines}
    return {name: line.get_markerfacecolor() != "white" for name, line in lines.items()}


def texts_of(figure):
    return [text.get_text() for text in figure.texts]


@needs_egl
def test_contacts_on_opposite_sides_are_each_seen_once(verified, config, tmp_path):
    figure = verification_figure(verified())
    assert len(figure.axes) == 2
    first, second = dots_of(figure, 0), dots_of(figure, 1)
    assert list(first) == list(second) == ["predicted 0", "predicted 1", "predicted 2"]
    assert sorted([first["predicted 0"], first["predicted 1"]]) == [False, True]
    assert first["predicted 0"] == second["predicted 1"]
    # What the object stands on is seen from nowhere.
    assert not first["predicted 2"]
    assert not second["predicted 2"]
    assert texts_of(figure) == ["1_box_a  fails: dropped", "so it is"]
    save_figure(figure, tmp_path / "figure.png", dpi=50)
    assert imread(tmp_path / "figure.png").std() > 0.1


@needs_egl
def test_hand_whose_link_is_called_palm_is_shown(verified, cube, tmp_path):
    """The hand of the tutorial, over the cube."""
    X_OG = from_above(cube, 0.06).X_OG
    trial = TrialRecord(outcome=Outcome.START_COLLISION, X_TO=standing(cube), X_OG=X_OG)
    nothing = np.full(2, np.nan)
    fit = some_fit(X_OG, spread=0.0, closing=np.full(2, 0.1), residual=np.zeros(2))
    result = verified(
        config=load_config(hand=str(write_tongs(tmp_path))),
        outcome=Outcome.START_COLLISION,
        surface_distance=np.zeros(2),
        p_OQ=P_OQ[:2],
        nhat_Q_O=NHAT_Q_O[:2],
        tries=(some_try(trial, fit=fit, contact_error=nothing, normal_error=nothing),),
    )
    figure = result.figure()
    assert [axes.get_title(loc="left") for axes in figure.axes][2].startswith("the hand where")
    assert figure.axes[2].images[0].get_array().std() > 1.0


@needs_egl
def test_dots_are_on_the_object_and_its_hand_is_shown(verified, held, config):
    assert held.outcome is Outcome.SUCCESS
    result = verified(
        outcome=Outcome.SUCCESS,
        tries=(some_try(held),),
        p_OQ=held.closed.contacts.p_OQ,
        nhat_Q_O=held.closed.contacts.nhat_Q_O,
    )
    figure = verification_figure(result)
    assert texts_of(figure)[0] == f"1_box_a  {result.words}"
    assert result.words.startswith("held")
    assert result.stable and figure.texts[0].get_color() == STABLE
    line = texts_of(figure)[1].splitlines()[1]
    assert line == "contacts within 3.0 mm of the requested ones (success: 20 mm)"
    line = texts_of(figure)[1].splitlines()[2]
    assert f"slip {1e3 * held.lift.slip:.1f} mm, turn {np.rad2deg(held.lift.turn):.1f}°" in line
    assert line.endswith(f"other links at the end: {held.lift.contacts.other_links}")
    assert [axes.get_title(loc="left") for axes in figure.axes][2] == "end of the lift, with forces"
    # Predicted where they were reached: dots lie on each other.
    for panel in (0, 1):
        lines = {line.get_gid(): line.get_xydata()[0] for line in figure.axes[panel].lines}
        for i in range(3):
            np.testing.assert_allclose(lines[f"predicted {i}"], lines[f"reached {i}"], atol=1e-6)
    assert set(dots_of(figure, 2)) == {"lifted 0", "lifted 1", "lifted 2"}
    assert {"lifted 0", "lifted 1", "lifted 2"} < set(dots_of(figure, 0))
    alone, hand = (figure.axes[k].images[0].get_array() for k in (0, 2))
    # The hand is grey and black, the table and the cube are not.
    assert np.mean(np.ptp(hand, axis=2) < 8) > 0.05
    assert np.mean(np.ptp(alone, axis=2) < 8) < 0.05
    largest = max(
        np.linalg.norm(contacts.f_Q_O, axis=1).max()
        for contacts in (held.closed.contacts, held.lift.contacts)
    )
    legend = [text.get_text() for text in figure.legends[0].get_texts()]
    assert any(f"{largest:.1f} N" in text for text in legend)


@needs_egl
def test_last_panel_shows_the_last_instant(verified, held, cube, config):
    slides = replace(held, lift=replace(held.lift, slip=0.5))
    figure = verification_figure(verified(outcome=Outcome.SUCCESS, tries=(some_try(slides),)))
    assert figure.texts[0].get_color() == HELD
    closed = replace(held, lift=None)
    placed = replace(closed, outcome=Outcome.START_COLLISION, closed=None)
    for values, title in (
        ({"tries": (some_try(closed),)}, "after closing"),
        ({"tries": (some_try(placed),)}, "the hand where it comes closest"),
    ):
        figure = verification_figure(verified(**values))
        assert figure.axes[2].get_title(loc="left") == title
    assert len(verification_figure(verified(forces=some_forces())).axes) == 2


@needs_egl
def test_row_that_is_no_grasp_shows_the_object_alone(verified):
    nothing = np.full((3, 3), np.nan)
    row = verified(
        outcome=Outcome.INVALID, reason="number 1 is nan", p_OQ=nothing, nhat_Q_O=nothing
    )
    figure = verification_figure(row)
    assert texts_of(figure) == ["1_box_a  fails: invalid", "number 1 is nan"]
    assert figure.texts[0].get_color() == FAILS
    assert [dots_of(figure, panel) for panel in (0, 1)] == [{}, {}]


@pytest.mark.parametrize("friction", [0.71, 0.1])
def test_palm_is_where_the_lift_ended(cube, config, friction):
    """Without friction the cube is lost long before the palm has arrived."""
    physics = config.physics.model_copy(update={"friction_hand": friction})
    slick = config.model_copy(update={"physics": physics})
    scene = build_scene(cube, physics, load_hand(config.hand))
    record = run_attempt(scene, standing(cube), from_above(cube, 0.06), slick)
    assert record.lift.contacts.touching.any() == (friction > 0.5)
    # The coarse steps of a lift have a scene of their own.
    X_WG = palm_pose(max(scene, scene.coarse_scene(), key=lambda stage: stage.time))
    X_WO = X_WT @ record.lift.X_TO
    np.testing.assert_allclose(X_WO @ record.lift.X_OG, X_WG, atol=1e-9)
    if friction < 0.5:
        assert X_WG[2, 3] < 0.65 + config.lift.p_TG[2] - 0.1
