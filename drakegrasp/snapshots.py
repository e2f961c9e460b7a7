"""Third-person pictures of a trial, hand and all, for the README and the docs.

In: a dataset's directory and the number of a trial. Out: pictures of its moments, drawn
from the poses and joint positions in trials.hdf5; nothing is simulated. Each picture comes
with its camera, so that frames can be drawn into it. The camera is chosen by itself: of a
ring of viewpoints, the one that sees most of the fingertip it sees least of.

As for `render`: a stage must be made and used in one thread.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import numpy.typing as npt
from pydrake.common import MemoryFile
from pydrake.geometry import (
    Box,
    ClippingRange,
    ColorRenderCamera,
    FrameId,
    InMemoryMesh,
    LightParameter,
    MakeRenderEngineVtk,
    Mesh,
    QueryObject,
    RenderCameraCore,
    RenderEngineVtkParams,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import FixedOffsetFrame, ModelInstanceIndex, RigidBody, SpatialInertia
from pydrake.systems.framework import Context, Diagram, DiagramBuilder
from pydrake.systems.sensors import CameraInfo

from drakegrasp.assemble import DATA_FILES, TRIALS_FILE
from drakegrasp.camera import unproject
from drakegrasp.config import Config
from drakegrasp.errors import DataError
from drakegrasp.figures import ARROW, Panel, Picture, Triad, find_sample
from drakegrasp.frames import (
    X_WT,
    Array,
    make_pose,
    rotate_vectors,
    transform_points,
    unpack_pose,
)
from drakegrasp.hand import Hand, load_hand, make_parser
from drakegrasp.manifest import read_manifest
from drakegrasp.meshes import ObjectModel, obj_text
from drakegrasp.outcomes import Outcome, Stage
from drakegrasp.prepared import load_prepared
from drakegrasp.render import object_colour

#: Vertical field of view [deg]: narrow, so that nothing is distorted.
FOV_Y_DEG = 26.0
#: Viewpoints that are tried: around the vertical, and above the horizontal [deg].
AZIMUTHS_DEG, ELEVATIONS_DEG = range(0, 360, 20), (19.0, 28.0)
#: Height of the pictures among which the viewpoint is chosen [px].
TRIAL_SIZE = 120
#: Pictures are drawn this many times larger and averaged: VTK alone leaves jagged edges.
OVERSAMPLING = 2
#: What the hand needs around the origins of its links [m].
MARGIN = 0.035
BACKGROUND = np.array([0.95, 0.96, 0.97])
TABLE_COLOUR = np.array([0.74, 0.70, 0.64, 1.0])
TABLE_SIZE, TABLE_THICKNESS = 1.6, 0.1
#: Edge of the table where the world's origin below it must be seen [m].
SMALL_TABLE = 0.36
#: From where a camera's line of sight is looked at, about the vertical [rad].
SIDE_VIEW = np.deg2rad(62.0)
#: The camera follows the lift by this part of the way, and from this much further off.
FOLLOW, BACK = 0.85, 0.3
#: Edge of the map that the shadows are looked up in [px].
SHADOW_MAP = 4096
_ENGINE = "vtk"


@dataclass(frozen=True, kw_only=True, eq=False)
class Moment:
    """Where everything is at one instant: palm X_WG, object X_WO (4, 4), joints q [rad]."""

    X_WG: Array
    X_WO: Array
    q: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class Theatre:
    """A diagram of the object, the hand and the table that is only looked at."""

    diagram: Diagram
    context: Context
    plant: MultibodyPlant
    object: RigidBody
    hand: Hand
    hand_instance: ModelInstanceIndex
    wrist: FixedOffsetFrame

    @property
    def joint_names(self) -> list[str]:
        """Names of the hand's joints in the order of `Moment.q`."""
        names = self.plant.GetPositionNames(
            self.hand_instance, add_model_instance_prefix=False, always_add_suffix=False
        )
        return list(names)

    def pose(self, link: str) -> Array:
        """Return the pose X_WL (4, 4) of a link of the hand now."""
        body = self.plant.GetBodyByName(link, self.hand_instance)
        context = self.plant.GetMyContextFromRoot(self.context)
        return self.plant.EvalBodyPoseInWorld(context, body).GetAsMatrix4()


@dataclass(frozen=True, kw_only=True, eq=False)
class StagedTrial:
    """The three moments of a trial, and the theatre to show them in.

    Attributes:
        theatre: Of the trial's object and hand.
        place, close, lift: At the start, after closing, after the lift.
        p_OQ, nhat_Q_O: Contacts after closing (k, 3), in {O}.
        model: The object.
        config: Of the dataset.
    """

    theatre: Theatre
    place: Moment
    close: Moment
    lift: Moment
    p_OQ: Array
    nhat_Q_O: Array
    model: ObjectModel
    config: Config


