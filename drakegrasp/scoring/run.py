"""The path of a score: predictions and rows in, a `Score` out.

Reference rows are created, all predictions without a verdict are tried together, and the verdicts
become a card. The caller chooses who does the work (`Verify`).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from drakegrasp.config import Config
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.scenes import SceneRows
from drakegrasp.errors import DataError, GraspError, MachineError
from drakegrasp.runtime.files import write_atomic
from drakegrasp.scoring.benchmark import read_benchmark, rows_digest
from drakegrasp.scoring.card import card_of, card_text
from drakegrasp.scoring.measures import Grouping, Judged
from drakegrasp.scoring.references import REFERENCES, ReferenceInput
from drakegrasp.scoring.verdict import Verdict, VerdictFile, rank_array, verdict_key
from drakegrasp.seeding import Stream, object_key
from drakegrasp.simulation.attempts import GraspRows, GraspTable, Rows, join_rows

#: Tries n attempts on rows (n,), and calls back with the index and the verdict of each.
Verify: TypeAlias = Callable[[GraspRows, Sequence[int], Callable[[int, Verdict], None]], object]
#: Predictions of each method by training seed, by the name of the method on a card.
Methods: TypeAlias = Mapping[str, tuple[GraspRows, ...]]
#: Files of a score.
CARD_JSON, CARD_TEXT, CARD_PICTURE, VERDICTS = "card.json", "card.md", "card.png", "verdicts.jsonl"


@dataclass(frozen=True, kw_only=True, eq=False)
class Score:
    """A score of predictions and of reference rows, with which they are compared.

    Attributes:
        card: Plain JSON types, see docs/how-to/score.md.
        seconds: By set, the median wall-clock time of a verdict [s]; the card has no times.
        sets: The predictions of each set and their verdicts.
    """

    card: dict[str, Any]
    seconds: dict[str, float]
    sets: tuple[Judged, ...]

    @property
    def text(self) -> str:
        """The card as Markdown."""
        return card_text(self.card)

    def save(self, folder: Path) -> list[Path]:
        """Write the card as JSON, Markdown and a picture, and return the paths.

        Raises:
            OSError: If the folder cannot be written.
        """
        from drakegrasp.pictures.charts import card_picture

        folder.mkdir(parents=True, exist_ok=True)
        contents = {
            CARD_JSON: (json.dumps(self.card, indent=1, allow_nan=False) + "\n").encode(),
            CARD_TEXT: self.text.encode(),
            CARD_PICTURE: card_picture(self.card),
        }
        for name, content in contents.items():
            write_atomic(folder / name, content)
        return [folder / name for name in contents]


def score(
    data: GraspDataset,
    methods: Methods,
    verify: Verify,
    *,
    train: GraspDataset,
    references: Sequence[str],
    per_object: int | None,
    config: Config,
    settings: Mapping[str, Any],
    again: str,
    folder: Path | None = None,
) -> Score:
    """Return the score of predictions.

    Args:
        data: The dataset; its split has the rows.
        methods: Predictions of each method by training seed, by the name of the method on the card;
            without any, only the reference rows are scored.
        verify: Tries grasps.
        train: Training rows for the reference rows.
        references: Names of the reference rows, in the order of the card.
        per_object: Maximum number of rows of each object; None for all.
        config: Configuration of the verification.
        settings: All that decides a verdict apart from the row, with the versions.
        again: The command that creates the card again.
        folder: Folder that stores verdicts, so that the same call can continue; None stores none.

    Raises:
        GraspError: If there is nothing to score, the predictions are for different rows, or the
            training rows are of another camera or hand.
    """
    # The rows, and the sets that are scored on them.
    _validate_train(data, train)
    rows = _chosen_rows(data, [each for ranked in methods.values() for each in ranked], per_object)
    grouping = _grouping(data, rows)
    sets = {
        name: tuple(_of_rows(each, rows) for each in ranked)
        for name, ranked in methods.items()
        if ranked
    }
    inputs = ReferenceInput(data=data, rows=rows, train=train)
    for name in references:
        if len(train) or not REFERENCES[name].trained:
            sets[name] = (rank_array(name, REFERENCES[name].make(inputs), data, rows),)
    if not sets:
        raise GraspError("there must be predictions or reference rows to score, got none")

    # Their verdicts: all predictions without a verdict are tried together.
    with closing(VerdictFile(None if folder is None else folder / VERDICTS)) as known:
        tables = [each for ranked in sets.values() for each in ranked]
        verdicts = iter(_verdicts(tables, data, settings, verify, known))
    judged = tuple(
        Judged(name=name, ranked=ranked, verdicts=tuple(next(verdicts) for _ in ranked))
        for name, ranked in sets.items()
    )
    card = card_of(
        judged,
        grouping,
        dataset=_described(data, rows),
        config=config,
        settings=settings,
        known_objects=_known_objects(grouping.names, data, train),
        new_classes=not set(grouping.classes) & _texts(train, "class_name"),
        among=isinstance(data, SceneRows) and data.several,
        benchmark=read_benchmark(data.path.parent, config, settings["versions"]),
        again=again,
    )
    times = {each.name: float(np.median(each.table.seconds)) for each in judged}
    return Score(card=card, seconds=times, sets=judged)


def _validate_train(data: GraspDataset, train: GraspDataset) -> None:
    """Reject training rows whose grasps cannot be predictions for the rows to score.

    Raises:
        GraspError: If they are in the frame of the other camera, or of a hand with another number
            of fingers.
    """
    numbers, found = (each.column("grasps").shape[1] for each in (data, train))
    if (train.camera, found) != (data.camera, numbers):
        raise GraspError(
            f"{train.path}: training rows must be of the camera and hand of {data.path.name} "
            f"({data.camera}, {numbers} numbers), got {train.camera}, {found} numbers"
        )


def _chosen_rows(
    data: GraspDataset, predictions: Sequence[GraspRows], per_object: int | None
) -> list[int]:
    """Return the rows to score, in order: rows of the predictions, at most `per_object` each."""
    if per_object is not None and per_object < 1:
        raise GraspError(f"per_object must be 1 or more, got {per_object}")

    # The rows of the predictions; all methods must have the same rows.
    rows = np.unique(predictions[0].of_row) if predictions else np.arange(len(data))
    for other in predictions[1:]:
        if not np.array_equal(np.unique(other.of_row), rows):
            raise GraspError(
                f"{other.file}: must have predictions for the rows of {predictions[0].file}, "
                "got other rows"
            )
    if not len(rows):
        raise GraspError(f"{data.path}: {data.emptiness}")
    if per_object is None:
        return [int(row) for row in rows]

    # Draw rows by the names of their objects, so that other objects do not change them.
    names = data.column("object_props/object_name")[rows]
    chosen: list[int] = []
    for name in sorted(set(names.tolist())):
        own = rows[names == name]
        order = Stream(0, object_key(name), object_key("rows")).permutation(len(own))
        chosen += [int(row) for row in own[order[:per_object]]]
    return sorted(chosen)


def _grouping(data: GraspDataset, rows: Sequence[int]) -> Grouping:
    """Return the grouping of rows by object."""
    objects = data.column("object_props/object_name")[list(rows)]
    classes = data.column("object_props/class_name")[list(rows)]
    names, first, members = np.unique(objects, return_index=True, return_inverse=True)
    return Grouping(
        rows=tuple(rows),
        objects=members,
        names=tuple(names.tolist()),
        classes=tuple(classes[first].tolist()),
    )


def _verdicts(
    tables: Sequence[GraspRows],
    data: GraspDataset,
    settings: Mapping[str, Any],
    verify: Verify,
    known: VerdictFile,
) -> list[tuple[Verdict, ...]]:
    """Return the verdicts on each of several tables of predictions; equal predictions share one.

    Contacts of all tables are tried together, postures table by table.
    """
    keys = [_keys(each, data, settings) for each in tables]
    contacts = [k for k, each in enumerate(tables) if not isinstance(each, GraspTable)]
    postures = [[k] for k in range(len(tables)) if k not in contacts]
    for part in [contacts, *postures] if contacts else postures:
        table = join_rows([tables[k] for k in part])
        _try_unknown(table, [key for k in part for key in keys[k]], data, verify, known)
    return [tuple(known.verdicts[key] for key in each) for each in keys]


def _keys(table: GraspRows, data: GraspDataset, settings: Mapping[str, Any]) -> list[str]:
    """Return the key of each prediction under these settings."""
    # The files of the two cameras have the same content.
    frame, shapes = f"{data.content} {data.camera}", [""] * len(table)
    if isinstance(table, GraspTable):
        # Palm poses alone may differ only in their preshape.
        frame = f"{frame} posture in {table.frame}"
        shapes = [name and f" of {name}" for name in table.preshape]
    numbers = zip(shapes, table.of_row.tolist(), table.numbers(), strict=True)
    return [verdict_key(settings, frame + shape, *of) for shape, *of in numbers]


def _try_unknown(
    table: GraspRows, keys: Sequence[str], data: GraspDataset, verify: Verify, known: VerdictFile
) -> None:
    """Try the predictions that have no verdict, and store each verdict as soon as it is known.

    Predictions for an object in a resting pose are adjacent: verdicts come in this order, so none
    waits for another object.
    """
    objects = data.column("object_props/object_name").tolist()
    resting = data.column("grasp_props/resting").tolist()
    place = dict[str, tuple[str, int, int, int]]()
    for i, key in enumerate(keys):
        row = int(table.of_row[i])
        if key not in known.verdicts:
            place.setdefault(key, (objects[row], resting[row], row, i))
    if not place:
        return

    # Verdicts are stored in the order of the trials.
    tried = sorted(place, key=place.__getitem__)
    chosen = [place[key] for key in tried]
    verify(
        table.at([i for *_, i in chosen]),
        [row for _, _, row, _ in chosen],
        lambda index, verdict: known.add(tried[index], verdict),
    )
    if missing := [key for key in tried if key not in known.verdicts]:
        raise MachineError(f"each prediction must have a verdict, got none for {len(missing)}")


def _of_rows(table: Rows, rows: Sequence[int]) -> Rows:
    """Return the predictions for some rows."""
    return table.at(np.flatnonzero(np.isin(table.of_row, rows)).tolist())


def _texts(data: GraspDataset, name: str) -> set[str]:
    return set(data.column(f"object_props/{name}").tolist())


def _known_objects(names: Sequence[str], data: GraspDataset, train: GraspDataset) -> int:
    """Return the number of scored objects that are in the training split.

    Built-in objects of another seed have the same names but other meshes. For a data file without
    its dataset, the meshes are unknown, so only the names decide.
    """
    own, known = _meshes(data), _meshes(train)
    common = set(names) & _texts(train, "object_name")
    return sum(len({own.get(name), known.get(name)} - {None}) < 2 for name in common)


def _meshes(data: GraspDataset) -> dict[str, str]:
    """Return the hash of each object's mesh by name; empty for a file without its dataset."""
    try:
        return {each.name: each.mesh_sha256 for each in read_manifest(data.path.parent).objects}
    except DataError:
        return {}


def _described(data: GraspDataset, rows: Sequence[int]) -> dict[str, Any]:
    """Return the dataset's description on a card; its hashes show whether values differ."""
    return {
        "file": data.path.name,
        "split": data.split,
        "split_rows": len(data),
        "content": data.content,
        "rows_sha256": rows_digest(data, rows),
    }
