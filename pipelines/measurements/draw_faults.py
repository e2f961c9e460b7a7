"""Draw faults in the rules that decide labels, and write them as a table for `planted_faults.py`.

A fault changes one operator, number, condition, call or result in a module of nine packages: `<`
becomes `>=`, `+` becomes `-`, 0 becomes 1, `and` becomes `or`. Half of the faults are in simulation
and verification. Texts of messages and annotations stay unchanged, and so do modules that only draw
or describe. The same seed draws the same faults from the same source. The script writes YAML. The
tests of a fault are those of its module, then others of its package, then tests of other packages
that import the module. Faults that were examined and change no result are listed in
`equivalent_faults.yaml`.
"""

from __future__ import annotations

import argparse
import ast
import random
import sys
from collections import deque
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parents[2]
EQUIVALENT = Path(__file__).with_name("equivalent_faults.yaml")
#: The packages from which half of the faults are drawn, and the other packages.
JUDGES = ("simulation", "verification")
OTHERS = ("hand", "mesh", "objects", "vision", "dataset", "generation", "scoring")
#: Modules and folders that draw a picture or describe results: they decide nothing.
_TELLING = {
    *("dataset/card.py", "generation/cautions.py", "hand/files.py", "scoring/card.py"),
    *("verification/figure.py", "vision/probe_image.py"),
}
#: Maximum number of imports between a module and a test, in its package and elsewhere.
NEAR, NEAR_ELSEWHERE = 2, 1
#: Maximum number of test files for a fault.
MOST_TESTS = 16
#: An option of pytest that leaves slow tests out.
QUICK = "-mnot server and not slow"
_OPERATORS: dict[type[ast.AST], str] = {
    ast.Lt: ">=",
    ast.LtE: ">",
    ast.Gt: "<=",
    ast.GtE: "<",
    ast.Eq: "!=",
    ast.NotEq: "==",
    ast.Is: "is not",
    ast.IsNot: "is",
    ast.In: "not in",
    ast.NotIn: "in",
    ast.Add: "-",
    ast.Sub: "+",
    ast.Mult: "/",
    ast.Div: "*",
    ast.FloorDiv: "*",
    ast.Mod: "*",
    ast.BitAnd: "|",
    ast.BitOr: "&",
    ast.Pow: "*",
    ast.And: "or",
    ast.Or: "and",
}
_NAMES = {"any": "all", "all": "any", "min": "max", "max": "min", "minimum": "maximum"}
_NAMES |= {"maximum": "minimum", "argmin": "argmax", "argmax": "argmin", "floor": "ceil"}


def modules(rooms: Sequence[str]) -> list[str]:
    """Return the modules of packages in which faults are drawn, in the order of their paths."""
    found = sorted(
        path.relative_to(ROOT / "drakegrasp")
        for room in rooms
        for path in (ROOT / "drakegrasp" / room).rglob("*.py")
        if path.name != "__init__.py"
    )
    if gone := [name for name in _TELLING if not (ROOT / "drakegrasp" / name).exists()]:
        sys.exit(f"modules that tell must be there, got none for {', '.join(sorted(gone))}")
    telling = [p for p in found if {str(p), *map(str, p.parents)} & _TELLING]
    return [f"drakegrasp/{path}" for path in found if path not in telling]


