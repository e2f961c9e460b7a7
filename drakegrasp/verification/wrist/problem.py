"""The wrist problem: which palm pose and joints bring the fingertips to given contacts?

In: a hand, k contact points with outward normals in {O}, and where the table is. Out: a
sum of squares to minimise, with exact gradients, and what must not be negative. Nothing is
solved here; `solver` does that.

The objective is that of Veres et al. (2017), appendix, sum |C_i - Y_i|^2 over the rotations
and translations of X_OG, with the hand's joints as further unknowns. Y_i is the predicted
point and C_i the point of fingertip i that is nearest to it: a real contact may lie anywhere
on a fingertip. Terms with small weights tell apart what the points leave open (own): each
pad should face the predicted normal, the fingers should close against it, contacts should
be near the hand file's pad points, and the joints near those of the start.

Unknowns x = (alpha, beta, gamma, t, c), n = 7 + k: with a start X_OS the palm is at
X_OG = X_OS X(Rx(alpha) Ry(beta) Rz(gamma), t), and c are the hand's coordinates (spread,
closing 1..k). Everything is computed in {G}, where the fingers are.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from drakegrasp.errors import HandError
from drakegrasp.frames import Array, make_pose
from drakegrasp.hand.description import Hand
from drakegrasp.hand.kinematics import coordinate_limits
from drakegrasp.hand.shapes import link_shapes
from drakegrasp.verification.wrist.pads import PadContact, Pads, make_pads, touch

#: Number of unknowns of the palm's pose: three rotations and three translations.
POSE = 6
#: What a small angle of one radian between a pad and the predicted normal counts as [m]. Like
#: the next weights it is the size of what simulated grasps show: half a millimetre between
#: point and pad goes with 7 degrees here, 24 degrees, 5 mm and 7 degrees there.
NORMAL_WEIGHT = 0.004
#: The same between a finger's closing motion and the predicted normal [m].
CLOSING_WEIGHT = 0.0012
#: What a metre between contact and pad point counts as [m].
PAD_WEIGHT = 0.1
#: What a radian between a joint and its place in the start counts as [m].
POSTURE_WEIGHT = 0.004
#: Rounding of the smooth minimum over a part's corners [m].
CLEARANCE_ROUNDING = 0.5e-3
_NEXT, _LAST = np.array([1, 2, 0]), np.array([2, 0, 1])
#: Vector times this, as 3 x 3, is the matrix of its cross product.
_SKEW = np.array([np.cross(e, np.eye(3)).T for e in np.eye(3)]).reshape(3, 9)


@dataclass(frozen=True, kw_only=True, eq=False)
class HandConstants:
    """A hand of k fingers with chains of m joints as stacked arrays; shorter chains are padded.

    Attributes:
        X_PJ: (m, k, 4, 4), of each joint in the turning frame before it; the first in {G}.
        axis: (m, k, 3), unit, in the joint's frame.
        cross, cross2: (m, k, 4, 4), the axis' cross product matrix and its square.
        gain: (m, k, 1 + k), angles per coordinate.
        finger_gain: (k, m, 1 + k), the same by finger.
        closing_gain: (m, k), angles per closing of the own finger.
        X_JFi: (k, 4, 4), fingertip links in the last joint's turning frame.
        pads: The fingertips' surfaces.
        pad_points: (k, 3), nominal contact points in {Fi} [m].
        limits: (1 + k, 2), of the coordinates [rad].
        fingertips: (k, n, 3), corners of the fingertips in {Fi} [m].
        palm: (n, 3), corners of the palm link in {G} [m].
    """

    X_PJ: Array
    axis: Array
    cross: Array
    cross2: Array
    gain: Array
    finger_gain: Array
    closing_gain: Array
    X_JFi: Array
    pads: Pads
    pad_points: Array
    limits: Array
    fingertips: Array
    palm: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class WristProblem:
    """Contacts to reach from a start; see the module.

    Attributes:
        constants: Of the hand.
        p_OQ, nhat_Q_O: (k, 3), predicted points [m] and outward unit normals in {O}.
        up_O: (3,), the table's upward normal in {O}.
        height: Of the origin of {O} above the table [m].
        X_OS: (4, 4), the palm's pose at x = 0.
        posture: (1 + k,), the coordinates to stay near to where contacts do not tell [rad].
    """

    constants: HandConstants
    p_OQ: Array
    nhat_Q_O: Array
    up_O: Array
    height: float
    X_OS: Array
    posture: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class Evaluation:
    """The problem at one x of n = 7 + k unknowns.

    Attributes:
        X_OG: (4, 4), palm pose.
        p_FiQ: (k, 3), the predicted points in the fingertips' frames [m].
        contact: Where they stand to the pads.
        pad_normals_O: (k, 3), outward normals of the pads there, in {O}.
        residuals: (r,), weighted misfits [m]; the objective is their sum of squares. Those of
            normals and closing directions are vectors expressed in {G}.
        jacobian: (r, n), their derivatives. Where the residual is a vector in {G} it is the
            derivative seen from {O}: not that of its three numbers, as {G} turns with x.
            The slope of the objective is exactly 2 residuals @ jacobian.
        clearance: (1 + k,), heights of palm and fingertips above the table [m].
        clearance_jacobian: (1 + k, n).
    """

    X_OG: Array
    p_FiQ: Array
    contact: PadContact
    pad_normals_O: Array
    residuals: Array
    jacobian: Array
    clearance: Array
    clearance_jacobian: Array


@lru_cache(maxsize=4)
def hand_constants(hand: Hand) -> HandConstants:
    """Return the constants of a hand.

    Raises:
        HandError: If its palm or a fingertip has no shape, or one that is not convex.
    """
    shapes = link_shapes(hand)
    for link in (hand.palm_link, *hand.fingertip_links):
        if not shapes[link]:
            raise HandError(f"{hand.sdf_path}: link {link!r} must have a collision shape, got none")
    corners = [np.concatenate(shapes[finger.fingertip]) for finger in hand.fingers]
    most = max(map(len, corners))
    # Repeated corners lower a smooth minimum by up to its rounding times the log of their number.
    padded = np.stack([np.pad(c, ((0, most - len(c)), (0, 0)), mode="edge") for c in corners])
    X_GB = np.linalg.inv(hand.X_BG)
    palm = np.concatenate(shapes[hand.palm_link]) @ X_GB[:3, :3].T + X_GB[:3, 3]
    chains = _stack_chains(hand)
    return HandConstants(
        **chains,
        pads=make_pads(corners),
        pad_points=np.array([finger.p_FiP for finger in hand.fingers]),
        limits=coordinate_limits(hand),
        fingertips=padded,
        palm=palm,
    )


def _stack_chains(hand: Hand) -> dict[str, Array]:
    m = max(len(chain.axis) for chain in hand.chains)
    X_PJ, axis, gain = [], [], []
    for chain in hand.chains:
        # A padding joint comes last, does not move and has no effect.
        missing = m - len(chain.axis)
        X_PJ.append(np.concatenate([chain.X_PJ, np.tile(np.eye(4), (missing, 1, 1))]))
        axis.append(np.concatenate([chain.axis, np.tile([0.0, 0.0, 1.0], (missing, 1))]))
        gain.append(np.pad(chain.gain, ((0, missing), (0, 0))))
    a, k = np.stack(axis, axis=1), len(hand.chains)
    cross = np.zeros((m, k, 4, 4))
    cross[..., :3, :3] = _skew(a)
    return {
        "X_PJ": np.stack(X_PJ, axis=1),
        "axis": a,
        "cross": cross,
        "cross2": cross @ cross,
        "gain": np.stack(gain, axis=1),
        "finger_gain": np.stack(gain),
        "closing_gain": np.stack(gain, axis=1)[:, range(k), 1 + np.arange(k)],
        "X_JFi": np.stack([chain.X_JFi for chain in hand.chains]),
    }


def evaluate(problem: WristProblem, x: Array) -> Evaluation:
    """Return residuals, clearances and their exact derivatives at x (n,)."""
    constants, coordinates = problem.constants, x[POSE:]
    k, n = len(problem.p_OQ), len(x)
    R_SG, spin_G = _rotation(x[:3])
    X_OG = problem.X_OS @ make_pose(R_SG, x[3:POSE])
    R_OG = X_OG[:3, :3]
    p_GQ, n_G = (problem.p_OQ - X_OG[:3, 3]) @ R_OG, problem.nhat_Q_O @ R_OG
    X_GF, axes, origins = _forward(constants, coordinates)
    R_GF = X_GF[:, :3, :3]
    R_FG = R_GF.transpose(0, 2, 1)

    # By each unknown: angular velocity of the fingers, and velocity of their material
    # points at Q, seen from {O} and expressed in {G}.
    arms = _cross(axes, p_GQ - origins)  # (m, k, 3)
    spin, velocity = np.zeros((k, 3, n)), np.empty((k, 3, n))
    spin[:, :, :3] = spin_G
    spin[:, :, POSE:] = np.matmul(axes.transpose(1, 2, 0), constants.finger_gain)
    velocity[:, :, :3] = -np.matmul(_skew(p_GQ), spin_G)
    velocity[:, :, 3:POSE] = R_SG.T
    velocity[:, :, POSE:] = np.matmul(arms.transpose(1, 2, 0), constants.finger_gain)

    p_FQ = np.matmul(R_FG, (p_GQ - X_GF[:, :3, 3])[:, :, None])[..., 0]
    dp_F = -np.matmul(R_FG, velocity)
    contact = touch(constants.pads, p_FQ)
    pad_G = np.matmul(R_GF, contact.normal[:, :, None])[..., 0]
    # Seen from {O} pad and closing direction turn with the palm, the prediction does not.
    dpad_G = np.matmul(np.matmul(R_GF, contact.normal_slope), dp_F)
    dpad_G -= np.matmul(_skew(pad_G), spin)
    closing, dclosing = _closing_direction(constants, p_GQ, axes, arms, velocity)
    dclosing[:, :, :3] -= np.matmul(_skew(closing), spin_G)

    residuals = np.concatenate(
        [
            contact.distance,
            NORMAL_WEIGHT * (pad_G + n_G).ravel(),
            CLOSING_WEIGHT * (closing + n_G).ravel(),
            PAD_WEIGHT * (p_FQ - constants.pad_points).ravel(),
            POSTURE_WEIGHT * (coordinates - problem.posture),
        ]
    )
    jacobian = np.zeros((len(residuals), n))
    jacobian[:k] = np.matmul(contact.gradient[:, None, :], dp_F)[:, 0]
    jacobian[k : 4 * k] = NORMAL_WEIGHT * dpad_G.reshape(-1, n)
    jacobian[4 * k : 7 * k] = CLOSING_WEIGHT * dclosing.reshape(-1, n)
    jacobian[7 * k : 10 * k] = PAD_WEIGHT * dp_F.reshape(-1, n)
    jacobian[10 * k :, POSE:] = POSTURE_WEIGHT * np.eye(n - POSE)
    clearance, clearance_jacobian = _clearance(problem, X_OG, R_SG, spin_G, X_GF, axes, origins)
    return Evaluation(
        X_OG=X_OG,
        p_FiQ=p_FQ,
        contact=contact,
        pad_normals_O=pad_G @ R_OG.T,
        residuals=residuals,
        jacobian=jacobian,
        clearance=clearance,
        clearance_jacobian=clearance_jacobian,
    )


def _cross(a: Array, b: Array) -> Array:
    """Return a x b of (..., 3); NumPy's own costs five times as much on a few vectors."""
    return np.asarray(
        a.take(_NEXT, axis=-1) * b.take(_LAST, axis=-1)
        - a.take(_LAST, axis=-1) * b.take(_NEXT, axis=-1)
    )


