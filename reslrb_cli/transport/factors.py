"""Throughput of a path: products of its factors, and the Russian roulette that ends paths.

The products count zero factors, so that the derivative at a zero factor is not lost. The contribution of a path is a
product of factors, f_0 f_1 ... f_k, per channel. The derivative of the contribution with respect to factor f_j is the
product of all other factors. Dividing the product by f_j fails if f_j = 0. Therefore the product of the nonzero factors
is stored with the index of the zero factor.

    one zero factor, f_j:  d(f_0 ... f_k) = (product of the others) df_j       nothing for any other factor
    two or more:           d(f_0 ... f_k) = 0

A tiny factor must not end a path, or prevent the selection of a connection. The derivative with respect to a tiny
factor is as large as any other derivative. Roulette and selection therefore use `magnitude`, in which no factor is
below DIM.

Roulette works as in `ptracer`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import drjit as dr
import mitsuba as mi

from reslrb_cli.transport.plan import Plan

NO_ZERO = -1  # no factor of this channel is zero
MANY_ZEROS = -2  # two or more factors are zero: value and derivatives vanish
DIM = 0.1  # minimum value of a factor in a magnitude, as a fraction of its stand-in
#: Flags for propagating derivatives of a result that may depend on no parameter, for example if no lane is active.
MAY_LACK = dr.ADFlag.Default | dr.ADFlag.AllowNoGrad


def showing(value: mi.Float | mi.Spectrum) -> mi.Float | mi.Spectrum:
    """Return `value` with positive infinity in place of NaN and infinities. Images and gradients then show the fault.

    In Dr.Jit 1.5, `x != 0` is false for NaN. On a CPU, atomic sums ignore a NaN unless it shares its address with other
    numbers of the same packet. Infinities of both signs would become NaN in a sum over channels or wavelengths.
    """
    return type(value)(dr.select(dr.isfinite(value), value, dr.inf))


@dataclass
class Product:
    """Product of factors, one value per channel, as part of the loop state.

    If zeros are not tracked, `nonzero` is the product of all factors. If zeros are tracked, replacements take the place
    of zero factors in `nonzero`. For each channel, `zero` is the index of the zero factor, or NO_ZERO or MANY_ZEROS.
    `tracked` is the plain product with derivatives, for naive AD only. `raised` is the product of the factors after
    each factor is raised to at least DIM times its replacement. `zero` and `raised` are empty if zeros are not tracked,
    and `tracked` is empty without naive AD.
    """

    nonzero: mi.Spectrum
    zero: list[mi.Int32] = field(default_factory=list)
    tracked: list[mi.Spectrum] = field(default_factory=list)
    raised: list[mi.Spectrum] = field(default_factory=list)

    @staticmethod
    def one(track_zeros: bool, tracked: bool = False) -> Product:
        """Return the empty product."""
        zero = [mi.Int32(NO_ZERO) for _ in range(len(mi.Spectrum(0)))] if track_zeros else []
        return Product(mi.Spectrum(1), zero, [mi.Spectrum(1)] if tracked else [], [mi.Spectrum(1)] if zero else [])

    @staticmethod
    def none(track_zeros: bool) -> Product:
        """Return the product for a connection that does not exist. Its value and derivative are zero."""
        return Product(mi.Spectrum(0), [mi.Int32(MANY_ZEROS) for _ in Product.one(track_zeros).zero])

    def times(self, factor: mi.Spectrum, index: mi.UInt32 | mi.Int32, stand_in: mi.Spectrum | float = 1) -> Product:
        """Return the product with one more factor, (C,) per lane, at position `index` of the path.

        If the factor is zero, `stand_in` replaces it in `nonzero`. `stand_in` is a positive number with the size of the
        factor's derivative.
        """
        tracked = [self.tracked[0] * factor] if self.tracked else []
        factor = dr.detach(factor)
        if not self.zero:
            return Product(self.nonzero * factor, [], tracked)
        nonzero = self.nonzero * mi.Spectrum(dr.select(factor == 0, stand_in, factor))
        first = [dr.select(z == NO_ZERO, mi.Int32(index), MANY_ZEROS) for z in self.zero]
        zero = [dr.select(factor[c] == 0, first[c], z) for c, z in enumerate(self.zero)]
        raised = [r * dr.maximum(dr.abs(factor), mi.Spectrum(DIM * stand_in)) for r in self.raised]
        return Product(nonzero, zero, tracked, raised)

    def scaled(self, scale: mi.Float) -> Product:
        """Return the product times a positive number without derivatives, such as roulette's 1/q."""
        tracked, raised = ([value * scale for value in values] for values in (self.tracked, self.raised))
        return Product(self.nonzero * scale, self.zero, tracked, raised)

    def stored(self) -> Product:
        """Return the product without data that is no longer needed after the selection."""
        return replace(self, raised=[])

    def value(self) -> mi.Spectrum:
        """Return the contribution: zero in every channel with a zero factor. Tracked under naive AD."""
        return self.tracked[0] if self.tracked else self._where(self.nonzero, [z == NO_ZERO for z in self.zero])

    def magnitude(self) -> mi.Spectrum:
        """Return the magnitude (C,) of this product for roulette and selection. It estimates the value and the
        derivative of the contribution.
        """
        return self._where(self.raised[0] if self.raised else self.nonzero, [z != MANY_ZEROS for z in self.zero])

    def alive(self) -> mi.Bool:
        """Whether the value or derivative of any channel can be nonzero, or is not finite. Both vanish with two or more
        zero factors.
        """
        return ~dr.all(self._where(self.nonzero, [z != MANY_ZEROS for z in self.zero]) == 0)  # passes NaN on

    @staticmethod
    def _where(values: mi.Spectrum, keep: list[mi.Bool]) -> mi.Spectrum:
        result = mi.Spectrum(values)
        for c, mask in enumerate(keep):
            result[c] = dr.select(mask, result[c], 0)
        return result


# ---- Russian roulette ----

LIMIT = 0.95  # largest survival probability, as in `ptracer`
DIMMEST = 1e-30  # smallest emission for roulette, well above values that single precision rounds to zero


def first_eta(light: mi.Float, guided: mi.Float | None) -> mi.Float:
    """Return a path's initial index of refraction for roulette. The index is larger if the emission `light` is dim.

    With an initial index of 1, roulette would end paths of small lamps at once, or all paths if the unit of light is
    large. `guided` is the weight of a guide, and is excluded. If the guide's weight were included, roulette would end
    paths that the guide samples often.
    """
    if guided is None:
        return dr.rsqrt(dr.clip(light, DIMMEST, 1))
    return dr.rsqrt(dr.clip(light / guided, DIMMEST, 1)) * dr.rsqrt(guided)


def play(
    plan: Plan, depth: mi.UInt32, throughput: mi.Float, eta: mi.Float, number: mi.Float
) -> tuple[mi.Bool, mi.Float]:
    """Return whether a path survives at vertex `depth`, and 1/q."""
    q = dr.minimum(throughput * dr.square(eta), LIMIT)
    playing = depth + 1 > plan.rr_depth
    return ~playing | (number < q), dr.select(playing, dr.rcp(q), 1)
