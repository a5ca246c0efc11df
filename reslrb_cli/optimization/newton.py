"""Steps that know their scale (`optimizer: auto`).

Each parameter x has a measured curvature, so it needs no learning rate. With the gradient g of an iteration, the
entries i move as follows.

    m_i  <-  0.5 m_i + g_i                                    momentum
    s_i  <-  0.9 s_i + 0.1 |g_i|                              size of the gradients of entry i
    h_i   =  c s_i,   c = sum_j H_j s_j / sum_j s_j²          curvature
    x_i  <-  x_i - clip(0.4 m_i / h_i, ±L) / (1 + q n_i)      step

H is the diagonal of the loss's second derivative, measured with random signs z (Hutchinson 1989) at common random
numbers: H_i = z_i (g_i(x + d z) - g_i(x)) / d. A measurement costs one gradient. It takes place in the iterations 0, 2,
6, 14, 30, and so on, because H changes as the parameters move. A single H_i is mostly noise. The least-squares factor c
uses all entries, and s gives the differences between entries, as in Adam. Parameters of at most four entries use the
root mean square of H over the measurements instead, because coupled parameters may change its sign. Where the loss is
not convex, the absolute value of the curvature counts.

L is a share of the parameter's extent, so one bright path cannot move a texel far. n_i counts the iterations in which
g_i and m_i have opposite signs (Kesten 1958). As long as an entry moves in one direction, its steps keep their length.
When it oscillates, or when noise dominates, its steps become shorter, as 1/n. Gradients of small parameters are means
over many paths, so L is larger and q smaller for them.

`to_go` is a limit of the distance to the optimum. m_i contains only earlier samples, so the product g_i m_i has no bias
from noise, and

    sum_i g_i (m_i / 2) / h_i  /  sum_i h_i

estimates the mean square of the distance, with the curvature as weight. Where parameters are coupled, for example a
lamp and an albedo, the distance along a valley of the loss is longer than m / h. The distance that the parameter has
moved since the last measurement of H is therefore another limit.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import drjit.opt as dropt
import numpy as np

from reslrb_cli.optimization.nonfinite import flat

#: Step as a share of Newton's, decay of the momentum, and decay of the gradients' size. docs/optimizers.md has
#: measurements.
GAIN, MOMENTUM, MEMORY = 0.4, 0.5, 0.9
#: Displacement d of a measurement as a share of the extent, and the weight of the newest measurement.
DISPLACEMENT, NEWEST = 0.05, 0.75
#: Parameters of at most so many entries have one curvature. L as a share of the extent, and q, for them and for others.
SMALL, OF_SMALL, OF_LARGE = 4, (0.25, 0.25), (0.08, 0.5)
#: The limit of the distance uses this many iterations, and exceeds the largest of them by this factor.
RECENT, SURE = 4, 1.5
#: A mean square distance that is not known. A state on file has only finite numbers.
UNKNOWN = 3e38


class Newton(dropt.Optimizer[Any]):
    """The update of `optimizer: auto` for one parameter. The learning rate is the longest step L.

    Data: m, s, n, H, the variable at the last measurement of H, and the mean square distances of the last iterations,
    of width 1 each, newest first.
    """

    def _step(self, cache: Any, value: Any, grad: Any, lr: Any, extra: tuple[Any, ...]) -> tuple[Any, tuple[Any, ...]]:
        velocity, size, turns, bent, earlier, *squares = extra
        size = dr.lerp(dr.abs(grad), size, MEMORY)
        steepness = _steepness(size, bent)
        known = steepness > 0
        weight = total(dr.select(known, steepness, 0))
        offsets = dr.select(known, grad * ((1 - MOMENTUM) * velocity / steepness), 0)
        square = dr.select(weight > 0, total(offsets) / weight, UNKNOWN)
        turns = turns + dr.select((grad < 0) & (velocity > 0) | (grad > 0) & (velocity < 0), 1, 0)
        velocity = MOMENTUM * velocity + grad
        longest = dr.opaque(dr.leaf_t(grad), lr)
        step = dr.clip(GAIN * velocity / steepness, -longest, longest) / (1 + _options(value)[1] * turns)
        return value - dr.select(known, step, 0), (velocity, size, turns, bent, earlier, square, *squares[:-1])

    def _reset(self, key: str, value: Any, promoted: bool) -> None:
        array = value.array
        zeros = [dr.opaque(type(array), 0, array.shape) for _ in range(5)]
        unknown = [dr.opaque(dr.leaf_t(array), UNKNOWN) for _ in range(RECENT)]
        self.state[key] = value, promoted, None, (*zeros, *unknown)

    def limit(self, key: str) -> float:
        """Return the longest step as a share of the extent."""
        return _options(dr.detach(self[key]))[0]

    def bend(self, key: str, curvature: Any) -> None:
        """Take a measurement of H, in the shape of the parameter. Entries that are not finite keep their curvature."""
        value, promoted, lr, (velocity, size, turns, bent, _, *squares) = self.state[key]
        curvature = dr.select(dr.isfinite(curvature), curvature, bent)
        if dr.width(flat(value)) <= SMALL:  # other displacements change the sign, so squares are averaged
            curvature = dr.abs(curvature)
            ratio = dr.select(bent > 0, curvature / bent, 1)  # squares would underflow
            newest = dr.select(bent > 0, bent * dr.sqrt(dr.lerp(1, ratio * ratio, NEWEST)), curvature)
        else:
            newest = dr.lerp(bent, curvature, NEWEST)
        bent = dr.select(dr.all(flat(bent) == 0), curvature, newest)
        dr.make_opaque(bent)
        self.state[key] = value, promoted, lr, (velocity, size, turns, bent, dr.detach(value).array, *squares)

    def steepness(self, key: str) -> np.ndarray[Any, Any]:
        """Return the gradient of each entry that moves it by 1, summed over the steps, as a flat array. It is infinite
        if the curvature is not known.
        """
        _, size, turns, bent, *_ = self.state[key][3]
        steepness = np.array(_steepness(size, bent), dtype=np.float64).ravel()
        shorter = 1 + _options(bent)[1] * np.array(turns, dtype=np.float64).ravel()
        return np.asarray(np.where(steepness > 0, steepness * shorter * (1 - MOMENTUM) / GAIN, np.inf))

    def to_go(self, key: str) -> float:
        """Return a limit of the root mean square distance to the optimum. It is infinite if it is not known."""
        value, _, _, (_, size, _, bent, earlier, *squares) = self.state[key]
        left = np.abs([float(np.array(each).ravel()[0]) for each in squares])
        steepness = np.array(_steepness(size, bent), dtype=np.float64).ravel()
        moved = np.array(dr.detach(value).array - earlier, dtype=np.float64).ravel()
        if left.max() >= np.float32(UNKNOWN) or not steepness.any():
            return float("inf")
        far = np.sum(steepness * np.square(moved)) / np.sum(steepness)
        return float(np.sqrt(max(SURE**2 * left.max(), far)))


def _options(value: Any) -> tuple[float, float]:
    """Return L as a share of the extent, and q."""
    return OF_SMALL if dr.width(flat(value)) <= SMALL else OF_LARGE


def _steepness(size: Any, bent: Any) -> Any:
    """Return the curvature of each entry, which is 0 if it is not known."""
    entries = flat(bent)
    if dr.width(entries) <= SMALL:
        largest = dr.maximum(dr.max(dr.abs(entries)), 1e-37)  # squares would underflow
        return dr.zeros(type(size), dr.shape(size)) + dr.sqrt(dr.mean(dr.square(entries / largest))) * largest
    largest = dr.max(flat(size))
    unit = dr.select(largest > 0, size / largest, 0)  # squares of gradients would underflow
    factor = total(bent * unit) / total(unit * unit)
    return dr.select(largest > 0, dr.abs(factor) * unit, 0)


def total(value: Any) -> Any:
    """Return the sum of all entries, of width 1."""
    return dr.sum(flat(value))
