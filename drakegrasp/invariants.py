"""What must hold in a dataset: each invariant is one function.

In: an open file, or a `Batch`, some rows of one of its groups. Out: a `Violation` for every
file, row and figure that is wrong. `drakegrasp.check` decides which rows are looked at and
in which order: an invariant may rely on those before it, because it is given no row that
broke one of them. Apart from the layout nothing here reads a file, and nothing needs Drake.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.camera import (
    LOOKS_VERTICALLY,
    camera_pose_otm,
    camera_pose_oto,
    intrinsics,
    project,
    unproject,
)
from drakegrasp.config import CameraConfig, Config, parse_config
from drakegrasp.errors import ConfigError
from drakegrasp.frames import P_WT, X_WT, Array, invert_pose, transform_points, unpack_pose
from drakegrasp.meshes import ObjectModel
from drakegrasp.outcomes import Outcome, Stage
from drakegrasp.schema import (
    CAMERAS,
    CONVENTIONS,
    DATA_FIELDS,
    SCHEMA_VERSION,
    TRIAL_FIELDS,
    Field,
    sizes,
)

AnyArray = npt.NDArray[Any]
#: Unit vectors and rotations as float32 are good to 2e-7; this leaves room for products.
UNIT_TOLERANCE = 1e-5
#: Points within a metre or two as float32 are good to 1e-7 m; likewise.
POSITION_TOLERANCE = 1e-5  # [m]
#: Rows that one broken invariant lists for a group of a file before it only counts them.
MAX_LISTED = 20
#: Mass properties are float32 copies of the object's own.
RELATIVE_TOLERANCE = 1e-5
#: Depth images reproduce the table and the mesh to 1e-6 m when the lens is right. Half a pixel
#: of error moves them by 1 to 3 mm, so this tells the two apart.
DEPTH_TOLERANCE = 3e-4  # [m]
#: A contact on the object's outline falls beside the mask by rounding, and a contact point may
#: be off the full mesh by what the collision mesh and `filters.max_surface_distance` allow.
MASK_TOLERANCE = 2.0  # [px]
#: A contact is on the surface that is seen or behind it; at outlines the depth image jumps, so
#: the nearest surface within this many pixels counts, and the same 2 mm and a slope are allowed.
SILHOUETTE = 2  # [px]
BEFORE_SURFACE = 5e-3  # [m]
#: The image frame's origin is the mask's centroid itself, unprojected.
CENTROID_TOLERANCE = 0.05  # [px]
#: Mask pixels per image whose distance from the mesh is measured; the box test takes all.
MEASURED_PIXELS = 16
#: The table's slab (models/table.sdf): half edges and centre in {T} [m].
TABLE_HALF = np.array([0.8, 0.8, 0.05])
P_TTABLE = np.array([0.0, 0.0, -0.05])
FRAMES = tuple(f.name for f in DATA_FIELDS if f.name.startswith("object_props/frame_"))
#: K, near and far are float64 copies of what the configuration gives.
CAMERA_TOLERANCE = 1e-9
#: A patch's mean normal and its force are two averages: where a fingertip is just losing the
#: object they may disagree by as much as the force from which on a contact counts [N].
PULL = 0.05


@dataclass(frozen=True, kw_only=True)
class Violation:
    """One broken invariant.

    Attributes:
        file: Path within the dataset's directory.
        group: Group or split within the file, e.g. `/train`; empty for the whole file.
        row: Row of the group; None for all of it.
        what: The invariant in words, with its unit.
        got: The figure that breaks it.
    """

    file: str
    group: str = ""
    row: int | None = None
    what: str
    got: str

    def __str__(self) -> str:
        place = " ".join(p for p in (self.file, self.group) if p)
        row = "" if self.row is None else f" row {self.row}"
        return f"{place}{row}: {self.what}, got {self.got}"


@dataclass(frozen=True, kw_only=True, eq=False)
class Batch:
    """Some rows of one group.

    Attributes:
        file, group: Where they are from.
        rows: (n,) their numbers.
        columns: Values by field, each (n, ...).
    """

    file: str
    group: str
    rows: npt.NDArray[np.int64]
    columns: Mapping[str, AnyArray]

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, name: str) -> AnyArray:
        return self.columns[name]

    def pose(self, name: str) -> Array:
        """Return the poses (n, 4, 4) of a field."""
        return unpack_pose(self.columns[name])

    def frame(self, name: str) -> Array:
        """Return the poses (n, 4, 4) of a frame of `object_props`."""
        return self.pose(f"object_props/frame_{name}")

    def contacts(self) -> tuple[Array, Array]:
        """Return points and normals of the grasps, (n, k, 3) each, in the camera frame."""
        vectors = self.columns["grasps"].astype(float).reshape(len(self), 2, -1, 3)
        return vectors[:, 0], vectors[:, 1]

    def without(self, rows: set[int]) -> Batch:
        """Return the batch without some rows, given by their numbers."""
        keep = ~np.isin(self.rows, sorted(rows))
        return Batch(
            file=self.file,
            group=self.group,
            rows=self.rows[keep],
            columns={name: values[keep] for name, values in self.columns.items()},
        )

    def broken(
        self, what: str, bad: AnyArray, got: Callable[[int], str] | AnyArray
    ) -> Iterator[Violation]:
        """Yield a violation of each row where `bad` (n,) is true."""
        for i in np.flatnonzero(bad).tolist():
            figure = got(i) if callable(got) else f"{got[i].item():.6g}"
            yield Violation(
                file=self.file, group=self.group, row=int(self.rows[i]), what=what, got=figure
            )


@dataclass
class Findings:
    """Violations as they are found, each invariant's up to a limit for a group of a file."""

    _listed: dict[tuple[str, str, str], list[Violation]] = field(default_factory=dict)
    _more: dict[tuple[str, str, str], int] = field(default_factory=dict)

    def add(self, violations: Iterable[Violation]) -> set[int]:
        """Take violations and return the rows that they are in."""
        rows = set()
        for violation in violations:
            key = (violation.file, violation.group, violation.what)
            listed = self._listed.setdefault(key, [])
            if len(listed) < MAX_LISTED:
                listed.append(violation)
            else:
                self._more[key] = self._more.get(key, 0) + 1
            if violation.row is not None:
                rows.add(violation.row)
        return rows

    def violations(self) -> list[Violation]:
        """Return what was listed, with a line for what was only counted."""
        result = []
        for key, listed in self._listed.items():
            result += listed
            if key in self._more:
                file, group, what = key
                got = f"{self._more[key]} more rows that break it"
                result.append(Violation(file=file, group=group, what=what, got=got))
        return result