def stage_trial(out: Path, trial_id: int, *, table_size: float = TABLE_SIZE) -> StagedTrial:
    """Return a trial that came as far as the lift, ready to be shown.

    Raises:
        DataError: If the trial is not there, or ended before the lift.
    """
    config = read_manifest(out).config
    path = out / TRIALS_FILE
    try:
        with h5py.File(path, "r") as file:
            trials = file["trials"]
            if not 0 <= trial_id < len(trials["outcome"]):
                raise DataError(
                    f"{path}: trial must be 0 to {len(trials['outcome']) - 1}, got {trial_id}"
                )
            row = {name: np.asarray(values[trial_id]) for name, values in trials.items()}
            name = file["objects/name"][int(row["object"])].decode()
    except (OSError, KeyError) as error:
        raise DataError(f"{path}: must be the trials of a dataset, got none ({error})") from None
    outcome = Outcome(int(row["outcome"]))
    if outcome.stage is not Stage.LIFTED:
        raise DataError(f"{path}: trial {trial_id} must have been lifted, got {outcome.label}")
    X_WO = X_WT @ unpack_pose(row["X_TO"])
    X_WG = X_WO @ unpack_pose(row["X_OG"])
    X_WG_lifted = make_pose(X_WG[:3, :3], X_WT[:3, 3] + config.lift.p_TG)
    X_WO_lifted = X_WT @ unpack_pose(row["X_TO_lifted"])
    hand = load_hand(config.hand)
    model = load_prepared(out, name, config).model
    theatre = build_theatre(model, hand, table_size=table_size)
    open_q = np.array(
        [row["spread"] if joint in hand.spread.joints else 0.0 for joint in theatre.joint_names]
    )
    return StagedTrial(
        theatre=theatre,
        place=Moment(X_WG=X_WG, X_WO=X_WO, q=open_q),
        close=Moment(X_WG=X_WG, X_WO=X_WO, q=row["closed_q"]),
        lift=Moment(X_WG=X_WG_lifted, X_WO=X_WO_lifted, q=row["lifted_q"]),
        p_OQ=row["closed_p_OQ"],
        nhat_Q_O=row["closed_nhat_Q_O"],
        model=model,
        config=config,
    )


