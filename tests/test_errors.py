"""How errors of other libraries are quoted in our messages: always one line, never empty."""

from __future__ import annotations

import pytest

from drakegrasp.errors import LONGEST_MESSAGE, first_line, one_line


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
