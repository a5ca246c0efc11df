"""Calibration of verdicts and spreads, over simulated runs whose true values are known.

Adam, SGD or `auto` minimises a quadratic function with noisy gradients. The cases combine tails of the noise, numbers
of iterations, coupling between entries, schedules, rates, and a measured curvature that is wrong by a factor of 0.5 to
2. Half of the cases have one to four scalars. The other half have a texture of 16 x 16 texels, whose image is blurred.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from reslrb_cli.optimization.loop import close_enough, joint_cost
from reslrb_cli.optimization.optimizers import SMALL, Optimizer
from reslrb_cli.optimization.uncertainty.curvature import EntryCurvature, ParameterDirection
from reslrb_cli.optimization.uncertainty.measuring import PROBES, brightness, gradient_count
from reslrb_cli.optimization.uncertainty.posterior import Measured
from reslrb_cli.optimization.uncertainty.verdicts import ParameterCertainty, weigh
from reslrb_cli.statistics import Array, rms

#: Runs of each kind.
RUNS = 720
SIDE = 16
ITERATIONS, TAILS, COUPLINGS = (30, 100, 300), ("normal", "t3", "fireflies"), (0.0, 0.25, 0.5, 0.9)
#: Scale of all parameters: half of the distance between the bounds 0 and 1.
SCALE = 0.5

Random = np.random.Generator


@dataclass
class Case:
    """One simulated run: the curvature H, a root of its matrix, and the true values (N,)."""

    tails: str
    iterations: int
    coupling: float
    H: Array
    root: Array
    truth: Array

    def noise(self, random: Random, size: int) -> Array:
        """Return noise of variance 1. Of the fireflies, 1 % are 30 times as large as the rest."""
        if self.tails == "t3":
            return random.standard_t(3, size) / np.sqrt(3)
        normal = random.normal(size=size)
        if self.tails == "normal":
            return normal
        return normal * np.where(random.random(size) < 0.01, 30.0, 1.0) / np.sqrt(0.99 + 9.0)


@dataclass
class Judged:
    """Verdict on one parameter, its error, its spread, and its tolerance."""

    case: Case
    off: float
    verdict: str
    error: float
    spread: float
    tolerance: float


def blur(width: float) -> Array:
    """Return the image (N, N) of a texture under a Gaussian filter of `width` texels. The texture has no border."""
    at = np.arange(SIDE)
    line = np.exp(-0.5 * (np.minimum(at, SIDE - at) / width) ** 2)
    rows = np.array([np.roll(line / line.sum(), shift) for shift in at])
    return np.kron(rows, rows)


def make_case(random: Random, number: int, is_texture: bool) -> Case:
    iterations, tails = ITERATIONS[number % 3], TAILS[number // 3 % 3]
    coupling = COUPLINGS[number // 9 % 4]
    if is_texture:
        A, light = blur(0.3 + 0.5 * coupling), np.exp(0.5 * random.normal(size=SIDE**2))
        root = A.T * np.sqrt(light)
        root /= np.sqrt(np.mean(np.sum(root**2, axis=1)))
        H = root @ root.T
    else:
        count = int(random.choice([1, 2, 4]))
        sizes, signs = np.exp(random.uniform(np.log(0.1), 0, count)), random.choice([-1.0, 1.0], count)
        alike = coupling * np.outer(signs, signs) + (1 - coupling) * np.eye(count)
        H = alike * np.sqrt(np.outer(sizes, sizes))
        root = np.linalg.cholesky(H)
    return Case(tails, iterations, coupling, H, root, random.uniform(0.15, 0.85, len(H)))


Gradient = Callable[[Array], Array]
#: Values (N,) after the last of T iterations, values and gradients (T, N) of all iterations, and the movement (N,) by
#: the last step per unit of gradient.
Course = tuple[Array, Array, Array, Array]


def recover(random: Random, case: Case, is_texture: bool, by_auto: bool, off: float) -> tuple[Measured, Array, Array]:
    """Run the optimiser. Return the measurements as of one parameter, all values, and all gradients (T, N)."""
    count, truth = len(case.truth), case.truth
    if not is_texture:
        distance = random.choice([-1, 1], count) * random.uniform(0.05, 0.5, count)
        start = np.clip(truth + distance, 0.02, 0.98)
    elif random.random() < 0.3:
        start = np.clip(truth * random.uniform(0.5, 1.3), 0, 1)
    else:
        start = np.full(count, random.uniform(0.2, 0.8))
    # The Jacobian correlates a part of the noise. The noise may grow with the distance from the optimum.
    alike, grows = random.uniform(), random.choice([0.0, 1.0])
    size = np.exp(random.uniform(np.log(0.02), np.log(3.0)))

    def gradient(x: Array) -> Array:
        shared = case.root @ case.noise(random, count)
        own = np.sqrt(np.diag(case.H)) * case.noise(random, count)
        noise = np.sqrt(alike) * shared + np.sqrt(1 - alike) * own
        return np.asarray(case.H @ (x - truth) + size * (0.1 + grows * rms(x - truth)) * noise)

    found = run_auto(case, start, gradient, off) if by_auto else run_at_a_rate(random, case, start, gradient)
    x, values, gradients, moved = found
    few = np.array([gradient(x) for _ in range(gradient_count(len(values)))])
    return Measured(x, (0.0, 1.0), SCALE, few, moved, not is_texture, start), values, gradients


def run_auto(case: Case, start: Array, gradient: Gradient, off: float) -> Course:
    """Run `auto` until it ends by itself, or until the last iteration. The curvature that it measures is `off` times
    the true one. Each scalar is one parameter.
    """
    T, count = case.iterations, len(start)
    is_small = count <= SMALL
    keys = [f"p{k}" for k in range(count)] if is_small else ["t"]
    rows = start[:, None] if is_small else start[None]
    tensors = {key: mi.TensorXf(row.astype(np.float32)) for key, row in zip(keys, rows, strict=True)}
    optimizer = Optimizer("auto", 1.0, {}, tensors, dict.fromkeys(keys), dict.fromkeys(keys, (0.0, 1.0)))

    def now(key: str | None = None) -> Array:
        found = [np.array(dr.detach(optimizer[each]), dtype=np.float64) for each in ([key] if key else keys)]
        return np.concatenate(found)

    def accumulate(g: Array) -> None:
        for key, row in zip(keys, np.reshape(g, rows.shape), strict=True):
            dr.backward(dr.sum(optimizer[key] * mi.TensorXf(row.astype(np.float32)), axis=None))

    problem, values, gradients = SimpleNamespace(optimizer=optimizer, selection=SimpleNamespace(array=now)), [], []
    for iteration in range(T):
        if iteration and close_enough(problem, iteration):
            break
        values.append(x := now())
        gradients.append(g := gradient(x))
        accumulate(g)
        if is_small and joint_cost(iteration) is not None:
            optimizer.block.bend(off * case.H)
        elif not is_small and (iteration + 2) & (iteration + 1) == 0:
            with optimizer.displaced(np.random.default_rng(iteration)):
                accumulate(g + off * case.H @ (now() - x))
        optimizer.step(1.0)
    moved = np.concatenate([optimizer.response(key) for key in keys])
    return now(), np.array(values), np.array(gradients), np.nan_to_num(moved)


def run_at_a_rate(random: Random, case: Case, start: Array, gradient: Gradient) -> Course:
    """Run Adam, or SGD with momentum, at a random rate and schedule."""
    count, T = len(start), case.iterations
    rate, beta = np.exp(random.uniform(np.log(0.005), np.log(0.06))), random.choice([0.99, 0.999])
    by_adam, steepest = random.random() < 0.8, float(np.linalg.eigvalsh(case.H)[-1])
    progress = np.arange(T) / (T - 1)
    rates = [np.ones(T), 0.51 + 0.49 * np.cos(np.pi * progress), 0.05**progress][random.integers(3)]
    x, m, v, values, gradients = start.copy(), np.zeros(count), np.zeros(count), [], []
    response = np.ones(count)
    for number, factor in enumerate(rates):
        values.append(x)
        gradients.append(g := gradient(x))
        if by_adam:
            m, v = 0.9 * m + 0.1 * g, beta * v + (1 - beta) * g**2
            response = rate / (np.sqrt(v / (1 - beta ** (number + 1))) + 1e-15)
            step = response * m / (1 - 0.9 ** (number + 1))
        else:
            m = 0.9 * m + g
            response = np.full(count, 13 * rate / steepest)
            step = 0.1 * response * m
        x = np.clip(x - factor * step, 0, 1)
    return x, np.array(values), np.array(gradients), response * rates[-1]


def judge_scalars(own: Measured, values: Array, gradients: Array, H: Array) -> list[ParameterCertainty]:
    half, measured = len(values) // 2, {}
    for k in range(len(H)):
        last = np.stack([gradients, values], axis=1)[half:, :, k : k + 1]
        entry = slice(k, k + 1)
        measured[f"p{k}"] = Measured(
            own.value[entry], own.bounds, SCALE, own.gradients[:, entry], own.step[entry], True, own.start[entry], last
        )
    directions = [ParameterDirection(key, np.ones(1), None, 0) for key in measured]
    return list(weigh(measured, directions, H, np.zeros_like(H), {}).values())


def judge_texture(
    own: Measured, values: Array, gradients: Array, H: Array, probes: Sequence[tuple[Array, Array]]
) -> ParameterCertainty:
    half, row = len(values) // 2, own.value
    last = np.array([brightness(g, x, 1) for g, x in zip(gradients[half:], values[half:], strict=True)])
    object.__setattr__(own, "last", last)
    object.__setattr__(own, "rows", np.stack([gradients, values], axis=1)[half:])
    found = weigh(
        {"t": own}, [ParameterDirection("t", row)], np.array([[row @ H @ row]]), np.zeros((1, 1)),
        {"t": EntryCurvature(np.mean([a * b for a, b in probes], axis=0), None, probes, (SIDE, SIDE, 1))},
    )  # fmt: skip
    return found["t"]


def judge_runs(random: Random, is_texture: bool, by_auto: bool) -> Iterator[Judged]:
    for number in range(RUNS):
        case = make_case(random, number, is_texture)
        off = float(np.exp(random.uniform(np.log(0.5), np.log(2))))
        own, values, gradients = recover(random, case, is_texture, by_auto, off)
        errors = np.abs(own.value - case.truth)
        if not is_texture:
            for k, about in enumerate(judge_scalars(own, values, gradients, off * case.H)):
                spread = np.nan if about.spread is None else about.spread[0]
                yield Judged(case, off, about.verdict, errors[k], spread, float(own.tolerance(own.value[k])))
            continue
        probes = []
        for _ in range(PROBES):
            signs, noise = random.choice([-1.0, 1.0], SIDE**2), random.normal(size=(2, SIDE**2))
            a, b = np.sqrt(off) * (case.root @ signs + 0.5 * np.sqrt(np.diag(case.H)) * noise)
            probes.append((a, b))
        about = judge_texture(own, values, gradients, off * case.H, probes)
        spread = np.nan if about.spread is None else about.spread[0]
        yield Judged(case, off, about.verdict, rms(errors), spread, float(own.tolerance(rms(own.value))))


def figures(found: Sequence[Judged]) -> tuple[float, float, float]:
    """Return P(error > tolerance | settled), P(settled | error <= tolerance), and the rms of errors over spreads."""
    settled = np.array([each.verdict == "settled" for each in found])
    within = np.array([each.error <= each.tolerance for each in found])
    z = np.array([each.error / each.spread for each in found])
    wrong = float(np.mean(~within[settled])) if settled.any() else 0.0
    return wrong, float(np.mean(settled[within])), float(np.sqrt(np.nanmean(z**2)))


@pytest.mark.long
@pytest.mark.parametrize("by_auto", [False, True], ids=["adam", "auto"])
@pytest.mark.parametrize("is_texture", [False, True], ids=["scalars", "textures"])
def test_verdicts_are_calibrated(llvm: str, is_texture: bool, by_auto: bool) -> None:
    found = list(judge_runs(np.random.default_rng(7), is_texture, by_auto))
    parts = {"all": found}
    for name in ("iterations", "tails", "coupling"):
        for value in sorted({getattr(each.case, name) for each in found}):
            parts[f"{name} {value}"] = [each for each in found if getattr(each.case, name) == value]
    parts["curvature 1.25 to 2 times too large"] = [each for each in found if each.off > 1.25]
    for name, part in parts.items():
        wrong, right, size = figures(part)
        print(f"{name}: wrong {100 * wrong:.1f} % of settled; settled {100 * right:.0f} % of right; z {size:.2f}")
    wrong, right, size = figures(found)
    assert wrong <= 0.05
    assert right >= 0.7
    assert 0.8 <= size <= 1.3
