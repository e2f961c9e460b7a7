"""One grasp of each class, as the paper's Figure 6: colour, depth and mask, with the contacts.

In: a data file. Out: figures, a page of classes each. Needs matplotlib, not Drake.
"""

from __future__ import annotations

from pathlib import Path

from matplotlib.figure import Figure

from drakegrasp.dataset.reader import GraspDataset, Sample
from drakegrasp.dataset.schema import SPLITS
from drakegrasp.errors import DataError
from drakegrasp.pictures.contact_sheet import draw_sheet
from drakegrasp.pictures.style import read_far

#: Classes on a page.
PER_PAGE = 24


def class_sheets(path: Path) -> tuple[list[Figure], dict[str, int]]:
    """Return pages with a sample of each class, and the trial of each class's sample.

    Of each class the sample of the lowest trial is taken, as it is; classes are in the order of
    their names.

    Args:
        path: A data file.

    Raises:
        DataError: If the file is no data file or holds no sample.
    """
    # The first sample of each class.
    first: dict[str, tuple[int, GraspDataset, int]] = {}
    for split in SPLITS:
        data = GraspDataset(path, split=split, fewer_fingers=True)
        ids, classes = data.column("trial_id"), data.column("object_props/class_name")
        for row, (trial, name) in enumerate(zip(ids.tolist(), classes.tolist(), strict=True)):
            if name not in first or trial < first[name][0]:
                first[name] = trial, data, row
    if not first:
        raise DataError(f"{path}: must hold at least one sample to draw, got none")

    # Pages of as many classes as fit.
    names, far, pages = sorted(first), read_far(path), []
    for start in range(0, len(names), PER_PAGE):
        shown = names[start : start + PER_PAGE]
        samples: list[Sample] = [first[name][1][first[name][2]] for name in shown]
        pages.append(draw_sheet(samples, first[shown[0]][1].K, far=far, titles=shown))
    return pages, {name: first[name][0] for name in names}
