"""Draw faults over all rooms of the package, and write them as a table for `planted_faults.py`.

A fault changes one expression or statement of a module. Its kind is one of

- bound: `<` becomes `<=`, `>=` becomes `>`;
- swapped: two neighbouring positional arguments of a call change places;
- branch: the body of an `if` without `else` never runs, or `a if c else b` takes the wrong value;
- unit: a factor such as 1e3 becomes 1, `np.deg2rad(x)` becomes `x`;
- frame: `invert_pose(X)` becomes `X`, `multiply(A, B)` becomes `multiply(B, A)`, `A.T` becomes `A`;
- operator: `<` becomes `>=`, `+` becomes `-`, `and` becomes `or`, `min` becomes `max`;
- number: 0 becomes 1, 5 becomes 10, `True` becomes `False`;
- result: a function returns None, or a call that is a statement is left out.

Each room gets equally many faults. In a room first the kind is drawn, then the fault, so that rare
kinds are as frequent as common ones. Texts of messages and annotations stay unchanged, and so do
the numbers of pages and pictures, which are layout. The same seed draws the same faults from the
same source. The tests of a fault are those of its module, then others of its room, then tests of
other rooms that import the module or a user of it, then those of the whole package. Faults that
were examined and change no result are listed in `equivalent_faults.yaml`; they are not drawn.
"""

from __future__ import annotations

import argparse
import ast
import random
import sys
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from itertools import islice, pairwise, zip_longest
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parents[2]
EQUIVALENT = Path(__file__).with_name("equivalent_faults.yaml")
#: The room of the modules that lie directly in the package.
ROOT_ROOM = "drakegrasp"
#: Rooms that draw: their numbers are widths, margins and colours.
LAYOUT = ("page", "pictures")
#: Maximum number of modules between a module and a test of another room that needs it.
NEAR = 1
#: Maximum number of test files of a module, beside those of the whole package.
MOST_TESTS = 16
#: Tests of what comes out of all rooms.
WHOLE = ("tests/test_numbers.py", "tests/test_pins.py", "tests/test_equal_draws.py")
#: An option of pytest that selects the tests that `make test` runs.
FIRST_TIER = "-mnot server and not nightly and not browser"
_BOUNDS: dict[type[ast.AST], str] = {ast.Lt: "<=", ast.LtE: "<", ast.Gt: ">=", ast.GtE: ">"}
_UNITS = {1e-9, 1e-6, 1e-3, 1e-2, 1e2, 1e3, 1e6, 1e9}
_ANGLES = {"deg2rad", "rad2deg", "radians", "degrees"}
_INVERSES = {"invert_pose", "inv"}
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


#: Kind of a change, the node that is replaced, and its new text.
_Change = tuple[str, ast.expr | ast.stmt, str]
_Text = Callable[[ast.expr | ast.stmt | ast.keyword], str]


def rooms() -> list[str]:
    """Return the names of the rooms that have modules."""
    folders = (ROOT / "drakegrasp").iterdir()
    return [ROOT_ROOM, *sorted(path.name for path in folders if any(path.glob("*.py")))]


def modules(room: str) -> list[str]:
    """Return the modules of a room in the order of their paths."""
    folder = ROOT / "drakegrasp"
    found = folder.glob("*.py") if room == ROOT_ROOM else (folder / room).rglob("*.py")
    return sorted(str(path.relative_to(ROOT)) for path in found if path.name != "__init__.py")


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
    folder, stem = Path(name).parts[1:-1][:1], Path(name).stem
    ranked = []
    for path in sorted((ROOT / "tests").rglob("test_*.py")):
        test = str(path.relative_to(ROOT))
        distance = _distances(test).get(name, sys.maxsize)
        inside = path.relative_to(ROOT).parts[1:-1][:1] == folder
        if inside or distance <= NEAR:
            ranked.append((stem not in path.stem, not inside, distance, test))
    return [test for *_, test in sorted(ranked)][:MOST_TESTS]


