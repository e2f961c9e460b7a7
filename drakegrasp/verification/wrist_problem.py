"""The wrist problem: which palm pose and joints bring the fingertips to given contacts?

Input: a hand, k contact points with outward normals in {O}, and the height of the table. Output:
the residuals whose sum of squares is minimised, and the clearances that must not be negative, with
exact derivatives. `wrist_solver` minimises.

The objective is that of Veres et al. (2017), appendix: sum |C_i - Y_i|^2 over the rotations and
translations of X_OG. Here the hand's joints are further unknowns. Y_i is the predicted point, and
C_i the closest point of fingertip i, because a real contact may lie anywhere on a fingertip. Terms
with small weights (our own) decide what the points leave open: each pad should face the predicted
normal, each finger should close against it, the contacts should be near the hand file's pad points,
and the joints near those of the start. `evaluate` has the formulas.

The surfaces of the fingertips are smooth signed distances (`Pads`). The distance of p from a convex
body with face planes n_j . p = d_j is at least the largest of n_j . p - d_j, and equal to it in
front of a face. Here the largest is replaced by the smooth maximum s log sum exp((n_j . p - d_j)/s)
(Boyd and Vandenberghe, "Convex Optimization", 3.1.5), which rounds edges with a radius of about s.

A fingertip may only touch within its pad region. The planes of the region are not surface, so the
distance is that of the whole fingertip, and the distance of a point outside the region is a
separate value. A point on the fingertip but outside the region is about that far from the pad.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt
import trimesh
from scipy.linalg import block_diag
from scipy.spatial import ConvexHull

from drakegrasp.errors import HandError
from drakegrasp.frames import Array, make_pose, transform_points
from drakegrasp.hand.description import Hand
from drakegrasp.hand.file_format import HalfSpace
from drakegrasp.hand.kinematics import coordinate_limits, link_poses, still_links
from drakegrasp.hand.shapes import link_shapes, pad_surfaces

#: Rounding s of the edges [m], about as large as the unevenness of the pads.
ROUNDING = 0.7e-3
#: Faces whose normals and offsets agree to this many decimals are one plane.
SAME_PLANE = 6


@dataclass(frozen=True, kw_only=True, eq=False)
class Pads:
    """The surfaces of k fingertips, each with m planes and h half-spaces (padded).

    Attributes:
        normals: (k, m, 3), unit, outward, in each fingertip's frame.
        offsets: (k, m), n . p on the plane [m]; padded with planes at infinity.
        region_normals: (k, h, 3), unit, into the pad region; padded with zeros.
        region_offsets: (k, h), n . p on the border of the region [m]; padded with -1.
        triangles: For each fingertip (t, 3, 3), the corners of its pad's triangles [m].
    """

    normals: Array
    offsets: Array
    region_normals: Array
    region_offsets: Array
    triangles: tuple[Array, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class PadContact:
    """Distances and normals of k pads, each at one point.

    Attributes:
        distance: (k,), smooth signed distance from the pad, negative inside [m].
        normal: (k, 3), unit outward normal of the pad next to the point.
        gradient: (k, 3), derivative of `distance` with respect to the point; it is parallel to
            `normal`, and shorter than one at edges.
        normal_jacobian: (k, 3, 3), derivative of `normal` with respect to the point [1/m].
        outside: (k, h), distance of the point outside each half-space of the pad region [m], 0
            inside.
        outside_gradient: (k, h, 3), derivative of `outside` with respect to the point.
    """

    distance: Array
    normal: Array
    gradient: Array
    normal_jacobian: Array
    outside: Array
    outside_gradient: Array


def make_pads(
    corners: Sequence[Array], regions: Sequence[Sequence[HalfSpace]], triangles: Sequence[Array]
) -> Pads:
    """Return the pads of k fingertips.

    Args:
        corners: (n, 3) for each fingertip; its shape is their convex hull [m].
        regions: Half-spaces of each pad.
        triangles: (t, 3, 3) for each fingertip, surface of its pad, see
            `hand.shapes.pad_surfaces` [m].
    """
    # The planes of each hull; a row of equations is a unit normal and minus the offset.
    hulls = [ConvexHull(points) for points in corners]
    planes = [np.unique(np.round(hull.equations, SAME_PLANE), axis=0) for hull in hulls]

    # Stack the planes; a plane at infinity never has the largest n . p - d.
    most = max(map(len, planes))
    normals = np.zeros((len(planes), most, 3))
    offsets = np.full((len(planes), most), np.inf)
    for i, equations in enumerate(planes):
        normals[i, : len(equations)] = equations[:, :3]
        offsets[i, : len(equations)] = -equations[:, 3]

    # Stack the half-spaces; a half-space with zero normal and border -1 contains every point.
    most = max(map(len, regions))
    region_normals = np.zeros((len(planes), most, 3))
    region_offsets = np.full((len(planes), most), -1.0)
    for i, region in enumerate(regions):
        for j, (*normal, offset) in enumerate(region):
            length = np.linalg.norm(normal)
            region_normals[i, j] = np.array(normal) / length
            region_offsets[i, j] = offset / length

    return Pads(
        normals=normals,
        offsets=offsets,
        region_normals=region_normals,
        region_offsets=region_offsets,
        triangles=tuple(triangles),
    )


def nearest_on_pads(pads: Pads, p_FiQ: Array) -> Array:
    """Return the point of each pad, without rounding, that is closest to a point.

    Args:
        pads: Pads of k fingertips.
        p_FiQ: (k, 3), a point in each fingertip's frame [m].

    Returns:
        (k, 3), in the fingertips' frames [m].
    """
    nearest = []
    for triangles, point in zip(pads.triangles, p_FiQ, strict=True):
        near = trimesh.triangles.closest_point(triangles, np.tile(point, (len(triangles), 1)))
        nearest.append(near[np.argmin(np.sum((near - point) ** 2, axis=1))])
    return np.array(nearest)


def signed_distance(pads: Pads, p_FiQ: Array) -> PadContact:
    """Return the smooth signed distance of each point from its pad, with derivatives.

    With the heights h_j = n_j·p − d_j of a point p over the face planes and the rounding s:

        φ = s log Σ_j exp(h_j / s),   max h_j ≤ φ ≤ max h_j + s log M for M planes
        w_j = exp(h_j / s) / Σ exp(h_j / s)
        g = ∇φ = Σ_j w_j n_j
        H = ∇∇φ = (Σ_j w_j n_j n_jᵀ − g gᵀ) / s
        m = g / |g|,   ∂m/∂p = (1 − m mᵀ) H / |g|

    (Boyd and Vandenberghe, 3.1.5). A point is outside a half-space n·p ≥ d of the pad region by
    o = max(0, d − n·p).

    Args:
        pads: Pads of k fingertips.
        p_FiQ: (k, 3), a point in each fingertip's frame [m].
    """
    # The smooth maximum of the heights over the planes, and the weights of the planes.
    height = (np.matmul(pads.normals, p_FiQ[:, :, None])[..., 0] - pads.offsets) / ROUNDING
    highest = height.max(axis=1)
    weight = np.exp(height - highest[:, None])
    total = weight.sum(axis=1)
    weight /= total[:, None]

    # First and second derivatives with respect to the point.
    gradient = np.matmul(weight[:, None, :], pads.normals)[:, 0]
    weighted = pads.normals * weight[:, :, None]
    outer = gradient[:, :, None] * gradient[:, None, :]
    hessian = (np.matmul(weighted.transpose(0, 2, 1), pads.normals) - outer) / ROUNDING

    # The normal m = g / |g|; its derivative is (1 - m m') H / |g|.
    length = np.sqrt((gradient * gradient).sum(axis=1))
    normal = gradient / length[:, None]
    along = np.matmul(normal[:, None, :], hessian)
    normal_jacobian = (hessian - normal[:, :, None] * along) / length[:, None, None]

    # The distance of the point outside the pad region.
    outside = pads.region_offsets - np.matmul(pads.region_normals, p_FiQ[:, :, None])[..., 0]

    return PadContact(
        distance=ROUNDING * (highest + np.log(total)),
        normal=normal,
        gradient=gradient,
        normal_jacobian=normal_jacobian,
        outside=np.maximum(outside, 0.0),
        outside_gradient=-pads.region_normals * (outside > 0.0)[..., None],
    )


#: A vector times this, reshaped to 3 x 3, is the matrix of its cross product.
_SKEW = np.array([np.cross(e, np.eye(3)).T for e in np.eye(3)]).reshape(3, 9)


@dataclass(frozen=True, kw_only=True, eq=False)
class HandConstants:
    """A hand with k fingers and chains of m joints as stacked arrays; shorter chains are padded.

    Attributes:
        X_PJ: (m, k, 4, 4), pose of each joint in the moving frame of the previous joint; the first
            joint's pose is in {G}.
        axis: (m, k, 3), unit axis in the joint's frame; zero if the joint slides.
        slide: (m, k, 3), unit direction in the joint's frame; zero if the joint turns.
        slides: (m, k), whether the joint slides.
        twist, twist2: (m, k, 4, 4), matrix of the joint's motion per position, and its square. It
            is the cross product by the joint's axis, or the translation along its direction.
        gain: (m, k, 1 + k), joint position per coordinate.
        offset: (m, k), joint positions at zero coordinates [rad or m].
        finger_gain: (k, m, 1 + k), the gain by finger.
        closing_gain: (m, k), joint position per closing position of the joint's own finger.
        X_JFi: (k, 4, 4), pose of the fingertip link in the moving frame of the last joint.
        pads: The fingertips' surfaces.
        pad_points: (k, 3), nominal contact points in {Fi} [m].
        limits: (1 + m, 2), limits of the coordinates: the spread, and the closing of each finger
            with its own motor [rad or m].
        units: (1 + m,), change of each coordinate that is treated as equal to one radian [rad or
            m].
        fingertips: (k, n, 3), corners of the fingertips in {Fi} [m].
        closing_ratio: (k, m), see `Hand.closing_ratio`.
        motor_of: (k,), the motor that moves each finger.
        palm: (n, 3), corners of the palm and of the links fixed to it, in {G} [m].
    """

    X_PJ: Array
    axis: Array
    slide: Array
    slides: Array
    twist: Array
    twist2: Array
    gain: Array
    offset: Array
    finger_gain: Array
    closing_gain: Array
    X_JFi: Array
    pads: Pads
    pad_points: Array
    limits: Array
    units: Array
    fingertips: Array
    palm: Array
    closing_ratio: Array
    motor_of: npt.NDArray[np.int64]


@lru_cache(maxsize=4)
def hand_constants(hand: Hand) -> HandConstants:
    """Return the constants of a hand.

    Raises:
        HandError: If the palm or a fingertip has no shape, or a shape that is not convex.
    """
    # The palm and the fingertips need shapes; a palm's shapes may be on links fixed to it.
    shapes = link_shapes(hand.model)
    still = [link for link in still_links(hand) if shapes[link]]
    missing = [] if still else [hand.palm_link]
    missing += [link for link in hand.fingertip_links if not shapes[link]]
    if missing:
        raise HandError(
            f"{hand.model.path}: link {missing[0]!r} must have a collision shape, got none"
        )

    # Corners of the fingertips, stacked.
    corners = [np.concatenate(shapes[finger.fingertip]) for finger in hand.fingers]
    most = max(map(len, corners))
    # n copies of a corner lower the smooth minimum by at most its rounding times log n.
    padded = np.stack([np.pad(c, ((0, most - len(c)), (0, 0)), mode="edge") for c in corners])

    # Corners of the palm, from the links' frames to {G}.
    open_hand = np.zeros(hand.num_fingers)
    palm = np.concatenate(
        [
            transform_points(
                link_poses(hand, link, spread=0.0, closing=open_hand), np.concatenate(shapes[link])
            )
            for link in still
        ]
    )

    chains = _stack_chains(hand)
    moved = [0, *(1 + i for i in hand.motor_fingers)]
    return HandConstants(
        **chains,
        pads=make_pads(
            corners,
            [finger.pad_region for finger in hand.fingers],
            pad_surfaces(hand.model, hand.fingers),
        ),
        pad_points=np.array([finger.p_FiP for finger in hand.fingers]),
        limits=coordinate_limits(hand)[moved],
        units=np.r_[1.0, hand.closing_unit][moved],
        closing_ratio=hand.closing_ratio,
        motor_of=hand.motor_of,
        fingertips=padded,
        palm=palm,
    )


def _stack_chains(hand: Hand) -> dict[str, Array]:
    """Return the attributes of `HandConstants` that describe the joints, by name."""
    # Pad all chains to the length of the longest.
    m = max(len(chain.axis) for chain in hand.chains)
    X_PJ, axis, slides, gain, offset = [], [], [], [], []
    for chain in hand.chains:
        # Padding joints come last and do not move, so they have no effect.
        missing = m - len(chain.axis)
        X_PJ.append(np.concatenate([chain.X_PJ, np.tile(np.eye(4), (missing, 1, 1))]))
        axis.append(np.concatenate([chain.axis, np.tile([0.0, 0.0, 1.0], (missing, 1))]))
        slides.append(np.pad(chain.slides, (0, missing)))
        gain.append(np.pad(chain.gain, ((0, missing), (0, 0))))
        offset.append(np.pad(chain.offset, (0, missing)))

    # The motions of the joints as matrices: the cross product by an axis, or a translation.
    along, sliding = np.stack(axis, axis=1), np.stack(slides, axis=1)
    turn = np.where(sliding[..., None], 0.0, along)
    slide = np.where(sliding[..., None], along, 0.0)
    k = len(hand.chains)
    by_motor = block_diag(1.0, hand.closing_ratio)
    twist = np.zeros((m, k, 4, 4))
    twist[..., :3, :3] = skew(turn)
    twist[..., :3, 3] = slide

    return {
        "X_PJ": np.stack(X_PJ, axis=1),
        "axis": turn,
        "slide": slide,
        "slides": sliding,
        "twist": twist,
        "twist2": twist @ twist,
        "gain": np.stack(gain, axis=1) @ by_motor,
        "offset": np.stack(offset, axis=1),
        "finger_gain": np.stack(gain) @ by_motor,
        "closing_gain": np.stack(gain, axis=1)[:, range(k), 1 + np.arange(k)],
        "X_JFi": np.stack([chain.X_JFi for chain in hand.chains]),
    }


def skew(a: Array) -> Array:
    """Return the matrices (..., 3, 3) of the cross products with vectors a (..., 3)."""
    return np.asarray((a @ _SKEW).reshape(*a.shape, 3))


#: Number of unknowns of the palm's pose: three angles and three translations.
POSE = 6
#: Weight w_n of the angle between a pad and the predicted normal [m/rad]. The weights are ratios
#: that were found in simulated grasps: half a millimetre between point and pad corresponds to 7
#: degrees of this angle, 24 degrees of the closing motion, 5 mm along the pad, and 7 degrees of a
#: joint.
NORMAL_WEIGHT = 0.004
#: Weight w_v of the angle between a finger's closing motion and the predicted normal [m/rad].
CLOSING_WEIGHT = 0.0012
#: Weight w_p of the distance between contact and pad point, without unit.
PAD_WEIGHT = 0.1
#: Weight w_c of the angle between a joint and its value at the start [m/rad].
POSTURE_WEIGHT = 0.004
#: Rounding of the smooth minimum over the corners of a link [m].
CLEARANCE_ROUNDING = 0.5e-3
#: Indices of the two other axes, in the order of a cross product.
_NEXT, _LAST = np.array([1, 2, 0]), np.array([2, 0, 1])


@dataclass(frozen=True, kw_only=True, eq=False)
class WristProblem:
    """Contacts to reach, and a start for the search.

    Attributes:
        constants: Constants of the hand.
        p_OQ, nhat_Q_O: (k, 3), predicted points [m] and outward unit normals in {O}.
        up_O: (3,), the table's upward normal in {O}.
        height: Height of the origin of {O} above the table [m].
        X_OS: (4, 4), palm pose of the start, at zero angles and translations.
        posture: (1 + m,), starting coordinates [rad, or m if a finger slides]; coordinates that the
            contacts do not determine stay near these values.
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
    """The problem at one point x of its n = 7 + m unknowns; see `evaluate`.

    Attributes:
        X_OG: (4, 4), palm pose.
        p_FiQ: (k, 3), the predicted points in the fingertips' frames [m].
        contact: Distances of the points from the pads, and the pads' normals.
        pad_normals_O: (k, 3), outward normals of the pads there, in {O}.
        residuals: (r,), weighted misfits [m]; the objective is their sum of squares. The residuals
            of normals and closing directions are vectors expressed in {G}.
        jacobian: (r, n), derivatives of the residuals. For a residual that is a vector expressed in
            {G}, it is the derivative as seen from {O}, not that of its three components, because
            {G} turns with x. The gradient of the objective is exactly 2 residuals @ jacobian.
        clearance: (1 + k,), heights of palm and fingertips above the table [m].
        clearance_jacobian: (1 + k, n), derivatives of the heights.
    """

    X_OG: Array
    p_FiQ: Array
    contact: PadContact
    pad_normals_O: Array
    residuals: Array
    jacobian: Array
    clearance: Array
    clearance_jacobian: Array