# The file as a whole


def read_config(name: str, file: h5py.File) -> tuple[Config | None, list[Violation]]:
    """Return the configuration that is stored in a file, if it is sound."""
    try:
        return parse_config(json.loads(str(file.attrs["config"]))), []
    except KeyError:
        got = "none"
    except (json.JSONDecodeError, ConfigError) as error:
        got = f"another ({str(error).splitlines()[0]})"
    what = "attribute config must be a configuration of drakegrasp as JSON"
    return None, [Violation(file=name, what=what, got=got)]


def attributes(
    name: str, file: h5py.File, config: Config | None, camera: str
) -> Iterator[Violation]:
    """The attributes say what the file is of, and agree with its configuration.

    Args:
        name: Of the file, for the violations.
        file: The file.
        config: That it holds.
        camera: `oto` or `otm`; empty for the trials.
    """
    attrs = file.attrs

    def broken(what: str, got: object) -> Violation:
        return Violation(file=name, what=f"attribute {what}", got=str(got))

    required = [*(f"convention_{key}" for key in CONVENTIONS), "signature", "versions"]
    for key in required:
        if not str(attrs.get(key, "")).strip():
            yield broken(f"{key} must be there", "none")
    expected = {"schema_version": SCHEMA_VERSION}
    if camera:
        expected["camera"] = camera  # type: ignore[assignment]
    if config is not None:
        expected |= {"config_hash": config.simulation_hash(), "seed": config.seed}  # type: ignore[dict-item]
    for key, value in expected.items():
        if attrs.get(key) != value:
            yield broken(f"{key} must be {value}", attrs.get(key, "none"))
    if "versions" in attrs and not _is_json_object(str(attrs["versions"])):
        yield broken("versions must be a JSON object", attrs["versions"])
    if config is not None:
        numbers = {
            "K": intrinsics(config.camera),
            "near": np.array(config.camera.near),
            "far": np.array(config.camera.far),
        }
        for key, number in numbers.items():
            found = np.asarray(attrs.get(key, np.nan))
            if found.shape != number.shape or not np.allclose(
                found, number, rtol=CAMERA_TOLERANCE, atol=CAMERA_TOLERANCE
            ):
                yield broken(f"{key} must be {number.tolist()}", found.tolist())


def structure(
    name: str, file: h5py.File, fields: Mapping[str, tuple[Field, ...]], config: Config | None
) -> Iterator[Violation]:
    """Groups, datasets, types, shapes and their attributes are those of the table.

    Args:
        name: Of the file, for the violations.
        file: The file.
        fields: Of each group.
        config: Says how large the images are, if it is known.
    """
    for extra in sorted(set(file) - set(fields)):
        yield Violation(file=name, what="groups must be those of the schema", got=f"/{extra} too")
    letters = _letters(file, config)
    for group_name, table in fields.items():
        group = file.get(group_name)
        if not isinstance(group, h5py.Group):
            yield Violation(
                file=name, group=f"/{group_name}", what="the group must be there", got="none"
            )
            continue
        found: list[str] = []
        group.visititems(
            lambda key, node, found=found: (
                found.append(key)  # type: ignore[misc]
                if isinstance(node, h5py.Dataset)
                else None
            )
        )
        for key in sorted(set(found) - {f.name for f in table}):
            yield Violation(
                file=name,
                group=f"/{group_name}",
                what="datasets must be those of the schema",
                got=f"{key} too",
            )
        counts = [len(group[f.name]) for f in table if f.name in found and group[f.name].shape]
        rows = max(set(counts), key=counts.count) if counts else 0
        for f in table:
            dataset = group[f.name] if f.name in found else None
            yield from _field(name, f"/{group_name}/{f.name}", dataset, f, rows, letters)


