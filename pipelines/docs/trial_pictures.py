"""Third-person pictures of the hand and object of a trial, for the README and the docs.

Input: a dataset's directory and the number of a trial. Output: pictures of its stages, rendered
from the poses and joint positions in trials.hdf5, and the panels of the figure of all frames.
Nothing is simulated.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from doc_figures import Panel, Triad, find_sample

from drakegrasp.dataset.paths import DATA_FILES
from drakegrasp.frames import X_WT, make_pose, transform_points, unpack_pose
from drakegrasp.pictures.rendered import frustum, load_trial
from drakegrasp.pictures.still_scene import NO_SHADOWS, StillScene, camera_pose
from drakegrasp.vision.camera import Picture

#: Edge length of a table so small that the world's origin below it is visible [m].
SMALL_TABLE = 0.28
#: Azimuth between a camera's line of sight and the view that shows this line from the side [rad].
SIDE_VIEW = np.deg2rad(62.0)
#: For the picture of the lift the camera rises by the fraction FOLLOW of the lift, and moves back
#: by the fraction BACK of its distance.
FOLLOW, BACK = 0.85, 0.3


def render_trial(out: Path, trial_id: int, *, size: tuple[int, int] = (480, 480)) -> list[Picture]:
    """Return three pictures of a trial from the same side: placed, closed, lifted.

    Args:
        out: Directory of the dataset.
        trial_id: Row of trials.hdf5.
        size: Width and height of a picture [px].

    Raises:
        DataError: If the trial does not exist, or ended before the lift.
    """
    # The first two pictures share one view.
    trial = load_trial(out, trial_id)
    scene = trial.scene
    X_WC = scene.choose_view(np.vstack([scene.outline(p) for p in (trial.place, trial.close)]))
    pictures = []
    for poses in (trial.place, trial.close):
        scene.pose(poses)
        pictures.append(scene.picture(X_WC, size))

    # For the lift the camera rises only part of the way, so that the table stays in view and the
    # gap below the object is visible.
    rise = trial.lift.X_WG[:3, 3] - trial.close.X_WG[:3, 3]
    distance = float(np.linalg.norm(X_WC[:3, 3] - trial.close.X_WO[:3, 3]))
    back = make_pose(np.eye(3), [0.0, 0.0, -BACK * distance])
    scene.pose(trial.lift)
    X_WC = make_pose(np.eye(3), FOLLOW * rise) @ X_WC @ back
    pictures.append(scene.picture(X_WC, size, NO_SHADOWS))
    return pictures


def frames_panels(out: Path, trial_id: int) -> list[Panel]:
    """Return the panels of the figure of all frames: overview, close-up, camera image.

    Args:
        out: Directory of the dataset.
        trial_id: Row of trials.hdf5.

    Raises:
        DataError: If the trial is not a sample.
    """
    # The frames in the sample's files, and those of the trial in the world.
    sample, K = find_sample(out / DATA_FILES["otm"], trial_id)
    X_WC = X_WT @ unpack_pose(sample.props["frame_work2cam_otm"])
    X_WI = X_WC @ unpack_pose(sample.props["frame_cam2img_otm"])
    trial = load_trial(out, trial_id)
    scene = trial.scene
    X_WO, X_WG = trial.close.X_WO, trial.close.X_WG
    contacts = trial.normals("closed")

    # The overview, on a small table that does not hide the world's origin below it.
    small = StillScene(scene.hand, trial.model, table_size=SMALL_TABLE)
    around = np.vstack([np.zeros((1, 3)), small.outline(trial.close), X_WC[None, :3, 3]])
    # Look at the camera's line of sight almost from the side, so that its length is visible.
    azimuth = float(np.arctan2(X_WC[1, 2], X_WC[0, 2])) + SIDE_VIEW
    lines = [np.vstack([np.zeros(3), X_WT[:3, 3]]), np.vstack([X_WG[:3, 3], X_WC[:3, 3]])]
    afar = Panel(
        title="world, table, palm, camera",
        picture=small.picture(camera_pose(around, azimuth, np.deg2rad(12.0)), (520, 900)),
        triads=[
            Triad(label="W", X_WA=np.eye(4), length=0.15),
            Triad(label="T", X_WA=X_WT, length=0.1),
            Triad(label="C", X_WA=X_WC, length=0.09),
            Triad(label="G", X_WA=X_WG, length=0.09),
        ],
        lines=[*lines, *frustum(X_WC, K, sample.mask.shape[0], depth=0.12)],
    )

    # The close-up.
    body = scene.outline(trial.close)
    near = Panel(
        title="object, hand, contacts",
        picture=scene.picture(scene.choose_view(body), (900, 900)),
        triads=[
            Triad(label="O", X_WA=X_WO, length=0.04),
            Triad(label="T", X_WA=X_WT, length=0.04),
            Triad(label="G", X_WA=X_WG, length=0.04),
            *(
                Triad(label=f"F{i + 1}", X_WA=scene.link_pose(link), length=0.022)
                for i, link in enumerate(scene.hand.fingertip_links)
            ),
        ],
        points={"Ocm": transform_points(X_WO, trial.model.p_OOcm[None])[0]},
        arrows=contacts,
    )

    # The image of the dataset's camera.
    rgb = np.rint(255.0 * np.moveaxis(sample.image[:3], 0, 2)).astype(np.uint8)
    seen = Panel(
        title="image (otm): pixels, image frame",
        picture=Picture(image=rgb, K=K, X_WC=X_WC),
        triads=[Triad(label="I", X_WA=X_WI, length=0.04)],
        arrows=contacts,
    )
    return [afar, near, seen]
