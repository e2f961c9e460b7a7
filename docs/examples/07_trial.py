"""Try one wrist pose with joints.

Close the hand by a posture, lift the object, and see how far the wrist may be off.

Concepts: posture, pregrasp, coupled joints, trial, outcome.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import trimesh

import drakegrasp as dg


def main() -> None:
    """Try a grasp of a box from above, then the same with the wrist moved aside."""
    hand = dg.load_hand("barrett")
    box = dg.place_object(trimesh.creation.box([0.07, 0.07, 0.07]))

    # The palm is 60 mm above the box and looks down: +Gz of the palm is -z of the object.
    X_OG = np.diag([1.0, -1.0, -1.0, 1.0])
    X_OG[2, 3] = 0.035 + 0.06
    # Joints by name [rad]: what the hand file couples to another joint may be left out of files,
    # but a posture has them all. Without a pregrasp the fingers begin 20 degrees further open.
    closing, spread = 1.25, 0.0
    angles = {"proximal": closing, "distal": closing / 3.0, "spread": spread}
    q_grasp = [angles[name.split("_")[1]] for name in hand.joint_names]
    posture = dg.make_posture(hand, X_OG, q_grasp, joints=hand.joint_names)
    trial = dg.run_trial(box, posture)
    print(trial.outcome.label, trial.stable, f"slip {1e3 * trial.lift.slip:.2f} mm")

    # The same posture with the wrist moved along y of the object.
    offsets, slips = np.linspace(-0.06, 0.06, 9), []
    for offset in offsets:
        moved = posture.X_OG.copy()
        moved[1, 3] += offset
        trial = dg.run_trial(box, dg.Posture(moved, posture.q_grasp))
        lifted = trial.outcome is dg.Outcome.SUCCESS
        slips.append(1e3 * trial.lift.slip if lifted and trial.lift is not None else np.nan)
        print(f"{1e3 * offset:+4.0f} mm: {trial.outcome.label}")

    plt.figure(figsize=(5.0, 3.0))
    plt.plot(1e3 * offsets, slips, "o-")
    lost = np.isnan(slips)
    plt.plot(1e3 * offsets[lost], np.zeros(lost.sum()), "x", color="tab:red", label="not lifted")
    plt.xlabel("wrist off by [mm]")
    plt.ylabel("slip of the object in the hand [mm]")
    plt.legend() if lost.any() else None
    plt.tight_layout()
    Path("example").mkdir(exist_ok=True)
    plt.savefig("example/07_trial.png")


if __name__ == "__main__":
    main()
