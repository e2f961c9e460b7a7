"""The script of a job, for each scheduler, whatever is typed into the options."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from itertools import pairwise, product
from pathlib import Path

import click
import dask
import pytest
import trimesh
from click.testing import CliRunner
from helpers.golden import Golden
from helpers.tiers import few

from drakegrasp.cli.submit import submit
from drakegrasp.cluster.certificates import security_of
from drakegrasp.cluster.connect import dask_settings
from drakegrasp.cluster.kinds import cluster_of, describe
from drakegrasp.errors import ConfigError, MachineError

pytest.importorskip("dask_jobqueue")

from dask_jobqueue.slurm import SLURMJob

from drakegrasp.cluster.jobqueue import Jobs, Slurm, quoted


def test_paths_in_a_job_script_are_words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "a b $(touch ran) 'c' \"d\" `touch ran`"
    folder.mkdir()
    python = folder / "python"
    python.write_text(
        f"#!{sys.executable}\nimport json, sys\n"
        f"json.dump(sys.argv[1:], open({str(tmp_path / 'words')!r}, 'w'))\n"
    )
    python.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(python))
    files = folder / "ca.pem", folder / "cert.pem", folder / "key.pem"
    script = quoted(SLURMJob)(
        scheduler="tls://10.0.0.1:8786",
        name="worker",
        cores=1,
        memory="1GB",
        worker_extra_args=["--lifetime", "60s"],
        security=security_of(files),
    ).job_script()
    subprocess.run(["bash", "-c", script], cwd=tmp_path, check=True, timeout=120)
    words = json.loads((tmp_path / "words").read_text())
    said = dict(pairwise(words))
    assert [said[f"--tls-{key}"] for key in ("ca-file", "cert", "key")] == list(map(str, files))
    assert said["--lifetime"] == "60s"
    assert not list(tmp_path.rglob("ran"))


#: Texts of which a shell runs a part, unless they are quoted.
HOSTILE = (
    *("a;touch ran $(touch ran) `touch ran`", "'; touch ran; '", '"; touch ran; "'),
    "\ntouch ran\n",
)
KINDS = {"slurm": "sbatch", "htcondor": "condor_submit"}
KINDS |= {"pbs": "qsub", "lsf": "bsub", "sge": "qsub", "oar": "oarsub"}
TLS = ("--tls-ca-file", "--tls-cert", "--tls-key")
#: Options that take such a text: it stands in the script or in the command of the client.
TAKEN = {"--objects", "--out", "--script", "--manifest", "--postures", "--link", *TLS}


def typed(option: click.Option, text: str, folder: Path) -> str:
    """Return a value of an option with a text in it; a file or a folder is made."""
    path = folder / text
    if option.opts[0] == "--objects":
        path.mkdir()
        trimesh.creation.box([0.06, 0.06, 0.06]).export(path / "1_box_a.obj")
    elif not isinstance(option.type, click.Path):
        return f"queue={text}" if option.opts[0] == "--with" else text
    elif option.type.exists:
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
    options = [o for o in submit.params if isinstance(o, click.Option) and not o.is_flag]
    taken = list[str]()
    for number, (option, text) in enumerate(product(options, HOSTILE)):
        name, folder = option.opts[0], tmp_path / str(number)
        folder.mkdir()
        given = {"--cluster": kind, "--workers": "2", "--host": "10.0.0.1", "--objects": "builtin"}
        given |= {"--out": "out", "--script": str(folder / "script")}
        given |= dict.fromkeys(TLS, "key.pem") if name in TLS else {}
        given[name] = typed(option, text, folder)
        words = [word for pair in given.items() for word in pair]
        monkeypatch.setattr(sys, "argv", ["drakegrasp", "submit", *words])
        result = CliRunner().invoke(submit, words)
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
    assert len(options) > 30


def test_what_jobqueue_yaml_states_stays_shell_code(tmp_path: Path) -> None:
    """A container as Python, a scratch folder of each node."""
    told = {"python": "apptainer exec a.sif python", "local-directory": "/scratch/$USER"}
    with dask.config.set({"jobqueue.slurm": {**dask.config.get("jobqueue.slurm"), **told}}):
        script = cluster_of("slurm", workers=1, host="10.0.0.1").script(tmp_path)
    assert "\napptainer exec a.sif python -m distributed.cli.dask_worker " in script
    assert " --local-directory /scratch/$USER " in script


def test_name_and_log_of_jobqueue_yaml_are_used(tmp_path: Path) -> None:
    told = {"name": "grasps", "log-directory": str(tmp_path / "logs")}
    with dask.config.set({"jobqueue.slurm": {**dask.config.get("jobqueue.slurm"), **told}}):
        lines = cluster_of("slurm", workers=1, host="10.0.0.1").script(tmp_path).splitlines()
    assert [line for line in lines if line.startswith(("#SBATCH -J", "#SBATCH -o"))] == [
        "#SBATCH -J grasps",
        f"#SBATCH -o {tmp_path}/logs/grasps-%J.out",
    ]


@pytest.mark.parametrize(
    ("kind", "keys"),
    [("slurm", "queue, account"), ("lsf", "queue, project"), ("htcondor", "job-extra-directives")],
)
def test_settings_of_the_site_are_found_in_jobqueue_yaml(kind: str, keys: str) -> None:
    for text in ("queue=long", "account=me"):
        with pytest.raises(ConfigError) as told:
            cluster_of(kind, [text], workers=1, host="10.0.0.1")
        assert f"got {text!r}: jobqueue.{kind} in ~/.config/dask/jobqueue.yaml has {keys}" in str(
            told.value
        )


def test_job_has_the_memory_of_all_its_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    """SLURM reads it: three workers of 2 GB in a job of three cores."""
    scripts: list[str] = []

    def refuse(_: Jobs, script: str) -> None:
        scripts.append(script)
        raise MachineError("no SLURM here")

    monkeypatch.setattr(Jobs, "refuse_bad_job", refuse)
    cluster = Slurm(kind="slurm", workers=6, cores=3, memory="2GB", host="127.0.0.1")
    with pytest.raises(MachineError, match="no SLURM here"):
        cluster.start(None)
    (script,) = scripts
    lines = [line.removeprefix("#SBATCH ").split("=") for line in script.splitlines()]
    said = {line[0]: line[1] for line in lines if len(line) == 2}
    assert (said["--cpus-per-task"], said["--mem"]) == ("3", "6G")


def test_workers_run_the_kernel_of_blas_that_the_caller_chose(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A job inherits nothing, and the last bits of a lift depend on the kernel."""
    key = "distributed.nanny.pre-spawn-environ"
    monkeypatch.setenv("OPENBLAS_CORETYPE", "Prescott")
    assert dask_settings()[key]["OPENBLAS_CORETYPE"] == "Prescott"
    monkeypatch.delenv("OPENBLAS_CORETYPE")
    assert "OPENBLAS_CORETYPE" not in dask_settings()[key]


