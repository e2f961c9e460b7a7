"""Easing Drake's ban of the network for the few things that need none but are refused by it.

`DRAKE_ALLOW_NETWORK=none`, as our workers run, is a ban that Drake (1.51 to 1.58) applies
already when some objects are made, whether or not they would use a network.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

_VARIABLE = "DRAKE_ALLOW_NETWORK"


@contextmanager
def allow_network(kind: str) -> Iterator[None]:
    """Allow one of Drake's kinds of network use, e.g. `package_map`, while the block runs."""
    allowed = os.environ.get(_VARIABLE)
    os.environ[_VARIABLE] = kind
    try:
        yield
    finally:
        if allowed is None:
            del os.environ[_VARIABLE]
        else:
            os.environ[_VARIABLE] = allowed