def _skew(a: Array) -> Array:
    """Return the matrices (..., 3, 3) whose product with a vector b is a x b."""
    return np.asarray((a @ _SKEW).reshape(*a.shape, 3))


def _rotation(angles: Array) -> tuple[Array, Array]:
    """Return R_SG = Rx Ry Rz, and as columns its angular velocity in {G} per angle."""
    (ca, cb, cg), (sa, sb, sg) = np.cos(angles).tolist(), np.sin(angles).tolist()
    Ryz = np.array([[cb * cg, -cb * sg, sb], [sg, cg, 0.0], [-sb * cg, sb * sg, cb]])
    Rx = np.array([[1.0, 0.0, 0.0], [0.0, ca, -sa], [0.0, sa, ca]])
    spin = np.array([[Ryz[0, 0], sg, 0.0], [Ryz[0, 1], cg, 0.0], [Ryz[0, 2], 0.0, 1.0]])
    return Rx @ Ryz, spin


def _forward(constants: HandConstants, coordinates: Array) -> tuple[Array, Array, Array]:
    """Return X_GFi (k, 4, 4), and of each joint its axis and origin (m, k, 3) in {G}."""
    angles = (constants.gain @ coordinates)[..., None, None]  # (m, k, 1, 1)
    # Rodrigues: R = 1 + sin(q) K + (1 - cos(q)) K K, here with room for positions.
    turn = np.eye(4) + np.sin(angles) * constants.cross + (1.0 - np.cos(angles)) * constants.cross2
    before = np.empty_like(constants.X_PJ)
    X = np.eye(4)
    for j, X_PJ in enumerate(constants.X_PJ):
        before[j] = X @ X_PJ
        X = before[j] @ turn[j]
    axes = np.matmul(before[..., :3, :3], constants.axis[..., None])[..., 0]
    return X @ constants.X_JFi, axes, before[..., :3, 3]


