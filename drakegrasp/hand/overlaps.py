"""Overlaps of a hand's links in a posture."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TypeAlias

from pydrake.geometry import QueryObject
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

from drakegrasp.hand.parsing import ModelFile, add_model, joint_slides, moving_joint

#: Names of two links, and how deep one is in the other [m].
Overlap: TypeAlias = tuple[tuple[str, str], float]


def overlap_query(
    model: ModelFile, palm_link: str
) -> Callable[[Mapping[str, float]], list[Overlap]]:
    """Return a function of the positions of a hand's joints that returns which links overlap.

    Args:
        model: The hand's model.
        palm_link: The link that keeps its place.

    Raises:
        HandError: If the model cannot be read.
    """
    builder = DiagramBuilder()
    plant, graph = AddMultibodyPlantSceneGraph(builder, 0.0)
    instance = add_model(plant, model)
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName(palm_link, instance))
    plant.Finalize()
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    state, scene = plant.GetMyContextFromRoot(context), graph.GetMyContextFromRoot(context)
    found = [plant.get_joint(index) for index in plant.GetJointIndices(instance)]
    joints = [joint for joint in found if moving_joint(joint)]

    def overlaps(positions: Mapping[str, float]) -> list[Overlap]:
        for joint in joints:
            place = joint.set_translation if joint_slides(joint) else joint.set_angle
            place(state, positions[joint.name()])
        query: QueryObject = graph.get_query_output_port().Eval(scene)
        pairs = []
        for pair in query.ComputePointPairPenetration():
            frames = (query.inspector().GetFrameId(shape) for shape in (pair.id_A, pair.id_B))
            one, other = (plant.GetBodyFromFrameId(frame).name() for frame in frames)
            pairs.append(((one, other), pair.depth))
        return pairs

    return overlaps
