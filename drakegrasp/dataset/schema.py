"""The one table of everything that the files hold, with one row per field.

Writer, reader, checker and docs/reference/dataset-format.md are made from these rows: a field that
is not listed here is in no file. Imports only NumPy, so that a reader can load it anywhere.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import norm
from drakegrasp.errors import DataError, printable
from drakegrasp.filters import Removal
from drakegrasp.outcomes import Outcome, Stage

#: Increases with every change of the table that an older reader cannot read.
SCHEMA_VERSION = 5
#: What to do with a file of another version, whose labels have other meanings.
OTHER_SCHEMA = "build the dataset again with this version of drakegrasp, in another directory"

SPLITS = ("train", "valid", "test")
#: Letters in the shapes of fields, see `Field`.
LETTERS = ("k", "j", "S", "h", "w", "o", "a")
#: Units in which people read numbers, and the factors that convert SI values to them.
SHOWN_UNITS = {"": 1.0, "s": 1.0, "N": 1.0, "kg": 1.0, "mm": 1e3, "°": float(np.rad2deg(1.0))}
CAMERAS = ("oto", "otm")
#: Limits of fields: positive numbers, non-negative numbers, angles, fractions.
POSITIVE = 5e-324
ABOVE_0, FROM_0, ANGLE = (POSITIVE, np.inf), (0.0, np.inf), (0.0, np.pi)

#: The conventions in words, stored as attributes in every file.
CONVENTIONS = {
    "units": "SI: m, kg, s, N, rad, Pa",
    "poses": "frame_a2b is the pose of b expressed in a (maps b-coordinates to a), the first "
    "three rows of the 4x4 matrix, row-major; X_AB likewise",
    "frames": "W world; T = work, centre of the table top, p_WT = (0, 0, 0.65); O object, centre "
    "of the mesh's bounding box, axes of the mesh file, turned so that its `up` is +z; Ocm its "
    "centre of mass; G palm, +Gz out of the palm; Q contact point; C camera; C0 its usual pose "
    "behind the palm; I image",
    "camera_axes": "OpenCV and Drake: +X right, +Y down, +Z forward; pixel centres at integers",
    "depth": "z of the camera frame in metres; pixels with nothing before `far`, and those that a "
    "depth camera would lose, hold `far`",
    "images": "channels R, G, B in 0..1, then depth in metres; row 0 is the top",
    "grasps": "[p_1 .. p_k, n_1 .. n_k]: contact points, then unit normals out of the object, "
    "in finger order of the hand file",
    "contacts": "pressure-weighted centre and mean normal of the hydroelastic patches between the "
    "pad of a fingertip and the object; a patch mostly beside the pad is split there, and its rest "
    "counts as another link",
    "lifted": "at the end of the lift, relative to the object in its resting pose: everything that "
    "moved with the object is moved back with it",
    "oto": "one-to-one: the camera is rolled with the palm",
    "otm": "one-to-many: image up is world up",
}


@dataclass(frozen=True)
class Shown:
    """How people read a number, on pages and in figures.

    Attributes:
        title: Title of the number, in words.
        unit: One of SHOWN_UNITS; empty for a plain number.
        digits: Number of digits after the decimal point.
    """

    title: str
    unit: str = ""
    digits: int = 1

    @property
    def factor(self) -> float:
        """Factor from SI to the unit."""
        return SHOWN_UNITS[self.unit]

    @property
    def label(self) -> str:
        """The title and the unit, for an axis."""
        return f"{self.title} [{self.unit}]" if self.unit else self.title

    def text(self, value: float) -> str:
        """Return a value in SI as text with its unit; a dash if there is no value.

        Infinity means undefined: the contact has no normal.
        """
        if np.isposinf(value):
            return "none"
        if not np.isfinite(value):
            return "–"
        space = "" if self.unit in ("", "°") else " "
        return f"{value * self.factor:.{self.digits}f}{space}{self.unit}"


@dataclass(frozen=True)
class Field:
    """One field of a file.

    Attributes:
        name: Path below the group, which is a split, `/trials`, `/objects`, `/successes`, `/looks`,
            `/grasps`, `/scenes`, `/views`, `/visible`, `/reach`, `/clutter`, `/shapes` or `/rows`.
        dtype: NumPy's name of the type, or "str" for UTF-8 text.
        meaning: One sentence that describes the field.
        shape: Axes of one row, separated by blanks; empty for a scalar. An axis is an integer or a
            letter: `k` fingers, `j` joints of the hand, `6k` length of a grasp (18 for three
            fingers), `S` size of an image [px]; in scenes.hdf5 `h` rows and `w` columns of an image
            [px], `o` objects of a scene; in files of arms `a` joints of the arm.
        unit: SI unit, or "-".
        frame: Letter of the frame in which the field is expressed, or "-".
        stage: First stage at which a row has a value; before it, floats are NaN and other types 0.
        per_finger: Whether NaN marks a finger that does not touch.
        sample: Whether the field is an image, stored in one chunk per row.
        some: Whether rows that reached the stage may lack a value.
        optional: Whether files may lack the field; it is then derived, or read as without a value.
        limits: Smallest and largest value, POSITIVE for values above 0; None for any value. NaN is
            always allowed.
        derive: For a field of `/trials` that follows from other fields: a function from a table of
            rows with the columns of `needs` to the field's values (n, ...). No shard stores the
            field.
        needs: Names of these columns.
        of: Where the value is read, as a path of attributes: from a `TrialRow` of
            `generation.attempts` for a trial, from a `Verification` for a verdict. For a number of
            a sample, the column of its trial that it copies. Empty if the value is computed in
            another way.
        shown: How people read the field; None if it is not shown by itself.
    """

    name: str
    dtype: str
    meaning: str
    shape: str = ""
    unit: str = "-"
    frame: str = "-"
    stage: Stage = Stage.PLACED
    per_finger: bool = False
    sample: bool = False
    some: bool = False
    optional: bool = False
    limits: tuple[float, float] | None = None
    derive: Callable[[Mapping[str, npt.NDArray[Any]]], npt.NDArray[Any]] | None = None
    needs: tuple[str, ...] = ()
    of: str = ""
    shown: Shown | None = None

    @property
    def axes(self) -> tuple[int | str, ...]:
        """Axes of a row: lengths, and letters whose lengths depend on the dataset."""
        return tuple(int(axis) if axis.isdecimal() else axis for axis in self.shape.split())

    def row_shape(self, sizes: Mapping[str, int]) -> tuple[int, ...]:
        """Return the shape of a row, with `sizes` in place of the letters; `6k` follows from `k`.

        Raises:
            KeyError: If a letter is missing.
        """
        known = {**sizes, "6k": 6 * sizes.get("k", 0)}
        return tuple(known[axis] if isinstance(axis, str) else axis for axis in self.axes)

    def value_of(self, source: object) -> Any:
        """Return the field's value from the source of a row, or None if its stage is missing."""
        for name in self.of.split("."):
            if source is None:
                return None
            source = getattr(source, name)
        return source

    def empty(self, count: int, sizes: Mapping[str, int]) -> npt.NDArray[np.generic]:
        """Return an array of `count` rows without values: NaN, 0, False or an empty text."""
        if self.dtype == "str":
            return np.full(count, "", dtype=object)
        fill = np.nan if np.dtype(self.dtype).kind == "f" else 0
        return np.full((count, *self.row_shape(sizes)), fill, dtype=self.dtype)


