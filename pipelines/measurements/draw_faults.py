"""Draw faults in the rules that decide labels, as a table for `planted_faults.py`.

A fault changes one operator, number, condition, call or result in a module of physics, screen,
labels, filters or checks: `<` becomes `>=`, `+` becomes `-`, 0 becomes 1, `and` becomes `or`. Texts
of messages and annotations are left alone. The same seed draws the same faults of the same source.
Writes YAML. The tests of a fault are those of its module, the quickest first.
"""

from __future__ import annotations

import argparse
import ast
import random
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parents[2]
_SIM, _DATA, _CHECKS = (
    "tests/simulation/test_",
    "tests/dataset/test_",
    "tests/dataset/checks/test_check_",
)
#: Tests of some modules that lie elsewhere.
_BESIDE = {
    "construction": ("tests/visualization/test_recording.py",),
    "robustness": ("tests/test_equal_draws.py",),
}
#: The modules, and the tests that must notice.
MODULES = {
    **{
        f"drakegrasp/simulation/{name}.py": [
            *(f"{_SIM}{test}.py" for test in tests.split()),
            *_BESIDE.get(name, ()),
        ]
        for name, tests in {
            "verdict": "verdict trial",
            "contacts": "contacts trial",
            "lift": "lift trial",
            "trial": "trial",
            "stepping": "trial",
            "drive": "drive",
            "screen": "screen",
            "scene": "lift trial construction",
            "construction": "construction trial",
            "settle": "settle",
            "trajectory": "trajectory lift",
            "robustness": "robustness",
            "candidates": "candidates",
        }.items()
    },
    "drakegrasp/hand/finger_sweep.py": ["tests/hand/test_finger_sweep.py", f"{_SIM}screen.py"],
    "drakegrasp/dataset/filters.py": [f"{_DATA}filters.py", f"{_DATA}assemble.py"],
    "drakegrasp/dataset/suspicion.py": [f"{_DATA}suspicion.py", f"{_DATA}assemble.py"],
    "drakegrasp/dataset/assembly/samples.py": [f"{_DATA}assemble.py", f"{_CHECKS}samples.py"],
    **{
        f"drakegrasp/dataset/checks/{name}.py": [f"{_CHECKS}{test}.py" for test in tests.split()]
        for name, tests in {
            "trials": "trials",
            "trials_file": "trials consistency",
            "samples": "samples images",
            "images": "images samples",
            "assembled": "samples consistency trials",
            "attempts": "conditions trials",
            "data_file": "samples images consistency",
            "layout": "layout run",
            "object_files": "run",
            "rows": "run trials samples",
            "findings": "run",
            "run": "run layout",
        }.items()
    },
    "drakegrasp/verification/verify.py": ["tests/verification/test_verify.py"],
    "drakegrasp/verification/forces/verdict.py": [
        "tests/verification/forces/test_force_verdict.py"
    ],
}
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


def faults_of(name: str) -> Iterator[dict[str, object]]:
    """Yield every fault of a module as an entry of a table, in the order of its text."""
    text = (ROOT / name).read_text(encoding="utf-8")
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
                "tests": [*MODULES[name], QUICK],
            }


def _deciding(node: ast.AST) -> Iterator[ast.expr | ast.stmt]:
    """Yield the nodes of a tree in which a fault may be; annotations and texts have none."""
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
    """Yield the texts by which a fault replaces a node."""

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


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; return its exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=150, help="number of faults (default: 150)")
    parser.add_argument("--seed", type=int, default=0, help="of the draw (default: 0)")
    arguments = parser.parse_args(argv)
    every = [fault for name in MODULES for fault in faults_of(name)]
    drawn = random.Random(arguments.seed).sample(every, arguments.count)
    sys.stderr.write(f"{len(drawn)} of {len(every)} faults\n")
    yaml.safe_dump(drawn, sys.stdout, sort_keys=False, allow_unicode=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