def _field(
    name: str,
    place: str,
    dataset: h5py.Dataset | None,
    field: Field,
    rows: int,
    letters: Mapping[str, int],
) -> Iterator[Violation]:
    def broken(what: str, got: object) -> Violation:
        return Violation(file=name, group=place, what=what, got=str(got))

    if dataset is None:
        yield broken("the dataset must be there", "none")
        return
    text = h5py.check_string_dtype(dataset.dtype) is not None
    if text != (field.dtype == "str") or not (text or dataset.dtype == np.dtype(field.dtype)):
        yield broken(f"type must be {field.dtype}", dataset.dtype)
    try:
        shape = (rows, *field.row_shape(letters))
    except KeyError:
        shape = (rows, *dataset.shape[1:])  # a letter whose size no sound dataset tells
    if dataset.shape != shape:
        yield broken(f"shape must be {shape}", dataset.shape)
    for key, value in (("unit", field.unit), ("frame", field.frame)):
        if dataset.attrs.get(key) != value:
            yield broken(f"attribute {key} must be {value!r}", repr(dataset.attrs.get(key)))
    # Wording may improve without a new version of the schema.
    if not str(dataset.attrs.get("meaning", "")):
        yield broken("attribute meaning must be there", "none")


def _letters(file: h5py.File, config: Config | None) -> dict[str, int]:
    """Return the sizes of the letters in the shapes, from the file's own majority."""
    fingers = []
    joints = []
    for place, axis, each in (
        ("train/grasps", 1, 6),
        ("valid/grasps", 1, 6),
        ("test/grasps", 1, 6),
        ("trials/closed_touching", 1, 1),
        ("trials/closed_area", 1, 1),
        ("trials/lifted_area", 1, 1),
    ):
        if place in file and len(file[place].shape) > axis and file[place].shape[axis] % each == 0:
            fingers.append(file[place].shape[axis] // each)
    for place in ("trials/closed_q", "trials/lifted_q"):
        if place in file and len(file[place].shape) == 2:
            joints.append(file[place].shape[1])
    k = max(set(fingers), key=fingers.count) if fingers else 0
    j = max(set(joints), key=joints.count) if joints else 0
    found = sizes(fingers=k, joints=j, image=config.camera.size if config else 0)
    missing = {*(() if k else ("k", "6k")), *(() if j else ("j",)), *(() if config else ("S",))}
    return {letter: size for letter, size in found.items() if letter not in missing}


def _is_json_object(text: str) -> bool:
    try:
        return isinstance(json.loads(text), dict)
    except json.JSONDecodeError:
        return False


@dataclass(frozen=True, kw_only=True, eq=False)
class Lens:
    """The camera of a data file: its name, matrix K (3, 3) [px] and range [m]."""

    camera: str
    K: Array
    near: np.float32
    far: np.float32

    @classmethod
    def of(cls, camera: str, config: CameraConfig) -> Lens:
        """Return the lens of a configuration; images hold its range rounded to float32."""
        return cls(
            camera=camera,
            K=intrinsics(config),
            near=np.float32(config.near),
            far=np.float32(config.far),
        )

    def cam2work(self, batch: Batch) -> Array:
        """Return X_CT (n, 4, 4) of this camera."""
        return batch.frame(f"cam2work_{self.camera}")


# Values of a data file, one by one


def finite(batch: Batch) -> Iterator[Violation]:
    """No number of a sample is NaN or infinite."""
    for f in DATA_FIELDS:
        if f.dtype.startswith("float"):
            bad = ~_all_per_row(np.isfinite(batch[f.name]))
            yield from batch.broken(
                f"{f.name} must be finite", bad, lambda i: "NaN or an infinite value"
            )


def normals(batch: Batch) -> Iterator[Violation]:
    """Normals have length one."""
    lengths = np.linalg.norm(batch.contacts()[1], axis=2)
    yield from _unit_length(batch, lengths, "normal of finger")


def image_values(batch: Batch, lens: Lens) -> Iterator[Violation]:
    """Colours are within 0..1, depths within near..far."""
    colour, depth = batch["images"][:, :3], batch["images"][:, 3]
    for what, values, low, high in (
        ("colours must be within 0..1", colour, 0.0, 1.0),
        (f"depths must be within {lens.near:g}..{lens.far:g} m", depth, lens.near, lens.far),
    ):
        flat = values.reshape(len(batch), -1)
        least, most = flat.min(axis=1), flat.max(axis=1)
        yield from batch.broken(
            what,
            (least < low) | (most > high),
            lambda i, least=least, most=most: f"{least[i]:.6g}..{most[i]:.6g}",  # type: ignore[misc]
        )


def mask_values(batch: Batch) -> Iterator[Violation]:
    """A mask holds nothing but 0 and 1, and at least one 1."""
    largest = batch["masks"].reshape(len(batch), -1).max(axis=1)
    yield from batch.broken("mask must hold 0 and 1 only", largest > 1, largest)
    yield from batch.broken(
        "mask must have an object pixel", largest == 0, lambda i: "an empty mask"
    )


def frames(batch: Batch) -> Iterator[Violation]:
    """Every frame's rotation is orthonormal with determinant +1."""
    for name in FRAMES:
        yield from _rotation(batch, name)


def work_frame(batch: Batch) -> Iterator[Violation]:
    """The table-top frame is where it always is."""
    off = np.abs(batch.frame("world2work") - X_WT).max(axis=(1, 2))
    yield from batch.broken(
        f"frame_world2work must be the identity at {P_WT.tolist()} m",
        off > POSITION_TOLERANCE,
        lambda i: f"a pose that is off by {off[i]:.4g}",
    )


def mass_properties(batch: Batch) -> Iterator[Violation]:
    """Masses are positive; inertias are symmetric and those of a real body."""
    mass = batch["object_props/work2mass"][:, 0].astype(float)
    yield from batch.broken("work2mass must be positive [kg]", mass <= 0.0, mass)
    inertia = batch["object_props/work2inertia"].astype(float).reshape(-1, 3, 3)
    skew = np.abs(inertia - np.swapaxes(inertia, 1, 2)).max(axis=(1, 2))
    scale = np.trace(inertia, axis1=1, axis2=2)
    moments = np.linalg.eigvalsh(inertia)
    slack = moments[:, 0] + moments[:, 1] - moments[:, 2]
    bad = (skew > RELATIVE_TOLERANCE * scale) | (slack < -RELATIVE_TOLERANCE * scale)
    yield from batch.broken(
        "work2inertia must be symmetric with moments of a real body [kg m^2]",
        bad | (moments[:, 0] <= 0.0),
        lambda i: f"moments {np.array2string(moments[i], precision=4)}, skew by {skew[i]:.3g}",
    )


# How the frames of a sample belong together


def inverse_frames(batch: Batch) -> Iterator[Violation]:
    """work2cam and cam2work are each other's inverse."""
    for camera in CAMERAS:
        product = batch.frame(f"work2cam_{camera}") @ batch.frame(f"cam2work_{camera}")
        off = np.abs(product - np.eye(4)).max(axis=(1, 2))
        yield from batch.broken(
            f"frame_work2cam_{camera} times frame_cam2work_{camera} must be the identity",
            off > POSITION_TOLERANCE,
            lambda i, off=off: f"a product that is off by {off[i]:.4g}",  # type: ignore[misc]
        )


def camera_pair(batch: Batch) -> Iterator[Violation]:
    """Both cameras stand at one point and look the same way; otm has world up at the top."""
    oto, otm = (batch.frame(f"work2cam_{camera}") for camera in CAMERAS)
    off = np.abs(oto[:, :3, 2:] - otm[:, :3, 2:]).max(axis=(1, 2))
    yield from batch.broken(
        "both cameras must have the same place and view",
        off > POSITION_TOLERANCE,
        lambda i: f"poses that are off by {off[i]:.4g}",
    )
    tilt = np.abs(otm[:, 2, 0])
    yield from batch.broken(
        "the otm camera must have world up at the top of its image",
        (tilt > LOOKS_VERTICALLY + UNIT_TOLERANCE) | (otm[:, 2, 1] > LOOKS_VERTICALLY),
        lambda i: f"+Cx and +Cy that rise by {otm[i, 2, 0]:.4g} and {otm[i, 2, 1]:.4g}",
    )


def image_frames(batch: Batch, lens: Lens) -> Iterator[Violation]:
    """The image frame is before the camera, faces away, and in otm starts at the centroid."""
    X_CI = batch.frame("cam2img_otm")
    yield from batch.broken(
        "frame_cam2img_otm must start before the camera [m]", X_CI[:, 2, 3] <= 0.0, X_CI[:, 2, 3]
    )
    turned = np.abs(X_CI[:, :3, 0] - [0.0, 0.0, 1.0]).max(axis=1)
    yield from batch.broken(
        "frame_cam2img_otm must have +Ix along +Cz",
        turned > UNIT_TOLERANCE,
        lambda i: np.array2string(X_CI[i, :3, 0], precision=4),
    )
    if lens.camera == "otm":
        ahead = X_CI[:, 2, 3] > 0.0
        off = np.zeros(len(batch))
        for i in np.flatnonzero(ahead):
            v, u = np.nonzero(batch["masks"][i])
            off[i] = np.linalg.norm(project(lens.K, X_CI[i, None, :3, 3])[0] - [u.mean(), v.mean()])
        yield from batch.broken(
            f"frame_cam2img_otm must start within {CENTROID_TOLERANCE} px of the mask's centroid",
            off > CENTROID_TOLERANCE,
            off,
        )


# What the camera sees


def contacts_in_image(batch: Batch, lens: Lens) -> Iterator[Violation]:
    """Contacts project onto the mask, and lie on the surface that is seen or behind it."""
    p_CQ, _ = batch.contacts()
    for finger in range(p_CQ.shape[1]):
        z = p_CQ[:, finger, 2]
        beside, before = np.zeros(len(batch)), np.zeros(len(batch))
        for i in np.flatnonzero(z > 0.0):
            (pixel,) = project(lens.K, p_CQ[i, finger, None])
            v, u = np.nonzero(batch["masks"][i])
            beside[i] = np.hypot(u - pixel[0], v - pixel[1]).min()
            if beside[i] <= MASK_TOLERANCE:
                before[i] = _nearest_depth(batch["images"][i, 3], pixel) - z[i]
        yield from batch.broken(
            f"contact of finger {finger + 1} must be before the camera [m]", z <= 0.0, z
        )
        yield from batch.broken(
            f"contact of finger {finger + 1} must project within {MASK_TOLERANCE:g} px of the mask",
            beside > MASK_TOLERANCE,
            beside,
        )
        yield from batch.broken(
            f"contact of finger {finger + 1} must not lie more than {BEFORE_SURFACE:g} m before "
            "the surface in the depth image",
            before > BEFORE_SURFACE,
            before,
        )


def _nearest_depth(depth: AnyArray, pixel: Array) -> float:
    """Return the least depth [m] around a pixel, clipped into the image."""
    size = len(depth)
    u, v = np.clip(np.rint(pixel), 0, size - 1).astype(int)
    low = np.maximum([v - SILHOUETTE, u - SILHOUETTE], 0)
    return float(depth[low[0] : v + SILHOUETTE + 1, low[1] : u + SILHOUETTE + 1].min())


def table_pixels(batch: Batch, lens: Lens) -> Iterator[Violation]:
    """What is seen beside the object, nearer than far, is the table."""
    X_TC = invert_pose(lens.cam2work(batch))
    off = np.zeros(len(batch))
    for i in range(len(batch)):
        depth = batch["images"][i, 3]
        p_TQ = _seen_points(X_TC[i], lens, depth, (batch["masks"][i] == 0) & (depth < lens.far))
        outside = np.abs(p_TQ - P_TTABLE) - TABLE_HALF
        distance = np.linalg.norm(np.maximum(outside, 0.0), axis=1)
        distance += np.abs(np.minimum(outside.max(axis=1, initial=-np.inf), 0.0))
        off[i] = distance.max(initial=0.0)
    yield from batch.broken(
        f"points beside the mask must be on the table within {DEPTH_TOLERANCE:g} m",
        off > DEPTH_TOLERANCE,
        off,
    )


def _seen_points(X_AC: Array, lens: Lens, depth: AnyArray, chosen: AnyArray) -> Array:
    """Return the points p_AQ (m, 3) of the pixels where `chosen` (S, S) is true."""
    v, u = np.nonzero(chosen)
    return transform_points(X_AC, unproject(lens.K, np.column_stack([u, v]), depth[v, u]))


# The samples of one object, against its mesh


def object_pixels(batch: Batch, lens: Lens, model: ObjectModel) -> Iterator[Violation]:
    """What is seen in the mask is the object: in its bounding box, and on its surface."""
    X_OC = invert_pose(lens.cam2work(batch) @ (invert_pose(X_WT) @ batch.frame("world2obj")))
    beyond, chosen = np.zeros(len(batch)), []
    for i in range(len(batch)):
        p_OQ = _seen_points(X_OC[i], lens, batch["images"][i, 3], batch["masks"][i] == 1)
        beyond[i] = (np.abs(p_OQ) - model.half_extents).max()
        chosen.append(p_OQ[np.linspace(0, len(p_OQ) - 1, MEASURED_PIXELS).astype(int)])
    yield from batch.broken(
        f"points in the mask must be in the object's box within {DEPTH_TOLERANCE:g} m",
        beyond > DEPTH_TOLERANCE,
        beyond,
    )
    _, distance, _ = model.visual.nearest.on_surface(np.concatenate(chosen))
    off = distance.reshape(len(batch), -1).max(axis=1)
    yield from batch.broken(
        f"points in the mask must be on the object's mesh within {DEPTH_TOLERANCE:g} m",
        (off > DEPTH_TOLERANCE) & (beyond <= DEPTH_TOLERANCE),
        off,
    )


def contacts_on_mesh(
    batch: Batch, lens: Lens, model: ObjectModel, max_distance: float
) -> Iterator[Violation]:
    """Contacts are on the mesh, and their normals point out of it.

    A normal counts as outward if it agrees with the face that is nearest to the contact, or
    to a point that far ahead of it: in a thin wall, the wrong side may be the nearest.
    """
    X_OC = invert_pose(lens.cam2work(batch) @ (invert_pose(X_WT) @ batch.frame("world2obj")))
    p_CQ, n_C = batch.contacts()
    p_OQ = np.einsum("nij,nkj->nki", X_OC[:, :3, :3], p_CQ) + X_OC[:, None, :3, 3]
    n_O = np.einsum("nij,nkj->nki", X_OC[:, :3, :3], n_C)
    nearest, face_normals = model.visual.nearest, model.visual.face_normals
    shape = p_OQ.shape[:2]
    _, distance, face = nearest.on_surface(p_OQ.reshape(-1, 3))
    _, _, ahead = nearest.on_surface((p_OQ + max_distance * n_O).reshape(-1, 3))
    off = distance.reshape(shape)
    flat = n_O.reshape(-1, 3)
    cosine = np.maximum((flat * face_normals[face]).sum(1), (flat * face_normals[ahead]).sum(1))
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))).reshape(shape)
    limit = max_distance + POSITION_TOLERANCE
    for k in range(shape[1]):
        yield from batch.broken(
            f"contact of finger {k + 1} must be on the object's mesh within {max_distance:g} m",
            off[:, k] > limit,
            off[:, k],
        )
        yield from batch.broken(
            f"normal of finger {k + 1} must point out of the object, within 90 deg of its face's",
            (angle[:, k] > 90.0) & (off[:, k] <= limit),
            lambda i, k=k: f"{angle[i, k]:.4g} deg",  # type: ignore[misc]
        )


