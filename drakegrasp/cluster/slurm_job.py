"""A SLURM job whose script means what it says, whatever is in the names of folders.

dask-jobqueue (0.9) writes paths into the script without quotes: a blank splits them, and the shell
runs what is in `$(...)`. Import this module only where dask-jobqueue is needed: it is an extra.
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from typing import Any

from dask_jobqueue.slurm import SLURMJob
from distributed.security import Security

from drakegrasp.cluster.request import jobqueue


class QuotedJob(SLURMJob):
    """A `SLURMJob` with every path of ours in quotes.

    What the user's jobqueue.yaml says of options and of lines of the script is shell already.
    """

    def __init__(
        self,
        *arguments: Any,
        security: Security | None = None,
        worker_extra_args: Sequence[str] = (),
        python: str | None = None,
        local_directory: str | None = None,
        **options: Any,
    ) -> None:
        """Take the arguments of a `SLURMJob`."""
        folder = local_directory or jobqueue("local-directory")
        super().__init__(
            *arguments,
            # Given as `security`, the files of the certificates would not be quoted.
            worker_extra_args=[*worker_extra_args, *_tls_words(security)],
            python=shlex.quote(python or jobqueue("python") or sys.executable),
            local_directory=None if folder is None else shlex.quote(str(folder)),
            **options,
        )


def _tls_words(security: Security | None) -> list[str]:
    """Return the options of a worker that name its certificates, as words of a shell."""
    if security is None:
        return []
    files = security.get_tls_config_for_role("worker")
    words = (
        (f"--tls-{key.replace('_', '-')}", shlex.quote(str(value)))
        for key, value in files.items()
        if key != "ciphers"  # Dask has no option for them
    )
    return [word for pair in words for word in pair]
