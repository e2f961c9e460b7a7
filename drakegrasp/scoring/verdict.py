"""Ranked predictions, and the part of each verdict that a score stores.

Input: arrays and files with m predictions for each row of a split, and verdicts of any rule on
them. Output: a `GraspTable` in the order of rows and ranks, and a `Verdict` for each. Ranks follow
the stated confidence, or the given order if none is stated. Verdicts are stored as JSON lines under
a key of what was tried, so an interrupted score can continue.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, TextIO

import numpy as np
import numpy.typing as npt

from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.errors import GraspError
from drakegrasp.exchange.attempts import digest_of, named, read_predictions
from drakegrasp.foreign_files import parse_json
from drakegrasp.frames import Array, as_numbers
from drakegrasp.hand.description import load_hand
from drakegrasp.outcomes import Outcome
from drakegrasp.protocols.protocol import PostureVerdict
from drakegrasp.simulation.attempts import EACH, GraspRows, GraspTable, Rows, ranked
from drakegrasp.verification.placing import dataset_config
from drakegrasp.verification.prediction import read_several
from drakegrasp.verification.result import Verification


def sorted_by_rank(table: Rows) -> Rows:
    """Return predictions for rows of a split, ordered by row and by rank within a row."""
    table = ranked(table, table.of_row)
    return table.at(np.lexsort((table.rank, table.of_row)).tolist())


def rank_array(
    name: str,
    grasps: npt.ArrayLike | GraspRows,
    data: GraspDataset,
    rows: Sequence[int] | npt.NDArray[np.int64] | None = None,
    confidence: npt.ArrayLike | None = None,
) -> GraspRows:
    """Return predicted contacts of an array, ranked; see `read_several`.

    A table of predictions for rows is only ranked.

    Args:
        name: Name of the predictions in errors and on the card.
        grasps: (n, 6k), or (n, m, 6k); or a table with `of_row`.
        data: The split.
        rows: (n,), row that each prediction is for.
        confidence: (n,) or (n, m).

    Raises:
        GraspError: If the predictions cannot be used.
    """
    if isinstance(grasps, GraspRows):
        sha256 = hashlib.sha256(np.ascontiguousarray(grasps.numbers()).tobytes()).hexdigest()
        return sorted_by_rank(replace(grasps, file=name, sha256=sha256))
    fingers = data.column("grasps").shape[1] // 6
    with named(Path(name)):
        array = as_numbers(grasps, "grasps must be numbers")
        table = read_several(array, data, fingers=fingers, rows=rows, confidence=confidence)
        sha256 = hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()
        return sorted_by_rank(replace(table, file=name, sha256=sha256))


def rank_file(
    path: Path, data: GraspDataset, read_as: Mapping[str, str] | None = None
) -> GraspRows:
    """Return the predictions of a file, ranked; see `read_attempts`.

    Raises:
        GraspError: If the file holds anything else; the message names it.
        ConfigError, HandError, DataError, MachineError: If dataset or hand cannot be used.
    """
    hand = load_hand(dataset_config(data).hand_source)
    table = read_predictions(path, hand, of=data, several=True, read_as=read_as)
    with named(path):
        if isinstance(table, GraspTable) and EACH in table.preshape:
            raise GraspError(
                f"preshape must be one for a score, which tries nothing twice, got {EACH}"
            )
        return sorted_by_rank(replace(table, file=str(path), sha256=digest_of(path)))


def ranked_sets(
    predictions: Any,
    data: GraspDataset,
    *,
    rows: Sequence[int] | None = None,
    confidence: npt.ArrayLike | None = None,
    read_as: Mapping[str, str] | None = None,
) -> tuple[str, tuple[GraspRows, ...]]:
    """Return the name of the scored method, and its predictions by training seed.

    Args:
        predictions: An array, a path, or paths.
        data: The split.
        rows: With an array: row that each prediction is for.
        confidence: With an array: confidence of each prediction.
        read_as: With files of postures, see `read_attempts`.

    Raises:
        GraspError: If they cannot be used, or rows or confidence are given with files.
        MachineError: See `read_attempts`.
    """
    # One array.
    single = isinstance(predictions, str | Path)
    try:
        paths = [predictions] if single else list(predictions)
    except TypeError:
        raise GraspError(
            f"predictions must be an array, a file or a list of files, got {predictions!r}"
        ) from None
    if not all(isinstance(path, str | Path) for path in paths):
        one = rank_array("predictions", predictions, data, rows, confidence)
        return one.file, (one,)

    # Files, one per training seed.
    if rows is not None or confidence is not None:
        raise GraspError("rows and confidence must be in the files if files are given, got them")
    found = tuple(rank_file(Path(path), data, read_as) for path in paths)
    names = [Path(path).name for path in paths]
    if len(found) < 2:
        return (names or [""])[0], found
    return f"{names[0]} and {len(found) - 1} more", found


#: Decimals of lengths [m] and angles [rad]: two more than those to which contacts are rounded.
_DIGITS = 6


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """The verdict on one prediction. All but `lifted_any` is about the first wrist pose.

    Attributes:
        outcome: Name of the outcome.
        lifted, precision, stable, kept: As in a dataset, wherever the fingertips touch.
        clean: Kept, with all neighbours left in place.
        matches: Lifted, with every contact within `verify.max_contact_error` of the requested one.
        lifted_any: Whether any of at most five wrist poses holds: an oracle chose among them.
        contact_error: Largest distance between requested and reached contacts [m], of the
            fingertips that touch; None if none touches; 0 for a posture that holds, because it
            requests no contacts.
        penetration: Largest penetration after closing [m]; None if the hand did not close.
        posture: Position [m], rotation vector [rad] and joints after closing in {O}; empty if the
            hand did not close.
        seconds: Wall-clock time [s].
        reason: Why the row is invalid; empty for other rows.
        reachable: Whether an arm reaches the first wrist pose; None if no arm was asked.
    """

    outcome: str
    matches: bool
    lifted: bool
    precision: bool
    stable: bool
    kept: bool
    clean: bool
    lifted_any: bool
    contact_error: float | None
    penetration: float | None
    posture: tuple[float, ...]
    seconds: float
    reason: str = ""
    reachable: bool | None = None

    @property
    def counted(self) -> bool:
        """Whether it counts in the headline: a sample that is made by the requested contacts."""
        return self.matches and self.kept

    @property
    def reached(self) -> bool:
        """Whether it counts in the headline, and an arm reaches it."""
        return self.counted and bool(self.reachable)


def verdict_of(result: Verification) -> Verdict:
    """Return the part of a verification that a score stores."""
    first, farthest = result.first, result.farthest_contact
    closed = None if first is None else first.trial.closed
    if result.grasp.postures and result.lifted:
        farthest = 0.0
    return Verdict(
        outcome=result.outcome.label,
        matches=result.matches,
        lifted=result.lifted,
        precision=result.precision,
        stable=result.stable,
        kept=result.kept,
        clean=result.clean,
        lifted_any=result.lifted_any,
        contact_error=_rounded(farthest) if math.isfinite(farthest) else None,
        penetration=None if closed is None else _rounded(np.nanmax(closed.contacts.penetration)),
        posture=() if closed is None or first is None else _posture(first.trial.X_OG, closed.q),
        seconds=sum(result.seconds.values()),
        reason=result.reason if result.outcome is Outcome.INVALID else "",
        reachable=None if result.reach is None else result.reach.reachable,
    )


def protocol_verdict(found: PostureVerdict) -> Verdict:
    """Return the part that a score stores of a prediction tried by a MuJoCo protocol.

    A protocol only decides on success, which is then used for all measures.
    """
    outcome = found.reason.partition(":")[0] or "success"
    measures = ("matches", "lifted", "precision", "stable", "kept", "clean", "lifted_any")
    return Verdict(
        outcome=outcome,
        **dict.fromkeys(measures, found.success),
        contact_error=None,
        penetration=_rounded(found.penetration) if math.isfinite(found.penetration) else None,
        posture=(),
        seconds=0.0,
        reason=found.reason.partition(": ")[2] if outcome == Outcome.INVALID.label else "",
    )


def _posture(X_OG: Array, q: Array) -> tuple[float, ...]:
    from scipy.spatial.transform import Rotation

    turned = Rotation.from_matrix(X_OG[:3, :3]).as_rotvec()
    values = np.concatenate([X_OG[:3, 3], turned, q])
    return tuple(map(_rounded, values)) if np.isfinite(values).all() else ()


def _rounded(value: Any) -> float:
    return round(float(value), _DIGITS) + 0.0


class VerdictFile:
    """Verdicts keyed by what was tried, stored as JSON lines.

    A line that was cut off by a crash is ignored, and its grasp is tried again.

    Args:
        path: The file, created with the first line; None keeps the verdicts only in memory.
    """

    def __init__(self, path: Path | None) -> None:
        self.path, self.verdicts = path, dict[str, Verdict]()
        self._stream: TextIO | None = None
        if path is not None and path.is_file():
            for line in path.read_bytes().splitlines():
                self._read(line)

    def _read(self, line: bytes) -> None:
        try:
            tree = parse_json(line)
            values = {f.name: tree[f.name] for f in fields(Verdict)}
            values["posture"] = tuple(values["posture"])
            self.verdicts[str(tree["key"])] = Verdict(**values)
        except (ValueError, KeyError, TypeError):
            return

    def add(self, key: str, verdict: Verdict) -> None:
        """Store a verdict; its line is complete when the call returns.

        Raises:
            OSError: If the file cannot be written.
        """
        self.verdicts[key] = verdict
        if self.path is None:
            return
        if self._stream is None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._stream = self.path.open("a", encoding="utf-8")
            # A line that was cut off must not be joined with the next line.
            self._stream.write("\n" if self._stream.tell() else "")
        self._stream.write(json.dumps({"key": key, **asdict(verdict)}) + "\n")
        self._stream.flush()

    def close(self) -> None:
        """Close the file."""
        if self._stream is not None:
            self._stream.close()
            self._stream = None


def verdict_key(settings: Mapping[str, Any], signature: str, row: int, grasp: Array) -> str:
    """Return the key (32 hex digits) of a prediction that is tried on a row of a dataset.

    Args:
        settings: All that decides the verdict apart from the row: rules and versions.
        signature: Hash of the dataset's content, with the camera in whose frame the grasps are.
        row: Row of the split.
        grasp: (6k,), or the numbers of a posture.
    """
    text = json.dumps([settings, signature, row], sort_keys=True)
    digest = hashlib.sha256(text.encode())
    digest.update(np.ascontiguousarray(grasp, dtype=np.float64).tobytes())
    return digest.hexdigest()[:32]