def object_values(batch: Batch, model: ObjectModel) -> Iterator[Violation]:
    """Class and mass properties are those of the object at rest."""
    X_TO = invert_pose(X_WT) @ batch.frame("world2obj")
    R_TO = X_TO[:, :3, :3]
    com = R_TO @ model.p_OOcm + X_TO[:, :3, 3]
    inertia = (R_TO @ model.I_OOcm_O @ np.swapaxes(R_TO, 1, 2)).reshape(-1, 9)
    for name, unit, values, tolerance in (
        ("work2com", "m", com, POSITION_TOLERANCE),
        ("work2inertia", "kg m^2", inertia, RELATIVE_TOLERANCE * np.trace(model.I_OOcm_O)),
        ("work2mass", "kg", np.full((len(batch), 1), model.mass), RELATIVE_TOLERANCE * model.mass),
    ):
        off = np.abs(batch[f"object_props/{name}"] - values).max(axis=1)
        yield from batch.broken(
            f"{name} must be the resting object's within {tolerance:.1g} {unit}",
            off > tolerance,
            lambda i, off=off: f"a difference of {off[i]:.4g}",  # type: ignore[misc]
        )
    found = batch["object_props/class_name"]
    yield from batch.broken(
        f"class_name of {model.name} must be {model.class_name!r}",
        found != model.class_name,
        lambda i: repr(found[i]),
    )


