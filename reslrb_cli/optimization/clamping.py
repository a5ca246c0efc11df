"""A clamp against outliers in gradients: less variance, at the price of a bias, which is measured.

    m_e  running mean of |g_e| over the iterations before (of clamped gradients), decay DECAY
    r_e = max(m_e, mean of m over the parameter's entries)
    g_e  is brought into [-k r_e, k r_e]

Rare large values of a Monte Carlo gradient are part of its mean. What the clamp takes of them, R = g - clamped g, is a
bias as far as it does not cancel over iterations:

    bias = sum_e |sum of R_e| / sum_e |sum of g_e|      inner sums over the iterations so far

The entries' mean stands beside m_e since an entry that few paths reach may have had nothing but zeros. Absolute values
rather than squares: those of large gradients overflow.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import drjit as dr
import mitsuba as mi

from reslrb_cli.optimization.constraints import flat
from reslrb_cli.optimization.optimizers import Take
from reslrb_cli.records.metrics import Clamped

DECAY = 0.95


class GradientClamp:
    """Clamps gradients at `factor` (k) times what is usual for them; the first iteration is only looked at."""

    def __init__(self, factor: float) -> None:
        self.factor = factor
        #: By parameter: iterations, m (which starts at 0, corrected for as in Adam), and the sums of R and g.
        self._state: dict[str, tuple[int, Any, Any, Any]] = {}

    def state(self) -> tuple[dict[str, int], dict[str, Any]]:
        """What it knows: the iterations of each parameter, and arrays by `<key>/<what>`."""
        names = ("usual", "removed", "total")
        arrays = {
            f"{key}/{name}": value
            for key, state in self._state.items()
            for name, value in zip(names, state[1:], strict=True)
        }
        return {key: state[0] for key, state in self._state.items()}, arrays

    def restore(self, iterations: Mapping[str, int], parameters: Mapping[str, Any], take: Take) -> None:
        """Go on from what `state` said of these parameters; `take(name, like)` is the array of a name."""
        for key, count in iterations.items():
            like = dr.detach(parameters[key])
            usual, removed, total = (take(f"{key}/{name}", like) for name in ("usual", "removed", "total"))
            self._state[key] = count, usual, removed, total

    def apply(self, parameters: Mapping[str, Any]) -> Clamped:
        """Clamp the gradients of these parameters, which are finite, in place; what was done, and its bias so far."""
        counts, sums = {}, {}
        for key, parameter in parameters.items():
            g = clamped = dr.grad(parameter)
            zero = dr.zeros(type(g), dr.shape(g))
            iterations, m, removed, total = self._state.get(key, (0, zero, zero, zero))
            if iterations:
                # Opaque: as a literal it would compile a kernel each iteration.
                usual = m * dr.opaque(mi.Float, 1 / (1 - DECAY**iterations))
                limit = self.factor * dr.maximum(usual, dr.mean(flat(usual)))
                clamped = dr.clip(g, -limit, limit)
                dr.set_grad(parameter, clamped)
            R = g - clamped
            m = m + (dr.abs(clamped) - m) * (1 - DECAY)
            self._state[key] = iterations + 1, m, removed + R, total + g
            counts[key] = dr.count(flat(R) != 0)
            sums[key] = [dr.sum(dr.abs(flat(value))) for value in (R, g, *self._state[key][2:])]
        dr.eval(counts, sums, [state[1:] for state in self._state.values()])
        values = {key: [float(value[0]) for value in row] for key, row in sums.items()}
        return Clamped(
            entries=sum(int(count[0]) for count in counts.values()),
            share={key: _ratio(row[0], row[1]) for key, row in values.items()},
            bias={key: _ratio(row[2], row[3]) for key, row in values.items()},
        )


def _ratio(part: float, whole: float) -> float:
    return part / whole if part else 0.0
