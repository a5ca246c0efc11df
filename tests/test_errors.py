"""Error messages and seeds."""

from __future__ import annotations

from typing import Any

import pytest

from reslrb_cli.errors import LINE_LENGTH, MESSAGE_LENGTH, ConfigError, NonFinite, did_you_mean, one_line, printable
from reslrb_cli.seeds import seed

# The content of a message: one line of bounded length that cannot control the terminal.


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("plain, Fläche, 名前, प्रथम", "plain, Fläche, 名前, प्रथम"),
        ("\x1b[31mred\x07", "\\x1b[31mred\\x07"),
        ("\x9b2J", "\\x9b2J"),
        ("\u202eright to left", "\\u202eright to left"),
        ("bytes \udcff", "bytes \\udcff"),
        ("\U000e0041", "\\U000e0041"),
    ],
)
def test_unprintable_characters_are_escaped(text: str, shown: str) -> None:
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


# Seeds: reproducible, in range, and distinct for every use.


def test_a_seed_does_not_change_between_versions():
    assert seed(0, 0, 0, "image") == 2478797459
    assert len({seed(1, 11, 0, "image"), seed(11, 1, 0, "image"), seed(1, 1, 10, "image")}) == 3


def test_every_purpose_has_its_own_seed():
    uses = [
        (run, iteration, view, purpose)
        for run in range(3)
        for iteration in range(40)
        for view in range(3)
        for purpose in ("image", "target", "initial", "reach, pass 0", "reach, pass 1")
    ]
    assert len({seed(*use) for use in uses}) == len(uses)


def test_seeds_are_uniform_in_their_range():
    counts = [0] * 16
    for iteration in range(4096):
        counts[seed(0, iteration, 0, "image") >> 28] += 1
    # Each of 16 bins expects 256. Chi-square with 15 degrees of freedom exceeds 45 in 1 of 10000 cases
    assert sum((count - 256) ** 2 / 256 for count in counts) < 45


@pytest.mark.parametrize(
    ("name", "known", "options", "text"),
    [
        ("OPTIMISE", ["optimize", "render"], {}, "did you mean `optimize`?"),
        ("n-bk7", ["N-BK7", "N-BAK4"], {"count": 2}, "did you mean `N-BK7` or `N-BAK4`?"),
        ("n-bk7", ["N-BK7", "N-BAK4"], {}, "did you mean `N-BK7`?"),
        ("xyz", ["optimize"], {"otherwise": "there is no other"}, "there is no other"),
        ("xyz", ["optimize"], {"cutoff": 0}, "did you mean `optimize`?"),
        ("xyz", [], {"cutoff": 0}, ""),
    ],
)  # fmt: skip
def test_similar_names_are_proposed(name: str, known: list[str], options: dict[str, Any], text: str) -> None:
    assert did_you_mean(name, known, **options) == text
