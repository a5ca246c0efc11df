"""What a message may hold: one line of bounded length, in which nothing commands the terminal."""

from __future__ import annotations

import pytest

from reslrb_cli.errors import LINE_LENGTH, MESSAGE_LENGTH, ConfigError, NonFinite, one_line, printable


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("plain, Fläche, 名前, प्रथम", "plain, Fläche, 名前, प्रथम"),
        ("\x1b[31mred\x07", "\\x1b[31mred\\x07"),
        ("\x9b2J", "\\x9b2J"),
        ("a\nb\tc", "a\\nb\\tc"),
        ("\u202eright to left", "\\u202eright to left"),
        ("bytes \udcff", "bytes \\udcff"),
        ("\U000e0041", "\\U000e0041"),
    ],
)
def test_what_is_not_printable_is_escaped(text: str, shown: str) -> None:
    assert printable(text) == shown
    assert printable(shown) == shown


def test_long_text_keeps_both_ends() -> None:
    line = one_line("begin " + "x" * 10**6 + " end")
    assert len(line) == MESSAGE_LENGTH
    assert line.startswith("begin x")
    assert line.endswith("x end")
    assert len(one_line("\x1b" * 10**6)) == MESSAGE_LENGTH
    assert one_line(" a\n  b\u2028c ") == "a b c"


def test_an_error_is_one_bounded_line() -> None:
    error = ConfigError("\x1b]0;title\x07" * 1000, "k\u009b" * 1000, "wrong\n\x1b[2J" * 1000)
    for part in (str(error), error.source, error.key, error.message):
        assert part.isprintable()
        assert len(part) <= LINE_LENGTH + 4
    assert "wrong \\x1b[2J" in str(error)
    assert str(NonFinite("loss of \x1b[31m is nan")) == "loss of \\x1b[31m is nan"
