"""A still scene: a hand, posed and drawn.

Input: a hand, the pose of its palm, and the positions of its joints. Output: poses of the links,
and pictures. Nothing is simulated.

For the 3D view of a browser, links and objects are JSON: a list of parts, each with its `colour`
"#rrggbb", `vertices` (n, 3) as float32 [m] and `faces` (m, 3) as uint32, both little-endian in
base64. A link is in its own frame, an object in {O}, an arm in {T}; a part of an arm states its
`opacity`.

OpenGL starts with the first picture. As in `vision.rendering`, all pictures of a process must be
rendered in one thread.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import trimesh
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from pydrake.geometry import (
    Box,
    Capsule,
    ClippingRange,
    ColorRenderCamera,
    Convex,
    Cylinder,
    GeometryId,
    LightParameter,
    MakeRenderEngineVtk,
    Mesh,
    RenderCameraCore,
    RenderEngineVtkParams,
    Role,
    SceneGraphInspector,
    Sphere,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import FixedOffsetFrame, ModelInstanceIndex, RigidBody
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import CameraInfo

from drakegrasp.errors import MachineError, MeshError
from drakegrasp.frames import Array, invert_pose, make_pose, transform_points
from drakegrasp.hand.description import Hand
from drakegrasp.hand.finger_sweep import link_points
from drakegrasp.hand.kinematics import closed_positions, joint_positions
from drakegrasp.hand.parsing import add_model
from drakegrasp.hand.shapes import hull_corners, pad_surfaces
from drakegrasp.mesh.loading import load_surface
from drakegrasp.objects.model import ObjectModel
from drakegrasp.pictures.style import (
    FINGER_COLOURS,
    INK,
    SEEN_THROUGH,
    STILL,
    add_axes,
    hide_ticks,
    save_figure,
)
from drakegrasp.runtime.environment import prepare_rendering
from drakegrasp.vision.camera import object_colour
from drakegrasp.vision.rendering import BLANK, GREY, drawn_mesh

#: Vertical field of view [deg]: narrow, so that perspective distorts little.
FOV_Y_DEG = 26.0
#: Pictures are rendered larger by this factor and averaged, since VTK alone leaves jagged edges.
OVERSAMPLING = 2
#: Margin around the origins of the hand's links for the links' own size [m].
MARGIN = 0.035
BACKGROUND = np.array([0.95, 0.96, 0.97])
#: Lights: one at the camera and one from above, as in the images of a dataset. In camera axes +X is
#: right and +Y down.
LIGHTS = tuple(
    LightParameter(type="directional", frame=frame, direction=direction, intensity=intensity)
    for frame, direction, intensity in (
        ("camera", [0.0, 0.0, 1.0], 0.6),
        ("world", [0.3, 0.4, -1.0], 0.7),
    )
)
#: Name of Drake's render engine with these lights.
ENGINE = "still"
#: Fraction by which the hand has closed in each panel, and the title of the panel.
PANELS = ((0.0, "open"), (0.5, "half closed"), (1.0, "closed"))
#: Distance at which pads are drawn in front of the fingertip [m].
PAD_LIFT = 4e-4
#: Length and radius of the axes of the palm frame [m], and their colours.
AXIS, AXIS_RADIUS = 0.05, 0.0012
#: Length of the axes of other tools' frames [m], and the fraction of white in their colours.
FOREIGN_AXIS, PALE = 0.12, 0.5
AXIS_COLOURS = {"Gx": "#CC3333", "Gy": "#339933", "Gz": "#3355CC"}
#: Edge of a panel of a hand [px], and its size in the figure [inch].
HAND_PIXELS, INCHES = 480, 2.4
#: Width of the marker and the gap of a label in the legend [letters].
SPACE = 5
#: Direction of the camera: beside the line along which fingers close, and above [rad].
AZIMUTH, ELEVATION = np.deg2rad(25.0), np.deg2rad(20.0)


class StillScene:
    """A hand in Drake. Not thread-safe.

    Args:
        hand: The hand.
        add: Function that adds more shapes to the plant, before it is finalized, and to the hand's
            model instance in it.

    Attributes:
        hand: The hand.
        joints: Names of the hand's joints, in the order of the dataset's files.
        links: Names of the hand's links.
    """

    def __init__(
        self,
        hand: Hand,
        *,
        add: Callable[[MultibodyPlant, ModelInstanceIndex], None] | None = None,
    ) -> None:
        # The hand, whose palm can be placed anywhere.
        builder = DiagramBuilder()
        plant, graph = AddMultibodyPlant(MultibodyPlantConfig(time_step=0.0), builder)
        instance, self._wrist = _add_posed_hand(plant, hand)
        if add is not None:
            add(plant, instance)
        plant.Finalize()

        # The diagram and its only context.
        self._diagram = builder.Build()
        self._root = self._diagram.CreateDefaultContext()
        self._plant, self._graph, self._instance = plant, graph, instance
        self._context = plant.GetMyMutableContextFromRoot(self._root)
        self.hand = hand
        self.joints: tuple[str, ...] = tuple(plant.GetPositionNames(instance, False, False))
        self.links = tuple(plant.get_body(i).name() for i in plant.GetBodyIndices(instance))

    def positions(self, spread: float, closing: npt.ArrayLike | None = None) -> Array:
        """Return the positions (j,) of the hand's joints [rad or m] for `pose`.

        Args:
            spread: Angle of the spread joints [rad].
            closing: (k,), positions of the closing joints [rad or m]; the open hand if None.
        """
        closing = np.zeros(self.hand.num_fingers) if closing is None else closing
        named = joint_positions(self.hand, spread, closing)
        return np.array([named[name] for name in self.joints])

    def pose(self, X_WG: Array, q: npt.ArrayLike) -> None:
        """Move the hand.

        Args:
            X_WG: (4, 4), pose of the palm.
            q: (j,), positions of the hand's joints [rad or m], in the order of the dataset's files.
        """
        self._wrist.SetPoseInParentFrame(self._context, RigidTransform(X_WG))
        self._plant.SetPositions(self._context, self._instance, np.asarray(q, dtype=float))

    def link_pose(self, link: str) -> Array:
        """Return the pose X_WL (4, 4) of a link of the hand."""
        return self._plant.EvalBodyPoseInWorld(self._context, self._body(link)).GetAsMatrix4()

    def shapes(self, link: str) -> tuple[SceneGraphInspector, list[GeometryId]]:
        """Return the shapes that show a link: its visual shapes, or else its collision shapes.

        They are returned with the inspector that describes them. A link may have no shape.
        """
        body = self._body(link)
        shapes = self._plant.GetVisualGeometriesForBody(body)
        shapes = shapes or self._plant.GetCollisionGeometriesForBody(body)
        return self._graph.model_inspector(), list(shapes)

    def picture(self, X_WC: Array, edge: int) -> npt.NDArray[np.uint8]:
        """Return the square picture (edge, edge, 3) of a camera.

        Args:
            X_WC: (4, 4), pose of the camera.
            edge: Width and height of the picture [px].

        Raises:
            MachineError: If the picture is blank, which means that OpenGL failed.
        """
        # Render larger, then average blocks of pixels.
        query = self._plant.get_geometry_query_input_port().Eval(self._context)
        world = self._plant.GetBodyFrameIdOrThrow(self._plant.world_body().index())
        camera = self._camera(OVERSAMPLING * edge)
        large = query.RenderColorImage(camera, world, RigidTransform(X_WC)).data
        if not large.any():
            raise MachineError(BLANK)
        blocks = large[:, :, :3].reshape(edge, OVERSAMPLING, edge, OVERSAMPLING, 3)
        return np.rint(blocks.mean(axis=(1, 3))).astype(np.uint8)

    def _body(self, link: str) -> RigidBody:
        return self._plant.GetBodyByName(link, self._instance)

    def _camera(self, edge: int) -> ColorRenderCamera:
        """Return a camera of a size [px], whose render engine is added when first needed.

        So a scene that is not drawn does not start OpenGL.
        """
        context = self._graph.GetMyMutableContextFromRoot(self._root)
        if not self._graph.HasRenderer(context, ENGINE):
            prepare_rendering()
            parameters = RenderEngineVtkParams(
                default_clear_color=BACKGROUND, default_diffuse=GREY, lights=list(LIGHTS)
            )
            self._graph.AddRenderer(context, ENGINE, MakeRenderEngineVtk(parameters))
        info = CameraInfo(edge, edge, np.deg2rad(FOV_Y_DEG))
        core = RenderCameraCore(ENGINE, info, ClippingRange(0.05, 20.0), RigidTransform())
        return ColorRenderCamera(core, False)


def _add_posed_hand(
    plant: MultibodyPlant, hand: Hand
) -> tuple[ModelInstanceIndex, FixedOffsetFrame]:
    """Add a hand whose palm can be placed anywhere without a joint.

    The palm is welded to a frame whose pose is a parameter of the context.

    Args:
        plant: Not finalized; its shapes are drawn.
        hand: The hand. Its model may contain links of any name: our names must differ from them.

    Returns:
        The plant's model of the hand, and that frame in the world.
    """
    instance = add_model(plant, hand.model)
    base = plant.GetBodyByName(hand.palm_link, instance)
    X_BG = RigidTransform(hand.X_BG)
    palm = plant.AddFrame(FixedOffsetFrame("drakegrasp_palm", base.body_frame(), X_BG, instance))
    wrist = plant.AddFrame(FixedOffsetFrame("wrist", plant.world_frame(), RigidTransform()))
    plant.WeldFrames(wrist, palm)
    return instance, wrist


def camera_pose(p_WA: Array, azimuth: float, elevation: float, *, fill: float = 1.0) -> Array:
    """Return the pose X_WC (4, 4) of a camera that looks at the centre of points.

    Args:
        p_WA: (n, 3), points that must be in the picture [m].
        azimuth: Direction of the camera about the vertical, from +x of {W} [rad].
        elevation: Angle of the camera above the horizontal [rad].
        fill: Factor by which the camera's distance is divided; above 1 the points fill more of the
            picture.
    """
    # The distance is large enough for a sphere around the points to fit into the field of view.
    middle = (p_WA.min(axis=0) + p_WA.max(axis=0)) / 2.0
    radius = np.linalg.norm(p_WA - middle, axis=1).max() + MARGIN
    distance = radius / np.sin(np.deg2rad(FOV_Y_DEG) / 2.0) / fill

    # The camera's axes: +Z towards the points, +X horizontal to the right, +Y down.
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


def object_json(model: ObjectModel) -> bytes:
    """Return the visual mesh of an object, as JSON."""
    colour = object_colour(model.name)
    return json.dumps([_part(model.visual_vertices, model.visual_faces, colour)]).encode()


def arm_json(drawn: Mapping[str, Array]) -> bytes:
    """Return triangles (t, 3, 3) [m] as JSON; the first are solid, the others are seen through."""
    parts = list[dict[str, Any]]()
    for triangles in drawn.values():
        faces = np.arange(3 * len(triangles)).reshape(-1, 3)
        opacity = SEEN_THROUGH if parts else 1.0
        parts.append({**_part(triangles.reshape(-1, 3), faces, STILL), "opacity": opacity})
    return json.dumps(parts).encode()


def link_surfaces(scene: StillScene) -> dict[str, bytes]:
    """Return the surface of each link of a hand that has a shape as JSON, by the link's name.

    A link without visual shapes is shown by its collision shapes.
    """
    surfaces = {}
    for link in scene.links:
        inspector, shapes = scene.shapes(link)
        parts = []
        for shape in shapes:
            mesh = _mesh(inspector, shape)
            if mesh is not None:
                mesh.apply_transform(inspector.GetPoseInFrame(shape).GetAsMatrix4())
                parts.append(_part(mesh.vertices, mesh.faces, _colour(inspector, shape)))
        if shapes:
            surfaces[link] = json.dumps(parts).encode()
    return surfaces


def _part(vertices: npt.ArrayLike, faces: npt.ArrayLike, colour: npt.ArrayLike) -> dict[str, str]:
    """Return a part with one colour (3,): red, green and blue in 0..1."""
    levels = np.rint(255.0 * np.asarray(colour)).astype(np.uint8)
    return {
        "colour": f"#{levels.tobytes().hex()}",
        "vertices": base64.b64encode(np.asarray(vertices, dtype="<f4").tobytes()).decode(),
        "faces": base64.b64encode(np.asarray(faces, dtype="<u4").tobytes()).decode(),
    }


def _colour(inspector: SceneGraphInspector, geometry: GeometryId) -> Array:
    """Return the colour (3,) of a shape in the model, or grey if it has none."""
    properties = inspector.GetProperties(geometry, Role.kIllustration)
    if properties is None or not properties.HasProperty("phong", "diffuse"):
        return GREY[:3]
    rgba = properties.GetProperty("phong", "diffuse")
    return np.array([rgba.r(), rgba.g(), rgba.b()])


def _mesh(inspector: SceneGraphInspector, geometry: GeometryId) -> Any:
    """Return a shape as a mesh in its own frame; None if it cannot be drawn."""
    # All of Drake's shapes are centred, with their axis along z.
    shape = inspector.GetShape(geometry)
    if isinstance(shape, Box):
        return trimesh.creation.box(shape.size())
    if isinstance(shape, Cylinder):
        return trimesh.creation.cylinder(shape.radius(), shape.length(), sections=32)
    if isinstance(shape, Capsule):
        mesh = trimesh.creation.capsule(shape.length(), shape.radius(), count=(16, 24))
        return mesh.apply_translation(-mesh.bounds.mean(axis=0))
    if isinstance(shape, Sphere):
        return trimesh.creation.icosphere(3, shape.radius())
    if isinstance(shape, Mesh | Convex):
        return _file_mesh(inspector, geometry, shape)
    return None


def _file_mesh(inspector: SceneGraphInspector, geometry: GeometryId, shape: Mesh | Convex) -> Any:
    """Return the mesh of a file; its convex hull if the file cannot be read."""
    source = shape.source()
    path = Path(str(source.path())) if source.is_path() else None
    if path is not None and path.is_file():
        try:
            mesh = trimesh.Trimesh(*load_surface(path), process=False)
            return mesh.apply_scale(shape.scale3())
        except MeshError:
            pass
    return trimesh.convex.convex_hull(hull_corners(inspector, geometry))


# The picture of a hand.


def picture_hand(hand: Hand, png: Path, *, across: float) -> None:
    """Write a picture of a hand.

    Args:
        hand: The hand.
        png: Path of the file.
        across: Direction about Gz, from Gx, from which the fingers' opposition is seen best [rad].

    Raises:
        MachineError: If OpenGL failed.
        OSError: If the file cannot be written.
    """
    # The palm frame is the world frame; all panels share one camera.
    scene = StillScene(hand, add=lambda plant, instance: _add_marks(plant, instance, hand))
    postures = [scene.positions(0.0, share * closed_positions(hand)) for share, _ in PANELS]
    outline = np.concatenate([_hand_surface(scene, q) for q in postures])
    X_WC = camera_pose(outline, across + AZIMUTH, ELEVATION, fill=1.15)

    # Three panels side by side, over a legend.
    width, height = 3 * INCHES + 0.4, INCHES + 0.75
    figure = Figure(figsize=(width, height))
    for i, ((_, title), q) in enumerate(zip(PANELS, postures, strict=True)):
        axes = add_axes(figure, 0.1 + i * (INCHES + 0.1), 0.3, INCHES, INCHES)
        scene.pose(np.eye(4), q)
        picture = scene.picture(X_WC, HAND_PIXELS)
        axes.imshow(picture, interpolation="antialiased")
        axes.set_title(title, fontsize=9, color=INK, pad=4.0)
        hide_ticks(axes)
    entries = [
        (f"pad of {finger.name}", _finger_colour(i)) for i, finger in enumerate(hand.fingers)
    ]
    entries += list(AXIS_COLOURS.items())
    entries += [(f"{tool}: paler axes", INK) for tool in hand.frames]
    letters = [len(label) + SPACE for label, _ in entries]
    for i, (label, colour) in enumerate(entries):
        left = 0.1 + sum(letters[:i]) * (width - 0.2) / sum(letters)
        text = f"\N{BLACK SQUARE} {label}"
        figure.text(left / width, 0.16 / height, text, color=colour, fontsize=8)
    save_figure(figure, png, dpi=200)


def _finger_colour(finger: int) -> str:
    return FINGER_COLOURS[finger % len(FINGER_COLOURS)]


def _add_marks(plant: MultibodyPlant, instance: ModelInstanceIndex, hand: Hand) -> None:
    """Add the pads to the fingertips, and the axes of the palm frame to the world."""
    # The pads, slightly in front of their surfaces.
    for i, (finger, pad) in enumerate(
        zip(hand.fingers, pad_surfaces(hand.model, hand.fingers), strict=True)
    ):
        body = plant.GetBodyByName(finger.fingertip, instance)
        mesh = drawn_mesh(*_lifted(pad), f"pad {i}")
        colour = np.array(to_rgba(_finger_colour(i)))
        plant.RegisterVisualGeometry(body, RigidTransform(), mesh, f"drakegrasp pad {i}", colour)

    # The axes, and longer, paler axes of other tools' frames, whose origins are inside the hand.
    frames = {"": np.eye(4)} | {tool: invert_pose(hand.palm_in(tool)) for tool in hand.frames}
    for tool, X_GA in frames.items():
        length, pale = (FOREIGN_AXIS, PALE) if tool else (AXIS, 0.0)
        for name, direction in zip(AXIS_COLOURS, np.eye(3), strict=True):
            along = RotationMatrix.MakeFromOneVector(direction, 2)
            X_AC = RigidTransform(along, 0.5 * length * direction)
            colour = (1.0 - pale) * np.array(to_rgba(AXIS_COLOURS[name])) + pale
            shape = Cylinder(AXIS_RADIUS, length)
            X_WC = RigidTransform(X_GA) @ X_AC
            plant.RegisterVisualGeometry(plant.world_body(), X_WC, shape, f"{tool} {name}", colour)


def _lifted(pad: Array) -> tuple[Array, Array]:
    """Return vertices and faces of a pad's triangles (t, 3, 3), in front of it and facing out."""
    # The triangles of a hull have no orientation: draw each on both sides; one side is hidden.
    normals = np.cross(pad[:, 1] - pad[:, 0], pad[:, 2] - pad[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    both = np.concatenate([pad + PAD_LIFT * normals[:, None], pad - PAD_LIFT * normals[:, None]])
    faces = np.arange(3 * len(both)).reshape(-1, 3)
    return both.reshape(-1, 3), np.concatenate([faces[: len(pad)], faces[len(pad) :, ::-1]])


def _hand_surface(scene: StillScene, q: Array) -> Array:
    """Move the hand's joints, and return points (n, 3) of the hand's surface in {G} [m]."""
    scene.pose(np.eye(4), q)
    points = link_points(scene.hand)
    return np.concatenate(
        [transform_points(scene.link_pose(link), points[link]) for link in scene.hand.link_chains]
    )
