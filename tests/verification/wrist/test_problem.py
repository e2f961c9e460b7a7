"""The wrist problem: its gradients, and what is left of it, for hands of all kinds."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
from helpers.hands import PINCER, write_pincer
from scipy.spatial.transform import Rotation

from drakegrasp.frames import make_pose, transform_points
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.kinematics import fingertip_poses
from drakegrasp.verification.wrist_problem import (
    CLOSING_WEIGHT,
    NORMAL_WEIGHT,
    POSE,
    POSTURE_WEIGHT,
    WristProblem,
    evaluate,
    hand_constants,
    signed_distance,
)

SEEDS = range(12)


@cache
def hand_of(name):
    return load_hand(name)


@pytest.fixture(scope="module", params=["barrett", "pincer", "allegro", "franka"])
def name(request, tmp_path_factory):
    """Hands with a spread, with one joint per finger, with a preshape, with fingers that slide."""
    if request.param != "pincer":
        return str(request.param)
    return str(write_pincer(tmp_path_factory.mktemp("pincer"), fingers=with_regions()))


def with_regions():
    """Return the gripper's fingers with pads that face each other, on the outer 4 cm."""
    return [
        {**finger, "pad_region": [[0, 2.0 * inward, 0, 0], [0, 0, 1, 0.06]]}
        for finger, inward in zip(PINCER["fingers"], (1.0, -1.0), strict=True)
    ]


def unit(vectors):
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def random_pose(rng):
    return make_pose(Rotation.random(random_state=rng).as_matrix(), rng.uniform(-0.3, 0.3, 3))


def random_problem(name, seed):
    """Return contacts some centimetres off a hand's fingertips, and an x away from the start."""
    rng = np.random.default_rng(seed)
    hand, X_OS = hand_of(name), random_pose(rng)
    k, (lower, upper) = hand.num_fingers, hand_constants(hand).limits.T
    c = rng.uniform(lower, upper)
    X_GF = fingertip_poses(hand, spread=c[0], closing=hand.closing_ratio @ c[1:])
    pads = np.array([finger.p_FiP for finger in hand.fingers])
    p_GQ = np.einsum("kab,kb->ka", X_GF[:, :3, :3], pads) + X_GF[:, :3, 3]
    problem = WristProblem(
        constants=hand_constants(hand_of(name)),
        p_OQ=transform_points(X_OS, p_GQ + rng.normal(scale=0.015, size=(k, 3))),
        nhat_Q_O=unit(rng.normal(size=(k, 3))),
        up_O=unit(rng.normal(size=3)),
        height=0.2,
        X_OS=X_OS,
        posture=rng.uniform(lower, upper),
    )
    pose = np.concatenate([rng.uniform(-1.2, 1.2, 3), rng.normal(scale=0.03, size=3)])
    return problem, np.concatenate([pose, c + rng.normal(scale=0.2, size=len(c))])


def differences(function, x, h=1e-06):
    """Return the derivative of a function of x by central differences, x last."""
    steps = h * np.eye(len(x))
    return np.stack([(function(x + s) - function(x - s)) / (2.0 * h) for s in steps], axis=-1)


TERMS = ("distance", "normal", "closing", "pad", "posture", "region")


def terms(hand):
    """Return which residuals of a hand's k fingers and m motors are of which term."""
    k, m = hand.closing_ratio.shape
    ends = np.cumsum([0, k, 3 * k, 3 * k, 3 * k, 1 + m, 2 * k])
    return {t: slice(a, b) for t, a, b in zip(TERMS, ends[:-1], ends[1:], strict=True)}


@pytest.mark.parametrize("term", TERMS)
def test_slope_of_each_term_is_that_of_finite_differences(name, term):
    """A term with a small weight could hide an error behind the others."""
    problem, x = random_problem(name, 90)
    at = evaluate(problem, x)
    hand = hand_of(name)
    assert at.contact.outside.max() > 1e-3
    rows = terms(hand)[term]
    assert terms(hand)["region"].stop == len(at.residuals)

    def share(x):
        residuals = evaluate(problem, x).residuals[rows]
        return np.asarray(residuals @ residuals)

    slope = differences(share, x)
    own = 2.0 * at.residuals[rows] @ at.jacobian[rows]
    np.testing.assert_allclose(own, slope, atol=1e-6 * np.abs(slope).max(), rtol=1e-5)


@pytest.mark.parametrize("seed", SEEDS)
def test_slope_of_the_clearance_is_that_of_finite_differences(name, seed):
    problem, x = random_problem(name, seed)
    slope = differences(lambda x: evaluate(problem, x).clearance, x)
    np.testing.assert_allclose(evaluate(problem, x).clearance_jacobian, slope, atol=1e-6)


def test_a_finger_closed_against_its_contact_leaves_little(name):
    """Contacts on the nominal points, normals against the pads: only rounding is left."""
    hand, constants = hand_of(name), hand_constants(hand_of(name))
    c = constants.limits.mean(axis=1)
    c *= np.where(np.arange(len(c)) == 0, 0.2, 0.8)
    X_GF = fingertip_poses(hand, spread=c[0], closing=hand.closing_ratio @ c[1:])
    contact = signed_distance(constants.pads, constants.pad_points)
    on_pad = constants.pad_points - contact.distance[:, None] * contact.normal
    turn = partial(np.einsum, "kab,kb->ka", X_GF[:, :3, :3])
    problem = WristProblem(
        constants=constants,
        p_OQ=turn(on_pad) + X_GF[:, :3, 3],
        nhat_Q_O=-turn(contact.normal),
        up_O=np.array([0.0, 0.0, 1.0]),
        height=1.0,
        X_OS=np.eye(4),
        posture=c,
    )
    x = np.concatenate([np.zeros(POSE), c])
    at, rows = evaluate(problem, x), terms(hand)
    assert np.abs(at.residuals[rows["distance"]]).max() < 1e-4
    assert np.abs(at.residuals[rows["normal"]]).max() < 0.05 * NORMAL_WEIGHT
    np.testing.assert_array_equal(at.residuals[rows["posture"]], 0.0)
    # With the normals reversed each finger would open towards its contact.
    reversed_ = evaluate(replace(problem, nhat_Q_O=-problem.nhat_Q_O), x)
    right, wrong = (
        np.linalg.norm(e.residuals[rows["closing"]].reshape(-1, 3), axis=1) / CLOSING_WEIGHT
        for e in (at, reversed_)
    )
    assert np.all(right < 1.0)
    assert np.all(wrong > 1.7)


def test_posture_counts_a_slide_in_tenths_of_a_metre(name):
    """A motor that is off by 0.1 m weighs as much as one that is off by a radian."""
    problem, x = random_problem(name, 3)
    hand = hand_of(name)
    slides = np.array([hand.fingers[i].slides for i in hand.motor_fingers])
    off = np.r_[1.0, np.where(slides, 0.1, 1.0)]
    x[POSE:] = problem.posture + off
    posture = evaluate(problem, x).residuals[terms(hand)["posture"]]
    np.testing.assert_allclose(posture, POSTURE_WEIGHT)
