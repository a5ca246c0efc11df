"""Rules by which an iteration changes one parameter, with one interface (`Rule`).

Steps that know their scale (`Newton`, of `optimizer: auto`) have a measured curvature, so they need no learning rate.
They are for textures and other large parameters. `block.py` moves the small ones together. With the gradient g of an
iteration, the entries i move as follows.

    s_i, v_i                                                  means of |g_i| and g_i²
    h_i   =  c_i s_i,   c_i = sum_j H_j s_j / sum_j s_j²      curvature; the sums are over all j with s_j <= s_i
    r_i                                                       mean of (g_i - g_i' - h_i (x_i - x_i'))² / 2
    L_i   =  L s_i² / v_i                                     longest step
    d_i   =  h_i (1 + q n_i) / 0.5 + 0.5 r_i / (h_i P²)       divisor of a step
    m_i  <-  0.5 m_i + clip(g_i, ±0.5 L_i d_i)                momentum
    x_i  <-  x_i - clip(m_i / d_i, ±L_i)                      step

H is the second derivative of the loss, measured at common random numbers: H_i = z_i (g_i(x + d z) - g_i(x)) / d. The
signs z are those of the next step. Random signs would give the diagonal (Hutchinson 1989). However, a pixel shows
several texels, so neighbours that move together change the gradient more than one alone. Neighbours that move in
opposite directions change it less. A measurement costs one gradient. It takes place in the iterations 0, 2, 6, 14, 30,
and so on, because H changes as the parameters move. A single H_i is mostly noise. The least-squares factor c_i
therefore uses all entries with gradients of at most the size of s_i, and at least 2 % of the entries. A common factor
would not do: where many paths reach an entry, its gradients fall to a small fraction of the first ones, and elsewhere
they are noise from the start. The steps of dim entries would become too short. Where the loss is not convex, the
absolute value of the curvature counts.

L is a share of the parameter's extent. s_i² / v_i is about the share of the iterations in which paths reach the entry.
It is between 0.6 and 1 for entries with a gradient in each iteration. One gradient moves an entry by at most L_i in all
later steps together. Otherwise, one path would move a texel that few paths reach by many times L. Clipped gradients
have a bias where their noise is skewed. The limit rises as the steps become shorter, so the bias disappears.

r_i is the variance of the noise of a gradient. It comes from the last gradient g' at x'. P is a share of the extent. If
noise would move an entry by much more than P, steps are shorter from the start. Otherwise, the first steps would move
dim entries far from the optimum, and later steps would be too short to correct them.

n_i counts the iterations in which g_i and m_i have opposite signs (Kesten 1958). As long as an entry moves in one
direction, its steps keep their length. When it oscillates, or when noise dominates, its steps become shorter, as 1/n.

A pixel shows several texels, so the curvature of the loss is smaller for the details of a texture than for its coarse
parts. The steps above are too short for details. A texture therefore has fine steps too. Its fine part F x is x minus
the mean over 3 x 3 texels.

    x  <-  x - a + F a / 2 - F b

a is the step above. b is the same step for the gradient F g, with its own moments, curvature, noise and P. A
measurement of H displaces x by d z + F d w, with random signs w. The mean of F d w is 0, so H for a stays as above. H
for b is w_i F (g(x + d z + F d w) - g(x))_i / d. Let h be the curvature for a, and k for b. A step of b divides by
k + (0.2 h)² / k in place of k. Details therefore hardly move if the images hardly show them. a moves details by half,
because noise shortens the steps b more. Fine steps start after four iterations. Before, large gradients would move
details by too much.

`to_go` is a limit of the distance to the optimum. m_i contains only earlier samples, so the product g_i m_i has no bias
from noise, and

    sum_i g_i (m_i / 2) / h_i  /  sum_i h_i

estimates the mean square of the distance, with the curvature as weight. Where parameters are coupled, for example a
lamp and an albedo, the distance along a valley of the loss is longer than m / h. The distance that the parameter has
moved since the last measurement of H is therefore another limit.
"""

from __future__ import annotations

import itertools
import math
from typing import Any, NamedTuple

import drjit as dr
import drjit.opt as dropt
import numpy as np

from reslrb_cli.backend.memory import flat
from reslrb_cli.optimization.block import Block