def evaluate(problem: WristProblem, x: Array) -> Evaluation:
    """Return residuals, clearances and their exact derivatives.

    The unknowns are x = (alpha, beta, gamma, t, c), n = 7 + m. With the start X_OS, the palm is at

        X_OG = X_OS X(Rx(alpha) Ry(beta) Rz(gamma), t),

    and c = (spread, closing of each of the m fingers with a motor). The objective is

        sum_i  phi_i^2 + w_n^2 |m_i + n_i|^2 + w_v^2 |v_i + n_i|^2 + w_p^2 |p_FiQi - p_FiP|^2
        + w_c^2 |c - c_S|^2 + |o_i|^2

    where phi_i is the distance of the predicted point Q_i from the surface of fingertip i, m_i the
    pad's outward normal there (`signed_distance`), n_i the predicted outward normal, v_i the unit
    direction in which fingertip i moves at Q_i when its finger closes, p_FiP the hand file's pad
    point, c_S the coordinates of the start, and o_i the distance of Q_i outside each half-space of
    the pad region of finger i. The weights are `NORMAL_WEIGHT` (w_n), `CLOSING_WEIGHT` (w_v),
    `PAD_WEIGHT` (w_p) and `POSTURE_WEIGHT` (w_c). The residuals are the terms in this order,
    unsquared. Coordinates of fingers that slide are weighted in units of `Hand.closing_unit`. The
    constraints are that the clearances are not negative. They are the smooth minima of the heights
    of palm and fingertips over the table.

    Args:
        problem: The contacts and the start.
        x: (n,), angles [rad], translation [m], coordinates [rad or m].
    """
    # The palm, the contacts in {G}, and the fingers.
    constants, coordinates = problem.constants, x[POSE:]
    k, n = len(problem.p_OQ), len(x)
    R_SG, spin_G = _rotation(x[:3])
    X_OG = problem.X_OS @ make_pose(R_SG, x[3:POSE])
    R_OG = X_OG[:3, :3]
    p_GQ, n_G = (problem.p_OQ - X_OG[:3, 3]) @ R_OG, problem.nhat_Q_O @ R_OG
    X_GF, axes, slides, origins = _forward(constants, coordinates)
    R_GF = X_GF[:, :3, :3]
    R_FG = R_GF.transpose(0, 2, 1)

    # Per unknown: angular velocity of the fingertips, and velocity of their material points at
    # Q, seen from {O} and expressed in {G}.
    arms = _cross(axes, p_GQ - origins) + slides  # (m, k, 3)
    spin, velocity = np.zeros((k, 3, n)), np.empty((k, 3, n))
    spin[:, :, :3] = spin_G
    spin[:, :, POSE:] = np.matmul(axes.transpose(1, 2, 0), constants.finger_gain)
    velocity[:, :, :3] = -np.matmul(skew(p_GQ), spin_G)
    velocity[:, :, 3:POSE] = R_SG.T
    velocity[:, :, POSE:] = np.matmul(arms.transpose(1, 2, 0), constants.finger_gain)

    # Distance phi of each point from its pad, and the pad's normal m. Seen from {O}, the pad turns
    # with the palm and the finger, while the predicted normal does not turn.
    p_FQ = np.matmul(R_FG, (p_GQ - X_GF[:, :3, 3])[:, :, None])[..., 0]
    dp_F = -np.matmul(R_FG, velocity)
    contact = signed_distance(constants.pads, p_FQ)
    pad_G = np.matmul(R_GF, contact.normal[:, :, None])[..., 0]
    dpad_G = np.matmul(np.matmul(R_GF, contact.normal_jacobian), dp_F)
    dpad_G -= np.matmul(skew(pad_G), spin)

    # Closing direction v, which also turns with the palm.
    closing, dclosing = _closing_direction(constants, axes, arms, velocity)
    dclosing[:, :, :3] -= np.matmul(skew(closing), spin_G)

    # The residuals and their derivatives, term by term.
    residuals = np.concatenate(
        [
            contact.distance,
            NORMAL_WEIGHT * (pad_G + n_G).ravel(),
            CLOSING_WEIGHT * (closing + n_G).ravel(),
            PAD_WEIGHT * (p_FQ - constants.pad_points).ravel(),
            POSTURE_WEIGHT * (coordinates - problem.posture) / constants.units,
            contact.outside.ravel(),
        ]
    )
    jacobian = np.zeros((len(residuals), n))
    jacobian[:k] = np.matmul(contact.gradient[:, None, :], dp_F)[:, 0]
    jacobian[k : 4 * k] = NORMAL_WEIGHT * dpad_G.reshape(-1, n)
    jacobian[4 * k : 7 * k] = CLOSING_WEIGHT * dclosing.reshape(-1, n)
    jacobian[7 * k : 10 * k] = PAD_WEIGHT * dp_F.reshape(-1, n)
    jacobian[10 * k : 10 * k + n - POSE, POSE:] = POSTURE_WEIGHT * np.diag(1.0 / constants.units)
    jacobian[10 * k + n - POSE :] = np.matmul(contact.outside_gradient, dp_F).reshape(-1, n)

    # The heights over the table.
    clearance, clearance_jacobian = _clearance(
        problem, X_OG, R_SG, spin_G, X_GF, (axes, slides, origins)
    )

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
    """Return a x b of (..., 3); for few vectors it is five times as fast as NumPy's function."""
    return np.asarray(
        a.take(_NEXT, axis=-1) * b.take(_LAST, axis=-1)
        - a.take(_LAST, axis=-1) * b.take(_NEXT, axis=-1)
    )


