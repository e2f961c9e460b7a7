"""The script of a SLURM job, whatever is in the names of folders."""

from __future__ import annotations

import json
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import pytest

from drakegrasp.cluster.certificates import security_of

pytest.importorskip("dask_jobqueue")

from drakegrasp.cluster.slurm_job import QuotedJob


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
