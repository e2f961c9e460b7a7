"""The script of a SLURM job, whatever is in the names of folders."""

from __future__ import annotations

import json
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import pytest

from drakegrasp.cluster.certificates import security_of
from drakegrasp.cluster.connect import dask_settings
from drakegrasp.errors import MachineError

pytest.importorskip("dask_jobqueue")

from drakegrasp.cluster import slurm
from drakegrasp.cluster.slurm import QuotedJob, Slurm


def test_paths_in_a_job_script_are_words_and_nothing_of_them_runs(tmp_path: Path) -> None:
    folder = tmp_path / "a b $(touch ran) 'c' \"d\" `touch ran`"
    folder.mkdir()
    python = folder / "python"
    python.write_text(
        f"#!{sys.executable}\nimport json, sys\n"
        f"json.dump(sys.argv[1:], open({str(tmp_path / 'words')!r}, 'w'))\n"
    )
    python.chmod(0o755)
    files = folder / "ca.pem", folder / "cert.pem", folder / "key.pem"
    script = QuotedJob(
        scheduler="tls://10.0.0.1:8786",
        name="worker",
        cores=1,
        memory="1GB",
        python=str(python),
        local_directory=str(folder / "local"),
        worker_extra_args=["--lifetime", "60s"],
        security=security_of(files),
    ).job_script()
    subprocess.run(["bash", "-c", script], cwd=tmp_path, check=True, timeout=120)
    words = json.loads((tmp_path / "words").read_text())
    said = dict(pairwise(words))
    assert said["--local-directory"] == str(folder / "local")
    assert [said[f"--tls-{key}"] for key in ("ca-file", "cert", "key")] == list(map(str, files))
    assert said["--lifetime"] == "60s"
    assert not list(tmp_path.rglob("ran"))


def test_job_has_the_memory_of_all_its_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    """SLURM reads it: three workers of 2 GB in a job of three cores."""
    scripts: list[str] = []

    def refuse(script: str) -> None:
        scripts.append(script)
        raise MachineError("no SLURM here")

    monkeypatch.setattr(slurm, "_refuse_bad_job", refuse)
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