def validate_schema_version(path: Path, version: object) -> None:
    """Raise an error if a file has another version of the schema.

    Args:
        path: Path of the file, for the message.
        version: The file's attribute or key `schema_version`; None if it has none.

    Raises:
        DataError: If the version differs.
    """
    whole = isinstance(version, int | np.integer) and not isinstance(version, bool)
    if not (whole and version == SCHEMA_VERSION):
        got = "none" if version is None else printable(str(version)[:40])
        raise DataError(f"{path}: schema must be {SCHEMA_VERSION}, got {got}; {OTHER_SCHEMA}")


def sizes(*, fingers: int, joints: int, image: int) -> dict[str, int]:
    """Return the lengths of the letters in the shapes."""
    return {"k": fingers, "j": joints, "S": image}


def with_derived(
    columns: Mapping[str, npt.NDArray[Any]],
) -> dict[str, npt.NDArray[Any]]:
    """Return columns of `/trials` together with the columns that follow from them."""
    found = dict(columns)
    for field in TRIAL_FIELDS:
        if field.derive is not None and all(name in columns for name in field.needs):
            found[field.name] = field.derive(columns).astype(field.dtype)
    return found


def stored_fields(fields: Sequence[Field], *, repeats: bool) -> tuple[Field, ...]:
    """Return the fields that files have; ROBUST_FIELDS are only in those of builds with repeats."""
    own = {field.name for field in ROBUST_FIELDS}
    return tuple(f for f in fields if repeats or f.name.rpartition("/")[2] not in own)


def _since(stage: Stage, *fields: Field) -> tuple[Field, ...]:
    """Return fields that have a value from a stage on."""
    return tuple(replace(field, stage=stage) for field in fields)


def _contacts(prefix: str, of: str, when: str) -> tuple[Field, ...]:
    """Return the joint positions and contacts of one instant, e.g. `closed_q`, `closed_p_OQ`."""
    return tuple(
        replace(
            field,
            name=f"{prefix}_{field.name}",
            meaning=f"{field.meaning} {when}",
            of=f"{of}.{field.of}",
        )
        for field in (_JOINTS, *_OF_CONTACTS)
    )


def _measured(of: str, *fields: Field) -> tuple[Field, ...]:
    """Return fields whose values are attributes of the same names of one object."""
    return tuple(replace(field, of=f"{of}.{field.name}") for field in fields)


def _copied(group: str, *fields: Field) -> tuple[Field, ...]:
    """Return fields of a sample that copy columns of its trial, in single precision."""
    return tuple(
        replace(
            field,
            name=f"{group}/{field.name}",
            dtype="float32" if field.dtype == "float64" else field.dtype,
            of=field.name,
        )
        for field in fields
    )


def _verdict(of: str, outcomes: list[Outcome]) -> Field:
    return Field("outcome", "uint8", f"verdict: {_labels(outcomes)}", of=of)


def _labels(members: Sequence[Outcome] | Sequence[Removal]) -> str:
    """Return the numbers and names of an enum, as in a field's meaning."""
    return ", ".join(f"{member.value} {member.label}" for member in members)


