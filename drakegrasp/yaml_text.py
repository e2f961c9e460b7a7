"""YAML of unknown origin: read without running anything, and refused if it grows.

An alias repeats what an anchor names. A few lines of aliases of aliases stand for billions of
values, which fill the memory as soon as something walks through them.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import yaml

#: Values that a text may stand for, its aliases written out; 100,000 objects have fewer.
MOST_VALUES = 1_000_000


#: Brackets within each other; settings have three. PyYAML takes seconds for a thousand.
DEEPEST = 100


class _Loader(yaml.SafeLoader):
    def fetch_flow_collection_start(self, TokenClass: type[yaml.Token]) -> None:
        if self.flow_level >= DEEPEST:
            raise yaml.YAMLError("values nested too deeply")
        super().fetch_flow_collection_start(TokenClass)


def parse_yaml(text: str | bytes) -> Any:
    """Return the content of a YAML text.

    Raises:
        yaml.YAMLError: If it is no YAML, is nested too deeply, contains itself, has a key twice, or
            stands for more than `MOST_VALUES` values.
    """
    loader = _Loader(text)
    try:
        node = loader.get_single_node()
        if node is None:
            return None
        _refuse_large(node)
        _refuse_twins(node)
        return loader.construct_document(node)
    except RecursionError:
        raise yaml.YAMLError("values nested too deeply") from None
    except ValueError as error:
        # A number of thousands of digits, or a date that no calendar has.
        raise yaml.YAMLError(str(error)) from None
    finally:
        loader.dispose()


def parse_yaml_once(text: str | bytes) -> Any:
    """Return what `parse_yaml` does, for a small text that a process parses again and again.

    The caller must not change it.
    """
    return _parsed(text.encode() if isinstance(text, str) else text)


_parsed = lru_cache(maxsize=16)(parse_yaml)


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


def _refuse_twins(root: yaml.Node) -> None:
    """Refuse a mapping with a key twice, of which PyYAML would take the last."""
    nodes, seen = [root], set()
    while nodes:
        node = nodes.pop()
        if id(node) in seen or isinstance(node, yaml.ScalarNode):
            continue
        seen.add(id(node))
        nodes += _children(node)
        keys = [
            key.value
            for key, _ in (node.value if isinstance(node, yaml.MappingNode) else ())
            if isinstance(key, yaml.ScalarNode) and key.tag != "tag:yaml.org,2002:merge"
        ]
        if len(set(keys)) < len(keys):
            twice = next(key for key in keys if keys.count(key) > 1)
            raise yaml.YAMLError(f"the key {twice!r} twice{str(node.start_mark).rstrip()}")


def _children(node: yaml.Node) -> list[yaml.Node]:
    if isinstance(node, yaml.MappingNode):
        return [part for pair in node.value for part in pair]
    return list(node.value)
