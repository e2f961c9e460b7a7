"""YAML of unknown origin: read without running anything, and refused if it grows.

An alias repeats what an anchor names. A few lines of aliases of aliases stand for billions of
values, which fill the memory as soon as something walks through them.
"""

from __future__ import annotations

from typing import Any

import yaml

#: Values that a text may stand for, its aliases written out; 100,000 objects have fewer.
MOST_VALUES = 1_000_000


def parse_yaml(text: str | bytes) -> Any:
    """Return the content of a YAML text.

    Raises:
        yaml.YAMLError: If it is no YAML, is nested too deeply, contains itself, or stands for more
            than `MOST_VALUES` values.
    """
    loader = yaml.SafeLoader(text)
    try:
        node = loader.get_single_node()
        if node is None:
            return None
        _refuse_large(node)
        return loader.construct_document(node)
    except RecursionError:
        raise yaml.YAMLError("values nested too deeply") from None
    finally:
        loader.dispose()


def _refuse_large(root: yaml.Node) -> None:
    sizes: dict[int, int] = {}

    def size(node: yaml.Node) -> int:
        """Return the number of values that a node stands for; each node is looked at once."""
        if isinstance(node, yaml.ScalarNode):
            return 1
        if id(node) not in sizes:
            sizes[id(node)] = MOST_VALUES + 1  # of a node that contains itself
            sizes[id(node)] = 1 + sum(map(size, _children(node)))
        return sizes[id(node)]

    if size(root) > MOST_VALUES:
        raise yaml.YAMLError(f"aliases that stand for more than {MOST_VALUES:,} values")


def _children(node: yaml.Node) -> list[yaml.Node]:
    if isinstance(node, yaml.MappingNode):
        return [part for pair in node.value for part in pair]
    return list(node.value)