#: Step as a share of Newton's, decay of the momentum, decay of the means s and v, and decay of the mean r.
#: docs/optimizers.md has measurements.
GAIN, MOMENTUM, MEMORY, FORGETTING = 0.5, 0.5, 0.99, 0.9
#: Classes of gradients by size, classes for a factor of two, and the smallest share of the entries that c uses.
CLASSES, OCTAVE, SHARE = 128, 4, 0.02
#: Displacement d of a measurement as a share of the extent, and the weight of the newest measurement.
DISPLACEMENT, NEWEST = 0.05, 0.75
#: L and P as shares of the extent, and q.
LONGEST, NEAR, SHORTER = 0.13, 0.07, 1.2
#: P of fine steps, the ratio k / h of curvatures below which the images hardly show details, and the number of
#: iterations without fine steps.
NEAR_FINE, UNSEEN, EARLY = 0.0175, 0.2, 4
#: The limit of the distance uses this many iterations, and exceeds the largest of them by this factor.
RECENT, SURE = 4, 1.5
#: A mean square distance that is not known. A state on file has only finite numbers.
UNKNOWN = 3e38


class Rule:
    """Interface of the rules. The defaults are those of a rule with a learning rate."""

    #: Longest step as a share of the extent, in place of a learning rate.
    longest: float | None = None
    #: True if the length of a step does not depend on the size of the gradient.
    keeps_length = False

    def forget(self) -> None:
        """Set the moments to zero, if they last for many iterations."""
        self.reset()  # type: ignore[attr-defined]

    def to_go(self, key: str) -> float:
        """Return a limit of the root mean square distance to the optimum. It is infinite if it is not known."""
        return math.inf

    def averaged(self, key: str) -> float:
        """Return the number of gradients that a step averages, estimated from the factor that shortens the step."""
        return 1.0

    def steepness(self, key: str) -> np.ndarray[Any, Any]:
        """Return the gradient of each entry that moves it by 1 at a rate of 1, summed over the steps, as a flat array.
        It is infinite if the entry does not move.
        """
        raise NotImplementedError


class AdamRule(Rule, dropt.Adam):
    """Adam with the interface of `Rule`."""

    keeps_length = True

    def steepness(self, key: str) -> np.ndarray[Any, Any]:
        value, _, _, (steps, _, squares, *_) = self.state[key]
        count = int(np.array(steps).ravel()[0])
        mean = np.array(squares, dtype=np.float64).ravel() / max(1 - self.beta_2**count, 1e-300)
        return np.asarray(np.sqrt(mean) + self.epsilon if count else np.full(np.array(value).size, np.inf))


class Descent(Rule, dropt.SGD):
    """Gradient descent with the interface of `Rule`."""

    def steepness(self, key: str) -> np.ndarray[Any, Any]:
        return np.full(np.array(dr.detach(self[key])).size, 1 - self.momentum)


class Joint(Rule, dropt.SGD):
    """Holder of a small parameter that `block` moves."""

    def __init__(self, block: Block) -> None:
        super().__init__(lr=1.0)
        self._block = block

    def forget(self) -> None:
        pass

    def to_go(self, key: str) -> float:
        return self._block.to_go(key)

    def averaged(self, key: str) -> float:
        return self._block.averaged

    def steepness(self, key: str) -> np.ndarray[Any, Any]:
        return self._block.steepness(key)


class Moments(NamedTuple):
    """m, s, n, H, and the roots of v and r, flat."""

    velocity: Any
    size: Any
    turns: Any
    bent: Any
    spread: Any
    noise: Any