# A sample against its trial


def same_as_trial(
    batch: Batch, trials: Mapping[str, AnyArray], lens: Lens, config: CameraConfig
) -> Iterator[Violation]:
    """Pose, cameras and contacts of a sample are those of its trial, given row by row."""
    X_TO, X_OG = unpack_pose(trials["X_TO"]), unpack_pose(trials["X_OG"])
    poses = {"frame_world2obj": X_WT @ X_TO}
    for camera, pose in zip(CAMERAS, (camera_pose_oto, camera_pose_otm), strict=True):
        poses[f"frame_work2cam_{camera}"] = np.array(
            [pose(X, config) for X in X_TO @ X_OG]
        ).reshape(-1, 4, 4)
    for name, expected in poses.items():
        off = np.abs(batch.pose(f"object_props/{name}") - expected).max(axis=(1, 2))
        yield from batch.broken(
            f"{name} must follow from its trial within {POSITION_TOLERANCE:g} m",
            off > POSITION_TOLERANCE,
            lambda i, off=off: f"a pose that is off by {off[i]:.4g}",  # type: ignore[misc]
        )
    X_CO = lens.cam2work(batch) @ X_TO
    p_CQ = np.einsum("nij,nkj->nki", X_CO[:, :3, :3], trials["closed_p_OQ"])
    n_C = np.einsum("nij,nkj->nki", X_CO[:, :3, :3], trials["closed_nhat_Q_O"])
    points, normals = batch.contacts()
    off = np.maximum(
        np.abs(points - p_CQ - X_CO[:, None, :3, 3]).max(axis=(1, 2)),
        np.abs(normals - n_C).max(axis=(1, 2)),
    )
    yield from batch.broken(
        f"grasp must be its trial's contacts within {POSITION_TOLERANCE:g} m",
        ~(off <= POSITION_TOLERANCE),
        lambda i: f"a difference of {off[i]:.4g}",
    )


