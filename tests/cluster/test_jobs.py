"""The script of a job, for each scheduler, whatever is typed into the options."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from itertools import pairwise, product
from pathlib import Path

import dask
import pytest
import trimesh
from cyclopts.argument import Argument
from helpers.commands import arguments_of, run
from helpers.golden import Golden
from helpers.tiers import few

from drakegrasp.cli.arguments import validate_existing, validate_existing_file
from drakegrasp.cluster.connect import dask_settings
from drakegrasp.cluster.kinds import cluster_of, describe
from drakegrasp.errors import ConfigError, MachineError

pytest.importorskip("dask_jobqueue")


def test_job_runs_a_worker_with_its_paths_and_settings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Paths are words, whatever characters they have, and a job inherits no settings."""
    folder = tmp_path / "a b $(touch ran) 'c' \"d\" `touch ran`"
    folder.mkdir()
    python = folder / "python"
    python.write_text(
        f"#!{sys.executable}\nimport json, os, sys\n"
        f"json.dump([sys.argv[1:], dict(os.environ)], open({str(tmp_path / 'told')!r}, 'w'))\n"
    )
    python.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(python))
    files = folder / "ca.pem", folder / "cert.pem", folder / "key.pem"
    script = cluster_of("slurm", workers=1, tls_files=files).script(tmp_path)
    subprocess.run(["bash", "-c", script], cwd=tmp_path, check=True, timeout=120)
    words, environment = json.loads((tmp_path / "told").read_text())
    said = dict(pairwise(words))
    assert [said[f"--tls-{key}"] for key in ("ca-file", "cert", "key")] == list(map(str, files))
    assert not list(tmp_path.rglob("ran"))
    found = dask.config.collect_env({k: v for k, v in environment.items() if k[:5] == "DASK_"})
    for key, wanted in dask_settings().items():
        assert dask.config.get(key, config=found) == wanted, key


#: Texts of which a shell runs a part, unless they are quoted.
HOSTILE = (
    *("a;touch ran $(touch ran) `touch ran`", "'; touch ran; '", '"; touch ran; "'),
    "\ntouch ran\n",
)
KINDS = {"slurm": "sbatch", "htcondor": "condor_submit"}
KINDS |= {"pbs": "qsub", "lsf": "bsub", "sge": "qsub", "oar": "oarsub"}
#: An option of each scheduler, without which dask-jobqueue makes no job or warns.
NEEDED = {"htcondor": "disk=1GB", "oar": "memory_per_core_property_name=mem"}
TLS = ("--tls-ca-file", "--tls-cert", "--tls-key")
#: Options that take such a text: it stands in the script or in the command of the client.
TAKEN = {"--objects", "--out", "--script", "--manifest", "--postures", *TLS}
TAKEN |= {"--interface", "--host"}


def typed(option: Argument, text: str, folder: Path) -> str:
    """Return a value of an option with a text in it; a file or a folder is made."""
    path = folder / text
    if option.name == "--objects":
        path.mkdir()
        trimesh.creation.box([0.06, 0.06, 0.06]).export(path / "1_box_a.obj")
    elif not option.parameter.converter:  # no path
        return f"queue={text}" if option.name == "--with" else text
    elif {validate_existing, validate_existing_file} & {*option.parameter.validator}:
        path.write_text("{}")
    return str(path)


def shell_script(kind: str, script: str) -> str:
    """Return what a shell runs on the machine of a job."""
    if kind != "htcondor":
        return script
    # HTCondor replaces macros in a line, and then takes the word after -c.
    (line,) = [line for line in script.splitlines() if line.startswith("Arguments = ")]
    line = re.sub(r"\$\((.*?)\)", lambda found: "$" * (found[1] == "DOLLAR"), line)
    (word,) = re.findall(r"'((?:[^']|'')*)'", line.replace('""', '"'))
    return str(word).replace("''", "'")