def _closing_direction(
    constants: HandConstants, p_GQ: Array, axes: Array, arms: Array, velocity: Array
) -> tuple[Array, Array]:
    """Return the unit direction in which each fingertip moves at Q when its finger closes.

    Directions (k, 3) in {G}, and their derivatives (k, 3, n) seen from {G}.
    """
    own = constants.closing_gain[..., None]  # (m, k, 1)
    turning, motion = own * axes, own * arms  # what each joint adds when the finger closes
    total_turning, total_motion = turning.sum(axis=0), motion.sum(axis=0)
    derivative = np.empty(velocity.shape)
    # Q is fixed in {O}: from a moving palm it is seen to move the other way.
    derivative[:, :, :POSE] = -np.matmul(_skew(total_turning), velocity[:, :, :POSE])
    # Joint j carries the screws of all later ones: a field v turned about an axis a changes
    # at a fixed point by a x v - (dv/dp) (a x arm).
    later_turning = total_turning - turning.cumsum(axis=0)
    later_motion = total_motion - motion.cumsum(axis=0)
    carried = _cross(axes, later_motion) - _cross(later_turning, arms)
    derivative[:, :, POSE:] = np.matmul(carried.transpose(1, 2, 0), constants.finger_gain)
    speed = np.sqrt((total_motion * total_motion).sum(axis=1))[:, None]
    direction = total_motion / speed
    along = np.matmul(direction[:, None, :], derivative)
    derivative -= direction[:, :, None] * along
    return direction, derivative / speed[:, :, None]


