"""The command line as a user sees it: output, one-line errors, exit codes."""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
import trimesh
from helpers.assertions import arrays_of
from helpers.commands import error_line, run

from drakegrasp.cli import main as cli
from drakegrasp.cli.arguments import What
from drakegrasp.cli.console import say
from drakegrasp.cli.main import COMMANDS
from drakegrasp.config import preset_names
from drakegrasp.errors import DataError
from drakegrasp.hand.settings import load_config
from drakegrasp.pictures import figures
from drakegrasp.shapes.catalog import BuiltinObject


def test_help_answers_without_loading_the_simulator() -> None:
    code = (
        "import sys; from drakegrasp.cli.main import COMMANDS, main; "
        "[main([*name, '--help']) for name in ([], *([name] for name in COMMANDS))]; "
        "heavy = {'pydrake', 'dask', 'distributed', 'matplotlib', 'trimesh', 'scipy', 'h5py', "
        "'numpy', 'pydantic', 'yaml'}; "
        "assert not heavy & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


def test_a_locale_that_is_not_utf8_is_an_error() -> None:
    """Drake reads its own files by the locale."""
    locale = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    command = [sys.executable, "-m", "drakegrasp", "hand", "list"]
    done = subprocess.run(command, env={**os.environ, **locale}, capture_output=True, text=True)
    line = "error: the locale must be UTF-8, got ascii; set PYTHONUTF8=1\n"
    assert (done.returncode, done.stdout, done.stderr) == (1, "", line)


def test_closed_output_is_an_error() -> None:
    command = ["bash", "-c", '"$@" >&-', "-", sys.executable, "-m", "drakegrasp", "hand", "list"]
    done = subprocess.run(command, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 1
    assert done.stderr == "error: standard output must be open, got a closed one\n"


def test_options_of_clusters_come_last() -> None:
    """A newcomer reads those of everyday first."""
    for name in ("build", "verify", "score", "bench-set"):
        daily, cluster = run(name, "--help").stdout.split("\nCluster options:\n")
        for option in ("--scheduler ", "--scheduler-file", "--tls,", "--tls-ca-file", "--tls-key"):
            assert option in cluster and option not in daily, (name, option)
        assert {"--workers", "--quiet"} <= set(re.findall(r"--[a-z-]+", daily))
    everyday, _, rare = run("build", "--help").stdout.partition("\nMore options:\n")
    assert len(everyday.splitlines()) <= 40 and "--postures" in rare


@pytest.mark.parametrize("name", ["build", "submit", "verify"])
def test_help_names_all_presets(name: str) -> None:
    (text,) = re.findall(r"the preset ([\w, ]+)\.", " ".join(run(name, "--help").stdout.split()))
    assert sorted(re.split(", | or ", text)) == sorted(preset_names())


def test_examples_in_help_texts_are_settings() -> None:
    """Each `KEY=VALUE` that a help text shows can be set."""
    found = {}
    for name in COMMANDS:
        text = " ".join(run(name, "--help").stdout.split())
        for example in re.findall(r"--set KEY=VALUE [^\[]*?e\.g\. ([\w.]+=\w+)", text):
            assert load_config(overrides=[example])
            found[name] = example.partition(".")[0]
    assert len(found) >= 9
    assert [found[name] for name in ("assemble", "merge", "scenes")] == [*["filters"] * 2, "scenes"]


#: What is refused with one line: the words of the command, and some of the line's. The folder has
#: `a.npy`, a grasp, `short.npy`, one with a number too few, `other.h5`, which has one, `box.obj`,
#: and nothing else.
REFUSED = [
    ("verify a.npy --seed 3", "Unknown option: --seed."),
    ("verify a.npy --protocoll lift", "Did you mean --protocol?"),
    ("fly", "Unknown command"),
    ("verfy a.npy", 'Did you mean "verify"?'),
    ("build", "requires an argument"),
    ("stats", "requires an argument"),
    ("stats {tmp} more", "Unused Tokens: ['more']"),
    ("replay . x", ""),
    ("build --objects {tmp} --out {tmp}/out --per-class 3", "--per-class must be used with"),
    ("bench-set {tmp}/bench --only 99_chair_1", "'99_chair_1'"),
    ("verify a.npy --object gone.obj", "gone.obj: must be a mesh file"),
    ("verify a.npy", "--object MESH or --dataset FILE must be given"),
    ("verify a.npy --dataset a.npy", "a.npy: must be a data file or scenes of drakegrasp"),
    ("verify other.h5", "other.h5: must be a data file of drakegrasp"),
    ("verify other.h5 --frame object", "--frame must be camera for a dataset's own grasps"),
    ("verify other.h5 --units cm", "--units must be left out without --object, got cm"),
    ("verify a.npy --object o.obj --out run", "--out must be a file .h5 or .hdf5, got run"),
    ("verify a.npy --object o.obj --out a.npy/x.h5", "must be in a folder that can be"),
    ("verify a.npy --object o.obj --protocol dexgraspbench --out x.h5", "--out must be left out"),
    ("verify a.npy --object box.obj --units inch", 'Choose from: "m", "cm", "mm".'),
    ("score --dataset other.h5 --frame mesh", 'Choose from: "object", "table", "camera", "world".'),
    ("verify a.npy --object o.obj --assets .", "--assets must be used with another --protocol"),
    *(
        (f"verify {words} --object box.obj --units cm --out deep/run.h5", said)
        for words, said in (
            ("short.npy", "a grasp must be 18 numbers (3 points, then 3 outward normals)"),
            ("a.npy --frame camera", "--frame must not be camera with --object"),
            (
                "a.npy --frame top",
                'Choose from: "object", "table", "camera", "world", "mesh"',
            ),
            ("a.npy --dataset x.hdf5", "--object or --dataset must be given, got both"),
            ("a.npy --hand octopus", "octopus"),
            ("a.npy --workers 0", "workers must be at least 1, got 0"),
            ("a.npy --workers some", "must be a whole number, got"),
            ("a.npy --split test", "--split must be left out without --dataset, or grasps in an"),
            ("a.npy --set verify.max_tries=9", "max_tries: must be less than or equal to 5"),
            ("a.npy --workers 2 --scheduler x", "must not be given with a scheduler"),
        )
    ),
    ("build --objects builtin --out o --dry-run --only 1_jug_1", "only must be names of objects"),
    (
        "build --objects builtin --out o --dry-run --set candidates.postures=0123456789abcdef",
        "candidates.postures must be",
    ),
    *(
        (command, "must be a path of this machine, got the address")
        for command in (
            "build --objects builtin --out s3://x/y",
            "merge s3:/x {tmp}",
            "score --dataset other.h5 --out https://x/y",
            "audit memory://x",
        )
    ),
]

#: The same of commands whose dataset is none, which is no wrong usage.
NO_DATASET = [
    ("check {tmp}/nowhere", "nowhere"),
    ("stats {tmp}", "{tmp}"),
    ("check {tmp}", "{tmp}"),
    ("assemble {tmp}", "{tmp}"),
    ("figures {tmp} --quiet", "{tmp}/trials.hdf5: must be the trials"),
    ("export {tmp} {tmp}/to --to original", "must be a data file of drakegrasp"),
    ("inspect {tmp}/none", "must be the directory of a dataset"),
]


@pytest.mark.parametrize(("command", "words"), [*REFUSED, *NO_DATASET])
def test_wrong_usage_is_one_line_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str, words: str
) -> None:
    monkeypatch.chdir(tmp_path)
    np.save("a.npy", pinch())
    np.save("short.npy", pinch()[:17])
    trimesh.creation.box([6.0] * 3).export("box.obj")  # cm
    with h5py.File("other.h5", "w") as file:
        file["grasps"] = pinch()
    before = sorted(tmp_path.rglob("*"))
    result = run(*command.format(tmp=tmp_path).split())
    assert result.exit_code == (1 if (command, words) in NO_DATASET else 2)
    assert result.stdout == ""
    assert [error_line(result)] == result.stderr.splitlines()
    assert words.format(tmp=tmp_path) in error_line(result)
    assert sorted(tmp_path.rglob("*")) == before


def test_a_reader_that_closes_the_pipe_sees_no_error() -> None:
    code = "from drakegrasp.cli.main import main; main(['objects', 'list'])"
    reader, writer = os.pipe()
    os.close(reader)
    child = subprocess.run([sys.executable, "-c", code], stdout=writer, stderr=subprocess.PIPE)
    os.close(writer)
    assert (child.returncode, child.stderr) == (1, b"")


def test_help_fits_into_80_columns_and_has_the_first_line_of_each_command() -> None:
    groups = {"objects": ("", "list", "export"), "hand": ("", "list", "new", "check")}
    each = [" ".join([name, more]).strip() for name in COMMANDS for more in groups.get(name, [""])]
    pages = {words: run(*words.split(), "--help").stdout for words in ["", *each]}
    for page in pages.values():
        # In the usage line dots mean "and more of these".
        assert "..." not in page.partition("\n\n")[2]
        assert max(map(len, page.splitlines())) <= 80
    for name, (_, summary) in COMMANDS.items():
        assert re.search(rf"^  {name} +{re.escape(summary)}$", pages[""], re.M)
        assert pages[name].startswith(f"Usage: drakegrasp {name}")
        assert f"\n\n{summary}\n" in pages[name]
    # Also without docstrings.
    code = "from drakegrasp.cli.main import main; main(['build', '--help'])"
    done = subprocess.run([sys.executable, "-OO", "-c", code], capture_output=True, text=True)
    assert "--samples-per-object N" in done.stdout


@pytest.fixture
def quick_shapes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every built-in object is a tetrahedron: building the shapes takes long."""
    points, faces = np.vstack([np.zeros(3), 0.1 * np.eye(3)]), [[0, 2, 1], [0, 1, 3], [0, 3, 2]]
    mesh = trimesh.Trimesh(points, [*faces, [1, 2, 3]], process=False)

    def build(self: BuiltinObject) -> trimesh.Trimesh:
        return trimesh.Trimesh((1.0 + 0.1 * self.seed) * mesh.vertices, mesh.faces, process=False)

    monkeypatch.setattr(BuiltinObject, "build", build)


@pytest.mark.usefixtures("quick_shapes")
def test_as_many_objects_are_exported_as_asked_for(tmp_path: Path) -> None:
    for arguments, count, seed in (([], 2, 0), (["--per-class", 3, "--objects-seed", 7], 3, 7)):
        folder = tmp_path / str(count)
        result = run("objects", "export", folder, *arguments)
        assert result.exit_code == 0
        assert result.stdout == f"{64 * count} meshes in {folder}\n"
        assert len(list(folder.glob("*.obj"))) == 64 * count
        text = (folder / f"64_traffic_cone_{count}.obj").read_text()
        assert f"v {0.1 * (1.0 + 0.1 * seed):.7f} 0.0000000 0.0000000" in text


def test_options_of_built_in_objects_are_values_of_the_configuration(tmp_path: Path) -> None:
    given = {"objects": "builtin", "out": tmp_path, "overrides": ("builtin.seed=9",)}
    for per_class, seed, expected in ((3, None, (3, 9)), (None, 4, (2, 4)), (None, None, (2, 9))):
        config = What(**given, per_class=per_class, objects_seed=seed).asked()["config"]
        assert (config.builtin.per_class, config.builtin.seed) == expected


@pytest.mark.sim
@pytest.mark.usefixtures("builds_here")
def test_bad_meshes_are_one_line_and_leave_nothing(tmp_path: Path) -> None:
    """No mesh, a file that is none, and one that is metres long."""
    meshes, out = tmp_path / "meshes", tmp_path / "out"
    meshes.mkdir()
    for name, words in (("", "mesh"), ("1_text_a", "1_text_a"), ("1_huge_a", "--units")):
        if name == "1_text_a":
            (meshes / f"{name}.obj").write_text("Dear mesh, where are your faces?\n")
        elif name:
            (meshes / "1_text_a.obj").unlink()
            trimesh.creation.box([5.0, 5.0, 5.0]).export(meshes / f"{name}.obj")
        result = run("build", "--objects", meshes, "--out", out, "--workers", "1", "--quiet")
        assert result.exit_code in (1, 2)
        assert words in error_line(result)
        assert not out.exists()


@pytest.mark.sim
@pytest.mark.usefixtures("builds_here")
def test_build_reports_and_says_when_nothing_is_left_to_do(
    small_meshes: Path, tmp_path: Path
) -> None:
    (tmp_path / "meshes").mkdir()
    shutil.copy(small_meshes / "11_box_slim.obj", tmp_path / "meshes")
    command = ["build", "--objects", tmp_path / "meshes", "--out", tmp_path / "out"]
    command += ["--workers", "1", "--candidates", "1", "--quiet", "--config", "fast"]
    command += ["--set", "candidates.method=normals"]
    first = run(*command)
    assert first.exit_code == 0, first.output
    assert "1 work unit simulated" in first.stdout
    assert "grasping_oto.hdf5" in first.stdout
    second = run(*command)
    assert "all 1 work unit had been done before: nothing was simulated" in second.stdout


@pytest.mark.sim
@pytest.mark.slow
def test_replay_says_what_was_and_records_it(small_dataset: Path, tmp_path: Path) -> None:
    page = tmp_path / "trial.html"
    again = run("replay", small_dataset, "--trial", "0", "--html", page)
    assert again.exit_code == 0
    assert page.read_text(encoding="utf-8").lstrip().startswith("<!DOCTYPE html>")
    assert "trial 0 of 10_box_tall: was" in again.stdout
    assert run("replay", small_dataset, "--trial", "100000").exit_code == 1


def test_a_terminal_with_another_encoding_shows_question_marks(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    written = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(written, encoding="latin-1"))
    monkeypatch.setattr("drakegrasp.cli.main.main", lambda: say("\u7897 \u00fc"))
    cli.run()
    assert written.getvalue() == b"? \xfc\n"


def test_check_prints_one_document_of_json(out: Path) -> None:
    with h5py.File(out / "grasping_oto.hdf5", "r+") as file:
        file["test/grasps"][0, 9:12] *= np.float32(2.0)
    result = run("check", out, "--json", "--workers", "1")
    (checked,) = map(json.loads, result.stdout.splitlines())
    assert result.exit_code == 1 and checked["path"] == str(out)
    assert "grasping_oto.hdf5" in {broken["file"] for broken in checked["broken"]}


def test_findings_of_an_audit_are_written_as_json(tmp_path: Path) -> None:
    meshes, found = tmp_path / "m", tmp_path / "a.json"
    meshes.mkdir()
    trimesh.creation.box([0.05, 0.06, 0.07]).export(meshes / "1_box_a.obj")
    assert run("audit", meshes, "--json", found).exit_code == 0
    (row,) = json.loads(found.read_text())
    assert (row["name"], row["status"], row["faces"]) == ("1_box_a", "fit", 12)


def test_figures_are_written_beside_the_dataset(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise DataError("not in this test")

    monkeypatch.setattr(figures, "_sheet", refuse)
    for name in ("png_bytes", "svg_bytes"):
        monkeypatch.setattr(figures, name, lambda figure, *, dpi: b"")
    result = run("figures", out, "--quiet")
    assert result.exit_code == 0, result.output
    lines = ["sheet is left out: not in this test", f"2 figures in {out / 'figures'}"]
    assert result.stdout.splitlines() == lines
    assert (out / "figures" / "distributions.svg").is_file()
    folder = out.parent / "other"
    assert run("figures", out, "--out", folder, "--quiet").stdout.endswith(f"in {folder}\n")


# Verify

#: Edge of the cube that is verified [m].
EDGE = 0.06


@pytest.fixture(scope="module")
def cube(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("mesh") / "1_cube_a.obj"
    trimesh.creation.box([100.0 * EDGE] * 3).export(path)  # cm
    return path


def pinch() -> np.ndarray:
    """Return a grasp (18,) of two opposite faces."""
    points = np.array([[EDGE / 2, 0, 0], [-EDGE / 2, 0.01, 0], [-EDGE / 2, -0.01, 0]])
    normals = np.sign(points) * [1.0, 0.0, 0.0]
    return np.concatenate([points.ravel(), normals.ravel()])


def save(folder: Path, *grasps: np.ndarray) -> Path:
    np.save(folder / "grasps.npy", np.array(grasps))
    return folder / "grasps.npy"


@pytest.mark.sim
def test_verdicts_are_lines_of_json_in_the_order_of_the_grasps(cube: Path, tmp_path: Path) -> None:
    """Failed grasps are results: the exit code is zero. A wrong unit is hinted at."""
    in_mm = pinch() * ([1e3] * 9 + [1.0] * 9)
    file = save(tmp_path, pinch(), pinch() * np.nan, in_mm)
    options = ("--set", "verify.max_tries=1")
    result = run("verify", file, "--object", cube, "--units", "cm", *options)
    assert result.exit_code == 0, result.stderr
    tried, bad, far = (json.loads(line) for line in result.stdout.splitlines())
    assert (tried["index"], tried["object"], tried["tries"]) == (0, "1_cube_a", 1)
    assert tried["outcomes"] == [tried["outcome"]]
    assert (bad["index"], bad["outcome"], bad["matches"]) == (1, "invalid", False)
    assert bad["reason"] == "number 1 is nan, not finite"
    hint = "points in millimetres instead of metres"
    assert far["hints"] == hint and far["p_OQ"][0] == [30.0, 0.0, 0.0]  # nothing is changed by it
    assert "1 of 3 grasps: invalid\n" in result.stderr
    assert f"1 of 3 grasps would fit much better: {hint}\n" in result.stderr


@pytest.mark.sim
@pytest.mark.parametrize("as_json", [False, True])
def test_file_is_written_instead_of_lines(cube: Path, tmp_path: Path, as_json: bool) -> None:
    """With --json the lines are all that is printed."""
    file, out = save(tmp_path, *[np.full(18, np.inf)] * 3), tmp_path / "new" / "run.1.h5"
    words = ("verify", file, "--object", cube, "--units", "cm", "--out", out)
    result = run(*words, *["--json"] * as_json)
    assert result.exit_code == 0
    if as_json:
        found = [json.loads(line)["outcome"] for line in result.stdout.splitlines()]
        assert (found, result.stderr) == (["invalid"] * 3, "")
    else:
        assert result.stdout.splitlines() == [str(out)]
    assert arrays_of(out)["grasps/outcome"].tolist() == [17] * 3
    assert list(out.parent.iterdir()) == [out]


def test_module_runs_as_a_program() -> None:
    """The console script of the package is there and starts."""
    script = Path(sys.executable).with_name("drakegrasp")
    result = subprocess.run(
        [script, "--version"], capture_output=True, text=True, check=True, env=os.environ
    )
    assert result.stdout.startswith("drakegrasp, version ")


# Ctrl-C and SIGTERM end a command wherever it is


#: A library that swallows whatever is raised while it is imported.
GREEDY = """
import os, signal, time
try:
    os.kill(os.getpid(), signal.{name})
    time.sleep(0.2)
    whole = True
except BaseException:
    pass
"""
COMMAND = """
import sys, time
from drakegrasp.cli.console import run_command

def command(words, **_):
    import greedy
    print(f"whole: {greedy.whole}", flush=True)
    time.sleep(20.0)
    print("went on")

sys.path.insert(0, sys.argv.pop())
run_command(command, [], resumable=True)
"""


@pytest.mark.parametrize(("name", "code"), [("SIGINT", 130), ("SIGTERM", 143)])
def test_signal_in_an_import_ends_the_command_after_it(
    tmp_path: Path, name: str, code: int
) -> None:
    """The library is there whole, and the command does not go on."""
    (tmp_path / "greedy.py").write_text(GREEDY.format(name=name))
    found = subprocess.run(
        [sys.executable, "-c", COMMAND, str(tmp_path)], capture_output=True, text=True, timeout=60
    )
    assert (found.returncode, found.stdout) == (code, "whole: True\n")
    assert found.stderr == "stopped; the same command continues from here\n"


def test_signal_that_the_shell_ignores_stays_ignored(tmp_path: Path) -> None:
    """As in the background of a shell, or under nohup."""
    (tmp_path / "greedy.py").write_text(GREEDY.format(name="SIGINT"))
    shorter = COMMAND.replace("20.0", "0.5")
    found = subprocess.run(
        [sys.executable, "-c", shorter, str(tmp_path)],
        capture_output=True,
        text=True,
        timeout=60,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_IGN),
    )
    assert (found.returncode, found.stdout) == (0, "whole: True\nwent on\n")