@pytest.mark.parametrize("kind", few([*KINDS], 2))
def test_nothing_that_is_typed_runs(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each option with each text: neither the script nor the printed commands run any of it."""
    programs = tmp_path / "bin $(touch ran)"
    programs.mkdir()
    for name in ("python", "drakegrasp", KINDS[kind]):
        (programs / name).write_text(f"#!/bin/sh\necho {name} >> '{tmp_path / 'calls'}'\n")
        (programs / name).chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(programs / "python"))
    monkeypatch.setenv("PATH", str(programs), prepend=":")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "key.pem").touch()
    found = arguments_of("submit")
    options = [each for each in found if each.name.startswith("--") and each.hint is not bool]
    taken = list[str]()
    for number, (option, text) in enumerate(product(options, HOSTILE)):
        name, folder = option.name, tmp_path / str(number)
        folder.mkdir()
        given = {"--cluster": kind, "--workers": "2", "--objects": "builtin"}
        given |= {"--out": "out", "--script": str(folder / "script")}
        given |= dict.fromkeys(TLS, "key.pem") if name in TLS else {}
        given[name] = typed(option, text, folder)
        words = [word for pair in given.items() for word in pair]
        words += ["--with", NEEDED[kind]] if kind in NEEDED else []
        result = run("submit", *words)
        if result.exit_code:
            (line,) = result.stderr.splitlines()
            assert line.startswith("error: "), (name, text)
            continue
        taken.append(name)
        script = Path(given["--script"]).read_text()
        # A scheduler takes a line for a directive also between quotation marks.
        assert not any(line.startswith("touch") for line in script.splitlines()), (name, text)
        script = shell_script(kind, script)
        printed = result.stdout[result.stdout.index(f"\n{KINDS[kind]} ") :]
        for lines in (script, printed.replace("\nclient: ", "\n")):
            subprocess.run(["bash", "-n", "-c", lines], check=True, timeout=60)
            subprocess.run(["bash", "-c", lines], check=True, timeout=60)
        assert not list(tmp_path.rglob("ran")), (name, text)
    assert set(taken) >= TAKEN
    calls = (tmp_path / "calls").read_text().split()
    assert calls == ["python", KINDS[kind], "drakegrasp"] * len(taken)
    assert len(options) >= 30


def test_what_jobqueue_yaml_states_stays_shell_code(tmp_path: Path) -> None:
    """A container as Python, a scratch folder of each node, names and logs."""
    told = {
        "python": "apptainer exec a.sif python",
        "local-directory": "/scratch/$USER",
        "name": "grasps",
        "log-directory": str(tmp_path / "logs"),
    }
    with dask.config.set({"jobqueue.slurm": {**dask.config.get("jobqueue.slurm"), **told}}):
        script = cluster_of("slurm", workers=1).script(tmp_path)
    assert "\napptainer exec a.sif python -m distributed.cli.dask_worker " in script
    assert " --local-directory /scratch/$USER " in script
    assert f"\n#SBATCH -o {tmp_path}/logs/grasps-%J.out\n" in script


@pytest.mark.parametrize(
    ("kind", "text", "words"),
    [
        ("slurm", "disk=1GB", "KEY=VALUE with KEY one of queue, project, account, "),
        ("slurm", "queue", "KEY=VALUE with KEY one of queue,"),
        ("htcondor", "queue=a", "KEY=VALUE with KEY one of disk, submit_command_extra,"),
    ],
)
def test_what_is_no_option_of_the_scheduler_is_refused(kind: str, text: str, words: str) -> None:
    with pytest.raises(ConfigError, match=rf"--with must be {words}.* got '{text}'"):
        cluster_of(kind, [text], workers=1)


def test_what_dask_jobqueue_misses_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="--cluster htcondor: You must specify how much disk"):
        cluster_of("htcondor", workers=1).script(tmp_path)
    with pytest.raises(ConfigError, match="--walltime must not be given with --cluster htcondor"):
        cluster_of("htcondor", workers=1, walltime="1:00")


#: Options of each scheduler for jobs of three workers with 2 GB each.
ASKED = {
    "slurm": ["queue=long", "job_cpu=4"],
    "pbs": ["account=me"],
    "lsf": ["ncpus=6"],  # without lsf.conf LSF's unit is KB
    "sge": ["resource_spec=mem_free=2G"],
    "htcondor": ["disk=4GB"],
    "oar": ["memory_per_core_property_name=mem"],
}


@pytest.mark.parametrize("kind", ASKED)
def test_each_scheduler_gets_its_own_options(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, golden: Golden
) -> None:
    for name in ("LSF_ENVDIR", "OPENBLAS_CORETYPE"):
        monkeypatch.delenv(name, raising=False)
    walltime = None if kind == "htcondor" else "01:30"
    cluster = cluster_of(
        kind, ASKED[kind], workers=6, cores=3, memory="2GB", walltime=walltime, interface="ib0"
    )
    script = cluster.script(tmp_path)
    assert cluster.submission() == KINDS[kind]
    assert not list(tmp_path.iterdir())
    text = "\n".join([script, *describe(cluster)])
    golden(f"jobs/{kind}", text.replace(str(tmp_path), "OUT").replace(sys.executable, "PYTHON"))


@pytest.mark.cluster
@pytest.mark.parametrize("there", [False, True])
def test_job_that_is_not_accepted_is_one_line(
    there: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else the build would wait for workers that never come."""
    words = "No such file or directory: 'sbatch'"
    if there:
        words = "error: Batch job submission failed"
        (tmp_path / "sbatch").write_text(f"#!/bin/sh\necho 'sbatch: {words}' >&2\nexit 1\n")
        (tmp_path / "sbatch").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    cluster = cluster_of("slurm", workers=2, interface="lo")
    with (
        pytest.raises(MachineError, match=rf"^the workers did not start: .*{words}$"),
        cluster.connected(tmp_path / "out"),
    ):
        raise AssertionError
    assert not list((tmp_path / "out").iterdir())
