"""Rules of trials.hdf5: each attempt by itself, and against values derived again.

Input: the file, with the dataset around it if there is one. Output: tasks, each of which judges a
range of attempts. `run` first compares the attempts with their shards. The rules here also apply to
a single file: verdict and motion follow from contacts and poses, by the functions with which a
trial decides. With the dataset, conditions and resting pose follow from the functions with which
a build draws them.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import partial

import numpy as np

from drakegrasp.config import RandomizeConfig
from drakegrasp.dataset.checks.rows import (
    POSITION_TOLERANCE,
    AnyArray,
    Batch,
    CheckedFile,
    Dataset,
    LoadModel,
    Rule,
    Violation,
    complete,
    derived,
    of_file,
    ranges,
    rigid,
)
from drakegrasp.dataset.manifest import Manifest
from drakegrasp.dataset.paths import FILE_NAME
from drakegrasp.dataset.schema import CONDITION_FIELDS, NO_PRESHAPE
from drakegrasp.filters import Removal
from drakegrasp.frames import invert_pose
from drakegrasp.grasp import unused_fingers
from drakegrasp.objects.model import ObjectModel
from drakegrasp.outcomes import Outcome, Stage
from drakegrasp.simulation.attempt import Source
from drakegrasp.simulation.conditions import draw_conditions
from drakegrasp.simulation.verdict import (
    is_lost_sample,
    is_precision,
    is_stable,
    judge_closed,
    judge_lifted,
    scrapes,
)

#: Slip [m] and turn [rad] are as exact as the poses they follow from; the angle of a rotation close
#: to the identity is less exact than its matrix.
MOTION_TOLERANCE = 1e-4
#: Largest outward force [N] of a fingertip on the object. The mean normal and the force of a patch
#: are separate averages: when a fingertip is about to lose the object, they may disagree by at most
#: the smallest force that counts as a contact.
PULL = 0.05
#: With more friction, a force may leave the object's side of a mean normal: a cone of 45 degrees.
MAX_FRICTION = 1.0
#: Number of attempts that are searched for successes at once.
BLOCK = 16_384


def trial_rules(trials: CheckedFile, dataset: Dataset | None) -> list[list[Rule]]:
    """Return the rules for a file and the dataset around it, if there is one, in stages.

    The first stage applies to any values; the second needs valid outcomes; the third needs finite
    values and known objects; the last needs valid poses and contacts.
    """
    finite: list[Rule] = [verdicts, rigid, contacts]
    sound: list[Rule] = [motion, derived]
    most: AnyArray | None = None
    # Rules that need the dataset need all of its objects.
    if dataset is not None and trials.counts["objects"] == len(dataset.manifest.objects):
        manifest, model = dataset.manifest, dataset.loader()
        most = np.array([entry.candidates for entry in manifest.objects])
        finite.append(partial(resting_poses, manifest=manifest))
        finite.append(partial(conditions, manifest=manifest, model=model))
    return [[partial(numbers, candidates=most)], [complete_stages, ranges, repeats], finite, sound]


def numbers(batch: Batch, candidates: AnyArray | None) -> Iterator[Violation]:
    """The numbers of a trial are valid.

    Args:
        batch: Rows of `/trials`.
        candidates: Number of candidates of each object, if known.
    """
    config, objects = batch.of.config, batch.of.counts["objects"]
    yield from batch.follows("trial_id", batch.rows, "the row's number")
    outcome, known = batch["outcome"], [o.value for o in Outcome if not o.verification_only]
    what = f"outcome must be one of {', '.join(map(str, known))}"
    yield from batch.broken(what, ~np.isin(outcome, known), outcome)

    # An unknown object is already a finding; for it no number is too large.
    most, index = np.full(len(batch), np.inf), batch["object"]
    if candidates is not None:
        there = (index >= 0) & (index < objects)
        most[there] = candidates[index[there]]
    for name, of, limit in (
        ("object", "rows of /objects", objects),
        ("candidate", "candidates of its object", most),
        ("standoff_index", "stand-offs", len(config.candidates.standoffs) if config else np.inf),
    ):
        bad = (batch[name] < 0) | (batch[name] >= limit)
        yield from batch.broken(f"{name} must be one of the {of}", bad, batch[name])

    # Only a posture from outside may have no preshape.
    source, preshape = batch["source"], batch["preshape"]
    shape = (preshape == NO_PRESHAPE) & ((source != Source.POSTURES) | (batch["unused"] > 0))
    for name, bad, must in (
        ("source", ~np.isin(source, list(Source)), "0, 1, 3, 4 or 5"),
        ("preshape", shape, "255 of postures only, which use all fingers"),
    ):
        yield from batch.broken(f"{name} must be {must}", bad, batch[name])


def complete_stages(batch: Batch) -> Iterator[Violation]:
    """The fields of a stage have values if the attempt reached the stage, and none otherwise."""
    stage = _stages(batch)
    touching = {when: batch[f"{when}_touching"] for when in ("closed", "lifted")}
    yield from complete(batch, stage, **touching)
    if batch.of.config is None:
        return
    measured = batch.config.close.scrape_depth is not None
    state, given = ("finite", "given") if measured else ("NaN", "null")
    for name, reached in (("clearance_close", Stage.CLOSED), ("clearance_lift", Stage.LIFTED)):
        bad = (stage >= reached) & (np.isfinite(batch[name]) != measured)
        what = f"{name} must be {state} with close.scrape_depth {given}"
        yield from batch.broken(what, bad, batch[name])


def repeats(batch: Batch) -> Iterator[Violation]:
    """Some repeats of an attempt hold, and some of those that hold are samples."""
    drawn, half = ~np.isnan(batch["p_hold_probability"]), batch["p_hold_half_step"]
    most = batch.of.config.certify.repeats if batch.of.config else np.inf
    limit, of = np.where(drawn, most, 0), "those drawn for"
    for name in ("p_hold_repeats", "p_hold_held", "p_hold_samples"):
        values = batch[name]
        yield from batch.broken(f"{name} must be at most {of}", values > limit, values)
        limit, of = values, name
    bad = ~np.isnan(half) & (~np.isin(half, [0.0, 1.0]) | ~drawn)
    yield from batch.broken("p_hold_half_step must be 0, 1 or NaN, of those drawn", bad, half)


def verdicts(batch: Batch) -> Iterator[Violation]:
    """The outcome follows from contacts and motion (`simulation.verdict`)."""
    outcome, closed = batch["outcome"], judged_closed(batch)
    due = judge_lifted(
        batch["lifted_touching"],
        batch["lifted_other_links"],
        batch["lifted_object_on_table"],
        required=required_of(batch),
        scraped=_scraped(batch, "lift"),
    )

    # A lift that was ended early has a reason instead of a verdict.
    ended = outcome == Outcome.MOVED
    if batch.of.config is not None:
        ended &= is_lost_sample(batch["slip"], batch["turn"], batch.config.lift)
    due = np.where(ended, Outcome.MOVED.value, due)

    # A hand that may not lift has no second verdict.
    due = np.where(closed != Outcome.SUCCESS, closed, due)
    yield from batch.broken(
        "outcome must follow from the contacts, the clearance and the motion",
        (_stages(batch) >= Stage.CLOSED) & (due != outcome),
        lambda i: (
            f"{Outcome(int(outcome[i])).label} where these say {Outcome(int(due[i])).label}: slip "
            f"{batch['slip'][i]:.4g} m, turn {batch['turn'][i]:.4g} rad"
        ),
    )


def judged_closed(batch: Batch) -> AnyArray:
    """Return the outcomes (n,) of closed hands, SUCCESS if the hand may lift."""
    return judge_closed(
        batch["closed_touching"],
        batch["closed_other_links"],
        batch["closed_hand_on_table"],
        required=required_of(batch),
        scraped=_scraped(batch, "close"),
    )


def required_of(batch: Batch) -> AnyArray:
    """Return which fingertips (n, k) the grasp of each row needs: those of its preshape."""
    required = [*json.loads(batch.of.attributes.get("fingers", "{}")).values()] or [True]
    return np.asarray(required) & ~unused_fingers(batch["unused"], len(required))


def contacts(batch: Batch) -> Iterator[Violation]:
    """Touching fingertips have a contact patch, and forces on a held object point into it.

    A patch may span an edge or a thin rim; its mean normal then does not show the direction of the
    force. So the rule of forces is only for successes, and only if the friction is at most
    `MAX_FRICTION`, since friction turns a force away from the normal.
    """
    judged = (batch["outcome"] == Outcome.SUCCESS) & (batch["friction_hand"] <= MAX_FRICTION)
    for stage in ("closed", "lifted"):
        touching, area = batch[f"{stage}_touching"], batch[f"{stage}_area"]
        push = (batch[f"{stage}_nhat_Q_O"] * batch[f"{stage}_f_Q_O"]).sum(axis=2)
        for k in range(touching.shape[1]):
            finger, touches = f"of finger {k + 1} must", touching[:, k]
            what, bad = f"{stage}_f_Q_O {finger} push into the object [N]", ~(push[:, k] < PULL)
            yield from batch.broken(what, judged & touches & bad, push[:, k])
            what, bad = f"{stage}_area {finger} be positive where it touches [m^2]", area[:, k] <= 0
            yield from batch.broken(what, touches & bad, area[:, k])


def motion(batch: Batch) -> Iterator[Violation]:
    """The object's motion in the hand and its labels follow from the two poses of the palm."""
    before, after = (invert_pose(batch.pose(name)) for name in ("X_OG", "X_OG_lifted"))
    slip = np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1)
    cosine = (np.einsum("nij,nij->n", before[:, :3, :3], after[:, :3, :3]) - 1.0) / 2.0
    turn = np.arccos(np.clip(cosine, -1.0, 1.0))
    for name, due in (("slip", slip), ("turn", turn)):
        yield from batch.follows(name, due, "X_OG and X_OG_lifted", MOTION_TOLERANCE)

    outcome, links = batch["outcome"], batch["lifted_other_links"]
    words = {
        "precision": is_precision(outcome, links),
        "stable": is_stable(outcome, links, batch["slip"], batch["turn"]),
    }
    yield from batch.follow(words, "outcome, lifted_other_links, slip and turn")


