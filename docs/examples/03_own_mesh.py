"""Grasp a mesh of your own.

Describe a mesh file, place the object on the table, and try a grasp that you chose yourself.

Concepts: mesh, unit, `objects.yaml`, resting pose, object frame, verification.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import trimesh

import drakegrasp as dg

MESHES = Path("example/meshes")
DESCRIPTION = """
units: cm
objects:
  1_vase:           # the file's name: class `vase`
    mass: 0.3       # [kg]
    licence: CC0-1.0
"""


def main() -> None:
    """Write a mesh and its description, place the object, and verify one grasp of it."""
    # A solid vase, as a profile (radius, height) [cm] turned about z.
    MESHES.mkdir(parents=True, exist_ok=True)
    profile = [(0, 0), (3.2, 0), (3.6, 5), (2.6, 10), (2.2, 14), (2.8, 16), (0, 16)]
    trimesh.creation.revolve(np.array(profile)).export(MESHES / "1_vase.stl")
    (MESHES / "objects.yaml").write_text(DESCRIPTION)

    # Prepared, dropped and at rest. `drakegrasp audit example/meshes` says what it measures.
    vase = dg.place_object(MESHES / "1_vase.stl")
    print(vase)

    # Three contacts around the neck in {O}, whose origin is the centre of the bounding box.
    angles = np.deg2rad([60.0, -60.0, 180.0])
    nhat_Q_O = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(3)])
    p_OQ = 0.026 * nhat_Q_O + [0.0, 0.0, 0.02]  # [m]
    verdict = dg.verify_grasp(dg.pack_grasp(p_OQ, nhat_Q_O), on=vase)

    print(verdict.explain())
    verdict.save_html("example/03_own_mesh.html")  # open it in a browser

    # The neck from above, with the contacts that were asked for and those that the hand made.
    reached = verdict.trial.closed.contacts.p_OQ
    figure, axes = plt.subplots(figsize=(4.5, 4.0), layout="tight")
    axes.plot(*(1e3 * vase.model.visual_vertices[:, :2]).T, ".", color="lightgrey", markersize=2)
    axes.plot(*(1e3 * p_OQ[:, :2]).T, "o", label="requested")
    axes.plot(*(1e3 * reached[:, :2]).T, "x", label="reached")
    axes.set(xlabel="x [mm]", ylabel="y [mm]", aspect="equal")
    axes.legend()
    figure.savefig("example/03_own_mesh.png")


if __name__ == "__main__":
    main()
