"""The order of the checks of a hand.

In: a hand's name or file. Out: a `Finding` per check. A check that others rely on comes before
them, and where it fails they are left out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from drakegrasp.commissioning import model_checks, motion_checks, pad_checks
from drakegrasp.commissioning.finding import Finding
from drakegrasp.commissioning.trial_grasps import GRASPS, check_grasp
from drakegrasp.config import Config
from drakegrasp.errors import HandError
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.settings import load_config
from drakegrasp.hand.shapes import link_shapes
from drakegrasp.runtime.environment import one_thread


@one_thread
def check_hand(
    name_or_yaml: str | Path,
    *,
    config: Config | None = None,
    report: Callable[[Finding], None] | None = None,
) -> list[Finding]:
    """Return what is right and wrong about a hand.

    Args:
        name_or_yaml: A hand that comes with the package, or a hand file.
        config: The rules of its trial grasps; the defaults if None.
        report: Is called with each finding when it is there.
    """
    findings = []
    for finding in _findings(name_or_yaml, config or load_config()):
        findings.append(finding)
        if report is not None:
            report(finding)
    return findings


def _findings(name_or_yaml: str | Path, config: Config) -> Iterator[Finding]:
    """Yield the findings, up to the first check without which others make no sense."""
    # The files: without them there is no hand.
    try:
        hand = load_hand(name_or_yaml)
        shapes = link_shapes(hand)
    except HandError as error:
        yield Finding(name="files", ok=False, text=str(error))
        return
    count = sum(map(len, shapes.values()))
    yield Finding(
        name="files",
        ok=True,
        text=f"{hand.num_fingers} fingers, {len(hand.joint_names)} joints, {count} shapes in "
        f"{hand.model.path.name}",
    )

    # Masses, limits and couplings; the rest closes the hand, for which it needs its limits.
    yield model_checks.check_masses(hand)
    limits = model_checks.check_limits(hand)
    yield limits
    yield model_checks.check_couplings(hand)
    if not limits.ok:
        return
    yield model_checks.check_efforts(hand, config)

    # Geometry, then grasps.
    sound = True
    for finding in check_geometry(hand):
        sound = sound and finding.ok
        yield finding
    if sound:
        for shape, line in GRASPS:
            yield check_grasp(hand, config, shape, line)


def check_geometry(hand: Hand) -> Iterator[Finding]:
    """Yield what is right and wrong about a hand's geometry; nothing is simulated."""
    # Seen from behind, fingers run the other way round.
    palm = motion_checks.check_palm(hand)
    yield palm
    if not palm.ok:
        return
    yield motion_checks.check_order(hand)
    pads = pad_checks.check_pads(hand)
    yield pads
    if pads.ok:
        yield motion_checks.check_meeting(hand)
    yield motion_checks.check_overlaps(hand)