def _rotation(angles: Array) -> tuple[Array, Array]:
    """Return R_SG = Rx Ry Rz, and its angular velocities in {G} per angle, as columns (3, 3)."""
    (ca, cb, cg), (sa, sb, sg) = np.cos(angles).tolist(), np.sin(angles).tolist()
    Ryz = np.array([[cb * cg, -cb * sg, sb], [sg, cg, 0.0], [-sb * cg, sb * sg, cb]])
    Rx = np.array([[1.0, 0.0, 0.0], [0.0, ca, -sa], [0.0, sa, ca]])
    spin = np.array([[Ryz[0, 0], sg, 0.0], [Ryz[0, 1], cg, 0.0], [Ryz[0, 2], 0.0, 1.0]])
    return Rx @ Ryz, spin


def _forward(constants: HandConstants, coordinates: Array) -> tuple[Array, Array, Array, Array]:
    """Return X_GFi (k, 4, 4), and each joint's axis, direction and origin (m, k, 3) in {G}.

    A joint that slides has a zero axis, and a joint that turns has a zero direction. From the palm
    outwards the poses are

        X_GF = Π_j X_PJ(j) M_j(q_j) · X_JF,   q_j = Σ_c gain_jc c + offset_j,
        M(q) = 1 + sin(q) K + (1 − cos(q)) K K   (Rodrigues; turns)
        M(q) = 1 + q K                           (slides)

    with the 4 × 4 matrix K of the joint's motion per position: the cross product with its axis, or
    the translation along its direction, whose square is zero.
    """
    # `frames.rotation_about` has one axis for all angles. Here each joint has its own axis, and K K
    # is computed once per hand.
    q = (constants.gain @ coordinates + constants.offset)[..., None, None]  # (m, k, 1, 1)
    first = np.where(constants.slides[..., None, None], q, np.sin(q))
    motion = np.eye(4) + first * constants.twist + (1.0 - np.cos(q)) * constants.twist2

    # From the palm outwards, all fingers at once.
    before = np.empty_like(constants.X_PJ)
    X = np.eye(4)
    for j, X_PJ in enumerate(constants.X_PJ):
        before[j] = X @ X_PJ
        X = before[j] @ motion[j]
    R = before[..., :3, :3]
    axes = np.matmul(R, constants.axis[..., None])[..., 0]
    slides = np.matmul(R, constants.slide[..., None])[..., 0]
    return X @ constants.X_JFi, axes, slides, before[..., :3, 3]