class Newton(Rule, dropt.Optimizer[Any]):
    """The update of `optimizer: auto` for one large parameter. The learning rate is the longest step L.

    Data: the moments of the entries, the moments of the fine steps of a texture, g', x', the variable at the last
    measurement of H, and arrays of width 1. These are the sum of the weights in s and v, P, and the mean square
    distances of the last iterations, newest first.
    """

    longest = LONGEST

    def _step(self, cache: Any, value: Any, grad: Any, lr: Any, extra: tuple[Any, ...]) -> tuple[Any, tuple[Any, ...]]:
        (entries, *fine), (last, before, earlier, weights, _, *squares) = _parts(extra)
        most, rows = dr.opaque(dr.leaf_t(grad), lr), (grad, grad - last, value - before)
        near, ahead = NEAR / LONGEST * most, (1 - MOMENTUM) * entries.velocity
        step, steepness, entries = _advance(entries, rows, weights, most, near)
        known = steepness > 0
        weight = dr.sum(dr.select(known, steepness, 0))
        square = dr.select(weight > 0, dr.sum(dr.select(known, grad * (ahead / steepness), 0)) / weight, UNKNOWN)
        if fine:
            rows = tuple(fine_part(row, self._shape) for row in rows)
            detail, _, moments = _advance(fine[0], rows, weights, most, NEAR_FINE / LONGEST * most, steepness)
            step = dr.select(known, step + fine_part(detail - 0.5 * step, self._shape), 0)
            fine = [moments]
        moved = grad, value, earlier, dr.lerp(1, weights, MEMORY), near, square, *squares[:-1]
        return value - step, (*entries, *itertools.chain(*fine), *moved)

    def _reset(self, key: str, value: Any, promoted: bool) -> None:
        array, self._shape = value.array, dr.shape(value)
        levels = 2 if len(self._shape) == 3 else 1
        zeros = [dr.opaque(type(array), 0, array.shape) for _ in range(levels * len(Moments._fields) + 3)]
        single = [dr.opaque(dr.leaf_t(array), each) for each in (0, 1, *RECENT * [UNKNOWN])]
        self.state[key] = value, promoted, None, (*zeros, *single)

    def forget(self) -> None:
        pass  # no long memory, and the measured curvature stays

    def toward(self, key: str, gradient: Any) -> np.ndarray[Any, Any]:
        """Return the direction of the next step, in the shape of the parameter. The next gradient is `gradient`."""
        newest = np.array(gradient, dtype=np.float64)
        return -newest - MOMENTUM * np.array(self.state[key][3][0], dtype=np.float64).reshape(newest.shape)

    def bend(self, key: str, change: Any, step: Any, fine_step: Any) -> None:
        """Take a measurement of H. All arguments are flat.

        `change` is the change of the gradient by a displacement of `step` plus the fine part of `fine_step`. Without
        fine steps, `fine_step` is None. Entries that are not finite keep their curvature.
        """
        value, promoted, lr, extra = self.state[key]
        levels, (last, before, _, *others) = _parts(extra)
        found = [change / step] if fine_step is None else [change / step, fine_part(change, self._shape) / fine_step]
        for at, curvature in enumerate(found):
            bent = levels[at].bent
            curvature = dr.select(dr.isfinite(curvature), curvature, bent)
            bent = dr.select(dr.all(flat(bent) == 0), curvature, dr.lerp(bent, curvature, NEWEST))
            dr.make_opaque(bent)
            levels[at] = levels[at]._replace(bent=bent)
        kept = *itertools.chain(*levels), last, before, dr.detach(value).array, *others
        self.state[key] = value, promoted, lr, kept

    def steepness(self, key: str) -> np.ndarray[Any, Any]:
        (entries, *_), (_, _, _, _, near, *_) = _parts(self.state[key][3])
        steepness = _steepness(entries.size, entries.bent)
        summed = (1 - MOMENTUM) * _divisor(steepness, entries.turns, entries.noise, near)
        return np.array(dr.select(steepness > 0, summed, math.inf), dtype=np.float64).ravel()

    def averaged(self, key: str) -> float:
        (entries, *_), _ = _parts(self.state[key][3])
        steepness = np.array(_steepness(entries.size, entries.bent), dtype=np.float64).ravel()
        turns = np.array(entries.turns, dtype=np.float64).ravel()
        return float(1 + np.sum(steepness * turns) / max(np.sum(steepness), 1e-300))

    def to_go(self, key: str) -> float:
        value, _, _, extra = self.state[key]
        (entries, *_), (_, _, earlier, _, _, *squares) = _parts(extra)
        left = np.abs([float(np.array(each).ravel()[0]) for each in squares])
        steepness = np.array(_steepness(entries.size, entries.bent), dtype=np.float64).ravel()
        moved = np.array(dr.detach(value).array - earlier, dtype=np.float64).ravel()
        if left.max() >= np.float32(UNKNOWN) or not steepness.any():
            return float("inf")
        far = np.sum(steepness * np.square(moved)) / np.sum(steepness)
        return float(np.sqrt(max(SURE**2 * left.max(), far)))


def _parts(extra: tuple[Any, ...]) -> tuple[list[Moments], tuple[Any, ...]]:
    """Return the moments of the entries, those of the fine steps, if any, and the other data of `Newton`."""
    width, others = len(Moments._fields), len(extra) - 5 - RECENT
    return [Moments(*extra[at : at + width]) for at in range(0, others, width)], extra[others:]