def _friction_use(t: Mapping[str, npt.NDArray[Any]]) -> npt.NDArray[Any]:
    """Return the fraction (n, k) of the friction cone that each fingertip uses after the lift.

    It is |f_t| / (mu f_n), where f_n and f_t are the parts of the force along and across the
    contact's mean normal. 1 is the border of the cone of one point; a curved patch may exceed it.
    """
    f_Q_O, nhat_Q_O = t["lifted_f_Q_O"], t["lifted_nhat_Q_O"]
    f_n = -(f_Q_O * nhat_Q_O).sum(axis=-1)  # the normal points out of the object
    f_t = norm(f_Q_O + f_n[..., None] * nhat_Q_O)
    with np.errstate(divide="ignore", invalid="ignore"):
        use = f_t / (t["friction_hand"][:, None] * f_n)
    return np.where(t["lifted_touching"] & (f_n > 0.0), use, np.nan)


# One field on at most two lines makes this a table.
# fmt: off

_JOINTS = Field("q", "float64", "positions of the hand's joints", "j", "rad or m", of="q")

#: What `simulation.contacts.Contacts` measures at one instant, by its names.
_CONTACTS: tuple[Field, ...] = (
    Field("touching", "bool", "whether the fingertip touches the object", "k"),
    Field("p_OQ", "float64", "contact points", "k 3", "m", "O", per_finger=True),
    Field("nhat_Q_O", "float64", "unit normals out of the object", "k 3", frame="O",
          per_finger=True),
    Field("f_Q_O", "float64", "forces of the fingertips on the object", "k 3", "N", "O"),
    Field("area", "float64", "areas of the contact patches", "k", "m^2"),
    Field("penetration", "float64", "largest penetration depths of the object's surface into "
          "the fingertips", "k", "m", limits=FROM_0),
    Field("other_links", "uint8", "number of other links of the hand that touch the object"),
    Field("hand_on_table", "bool", "whether the hand touches the table"),
    Field("object_on_table", "bool", "whether the object touches the table"),
    Field("point_contacts", "uint16",
          "number of contacts of the object that were not hydroelastic"),
)

_OF_CONTACTS = _measured("contacts", *_CONTACTS)

# While the hand closes, the object is fixed in place, so nothing shows whether it stands on the
# table.
_CLOSED = tuple(field for field in _contacts("closed", "trial.closed", "when closing ended")
                if field.name != "closed_object_on_table")
# For a lift that ends early, the instant at which it ends.
_LIFTED = _contacts("lifted", "trial.lift", "after the lift")

# Origin of a palm pose; an attempt's identity is object, candidate and stand-off.
_LINEAGE = (
    Field("resting", "uint8", "index of the object's resting pose"),
    Field("source", "uint8", "sampler of the palm pose: 0 rotations, 1 normals, 5 closing, 3 "
          "other; 4 for a posture from a file"),
)
#: `preshape` of a posture without one, with which all fingers of a hand with preshapes close.
NO_PRESHAPE = 255
# Fields of several tables.
_PRESHAPE = (
    Field("preshape", "uint8", "index of the hand file's preshape; 255 for a posture without "
          "preshape; 0 if the hand file has no preshapes", optional=True),
    Field("unused", "uint32", "fingers that the preshape leaves out, as bits: 1 for the first "
          "finger. These fingers have no contact", optional=True),
)
_SPREAD = Field("spread", "float64", "angle of the spread joints", unit="rad",
                shown=Shown("spread", "°"))
_X_TO = Field("X_TO", "float64", "resting pose of the object", "12", "m, -", "T")
_TIME_CLOSE = Field("time_close", "float64", "simulated time at which closing ended", unit="s",
                    of="trial.closed.duration", shown=Shown("time of closing", "s", 2))
_TIME_LIFT = Field("time_lift", "float64",
                   "simulated time of the lift with its hold; shorter if the lift ended early",
                   unit="s", of="trial.lift.duration", shown=Shown("time of the lift", "s", 2))
#: Missing in files of datasets that do not measure it, see `close.scrape_depth`.
_CLEARANCE = {
    when: Field(f"clearance_{when}", "float64", f"smallest height of the hand above the table's "
                f"top {during}, negative below the top; NaN in datasets that do not measure it",
                unit="m", frame="T", some=True, optional=True, of=f"trial.{of}.clearance",
                shown=Shown(f"least height {during}", "mm"))
    for when, of, during in (("close", "closed", "from the start of closing to its end"),
                             ("lift", "lift", "during the lift"))
}
_SLIP = _measured(
    "trial.lift",
    Field("slip", "float64", "distance that the object moved in the hand during the lift",
          unit="m", frame="G", limits=FROM_0, shown=Shown("slip", "mm")),
    Field("turn", "float64", "angle that the object turned in the hand during the lift",
          unit="rad", frame="G", limits=ANGLE, shown=Shown("turn", "°")),
)
_SLIP_USE = Field("slip_use", "float64",
                  "fraction of the friction cone in use after the lift; 1 at the border of the "
                  "cone", "k", stage=Stage.TRIED, per_finger=True, some=True, optional=True,
                  derive=_friction_use, shown=Shown("friction in use", digits=2),
                  needs=("lifted_touching", "lifted_f_Q_O", "lifted_nhat_Q_O", "friction_hand"))
_RELEASED = _measured(
    "trial.lift",
    Field("slip_released", "float64",
          "distance that the object moved in the hand before the wrist moved", unit="m",
          frame="G", limits=FROM_0, shown=Shown("slip before the wrist moves", "mm")),
    Field("turn_released", "float64",
          "angle that the object turned in the hand before the wrist moved", unit="rad",
          frame="G", limits=ANGLE, shown=Shown("turn before the wrist moves", "°")),
)
_WORDS = (
    Field("precision", "bool", "whether the attempt is a success in which only fingertips hold "
          "the object after the lift"),
    Field("stable", "bool",
          "whether the attempt is a precision grasp with slip below 5 mm and turn below 5 deg"),
)

