"""Use a cluster.

Start two Dask workers, let them build a dataset, and let them verify grasps.

Concepts: scheduler, worker, client, work unit.
"""

import matplotlib.pyplot as plt
from distributed import Client, LocalCluster

import drakegrasp as dg

DATASET = "example/dataset/grasping_oto.hdf5"


def main() -> None:
    """Build the mesh of 03_own_mesh.py and verify grasps of 01_dataset.py on two workers."""
    # Any Dask cluster does, of dask-jobqueue for example. A worker must have one thread.
    with LocalCluster(n_workers=2, threads_per_worker=1) as cluster, Client(cluster) as client:
        overrides = ["candidates.max=8", "unit_candidates=4"]
        config = dg.load_config("fast", overrides=overrides)
        report = dg.build_dataset("example/meshes", "example/vase", config=config, client=client)
        print(report.simulated, "work units simulated on", cluster.scheduler_address)

        # The dataset's own grasps stand for predictions.
        data = dg.GraspDataset(DATASET, split="test")
        verdicts = dg.verify_grasps(data.column("grasps"), on=data, client=client)

    # The epsilon of Ferrari and Canny: the smallest wrench that the contacts cannot resist.
    figure, axes = plt.subplots(figsize=(5.0, 2.6))
    colours = ["tab:green" if verdict.lifted else "tab:red" for verdict in verdicts]
    axes.bar(range(len(verdicts)), [verdict.epsilon for verdict in verdicts], color=colours)
    axes.set(xlabel="verified grasp (green: lifted)", ylabel="epsilon of the contacts")
    axes.set_xticks(range(len(verdicts)))
    figure.tight_layout()
    figure.savefig("example/05_cluster.png")


if __name__ == "__main__":
    main()
