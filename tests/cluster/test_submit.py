"""`pipelines/submit_build.py` and the clusters that it starts on this machine."""

from __future__ import annotations

import ast
import asyncio
import gc
import os
import stat
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import dask
import psutil
import pytest
from distributed import Client, rpc
from distributed.security import Security
from helpers import commands
from helpers.assertions import assert_same_dataset
from helpers.builds import build
from helpers.commands import Result
from helpers.commands import run as run_command
from helpers.meshes import write_fixed
from helpers.scripts import PIPELINES, load_script
from server.processes import dask_scheduler

import drakegrasp
from drakegrasp import registry
from drakegrasp.cluster.connect import WORKER_ENVIRONMENT, connect, made_or_given, make_certificates
from drakegrasp.cluster.kinds import Jobs, Local, cluster_of
from drakegrasp.cluster.worker_checks import checked_workers
from drakegrasp.errors import ConfigError, MachineError
from drakegrasp.hand.settings import load_config

#: A build of a few seconds.
TINY = ["candidates.max=8", "unit_candidates=4"]
TINY_OPTIONS = ["--candidates", "8", "--set", "unit_candidates=4"]
#: Options that give files as certificates.
OWN = ["--tls-ca-file", __file__, "--tls-cert", __file__, "--tls-key", __file__]


def run(*arguments: str | Path) -> Result:
    return run_command(*arguments, command=load_script("submit_build").main)


def dry_run(out: Path, *arguments: str | Path) -> Result:
    return run("--objects", "builtin", "--out", out, *arguments, "--dry-run")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--workers", "3"], "3 workers on this machine"),
        (["--scheduler", "tls://a:1"], "the workers of tls://a:1"),
        (["--scheduler-file", "a.json"], "the workers of a.json"),
        (["--cluster", "slurm", "--workers", "3"], "3 workers in 3 slurm jobs (1 in each)"),
    ],
)
def test_dry_run_says_what_would_run_and_makes_nothing(
    tmp_path: Path, arguments: list[str], words: str
) -> None:
    out = tmp_path / "out"
    result = dry_run(out, *arguments)
    assert result.exit_code == 0, result.output
    assert words in result.stdout
    work = commands.run("build", "--objects", "builtin", "--out", out, "--dry-run").stdout
    assert "128 objects: until 20 samples of each" in work and work in result.stdout
    assert not out.exists()


def test_open_port_is_warned_of(tmp_path: Path) -> None:
    jobs = ["--cluster", "slurm", "--workers", "1"]
    said = dry_run(tmp_path / "out", *jobs, "--no-tls").stdout
    assert "connections: not encrypted" in said
    assert "can run programs as you" in said
    for given in (jobs, [*jobs, "--tls"], ["--workers", "1"]):
        said = dry_run(tmp_path / "out", *given).stdout
        assert "connections: TLS" in said
        assert "warning" not in said


@pytest.mark.parametrize("choice", ["made", "own", "none"])
def test_workers_elsewhere_need_a_certificate_unless_told_otherwise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, choice: str
) -> None:
    own = make_certificates(tmp_path) if choice == "own" else None

    def start(_: object, security: Security | None) -> None:
        if choice == "none":
            assert security is None
        else:
            assert security is not None
            assert security.require_encryption
            kept = (tmp_path / "ca.pem") if own else next((tmp_path / "out").glob(".tls-*/ca.pem"))
            assert security.tls_ca_file == str(kept)
        raise MachineError("started")

    monkeypatch.setattr(Jobs, "_start", start)
    cluster = cluster_of("slurm", workers=1, tls=choice != "none", tls_files=own)
    with pytest.raises(MachineError, match="started"), cluster.connected(tmp_path / "out"):
        pass
    assert not list(tmp_path.glob("out/.tls-*"))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--workers", "0"], "workers must be at least 1, got 0"),
        (["--cluster", "moab"], "error: clusters must be one of local, slurm, pbs"),
        (["--scheduler", "tls://a:1", "--cluster", "slurm"], "--scheduler must be used without"),
        (["--scheduler", "tls://a:1", "--workers", "2"], "--workers must not be given"),
        (["--scheduler", "tcp://a:1"], "must have an address that begins with tls://"),
        (["--scheduler", "x", "--no-tls", *OWN], "must not be given with certificates"),
        (["--with", "image=x"], "--with must be left out for --cluster local, got 'image=x'"),
        (["--cluster", "local", "--walltime", "1:00:00"], "--walltime must not be given"),
        (["--cluster", "slurm"], "--workers must be given"),
        (["--tls-cert", __file__], "must be given together"),
        (["--no-tls"], "must not be given for workers on this machine"),
        (["--set", "lift.speed=1"], "lift.speed: must be a known key"),
    ],
)
def test_bad_options_are_one_line_and_make_nothing(
    tmp_path: Path, arguments: list[str], words: str
) -> None:
    out = tmp_path / "out"
    result = dry_run(out, *arguments)
    assert result.exit_code == 2, result.output
    (line,) = result.stderr.splitlines()
    assert line.startswith("error: ")
    assert words in line
    assert not out.exists()