#: The conditions of an attempt, drawn or not: everything that `simulation.attempt` may change.
CONDITION_FIELDS: tuple[Field, ...] = (
    *_measured(
        "conditions.materials",
        Field("friction_hand", "float64", "effective coefficient of friction between hand and "
              "object", shown=Shown("friction of the object with the hand", digits=3)),
        Field("friction_table", "float64", "effective coefficient of friction between table and "
              "object", shown=Shown("friction of the object with the table", digits=3)),
        Field("mass", "float64", "mass of the object; the inertia is scaled with it", unit="kg",
              shown=Shown("mass", "kg", 3)),
    ),
    *_measured(
        "conditions.appearance",
        Field("object_colour", "float64", "R, G, B of the object in 0..1", "3"),
        Field("table_colour", "float64", "R, G, B of the table in 0..1", "3"),
        Field("light_direction", "float64", "unit vector along which the light from above shines",
              "3", frame="W"),
        Field("light_strength", "float64", "intensity of the light from above"),
    ),
    Field("X_C0C", "float64", "pose of the oto camera in its usual pose behind the palm", "12",
          "m, -", "C0", of="conditions.X_C0C"),
    Field("depth_noise", "float64", "standard deviation of a depth divided by the depth "
          "squared; 0 for images without noise", unit="1/m", of="conditions.sensor.noise"),
    Field("depth_seed", "uint64", "seed of the noise of the depth images; 0 for images without "
          "noise", of="conditions.sensor.seed"),
)

#: How often a sample survives noise; see `simulation.attempt.disturbed`. Missing in files of builds
#: without repeats, see `stored_fields`.
ROBUST_FIELDS: tuple[Field, ...] = tuple(
    replace(field, stage=Stage.TRIED, some=True, optional=True)
    for field in (
        Field("robust_tried", "int32", "number of disturbed repeats (section `robustness`) with "
              "a verdict; 0 for an attempt that was not selected"),
        Field("robust_kept", "int32", "number of these that would be samples by the default "
              "filters, except those of images and outliers"),
    )
)

#: A row per grasp, in `/train`, `/valid` and `/test` of both data files.
DATA_FIELDS: tuple[Field, ...] = (
    Field("images", "float32", "R, G, B in 0..1 and depth; object and table only, never the hand",
          "4 S S", "-, -, -, m", "C", sample=True),
    Field("masks", "uint8", "1 where the object is visible, 0 elsewhere", "S S", frame="C",
          sample=True, limits=(0, 1)),
    Field("grasps", "float32", "contact points, then outward unit normals, after closing, in "
          "the frame of this file's camera", "6k", "m, -", "C"),
    Field("grasps_lifted", "float32", "contact points and normals after the lift, relative to the "
          "resting object", "6k", "m, -", "C"),
    Field("trial_id", "int64", "row of trials.hdf5"),
    *_copied("grasp_props", *_WORDS, *_LINEAGE, *_PRESHAPE),
    *_copied("grasp_props", *_SLIP, *_RELEASED, _SLIP_USE),
    Field("grasp_props/other_links_lifted", "uint8", "number of other links of the hand that "
          "touch the object after the lift", of="lifted_other_links"),
    Field("grasp_props/X_CG", "float32", "pose of the palm at the start and while closing, in "
          "the frame of this file's camera", "12", "m, -", "C"),
    Field("grasp_props/X_CG_lifted", "float32",
          "pose of the palm after the lift, relative to the resting object", "12", "m, -", "C"),
    Field("grasp_props/q", "float32", "positions of the hand's joints after closing", "j",
          "rad or m", of="closed_q"),
    Field("grasp_props/q_lifted", "float32", "positions of the hand's joints after the lift", "j",
          "rad or m", of="lifted_q"),
    Field("grasp_props/f_Q_C", "float32", "forces of the fingertips on the object after closing",
          "k 3", "N", "C"),
    Field("grasp_props/f_Q_C_lifted", "float32", "forces of the fingertips on the object after "
          "the lift, rotated with the object to its resting pose", "k 3", "N", "C"),
    Field("grasp_props/area", "float32", "areas of the contact patches after closing", "k", "m^2",
          of="closed_area"),
    Field("grasp_props/area_lifted", "float32", "areas of the contact patches after the lift", "k",
          "m^2", of="lifted_area"),
    *_copied("grasp_props", *ROBUST_FIELDS),
    # The mass is in object_props.
    *_copied("conditions", *(field for field in CONDITION_FIELDS if field.name != "mass")),
    Field("object_props/object_name", "str", "name of the object"),
    Field("object_props/class_name", "str", "name of the object's class"),
    Field("object_props/work2com", "float32", "p_TOcm, centre of mass of the resting object", "3",
          "m", "T"),
    Field("object_props/work2inertia", "float32",
          "rotational inertia of the resting object about Ocm, 3x3 row-major", "9", "kg m^2", "T"),
    Field("object_props/work2mass", "float32", "mass of the object, as in the trial", "1", "kg",
          of="mass", limits=ABOVE_0),
    Field("object_props/frame_cam2img_otm", "float32",
          "X_CI, image frame estimated from the otm mask", "12", "m, -", "C (otm)"),
    *(Field(f"object_props/frame_cam2work_{camera}", "float32", f"X_CT of the {camera} camera",
            "12", "m, -", f"C ({camera})") for camera in reversed(CAMERAS)),
    *(Field(f"object_props/frame_work2cam_{camera}", "float32", f"X_TC of the {camera} camera",
            "12", "m, -", "T") for camera in reversed(CAMERAS)),
    Field("object_props/frame_world2obj", "float32", "X_WO, the resting object", "12", "m, -",
          "W"),
    Field("object_props/frame_world2work", "float32", "X_WT, the table top", "12", "m, -", "W"),
)