def _scraped(batch: Batch, when: str) -> AnyArray:
    """Return (n,) whether the hand came too far below the table's top; False if unknown."""
    if batch.of.config is None:
        return np.zeros(len(batch), dtype=np.bool_)
    return scrapes(batch[f"clearance_{when}"], batch.config.close)


def _stages(batch: Batch) -> AnyArray:
    """Return the stage (n,) that each attempt reached."""
    table = np.zeros(max(Outcome) + 1, dtype=int)
    table[[o.value for o in Outcome]] = [o.stage.value for o in Outcome]
    # The hand can touch the table while it closes, or during the lift.
    by_hand = batch["closed_hand_on_table"] | _scraped(batch, "close")
    lifted = (batch["outcome"] == Outcome.TABLE_CONTACT) & ~by_hand
    return np.where(lifted, Stage.LIFTED.value, table[batch["outcome"]])


# What an attempt gets from the configuration, its object and the seed


def resting_poses(batch: Batch, manifest: Manifest) -> Iterator[Violation]:
    """Every attempt starts from one of its object's resting poses."""
    objects, resting = batch["object"].astype(int), batch["resting"].astype(int)
    poses = [np.array([pose.X_TO for pose in entry.resting]) for entry in manifest.objects]
    unknown = resting >= np.array([len(own) for own in poses])[objects]
    yield from batch.broken("resting must be one of its object's resting poses", unknown, resting)
    if not unknown.all():
        known = batch.where(~unknown)
        pairs = zip(objects[~unknown], resting[~unknown], strict=True)
        due = np.array([poses[i][k] for i, k in pairs])
        of = f"the resting poses in {FILE_NAME}"
        yield from known.follows("X_TO", due, of, POSITION_TOLERANCE)


