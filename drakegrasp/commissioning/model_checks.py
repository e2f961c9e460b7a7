"""Checks of a hand's files: masses, limits, couplings and efforts.

In: a hand that was loaded. Out: a `Finding` per check. Nothing is simulated.
"""

from __future__ import annotations

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from scipy.linalg import block_diag

from drakegrasp.commissioning.finding import Finding, judge
from drakegrasp.config import Config
from drakegrasp.hand.description import Hand
from drakegrasp.hand.kinematics import coordinate_limits
from drakegrasp.hand.model_text import (
    Mimic,
    declared_masses,
    declared_mimics,
    impossible_inertias,
    read_xml,
)
from drakegrasp.hand.parsing import add_model
from drakegrasp.hand.strength import fingertip_forces
from drakegrasp.simulation.construction import FINGER_DAMPING
from drakegrasp.simulation.drive import drive_of

#: Least range of a closing joint, in its unit: less does not close a hand.
LEAST_RANGE = np.deg2rad(5.0)
#: Largest difference of a coupling from the model's own.
SAME = 1e-3


def check_masses(hand: Hand) -> Finding:
    """Return whether every link has a mass, and an inertia that a body can have."""
    # Drake parses the inertias; the masses are those that the file gives.
    root = read_xml(hand.model.path)
    masses, impossible = declared_masses(root), impossible_inertias(root)
    plant = MultibodyPlant(0.0)
    instance = add_model(plant, hand.model)
    faults = []
    for index in plant.GetBodyIndices(instance):
        body = plant.get_body(index)
        mass = masses.get(body.name(), 0.0)
        if not mass > 0.0:
            faults.append(f"link {body.name()!r} must have a mass above 0 kg, got {mass:g}")
        elif body.name() in impossible:
            faults.append(
                f"link {body.name()!r} must have an inertia that a body can have, got "
                f"{impossible[body.name()]}"
            )
        elif not body.default_spatial_inertia().IsPhysicallyValid():
            faults.append(f"link {body.name()!r} must have an inertia that a body can have")
    return judge("masses", faults, f"{len(masses)} links, {sum(masses.values()):.3g} kg in all")


def check_limits(hand: Hand) -> Finding:
    """Return whether each closing joint has limits between which it closes, from zero."""
    # The closing joints' own limits, then what their coupled joints leave of them.
    faults, ranges = [], []
    of_joint = dict(zip(hand.joint_names, hand.joint_limits, strict=True))
    for finger, (lower, upper), unit in zip(
        hand.fingers, coordinate_limits(hand)[1:], hand.closing_unit.tolist(), strict=True
    ):
        own = of_joint[finger.closing_joint]
        if not np.isfinite(own).all():
            faults.append(f"joint {finger.closing_joint!r} must have limits, got {_range(*own)}")
        elif not (own[0] <= 0.0 and own[1] >= LEAST_RANGE * unit):
            faults.append(
                f"joint {finger.closing_joint!r} must reach from 0, the open hand, to a positive "
                f"limit, got {_range(*own)}"
            )
        elif lower > SAME * unit:
            offsets = ", ".join(f"{c.joint} by {c.offset:g}" for c in finger.coupled)
            faults.append(
                f"finger {finger.name!r} must be open at 0, but with their offsets ({offsets}) "
                f"limits of its coupled joints leave {_range(lower, upper)}"
            )
        elif upper < LEAST_RANGE * unit:
            ratios = ", ".join(f"{c.joint} by {c.ratio:g}" for c in finger.coupled)
            faults.append(
                f"finger {finger.name!r} must be able to close, but limits of its coupled joints "
                f"({ratios}) leave {_range(lower, upper)}: check the signs of the ratios"
            )
        ranges.append(f"{finger.name} {_text(upper, finger.slides)}")

    # The spreads.
    least, most = np.rad2deg(coordinate_limits(hand)[0])
    for spread in hand.spreads_deg:
        if not least - 1e-6 <= spread <= most + 1e-6:
            faults.append(f"spreads_deg must be {least:g}..{most:g}, got {spread:g}")
    return judge("limits", faults, f"closing up to {', '.join(ranges)}")