#: A row per attempt, whatever its outcome, in `/trials` of trials.hdf5 and of every shard.
TRIAL_FIELDS: tuple[Field, ...] = (
    Field("trial_id", "int64", "number of the row"),
    Field("object", "int32", "row of /objects"),
    *_measured(
        "attempt",
        Field("candidate", "int32", "index of the palm pose among its object's candidates"),
        Field("standoff_index", "uint8", "index into the configuration's candidates.standoffs"),
        *_LINEAGE,
        Field("posture_row", "float64", "row of the posture in its file; NaN for a sampled palm "
              "pose", some=True, optional=True),
        Field("own_motors", "bool", "whether each joint had its own motor, because the posture "
              "does not follow the couplings of the hand file", optional=True),
        *_PRESHAPE,
        _SPREAD,
        Field("seed", "uint64",
              "state of the random stream of the candidate, from which the spread was drawn"),
    ),
    _verdict("trial.outcome", [outcome for outcome in Outcome if not outcome.verification_only]),
    *_measured(
        "trial",
        _X_TO,
        Field("X_OG", "float64", "pose of the palm at the start; the candidate's pose if the "
              "palm ray misses", "12", "m, -", "O"),
    ),
    *CONDITION_FIELDS,
    *_since(
        Stage.CLOSED,
        _TIME_CLOSE,
        _CLEARANCE["close"],
        *_CLOSED,
    ),
    *_since(
        Stage.TRIED,
        Field("surface_distance", "float64",
              "distance of the contact points after closing from the full mesh's surface", "k",
              "m", per_finger=True, of="fit.distance", shown=Shown("off surface", "mm", 2)),
        Field("normal_angle", "float64",
              "angle between the normals after closing and the normal of the full mesh's "
              "nearest face, or of the face nearest to a point ahead if it agrees better", "k",
              "rad", per_finger=True, of="fit.normal_angle", shown=Shown("normal angle", "°")),
        _TIME_LIFT,
        _CLEARANCE["lift"],
        *_LIFTED,
        Field("X_TO_lifted", "float64", "pose of the object after the lift", "12", "m, -", "T",
              of="trial.lift.X_TO"),
        Field("X_OG_lifted", "float64", "pose of the palm after the lift", "12", "m, -", "O",
              of="trial.lift.X_OG"),
        *_SLIP,
        *_RELEASED,
        _SLIP_USE,
        *_measured("trial", *_WORDS),
    ),
    *ROBUST_FIELDS,
)


def _image_fields(camera: str) -> tuple[Field, ...]:
    frame = f"C ({camera})"
    return (
        Field(f"image_{camera}", "float32", "R, G, B in 0..1 and depth", "4 S S", "-, -, -, m",
              frame, sample=True),
        Field(f"mask_{camera}", "uint8", "1 where the object is visible", "S S", frame=frame,
              sample=True),
        Field(f"X_TC_{camera}", "float64", "pose of the camera", "12", "m, -", "T"),
    )


#: A row per success, in `/looks` of a shard.
LOOK_FIELDS: tuple[Field, ...] = (
    Field("row", "int32", "row of the shard's /trials"),
    *(field for camera in CAMERAS for field in _image_fields(camera)),
    Field("X_CI_otm", "float64", "image frame estimated from the otm mask", "12", "m, -",
          "C (otm)"),
)

#: A row per success, in `/successes` of trials.hdf5.
SUCCESS_FIELDS: tuple[Field, ...] = (
    Field("trial_id", "int64", "row of /trials"),
    Field("removal", "uint8", f"why the success is not a sample: {_labels(list(Removal))}"),
)

#: A row per object, in `/objects` of trials.hdf5.
OBJECT_FIELDS: tuple[Field, ...] = (
    Field("name", "str", "name of the object"),
    Field("class_name", "str", "name of the object's class"),
    Field("mesh_sha256", "str", "hash of the mesh file and of its entries in objects.yaml"),
    Field("scale", "float64", "metres per unit of length of the mesh file", unit="m"),
    Field("up", "str", "axis of the mesh file that is +z of the object"),
    Field("mass", "float64", "mass", unit="kg"),
    Field("density", "float64", "mass divided by volume", unit="kg/m^3"),
    Field("friction", "float64", "the object's own coefficient with hand and table; NaN if "
          "those of the configuration apply"),
    Field("collision_error", "float64", "largest distance between mesh and collision surface",
          unit="m"),
    Field("candidates", "int64", "number of palm poses"),
)

