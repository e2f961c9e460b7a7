"""Posed scenes: one GLB file per grasp, with the object and the hand's shapes after closing.

Input: a dataset. Output: `<object>/<trial_id>.glb`, which any viewer opens without a simulator. In
glTF +Y points up, so our table frame {T} is rotated by -90 degrees about X. Each link is drawn as
its collision shapes, which are convex. Nodes are named `object/NAME` and `hand/LINK`, because an
object may have the same name as a link.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh

from drakegrasp.arithmetic import multiply
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.exchange.export import ClosedGrasp, samples_by_object
from drakegrasp.frames import Array, make_pose
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.shapes import hull_triangles, link_shapes
from drakegrasp.objects.model import ObjectModel
from drakegrasp.pictures.still_scene import StillScene
from drakegrasp.runtime.progress import Report
from drakegrasp.vision.camera import object_colour

#: Description of the format in `drakegrasp export --help`.
HELP = "a 3D scene per grasp: the object in the closed hand"

#: Pose of {T} in the frame {U} of the file, in which +Y points up.
X_UT = make_pose(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]), np.zeros(3))
#: RGBA colours of fingertips and of other links.
TIP_COLOUR, LINK_COLOUR = (0.93, 0.55, 0.20, 1.0), (0.45, 0.48, 0.52, 1.0)


def write_glb(out: Path, folder: Path, progress: Report) -> int:
    """Write one scene per sample and return the number of scenes; see `export.export_dataset`."""
    hand = load_hand(read_manifest(out).config.hand_source)
    posed, links = StillScene(hand), link_meshes(hand)
    count = 0
    for model, samples in samples_by_object(out, progress):
        (folder / model.name).mkdir()
        for grasp in samples:
            scene = posed_scene(model, posed, links, grasp).export(file_type="glb")
            (folder / model.name / f"{grasp.trial_id}.glb").write_bytes(scene)
        count += len(samples)
    return count


def posed_scene(
    model: ObjectModel, posed: StillScene, links: dict[str, trimesh.Trimesh], grasp: ClosedGrasp
) -> trimesh.Scene:
    """Return the scene of object and hand after the fingers have closed.

    Args:
        model: The object.
        posed: The hand.
        links: Meshes of the links by link name, each in the frame of its link.
        grasp: The sample.
    """
    scene = trimesh.Scene(base_frame="scene")
    body = model.visual.copy()
    body.visual = _paint(body, (*object_colour(model.name), 1.0))
    _add(scene, f"object/{model.name}", body, grasp.X_TO)
    posed.pose(grasp.X_TG, grasp.q)
    for link, mesh in links.items():
        _add(scene, f"hand/{link}", mesh, posed.link_pose(link))
    return scene


def _add(scene: trimesh.Scene, name: str, mesh: trimesh.Trimesh, X_TB: Array) -> None:
    scene.add_geometry(mesh, node_name=name, geom_name=name, transform=multiply(X_UT, X_TB))


def link_meshes(hand: Hand) -> dict[str, trimesh.Trimesh]:
    """Return one mesh for each link that has shapes, in the frame of the link."""
    meshes = {}
    for link, shapes in link_shapes(hand.model).items():
        parts = [trimesh.Trimesh(**_indexed(hull_triangles(corners))) for corners in shapes]
        if parts:
            mesh = trimesh.util.concatenate(parts)
            mesh.fix_normals()
            tip = link in hand.fingertip_links
            mesh.visual = _paint(mesh, TIP_COLOUR if tip else LINK_COLOUR)
            meshes[link] = mesh
    return meshes


def _indexed(triangles: Array) -> dict[str, Array]:
    return trimesh.triangles.to_kwargs(triangles)


def _paint(mesh: trimesh.Trimesh, rgba: tuple[float, float, float, float]) -> object:
    material = trimesh.visual.material.PBRMaterial(
        baseColorFactor=[round(255 * value) for value in rgba],
        metallicFactor=0.0,
        roughnessFactor=0.8,
        doubleSided=True,
    )
    return trimesh.visual.TextureVisuals(material=material)
