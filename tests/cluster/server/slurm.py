"""A SLURM of one node on this machine, with its own munge; everything is in one folder."""

from __future__ import annotations

import os
import secrets
import socket
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from server.processes import daemon, free_port, wait_until

#: Name of its only partition.
PARTITION = "main"
_CONF = """\
ClusterName=test
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={controller}
SlurmdPort={node}
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
CryptoType=crypto/munge
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
MpiDefault=none
ReturnToService=2
SwitchType=switch/none
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmdParameters=config_overrides
SchedulerParameters=sched_interval=2
KillWait=5
NodeName={host} NodeAddr=127.0.0.1 CPUs=4 RealMemory=8000 State=UNKNOWN
PartitionName={partition} Nodes={host} Default=YES MaxTime=INFINITE State=UP
"""


@contextmanager
def running_slurm(folder: Path) -> Iterator[dict[str, str]]:
    """Run a SLURM while the block does; yield the environment in which its commands find it.

    Args:
        folder: For its files; short, because a socket's path may have 107 characters.
    """
    folder.chmod(0o755)
    host = socket.gethostname().partition(".")[0]
    conf = folder / "slurm.conf"
    text = _CONF.format(
        host=host, folder=folder, controller=free_port(), node=free_port(), partition=PARTITION
    )
    conf.write_text(text)
    for name in ("state", "spool"):
        (folder / name).mkdir()
    env = {**os.environ, "SLURM_CONF": str(conf)}
    with ExitStack() as stack:
        stack.enter_context(_munge(folder))
        for name, command in {
            "slurmctld": ["slurmctld", "-D", "-f", conf],
            "slurmd": ["slurmd", "-D", "-f", conf, "-N", host],
        }.items():
            stack.enter_context(daemon(command, folder / f"{name}.log", env))
        wait_until(lambda: _idle(env), "slurm", folder / "slurmctld.log")
        try:
            yield env
        finally:
            subprocess.run(["scancel", "--user=root"], env=env, capture_output=True)
            wait_until(lambda: not queued_jobs(env), "the end of all jobs", folder / "slurmd.log")


@contextmanager
def _munge(folder: Path) -> Iterator[None]:
    key, sock = folder / "munge.key", folder / "munge.socket"
    key.touch(mode=0o400)
    key.write_bytes(secrets.token_bytes(128))
    files = {"key-file": key, "socket": sock}
    files |= {f"{name}-file": folder / f"munge.{name}" for name in ("log", "pid", "seed")}
    options = [f"--{name}={path}" for name, path in files.items()]
    # It would rather not be root, but then its folder would have to be another user's.
    command = ["munged", "--foreground", "--force", *options]
    with daemon(command, folder / "munged.out"):
        wait_until(sock.exists, "munged", folder / "munged.out")
        yield


def queued_jobs(env: dict[str, str]) -> list[str]:
    """Return the numbers of the jobs that wait or run."""
    found = subprocess.run(
        ["squeue", "--noheader", "--format=%i"], env=env, capture_output=True, text=True
    )
    return found.stdout.split()


def _idle(env: dict[str, str]) -> bool:
    found = subprocess.run(
        ["sinfo", "--noheader", "--format=%t"], env=env, capture_output=True, text=True
    )
    return found.stdout.split() == ["idle"]
