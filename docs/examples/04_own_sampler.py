"""Draw palm poses yourself.

Give the build a sampler of your own, let it take turns with one of the package, and compare both.

Concepts: sampler, palm pose, stand-off, stream of random numbers, source of an attempt.
"""

from collections.abc import Iterator

import matplotlib.pyplot as plt
import numpy as np

import drakegrasp as dg
from drakegrasp.frames import make_pose


class Above:
    """Palms straight above the object that look down, turned by a random angle."""

    def __init__(self, model, X_TO, stream, config):
        self.up = X_TO[2, :3]  # the table's normal in the object frame {O}
        self.height = np.linalg.norm(model.half_extents)
        self.stream = stream  # random numbers of the seed and the object: use no others

    def poses(self) -> Iterator[np.ndarray]:
        """Yield poses X_OG (4, 4) of the palm; +Gz points out of it."""
        side = np.cross(self.up, np.eye(3)[np.argmin(np.abs(self.up))])
        side /= np.linalg.norm(side)
        while True:
            angle = 2.0 * np.pi * self.stream.uniform(1)[0]
            x = np.cos(angle) * side + np.sin(angle) * np.cross(self.up, side)
            R_OG = np.column_stack([x, np.cross(-self.up, x), -self.up])
            yield make_pose(R_OG, 2.0 * self.height * self.up)


def main() -> None:
    """Build with both samplers, and count what each of them gave."""
    # A file and the name of a class in it, here this file: workers get its text.
    methods = f"candidates.method=['{__file__}:Above', normals]"
    config = dg.load_config(overrides=["builtin.per_class=1", "candidates.max=24", methods])
    dg.build_dataset("builtin", "example/own", config=config, only=["4_wineglass_1", "24_carton_1"])

    # `source` tells the sampler: 1 is `normals`, 3 one of your own.
    trials = dg.Trials("example/own")
    outcomes = [dg.Outcome(value) for value in np.unique(trials["outcome"])]
    figure, axes = plt.subplots(figsize=(5.6, 3.0), layout="constrained")
    for name, source, shift in (("normals", 1, -0.2), ("Above", 3, 0.2)):
        own = trials["outcome"][trials["source"] == source]
        counts = [np.count_nonzero(own == outcome) for outcome in outcomes]
        print(f"{name}: {np.count_nonzero(own == dg.Outcome.SUCCESS)} of {len(own)} lifted")
        axes.barh(np.arange(len(outcomes)) + shift, counts, height=0.4, label=name)
    axes.set_yticks(range(len(outcomes)), [outcome.label for outcome in outcomes])
    axes.set(xlabel="attempts")
    axes.legend()
    figure.savefig("example/04_own_sampler.png")


if __name__ == "__main__":
    main()
