"""Reads YAML of unknown origin without running code, and rejects text that expands too much.

An alias repeats what an anchor names. A few lines of aliases of aliases can expand to billions of
values, which fill the memory as soon as something iterates over them.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import yaml

#: Maximum number of values after aliases are expanded; 100,000 objects have fewer.
MOST_VALUES = 1_000_000


#: Maximum depth of nested brackets; settings have three. PyYAML takes seconds for a thousand.
DEEPEST = 100


class _Loader(yaml.SafeLoader):
    def fetch_flow_collection_start(self, TokenClass: type[yaml.Token]) -> None:
        if self.flow_level >= DEEPEST:
            raise yaml.YAMLError("values nested too deeply")
        super().fetch_flow_collection_start(TokenClass)


def parse_yaml(text: str | bytes) -> Any:
    """Return the content of a YAML text.

    Raises:
        yaml.YAMLError: If the text is not YAML, is nested too deeply, contains itself, has a
            repeated key, or expands to more than `MOST_VALUES` values.
    """
    loader = _Loader(text)
    try:
        node = loader.get_single_node()
        if node is None:
            return None
        _validate_size(node)
        _validate_distinct(node)
        return loader.construct_document(node)
    except RecursionError:
        raise yaml.YAMLError("values nested too deeply") from None
    except ValueError as error:
        # The text has a number of thousands of digits, or a date that does not exist.
        raise yaml.YAMLError(str(error)) from None
    finally:
        loader.dispose()


def parse_yaml_once(text: str | bytes) -> Any:
    """Return the result of `parse_yaml`, cached, for a small text that is parsed many times.

    The caller must not change the result.
    """
    return _parsed(text.encode() if isinstance(text, str) else text)


_parsed = lru_cache(maxsize=16)(parse_yaml)


def _validate_size(root: yaml.Node) -> None:
    sizes: dict[int, int] = {}

    def size(node: yaml.Node) -> int:
        """Return the number of values that a node expands to; each node is visited once."""
        if isinstance(node, yaml.ScalarNode):
            return 1
        if id(node) not in sizes:
            sizes[id(node)] = MOST_VALUES + 1  # for a node that contains itself
            sizes[id(node)] = 1 + sum(map(size, _children(node)))
        return sizes[id(node)]

    if size(root) > MOST_VALUES:
        raise yaml.YAMLError(f"aliases that stand for more than {MOST_VALUES:,} values")


def _validate_distinct(root: yaml.Node) -> None:
    """Reject a mapping with a repeated key, of which PyYAML would use the last value."""
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
