"""Comparison of the two samplers of palm poses: which approaches they try, and what they find.

Input: a dataset, and optionally another of the same objects by the other sampler. Output: the
paper's Figure 2, palm poses of one object by both samplers, and numbers. Without the other dataset,
the other sampler draws palm poses of that one object, which were not tried.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from drakegrasp.config import POSTPROCESSING_KEYS, Config
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.prepared_objects import PreparedObject, load_prepared
from drakegrasp.dataset.statistics import Funnel, count_funnel
from drakegrasp.errors import DataError
from drakegrasp.frames import Array
from drakegrasp.outcomes import Outcome
from drakegrasp.pictures.approaches import (
    NEAR_DEG,
    approach_directions,
    coverage,
    palm_poses_figure,
)
from drakegrasp.simulation.candidates import Candidates, sample_candidates

#: Names of the samplers in the configuration, in the order of the paper's figure, and in words.
METHODS = {"normals": "along surface normals", "rotations": "global and local rotations"}
#: Number of palm rays of a sampler in the figure.
RAYS = 220


def samplers_figure(out: Path, other: Path | None = None) -> tuple[Figure, dict[str, Any]]:
    """Return a figure of both samplers' palm poses on one object, and the compared numbers.

    Args:
        out: As in `compare_samplers`.
        other: As in `compare_samplers`.

    Raises:
        DataError: As in `compare_samplers`.
    """
    found = compare_samplers(out, other)
    model, numbers, rays, captions = found.shown.model, found.numbers, {}, {}
    for method, title in METHODS.items():
        rays[title] = palm_rays(found.candidates[method], found.standoff, RAYS)
        of_all = numbers["of_objects"].get(method)
        captions[title] = caption(numbers["of_object"][method], of_all, numbers["objects"])
    figure = palm_poses_figure(
        model.visual_vertices,
        model.visual_faces,
        rays,
        R_TO=found.shown.X_TO[:3, :3],
        captions=captions,
        name=model.name,
    )
    return figure, numbers


class SamplerComparison(NamedTuple):
    """The palm poses of both samplers on one object, and the compared numbers.

    Attributes:
        shown: The object that is drawn.
        candidates: The object's palm poses for each method of METHODS.
        standoff: The largest stand-off, from which the palm rays are drawn [m].
        numbers: Numbers for JSON: of this object, and of all objects in both datasets.
    """

    shown: PreparedObject
    candidates: dict[str, Candidates]
    standoff: float
    numbers: dict[str, Any]


def compare_samplers(out: Path, other: Path | None = None) -> SamplerComparison:
    """Return palm poses and numbers of both samplers.

    Args:
        out: Directory of a dataset.
        other: Directory of a dataset of the same objects with the other sampler and otherwise the
            same configuration.

    Raises:
        DataError: If a file is missing, or if the other dataset has another configuration or none
            of the objects.
    """
    # The datasets by method.
    manifest = read_manifest(out)
    config = manifest.config
    method, most = config.candidates.method, config.objects.resting_poses
    if isinstance(method, tuple) or method not in METHODS or most > 1:
        named = " and ".join(method) if isinstance(method, tuple) else method
        raise DataError(
            f"{out}: must be of candidates.method {' or '.join(METHODS)} and "
            f"objects.resting_poses 1, got {named} and {most}"
        )
    datasets: dict[str, Path] = {method: out}
    if other is not None:
        datasets[_other_method(config)] = other
        _refuse_other_configuration(other, config)

    # The objects that all datasets have, and the one with the most successes.
    funnels = {method: count_funnel(path) for method, path in datasets.items()}
    names = _common_objects(datasets, funnels)
    own = funnels[method]
    wins = {name: int(own.outcomes[own.names.index(name), Outcome.SUCCESS]) for name in names}
    name = max(names, key=lambda name: wins[name])
    own_config = manifest.config_of(name)
    shown = load_prepared(out, name, own_config)

    # Palm poses of that object, and numbers.
    candidates: dict[str, Candidates] = {}
    of_shown: dict[str, dict[str, Any]] = {}
    of_all: dict[str, dict[str, Any]] = {}
    for method in METHODS:
        if method in datasets:
            path, funnel = datasets[method], funnels[method]
            settings = read_manifest(path).config_of
            covers = {each: _cover(load_prepared(path, each, settings(each))) for each in names}
            candidates[method] = load_prepared(path, name, settings(name)).candidates
            of_shown[method] = _numbers({name: covers[name]}, funnel)
            of_all[method] = _numbers(covers, funnel)
        else:
            drawn = replace(shown, candidates=_draw(shown, own_config, method))
            candidates[method] = drawn.candidates
            of_shown[method] = _numbers({name: _cover(drawn)}, None)
    return SamplerComparison(
        shown=shown,
        candidates=candidates,
        standoff=max(config.candidates.standoffs),
        numbers={
            "what": "palm_rays: palm rays that meet the object; coverage: share of the directions "
            f"of the half sphere over the table that lie within {NEAR_DEG:g} deg of one of them, "
            "mean over objects; attempts: those that the simulator decided",
            "object": name,
            "of_object": of_shown,
            "objects": len(names),
            "of_objects": of_all,
        },
    )


def palm_rays(candidates: Candidates, standoff: float, count: int) -> Array:
    """Return the approach rays of the first palm poses, from a stand-off to the surface.

    Args:
        candidates: Candidates of the object in drawing order, which is random.
        standoff: Stand-off of the palm from the surface [m].
        count: Maximum number of rays to return.

    Returns:
        (n, 2, 3) in {O}: the palm's origin and the point on the surface [m].
    """
    hits = np.flatnonzero(np.isfinite(candidates.distance))[:count]
    z_O = candidates.X_OG[hits, :3, 2]
    p_OS = candidates.X_OG[hits, :3, 3] + candidates.distance[hits, None] * z_O
    return np.stack([p_OS - standoff * z_O, p_OS], axis=1)


def _draw(prepared: PreparedObject, config: Config, method: str) -> Candidates:
    """Return as many palm poses of a method as a dataset with this method would try."""
    rules = config.candidates.model_copy(update={"method": method})
    changed = config.model_copy(update={"candidates": rules})
    return sample_candidates(prepared.model, prepared.X_TO, changed)


def _cover(prepared: PreparedObject) -> tuple[int, int, float]:
    """Return the number of palm poses, the number of palm rays that hit, and their coverage."""
    candidates = prepared.candidates
    hits = np.isfinite(candidates.distance)
    covered = coverage(approach_directions(prepared.X_TO, candidates.X_OG[hits]))
    return len(hits), int(hits.sum()), covered


def _numbers(covers: dict[str, tuple[int, int, float]], funnel: Funnel | None) -> dict[str, Any]:
    """Return the numbers of a sampler on objects; None for numbers that were not simulated.

    Args:
        covers: Result of `_cover` by object.
        funnel: Funnel of the dataset; None if the palm poses were only drawn.
    """
    attempts = successes = rate = None
    if funnel is not None:
        # If the simulator failed, nothing is known of the palm pose.
        rows = [funnel.names.index(name) for name in covers]
        decided = [outcome for outcome in Outcome if not outcome.inconclusive]
        attempts = int(funnel.outcomes[np.ix_(rows, decided)].sum())
        successes = int(funnel.outcomes[rows, Outcome.SUCCESS].sum())
        rate = round(1000.0 * successes / attempts, 3) if attempts else None
    return {
        "palm_poses": sum(poses for poses, _, _ in covers.values()),
        "palm_rays": sum(hits for _, hits, _ in covers.values()),
        "coverage": round(float(np.mean([share for _, _, share in covers.values()])), 4),
        "attempts": attempts,
        "successes": successes,
        "successes_per_1000_attempts": rate,
    }


def _other_method(config: Config) -> str:
    return next(method for method in METHODS if method != config.candidates.method)


def _refuse_other_configuration(other: Path, config: Config) -> None:
    """Reject a dataset that differs from this one in anything but the sampler of its palm poses.

    Raises:
        DataError: If any other setting that affects attempts differs.
    """
    # Settings that do not affect attempts may differ.
    wanted = config.candidates.model_copy(update={"method": _other_method(config)})
    mine = _settings(config.model_copy(update={"candidates": wanted}))
    theirs = _settings(read_manifest(other).config)
    keys = sorted(mine.keys() | theirs.keys())
    differing = [key for key in keys if mine.get(key) != theirs.get(key)]
    if differing:
        raise DataError(
            f"{other}: must be of candidates.method={_other_method(config)} and else of the same "
            f"configuration, got another {', '.join(differing)}"
        )


def _settings(config: Config) -> dict[str, Any]:
    """Return the settings that affect attempts, by key, e.g. `hand`, `lift.hold_time`."""
    settings: dict[str, Any] = {}
    for name, value in config.to_dict().items():
        if name not in (*POSTPROCESSING_KEYS, "unit_candidates"):
            parts = value if isinstance(value, dict) else {"": value}
            settings |= {f"{name}.{key}".rstrip("."): part for key, part in parts.items()}
    return settings


def _common_objects(datasets: dict[str, Path], funnels: dict[str, Funnel]) -> list[str]:
    """Return the names of the objects that all datasets have with the same mesh, in order.

    While a build that adds objects runs, a manifest has more objects than the files.

    Raises:
        DataError: If there is no such object.
    """
    first, *others = (
        {
            entry.name: entry.mesh_sha256
            for entry in read_manifest(path).objects
            if entry.name in funnels[method].names
        }
        for method, path in datasets.items()
    )
    names = [name for name, mesh in first.items() if all(o.get(name) == mesh for o in others)]
    if not names:
        paths = " and ".join(str(path) for path in datasets.values())
        raise DataError(f"{paths}: must have objects of the same meshes, got none")
    return names


def caption(of_object: Mapping[str, Any], of_all: Mapping[str, Any] | None, objects: int) -> str:
    """Return the text below a panel.

    Args:
        of_object: Numbers of the sampler on the object that is drawn, see `_numbers`.
        of_all: Numbers on all objects; None if the palm poses were only drawn.
        objects: Number of all objects.
    """
    lines = [
        f"{of_object['palm_rays']:,} of {of_object['palm_poses']:,} palm rays meet the object",
        f"{_percent(of_object)} of the directions from above lie within {NEAR_DEG:g}° of one",
        _rate(of_object, "successes per 1,000 attempts"),
    ]
    if of_all is not None and objects > 1:
        lines.append(f"all {objects:,} objects: {_percent(of_all)}; {_rate(of_all, 'per 1,000')}")
    return "\n".join(lines)


def _percent(numbers: Mapping[str, Any]) -> str:
    return f"{100.0 * numbers['coverage']:.0f} %"


def _rate(numbers: Mapping[str, Any], unit: str) -> str:
    rate = numbers["successes_per_1000_attempts"]
    if rate is None:
        return "not tried in this dataset"
    return f"{rate:.1f} {unit} ({numbers['successes']:,} of {numbers['attempts']:,})"