def build_theatre(model: ObjectModel, hand: Hand, *, table_size: float = TABLE_SIZE) -> Theatre:
    """Return a diagram of an object, a hand and a square table of an edge [m]."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlant(MultibodyPlantConfig(time_step=0.0), builder)
    scene_graph.AddRenderer(_ENGINE, MakeRenderEngineVtk(_parameters()))
    body = plant.AddRigidBody("object", SpatialInertia.SolidSphereWithMass(1.0, 1.0))
    text = obj_text(model.visual_vertices, model.visual_faces, normals=True)
    mesh = Mesh(InMemoryMesh(mesh_file=MemoryFile(text, ".obj", model.name)))
    colour = np.array([*object_colour(model.name), 1.0])
    plant.RegisterVisualGeometry(body, RigidTransform(), mesh, "surface", colour)
    X_WB = RigidTransform(X_WT @ make_pose(np.eye(3), [0.0, 0.0, -TABLE_THICKNESS / 2.0]))
    slab = Box(table_size, table_size, TABLE_THICKNESS)
    plant.RegisterVisualGeometry(plant.world_body(), X_WB, slab, "table", TABLE_COLOUR)
    (instance,) = make_parser(plant).AddModels(hand.sdf_path)
    base = plant.GetBodyByName(hand.palm_link, instance)
    palm = plant.AddFrame(
        FixedOffsetFrame("palm", base.body_frame(), RigidTransform(hand.X_BG), instance)
    )
    # Its pose is a parameter of the context: the palm can be put anywhere without a joint.
    wrist = plant.AddFrame(FixedOffsetFrame("wrist", plant.world_frame(), RigidTransform()))
    plant.WeldFrames(wrist, palm)
    plant.Finalize()
    diagram = builder.Build()
    return Theatre(
        diagram=diagram,
        context=diagram.CreateDefaultContext(),
        plant=plant,
        object=body,
        hand=hand,
        hand_instance=instance,
        wrist=wrist,
    )


def show(theatre: Theatre, moment: Moment) -> None:
    """Put hand and object where they are at a moment."""
    plant = theatre.plant
    context = plant.GetMyMutableContextFromRoot(theatre.context)
    plant.SetFreeBodyPose(context, theatre.object, RigidTransform(moment.X_WO))
    theatre.wrist.SetPoseInParentFrame(context, RigidTransform(moment.X_WG))
    plant.SetPositions(context, theatre.hand_instance, moment.q)


def take(theatre: Theatre, X_WC: Array, size: tuple[int, int]) -> Picture:
    """Return what a camera at X_WC (4, 4) sees, `size` = (width, height) [px]."""
    query, camera, world = _camera(theatre, (OVERSAMPLING * size[0], OVERSAMPLING * size[1]))
    large = query.RenderColorImage(camera, world, RigidTransform(X_WC)).data[:, :, :3]
    blocks = large.reshape(size[1], OVERSAMPLING, size[0], OVERSAMPLING, 3)
    image = np.rint(blocks.mean(axis=(1, 3))).astype(np.uint8)
    focal = size[1] / (2.0 * np.tan(np.deg2rad(FOV_Y_DEG) / 2.0))
    K = np.array([[focal, 0.0, (size[0] - 1) / 2], [0.0, focal, (size[1] - 1) / 2], [0, 0, 1.0]])
    return Picture(image=image, K=K, X_WC=X_WC)


def labels(theatre: Theatre, X_WC: Array, size: tuple[int, int]) -> npt.NDArray[np.int16]:
    """Return the body index (height, width) that each pixel shows."""
    query, camera, world = _camera(theatre, size)
    return query.RenderLabelImage(camera, world, RigidTransform(X_WC)).data[:, :, 0].copy()


def choose_view(theatre: Theatre, p_WA: Array, *, fill: float = 1.0) -> Array:
    """Return X_WC of a camera that has points p_WA (n, 3) in view and all fingertips in sight.

    Args:
        theatre: As it is to be seen.
        p_WA: What must be in the picture [m].
        fill: The camera's distance is divided by it.
    """
    tips = [
        int(theatre.plant.GetBodyByName(name, theatre.hand_instance).index())
        for name in theatre.hand.fingertip_links
    ]
    best, most = np.eye(4), (-1, -1)
    for elevation in np.deg2rad(ELEVATIONS_DEG):
        for azimuth in np.deg2rad(AZIMUTHS_DEG):
            X_WC = view(p_WA, azimuth, elevation, fill=fill)
            seen = labels(theatre, X_WC, (TRIAL_SIZE, TRIAL_SIZE))
            counts = [int(np.sum(seen == tip)) for tip in tips]
            score = min(counts), sum(counts) + int(np.sum(seen == int(theatre.object.index())))
            if score > most:
                best, most = X_WC, score
    return best


def view(p_WA: Array, azimuth: float, elevation: float, *, fill: float = 1.0) -> Array:
    """Return X_WC (4, 4) of a camera that looks at the middle of points from two angles [rad]."""
    middle = (p_WA.min(axis=0) + p_WA.max(axis=0)) / 2.0
    radius = np.linalg.norm(p_WA - middle, axis=1).max() + MARGIN
    distance = radius / np.sin(np.deg2rad(FOV_Y_DEG) / 2.0) / fill
    z = -np.array(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return make_pose(np.column_stack([x, np.cross(z, x), z]), middle - distance * z)


def outline(theatre: Theatre, moment: Moment, half_extents: Array) -> Array:
    """Return points (n, 3) that span what is shown: links of the hand, corners of the box."""
    show(theatre, moment)
    plant = theatre.plant
    links = [plant.get_body(i).name() for i in plant.GetBodyIndices(theatre.hand_instance)]
    corners = half_extents * np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T
    return np.vstack(
        [
            transform_points(moment.X_WO, corners),
            *(theatre.pose(link)[None, :3, 3] for link in links),
        ]
    )


def trial_snapshots(
    out: Path, trial_id: int, *, size: tuple[int, int] = (480, 480)
) -> list[Picture]:
    """Return pictures of a trial as it is placed, closed and lifted, from one side.

    Raises:
        DataError: If the trial is not there, or ended before the lift.
    """
    trial = stage_trial(out, trial_id)
    theatre, half = trial.theatre, trial.model.half_extents
    around = np.vstack([outline(theatre, m, half) for m in (trial.place, trial.close)])
    X_WC = choose_view(theatre, around)
    pictures = []
    for moment in (trial.place, trial.close):
        show(theatre, moment)
        pictures.append(take(theatre, X_WC, size))
    # So the table stays in view, and one sees that there is air below the object.
    rise = trial.lift.X_WG[:3, 3] - trial.close.X_WG[:3, 3]
    distance = float(np.linalg.norm(X_WC[:3, 3] - trial.close.X_WO[:3, 3]))
    back = make_pose(np.eye(3), [0.0, 0.0, -BACK * distance])
    show(theatre, trial.lift)
    pictures.append(take(theatre, make_pose(np.eye(3), FOLLOW * rise) @ X_WC @ back, size))
    return pictures


def frames_panels(out: Path, trial_id: int) -> list[Panel]:
    """Return the panels of the figure of all frames: from afar, from near, through the camera.

    Raises:
        DataError: If the trial is no sample.
    """
    sample, K = find_sample(out / DATA_FILES["otm"], trial_id)
    X_WC = X_WT @ unpack_pose(sample.props["frame_work2cam_otm"])
    X_WI = X_WC @ unpack_pose(sample.props["frame_cam2img_otm"])
    trial = stage_trial(out, trial_id)
    X_WO, X_WG = trial.close.X_WO, trial.close.X_WG
    p_WQ = transform_points(X_WO, trial.p_OQ)
    normals = rotate_vectors(X_WO, trial.nhat_Q_O)
    tips = zip(p_WQ, p_WQ + ARROW * normals, strict=True)
    contacts = {f"Q{i + 1}": ends for i, ends in enumerate(tips)}
    half = trial.model.half_extents

    small = build_theatre(trial.model, trial.theatre.hand, table_size=SMALL_TABLE)
    around = np.vstack([np.zeros((1, 3)), outline(small, trial.close, half), X_WC[None, :3, 3]])
    # Almost from the side of the camera's line of sight, so that its length is seen.
    azimuth = float(np.arctan2(X_WC[1, 2], X_WC[0, 2])) + SIDE_VIEW
    lines = [np.vstack([np.zeros(3), X_WT[:3, 3]]), np.vstack([X_WG[:3, 3], X_WC[:3, 3]])]
    afar = Panel(
        title="world, table, palm, camera",
        picture=take(small, view(around, azimuth, np.deg2rad(12.0)), (520, 900)),
        triads=[
            Triad(label="W", X_WA=np.eye(4), length=0.15),
            Triad(label="T", X_WA=X_WT, length=0.1),
            Triad(label="C", X_WA=X_WC, length=0.09),
            Triad(label="G", X_WA=X_WG, length=0.09),
        ],
        lines=[*lines, *_frustum(X_WC, K, sample.mask.shape[0], depth=0.12)],
    )
    body = outline(trial.theatre, trial.close, half)
    near = Panel(
        title="object, hand, contacts",
        picture=take(trial.theatre, choose_view(trial.theatre, body), (900, 900)),
        triads=[
            Triad(label="O", X_WA=X_WO, length=0.04),
            Triad(label="T", X_WA=X_WT, length=0.04),
            Triad(label="G", X_WA=X_WG, length=0.04),
            *(
                Triad(label=f"F{i + 1}", X_WA=trial.theatre.pose(link), length=0.022)
                for i, link in enumerate(trial.theatre.hand.fingertip_links)
            ),
        ],
        points={"Ocm": transform_points(X_WO, trial.model.p_OOcm[None])[0]},
        arrows=contacts,
    )
    rgb = np.rint(255.0 * np.moveaxis(sample.image[:3], 0, 2)).astype(np.uint8)
    seen = Panel(
        title="image (otm): pixels, image frame",
        picture=Picture(image=rgb, K=K, X_WC=X_WC),
        triads=[Triad(label="I", X_WA=X_WI, length=0.04)],
        arrows=contacts,
    )
    return [afar, near, seen]


def _frustum(X_WC: Array, K: Array, size: int, depth: float) -> list[Array]:
    """Return polylines (n, 3) of what a camera sees, up to a depth [m]."""
    edge = size - 0.5
    pixels = np.array([[-0.5, -0.5], [edge, -0.5], [edge, edge], [-0.5, edge]])
    corners = transform_points(X_WC, unproject(K, pixels, np.full(4, depth)))
    rays = [np.vstack([X_WC[:3, 3], corner]) for corner in corners]
    return [np.vstack([corners, corners[:1]]), *rays]


def _parameters() -> RenderEngineVtkParams:
    # Camera axes: +X right, +Y down. Point lights cast no shadow in VTK; the spot does.
    lights = [
        LightParameter(type="point", frame="camera", position=[0.3, -0.3, -0.5], intensity=0.5),
        LightParameter(type="point", frame="world", position=[0.0, 0.0, 4.0], intensity=0.25),
        LightParameter(
            type="spot",
            frame="camera",
            position=[-1.0, -1.3, 0.2],
            direction=[1.0, 1.3, 1.0],
            intensity=0.7,
            cone_angle=26.0,
        ),
    ]
    return RenderEngineVtkParams(
        default_clear_color=BACKGROUND, lights=lights, cast_shadows=True, shadow_map_size=SHADOW_MAP
    )


def _camera(
    theatre: Theatre, size: tuple[int, int]
) -> tuple[QueryObject, ColorRenderCamera, FrameId]:
    plant = theatre.plant
    core = RenderCameraCore(
        _ENGINE,
        CameraInfo(*size, np.deg2rad(FOV_Y_DEG)),
        ClippingRange(0.05, 20.0),
        RigidTransform(),
    )
    query = plant.get_geometry_query_input_port().Eval(plant.GetMyContextFromRoot(theatre.context))
    world = plant.GetBodyFrameIdOrThrow(plant.world_body().index())
    return query, ColorRenderCamera(core, False), world
