"""How errors of other libraries are quoted in our messages: always one line, never empty."""

from __future__ import annotations

import pytest

from drakegrasp.errors import LONGEST_MESSAGE, counted, first_line, one_line


@pytest.mark.parametrize(
    ("error", "first", "whole"),
    [
        (ValueError("bad value"), "bad value", "bad value"),
        (RuntimeError("\n  Failure at a.cc:3\ncondition 'x > 0' failed.\n"),
         "Failure at a.cc:3", "Failure at a.cc:3 condition 'x > 0' failed."),
        (RuntimeError(), "RuntimeError", "RuntimeError"),
        (SystemExit("\n \n"), "SystemExit", "SystemExit"),
        (ValueError("x" * 500), "x" * 500, "x" * LONGEST_MESSAGE),
    ],
)  # fmt: skip
def test_message_of_another_library_becomes_one_line(
    error: BaseException, first: str, whole: str
) -> None:
    assert first_line(error) == first
    assert one_line(error) == whole


def test_one_is_no_plural() -> None:
    assert [counted(n, "hand") for n in (0, 1, 2, 1000)] == [
        *("0 hands", "1 hand", "2 hands", "1,000 hands")
    ]
    assert [counted(n, "mesh", "meshes") for n in (1, 2)] == ["1 mesh", "2 meshes"]
