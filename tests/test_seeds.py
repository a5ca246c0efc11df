"""Seeds: reproducible, in range, and distinct for every use."""

from __future__ import annotations

from reslrb_cli.seeds import seed


def test_seeds_are_reproducible_uint32():
    values = [seed(7, 3, 1, "image") for _ in range(2)]
    assert values[0] == values[1]
    assert 0 <= values[0] < 2**32


def test_a_seed_does_not_change_between_versions():
    assert seed(0, 0, 0, "image") == 2478797459


def test_every_use_has_a_seed_of_its_own():
    uses = [
        (run, iteration, view, purpose)
        for run in range(3)
        for iteration in range(40)
        for view in range(3)
        for purpose in ("image", "target", "initial", "reach, pass 0", "reach, pass 1")
    ]
    assert len({seed(*use) for use in uses}) == len(uses)


def test_the_parts_are_kept_apart():
    assert seed(1, 11, 0, "image") != seed(11, 1, 0, "image")
    assert seed(1, 1, 10, "image") != seed(1, 11, 0, "image")


def test_seeds_fill_their_range_evenly():
    counts = [0] * 16
    for iteration in range(4096):
        counts[seed(0, iteration, 0, "image") >> 28] += 1
    # 256 expected in each of 16 bins; chi-square with 15 degrees of freedom exceeds 45 in 1 of 10000 cases
    assert sum((count - 256) ** 2 / 256 for count in counts) < 45
