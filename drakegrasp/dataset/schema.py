"""The one table of everything that the files hold.

Writer, reader, checker and docs/reference/dataset-format.md are made from these rows; a field that
is not here is not in a file. Shapes are per row of the dataset; in them `k` is the number
of fingers, `j` of the hand's joints, `6k` the length of a grasp (18 for three fingers)
and `S` the size of the images.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from drakegrasp.outcomes import Outcome, Stage

#: Raised with every change of the table that an older reader would not understand.
SCHEMA_VERSION = 1

SPLITS = ("train", "valid", "test")
CAMERAS = ("oto", "otm")

#: The conventions in words, stored as attributes in every file.
CONVENTIONS = {
    "units": "SI: m, kg, s, N, rad, Pa",
    "poses": "frame_a2b is the pose of b expressed in a (maps b-coordinates to a), the first "
    "three rows of the 4x4 matrix, row-major; X_AB likewise",
    "frames": "W world; T = work, centre of the table top, p_WT = (0, 0, 0.65); O object, centre "
    "of the mesh's bounding box, axes of the mesh file; Ocm its centre of mass; G palm, +Gz out "
    "of the palm; Q contact point; C camera; I image",
    "camera_axes": "OpenCV and Drake: +X right, +Y down, +Z forward; pixel centres at integers",
    "depth": "z of the camera frame in metres; pixels with nothing before `far` hold `far`",
    "images": "channels R, G, B in 0..1, then depth in metres; row 0 is the top",
    "grasps": "[p_1 .. p_k, n_1 .. n_k]: contact points, then unit normals out of the object, "
    "in finger order of the hand file",
    "contacts": "pressure-weighted centre and mean normal of the hydroelastic patches between a "
    "fingertip and the object",
    "oto": "one-to-one: the camera is rolled with the palm",
    "otm": "one-to-many: image up is world up",
}


@dataclass(frozen=True, kw_only=True)
class Field:
    """One field of a file.

    Attributes:
        name: Path below the split (data files) or below `/trials`.
        shape: Of one row; integers or the letters k, j, S, 6k.
        dtype: NumPy's name, or "str" for UTF-8 text.
        unit: SI unit, or "-".
        frame: Letter of the frame that it is expressed in, or "-".
        meaning: One sentence.
        stage: For trials: the stage from which on a row has a value; before, floats are NaN.
        per_finger: For trials: whether NaN stands for a finger that does not touch.
        sample: For images: whether a chunk holds one sample.
    """

    name: str
    shape: tuple[int | str, ...]
    dtype: str
    unit: str
    frame: str
    meaning: str
    stage: Stage = Stage.PLACED
    per_finger: bool = False
    sample: bool = False

    def row_shape(self, sizes: Mapping[str, int]) -> tuple[int, ...]:
        """Return the shape of a row with the letters replaced by their sizes."""
        return tuple(sizes[s] if isinstance(s, str) else s for s in self.shape)

    def empty(self, count: int, sizes: Mapping[str, int]) -> npt.NDArray[np.generic]:
        """Return an array of `count` rows without a value: NaN, 0, or False."""
        fill = np.nan if np.dtype(self.dtype).kind == "f" else 0
        return np.full((count, *self.row_shape(sizes)), fill, dtype=self.dtype)


def sizes(*, fingers: int, joints: int, image: int) -> dict[str, int]:
    """Return what the letters of the shapes stand for."""
    return {"k": fingers, "6k": 6 * fingers, "j": joints, "S": image}


def _frame(name: str, meaning: str, frame: str) -> Field:
    return Field(
        name=f"object_props/{name}",
        shape=(12,),
        dtype="float32",
        unit="m, -",
        frame=frame,
        meaning=meaning,
    )


#: A row per grasp, in `/train`, `/valid` and `/test` of both data files.
DATA_FIELDS: tuple[Field, ...] = (
    Field(
        name="images",
        shape=(4, "S", "S"),
        dtype="float32",
        unit="-, -, -, m",
        frame="C",
        meaning="R, G, B in 0..1 and depth; object and table only, never the hand",
        sample=True,
    ),
    Field(
        name="masks",
        shape=("S", "S"),
        dtype="uint8",
        unit="-",
        frame="C",
        meaning="1 where the object is seen, 0 everywhere else",
        sample=True,
    ),
    Field(
        name="grasps",
        shape=("6k",),
        dtype="float32",
        unit="m, -",
        frame="C",
        meaning="contact points, then outward unit normals, after closing, in this file's camera",
    ),
    Field(
        name="trial_id",
        shape=(),
        dtype="int64",
        unit="-",
        frame="-",
        meaning="row of trials.hdf5",
    ),
    Field(
        name="object_props/object_name",
        shape=(),
        dtype="str",
        unit="-",
        frame="-",
        meaning="name of the object",
    ),
    Field(
        name="object_props/class_name",
        shape=(),
        dtype="str",
        unit="-",
        frame="-",
        meaning="name of the object's class",
    ),
    Field(
        name="object_props/work2com",
        shape=(3,),
        dtype="float32",
        unit="m",
        frame="T",
        meaning="p_TOcm, centre of mass of the resting object",
    ),
    Field(
        name="object_props/work2inertia",
        shape=(9,),
        dtype="float32",
        unit="kg m^2",
        frame="T",
        meaning="rotational inertia of the resting object about Ocm, 3x3 row-major",
    ),
    Field(
        name="object_props/work2mass",
        shape=(1,),
        dtype="float32",
        unit="kg",
        frame="-",
        meaning="mass of the object",
    ),
    _frame("frame_cam2img_otm", "X_CI, image frame estimated from the otm mask", "C (otm)"),
    _frame("frame_cam2work_otm", "X_CT of the otm camera", "C (otm)"),
    _frame("frame_cam2work_oto", "X_CT of the oto camera", "C (oto)"),
    _frame("frame_work2cam_otm", "X_TC of the otm camera", "T"),
    _frame("frame_work2cam_oto", "X_TC of the oto camera", "T"),
    _frame("frame_world2obj", "X_WO, the resting object", "W"),
    _frame("frame_world2work", "X_WT, the table top", "W"),
)


def _contact_fields(prefix: str, when: str, stage: Stage) -> tuple[Field, ...]:
    def field(
        name: str,
        shape: tuple[int | str, ...],
        dtype: str,
        unit: str,
        frame: str,
        meaning: str,
        per_finger: bool = False,
    ) -> Field:
        return Field(
            name=f"{prefix}_{name}",
            shape=shape,
            dtype=dtype,
            unit=unit,
            frame=frame,
            meaning=f"{meaning} {when}",
            stage=stage,
            per_finger=per_finger,
        )

    return (
        field("q", ("j",), "float64", "rad", "-", "positions of the hand's joints"),
        field("touching", ("k",), "bool", "-", "-", "whether the fingertip touches the object"),
        field("p_OQ", ("k", 3), "float64", "m", "O", "contact points", per_finger=True),
        field("nhat_Q_O", ("k", 3), "float64", "-", "O", "unit normals out of the object",
              per_finger=True),
        field("f_Q_O", ("k", 3), "float64", "N", "O", "forces of the fingertips on the object"),
        field("area", ("k",), "float64", "m^2", "-", "areas of the contact patches"),
        field("penetration", ("k",), "float64", "m", "-",
              "largest depths of the object's surface in the fingertips"),
        field("other_links", (), "uint8", "-", "-",
              "number of other links of the hand that touch the object"),
        field("hand_on_table", (), "bool", "-", "-", "whether the hand touches the table"),
        field("object_on_table", (), "bool", "-", "-", "whether the object touches the table"),
        field("point_contacts", (), "uint16", "-", "-",
              "number of contacts of the object that were not hydroelastic"),
    )  # fmt: skip


#: A row per attempt, whatever its outcome, in `/trials` of trials.hdf5 and of every shard.
TRIAL_FIELDS: tuple[Field, ...] = (
    Field(
        name="trial_id",
        shape=(),
        dtype="int64",
        unit="-",
        frame="-",
        meaning="the row's own number",
    ),
    Field(
        name="object",
        shape=(),
        dtype="int32",
        unit="-",
        frame="-",
        meaning="row of /objects",
    ),
    Field(
        name="candidate",
        shape=(),
        dtype="int32",
        unit="-",
        frame="-",
        meaning="index of the palm pose among its object's candidates",
    ),
    Field(
        name="standoff_index",
        shape=(),
        dtype="uint8",
        unit="-",
        frame="-",
        meaning="index into the configuration's candidates.standoffs",
    ),
    Field(
        name="spread",
        shape=(),
        dtype="float64",
        unit="rad",
        frame="-",
        meaning="angle of the spread joints",
    ),
    Field(
        name="seed",
        shape=(),
        dtype="uint64",
        unit="-",
        frame="-",
        meaning="state of the candidate's random stream, from which the spread was drawn",
    ),
    Field(
        name="outcome",
        shape=(),
        dtype="uint8",
        unit="-",
        frame="-",
        meaning="verdict: "
        + ", ".join(f"{o.value} {o.label}" for o in Outcome if not o.only_verified),
    ),
    Field(
        name="X_TO",
        shape=(12,),
        dtype="float64",
        unit="m, -",
        frame="T",
        meaning="resting pose of the object",
    ),
    Field(
        name="X_OG",
        shape=(12,),
        dtype="float64",
        unit="m, -",
        frame="O",
        meaning="pose of the palm at the start; the candidate's where the palm ray misses",
    ),
    Field(
        name="time_close",
        shape=(),
        dtype="float64",
        unit="s",
        frame="-",
        meaning="simulated time of closing",
        stage=Stage.CLOSED,
    ),
    *_contact_fields("closed", "after closing", Stage.CLOSED),
    Field(
        name="surface_distance",
        shape=("k",),
        dtype="float64",
        unit="m",
        frame="-",
        meaning="distance of the contact points after closing from the full mesh's surface",
        stage=Stage.LIFTED,
    ),
    Field(
        name="time_lift",
        shape=(),
        dtype="float64",
        unit="s",
        frame="-",
        meaning="simulated time of the lift with its hold; shorter where its end was known before",
        stage=Stage.LIFTED,
    ),
    *_contact_fields("lifted", "after the lift", Stage.LIFTED),
    Field(
        name="X_TO_lifted",
        shape=(12,),
        dtype="float64",
        unit="m, -",
        frame="T",
        meaning="pose of the object after the lift",
        stage=Stage.LIFTED,
    ),
    Field(
        name="slip",
        shape=(),
        dtype="float64",
        unit="m",
        frame="G",
        meaning="distance that the object moved in the hand during the lift",
        stage=Stage.LIFTED,
    ),
    Field(
        name="slip_angle",
        shape=(),
        dtype="float64",
        unit="rad",
        frame="G",
        meaning="angle that the object turned in the hand during the lift",
        stage=Stage.LIFTED,
    ),
)

#: How robust a success is; see `drakegrasp.simulation.robustness`.
CERTIFICATE_FIELDS: tuple[Field, ...] = (
    Field(
        name="certified_share",
        shape=(),
        dtype="float64",
        unit="-",
        frame="-",
        meaning="share of `certify.repeats` repeats with noise that hold; NaN if not certified",
    ),
    Field(
        name="certified_friction",
        shape=(),
        dtype="float64",
        unit="-",
        frame="-",
        meaning="least friction of hand and object at which it holds, inf if not even at the "
        "configured one; NaN if not certified",
    ),
)

#: A row per success, in `/looks` of a shard.
LOOK_FIELDS: tuple[Field, ...] = (
    Field(
        name="row",
        shape=(),
        dtype="int32",
        unit="-",
        frame="-",
        meaning="row of the shard's /trials",
    ),
    *(
        field
        for camera in CAMERAS
        for field in (
            Field(
                name=f"image_{camera}",
                shape=(4, "S", "S"),
                dtype="float32",
                unit="-, -, -, m",
                frame=f"C ({camera})",
                meaning="R, G, B in 0..1 and depth",
                sample=True,
            ),
            Field(
                name=f"mask_{camera}",
                shape=("S", "S"),
                dtype="uint8",
                unit="-",
                frame=f"C ({camera})",
                meaning="1 where the object is seen",
                sample=True,
            ),
            Field(
                name=f"X_TC_{camera}",
                shape=(12,),
                dtype="float64",
                unit="m, -",
                frame="T",
                meaning="pose of the camera",
            ),
        )
    ),
    Field(
        name="X_CI_otm",
        shape=(12,),
        dtype="float64",
        unit="m, -",
        frame="C (otm)",
        meaning="image frame estimated from the otm mask",
    ),
    *CERTIFICATE_FIELDS,
)

#: A row per success, in `/successes` of trials.hdf5.
SUCCESS_FIELDS: tuple[Field, ...] = (
    Field(name="trial_id", shape=(), dtype="int64", unit="-", frame="-", meaning="row of /trials"),
    Field(
        name="removal",
        shape=(),
        dtype="uint8",
        unit="-",
        frame="-",
        meaning="why it is no sample: 0 kept, 1 not_seen, 2 out_of_view, 3 bisects_table, "
        "4 flat_depth, 5 off_surface, 6 outlier, 7 rejected",
    ),
    *CERTIFICATE_FIELDS,
)

#: A row per object, in `/objects` of trials.hdf5.
OBJECT_FIELDS: tuple[Field, ...] = (
    Field(name="name", shape=(), dtype="str", unit="-", frame="-", meaning="name of the object"),
    Field(
        name="class_name", shape=(), dtype="str", unit="-", frame="-", meaning="name of its class"
    ),
    Field(
        name="mesh_sha256",
        shape=(),
        dtype="str",
        unit="-",
        frame="-",
        meaning="hash of the mesh file and its scale",
    ),
    Field(
        name="combinations",
        shape=(),
        dtype="int64",
        unit="-",
        frame="-",
        meaning="combinations of rotations that were considered",
    ),
    Field(
        name="valid",
        shape=(),
        dtype="int64",
        unit="-",
        frame="-",
        meaning="those above the table whose palm ray meets the bounding box",
    ),
    Field(
        name="distinct",
        shape=(),
        dtype="int64",
        unit="-",
        frame="-",
        meaning="different palm poses among the valid ones",
    ),
    Field(
        name="candidates",
        shape=(),
        dtype="int64",
        unit="-",
        frame="-",
        meaning="palm poses drawn from the different ones",
    ),
)

#: A row per predicted grasp, in the order of the input, in `/grasps` of the results of
#: `drakegrasp verify`. What a method or a stage did not reach is NaN, 0, false or empty.
VERIFICATION_FIELDS: tuple[Field, ...] = (
    Field(name="object", shape=(), dtype="str", unit="-", frame="-", meaning="name of the object"),
    Field(
        name="method",
        shape=(),
        dtype="str",
        unit="-",
        frame="-",
        meaning="how it was verified: hand, or forces alone",
    ),
    Field(
        name="outcome",
        shape=(),
        dtype="uint8",
        unit="-",
        frame="-",
        meaning="verdict: " + ", ".join(f"{o.value} {o.label}" for o in Outcome),
    ),
    Field(name="reason", shape=(), dtype="str", unit="-", frame="-", meaning="why, in words"),
    Field(
        name="X_TO",
        shape=(12,),
        dtype="float64",
        unit="m, -",
        frame="T",
        meaning="resting pose of the object",
    ),
    Field(
        name="X_TO_simulated",
        shape=(12,),
        dtype="float64",
        unit="m, -",
        frame="T",
        meaning="pose at which it is simulated: moved on the table and turned about its normal",
    ),
    Field(
        name="p_OQ",
        shape=("k", 3),
        dtype="float64",
        unit="m",
        frame="O",
        meaning="predicted contact points",
    ),
    Field(
        name="nhat_Q_O",
        shape=("k", 3),
        dtype="float64",
        unit="-",
        frame="O",
        meaning="predicted unit normals out of the object",
    ),
    Field(
        name="surface_distance",
        shape=("k",),
        dtype="float64",
        unit="m",
        frame="-",
        meaning="distance of the predicted points from the object's surface",
    ),
    Field(
        name="epsilon",
        shape=(),
        dtype="float64",
        unit="-",
        frame="-",
        meaning="Ferrari-Canny measure of the predicted contacts, 0 without force closure",
    ),
    Field(
        name="smallest_friction",
        shape=(),
        dtype="float64",
        unit="-",
        frame="-",
        meaning="least friction coefficient at which forces within the hand's limit at the "
        "predicted contacts hold the object; inf if none does",
    ),
    Field(
        name="X_OG",
        shape=(12,),
        dtype="float64",
        unit="m, -",
        frame="O",
        meaning="pose of the palm that was found",
    ),
    Field(
        name="spread",
        shape=(),
        dtype="float64",
        unit="rad",
        frame="-",
        meaning="angle of the spread joints",
    ),
    Field(
        name="closing",
        shape=("k",),
        dtype="float64",
        unit="rad",
        frame="-",
        meaning="closing angles at which the fingertips meet the predicted points",
    ),
    Field(
        name="residual",
        shape=("k",),
        dtype="float64",
        unit="m",
        frame="-",
        meaning="distance of the predicted points from the fingertips then",
    ),
    Field(
        name="normal_error",
        shape=("k",),
        dtype="float64",
        unit="rad",
        frame="-",
        meaning="angle between the fingertips' and the predicted normals then",
    ),
    Field(
        name="solver_status",
        shape=(),
        dtype="int16",
        unit="-",
        frame="-",
        meaning="exit mode of SLSQP, 0 for success; -1 where it was not asked",
    ),
    Field(
        name="solver_iterations",
        shape=(),
        dtype="uint16",
        unit="-",
        frame="-",
        meaning="iterations of SLSQP",
    ),
    Field(
        name="tries",
        shape=(),
        dtype="uint16",
        unit="-",
        frame="-",
        meaning="number of palm poses that were simulated",
    ),
    Field(
        name="closing_start",
        shape=("k",),
        dtype="float64",
        unit="rad",
        frame="-",
        meaning="closing angles from which the simulated fingers close",
    ),
    Field(
        name="time_close",
        shape=(),
        dtype="float64",
        unit="s",
        frame="-",
        meaning="simulated time of closing",
        stage=Stage.CLOSED,
    ),
    *_contact_fields("closed", "after closing", Stage.CLOSED),
    Field(
        name="contact_error",
        shape=("k",),
        dtype="float64",
        unit="m",
        frame="-",
        meaning="distance of the contact points after closing from the predicted ones",
        stage=Stage.CLOSED,
    ),
    Field(
        name="time_lift",
        shape=(),
        dtype="float64",
        unit="s",
        frame="-",
        meaning="simulated time of the lift with its hold; shorter where its end was known before",
        stage=Stage.LIFTED,
    ),
    *_contact_fields("lifted", "after the lift", Stage.LIFTED),
    Field(
        name="X_TO_lifted",
        shape=(12,),
        dtype="float64",
        unit="m, -",
        frame="T",
        meaning="pose of the object after the lift, which began at X_TO_simulated",
        stage=Stage.LIFTED,
    ),
    Field(
        name="slip",
        shape=(),
        dtype="float64",
        unit="m",
        frame="G",
        meaning="distance that the object moved in the hand during the lift",
        stage=Stage.LIFTED,
    ),
    Field(
        name="slip_angle",
        shape=(),
        dtype="float64",
        unit="rad",
        frame="G",
        meaning="angle that the object turned in the hand during the lift",
        stage=Stage.LIFTED,
    ),
    Field(
        name="planned_force",
        shape=(),
        dtype="float64",
        unit="N",
        frame="-",
        meaning="method forces: largest normal force that the lift takes at least; inf if no "
        "forces carry the object",
    ),
    Field(
        name="applied_force",
        shape=(),
        dtype="float64",
        unit="N",
        frame="-",
        meaning="method forces: largest normal force that was applied",
        stage=Stage.LIFTED,
    ),
    Field(
        name="position_error",
        shape=(),
        dtype="float64",
        unit="m",
        frame="-",
        meaning="method forces: distance of the object from its path at the end",
        stage=Stage.LIFTED,
    ),
    Field(
        name="angle_error",
        shape=(),
        dtype="float64",
        unit="rad",
        frame="-",
        meaning="method forces: angle of the object from its path at the end",
        stage=Stage.LIFTED,
    ),
)
