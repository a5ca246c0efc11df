"""Low-discrepancy numbers: scrambled Sobol points.

Over all light paths, the Sobol points distribute starts and first scattering events evenly. The first number is
stratified over n lanes. [0, 1) is divided into n equal intervals, and the number of lane i lies in interval i. n does
not need to be a power of two. Similar paths are traced side by side.

The other numbers are Sobol points with the lane number as index. Take 2^k consecutive lanes that start at a multiple of
2^k. Take boxes of area 2^-k along the first two Sobol numbers. Each side of a box is [a, a + 1) times a power of two.
Every such box contains exactly one point. Boxes along more than two numbers contain few points each.

Points are scrambled for every pass (Owen 1995). Scrambling permutes each binary digit. The permutation depends on the
digits before it, which preserves the boxes. The permutations are hashes, as in Laine and Karras (2011), Burley (2020)
and Vegdahl (2022). A random number is added to each coordinate, so each point is uniformly distributed for any hash. A
sum over the lanes is therefore unbiased, and sums of different seeds are independent. Direction numbers are those of
Joe and Kuo (2008).

Digits are stored in reverse order, with the first digit in the lowest bit. Carries in sums and products then affect
only later digits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import drjit as dr
import mitsuba as mi

DIGITS = 32

#: For each dimension after the first: the inner coefficients of its polynomial, one bit each, and its first numbers m.
JOE_KUO: tuple[tuple[int, tuple[int, ...]], ...] = (
    (0, (1,)),
    (1, (1, 3)),
    (1, (1, 3, 1)),
    (2, (1, 1, 1)),
    (1, (1, 1, 3, 3)),
    (4, (1, 3, 5, 13)),
    (2, (1, 1, 5, 5, 17)),
    (4, (1, 1, 5, 5, 5)),
    (7, (1, 1, 7, 11, 19)),
)

#: Scattering events with their own dimensions: through a pane of glass, or around a corner.
BOUNCES = 2


@cache
def directions(coordinate: int) -> tuple[int, ...]:
    """Return a direction number for each binary digit of an index, from the lowest digit on.

    If a digit of the index is 1, its direction number is added (modulo 2) to the 32 digits of the point.
    """
    if coordinate == 0:
        return tuple(1 << k for k in range(DIGITS))
    inner, numbers = JOE_KUO[coordinate - 1]
    m, degree = list(numbers), len(numbers)
    for k in range(degree, DIGITS):
        new = m[k - degree] ^ (m[k - degree] << degree)
        for j in range(1, degree):
            if inner >> (degree - 1 - j) & 1:
                new ^= m[k - j] << j
        m.append(new)
    return tuple(_reversed(m[k] << (DIGITS - 1 - k)) for k in range(DIGITS))


def _reversed(digits: int) -> int:
    return int(f"{digits:0{DIGITS}b}"[::-1], 2)


def point(index: mi.UInt32, coordinate: int, digits: int = DIGITS) -> mi.UInt32:
    """Return one coordinate's digits for the Sobol points with these indices. Indices have at most `digits` binary
    digits.
    """
    if coordinate == 0:
        return mi.UInt32(index)
    result = mi.UInt32(0)
    for k, direction in enumerate(directions(coordinate)[:digits]):
        result ^= dr.select((index & (1 << k)) != 0, mi.UInt32(direction), 0)
    return result


def scrambled(point: mi.UInt32, shift: mi.UInt32, key: mi.UInt32) -> mi.UInt32:
    """Return the digits after scrambling. Over all values of `shift`, the result is uniformly distributed."""
    x = point ^ (point * 0x3D20ADEA)
    x = (x + shift) * (key | 1)
    x ^= x * 0x05526C56
    return x ^ (x * 0x53A22864)


@dataclass(frozen=True)
class Coordinates:
    """Random numbers that a path takes from the coordinates of its Sobol point.

    The coordinates are the numbers that emitters use (choice, place and direction), and numbers for scattering. Each of
    the first `bounces` scattering events has three numbers.
    """

    choice: bool
    place: tuple[bool, bool]
    direction: tuple[bool, bool]
    bounces: int


def make_coordinates(used: Sequence[bool], emitters: int, max_depth: int) -> Coordinates:
    """Return the coordinates for this number of emitters. `used` tells which numbers of place and direction the
    emitters use. One number chooses the emitter and the wavelengths.
    """
    bounces = min(max(max_depth - 2, 0), BOUNCES)
    return Coordinates(emitters > 1 or mi.is_spectral, (used[0], used[1]), (used[2], used[3]), bounces)


@dataclass
class Net:
    """Distance between neighbouring lanes in the first coordinate, in units of 2^-64 (opaque, width 1)."""

    step: mi.UInt64

    @staticmethod
    def of(width: int) -> Net:
        """Return the net for a pass of `width` light paths."""
        return Net(dr.opaque(mi.UInt64, min(2**64 // width, 2**64 - 1)))

    def stratified(self, lane: mi.UInt32, jitter: mi.Float) -> mi.Float:
        """Return the first coordinate. `jitter`, in [0, 1), is the position of the coordinate within its interval."""
        within = mi.UInt64(mi.UInt32(jitter * 2.0**24)) * (self.step >> 24)
        return unit(mi.UInt32((mi.UInt64(lane) * self.step + within) >> 32))


class Points:
    """Coordinates of the lanes' Sobol points, returned in order. `used` is the index of the next coordinate. `seed` is
    opaque.

    With `net`, the first requested coordinate is stratified. Without a net, no coordinate is stratified, because a
    guide has already stratified the lanes.
    """

    def __init__(self, seed: mi.UInt32, width: int, net: Net | None) -> None:
        self.seed, self.lane, self.net, self.used = seed, dr.arange(mi.UInt32, width), net, 0
        # In coarse steps, so that another number of paths uses the same kernel.
        self.digits = 24 if width <= 2**24 else DIGITS

    def next_1d(self, independent: mi.Float | None = None) -> mi.Float:
        """Return the next coordinate, in [0, 1). The coordinate replaces the random number `independent`. Stratified
        coordinates use `independent` as the position within the interval.
        """
        if self.net is not None:
            assert independent is not None
            net, self.net = self.net, None
            return net.stratified(self.lane, independent)
        shift, key = mi.sample_tea_32(self.seed, mi.UInt32(self.used))
        digits = point(self.lane, self.used, self.digits)
        self.used += 1
        return unit(dr.brev(scrambled(digits, shift, key)))

    def next_2d(self, independent: mi.Point2f | None = None, used: tuple[bool, bool] = (True, True)) -> mi.Point2f:
        """Return the next two coordinates. The coordinates replace the random numbers for which `used` is true."""
        own = mi.Point2f(0.5) if independent is None else independent
        return mi.Point2f(*(self.next_1d(u) if used[k] else u for k, u in enumerate((own.x, own.y))))


def unit(digits: mi.UInt32) -> mi.Float:
    """Return a number in [0, 1) from digits. The highest bit is the first digit."""
    return mi.Float(digits >> 8) * 2.0**-24


def evenly(seed: mi.UInt32, stream: int, index: mi.UInt32) -> tuple[mi.Float, mi.Float, mi.Float]:
    """Return three numbers in [0, 1) for each `index`, which are spread evenly over indices.

    They are van der Corput's sequence and a Kronecker sequence (Roberts 2018), with a random offset for each seed.
    """
    first, second = mi.sample_tea_32(seed, mi.UInt32(stream))
    third, _ = mi.sample_tea_32(seed, mi.UInt32(stream + 1))
    return unit(dr.brev(index) + first), unit(index * 3242174889 + second), unit(index * 2447445414 + third)
