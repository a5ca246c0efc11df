"""Textures whose single entries compensate for a small parameter, or for another texture of the same shape.

The directions of `curvature.py` change the brightness of a texture as a whole. Two cases need single entries.

**A small parameter and textures.** The tint of a mirror, and the texels that only the mirror shows, give the same image
if one rises and the others fall. Let J u be the change of the image by a small parameter, and H the curvature of a
texture with the values x. The change d of the texels makes up for u best if H d = -J^T W J u. It is approximated by
`ROUNDS` steps of accelerated gradient descent (Nesterov 1983).

    d <- d - J^T W J (u + d) / r,   r = H x / x

A matrix H without negative entries satisfies diag(r) >= H, so these steps converge. `followed` returns the changes in
which d accompanies u. The curvature along such a change is the one that remains if the textures may follow. A gradient
along u + d does not depend on the offsets of the textures. If u is off by one spread, the texels are off by d spreads
(`texel_offsets`).

**Maps of one shape.** The colour, the roughness and the metallic weight of a texel change the same pixels. A shape is
divided into cells, which are the texels of its coarsest map, or the vertices of a mesh. A and B are two maps of the
shape, each with one channel, and i is a cell.

    M_AB,i = sum over entries j of A in i:  x_j (J^T W J x_B)_j

J x_B is the change of the image if B changes in proportion to its values, in every second cell only, so that
neighbouring cells do not add to M. M has two independent samples. Its deviations from zero between maps, and from the
mean within a map, are multiplied by the share of their mean square that both samples have in common.

In a cell, the mean y of the gradients measures M d, where d is the offset of the maps. Noise of the image reaches the
gradients through J, so the covariance of y is s M. The variance of y determines s. The largest s of the maps counts,
because the gradients drift if the run has not converged. With the standard deviations C^(1/2) before the run,

    P = M / s + C^-1,   mean square of d = min(max(diag(P^-1), (P^-1 y / s)^2), C)

The part that exceeds the mean square with the diagonal of M alone is what the images do not determine, because another
map compensates for it (`Maps.undetermined`).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.uncertainty.curvature import (
    LossCurvature,
    ParameterChange,
    ParameterDirection,
    row_of,
    separates,
)
from reslrb_cli.optimization.uncertainty.posterior import Measured
from reslrb_cli.statistics import Array, rms

#: Noise of M, as a share of its mean diagonal, at which measurements end. It hides smaller eigenvalues.
MOST_NOISE = 0.1
#: Renderings in the search for the texels that compensate for a small parameter.
ROUNDS = 8


def followed(
    curvature: LossCurvature,
    changes: Sequence[ParameterChange],
    free: Mapping[str, Array],
    go_on: Callable[[], bool],
) -> list[ParameterChange]:
    """Return the changes of small parameters, together with those of the textures that compensate for them best. The
    list is shorter if `go_on` returns false.

    `free` has the entries (N,) of each large parameter that may move. Textures without a change in `changes` stay.
    """
    problem, stiff = curvature.problem, dict[str, Array]()
    for change in changes:
        if (key := change.directions[0].key) in free and go_on():
            samples = [sample[key] for sample in curvature.products(change)]
            value = np.abs(row_of(problem, key))
            # The noise of r makes d too small rather than too large.
            sums = sum((a + b) / 2 + np.abs(a - b) / 2 for a, b in samples)
            stiff[key] = np.where(free[key] & (value > 0), sums, 0.0) / np.where(value > 0, value, 1.0)
    found: list[ParameterChange] = []
    together = all(separates(problem, key) for key in stiff)
    for change in changes if stiff else ():
        if change.directions[0].key in free:
            continue
        split = [] if together else [_alone(problem, change, direction) for direction in change.directions]
        for part in split or [change]:
            if not go_on():
                return found
            found += _best(curvature, part, stiff, go_on)
    return found


def with_followed(directions: Sequence[ParameterDirection], H: Array, count: int) -> list[int]:
    """Return the places of `count` directions among those of `directions` and H.

    There are `count` directions without textures that follow, and then those of `followed`. A direction is replaced by
    the one that textures follow if its curvature is smaller.
    """
    chosen = list(range(count))
    places = {(each.key, each.entry): place for place, each in enumerate(directions[:count])}
    for place, direction in enumerate(directions[count:], count):
        first = places[direction.key, direction.entry]
        if H[place, place] < H[first, first]:
            chosen[first] = place
    return chosen


def texel_offsets(directions: Sequence[ParameterDirection], spreads: Sequence[float]) -> dict[str, tuple[Array, str]]:
    """Return the mean square offset of each texel (N,) that follows small parameters with these spreads. Also return
    the parameter that causes most of it. The results are by texture.
    """
    parts: dict[str, dict[str, Array]] = {}
    for direction, spread in zip(directions, spreads, strict=True):
        for key, d in direction.followers.items():
            by_source = parts.setdefault(key, {})
            by_source[direction.key] = by_source.get(direction.key, 0.0) + (spread * d) ** 2
    return {key: (np.sum(list(found.values()), axis=0), max(found, key=lambda name: float(found[name].sum())))
            for key, found in parts.items()}  # fmt: skip


def _alone(problem: Problem, change: ParameterChange, direction: ParameterDirection) -> ParameterChange:
    """Return the part of a change along one of its directions."""
    row = row_of(problem, direction.key) + change.amount * direction.vector
    array = row.reshape(problem.selection.array(direction.key).shape)
    return ParameterChange({direction.key: array}, change.amount, [direction])


def _best(
    curvature: LossCurvature, change: ParameterChange, stiff: Mapping[str, Array], go_on: Callable[[], bool]
) -> list[ParameterChange]:
    """Return a change of a small parameter with the changes of the textures that compensate for it best, or no change
    if no texture moves. `stiff` has r (N,) for each texture.
    """
    problem, key = curvature.problem, change.directions[0].key
    unit = np.sum([direction.vector for direction in change.directions], axis=0)
    channels = [direction.channel for direction in change.directions]
    whole = replace(change.directions[0], vector=unit, channel=channels[0] if len(channels) == 1 else None)
    last = d = after = best = {name: np.zeros(r.size) for name, r in stiff.items()}
    least, first = np.inf, dict[str, Array]()
    for number in range(ROUNDS):
        moved, d = _together(problem, change, d)
        (samples,) = curvature.products(replace(moved, directions=[whole]))
        product = {name: np.mean(both, axis=0) for name, both in samples.items()}
        after = {name: d[name] - np.where(r > 0, product[name], 0.0) / np.where(r > 0, r, 1.0)
                 for name, r in stiff.items()}  # fmt: skip
        left = float(product[key] @ unit) + sum(float(product[name] @ part) for name, part in d.items())
        if number == 0:
            first, best = product, after
        elif left < least:
            best, least = d, left
        if not go_on():
            break
        d = {name: row + number / (number + 3) * (row - last[name]) for name, row in after.items()}
        last = after
    if not any(row.any() for row in best.values()):
        return []
    moved, best = _together(problem, change, best)
    directions, are_separate = [], all(separates(problem, name) for name in best)
    for direction in change.directions:
        channel, parts = direction.channel if are_separate else None, best
        if channel is not None:
            parts = {name: np.where(np.arange(row.size) % 3 == channel, row, 0.0) for name, row in best.items()}
        partner = max(parts, key=lambda name: abs(float(first[name] @ parts[name])))
        directions.append(replace(direction, channel=channel, partner=partner, followers=parts))
    return [replace(moved, directions=directions)]


def _together(
    problem: Problem, change: ParameterChange, d: Mapping[str, Array]
) -> tuple[ParameterChange, dict[str, Array]]:
    """Add the changes `d` of textures to a change of a small parameter. Also return `d` within the bounds."""
    values, inside = dict(change.values), {}
    for key, part in d.items():
        row, (low, high) = row_of(problem, key), problem.selection.specs[key].bounds or (-np.inf, np.inf)
        moved = np.clip(row + change.amount * part, np.minimum(low, row), np.maximum(high, row))
        values[key], inside[key] = _shown(problem, key, moved), (moved - row) / change.amount
    return replace(change, values=values), inside


def _shown(problem: Problem, key: str, row: Array) -> Array:
    """Return a flat value of a texture in the form of `Selection.array`, without the halo of an environment map."""
    shape = problem.selection.array(key).shape
    if row.size == np.prod(shape):
        return row.reshape(shape)
    wide, halo = row.reshape(shape[0], -1, shape[2]), problem.selection.slot(key).halo
    return wide[:, halo : halo + shape[1]]


@dataclass(frozen=True)
class Maps:
    """Maps of one shape with n cells. `names` has the key and the channel of each of the K maps.

    `matrix` (n, K, K) is M per unit of the values, and `noise` its root mean square error in units in which the mean of
    its diagonal is 1. `sizes` (n, K) are the root mean squares of the
    values in each cell. `places` has the map and the cell of each entry (N,) of a parameter.
    """

    names: Sequence[tuple[str, int]]
    matrix: Array
    noise: float
    sizes: Array
    places: Mapping[str, tuple[Array, Array]]

    def undetermined(self, measured: Mapping[str, Measured], of_target: Mapping[str, float]) -> dict[str, Array]:
        """Return the mean square offset of each entry (N,) from its optimum, minus the one if all other maps were
        known.

        `of_target` is the mean curvature B of each parameter by the noise of the target.
        """
        count, K = self.matrix.shape[:2]
        prior = np.array([measured[key].prior for key, _ in self.names])
        blocks = min(len(measured[key].in_blocks[0]) for key in self.places)
        y, moved = np.zeros((2, blocks, count, K))
        for key, (maps, cells) in self.places.items():
            own = measured[key]
            weight = own.value / self.sizes[cells, maps]  # of a change in proportion to the values
            entries = np.zeros((count, K))
            np.add.at(entries, (cells, maps), 1.0)
            for block, (gradient, shift) in enumerate(zip(*(each[-blocks:] for each in own.in_blocks), strict=True)):
                np.add.at(y[block], (cells, maps), gradient * weight)
                np.add.at(moved[block], (cells, maps), shift / entries[cells, maps])
        y -= np.einsum("nkl,bnl->bnk", self.matrix, moved)
        h = np.einsum("nkk->k", self.matrix) / count
        noise = y.var(axis=0, ddof=1).mean(axis=0) / blocks + [of_target[key] for key, _ in self.names]
        s = float(np.max(noise[h > 0] / h[h > 0], initial=1e-300))
        precision = self.matrix / s
        joint = _mean_squares(precision, y.mean(axis=0) / s, prior)
        alone = _mean_squares(precision * np.eye(K), y.mean(axis=0) / s, prior)
        return {key: (joint - alone)[cells, maps] for key, (maps, cells) in self.places.items()}

    def partner(self, key: str) -> str | None:
        """Return the parameter whose maps are most similar to those of `key` in the mean over the cells."""
        size = np.sqrt(np.maximum(np.einsum("nkk->nk", self.matrix), 1e-300))
        alike = np.mean(np.square(self.matrix / (size[:, :, None] * size[:, None, :])), axis=0)
        own = [place for place, (name, _) in enumerate(self.names) if name == key]
        others = {name: float(alike[own, place].max()) for place, (name, _) in enumerate(self.names) if name != key}
        return max(others, key=lambda name: others[name]) if others else None


def _mean_squares(precision: Array, pull: Array, prior: Array) -> Array:
    """Return the mean squares (n, K) of offsets with the `precision` (n, K, K) of the gradients, which are `pull`
    (n, K) in the same units, and with standard deviations `prior` (K,) at the start.
    """
    covariance = np.linalg.inv(precision + np.diag(1 / prior**2))
    offsets = np.einsum("nkl,nl->nk", covariance, pull)
    return np.minimum(np.maximum(offsets**2, np.einsum("nkk->nk", covariance)), prior**2)  # as in `spread_of`


def measure_maps(
    curvature: LossCurvature, large: Collection[str], share: float, most: int, go_on: Callable[[], bool]
) -> tuple[list[Maps], set[str]]:
    """Measure the maps of each shape that has several of the `large` parameters with common cells. Steps are `share`
    of the values. Also return the parameters of the shapes that `go_on` left out.

    The measurement is repeated with four times the samples, up to `most` samples per pixel, until the noise is small.
    More noise may hide small eigenvalues of M, and the spreads are then too large.
    """
    problem, found, left, by_shape = curvature.problem, list[Maps](), set[str](), dict[str, list[str]]()
    for key in problem.selection.keys:
        if key in problem.selection.params and key in large:
            by_shape.setdefault(key.split(".")[0], []).append(key)
    for keys in by_shape.values():
        if len(places := _cells(problem, keys)) < 2:
            continue
        latest, best = curvature, None
        while (made := _measure(latest, places, share, go_on)) is not None:
            best = made
            if made.noise <= MOST_NOISE or 4 * latest.spp > most:
                break
            latest = LossCurvature(problem, 4 * latest.spp, of_target=False, round=latest.round + 3)
        if best is None:
            left |= set(places)
        else:
            found.append(best)
    return found, left


def _cells(problem: Problem, keys: Sequence[str]) -> dict[str, tuple[Array, Array, Array]]:
    """Return the channel, the cell, and the half (0 or 1) of the cell for each entry of maps with common cells."""
    arrays = {key: problem.selection.array(key) for key in keys}
    textures = {key: array.shape for key, array in arrays.items()
                if array.ndim == 3 and array.size == row_of(problem, key).size}  # fmt: skip
    if len(textures) > 1:
        rows, columns = (min(shape[axis] for shape in textures.values()) for axis in (0, 1))
        found = {}
        for key, shape in textures.items():
            row, column, channel = np.indices(shape).reshape(3, -1)
            row, column = row * rows // shape[0], column * columns // shape[1]
            found[key] = channel, row * columns + column, (row + column) % 2
        return found
    flat = {key: array.size for key, array in arrays.items() if array.ndim == 1 and ".vertex_" in key}
    count = min(flat.values(), default=0)
    halves = np.random.default_rng(0).integers(0, 2, count)
    return {key: (np.arange(size) % (size // count), np.arange(size) // (size // count),
                  np.repeat(halves, size // count)) for key, size in flat.items() if size % count == 0}  # fmt: skip


def _measure(
    curvature: LossCurvature,
    places: Mapping[str, tuple[Array, Array, Array]],
    share: float,
    go_on: Callable[[], bool],
) -> Maps | None:
    """Return the maps of one shape, or None if `go_on` returns false."""
    problem = curvature.problem
    names = [(key, channel) for key, (channels, *_) in places.items() for channel in range(int(channels.max()) + 1)]
    count = 1 + max(int(cells.max()) for _, cells, _ in places.values())
    values = {key: row_of(problem, key) for key in places}
    M, size = np.zeros((2, count, len(names), len(names))), np.zeros((count, len(names)))
    for column, (key, channel) in enumerate(names):
        channels, cells, halves = places[key]
        entries = np.bincount(cells[channels == channel], minlength=count)
        squares = np.bincount(cells, np.where(channels == channel, values[key] ** 2, 0.0), minlength=count)
        size[:, column] = np.sqrt(squares / np.maximum(entries, 1))
        for half in (0, 1):
            if not go_on():
                return None
            vector = np.where((channels == channel) & (halves == half), values[key], 0.0)
            changed = (values[key] - share * vector).reshape(problem.selection.array(key).shape)
            direction = ParameterDirection(key, vector, channel if separates(problem, key) else None)
            (product,) = curvature.products(ParameterChange({key: changed}, -share, [direction]))
            for row, (other, number) in enumerate(names):
                here = (places[other][0] == number) & (places[other][2] == half)
                for sample in (0, 1):
                    terms = np.where(here, values[other] * product[other][sample], 0.0)
                    M[sample, :, row, column] += np.bincount(places[other][1], terms, minlength=count)
    units = np.maximum(size, 1e-3 * size.mean(axis=0) + 1e-300)
    M /= (units[:, :, None] * units[:, None, :])[None]
    firsts = np.cumsum([0, *(int(channels.max()) + 1 for channels, *_ in places.values())])
    found = {key: (first + channels, cells)
             for first, (key, (channels, cells, _)) in zip(firsts, places.items(), strict=False)}  # fmt: skip
    return make_maps(names, 0.5 * (M + M.swapaxes(2, 3)), units, found)


def make_maps(
    names: Sequence[tuple[str, int]], samples: Array, sizes: Array, places: Mapping[str, tuple[Array, Array]]
) -> Maps:
    """Return maps from two independent samples of M (2, n, K, K), without their noise and negative eigenvalues."""
    mean = np.mean(samples, axis=0)
    middle = np.maximum(np.einsum("nkk->k", mean) / len(mean), 0.0)
    root = np.sqrt(np.where(middle > 0, middle, 1.0))
    units, centre = np.outer(root, root), np.diag((middle > 0).astype(float))
    (a, b), used = samples / units, middle > 0
    weight = np.sum((a - centre) * (b - centre), axis=0)
    weight = np.clip(weight / np.maximum(np.sum((mean / units - centre) ** 2, axis=0), 1e-300), 0, 1)
    values, vectors = np.linalg.eigh(centre + weight * (mean / units - centre))
    matrix = np.asarray((vectors * np.maximum(values, 0.0)[:, None]) @ vectors.swapaxes(1, 2) * units)
    noise = rms((a - b)[:, used][:, :, used] / 2) if used.any() else 0.0
    return Maps(names, matrix, noise, sizes, places)
