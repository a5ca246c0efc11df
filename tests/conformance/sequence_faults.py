"""Faults of low-discrepancy numbers. A function patches each fault into the code."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import pytest

from reslrb_cli.integrators import reslrb
from reslrb_cli.transport import samples, sobol
from reslrb_cli.transport.samples import Samples


def never_scrambled(patch: pytest.MonkeyPatch) -> None:
    """In every pass, the points are the points of the sequence itself, without a scramble."""
    patch.setattr(sobol, "scrambled", lambda point, shift, key: point)


def scrambled_once(patch: pytest.MonkeyPatch) -> None:
    """Every pass has the same scramble."""
    right = samples.Points

    def wrong(seed: Any, *rest: Any) -> Any:
        return right(mi.UInt32(7), *rest)

    patch.setattr(samples, "Points", wrong)


def not_shifted(patch: pytest.MonkeyPatch) -> None:
    """The digits are permuted, but the permutation does not move the first point."""
    right = sobol.scrambled
    patch.setattr(sobol, "scrambled", lambda point, shift, key: right(point, shift * 0, key))


def one_scramble_for_all(patch: pytest.MonkeyPatch) -> None:
    """All coordinates of a pass have the same shift and key."""
    _renumbered(patch, scramble=lambda number: 0)


def used_twice(patch: pytest.MonkeyPatch) -> None:
    """Each pair of successive numbers uses the same coordinate with the same scramble."""
    _renumbered(patch, scramble=lambda number: number // 2, coordinate=lambda number: number // 2)


def _renumbered(
    patch: pytest.MonkeyPatch, scramble: Any = lambda number: number, coordinate: Any = lambda number: number
) -> None:
    def next_1d(self: Any, independent: Any = None) -> Any:
        if self.net is not None:
            net, self.net = self.net, None
            return net.stratified(self.lane, independent)
        shift, key = mi.sample_tea_32(self.seed, mi.UInt32(scramble(self.used)))
        digits = sobol.point(self.lane, coordinate(self.used), self.digits)
        self.used += 1
        return sobol.unit(dr.brev(sobol.scrambled(digits, shift, key)))

    patch.setattr(sobol.Points, "next_1d", next_1d)


def half_of_the_strata(patch: pytest.MonkeyPatch) -> None:
    """The lanes share the first number as if there were twice as many lanes."""
    right = sobol.Net.of
    patch.setattr(sobol.Net, "of", staticmethod(lambda width: right(2 * width)))


def without_jitter(patch: pytest.MonkeyPatch) -> None:
    """The first number is always at the start of its stratum."""
    right = sobol.Net.stratified
    patch.setattr(sobol.Net, "stratified", lambda self, lane, jitter: right(self, lane, jitter * 0))


def squeezed(patch: pytest.MonkeyPatch) -> None:
    """The range of the numbers ends below 1."""
    right = sobol.unit
    patch.setattr(sobol, "unit", lambda digits: right(digits) * 0.96)


def of_emission_again(patch: pytest.MonkeyPatch) -> None:
    """The first vertices use the same coordinates as emission."""
    right = Samples._points

    def wrong(self: Any, *numbers: Any) -> Any:
        points, own = right(self, *numbers)
        points.used = 0
        return points, own

    patch.setattr(Samples, "_points", wrong)


def shared_by_passes(patch: pytest.MonkeyPatch) -> None:
    """All passes of an image have the seed of the first pass."""
    right = reslrb.passes

    def wrong(*given: Any) -> Any:
        parts = right(*given)
        for part in parts[1:]:
            part.seed = parts[0].seed
        return parts

    patch.setattr(reslrb, "passes", wrong)


def swapped_in_replays(patch: pytest.MonkeyPatch) -> None:
    """Every second walk uses the numbers of its first vertices in reverse order."""
    right, calls = Samples.early_numbers, [0]

    def wrong(self: Any) -> Any:
        calls[0] += 1
        return right(self)[:: 1 if calls[0] % 2 else -1]

    patch.setattr(Samples, "early_numbers", wrong)
