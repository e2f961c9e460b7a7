"""Grasps among other objects are counted alike by stats and figures."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import h5py
import pytest

from drakegrasp.cli.tables import print_stats
from drakegrasp.dataset.assemble import assemble
from drakegrasp.dataset.schema import NOT_TRIED
from drakegrasp.dataset.statistics import counts_as_dict
from drakegrasp.dataset.trials import Trials
from drakegrasp.pictures.figures import NUMBERS_FILE, write_figures

pytestmark = pytest.mark.sim
#: Labels of grasps among others, besides whether they were tried.
LABELS = ("free", "kept", "clean")


def test_grasps_among_others_are_counted_by_surroundings(
    small_clutter: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """In text, as JSON and in the figures."""
    with h5py.File(small_clutter / "clutter.hdf5") as file:
        around = file["scenes/surroundings"].asstr()[:]
        grasps = {name: file["grasps"][name][:] for name in ("scene", "outcome", *LABELS)}
    tried = grasps["outcome"] != NOT_TRIED
    due = []
    for name in ("bin", "table"):
        own = (around == name)[grasps["scene"]]
        due.append(
            {
                "surroundings": name,
                "scenes": int((around == name).sum()),
                "grasps": int(own.sum()),
                "tried": int((own & tried).sum()),
                "neighbour_hit": int((own & (grasps["outcome"] == 19)).sum()),
                **{label: int((own & grasps[label]).sum()) for label in LABELS},
            }
        )
    assert due[1]["grasps"] > due[1]["free"] >= due[1]["tried"] > due[1]["kept"] > 0

    assert counts_as_dict(small_clutter)["clutter"] == due
    written = write_figures(small_clutter, tmp_path)
    numbers = json.loads((tmp_path / NUMBERS_FILE).read_text())
    assert numbers["clutter"] == due and numbers["scenes"] == {"scenes": [0, 1, 2]}
    assert {"clutter", "scenes"} <= set(written.names) and (tmp_path / "scenes.png").is_file()
    print_stats(small_clutter)
    told = capsys.readouterr().out
    for each in due:
        free, tried, kept = each["free"], each["tried"], each["kept"]
        assert f"({each['surroundings']}): {free} of {each['grasps']} grasps free" in told
        assert f"of {tried} tried {kept} kept, {each['clean']} clean" in told


def test_scenes_of_other_trials_are_not_counted(
    small_clutter: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The files were assembled again since: the rest is counted and drawn."""
    out = Path(shutil.copytree(small_clutter, tmp_path / "out"))
    write_figures(out, out / "figures")
    assemble(out, rejected=Trials(out).where(kept=True).trial_ids.tolist()[:1])
    print_stats(out)
    why = "must be of the trials in its folder, got other scenes; run `drakegrasp clutter` again"
    assert f"not counted: {out / 'clutter.hdf5'}: {why}" in capsys.readouterr().out
    left_out = write_figures(out, out / "figures").left_out
    assert set(left_out) == {"clutter", "scenes"} and why in left_out["clutter"]
    assert not (out / "figures/scenes.png").exists()