def check_couplings(hand: Hand) -> Finding:
    """Return whether the couplings agree with those of the model, where it has any."""
    # Position of each joint by closing joint, as the hand file has it.
    own = {c.joint: (f.closing_joint, c) for f in hand.fingers for c in f.coupled}
    faults = []

    # The model's own couplings.
    for mimic in declared_mimics(read_xml(hand.model.path)):
        if _moves_as(hand, mimic):
            continue
        if (driver := _driver(hand, mimic)) is not None:
            faults.append(driver)
            continue
        if mimic.joint not in own:
            faults.append(
                f"joint {mimic.joint!r} must be coupled to {mimic.leader!r} by {mimic.ratio:g} and "
                f"{mimic.offset:g}, as in the model"
            )
            continue
        leader, coupling = own[mimic.joint]
        faults.append(
            f"joint {mimic.joint!r} must follow {mimic.leader!r} by {mimic.ratio:g} and "
            f"{mimic.offset:g} as in the model, got {leader!r} by {coupling.ratio:g} and "
            f"{coupling.offset:g}"
        )
    joints = ", ".join(f"{joint} {c.ratio:+g}" for joint, (_, c) in own.items())
    return judge("couplings", faults, joints or "none")


def _driver(hand: Hand, mimic: Mimic) -> str | None:
    """Return what to write where one motor moves two fingers in the model; None elsewhere."""
    closes = {finger.closing_joint: finger.name for finger in hand.fingers}
    if not {mimic.joint, mimic.leader} <= set(closes) or mimic.ratio <= 0.0:
        return None
    i, leader = list(closes).index(mimic.joint), closes[mimic.leader]
    return (
        f"fingers.{i}.driven_by must be {{finger: {leader}, ratio: {mimic.ratio:g}}} in place of a "
        "motor of its own: in the model one moves both"
    )


def _moves_as(hand: Hand, mimic: Mimic) -> bool:
    """Return whether two joints of a hand move as a coupling of its model says."""
    if not {mimic.joint, mimic.leader} <= set(hand.joint_names):
        return False

    # Positions are linear in the coordinates: those of the spread, of a motor, or of none.
    j, i = (hand.joint_names.index(name) for name in (mimic.joint, mimic.leader))
    gains = hand.joint_gain @ block_diag(1.0, hand.closing_ratio)
    gain = gains[j] - mimic.ratio * gains[i]
    offset = hand.joint_offset[j] - mimic.ratio * hand.joint_offset[i] - mimic.offset
    return bool(np.abs(gain).max() <= SAME and abs(offset) <= SAME)


def check_efforts(hand: Hand, config: Config) -> Finding:
    """Return whether motors reach their efforts and close the hand in time, and what it presses."""
    # A motor is a gain on the lack of speed: a stalled one gives gain * speed, up to its limit.
    faults = []
    limits, units = coordinate_limits(hand)[1:, 1], hand.closing_unit
    for finger, speed, limit, unit in zip(
        hand.fingers, hand.closing_speed, limits, units, strict=True
    ):
        stalled = FINGER_DAMPING * speed / unit**2
        if finger.driven_by is None and stalled < finger.effort_limit:
            faults.append(
                f"finger {finger.name!r} must close fast enough for its motor: at its speed a "
                f"stalled one gives {stalled:.3g} of {finger.effort_limit:g} {finger.effort_unit}"
            )
        if np.isfinite(limit) and limit / speed > config.close.max_time:
            faults.append(
                f"finger {finger.name!r} must close within close.max_time, "
                f"{config.close.max_time:g} s, got {limit / speed:.2g} s"
            )

    # What the fingertips press with, and whether friction then carries the payload.
    forces = fingertip_forces(hand, "torque")
    carried = config.physics.friction_hand * float(forces.sum()) / 9.81
    if hand.payload is not None and carried < hand.payload:
        # Rounded down to grams: what is said must pass.
        most = np.floor(1e3 * carried) / 1e3
        faults.append(
            f"payload must be at most {most:g} kg, which friction carries, got {hand.payload:g} kg"
        )
    listed = ", ".join(f"{f:.3g}" for f in forces)
    carries = f"friction carries {carried:.2g} kg"
    return judge("efforts", faults, f"{drive_of(hand, config.lift)}; {listed} N; {carries}")


def _range(lower: float, upper: float) -> str:
    return f"{lower:.3g}..{upper:.3g}"


def _text(position: float, slides: bool) -> str:
    return f"{1e3 * position:.0f} mm" if slides else f"{np.rad2deg(position):.0f}°"