def same_grasp(batch: Batch, other: Batch) -> Iterator[Violation]:
    """Both data files hold the same properties, and the same grasp once moved to {T}."""
    for name in (f.name for f in DATA_FIELDS if f.name.startswith("object_props/")):
        differs = ~_all_per_row(batch[name] == other[name])
        yield from batch.broken(
            f"{name} must be equal to that of {other.file}", differs, lambda i: "another value"
        )
    moved = []
    for one, camera in ((batch, CAMERAS[0]), (other, CAMERAS[1])):
        R_TC = one.frame(f"work2cam_{camera}")
        points, normals = one.contacts()
        p_TQ = np.einsum("nij,nkj->nki", R_TC[:, :3, :3], points) + R_TC[:, None, :3, 3]
        moved.append((p_TQ, np.einsum("nij,nkj->nki", R_TC[:, :3, :3], normals)))
    off = np.max([np.abs(a - b).max(axis=(1, 2)) for a, b in zip(*moved, strict=True)], axis=0)
    yield from batch.broken(
        f"grasp must be that of {other.file} in {{T}} within {POSITION_TOLERANCE:g} m",
        off > POSITION_TOLERANCE,
        lambda i: f"a difference of {off[i]:.4g}",
    )


# Trials


def trial_numbers(
    batch: Batch, objects: int, candidates: Sequence[int] | None, standoffs: int | None
) -> Iterator[Violation]:
    """Numbers of a trial are legal: its own row, outcome, object, candidate, stand-off.

    Args:
        batch: Rows of `/trials`.
        objects: Number of objects.
        candidates: Number of candidates by object, if they are known.
        standoffs: Number of stand-offs, if it is known.
    """
    yield from batch.broken(
        "trial_id must be the row's number", batch["trial_id"] != batch.rows, batch["trial_id"]
    )
    outcome = batch["outcome"]
    yield from batch.broken(
        f"outcome must be 0..{max(Outcome)}", ~np.isin(outcome, [o.value for o in Outcome]), outcome
    )
    index, candidate = batch["object"], batch["candidate"]
    wild = (index < 0) | (index >= objects)
    yield from batch.broken(f"object must be a row of /objects, 0..{objects - 1}", wild, index)
    limit = np.full(objects, np.iinfo(np.int64).max)
    if candidates is not None and len(candidates) == objects:
        limit = np.array(candidates, dtype=np.int64)
    # An index out of range is found above; any object's limit will do for it.
    above = candidate >= np.take(limit, index, mode="clip") if objects else np.zeros_like(wild)
    yield from batch.broken(
        "candidate must be one of its object's candidates",
        ~wild & ((candidate < 0) | above),
        candidate,
    )
    if standoffs is not None:
        number = batch["standoff_index"]
        yield from batch.broken(
            f"standoff_index must be below {standoffs}", number >= standoffs, number
        )