def test_kind_of_another_package_has_settings_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    class Pods(Local):
        settings = ("image",)

    monkeypatch.setattr(registry, "find", lambda *_: Pods)
    assert cluster_of("pods", ["image=a;b=$(c)"]).own == {"image": "a;b=$(c)"}
    for text in ("size=1", "image=", "image", "workers=2"):
        with pytest.raises(ConfigError) as told:
            cluster_of("pods", [text])
        assert f"must be KEY=VALUE with KEY one of image for --cluster pods, got {text!r}" in str(
            told.value
        )


def test_keys_are_private_and_removed(tmp_path: Path) -> None:
    dead = tmp_path / ".tls-dead"  # of a client that was killed
    dead.mkdir()
    make_certificates(dead)
    with made_or_given(True, None, tmp_path) as security:
        assert security is not None
        (folder,) = tmp_path.iterdir()
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700
        assert {stat.S_IMODE(path.stat().st_mode) for path in folder.iterdir()} == {0o600}
        assert security.tls_ca_file == str(folder / "ca.pem")
    assert not list(tmp_path.iterdir())


def test_nothing_that_is_read_can_run() -> None:
    """No pickles from the disk, and YAML only by its safe loader."""
    package = Path(drakegrasp.__file__).parent
    # Makes arrays and plain values alone, see tests/runtime/test_plain_pickle.py.
    plain = {package / "runtime" / "plain_pickle.py"}
    # What Dask sends between client and worker is a pickle anyway; these two read no file.
    sent = {package / "cluster" / name for name in ("wire.py", "apart.py")}
    for path in set(package.rglob("*.py")) - plain - sent:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import | ast.ImportFrom):
                names = {getattr(node, "module", None), *(alias.name for alias in node.names)}
                assert not names & {"pickle", "cloudpickle", "joblib", "marshal"}, path
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                name = f"{node.value.id}.{node.attr}"
                assert name not in ("yaml.load", "yaml.full_load", "yaml.unsafe_load"), path
            if isinstance(node, ast.keyword) and node.arg == "allow_pickle":
                assert isinstance(node.value, ast.Constant) and node.value.value is False, path


@pytest.fixture
def local() -> Iterator[Client]:
    """Workers on this machine, as a build without options starts them; one of them."""
    with connect(workers=1) as client:
        yield client


def addresses(client: Client) -> list[str]:
    """Return the addresses of the scheduler, and of the only worker and its nanny."""
    ((worker, about),) = client.scheduler_info()["workers"].items()
    return [client.scheduler.address, worker, about["nanny"]]


