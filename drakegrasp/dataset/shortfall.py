"""What a dataset lacks, why, and what would help: objects without samples, parts of a split.

In: counts. Out: sentences.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from drakegrasp.config import Config, SplitConfig, ways_to_grasps
from drakegrasp.dataset.hdf5 import AnyArray
from drakegrasp.dataset.statistics import Funnel, SplitCount
from drakegrasp.filters import Removal
from drakegrasp.outcomes import Outcome, Stage

#: A share of the samples differs much from the one asked for beyond this factor.
MUCH = 2.0


class Shortfall(NamedTuple):
    """Why an object has no sample, and what would help; each a part of a sentence."""

    reason: str
    advice: str


def objects_without_samples(funnel: Funnel, config: Config) -> dict[str, Shortfall]:
    """Return why each object that has no sample has none, by its name."""
    return {
        funnel.names[i]: why_no_sample(funnel.outcomes[i], funnel.removals[i], config)
        for i in np.flatnonzero(funnel.samples == 0).tolist()
    }


def why_no_sample(outcomes: AnyArray, removals: AnyArray, config: Config) -> Shortfall:
    """Return why the attempts at an object gave no sample.

    Args:
        outcomes: (1 + max(Outcome),), attempts by outcome.
        removals: (1 + max(Removal),), successes by reason of removal.
        config: Of the dataset, which says what was tried already.
    """
    total = int(outcomes.sum())
    if not total:
        return Shortfall("nothing was tried", "more palm poses (--candidates)")

    # What is nearest to a sample says more than what is most frequent, if there is any.
    held = int(outcomes[Outcome.SUCCESS])
    if held:
        removal = Removal(int(np.argmax(removals)))
        reason = f"{held:,} held, none a sample: mostly {removal.label} ({removals[removal]:,})"
        if removal is Removal.FLAT_DEPTH:
            # Where lifts were left out for a flat image, the filter cannot be wider than that.
            least = f"{config.lift.least_depth_variance:g}"
            ways = f"`drakegrasp assemble OUT --set filters.min_depth_variance={least}`"
            return Shortfall(reason, f"{ways}, which keeps flat depth images")
        return Shortfall(reason, "more palm poses (--candidates), or other limits in `filters`")

    most = Outcome(int(np.argmax(outcomes)))
    met = "" if most.inconclusive else f", {most.text}"
    reason = f"{outcomes[most]:,} of {total:,} attempts ({outcomes[most] / total:.0%}) end in "
    reason += f"{most.label}{met}"
    by_stage = {
        stage: sum(int(outcomes[o]) for o in Outcome if o.stage is stage) for stage in Stage
    }
    if most.inconclusive:
        return Shortfall(reason, "another machine or a simpler mesh: this says nothing of grasps")
    if by_stage[Stage.LIFTED] and most.stage is not Stage.LIFTED:
        reason += f"; {by_stage[Stage.LIFTED]:,} were lifted, none held"
    elif by_stage[Stage.CLOSED] and most.stage is Stage.PLACED:
        reason += f"; {by_stage[Stage.CLOSED]:,} closed, none lifted"
    elif not by_stage[Stage.CLOSED] and not by_stage[Stage.LIFTED]:
        reason += "; the hand never closed on it"
    return Shortfall(reason, ways_to_grasps(config))


def split_shortfall(counts: Sequence[SplitCount], rule: str, config: SplitConfig) -> str:
    """Return which part of a split is empty or of another share than asked for; "" if none is.

    Args:
        counts: Of the parts.
        rule: By what the samples are split, `class` or `object`.
        config: The shares that were asked for.
    """
    samples = {count.split: count.samples for count in counts}
    total = sum(samples.values())
    if not total:
        return ""
    if rule == "class":
        asked = {"train": 1.0, "valid": config.valid_fraction, "test": 1.0}
    else:
        asked = {"valid": config.valid_fraction, "test": config.test_fraction}
        asked["train"] = 1.0 - sum(asked.values())
    empty = [name for name, count in samples.items() if asked[name] and not count]

    if rule == "class":
        # By class no share of the samples is asked for the test, and valid is drawn from the rest.
        if "train" in empty:
            return (
                "no sample is for training: by class, a class trains if two of its objects have "
                "samples, or if split.train_classes names it; --set split.by=object trains on any"
            )
        if empty:
            wanted = {
                "valid": "more samples, or a larger split.valid_fraction",
                "test": "classes of which two objects have samples, or --set split.by=object",
            }
            helps = "; ".join(f"{name}: {wanted[name]}" for name in empty)
            return f"no sample is in {' and '.join(empty)}. What would help: {helps}"
        return ""

    off = [
        name
        for name, share in asked.items()
        if share and not share / MUCH <= samples[name] / total <= share * MUCH
    ]
    if not off:
        return ""
    told = ", ".join(
        f"{name} {samples[name] / total:.0%} (asked {asked[name]:.0%})" for name in samples
    )
    objects = sum(count.objects for count in counts)
    return (
        f"the split is of other shares than asked: {told}, as whole objects are drawn and only "
        f"{objects:,} have samples that count. What would help: more objects, or as many samples "
        "of each (--samples-per-object)"
    )