#: A row per predicted grasp, in the order of the input, in `/grasps` of the results of
#: `drakegrasp verify`. Values of a stage that was not reached, or that a posture does not have, are
#: NaN, 0, false or empty. Palm, joints, contacts and lift are those of the first wrist pose.
VERIFICATION_FIELDS: tuple[Field, ...] = (
    Field("object", "str", "name of the object", of="placed.model.name"),
    _verdict("outcome", [outcome for outcome in Outcome if not outcome.dataset_only]),
    Field("matches", "bool", "whether the first wrist pose holds, with each contact within "
          "verify.max_contact_error of the requested contact", of="matches"),
    Field("lifted", "bool", "whether the first wrist pose holds, wherever the contacts are",
          of="lifted"),
    *(replace(field, of=field.name) for field in _WORDS),
    Field("kept", "bool", "whether the grasp passes the filters of a dataset, except filters "
          "that need images or other grasps", of="kept"),
    Field("clean", "bool", "whether the grasp is kept, and no neighbour moved by more than 10 mm "
          "or turned by more than 10 degrees", of="clean"),
    Field("neighbour_shift", "float64", "largest motion of a neighbour's origin; NaN without "
          "neighbours", unit="m", of="disturbance.shift"),
    Field("neighbour_turn", "float64", "largest turn of a neighbour; NaN without neighbours",
          unit="rad", of="disturbance.turn"),
    Field("removal", "uint8", f"first filter that removes a lifted grasp: {_labels(list(Removal))}",
          stage=Stage.TRIED, of="removal"),
    Field("lifted_any", "bool",
          "whether any of the tried wrist poses holds: the choice of an oracle", of="lifted_any"),
    Field("confidence", "float64", "confidence that the file of the grasps states; NaN if it "
          "states none", of="grasp.confidence", shown=Shown("confidence", digits=3)),
    Field("rank", "int64",
          "rank by confidence among the grasps for the same row, or without rows for the same "
          "object; 0 for the best, -1 if the file states no confidence", of="grasp.rank"),
    Field("reason", "str", "reason of the outcome, in words", of="reason"),
    Field("hints", "str", "changes with which a failed grasp would fit much better, in words",
          of="hint_text"),
    *_measured(
        "placed",
        _X_TO,
        Field("X_TO_simulated", "float64", "pose of the object in the simulation: moved on the "
              "table and rotated about its normal", "12", "m, -", "T"),
    ),
    Field("p_OQ", "float64", "contact points of the tried grasp; NaN in an invalid row", "k 3",
          "m", "O", of="p_OQ"),
    Field("nhat_Q_O", "float64", "outward unit normals of the tried grasp", "k 3", frame="O",
          of="nhat_Q_O"),
    Field("normalised", "bool", "whether a predicted normal was not of unit length",
          of="grasp.normalised"),
    Field("surface_distance", "float64", "distance of the predicted points from the object's "
          "surface", "k", "m", of="surface_distance", shown=Shown("requested to surface", "mm")),
    Field("epsilon", "float64",
          "Ferrari-Canny measure of the predicted contacts, 0 without force closure",
          of="epsilon", shown=Shown("epsilon of the requested contacts", digits=3)),
    *_measured(
        "pregrasp",
        Field("X_OG", "float64", "fitted or given pose of the palm", "12", "m, -", "O"),
        _SPREAD,
    ),
    Field("closing", "float64", "closing positions at which the fingertips meet the predicted "
          "points", "k", "rad or m", of="fit.closing"),
    Field("fit_residual", "float64",
          "distance of the predicted points from the fingertips at these positions", "k", "m",
          of="fit.residual", shown=Shown("requested to fingertip of the fit", "mm")),
    Field("fit_normal_error", "float64",
          "angle between the fingertips' and the predicted normals at these positions", "k",
          "rad", of="fit.normal_error", shown=Shown("requested normal to pad of the fit", "°")),
    Field("tries", "uint16", "number of wrist poses that were tried", of="num_tries",
          shown=Shown("wrist poses tried", digits=0)),
    *_since(
        Stage.CLOSED,
        _TIME_CLOSE,
        *_CLOSED,
        Field("contact_error", "float64", "distance of the contact points after closing from "
              "the requested ones; NaN for a fingertip that does not touch", "k", "m",
              per_finger=True, of="contact_error", shown=Shown("requested to reached", "mm")),
        Field("normal_error", "float64",
              "angle between the normals after closing and the requested ones", "k", "rad",
              per_finger=True, of="normal_error", shown=Shown("requested to reached normal", "°")),
    ),
    *_since(
        Stage.TRIED,
        _TIME_LIFT,
        *_LIFTED,
        Field("X_TO_lifted", "float64", "pose of the object after the lift, which starts at "
              "X_TO_simulated", "12", "m, -", "T", of="trial.lift.X_TO"),
        *_SLIP,
    ),
)

#: Kinds of views in `/views` of scenes.hdf5.
VIEW_KINDS = ("drawn", "ring", "single")
#: Number of points on the surface of an object in `/objects` of scenes.hdf5.
SURFACE_POINTS = 4096
#: Depth [m] of one unit in a depth image of scenes.hdf5.
DEPTH_UNIT = 1e-4

#: Row of /objects, and outcome of a grasp, where there is none.
NO_OBJECT, NOT_TRIED = -1, 255
#: What a hand meets: nothing, or the table or a wall; otherwise the index of an object.
HITS_NOTHING, HITS_TABLE = 255, 254
#: A neighbour that moved or turned by more than this does not count as left in place [m], [rad].
MOVED_SHIFT, MOVED_TURN = 0.010, float(np.deg2rad(10.0))