def trial_stages(batch: Batch) -> Iterator[Violation]:
    """A stage's fields have values where the attempt came that far and nowhere else."""
    stage = _stages(batch)
    for f in TRIAL_FIELDS:
        values = batch[f.name]
        came = stage >= f.stage
        if np.dtype(f.dtype).kind != "f":
            bad = ~came & ~_all_per_row(values == 0)
            what = f"{f.name} must be 0 before the stage {f.stage.name.lower()}"
        elif f.per_finger:
            touching = came[:, None] & batch[f"{f.name.split('_')[0]}_touching"]
            bad = ~_all_per_row(_as_due(values, touching[:, :, None]))
            what = f"{f.name} must be finite where the finger touches and NaN elsewhere"
        else:
            due = came.reshape(-1, *(1,) * (values.ndim - 1))
            bad = ~_all_per_row(_as_due(values, due))
            what = f"{f.name} must be finite from the stage {f.stage.name.lower()} on"
            what += "" if f.stage is Stage.PLACED else " and NaN before"
        yield from batch.broken(what, bad, lambda i: _outcome(batch, i))


def _as_due(values: AnyArray, due: AnyArray) -> AnyArray:
    """Return where values are finite and should be, or NaN and should be."""
    return np.asarray(np.where(due, np.isfinite(values), np.isnan(values)))


def _stages(batch: Batch) -> AnyArray:
    table = np.zeros(max(Outcome) + 1, dtype=int)
    table[[o.value for o in Outcome]] = [o.stage.value for o in Outcome]
    # The table can be touched by the hand at closing, or by the object after the lift.
    lifted = (batch["outcome"] == Outcome.TABLE_CONTACT) & ~batch["closed_hand_on_table"]
    return np.where(lifted, Stage.LIFTED.value, table[batch["outcome"]])


