"""An sshd on this machine with its own port, keys and configuration, all in one folder."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from server.processes import accepts, daemon, free_port, wait_until

#: Where sshd insists on an empty directory.
_PRIVSEP = Path("/run/sshd")


@contextmanager
def running_sshd(folder: Path) -> Iterator[dict[str, str]]:
    """Run an sshd while the block does; yield the environment in which a client finds it.

    Its HOME has the client's key, the host's key and the port.
    """
    port, client = free_port(), folder / "home" / ".ssh"
    client.mkdir(parents=True, mode=0o700)
    host_key, key = folder / "host_key", client / "id_ed25519"
    for path in (host_key, key):
        _make_key(path)
    authorized = folder / "authorized_keys"
    authorized.write_text(_public(key))
    (folder / "sshd_config").write_text(
        f"Port {port}\nListenAddress 127.0.0.1\nHostKey {host_key}\nPidFile none\n"
        f"AuthorizedKeysFile {authorized}\nStrictModes no\nUsePAM no\n"
        "PasswordAuthentication no\nPermitRootLogin prohibit-password\n"
    )
    (client / "config").write_text(f"Host 127.0.0.1\n  Port {port}\n  IdentityFile {key}\n")
    (client / "known_hosts").write_text(f"[127.0.0.1]:{port} {_public(host_key)}")
    made = not _PRIVSEP.exists()
    _PRIVSEP.mkdir(mode=0o755, exist_ok=True)
    command = ["/usr/sbin/sshd", "-D", "-e", "-f", folder / "sshd_config"]
    try:
        with daemon(command, folder / "sshd.log"):
            wait_until(lambda: accepts(port), "sshd", folder / "sshd.log")
            yield {**os.environ, "HOME": str(folder / "home")}
    finally:
        if made:
            _PRIVSEP.rmdir()


def _make_key(path: Path) -> None:
    subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(path)], check=True)


def _public(path: Path) -> str:
    return path.with_name(f"{path.name}.pub").read_text()
