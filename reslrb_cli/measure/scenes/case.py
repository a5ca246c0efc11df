"""A case of the catalogue (`SceneCase`): a scene, its parameters, options of the integrators, and its references."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from reslrb_cli.measure.gradients import Case, integrator
from reslrb_cli.measure.gradients import seeds as seeds_of
from reslrb_cli.measure.methods import PATHS_OPTIONS
from reslrb_cli.measure.scenes.analytic import KnownScene
from reslrb_cli.measure.scenes.moving import Move, moving_case
from reslrb_cli.records.measurements import Reference
from reslrb_cli.statistics import rms

Scene = Callable[[], dict]
Moves = Callable[[Any], Sequence[Move]]


@dataclass(frozen=True)
class ReferenceGradients:
    """Gradients of a reference.

    The gradients are (N, P) at other seeds, (N, P) at the estimator's seeds (`paired`), or exact values (P,). `along`
    (K, P) are the directions along which the derivative is known, or None for all entries. `bias` bounds the error of
    the reference itself.
    """

    values: np.ndarray
    paired: bool = False
    along: np.ndarray | None = None
    bias: np.ndarray | float = 0.0


@dataclass(frozen=True)
class Stock:
    """A stock integrator, without Russian roulette (docs/method.md).

    It renders the case's scene, or another `scene`. The case's gradients are known multiples of the other scene's
    gradients. `factors` holds the multiple for each parameter. The default multiple is 1.
    """

    name: str
    scene: Scene | None = None
    factors: Mapping[str, float] = field(default_factory=dict)

    @property
    def reference(self) -> Reference:
        return Reference(self.name)

    def samples(self, case: SceneCase, setup: Case) -> ReferenceGradients:
        other = setup if self.scene is None else Case(self.scene(), case.keys)
        other.weights = setup.weights
        tracer = integrator(self.name, **case.without_roulette)
        values = other.gradients(tracer, seeds_of(case.seeds, 1), case.spp)
        scale = [np.full(len(row), self.factors.get(key, 1.0)) for key, row in other.initial.items()]
        return ReferenceGradients(values * np.concatenate(scale))


@dataclass(frozen=True)
class Differences:
    """Finite differences of the image by `reslrb`, without Russian roulette.

    They use the same random numbers as the gradient, unless the case's options set `rr_depth`. By default, they are
    along two random directions, which point into the domain for one-sided differences. They are exact up to rounding if
    paths do not depend on the parameters and the image is a polynomial of degree 2.

    With `left`, they are along each amplitude of a motion, and differences with twice the step correct them
    (Richardson's extrapolation). The assumed error is a tenth of the correction, plus the fraction `left` of the root
    mean square of the differences. The `left` part covers the faces of a mesh and higher powers of the step.
    """

    step: float
    sides: str = "both"
    left: float | None = None
    reference = Reference.FINITE_DIFFERENCE

    def directions(self, setup: Case) -> int:
        return 2 if self.left is None else setup.size

    def samples(self, case: SceneCase, setup: Case) -> ReferenceGradients:
        along = setup.directions(2) if self.left is None else np.eye(setup.size)
        along = along if self.sides == "both" else np.abs(along)
        way = {name: case.ours[name] for name in PATHS_OPTIONS if name in case.ours}
        tracer = integrator("reslrb", **case.without_roulette, **way)
        paired = "rr_depth" not in case.options
        chosen = seeds_of(case.seeds, 0 if paired else 1)
        near = setup.differences(tracer, along, chosen, case.spp, self.step, self.sides)
        if self.left is None:
            return ReferenceGradients(near, paired, along)
        # E(h) = (4 D(h) - D(2 h)) / 3: the error of order h^2 cancels (Richardson 1911).
        correction = (near - setup.differences(tracer, along, chosen, case.spp, 2 * self.step)) / 3
        values = near + correction
        bias = np.abs(correction.mean(0)) / 10 + self.left * rms(values.mean(0))
        return ReferenceGradients(values, paired, along, bias)


@dataclass(frozen=True)
class Exact:
    """Exact values in closed form."""

    known: Callable[[], KnownScene]
    reference = Reference.ANALYTIC

    def samples(self, case: SceneCase, setup: Case) -> ReferenceGradients:
        return ReferenceGradients(self.known().gradient(setup.weights))


Source = Stock | Differences | Exact


@dataclass(frozen=True)
class SceneCase:
    """One case. `scene` is a function, because building the scene needs Mitsuba. The case uses the scene's first
    sensor.

    - `source` is the reference for gradients, in addition to naive AD at equal seeds. `naive` is true if naive AD fits
        into memory.
    - `image` is the stock integrator for the reference image, or "" if none can render the scene.
    - `options` are options of all integrators. `ours` are options of only `reslrb` and `walk_ad`.
    - `weights` changes the usual dL/dI of mean 1.
    - `signed` is true if derivatives can have either sign. Otherwise, no derivative may be negative.
    - `equal` is the limit of the relative L2 distance at equal seeds. If there is only one seed, the limit also applies
        to the distance from exact values.
    - `open_ended` lists parameters that no z-test can decide, with the reason. These parameters are compared only at
        equal seeds.
    - `moves` has the motions of light. With `moves`, the motions' amplitudes are the only parameters, `keys` is empty,
        and dL/dI is smooth. Only estimators with attached derivatives then take part.
    - `not_spectral` is the reason to leave out the case in spectral variants.
    """

    name: str
    about: str
    scene: Scene
    keys: tuple[str, ...] = ()
    source: Source = Stock("ptracer")
    image: str = "path"
    spp: int = 64
    seeds: int = 16
    options: Mapping[str, Any] = field(default_factory=lambda: {"max_depth": 4})
    ours: Mapping[str, Any] = field(default_factory=dict)
    weights: Callable[[np.ndarray], np.ndarray] | None = None
    signed: bool = False
    naive: bool = True
    equal: float = 1e-4
    open_ended: Mapping[str, str] = field(default_factory=dict)
    moves: Moves | None = None
    not_spectral: str = ""

    @property
    def own(self) -> dict[str, Any]:
        """The options of `reslrb` and `walk_ad`."""
        return {**self.options, **self.ours}

    @property
    def without_roulette(self) -> dict[str, Any]:
        """The options for integrators whose gradients Russian roulette would bias. They have no `rr_depth`."""
        return {key: value for key, value in self.options.items() if key != "rr_depth"}

    def setup(self) -> Case:
        """Load the scene with its parameters."""
        return Case(self.scene(), self.keys) if self.moves is None else moving_case(self.scene(), self.moves)


def exact(
    name: str, about: str, known: Callable[[], KnownScene], keys: Mapping[str, str], max_depth: int, **more: Any
) -> SceneCase:
    """Return a case whose image is known in closed form. `keys` are the case's parameters. `more` sets other fields of
    the case.
    """
    shared: dict[str, Any] = {"options": {"max_depth": max_depth}, "not_spectral": "its closed form is that of RGB"}
    return SceneCase(name, about, lambda: known().scene(), tuple(keys.values()), Exact(known), **shared | more)
