"""Write docs/reference/builtin-objects.md from the table of classes, or check it.

Usage: python pipelines/docs/builtin_objects.py [--check] FILE
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import generated_page

from drakegrasp.config import BuiltinConfig
from drakegrasp.shapes.catalog import CLASSES, ObjectClass

_HEAD = f"""<!-- Made by `make docs-pages` from shapes/catalog.py: change that. -->

# Built-in objects

{len(CLASSES)} classes of everyday objects are included in the package, so you can build a dataset
without mesh files. They follow the kinds of objects in the paper. Their shapes and sizes are our
own and fit a hand of the Barrett Hand's size.

![The first object of every class](../images/builtin.png)

```
drakegrasp objects list
drakegrasp objects export MESHES --per-class 5
drakegrasp build --objects builtin --per-class 5 --out OUT
```

The first command prints the classes and their parameters, the second writes {5 * len(CLASSES)}
meshes (`.obj`, metres), and the third builds a dataset of the same objects.

A class is a function of a few parameters. Each object draws its parameters from the ranges below,
in steps of 0.1 mm, 0.1° or one piece. Its name is `<number>_<class>_<index>`, e.g. `1_mug_2`. Its
sizes depend only on its class, its index and `--objects-seed` (`builtin.seed`), so a larger number
of objects per class does not change the earlier objects. The same seed produces the same mesh files
on every machine.

`--per-class` (`builtin.per_class`) is {BuiltinConfig().per_class} by default. Both options are
stored in `manifest.json`, and a build can be resumed only with the same values.

Every object is one watertight solid of at most 3000 triangles. It stands or lies on z = 0 as on a
table, with z up, and keeps this pose when it is dropped. Hollow objects have walls of 4.5 to 6 mm.
Thin flat objects of the paper's set, such as forks and pens, are left out: the Barrett Hand cannot
pick them up from a table.

In Python, `export_builtin("MESHES", ["1_mug_1", "1_mug_2"])` of `drakegrasp.shapes.catalog` writes
single objects, and `builtin_object("1_mug_2", seed=3).sizes` returns the sizes of one object. To
add a class, write a function in `drakegrasp/shapes/`, add a row at the end of the table in
`drakegrasp/shapes/catalog.py`, and run `make docs-pages`.
"""


def format_page() -> str:
    """Return the page as Markdown."""
    lines = ["| | class | what it is | parameters |", "|---|---|---|---|"]
    lines += [_row(item) for item in CLASSES]
    return f"{_HEAD}\n## The classes\n\n" + "\n".join(lines) + "\n"


def _row(item: ObjectClass) -> str:
    """Return the row of a class."""
    spans = ", ".join(f"`{name}` {span}" for name, span in item.parameters.items())
    return f"| {item.number} | `{item.name}` | {item.meaning} | {spans} |"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script, see `generated_page`."""
    return generated_page.main(format_page(), __doc__.splitlines()[0], argv)


if __name__ == "__main__":
    sys.exit(main())
