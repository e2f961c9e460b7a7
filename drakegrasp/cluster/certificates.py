"""TLS certificates of a cluster, created for one run or given by the user.

With certificates, Dask's servers and clients reject connections without one. Certificates for
processes on other machines are files that only this user can read.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from distributed.security import Security

from drakegrasp.errors import ConfigError


def make_certificates(folder: Path) -> tuple[Path, Path, Path]:
    """Write an authority, a certificate and its key as ca.pem, cert.pem and key.pem to a folder.

    Any user who can read these files can use the cluster, so the folder must be private.
    """
    security = Security.temporary()
    paths = folder / "ca.pem", folder / "cert.pem", folder / "key.pem"
    texts = security.tls_ca_file, security.tls_worker_cert, security.tls_worker_key
    for path, text in zip(paths, texts, strict=True):
        path.touch(mode=0o600)
        path.write_text(text, encoding="ascii")
    return paths


def chosen_security(
    tls: bool, files: tuple[Path, Path, Path] | None, *, elsewhere: bool
) -> Security | None:
    """Return the certificates that a caller gives; None if the caller gives none.

    Args:
        tls: Whether connections need a certificate.
        files: Authority, certificate and private key.
        elsewhere: Whether workers or scheduler are not started on this machine.

    Raises:
        ConfigError: If the choice contradicts itself.
    """
    if not tls and not elsewhere:
        raise ConfigError(
            "--no-tls (tls=False) must not be given for workers on this machine: every user of it "
            "could run programs as you"
        )
    if not tls and files is not None:
        raise ConfigError("--no-tls (tls=False) must not be given with certificates")
    return None if files is None else security_of(files)


def security_of(files: tuple[Path, Path, Path]) -> Security:
    """Return Dask's security settings, which use the same certificate for every role."""
    ca, cert, key = (str(path.absolute()) for path in files)
    options: dict[str, Any] = {"require_encryption": True, "tls_ca_file": ca}
    for role in ("client", "scheduler", "worker"):
        options |= {f"tls_{role}_cert": cert, f"tls_{role}_key": key}
    return Security(**options)


@contextmanager
def made_or_given(
    tls: bool, files: tuple[Path, Path, Path] | None, out: Path
) -> Iterator[Security | None]:
    """Yield the certificates that a caller gives, or new ones that are removed afterwards.

    Args:
        tls: Whether connections need a certificate; if not, None is yielded.
        files: Authority, certificate and private key; None for new ones.
        out: Directory that all machines see, for new ones. Those of killed clients are removed,
            because the caller holds the lock of the directory.
    """
    given = chosen_security(tls, files, elsewhere=True)
    if given is not None or not tls:
        yield given
        return
    out.mkdir(parents=True, exist_ok=True)
    for leftover in out.glob(".tls-*"):
        shutil.rmtree(leftover, ignore_errors=True)
    with TemporaryDirectory(prefix=".tls-", dir=out) as folder:  # only this user can enter it
        yield security_of(make_certificates(Path(folder)))
