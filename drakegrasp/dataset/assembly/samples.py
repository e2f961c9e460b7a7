"""The values of samples: what a data file says of a success, seen from one of its cameras."""

from __future__ import annotations

import numpy as np

from drakegrasp.arithmetic import multiply
from drakegrasp.dataset.hdf5 import AnyArray
from drakegrasp.dataset.schema import CAMERAS, DATA_FIELDS
from drakegrasp.frames import X_WT, invert_pose, pack_pose, unpack_pose
from drakegrasp.objects.model import ObjectModel
from drakegrasp.table import Table

#: Image fields of a sample, copied from /looks as they are stored, and their names there.
IMAGES = {"images": "image", "masks": "mask"}


def sample_values(
    model: ObjectModel, trials: Table, looks: Table, camera: str
) -> dict[str, AnyArray]:
    """Return the numbers of n samples of one object, by the names of DATA_FIELDS.

    Args:
        model: The object.
        trials: Rows of the samples' trials, with the columns of /trials.
        looks: Their rows of /looks; images are not needed.
        camera: `oto` or `otm`.
    """
    # Poses of each sample.
    X_TO = unpack_pose(trials["X_TO"])
    X_TC = {c: unpack_pose(looks[f"X_TC_{c}"]) for c in CAMERAS}
    X_CO = multiply(invert_pose(X_TC[camera]), X_TO)
    R_OC, p_CO = np.swapaxes(X_CO[:, :3, :3], 1, 2), X_CO[:, None, :3, 3]

    # Grasp, palm and forces in the frame of the file's camera. The held grasp is expressed with the
    # object in its resting pose: both grasps are transformed with X_CO.
    values: dict[str, AnyArray] = {}
    for suffix, when, X_OG in (("", "closed", "X_OG"), ("_held", "lifted", "X_OG_lifted")):
        p_OQ, nhat_Q_O, f_Q_O = (trials[f"{when}_{n}"] for n in ("p_OQ", "nhat_Q_O", "f_Q_O"))
        vectors = multiply(p_OQ, R_OC) + p_CO, multiply(nhat_Q_O, R_OC)
        values[f"grasps{suffix}"] = np.concatenate(vectors, axis=1).reshape(trials.count, -1)
        values[f"grasp_props/X_CG{suffix}"] = pack_pose(multiply(X_CO, unpack_pose(trials[X_OG])))
        values[f"grasp_props/f_Q_C{suffix}"] = multiply(f_Q_O, R_OC)

    # Frames and mass properties, which do not depend on the camera of the file.
    R_TO = X_TO[:, :3, :3]
    R_OT = np.swapaxes(R_TO, 1, 2)
    I_OOcm_T = multiply(multiply(R_TO, model.I_OOcm_O), R_OT).reshape(-1, 9)
    properties = {
        "work2com": multiply(model.p_OOcm[None], R_OT)[:, 0] + X_TO[:, :3, 3],
        "work2inertia": (trials["mass"] / model.mass)[:, None] * I_OOcm_T,
        "frame_cam2img_otm": looks["X_CI_otm"],
        **{f"frame_cam2work_{c}": pack_pose(invert_pose(X)) for c, X in X_TC.items()},
        **{f"frame_work2cam_{c}": pack_pose(X) for c, X in X_TC.items()},
        "frame_world2obj": pack_pose(multiply(X_WT, X_TO)),
        "frame_world2work": np.tile(pack_pose(X_WT), (trials.count, 1)),
    }
    values |= {f"object_props/{name}": value for name, value in properties.items()}

    # All other fields are columns of the trial.
    copied = {f.name: trials[f.of] for f in DATA_FIELDS if trials.has(f.of)}
    return values | copied | {"object_props/work2mass": trials["mass"][:, None]}
