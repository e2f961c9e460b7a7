"""Measure how fast the parts of the package are, and how much memory they need.

\b
    python pipelines/measurements/speed.py COMMAND ...

Each command prints JSON. Wall-clock times need an idle machine; on a busy machine the CPU seconds
are more reliable, if they are printed.
"""  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)

from __future__ import annotations

import attempt_phases
import build_overhead
import click
import inspect_speed
import loader_speed
import prepare_memory
import scene_speed
import verify_speed
import wire_bytes
import worker_memory

COMMANDS = {
    "build": build_overhead,
    "loader": loader_speed,
    "page": inspect_speed,
    "phases": attempt_phases,
    "prepare": prepare_memory,
    "scenes": scene_speed,
    "verdicts": verify_speed,
    "wire": wire_bytes,
    "worker": worker_memory,
}

main = click.Group(help=__doc__, commands={name: of.main for name, of in COMMANDS.items()})

if __name__ == "__main__":
    main()