#: A row per scene, in `/scenes` of scenes.hdf5, where it is one object in a resting pose, and of
#: clutter.hdf5, where it has up to `o` objects.
SCENE_FIELDS: tuple[Field, ...] = (
    Field("split", "uint8", f"{', '.join(f'{i} {name}' for i, name in enumerate(SPLITS))}: by "
          f"object, whatever `split.by` is", limits=(0, len(SPLITS) - 1)),
    Field("object", "int32", "rows of /objects; -1 beyond the last object of the scene", "o"),
    Field("resting", "uint8", "indices of the objects' resting poses; 255 for an object that lies "
          "otherwise", "o"),
    Field("probability", "float64", "fractions of the drops that ended in them", "o", some=True),
    Field("X_TO", "float64", "poses of the objects: resting poses, rotated about Tz and moved "
          "on the table, or how they lie among others", "o 12", "m, -", "T", some=True),
    Field("mass", "float64", "masses of the objects; the mass drawn for an attempt may differ",
          "o", "kg", some=True),
    Field("friction_hand", "float64", "effective coefficients of friction between hand and "
          "objects; may differ in attempts", "o", some=True),
    Field("friction_table", "float64", "effective coefficients of friction between table and "
          "objects; may differ in attempts", "o", some=True),
    Field("surroundings", "str", "name of the surroundings of the objects, see the attribute of "
          "the file; only in clutter.hdf5", optional=True),
    Field("seed", "uint64", "state of the random stream of the scene; only in clutter.hdf5",
          optional=True),
)

#: A row per camera and scene, in `/views` of scenes.hdf5.
VIEW_FIELDS: tuple[Field, ...] = (
    Field("scene", "int32", "row of /scenes"),
    Field("kind", "uint8",
          f"the camera: {', '.join(f'{i} {name}' for i, name in enumerate(VIEW_KINDS))}"),
    Field("rgb", "uint8", "colours", "h w 3", frame="C", sample=True),
    Field("depth", "uint16", "depth without noise; 0 where nothing is between `near` and `far`",
          "h w", "0.1 mm", "C", sample=True),
    Field("mask", "uint8", "1 + index of the visible object in the scene, 0 elsewhere", "h w",
          frame="C", sample=True),
    Field("K", "float64", "camera matrix, 3x3 row-major", "9", "px"),
    Field("X_TC", "float64", "pose of the camera", "12", "m, -", "T"),
    *(replace(field, optional=False) for field in CONDITION_FIELDS
      if field.name in ("object_colour", "table_colour", "light_direction", "light_strength",
                        "depth_noise", "depth_seed")),
    Field("visible_share", "float64", "fraction of each object's outline that nothing hides; NaN "
          "outside of the image; only in clutter.hdf5", "o", limits=(0, 1), some=True,
          optional=True),
)

#: A row per closed hand, in `/grasps` of scenes.hdf5; the grasps of a scene are consecutive.
SCENE_GRASP_FIELDS: tuple[Field, ...] = (
    Field("scene", "int32", "row of /scenes"),
    Field("object", "uint8", "index of the grasped object in the scene"),
    Field("trial_id", "int64", "row of trials.hdf5"),
    Field("outcome", "uint8", "verdict, see /trials; in clutter.hdf5 of the grasp in its scene, or "
          "255 if it was not tried there"),
    Field("tested", "bool",
          "whether a lift was tried to a verdict; if not, it is unknown whether it would hold"),
    Field("lifted", "bool", "whether the grasp holds"),
    *_WORDS,
    Field("kept", "bool", "whether the grasp is a sample of the dataset; in clutter.hdf5 whether "
          "it passes the filters in its scene, except those of images and other grasps"),
    *(replace(field, optional=True, some=True) for field in (
        Field("free", "bool", "whether neither the open hand, on its straight way of 10 cm and at "
              "the grasp, nor the closed hand intersects neighbours, walls or table; only in "
              "clutter.hdf5, as the next five fields"),
        Field("hit", "uint8", "what the hand intersects first: index of the object in the scene, "
              "254 table or wall, 255 nothing"),
        Field("clean", "bool", "whether the grasp is kept, and no neighbour moved by more than "
              "10 mm or turned by more than 10 degrees"),
        Field("neighbour", "uint8", "index in the scene of the neighbour that moved most; 255 for "
              "none"),
        Field("neighbour_shift", "float64", "largest motion of a neighbour's origin; NaN if not "
              "tried", unit="m", limits=FROM_0),
        Field("neighbour_turn", "float64", "largest turn of a neighbour; NaN if not tried",
              unit="rad", limits=ANGLE),
    )),
    Field("source", "uint8", "sampler of the palm pose, see /trials", of="source"),
    *(replace(field, of=field.name) for field in ROBUST_FIELDS),
    *_PRESHAPE,
    Field("X_TG", "float32", "pose of the palm at the start and while closing", "12", "m, -", "T"),
    Field("X_TG_lifted", "float32", "pose of the palm after the lift, relative to the resting "
          "object; NaN if no lift was tried", "12", "m, -", "T"),
    replace(_JOINTS, name="q_open", dtype="float32", of="",
            meaning="positions of the hand's joints where it starts to close, fully open"),
    replace(_JOINTS, dtype="float32", of="closed_q",
            meaning="positions of the hand's joints after closing"),
    replace(_JOINTS, name="q_lifted", dtype="float32", of="lifted_q",
            meaning="positions of the hand's joints after the lift; NaN if no lift was tried"),
    *(field for suffix, when in (("", "after closing"),
                                 ("_lifted", "after the lift, on the resting object; NaN if no "
                                  "lift was tried"))
      for field in (
        Field(f"p_TQ{suffix}", "float32", f"contact points {when}", "k 3", "m", "T",
              per_finger=True),
        Field(f"nhat_Q_T{suffix}", "float32", f"unit normals out of the object {when}", "k 3",
              frame="T", per_finger=True),
        Field(f"f_Q_T{suffix}", "float32", f"forces of the fingertips on the object {when}",
              "k 3", "N", "T"),
    )),
)

