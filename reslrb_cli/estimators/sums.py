"""Sums of delta_i C_i over the connections of a path, to which contributions are added, and from which they are taken.

Each channel is a pair (value, rest): what rounding loses is kept beside the value (Knuth's two-sum), so that taking off
what was added leaves zero also after a thousand vertices. Contributions whose prefix holds exactly one zero factor are
summed apart, without it: their value is nothing, and their derivative with respect to that factor is the sum.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from reslrb_cli.transport.factors import NO_ZERO, Product, showing


@dataclass
class AdjointSum:
    """sum_i delta_i C_i, (C,), as `value` + `rest`.

    `behind_zero` is the same pair for what lies behind a zero factor of the prefix, without that factor; it is empty
    where zeros are not tracked.
    """

    value: mi.Spectrum
    rest: mi.Spectrum
    behind_zero: list[mi.Spectrum]

    @classmethod
    def zero(cls, track_zeros: bool) -> AdjointSum:
        """The empty sum."""
        behind_zero = [mi.Spectrum(0), mi.Spectrum(0)] if track_zeros else []
        return cls(mi.Spectrum(0), mi.Spectrum(0), behind_zero)

    def plus(self, delta: mi.Spectrum, C: Product, index: mi.UInt32, active: mi.Bool) -> AdjointSum:
        """The sum with delta C of one more connection, that of vertex `index`."""
        return self._shifted(dr.select(active, delta, 0), C, index)

    def minus(self, delta: mi.Spectrum, C: Product, index: mi.UInt32, active: mi.Bool) -> AdjointSum:
        """The sum without delta C of a connection that is in it."""
        return self._shifted(dr.select(active, -delta, 0), C, index)

    def _shifted(self, delta: mi.Spectrum, C: Product, index: mi.UInt32) -> AdjointSum:
        value, rest = self._add(self.value, self.rest, delta * C.value())
        if not self.behind_zero:
            return type(self)(value, rest, [])
        term = delta * C.nonzero
        for c, zero in enumerate(C.zero):
            # A connection whose own factor is the zero one has a derivative there, and none in the prefix.
            term[c] = dr.select((zero >= 0) & (zero != mi.Int32(index)), term[c], 0)
        return type(self)(value, rest, list(self._add(self.behind_zero[0], self.behind_zero[1], term)))

    def adjoint_of_factor(self, f: mi.Spectrum, prefix: Product, rest: mi.Float | float) -> mi.Spectrum:
        """d(sum)/df (C,), for a factor `f * rest` of the path with this prefix, before all connections in the sum."""
        f, total = dr.detach(f), self.value + self.rest
        result = dr.select(f != 0, total / f, 0)
        if self.behind_zero:
            behind = (self.behind_zero[0] + self.behind_zero[1]) * rest
            for c, zero in enumerate(prefix.zero):
                result[c] = dr.select((f[c] == 0) & (zero == NO_ZERO), behind[c], result[c])
        return showing(result)

    def adjoint_of_emission(self, E: mi.Spectrum) -> mi.Spectrum:
        """d(sum)/dE (C,)."""
        return self.adjoint_of_factor(E, Product.one(bool(self.behind_zero)), 1)

    @staticmethod
    def _add(value: mi.Spectrum, rest: mi.Spectrum, term: mi.Spectrum) -> tuple[mi.Spectrum, mi.Spectrum]:
        """value + rest + term, as the rounded sum and what it lost (Knuth 1969, 4.2.2, theorem B)."""
        total = value + term
        part = total - value
        return total, rest + ((value - (total - part)) + (term - part))


class PlainSum(AdjointSum):
    """The same for sums that are only ever added to, where nothing cancels: `rest` stays zero."""

    @staticmethod
    def _add(value: mi.Spectrum, rest: mi.Spectrum, term: mi.Spectrum) -> tuple[mi.Spectrum, mi.Spectrum]:
        return value + term, rest