def _outcome(batch: Batch, i: int) -> str:
    return f"the contrary at outcome {Outcome(int(batch['outcome'][i])).label}"


def trial_verdicts(batch: Batch) -> Iterator[Violation]:
    """The outcome is what follows from the contacts that were recorded (`trial.judge_*`)."""
    lifted = batch["lifted_touching"]
    expected = np.select(
        [
            ~batch["closed_touching"].all(axis=1),
            batch["closed_other_links"] > 0,
            batch["closed_hand_on_table"],
            ~lifted.any(axis=1) & (batch["lifted_other_links"] == 0),
            ~lifted.all(axis=1),
            batch["lifted_object_on_table"],
        ],
        [
            Outcome.MISSING_FINGERTIP.value,
            Outcome.HAND_CONTACT.value,
            Outcome.TABLE_CONTACT.value,
            Outcome.DROPPED.value,
            Outcome.SLIPPED.value,
            Outcome.TABLE_CONTACT.value,
        ],
        Outcome.SUCCESS.value,
    )
    judged = _stages(batch) >= Stage.CLOSED
    yield from batch.broken(
        "outcome must follow from the contacts",
        judged & (expected != batch["outcome"]),
        lambda i: (
            f"{Outcome(int(batch['outcome'][i])).label} where the contacts say "
            f"{Outcome(int(expected[i])).label}"
        ),
    )


def trial_contacts(batch: Batch) -> Iterator[Violation]:
    """Fingertips that touch have a patch, a unit normal, and push into the object."""
    for stage in ("closed", "lifted"):
        touching = batch[f"{stage}_touching"]
        normals, forces = batch[f"{stage}_nhat_Q_O"], batch[f"{stage}_f_Q_O"]
        lengths = np.where(touching, np.linalg.norm(normals, axis=2), 1.0)
        yield from _unit_length(batch, lengths, f"{stage}_nhat_Q_O of finger")
        push = (normals * forces).sum(axis=2)
        area, depth = batch[f"{stage}_area"], batch[f"{stage}_penetration"]
        for k in range(touching.shape[1]):
            touches = touching[:, k]
            yield from batch.broken(
                f"{stage}_f_Q_O of finger {k + 1} must push into the object [N]",
                touches & ~(push[:, k] < PULL),
                push[:, k],
            )
            yield from batch.broken(
                f"{stage}_area of finger {k + 1} must be positive where it touches [m^2]",
                touches & ~(area[:, k] > 0.0),
                area[:, k],
            )
            yield from batch.broken(
                f"{stage}_penetration of finger {k + 1} must not be negative [m]",
                depth[:, k] < 0.0,
                depth[:, k],
            )


def trial_poses(batch: Batch) -> Iterator[Violation]:
    """Poses of trials are rotations and positions."""
    for name in ("X_TO", "X_OG", "X_TO_lifted"):
        yield from _rotation(batch, name)


def resting_poses(batch: Batch, X_TO: Sequence[Sequence[float]]) -> Iterator[Violation]:
    """Every attempt starts from its object's resting pose, given by object as (12,)."""
    expected = np.array(X_TO, dtype=float).reshape(-1, 12)[batch["object"].astype(int)]
    off = np.abs(batch["X_TO"] - expected).max(axis=1)
    yield from batch.broken(
        "X_TO must be the object's resting pose in manifest.json",
        off > POSITION_TOLERANCE,
        lambda i: f"a pose that is off by {off[i]:.4g}",
    )


# Helpers


def _all_per_row(values: AnyArray) -> AnyArray:
    """Return for each row (n,) whether all of (n, ...) is true."""
    return np.asarray(values.all(axis=tuple(range(1, values.ndim))))


def _unit_length(batch: Batch, lengths: Array, what: str) -> Iterator[Violation]:
    """Lengths (n, k), by finger, are one."""
    for k in range(lengths.shape[1]):
        yield from batch.broken(
            f"{what} {k + 1} must have length 1 within {UNIT_TOLERANCE:g}",
            np.abs(lengths[:, k] - 1.0) > UNIT_TOLERANCE,
            lengths[:, k],
        )


def _rotation(batch: Batch, name: str) -> Iterator[Violation]:
    """The pose of that name has an orthonormal rotation with determinant +1."""
    R = batch.pose(name)[:, :3, :3]
    # A pose that is due to be NaN is not a pose: `trial_stages` looks after those.
    R = np.where(np.isfinite(R).all(axis=(1, 2), keepdims=True), R, np.eye(3))
    skew = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2))
    determinant = np.linalg.det(R)
    yield from batch.broken(
        f"{name} must have an orthonormal rotation with determinant +1",
        (skew > UNIT_TOLERANCE) | (determinant < 0.0),
        lambda i: f"one that is off by {skew[i]:.3g}, with determinant {determinant[i]:.4g}",
    )
