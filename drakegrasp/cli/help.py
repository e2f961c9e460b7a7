"""The help of a command as plain text in 80 columns: names on the left, texts on the right.

Input: what cyclopts read from the signature and the docstring of a command. Output: the text on the
console. Paragraphs of docstrings are filled; indented lines keep their breaks.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from textwrap import fill, wrap
from typing import TYPE_CHECKING, Any

from cyclopts import App, Group, Parameter

if TYPE_CHECKING:
    from cyclopts.help import HelpEntry, HelpPanel
    from rich.console import Console, ConsoleOptions

#: Sections of a page, in their order: everyday options come before rare ones.
ARGUMENTS, OPTIONS = Group.create_ordered("Arguments"), Group.create_ordered("Options")
MORE, CLUSTER = Group.create_ordered("More options"), Group.create_ordered("Cluster options")
#: Widths of a page, and of its column of names [characters].
PAGE, NAMES = 80, 26


def new_group(
    name: str, text: str | None, summaries: Mapping[str, str] | None = None, **more: Any
) -> App:
    """Return a group of commands, or a command, with the help and the options of all others.

    Args:
        name: Name of the group.
        text: Its help; None for the docstring of its function.
        summaries: Summaries of commands that are not imported for the help of the group.
        more: Other arguments of `cyclopts.App`.
    """
    return App(
        name=name,
        help=text,
        help_format="plaintext",
        suppress_keyboard_interrupt=False,
        help_formatter=PlainHelp(summaries or {}),
        # Flags have no negative form; of an option that is given twice, the last value counts.
        default_parameter=Parameter(negative=(), negative_iterable=(), allow_repeating=True),
        group_arguments=ARGUMENTS,
        group_parameters=OPTIONS,
        **more,
    )


class PlainHelp:
    """The format of a page of help; its methods are called by cyclopts."""

    def __init__(self, summaries: Mapping[str, str]) -> None:
        self.summaries = summaries

    def __call__(self, console: Console, options: ConsoleOptions, panel: HelpPanel) -> None:
        """Write a section with its names and their texts."""
        rows = [_row(entry, self.summaries) for entry in panel.entries]
        if not rows:
            return
        left = min(max(len(name) for name, _ in rows), NAMES)
        console.file.write(f"\n{panel.title}:\n")
        for name, text in rows:
            # A long name has a line of its own.
            lines = wrap(text, PAGE - left - 4, break_on_hyphens=False)
            first = "" if len(name) > left or not lines else lines.pop(0)
            console.file.write(f"  {name:<{left}}  {first}".rstrip() + "\n")
            console.file.writelines(f"{'':{left + 4}}{line}\n" for line in lines)

    def render_usage(self, console: Console, options: ConsoleOptions, usage: Any) -> None:
        """Write the line of the words that a command takes."""
        text = f"Usage: {str(usage).strip()}"
        console.file.write(fill(text, PAGE, subsequent_indent=" " * 7) + "\n")

    def render_description(self, console: Console, options: ConsoleOptions, text: Any) -> None:
        """Write the text of a command."""
        for paragraph in filter(None, _plain(text).split("\n\n")):
            # The first line of a text has lost its indentation.
            kept = "\n    " in paragraph or paragraph.startswith("    ")
            lines = [f"    {line.strip()}" for line in paragraph.splitlines()]
            filled = "\n".join(lines) if kept else fill(paragraph, PAGE, break_on_hyphens=False)
            console.file.write(f"\n{filled}\n")


def _plain(text: Any) -> str:
    """Return a text of cyclopts without its format; empty if there is none."""
    return str(getattr(text, "primary_renderable", "")).rstrip()


def _row(entry: HelpEntry, summaries: Mapping[str, str]) -> tuple[str, str]:
    """Return the names of an option, an argument or a command, and its text."""
    value = "|".join(entry.choices) if entry.choices else entry.metavar
    names = ", ".join(entry.display_labels)
    name = f"{names} {value}" if value and not entry.positional_label else names
    return name, summaries.get(name) or " ".join(filter(None, _sentences(entry)))


def _sentences(entry: HelpEntry) -> Iterator[str]:
    yield " ".join(_plain(entry.description).split())
    if entry.required and not entry.positional_label:
        yield "[required]"
    if entry.default not in (None, "False", "True", "()"):
        yield f"[default: {entry.default}]"