def conditions(batch: Batch, manifest: Manifest, model: LoadModel) -> Iterator[Violation]:
    """Friction, mass, looks, cameras and noise are those that the seed draws, or the defaults."""
    due = {f.name: np.array(batch[f.name]) for f in CONDITION_FIELDS}
    identity = ("candidate", "standoff_index")
    for name, known, rows in _by_object(batch, manifest, model):
        own = manifest.config_of(name)
        # If nothing is drawn, all attempts of an object have the same conditions.
        same = own.randomize == RandomizeConfig()
        for chosen in [rows] if same else rows[:, None]:
            numbers = [0, 0] if same else [int(batch[key][chosen[0]]) for key in identity]
            for key, value in draw_conditions(known, own, *numbers).values().items():
                due[key][chosen] = value
    for key, values in due.items():
        yield from batch.follows(key, values, "what the seed gives the attempt", 0.0)


def _by_object(
    batch: Batch, manifest: Manifest, model: LoadModel
) -> Iterator[tuple[str, ObjectModel, AnyArray]]:
    """Yield name and model of each object that can be read, and the indices of its rows."""
    for index in np.unique(batch["object"]).tolist():
        # The object's file may have another name for it, see `ObjectEntry.drawn_as`.
        name = manifest.objects[index].name
        known = model(name)
        if known is not None:
            yield name, known, np.flatnonzero(batch["object"] == index)


def successes(trials: CheckedFile) -> Iterator[Violation]:
    """Every success is in /successes, in order, with a valid reason of removal and certificate."""
    if not {"trials", "successes"} <= set(trials.counts):
        return
    with trials.opened() as file:
        outcome = file["trials/outcome"]
        blocks = range(0, len(outcome), BLOCK)
        hits = [np.flatnonzero(outcome[a : a + BLOCK] == Outcome.SUCCESS) + a for a in blocks]
        due = np.concatenate([np.zeros(0, dtype=np.int64), *hits])
        batch = trials.read(file, "successes", np.arange(trials.counts["successes"]))

    if not np.array_equal(batch["trial_id"], due):
        different = sorted(set(batch["trial_id"].tolist()) ^ set(due.tolist()))
        got = f"differences at trials {different[:5]}" if different else "another order"
        yield of_file(trials.name, "trial_id must list the successes of /trials", got, "/successes")
    known, removal = [r.value for r in Removal], batch["removal"]
    what = f"removal must be one of {', '.join(map(str, known))}"
    yield from batch.broken(what, ~np.isin(removal, known), removal)
    yield from ranges(batch)
