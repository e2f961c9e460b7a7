"""The signatures of all public functions and methods, compared with a stored text.

A default that changes is a change for everybody who calls the package; see `helpers/golden.py`.
"""

from __future__ import annotations

import inspect
from enum import Enum
from typing import Any

from helpers.golden import Golden

import drakegrasp


def signatures(name: str, found: Any) -> list[str]:
    """Return the names of parameters with their defaults, of a function or of a class's methods."""
    if not inspect.isclass(found):
        kinds = {inspect.Parameter.VAR_POSITIONAL: "*", inspect.Parameter.VAR_KEYWORD: "**"}
        words = []
        for each in inspect.signature(found).parameters.values():
            value = getattr(each.default, "__qualname__", repr(each.default))
            default = "" if each.default is each.empty else f"={value}"
            words.append(f"{kinds.get(each.kind, '')}{each.name}{default}")
        return [f"{name}({', '.join(words)})"]
    if issubclass(found, Enum):
        return [f"{name}: {', '.join(f'{each.name}={each.value}' for each in found)}"]
    if issubclass(found, Exception):
        return [f"{name}: {', '.join(base.__name__ for base in found.__mro__[1:-2])}"]
    own = {k: v for k, v in vars(found).items() if inspect.isfunction(v) and k[:1] != "_"}
    return [
        *(signatures(name, found.__init__) if inspect.isfunction(found.__init__) else []),
        *(line for key, method in own.items() for line in signatures(f"{name}.{key}", method)),
    ]


def test_signatures(golden: Golden) -> None:
    lines = [signatures(name, getattr(drakegrasp, name)) for name in drakegrasp.__all__]
    golden("api/signatures", "\n".join(line for found in lines for line in found))