def _advance(
    moments: Moments, rows: tuple[Any, ...], weights: Any, most: Any, near: Any, coarse: Any = None
) -> tuple[Any, Any, Moments]:
    """Return the step, the curvature, and the moments after one more gradient.

    `rows` are the gradient, its change and the change of the value since the last step. `weights` is the sum of the
    weights in s and v before the step, `most` is L, and `near` is P. Fine steps need the curvature h of the entries,
    `coarse`.
    """
    grad, turned, moved = rows
    velocity, size = moments.velocity, dr.lerp(dr.abs(grad), moments.size, MEMORY)
    spread, steepness = _root_mean(grad, moments.spread, MEMORY), _steepness(size, moments.bent)
    surprise = math.sqrt(0.5) * (turned - steepness * moved)
    mean = dr.select(weights > 1.5 * (1 - MEMORY), _root_mean(surprise, moments.noise, FORGETTING), dr.abs(surprise))
    noise = dr.select(weights > 0, mean, 0)  # the first gradient has no predecessor
    if coarse is not None:
        started = (steepness > 0) & (weights > 1 - MEMORY ** (EARLY - 0.5))
        unseen = UNSEEN**2 * coarse * (coarse / steepness)  # squares of curvatures would underflow
        steepness = dr.select(started, steepness + unseen, 0)
    known = steepness > 0
    turns = moments.turns + dr.select((grad < 0) & (velocity > 0) | (grad > 0) & (velocity < 0), 1, 0)
    longest = most * dr.select(known, dr.square(size / spread) / dr.lerp(1, weights, MEMORY), 1)
    divisor = _divisor(steepness, turns, noise, near)
    reach = (1 - MOMENTUM) * longest * divisor
    velocity = MOMENTUM * velocity + dr.clip(grad, -reach, reach)
    step = dr.select(known, dr.clip(velocity / divisor, -longest, longest), 0)
    return step, steepness, Moments(velocity, size, turns, moments.bent, spread, noise)


def fine_part(texels: Any, shape: tuple[int, ...]) -> Any:
    """Return flat texels minus their means over 3 x 3 texels with binomial weights. `shape` is (H, W, channels).

    The map is linear, and its matrix is symmetric.
    """
    H, W, channels = shape
    index = dr.int32_array_t(texels)(dr.arange(dr.uint32_array_t(texels), H * W * channels))
    channel, column, row = index % channels, index // channels % W, index // (channels * W)
    mean = dr.zeros(type(texels), H * W * channels)
    for down, right in itertools.product((-1, 0, 1), repeat=2):
        at = dr.clip(row + down, 0, H - 1) * W + dr.clip(column + right, 0, W - 1)
        neighbour = dr.gather(type(texels), texels, dr.uint32_array_t(texels)(at * channels + channel))
        mean += (2 - abs(down)) * (2 - abs(right)) / 16 * neighbour
    return texels - mean


def _steepness(size: Any, bent: Any) -> Any:
    """Return the curvature of each entry, which is 0 if it is not known."""
    largest = dr.max(flat(size))
    unit = dr.select(largest > 0, size / largest, 0)  # squares of gradients would underflow
    octaves = dr.clip(-OCTAVE * dr.log2(unit), 0, CLASSES - 1)
    number = CLASSES - 1 - dr.uint32_array_t(octaves)(octaves)  # the class with the smallest gradients is the first
    sums = []
    for each in (bent * unit, unit * unit, dr.select(unit > 0, type(unit)(1), 0)):
        classes = dr.zeros(type(unit), CLASSES)
        dr.scatter_add(classes, each, number)
        sums.append(dr.cumsum(classes))
    least = SHARE * dr.max(sums[2])
    number = dr.maximum(number, dr.sum(dr.select(sums[2] < least, dr.uint32_array_t(sums[2])(1), 0)))
    squares = dr.gather(type(unit), sums[1], number)
    return dr.select(squares > 0, dr.abs(dr.gather(type(unit), sums[0], number)) / squares * unit, 0)


def _divisor(steepness: Any, turns: Any, noise: Any, near: Any) -> Any:
    """Return d of each entry from h, n, the root of r, and P."""
    noisy = dr.select(steepness > 0, dr.square(noise / (steepness * near)), 0)  # squares of gradients would underflow
    return steepness * ((1 + SHORTER * turns) / GAIN + (1 - MOMENTUM) * noisy)


def _root_mean(grad: Any, spread: Any, memory: float) -> Any:
    """Return the root of the running mean of squares with one more gradient. Squares of gradients would underflow."""
    largest = dr.maximum(dr.abs(grad), spread)
    root = largest * dr.sqrt(dr.lerp(dr.square(grad / largest), dr.square(spread / largest), memory))
    return dr.select(largest > 0, root, 0)