@pytest.mark.cluster
@pytest.mark.slow
def test_scheduler_with_tls_refuses_a_client_without_a_certificate(
    local: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("drakegrasp.cluster.connect.CONNECT_SECONDS", 2)
    address = local.scheduler.address
    # The garbage collector must not be needed: it may run while another client starts.
    gc.collect()
    gc.disable()
    try:
        for other in (address, address.replace("tls://", "tcp://")):
            with (
                pytest.raises(MachineError, match="must be a running Dask scheduler"),
                connect(scheduler=other, tls=other == address),
            ):
                pass
        clients = [o for o in gc.get_objects() if issubclass(type(o), Client)]
    finally:
        gc.enable()
    assert [client for client in clients if client.status != "closed"] == [local]
    assert local.submit(int, 7).result() == 7


def ask(address: str, security: Security) -> None:
    """Ask a process of a cluster what it is; raise an OSError if it does not answer."""

    async def identity() -> None:
        process = rpc(address, connection_args=security.get_connection_args("client"), timeout=2)
        try:
            await asyncio.wait_for(process.identity(), 5)
        finally:
            await process.close_rpc()

    asyncio.run(identity())


@pytest.mark.cluster
@pytest.mark.slow
def test_nobody_without_the_certificate_reaches_a_process_of_this_machine(local: Client) -> None:
    for address in addresses(local):
        ask(address, local.security)
        with pytest.raises(OSError):
            ask(address, Security.temporary())
        with pytest.raises(OSError):
            ask(address.replace("tls://", "tcp://"), Security())


@pytest.mark.cluster
@pytest.mark.slow
def test_only_the_loopback_address_is_listened_on_and_not_for_http(local: Client) -> None:
    listening = [
        f"tls://{connection.laddr.ip}:{connection.laddr.port}"
        for process in (psutil.Process(), *psutil.Process().children(recursive=True))
        for connection in process.net_connections("tcp")
        if connection.status == psutil.CONN_LISTEN
    ]
    assert sorted(listening) == sorted(addresses(local))
    assert all(address.startswith("tls://127.0.0.1:") for address in listening)


@pytest.mark.nightly
@pytest.mark.cluster
@pytest.mark.slow
def test_running_scheduler_and_its_workers_are_set_up(tmp_path: Path) -> None:
    """Whoever started them: saturation, environment; and a late worker of two threads goes."""

    # Other processes cannot import this module, so what they run is defined here.
    def saturation(dask_scheduler: Any) -> float:
        return float(dask_scheduler.WORKER_SATURATION)

    names = list(WORKER_ENVIRONMENT)

    def environment() -> dict[str, str | None]:
        return {name: os.environ.get(name) for name in names}

    plain = {k: v for k, v in os.environ.items() if k not in WORKER_ENVIRONMENT}
    files = make_certificates(tmp_path)
    given = zip(("ca-file", "cert", "key"), map(str, files), strict=True)
    tls = [word for name, path in given for word in (f"--tls-{name}", path)]
    with (
        dask_scheduler(tmp_path, *tls, "--protocol", "tls", env=plain) as (_, join),
        connect(scheduler_file=tmp_path / "scheduler.json", tls_files=files) as client,
    ):
        client.wait_for_workers(1, timeout=60)
        with checked_workers(client, load_config()):
            assert client.run_on_scheduler(saturation) == 1.0
            ((address, found),) = client.run(environment).items()
            assert found == WORKER_ENVIRONMENT
            late = [*join, "--nthreads", "2"]
            refused = subprocess.run(late, env=plain, stderr=subprocess.PIPE, timeout=120)
            assert b"drakegrasp-unfit" in refused.stderr
            assert list(client.nthreads()) == [address]


@pytest.mark.nightly
@pytest.mark.cluster
@pytest.mark.sim
@pytest.mark.slow
def test_script_builds_what_a_plain_loop_builds(tmp_path: Path) -> None:
    box = tmp_path / "box"
    write_fixed(box, "10_box_tall")
    build(box, tmp_path / "here", load_config(overrides=TINY))
    command = [sys.executable, PIPELINES / "submit_build.py", "--objects", box, *TINY_OPTIONS]
    out, defaults = tmp_path / "out", tmp_path / "defaults.yaml"
    defaults.write_text("seed: 0\n")
    options = ["--out", out, "--workers", "1", "--memory", "2GB", "--config", defaults]
    result = subprocess.run([*command, *options], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert "2 work units simulated" in result.stdout
    assert "connections: TLS" in result.stdout
    assert "dashboard: " not in result.stderr
    assert_same_dataset(tmp_path / "here", out)
    assert dask.config.get("distributed.worker.profile.enabled") is True  # and nothing is left set