def _clearance(
    problem: WristProblem,
    X_OG: Array,
    R_SG: Array,
    spin_G: Array,
    X_GF: Array,
    axes: Array,
    origins: Array,
) -> tuple[Array, Array]:
    """Return smooth heights (1 + k,) of palm and fingertips over the table [m], and derivatives."""
    constants = problem.constants
    up_G = problem.up_O @ X_OG[:3, :3]
    base = problem.height + problem.up_O @ X_OG[:3, 3]
    palm, p_palm = _lowest((constants.palm @ up_G)[None], constants.palm[None])
    up_F = up_G @ X_GF[:, :3, :3]
    corners = constants.fingertips
    tips, p_F = _lowest(np.matmul(corners, up_F[:, :, None])[..., 0], corners)
    p_tips = np.matmul(X_GF[:, :3, :3], p_F[:, :, None])[..., 0] + X_GF[:, :3, 3]
    jacobian = np.zeros((1 + len(tips), POSE + len(tips) + 1))
    jacobian[:, :3] = _cross(np.concatenate([p_palm, p_tips]), up_G) @ spin_G
    jacobian[:, 3:POSE] = R_SG @ up_G
    arms = _cross(axes, p_tips - origins) @ up_G  # (m, k)
    jacobian[1:, POSE:] = np.matmul(arms.T[:, None, :], constants.finger_gain)[:, 0]
    return base + np.concatenate([palm, tips + X_GF[:, :3, 3] @ up_G]), jacobian


def _lowest(heights: Array, points: Array) -> tuple[Array, Array]:
    """Return the smooth minimum of heights (g, n), and the points (g, 3) that it weighs."""
    scaled = heights / -CLEARANCE_ROUNDING
    highest = scaled.max(axis=1)
    weight = np.exp(scaled - highest[:, None])
    total = weight.sum(axis=1)
    weight /= total[:, None]
    minimum = -CLEARANCE_ROUNDING * (highest + np.log(total))
    return minimum, np.matmul(weight[:, None, :], points)[:, 0]
