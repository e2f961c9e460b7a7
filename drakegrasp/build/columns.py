"""What is written of an attempt: the columns of `/trials`, and of `/looks` for a success.

In: attempts with their records, or one record. Out: values by the names of `schema`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from drakegrasp.arithmetic import multiply
from drakegrasp.build.attempts import Workbench
from drakegrasp.dataset.hdf5 import AnyArray
from drakegrasp.dataset.prepared_objects import PreparedObject
from drakegrasp.dataset.schema import CAMERAS, CONTACT_NAMES, sizes
from drakegrasp.dataset.shards import trial_columns
from drakegrasp.frames import pack_pose
from drakegrasp.simulation.candidates import Attempt
from drakegrasp.simulation.contacts import Contacts
from drakegrasp.simulation.scene import hand_joint_names
from drakegrasp.simulation.trial import TrialRecord
from drakegrasp.vision.camera import camera_pose_otm, camera_pose_oto, image_frame, intrinsics
from drakegrasp.vision.rendering import render


def trial_rows(
    bench: Workbench, attempts: Sequence[Attempt], records: Sequence[TrialRecord]
) -> dict[str, AnyArray]:
    """Return the columns of `/trials` of attempts and their records."""
    shape = array_sizes(bench)
    columns = {f.name: f.empty(len(records), shape) for f in trial_columns()}
    for row, (attempt, record) in enumerate(zip(attempts, records, strict=True)):
        for name, value in _row(bench.prepared, attempt, record).items():
            columns[name][row] = value
    return columns


def look_values(bench: Workbench, record: TrialRecord) -> dict[str, AnyArray]:
    """Return both images of a success, by the names of LOOK_FIELDS."""
    camera = bench.config.camera
    found: dict[str, AnyArray] = {}
    poses = {"oto": camera_pose_oto, "otm": camera_pose_otm}
    for name in CAMERAS:
        X_TC = poses[name](multiply(record.X_TO, record.X_OG), camera)
        seen = render(bench.renderer, record.X_TO, X_TC)
        found[f"image_{name}"] = seen.image
        found[f"mask_{name}"] = seen.mask
        found[f"X_TC_{name}"] = pack_pose(X_TC)
        # Where the object is out of sight the frame stays NaN, and a filter removes the row.
        if name == "otm" and seen.mask.any():
            X_CI = image_frame(intrinsics(camera), seen.mask, seen.image[3])
            found["X_CI_otm"] = pack_pose(X_CI)
    return found


def _row(prepared: PreparedObject, attempt: Attempt, record: TrialRecord) -> dict[str, Any]:
    row: dict[str, Any] = {
        "candidate": attempt.candidate,
        "standoff_index": attempt.standoff_index,
        "spread": attempt.spread,
        "seed": attempt.seed,
        "outcome": record.outcome,
        "X_TO": pack_pose(record.X_TO),
        "X_OG": pack_pose(record.X_OG),
    }
    if record.closed is not None:
        row |= {"time_close": record.time_close, "closed_q": record.q_closed}
        row |= _contact_values("closed", record.closed)
    if record.lifted is not None and record.closed is not None and record.X_TO_lifted is not None:
        row |= {"time_lift": record.time_lift, "lifted_q": record.q_lifted}
        row |= _contact_values("lifted", record.lifted)
        row |= {"slip": record.slip, "slip_angle": record.slip_angle}
        row["X_TO_lifted"] = pack_pose(record.X_TO_lifted)
        _, distance, _ = prepared.model.visual.nearest.on_surface(record.closed.p_OQ)
        row["surface_distance"] = distance
    return row


def _contact_values(prefix: str, contacts: Contacts) -> dict[str, Any]:
    return {f"{prefix}_{name}": getattr(contacts, name) for name in CONTACT_NAMES}


def array_sizes(bench: Workbench) -> dict[str, int]:
    """Return the lengths that the shapes of `schema` leave open, of a workbench's rows."""
    handles = bench.scene.handles
    assert handles is not None
    return sizes(
        fingers=handles.hand.num_fingers,
        joints=len(hand_joint_names(bench.scene)),
        image=bench.config.camera.size,
    )