#: Of jobs of three workers with 2 GB each for 90 minutes: the lines that ask for it.
ASKED = {
    "slurm": ("sbatch", ["#SBATCH --cpus-per-task=3", "#SBATCH --mem=6G", "#SBATCH -t 01:30:00"]),
    "pbs": ("qsub", ["#PBS -l select=1:ncpus=3:mem=5723MB", "#PBS -l walltime=01:30:00"]),
    # Without lsf.conf LSF's unit is KB.
    "lsf": ("bsub", ["#BSUB -n 3", "#BSUB -M 6000000", "#BSUB -W 1:30"]),
    "sge": ("qsub", ["#$ -l mem_free=1908M", "#$ -l h_rt=01:30:00", "#$ -pe smp 3"]),
    "htcondor": (
        "condor_submit",
        [
            "MY.DaskWorkerCores = 3",
            "MY.DaskWorkerMemory = 6000000000",
            "MY.DaskWorkerDisk = 3000000000",
            "allowed_job_duration = 5400",
        ],
    ),
    "oar": (
        "oarsub",
        ["#OAR -l /nodes=1/core=3,walltime=01:30:00", "#OAR -p mem>=1908"],
    ),
}


@pytest.mark.parametrize("kind", ASKED)
def test_each_scheduler_is_asked_in_its_own_words(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, golden: Golden
) -> None:
    for name in ("LSF_ENVDIR", "OPENBLAS_CORETYPE"):
        monkeypatch.delenv(name, raising=False)
    site = {
        "jobqueue.sge.job-extra-directives": ["-pe smp 3"],
        "jobqueue.oar.memory-per-core-property-name": "mem",
    }
    submission, lines = ASKED[kind]
    given = {"cores": 3, "memory": "2GB", "walltime": "01:30:00", "host": "10.0.0.1"}
    with dask.config.set(site):
        cluster = cluster_of(kind, workers=6, **given)
        script = cluster.script(tmp_path)
        assert cluster.submission() == submission
    assert set(lines) <= set(script.splitlines())
    assert "--nworkers 3 --nanny" in script
    # A quarter of an hour is more than the five minutes of long jobs.
    assert "--lifetime 5100s" in script
    assert f"--tls-key {tmp_path}/.tls-RUN/key.pem --protocol tls://" in script
    assert not list(tmp_path.iterdir())
    assert (
        f"6 workers in 2 {type(cluster).title} jobs (3 in each), 2GB per worker" in cluster.line()
    )

    # The whole script, and that of one job of one worker, without encryption.
    with dask.config.set(site):
        more = {"workers": 1, "memory": "500MB", "walltime": "2-03:04:05", "host": "127.0.0.1"}
        other = cluster_of(kind, tls=False, **more)
        both = [script, *describe(cluster), other.script(tmp_path), *describe(other)]
    text = "\n".join(both).replace(str(tmp_path), "OUT").replace(sys.executable, "PYTHON")
    golden(f"jobs/{kind}", text)


def test_times_of_the_users_file_are_read_as_its_scheduler_does() -> None:
    told = {"slurm": 90.0, "pbs": 90.0, "lsf": 5400.0, "sge": 90.0, "oar": 5400.0}
    for kind, seconds in told.items():
        with dask.config.set({f"jobqueue.{kind}.walltime": "1:30"}):
            assert cluster_of(kind, workers=1, host="10.0.0.1").seconds() == seconds


def test_several_cores_of_grid_engine_need_the_environment_of_the_site() -> None:
    with pytest.raises(ConfigError, match="must have -pe NAME 3"):
        cluster_of("sge", workers=3, cores=3, host="10.0.0.1")


def test_machine_that_submits_no_jobs_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    with pytest.raises(MachineError, match="there is no condor_submit on the PATH"):
        cluster_of("htcondor", workers=1, host="10.0.0.1").refuse_bad_job("")