def _closing_direction(
    constants: HandConstants, axes: Array, arms: Array, velocity: Array
) -> tuple[Array, Array]:
    """Return the unit direction in which each fingertip moves at Q when its finger closes.

    With the axes a_j, directions s_j and origins o_j of the finger's joints, and the joints' motion
    κ_j per closing position:

        arm_j = a_j × (Q − o_j) + s_j,   V = Σ_j κ_j arm_j,   v = V / |V|
        ∂V/∂(palm) = − Ω × dQ,   Ω = Σ_j κ_j a_j, with dQ the fingertip's motion at Q
        ∂V/∂q_j = Σ_{l>j} κ_l (a_j × arm_l − a_l × arm_j)
        dv = (1 − v vᵀ) dV / |V|

    Args:
        constants: Constants of the hand.
        axes: (m, k, 3), axes of the joints in {G}; zero if they slide.
        arms: (m, k, 3), velocity at Q per position of each joint, in {G} [m/rad, or -].
        velocity: (k, 3, n), velocity of the fingertips' material points at Q per unknown, in {G}.

    Returns:
        Directions (k, 3) in {G}, and their derivatives (k, 3, n) as seen from {G}.
    """
    # Screw of each fingertip per closing position: the sum over the joints of its finger.
    own = constants.closing_gain[..., None]  # (m, k, 1)
    turning, motion = own * axes, own * arms
    total_turning, total_motion = turning.sum(axis=0), motion.sum(axis=0)

    # With respect to the palm's pose: Q is fixed in {O}, so in {G} it moves against the palm.
    derivative = np.empty(velocity.shape)
    derivative[:, :, :POSE] = -np.matmul(skew(total_turning), velocity[:, :, :POSE])

    # With respect to the coordinates: joint j moves the screws of all later joints. At a fixed
    # point, a velocity field v that turns about an axis a changes by a x v - (dv/dp) arm.
    later_turning = total_turning - turning.cumsum(axis=0)
    later_motion = total_motion - motion.cumsum(axis=0)
    carried = _cross(axes, later_motion) - _cross(later_turning, arms)
    derivative[:, :, POSE:] = np.matmul(carried.transpose(1, 2, 0), constants.finger_gain)

    # From the velocity to its direction.
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
    joints: tuple[Array, Array, Array],
) -> tuple[Array, Array]:
    """Return the smooth heights (1 + k,) of palm and fingertips over the table [m].

    Args:
        problem: The problem, with the table.
        X_OG: (4, 4), pose of the palm.
        R_SG: (3, 3), rotation of the palm from the start.
        spin_G: (3, 3), angular velocities per angle, as columns.
        X_GF: (k, 4, 4), poses of the fingertips.
        joints: Axes, directions and origins (m, k, 3) of the joints in {G}, see `_forward`.

    Returns:
        The heights, and their derivatives (1 + k, n).
    """
    # Heights of the lowest corners.
    constants = problem.constants
    up_G = problem.up_O @ X_OG[:3, :3]
    base = problem.height + problem.up_O @ X_OG[:3, 3]
    palm, p_palm = _lowest((constants.palm @ up_G)[None], constants.palm[None])
    up_F = up_G @ X_GF[:, :3, :3]
    corners = constants.fingertips
    tips, p_F = _lowest(np.matmul(corners, up_F[:, :, None])[..., 0], corners)
    p_tips = np.matmul(X_GF[:, :3, :3], p_F[:, :, None])[..., 0] + X_GF[:, :3, 3]

    # Derivatives of the corners' heights, weighted as in the smooth minimum.
    jacobian = np.zeros((1 + len(tips), POSE + constants.gain.shape[-1]))
    jacobian[:, :3] = _cross(np.concatenate([p_palm, p_tips]), up_G) @ spin_G
    jacobian[:, 3:POSE] = R_SG @ up_G
    axes, slides, origins = joints
    arms = (_cross(axes, p_tips - origins) + slides) @ up_G  # (m, k)
    jacobian[1:, POSE:] = np.matmul(arms.T[:, None, :], constants.finger_gain)[:, 0]
    return base + np.concatenate([palm, tips + X_GF[:, :3, 3] @ up_G]), jacobian


def _lowest(heights: Array, points: Array) -> tuple[Array, Array]:
    """Return the smooth minima (g,) of heights (g, n) [m], and weighted means (g, 3) of the points.

    The minimum is -s log sum exp(-h / s); the weights are its derivatives with respect to the
    heights.
    """
    scaled = heights / -CLEARANCE_ROUNDING
    highest = scaled.max(axis=1)
    weight = np.exp(scaled - highest[:, None])
    total = weight.sum(axis=1)
    weight /= total[:, None]
    minimum = -CLEARANCE_ROUNDING * (highest + np.log(total))
    return minimum, np.matmul(weight[:, None, :], points)[:, 0]