#: A row per view and grasp of its scene, in `/visible` of scenes.hdf5, view by view.
VISIBLE_FIELDS: tuple[Field, ...] = (
    Field("view", "int32", "row of /views"),
    Field("grasp", "int32", "row of /grasps"),
    Field("visible", "bool", "whether the camera sees the contact after closing: the contact is "
          "in the image, and neither object nor table hides it", "k"),
)

#: A row per object, in `/objects` of scenes.hdf5.
SCENE_OBJECT_FIELDS: tuple[Field, ...] = (
    *(field for field in OBJECT_FIELDS if field.name in ("name", "class_name", "mesh_sha256")),
    Field("p_OS", "float32", "points spread evenly over the surface", f"{SURFACE_POINTS} 3", "m",
          "O", sample=True),
    Field("nhat_S_O", "float32", "unit normals out of the object at these points",
          f"{SURFACE_POINTS} 3", frame="O", sample=True),
)

#: What an arm can do about a grasp: all of it, or where the branch ends that comes farthest.
REACHES = ("reachable", "out_of_reach", "collision", "approach", "lift")

_REACHED: tuple[Field, ...] = (
    Field("reachable", "bool", "whether one branch of the arm's inverse kinematics has the "
          "approach, the grasp and the lift, within joint limits, without a jump or a collision"),
    Field("reach_outcome", "uint8", "0 reachable; otherwise where the branch ends that comes "
          "farthest: 1 out_of_reach, no joint positions for the palm pose; 2 collision at the palm "
          "pose; 3 approach, also if the hand itself collides there; 4 lift",
          limits=(0, len(REACHES) - 1)),
    *(Field(name, "float64", f"positions of the arm's joints {when}; NaN if not reachable", "a",
            "rad or m", some=True)
      for name, when in (("q_approach", "at the start of the approach"),
                         ("q_grasp", "at the palm pose of the grasp"),
                         ("q_lift", "at the end of the lift"))),
    Field("clearance", "float64", "least distance, all the way, of arm and hand from the table, "
          "and of the arm and the open hand from the object; at most 0.2, NaN if not reachable",
          unit="m", some=True, shown=Shown("clearance of the arm", "mm")),
)

#: A row per grasp that an arm was asked for, in `/reach` of reach/NAME.hdf5.
REACH_FIELDS: tuple[Field, ...] = (
    Field("object", "str", "name of the object"),
    *(field for field in TRIAL_FIELDS if field.name in ("candidate", "standoff_index")),
    Field("trial_id", "int64", "row of trials.hdf5"),
    *_REACHED,
)

#: A row per free grasp of clutter.hdf5 that an arm was asked for, in `/clutter` of
#: reach/clutter/NAME.hdf5.
CLUTTER_REACH_FIELDS: tuple[Field, ...] = (
    Field("grasp", "int64", "row of /grasps of clutter.hdf5"),
    Field("scene", "int32", "row of /scenes of clutter.hdf5"),
    Field("object", "uint8", "index of the grasped object in the scene"),
    *_REACHED[:-1],
    replace(_REACHED[-1], meaning="least distance, all the way, of arm and hand from table and "
            "walls, and of the arm and the open hand from all objects; at most 0.2, NaN if not "
            "reachable"),
)

#: A row per corner of the shapes of the arm, in `/shapes` of both files of an arm.
SHAPE_FIELDS: tuple[Field, ...] = (
    Field("link", "str", "name of the link"),
    Field("hull", "uint16", "number of the convex hull to which the corner belongs"),
    Field("p_LC", "float64", "the corner, in the frame of its link", "3", "m"),
)

#: A row per predicted grasp, in `/rows` of the results for rows of a dataset.
PREDICTED_ROW_FIELDS: tuple[Field, ...] = (
    Field("row", "int64", "row of the dataset's split to which the grasp belongs"),
    Field("trial_id", "int64", "row of trials.hdf5 of the same sample"),
)
# fmt: on

#: Fields of each group of a file, by the group's name.
Tables = Mapping[str, tuple[Field, ...]]
DATA_TABLES: Tables = {split: DATA_FIELDS for split in SPLITS}
TRIAL_TABLES: Tables = {
    "objects": OBJECT_FIELDS,
    "trials": TRIAL_FIELDS,
    "successes": SUCCESS_FIELDS,
}
SCENE_TABLES: Tables = {
    "objects": SCENE_OBJECT_FIELDS,
    "scenes": SCENE_FIELDS,
    "views": VIEW_FIELDS,
    "grasps": SCENE_GRASP_FIELDS,
    "visible": VISIBLE_FIELDS,
}
REACH_TABLES: Tables = {"reach": REACH_FIELDS, "shapes": SHAPE_FIELDS}
CLUTTER_REACH_TABLES: Tables = {"clutter": CLUTTER_REACH_FIELDS, "shapes": SHAPE_FIELDS}
#: Columns that number the rows of another group, by their group.
ROW_NUMBERS: Mapping[str, Mapping[str, str]] = {
    "trials": {"object": "objects"},
    **{split: {"trial_id": "trials"} for split in SPLITS},
    "successes": {"trial_id": "trials"},
    "scenes": {"object": "objects"},
    "views": {"scene": "scenes"},
    "grasps": {"scene": "scenes"},
    "reach": {"trial_id": "trials"},
    "clutter": {"scene": "scenes", "grasp": "grasps"},
    "visible": {"view": "views", "grasp": "grasps"},
}