def faults_of(name: str) -> Iterator[dict[str, object]]:
    """Yield every fault of a module as a table entry, in the order of the source text."""
    text = (ROOT / name).read_text(encoding="utf-8")
    lines = text.encode().splitlines(keepends=True)
    tests = tests_of(name)

    def own(node: ast.expr | ast.stmt | ast.keyword) -> str:
        """Return the text of a node; `ast.get_source_segment` would split the file each time."""
        last = (node.end_lineno or node.lineno) - 1
        end = sum(map(len, lines[node.lineno - 1 : last])) + (node.end_col_offset or 0)
        return b"".join(lines[node.lineno - 1 : last + 1])[node.col_offset : end].decode()

    for above in _deciding(ast.parse(text)):
        for kind, node, new in _changes(above, own):
            first, last = node.lineno - 1, (node.end_lineno or node.lineno) - 1
            head = lines[first][: node.col_offset].decode()
            tail = lines[last][node.end_col_offset or 0 :].decode()
            yield {
                "fault": f"line {node.lineno}: {own(node)} -> {new}",
                "kind": kind,
                "file": name,
                "line": node.lineno,
                "old": b"".join(lines[first : last + 1]).decode(),
                "new": f"{head}{new}{tail}",
                "tests": [*dict.fromkeys((*tests, *WHOLE)), FIRST_TIER],
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


def _changes(node: ast.expr | ast.stmt, own: _Text) -> Iterator[_Change]:
    """Yield the changes of a node; `own` returns the text of a node."""
    match node:
        case ast.Constant(value=bool()):
            yield "number", node, str(not node.value)
        case ast.Constant(value=int() | float()) if node.value in _UNITS:
            yield "unit", node, "1"
        case ast.Constant(value=int() | float()):
            new = "1" if node.value == 0 else "0" if node.value == 1 else f"(2 * {own(node)})"
            yield "number", node, new
        case ast.Compare(ops=[operator], comparators=[right]):
            left = own(node.left)
            if type(operator) in _BOUNDS:
                yield "bound", node, f"({left}) {_BOUNDS[type(operator)]} ({own(right)})"
            yield "operator", node, f"({left}) {_OPERATORS[type(operator)]} ({own(right)})"
        case ast.BinOp(op=ast.MatMult()):
            yield "frame", node, f"({own(node.right)}) @ ({own(node.left)})"
        case ast.BinOp() if type(node.op) in _OPERATORS:
            new = _OPERATORS[type(node.op)]
            yield "operator", node, f"({own(node.left)}) {new} ({own(node.right)})"
        case ast.BoolOp():
            new = f" {_OPERATORS[type(node.op)]} ".join(f"({own(v)})" for v in node.values)
            yield "operator", node, new
        case ast.UnaryOp(op=ast.Not() | ast.Invert() | ast.USub()):
            yield "operator", node, f"({own(node.operand)})"
        case ast.If(orelse=[]) if own(node.test) != "TYPE_CHECKING":
            yield "branch", node.test, "False"
        case ast.IfExp():
            new = f"({own(node.body)}) if not ({own(node.test)}) else ({own(node.orelse)})"
            yield "branch", node, new
        case ast.Attribute(attr="T"):
            yield "frame", node, f"({own(node.value)})"
        case ast.Attribute() if node.attr in _NAMES:
            yield "operator", node, f"({own(node.value)}).{_NAMES[node.attr]}"
        case ast.Name() if node.id in _NAMES:
            yield "operator", node, _NAMES[node.id]
        case ast.Call():
            yield from _changes_of_call(node, own)
        case ast.Expr(value=ast.Call()):
            yield "result", node, "pass"
        case ast.Return(value=ast.expr()):
            yield "result", node, "return None"
        case ast.Break() | ast.Continue():
            yield "result", node, "pass"


def _changes_of_call(node: ast.Call, own: _Text) -> Iterator[_Change]:
    """Yield the changes of a call; `own` returns the text of a node."""
    called = own(node.func).rpartition(".")[2]
    arguments = [own(argument) for argument in node.args]
    if len(arguments) == 1 and called in _ANGLES:
        yield "unit", node, f"({arguments[0]})"
    if len(arguments) == 1 and called in _INVERSES:
        yield "frame", node, f"({arguments[0]})"
    for i, (first, second) in enumerate(pairwise(arguments)):
        if first == second or called == "isinstance" or "*" in (first[0], second[0]):
            continue
        given = [*arguments[:i], second, first, *arguments[i + 2 :], *map(own, node.keywords)]
        kind = "frame" if called == "multiply" else "swapped"
        yield kind, node, f"{own(node.func)}({', '.join(given)})"


@cache
def equivalent_faults() -> frozenset[tuple[str, str, str]]:
    """Return the file, the old and the new line of each fault that is known to change no result.

    Raises:
        ValueError: If an entry is not of exactly one fault, because the source has changed.
    """
    found = list[tuple[str, str, str]]()
    for entry in yaml.safe_load(EQUIVALENT.read_text(encoding="utf-8")):
        file, old, new = entry["file"], entry.get("old"), entry["new"]
        known = {_lines(fault) for fault in faults_of(file)}
        same = [each for each in known if each[2] == new and old in (None, each[1])]
        if len(same) != 1:
            must = f"{EQUIVALENT.name}: {file} must have one fault {new!r}"
            raise ValueError(f"{must}, got {len(same)}")
        found += same
    return frozenset(found)


def _lines(fault: dict[str, object]) -> tuple[str, str, str]:
    """Return what tells a fault: its file, its old line and its new line."""
    return str(fault["file"]), str(fault["old"]).strip(), str(fault["new"]).strip()


def drawn_in(room: str, seed: int) -> Iterator[dict[str, object]]:
    """Yield the faults of a room in the order in which they are drawn, without equivalent ones."""
    stream = random.Random(f"{seed} {room}")
    known = equivalent_faults()
    kinds: dict[object, list[dict[str, object]]] = {}
    for fault in (fault for name in modules(room) for fault in faults_of(name)):
        if fault["kind"] != "number" or room not in LAYOUT:
            kinds.setdefault(fault["kind"], []).append(fault)
    while kinds:
        kind = stream.choice(sorted(kinds, key=str))
        fault = kinds[kind].pop(stream.randrange(len(kinds[kind])))
        if not kinds[kind]:
            del kinds[kind]
        if _lines(fault) not in known:
            yield fault


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; return its exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=150, help="number of faults (default: 150)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the random draw (default: 0)")
    parser.add_argument(
        "--rooms",
        nargs="+",
        choices=rooms(),
        default=rooms(),
        metavar="ROOM",
        help="folders of the package, or drakegrasp for the modules in none (default: all)",
    )
    arguments = parser.parse_args(argv)
    given = list(arguments.rooms)
    random.Random(arguments.seed).shuffle(given)
    faults = [drawn_in(room, arguments.seed) for room in given]
    in_turn = (fault for turn in zip_longest(*faults) for fault in turn if fault)
    drawn = list(islice(in_turn, arguments.count))
    yaml.safe_dump(drawn, sys.stdout, sort_keys=False, allow_unicode=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
