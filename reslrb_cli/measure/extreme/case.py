"""What a case of the extreme suite is: a scene, its parameters, and what their gradient is known by."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from reslrb_cli.measure.analytic_scenes import KnownScene
from reslrb_cli.measure.attached.amplitudes import AMPLITUDES, Displaced, Move
from reslrb_cli.measure.gradients import Case, integrator, seeds
from reslrb_cli.measure.moving import smooth_weights
from reslrb_cli.measure.small_scenes import load
from reslrb_cli.records.gradcheck import Reference

Scene = Callable[[], dict]


@dataclass(frozen=True)
class Samples:
    """A reference's gradients: (N, P) of seeds of its own, (N, P) of ours (`paired`), or (P,) exact values.

    `along` (K, P) are directions in which alone it knows the derivative; None: all entries. By `bias` the reference
    may be wrong itself.
    """

    values: np.ndarray
    paired: bool = False
    along: np.ndarray | None = None
    bias: np.ndarray | float = 0.0


@dataclass(frozen=True)
class Stock:
    """A stock integrator in the same scene. Where roulette is on, the reference goes without it: see docs/method.md."""

    name: str
    spp: int | None = None

    @property
    def reference(self) -> Reference:
        return Reference(self.name)

    def samples(self, case: ExtremeCase, setup: Case) -> Samples:
        tracer = integrator(self.name, **without_roulette(case))
        return Samples(setup.gradients(tracer, seeds(case.seeds, 1), self.spp or case.spp))


@dataclass(frozen=True)
class Twin:
    """A stock integrator in another scene, whose gradients are known multiples of this one's.

    `factors` are by parameter; those that are not named are 1. `keys` are the parameters there, in our order.
    """

    scene: Scene
    factors: Mapping[str, float] = field(default_factory=dict)
    keys: tuple[str, ...] = ()
    name: str = "ptracer"

    @property
    def reference(self) -> Reference:
        return Reference(self.name)

    def samples(self, case: ExtremeCase, setup: Case) -> Samples:
        keys = self.keys or case.keys
        other = Case(self.scene(), keys)
        other.weights = setup.weights
        values = other.gradients(integrator(self.name, **without_roulette(case)), seeds(case.seeds, 1), case.spp)
        scale = [np.full(len(other.initial[key]), self.factors.get(key, 1.0)) for key in keys]
        return Samples(values * np.concatenate(scale))


@dataclass(frozen=True)
class Differences:
    """Finite differences of our image, without roulette, along random directions into the domain.

    At the gradient's own random numbers they are exact up to rounding where paths do not depend on the parameters and
    the image is a polynomial of degree 2.
    """

    step: float
    sides: str = "both"
    along: int = 2
    reference = Reference.FINITE_DIFFERENCE

    def samples(self, case: ExtremeCase, setup: Case) -> Samples:
        directions = setup.directions(self.along)
        along = directions if self.sides == "both" else np.abs(directions)
        tracer = integrator("reslrb", **without_roulette(case))
        paired = "rr_depth" not in case.options
        values = [
            [setup.difference(tracer, direction, seed, case.spp, self.step, self.sides) for direction in along]
            for seed in seeds(case.seeds, 0 if paired else 1)
        ]
        return Samples(np.array(values), paired=paired, along=along)


@dataclass(frozen=True)
class Extrapolated:
    """Finite differences of the image at the gradient's own random numbers, of each amplitude of what moves.

    Those of `step` are corrected by those of twice the step, after Richardson. A tenth of the correction may be wrong,
    and `left` of their root mean square, which the faces of a mesh and higher powers of the step leave.
    """

    step: float
    left: float = 1e-3
    reference = Reference.FINITE_DIFFERENCE

    def samples(self, case: ExtremeCase, setup: Case) -> Samples:
        along = np.eye(sum(len(value) for value in setup.initial.values()))
        tracer = integrator("reslrb", **without_roulette(case))
        near, far = (
            np.array([[setup.difference(tracer, d, seed, case.spp, step) for d in along] for seed in seeds(case.seeds)])
            for step in (self.step, 2 * self.step)
        )
        correction = (near - far) / 3
        values = near + correction
        size = float(np.sqrt(np.mean(np.square(values.mean(0)))))
        return Samples(values, True, along, bias=np.abs(correction.mean(0)) / 10 + self.left * size)


@dataclass(frozen=True)
class Exact:
    """Values in closed form."""

    known: Callable[[], KnownScene]
    reference = Reference.ANALYTIC

    def samples(self, case: ExtremeCase, setup: Case) -> Samples:
        return Samples(self.known().gradient(setup.weights))


@dataclass(frozen=True)
class Zero:
    """No light path connects: every derivative is exactly zero."""

    reference = Reference.ANALYTIC

    def samples(self, case: ExtremeCase, setup: Case) -> Samples:
        return Samples(np.zeros(sum(len(value) for value in setup.initial.values())))


Source = Stock | Twin | Differences | Extrapolated | Exact | Zero


@dataclass(frozen=True)
class ExtremeCase:
    """One case. `scene` is a function, since it needs Mitsuba; its first sensor counts.

    `source` is the reference of gradients beside naive AD of our own walk at equal seeds (`naive`: whether that fits
    into memory), `image` the stock integrator that images are compared with ("": none can). `options` go to all
    integrators, `ours` to `reslrb` and `walk_ad`. `weights` makes dL/dI of the usual one, of mean 1. `signed` cases
    have derivatives of either sign; in the others nothing may be negative. `equal` limits the relative L2 distance at
    equal seeds, and from exact values where there is one seed only. `residual`: what `gather`'s replay leaves of its
    sum is looked at. `open_ended` names the parameters that no z-test can decide, and why; equal seeds decide there.
    `elsewhere` names those that another case decides, and which: equal seeds alone are compared.
    `moves` are what moves light, by amplitudes that are then the one parameter (`keys` is empty): estimators that do
    not follow it are left out, and dL/dI is smooth.
    """

    name: str
    about: str
    scene: Scene
    keys: tuple[str, ...]
    source: Source
    image: str = "path"
    spp: int = 64
    seeds: int = 16
    options: Mapping[str, Any] = field(default_factory=lambda: {"max_depth": 4})
    ours: Mapping[str, Any] = field(default_factory=dict)
    weights: Callable[[np.ndarray], np.ndarray] | None = None
    signed: bool = False
    naive: bool = True
    residual: bool = False
    equal: float = 1e-4
    open_ended: Mapping[str, str] = field(default_factory=dict)
    elsewhere: Mapping[str, str] = field(default_factory=dict)
    moves: Callable[[Any], Sequence[Move]] | None = None

    def setup(self) -> Case:
        """The scene, loaded, with its parameters."""
        if self.moves is None:
            return Case(self.scene(), self.keys)
        scene = load(self.scene())
        case = Case.of(scene, [AMPLITUDES], values=Displaced(scene, self.moves(scene)))
        case.weigh(smooth_weights(*case.weights.shape))
        return case

    def naive_options(self) -> dict[str, Any]:
        """The options of `walk_ad`."""
        return {**self.options, **self.ours} | ({} if self.moves is None else {"attached": True})


def without_roulette(case: ExtremeCase) -> dict[str, Any]:
    """The options of a case, for integrators whose gradient roulette biases."""
    return {key: value for key, value in case.options.items() if key != "rr_depth"}