@cache
def _imports(name: str) -> frozenset[str]:
    """Return the files of the package that a file imports directly."""
    named: set[str] = set()
    for node in ast.walk(ast.parse((ROOT / name).read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            named |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Import):
            named |= {alias.name for alias in node.names}
    own = (f"{n.replace('.', '/')}.py" for n in named if n.startswith("drakegrasp."))
    return frozenset(path for path in own if (ROOT / path).is_file())


@cache
def _distances(test: str) -> dict[str, int]:
    """Return how many modules lie between a test and each module that the test needs."""
    distances: dict[str, int] = {}
    due = deque((path, 0) for path in sorted(_imports(test)))
    while due:
        path, distance = due.popleft()
        if path not in distances:
            distances[path] = distance
            due.extend((below, distance + 1) for below in sorted(_imports(path)))
    return distances


def tests_of(name: str) -> list[str]:
    """Return the test files that must notice a fault of a module, the nearest first."""
    room, stem = name.split("/")[1], Path(name).stem
    ranked = []
    for path in sorted((ROOT / "tests").rglob("test_*.py")):
        test = str(path.relative_to(ROOT))
        distance = _distances(test).get(name, sys.maxsize)
        inside = path.relative_to(ROOT).parts[1] == room
        if distance <= (NEAR if inside else NEAR_ELSEWHERE):
            ranked.append((stem not in path.stem, not inside, distance, test))
    return [test for *_, test in sorted(ranked)][:MOST_TESTS]


def faults_of(name: str) -> Iterator[dict[str, object]]:
    """Yield every fault of a module as a table entry, in the order of the source text."""
    text = (ROOT / name).read_text(encoding="utf-8")
    tests = tests_of(name)
    tree = ast.parse(text)
    lines = text.splitlines(keepends=True)
    for node in _deciding(tree):
        for new in _changes(node, text):
            first, last = node.lineno - 1, (node.end_lineno or node.lineno) - 1
            head = lines[first].encode()[: node.col_offset].decode()
            tail = lines[last].encode()[node.end_col_offset or 0 :].decode()
            yield {
                "fault": f"line {node.lineno}: {ast.get_source_segment(text, node)} -> {new}",
                "file": name,
                "line": node.lineno,
                "old": "".join(lines[first : last + 1]),
                "new": f"{head}{new}{tail}",
                "tests": [*tests, QUICK],
            }


def _deciding(node: ast.AST) -> Iterator[ast.expr | ast.stmt]:
    """Yield the nodes of a tree that may have a fault; annotations and texts are left out."""
    for field, value in ast.iter_fields(node):
        if field in ("annotation", "returns", "decorator_list"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.JoinedStr | ast.Raise | ast.Assert | ast.Import):
                continue
            if isinstance(child, ast.ImportFrom) or not isinstance(child, ast.AST):
                continue
            if isinstance(child, ast.expr | ast.stmt):
                yield child
            yield from _deciding(child)


def _changes(node: ast.AST, text: str) -> Iterator[str]:
    """Yield the texts with which faults replace a node."""

    def own(part: ast.AST) -> str:
        return ast.get_source_segment(text, part) or ""

    match node:
        case ast.Constant(value=bool()):
            yield str(not node.value)
        case ast.Constant(value=int() | float()):
            yield "1" if node.value == 0 else "0" if node.value == 1 else f"(2 * {own(node)})"
        case ast.Compare(ops=[operator], comparators=[right]):
            yield f"({own(node.left)}) {_OPERATORS[type(operator)]} ({own(right)})"
        case ast.BinOp() if type(node.op) in _OPERATORS:
            yield f"({own(node.left)}) {_OPERATORS[type(node.op)]} ({own(node.right)})"
        case ast.BoolOp():
            yield f" {_OPERATORS[type(node.op)]} ".join(f"({own(v)})" for v in node.values)
        case ast.UnaryOp(op=ast.Not() | ast.Invert() | ast.USub()):
            yield f"({own(node.operand)})"
        case ast.IfExp():
            yield f"({own(node.body)}) if not ({own(node.test)}) else ({own(node.orelse)})"
        case ast.Attribute() if node.attr in _NAMES:
            yield f"({own(node.value)}).{_NAMES[node.attr]}"
        case ast.Name() if node.id in _NAMES:
            yield _NAMES[node.id]
        case ast.Expr(value=ast.Call()):
            yield "pass"
        case ast.Return(value=ast.expr()):
            yield "return None"
        case ast.Break() | ast.Continue():
            yield "pass"


def name_equivalent(faults: Sequence[dict[str, object]]) -> None:
    """Add to faults why they change no result, if somebody has examined them."""
    known = {(e["file"], e["new"]): e["why"] for e in yaml.safe_load(EQUIVALENT.read_text())}
    for fault in faults:
        if why := known.get((fault["file"], str(fault["new"]).strip())):
            fault["equivalent"] = why


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; return its exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=150, help="number of faults (default: 150)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the random draw (default: 0)")
    arguments = parser.parse_args(argv)
    drawn, stream = [], random.Random(arguments.seed)
    for rooms, count in ((JUDGES, (arguments.count + 1) // 2), (OTHERS, arguments.count // 2)):
        every = [fault for name in modules(rooms) for fault in faults_of(name)]
        drawn += stream.sample(every, count)
        sys.stderr.write(f"{count} of {len(every)} faults in {', '.join(rooms)}\n")
    name_equivalent(drawn)
    yaml.safe_dump(drawn, sys.stdout, sort_keys=False, allow_unicode=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
