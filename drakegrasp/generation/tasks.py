"""What the tasks of a build have in common: plain data on one object, and the files that they use.

A worker that does not see the dataset gets copies of these files, see `FileTask` of
`drakegrasp.runtime.executor`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

from drakegrasp.config import Config
from drakegrasp.dataset.paths import places
from drakegrasp.hand.folder import hand_places, moved_hand


@dataclass(frozen=True, kw_only=True, eq=False)
class DatasetTask:
    """The input of a task on files of a dataset, as plain data.

    Attributes:
        out: Directory of the dataset, as a path of the process that runs the task.
        config: Configuration of the dataset.
    """

    out: Path
    config: Config

    @property
    def inputs(self) -> tuple[Path, ...]:
        """Files of the dataset that the task reads, without those of the hand."""
        raise NotImplementedError

    @property
    def outputs(self) -> tuple[Path, ...]:
        """Files of the dataset that the task writes or removes."""
        raise NotImplementedError

    def reads(self) -> dict[str, Path]:
        """Return the files that the task reads by their places, see `FileTask`."""
        return {**hand_places(self.config), **places(self.out, *self.inputs)}

    def writes(self) -> tuple[str, ...]:
        """Return the places of the files that the task writes or removes."""
        return tuple(path.relative_to(self.out).as_posix() for path in self.outputs)

    def moved(self, folder: Path) -> Self:
        """Return the task in a directory with copies of the files."""
        return replace(self, out=folder, config=moved_hand(self.config, folder))
