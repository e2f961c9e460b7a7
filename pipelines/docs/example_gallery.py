"""Write or check docs/examples/index.md, the gallery of the example scripts in its folder.

Usage: python pipelines/docs/example_gallery.py [--check] FILE
       python pipelines/docs/example_gallery.py --pictures docs/images

The second form runs all scripts, which takes a minute, and stores the picture of each.
"""

from __future__ import annotations

import ast
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import generated_page

EXAMPLES = Path(__file__).resolve().parents[2] / "docs" / "examples"

_HEAD = """<!-- Made by `make docs-pages` from the scripts in this folder: change those. -->

# Examples

This is a course of short scripts. Each script shows one topic, prints its results and draws one
picture. Run them in order from any folder. They write to `example/` in that folder, and 01 builds
the dataset that most of the others read. All scripts together take about a minute.

```
python docs/examples/01_dataset.py
```

To train a network, see the [tutorial](../tutorial.md#3-train).
"""


@dataclass(frozen=True, kw_only=True)
class Example:
    """An example: its file, the parts of its docstring, and its code without the docstring."""

    path: Path
    title: str
    line: str
    concepts: str
    code: str

    @property
    def anchor(self) -> str:
        """The anchor of the example's section."""
        return f"{self.number}-{self.title.removesuffix('.').lower().replace(' ', '-')}"

    @property
    def number(self) -> str:
        """The example's number in the course."""
        return self.path.stem.partition("_")[0]

    @property
    def picture(self) -> str:
        """Name of the example's picture in docs/images."""
        return f"example_{self.path.stem}.png"


def read_examples(folder: Path = EXAMPLES) -> list[Example]:
    """Return the examples of a folder in the order of their numbers.

    Raises:
        ValueError: If a docstring does not consist of a title, one line and a line of concepts.
    """
    return [read_example(path) for path in sorted(folder.glob("[0-9][0-9]_*.py"))]


def read_example(path: Path) -> Example:
    """Return one example, see `read_examples`."""
    text = path.read_text(encoding="utf-8")
    tree = ast.parse(text)
    parts = (ast.get_docstring(tree) or "").split("\n\n")
    if len(parts) != 3 or not parts[2].startswith("Concepts: "):
        raise ValueError(f"{path}: docstring must be a title, one line and 'Concepts: ...'")
    end = tree.body[0].end_lineno or 0
    title, line, concepts = (" ".join(part.split()) for part in parts)
    return Example(
        path=path,
        title=title.removesuffix("."),
        line=line,
        concepts=concepts.removeprefix("Concepts: "),
        code="\n".join(text.splitlines()[end:]).strip(),
    )


def format_page(examples: Sequence[Example]) -> str:
    """Return the page as Markdown: a table of pictures, then a section per example."""
    rows = ["| | |", "|---|---|"]
    rows += [
        f"| ![{item.title}](../images/{item.picture}) "
        f"| [**{item.number} {item.title}**](#{item.anchor})<br>{item.line} |"
        for item in examples
    ]
    return "\n".join([_HEAD, *rows, "", *map(_section, examples)])


def _section(item: Example) -> str:
    """Return the section of an example."""
    return f"""## {item.number} {item.title}

{item.line}

*Concepts: {item.concepts}* The script: [`{item.path.name}`]({item.path.name}).

![What {item.path.name} draws](../images/{item.picture})

```py
{item.code}
```
"""


def draw_pictures(folder: Path) -> None:
    """Run all examples in a temporary folder, and store their pictures."""
    with tempfile.TemporaryDirectory() as scratch:
        for item in read_examples():
            subprocess.run([sys.executable, item.path], cwd=scratch, check=True)
            shutil.copy(Path(scratch, "example", f"{item.path.stem}.png"), folder / item.picture)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script, see `generated_page`."""
    words = sys.argv[1:] if argv is None else list(argv)
    if words[:1] == ["--pictures"] and len(words) == 2:
        draw_pictures(Path(words[1]))
        return 0
    return generated_page.main(format_page(read_examples()), __doc__.splitlines()[0], words)


if __name__ == "__main__":
    sys.exit(main())
