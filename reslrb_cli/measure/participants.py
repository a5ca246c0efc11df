"""An experiment whose gradients are checked: the scene, the compared integrators, and one sample of each."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import mitsuba as mi
import numpy as np

from reslrb_cli.config.integrators import AUTO_ESTIMATOR, PLAIN, ReslrbConfig, traced_paths
from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ConfigError
from reslrb_cli.estimators import ATTACHED
from reslrb_cli.integrators.own import OwnIntegrator, load_estimator
from reslrb_cli.integrators.plugin import make_integrator
from reslrb_cli.integrators.protocol import StepIntegrator
from reslrb_cli.integrators.reslrb import LightTracer
from reslrb_cli.measure.draws import situation
from reslrb_cli.measure.gradients import Case, all_directions, choose_step, seeds, smooth_weights
from reslrb_cli.measure.methods import NEVER, NamedIntegrator, all_estimators
from reslrb_cli.measure.references import (
    CAMERA_PATHS,
    Situation,
    choose,
    ends,
    of_gradient,
    of_image,
)
from reslrb_cli.measure.scenes import small
from reslrb_cli.optimization.assemble import assemble_scene
from reslrb_cli.optimization.loading import check_integrator, lit_emitters, paths_of, what_moves
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.targets import multiple_of
from reslrb_cli.records.measurements import Reference
from reslrb_cli.scene.deformation import Moves
from reslrb_cli.scene.graph import interpolates_normals
from reslrb_cli.scene.visibility import interior

#: Light paths of one gradient, rounded to whole samples per pixel.
PATHS = 2**16

#: Directions of finite differences and of forward mode for each parameter.
DIRECTIONS = 2

#: The same for parameters that move light.
MOVING_DIRECTIONS = 3

#: Settings of attached derivatives for each reference that differ from the user's. Naive AD follows everywhere;
#: `ptracer` does not differentiate the filter's normalisation, but differences do, and they alone include edges.
ALIKE: dict[Reference, dict[str, str]] = {
    Reference.WALK_AD: {"attached_sampling": "follow"},
    Reference.PTRACER: {"attached_sampling": "follow", "filter_normalization": "detached"},
    Reference.FINITE_DIFFERENCE: {"filter_normalization": "attached", "edges": "on"},
}

#: References that are compared with light paths if light moves: they do not follow it along other paths.
OF_LIGHT_PATHS = (Reference.WALK_AD, Reference.PTRACER, Reference.PRB, Reference.FORWARD_MODE)

#: Integrator of the differenced images: ours, without roulette if paths have a maximum length.
DIFFERENCED = "differenced"

#: Seeds for choosing the step of finite differences.
PILOT_SEEDS = 2


def shrink(scene: Any, sensor: int, pixels: int) -> None:
    """Reduce the film of the sensor with the index `sensor` to about `pixels` pixels. The view stays the same.

    A crop window shrinks with it.
    """
    params = mi.traverse(scene.sensors()[sensor])
    width, height = (int(n) for n in params["film.size"])
    factor = (pixels / (width * height)) ** 0.5
    if factor >= 1:
        return

    def scaled(name: str, least: int) -> list[int]:
        return [max(round(n * factor), least) for n in params[name]]

    size, offset = scaled("film.size", 1), scaled("film.crop_offset", 0)
    offset = [min(o, n - 1) for o, n in zip(offset, size, strict=True)]
    window = [min(w, n - o) for w, n, o in zip(scaled("film.crop_size", 1), size, offset, strict=True)]
    for name, value in (("film.size", size), ("film.crop_size", window), ("film.crop_offset", offset)):
        params[name] = type(params[name])(*value)
    params.update()


@dataclass
class CheckSettings:
    """Settings of a check. `seeds` and `spp` are None if they are chosen automatically.

    - `named` are the integrators that the user named, or None for all estimators that can take part.
    - `spent_s` is the part of the budget that earlier sessions used.
    - `configs` has one experiment for each integrator, by label. Raises ConfigError if one is invalid.
    """

    config: Config
    named: Sequence[NamedIntegrator] | None
    budget_s: float
    seeds: int | None = None
    spp: int | None = None
    spent_s: float = 0.0

    def __post_init__(self) -> None:
        self.known = self.config.adjoint != "correlated"  # dL/dI is known before the image, as in a run's steps
        self.integrators = all_estimators(self.config) if self.named is None else self.named
        config, integrator = self.config, self.config.integrator
        if integrator.options().get("edges") == "on":  # only differences have the derivatives of edges
            config = config.model_copy(update={"integrator": integrator.model_copy(update={"edges": "off"})})
        depth = integrator.max_depth
        has_lamps = all(case.type == "reslrb" for case in self.integrators)  # the user's own cannot switch lamps off
        self.configs = {
            case.label: case.at(config, depth, self.known, has_lamps=has_lamps) for case in self.integrators
        }


@dataclass(frozen=True)
class Way:
    """The kinds of paths and the share of light paths. The kinds of paths determine which light is visible, and which
    paths naive AD must trace.
    """

    paths: str = "light"
    light_share: float = PLAIN["light_share"]

    @classmethod
    def of(cls, config: Config) -> Way:
        """Return the paths of an integrator. Integrators without the option `paths` use light paths."""
        options = config.integrator.options()
        share = options.get("light_share", cls.light_share)
        paths = traced_paths(options.get("paths", "light"), share)
        return cls(paths, share) if paths == "both" else cls(paths)

    @property
    def options(self) -> dict[str, Any]:
        """The options for integrators. They are empty for light paths."""
        share = {"light_share": self.light_share} if self.paths == "both" else {}
        return {} if self.paths == "light" else {"paths": self.paths} | share

    def named(self, name: str) -> str:
        """Return an item's name with a suffix for the kinds of paths. `name` is its name for light paths."""
        return name + "".join(f", {option}: {value}" for option, value in self.options.items())


class Participants:
    """The loaded scene with every integrator by its label. A variant must be set.

    - `ways` maps the label of each estimator to the estimator's paths. If light moves, the paths are those of a run,
        but `OF_LIGHT_PATHS` are compared with the estimator's light paths (`way`). Dictionaries "by way" have names for
        each kind of paths (`Way.named`).
    - `stock` has the stock reference for each parameter's gradient, or None, and the reasons against the others.
    - `images` has the same of the image for each way.
    - `listed` has the estimators that take part. If derivatives are attached, only estimators with attached derivatives
        on light paths take part.
    - `forward_mode` tells whether there is a forward mode. Moving emitters have none.
    - `masked` tells whether images and their references leave out the film's border.
    - `lit` has the indices of the emitters that are on, by sensor, if others are off.

    Raises ConfigError and UnsupportedScene.
    """

    def __init__(self, settings: CheckSettings) -> None:
        self._config, self._configs, self.known = settings.config, settings.configs, settings.known
        # If objects move, the experiment has an estimator with derivatives of moving light.
        follow = [case for case in settings.integrators if case.options.get("estimator") in ATTACHED]
        first = self._configs[[*follow, *settings.integrators][0].label].with_exposures_fixed()
        built_in = self._config.scene.file == small.FILE
        problem = assemble_scene(first, small.build(self._config.scene.options) if built_in else None)
        scene, sensor = problem.scene, problem.sensors[0]
        shrink(scene, sensor, PATHS)
        self.lit = lit_emitters(first, scene)
        self.case = Case(scene, problem.selection.keys, sensor, problem.selection)
        self.sensor = scene.sensors()[sensor]
        self.film: tuple[int, int] = (self.case.weights.shape[1], self.case.weights.shape[0])
        most = min(PATHS // (self.film[0] * self.film[1]), self._config.run.spp)  # not more than a step of the run
        self.spp = settings.spp or multiple_of(max(most, 1), problem.samples_per_pass)
        self._situation = Situation.of_problem(problem, sensor)
        self.attached, self._moved = self._situation.attached, self._situation.moved
        self._nodes = [self.case.params.properties[key][2] for key in self._moved]
        self.forward_mode = not any(
            isinstance(node, mi.Emitter) or (isinstance(node, mi.Shape) and node.is_emitter()) for node in self._nodes
        )
        self._moves = what_moves(first, problem.selection) if self._moved else Moves.NOTHING
        self.listed = self._able(settings, problem)
        self.ways = {case.label: self._way(case, problem) for case in self.listed}
        self.each_way = list(dict.fromkeys(self.way(case, one) for one in Reference for case in self.listed))
        self.integrators: dict[str, StepIntegrator] = {}
        #: The experiment and the options that determine an integrator, by its label.
        self._origins: dict[str, tuple[Config, dict[str, Any]]] = {}
        for case in self.listed:
            self._add_listed(case)
        self._add_others(first.integrator.options())
        at = {way: replace(self._situation, paths=way.paths) for way in self.each_way}
        rendered = Reference.PTRACER, Reference.PATH, Reference.PRB
        self.images = {way: choose(of_image(at[way], rendered)) for way in self.each_way}
        self._of = {way.named(key): (key, way) for way in self.each_way for key in self.case.keys}
        self.stock = {name: choose(of_gradient(at[way], key)) for name, (key, way) in self._of.items()}
        self.masked = self._are_unlike(self.images.values())
        self._weigh(self._are_unlike([*self.stock.values(), *self.images.values()]))
        along = all_directions(self.case, problem.selection, MOVING_DIRECTIONS, DIRECTIONS)
        self.directions = {way.named(key): list(along[key]) for way in self.each_way for key in self.case.keys}

    # --- integrators --------------------------------------------------------------------------------------------------

    def _able(self, settings: CheckSettings, problem: Problem) -> list[NamedIntegrator]:
        """Return the estimators that can take part. Raises ConfigError if an estimator that the user named cannot take
        part, or if no estimator can take part.
        """
        refused: dict[str, ConfigError] = {}
        for case in settings.integrators:
            try:
                self._check(case, self._configs[case.label], problem)
            except ConfigError as error:
                refused[case.label] = error
            # The others have a run's paths. Camera paths are not guided.
            repeats = "paths" in case.options or (
                "guiding" in case.options and self._way(case, problem).paths == "camera"
            )
            if self._moved and repeats and settings.named is None:
                refused.setdefault(case.label, ConfigError("--integrators", case.label, "repeats another estimator"))
        listed = [case for case in settings.integrators if case.label not in refused]
        if refused and (settings.named is not None or not listed):
            raise next(iter(refused.values()))
        return listed

    def _check(self, case: NamedIntegrator, config: Config, problem: Problem) -> None:
        """Raise ConfigError if the estimator cannot render the scene or, if light moves, differentiate it."""
        integrator, estimator, asked = config.integrator, case.options.get("estimator"), case.options.get("paths")
        if not isinstance(integrator, ReslrbConfig):
            check_integrator(config, integrator, problem.scene, problem.sensors)
            return
        if self.attached and estimator not in ATTACHED:
            reason = f"{estimator} has no derivatives of moving light; use {', '.join(ATTACHED)}"
            raise ConfigError("--integrators", "", reason)
        if self._moved:
            paths = self._way(case, problem).paths
            if paths == "light" and asked not in (None, "light"):
                reason = "only light paths have derivatives of moving lamps, and derivatives that follow everywhere"
                raise ConfigError("--integrators", case.label, reason)
            if paths == "camera" and estimator != AUTO_ESTIMATOR:
                reason = f"a run has only camera paths, and {estimator} has none; use reslrb:{estimator}(paths=light)"
                raise ConfigError("--integrators", case.label, reason)
            integrator = integrator.model_copy(update={"paths": paths})
        check_integrator(config, integrator, problem.scene, problem.sensors, self._moves)

    def _way(self, case: NamedIntegrator, problem: Problem) -> Way:
        """Return the paths of a case. If light moves, a case that names no paths has those of a run."""
        config = self._configs[case.label]
        if not self._moved or not isinstance(config.integrator, ReslrbConfig):
            return Way.of(config)
        asked = case.options.get("paths", self._config.integrator.options().get("paths", "auto"))
        integrator = config.integrator.model_copy(update={"paths": asked})
        paths = paths_of(integrator, problem.scene, problem.sensors, self._moves)
        return Way(paths, integrator.light_share) if paths == "both" else Way(paths)

    def way(self, case: NamedIntegrator, reference: Reference) -> Way:
        """Return the paths of a case that are compared with `reference`."""
        light = self._moved and case.type == "reslrb" and reference in OF_LIGHT_PATHS
        return Way() if light else self.ways[case.label]

    def lacking(self, way: Way) -> str:
        """Return a known cause why derivatives of these paths differ from differences, or an empty text."""
        smooth = (isinstance(node, mi.Shape) and interpolates_normals(node) for node in self._nodes)
        if way.paths != "light" or not any(smooth):
            return ""
        return "light paths lack terms of moving meshes with interpolated normals; paths=both and camera have them"

    def _add(self, label: str, kind: str, config: Config | None = None, **options: Any) -> None:
        made = make_integrator(kind, **options)
        self.integrators[label] = made.lit_by(self.lit) if self.lit and isinstance(made, LightTracer) else made
        self._origins[label] = config or self._config, {"type": kind} | options

    def _add_listed(self, case: NamedIntegrator) -> None:
        """Add the integrator of a case, and variants with the attached derivatives that references need."""
        label, config = case.label, self._configs[case.label]
        kind, options = config.integrator.type, config.integrator.options()
        if kind == "custom":
            own = OwnIntegrator(**options, allowed=config.allows_code)
            own.ready()  # before anything is rendered
            self.integrators[label], self._origins[label] = own, (config, {"type": kind} | options)
            return
        if self._moved and kind == "reslrb":
            options |= {"paths": "light", "light_share": PLAIN["light_share"]} | self.ways[label].options
        if kind == "reslrb":  # as in a run
            options["freeze"] = True
            if (place := getattr(config.integrator, "file", None)) is not None:
                load_estimator(place, "--integrators", label)
        self._add(label, kind, config, **options)
        edgeless = (self._config.integrator.options() | case.options).get("edges") == "off"
        for reference in Reference if self.attached else ():
            alike = ALIKE.get(reference, {}) | ({"edges": "off"} if edgeless else {})
            alike |= {"paths": self.way(case, reference).paths}
            if options | alike != options:
                self._add(_alike(label, reference), kind, config, **options | alike)

    def _add_others(self, options: dict[str, Any]) -> None:
        """Add naive AD, the integrators of differences, and stock integrators. `options` are those of a run."""
        shared = {name: options[name] for name in ("max_depth", "rr_depth", "hide_emitters")}
        # With roulette, differences have heavy tails: sometimes a path ends for only one of the two values.
        endless = shared | {"rr_depth": NEVER}
        for way in self.each_way:
            naive = {"samples_per_pass": options.get("samples_per_pass")}
            if self.attached:
                naive["attached"] = way.paths == "light"
                naive["filter_normalization"] = options.get("filter_normalization", "attached")
            self._add(way.named("walk_ad"), "walk_ad", **shared, **naive, **way.options)
            limited = endless if ends(shared["max_depth"]) else shared
            self._add(way.named(DIFFERENCED), "walk_ad", **limited, **way.options)
        self._add("ptracer", "ptracer", **endless)
        self._add("prb", "prb", **shared)
        self._add("path", "path", **shared)

    def sampled(self, label: str, reference: Reference) -> str:
        """Return the label of the integrator that replaces `label` in comparisons with `reference`. `ALIKE` has the
        settings that differ.
        """
        alike = _alike(label, reference)
        return alike if alike in self.integrators else label

    # --- references ---------------------------------------------------------------------------------------------------

    def references(self, key: str, listed: NamedIntegrator) -> list[Reference]:
        """Return the references that the scene allows for the gradient of a parameter by an integrator."""
        if listed.type == "custom" and self._moved:  # our camera paths have no derivatives of moving light
            return [Reference.FINITE_DIFFERENCE]
        stock, _ = self.stock[self.way(listed, Reference.PTRACER).named(key)]
        found = [Reference.WALK_AD] + ([] if stock is None else [stock])
        return found + [Reference.FINITE_DIFFERENCE] + ([Reference.FORWARD_MODE] if self.forward_mode else [])

    def _are_unlike(self, references: Iterable[tuple[Reference | None, str]]) -> bool:
        """Whether some references lose light along the film's border and others do not."""
        sides = {reference in CAMERA_PATHS for reference, _ in references if reference is not None}
        return len(sides | {way.paths != "light" for way in self.each_way}) > 1

    def _weigh(self, inside: bool) -> None:
        """Set random weights of mean 1. A sixth of the weights is negative. If light moves, they are smooth.

        With `inside`, weights are 0 at the border.
        """
        shape = tuple(self.case.weights.shape)
        if self._moved:
            self.case.weigh(smooth_weights(*shape))
            return
        weights = np.random.default_rng(7).uniform(-0.5, 2.5, shape)
        if inside:
            weights *= interior(shape, self.sensor)[:, :, None]
        self.case.weigh(weights)

    # --- samples ------------------------------------------------------------------------------------------------------

    def choose_steps(self, of: str) -> None:
        """Choose the finite-difference step for each direction of a parameter. `of` is its name by way."""
        image, pilot = self.integrators[self._tracer("differences", of)], seeds(PILOT_SEEDS, 9)
        self.directions[of] = [choose_step(self.case, image, d, pilot, self.spp) for d in self.directions[of]]

    def _tracer(self, kind: str, of: str) -> str:
        """Return the label of the integrator that takes samples (`sample`)."""
        if kind in ("gradient", "image"):
            return of
        _, way = self._of[of]
        able = [case for case in self.listed if case.type == "reslrb" and self.way(case, Reference.FORWARD_MODE) == way]
        ours = [self.sampled(case.label, Reference.FORWARD_MODE) for case in able]
        return way.named(DIFFERENCED) if kind == "differences" else [*ours, way.named("walk_ad")][0]

    def about(self, kind: str, of: str) -> dict[str, Any]:
        """Return everything that determines the samples of `kind` and `of`, for a file of draws."""
        config, options = self._origins[self._tracer(kind, of)]
        arrays = [np.array(self.case.weights), *(direction.vector for direction in self.directions.get(of, ()))]
        digest = hashlib.sha256(b"".join(array.tobytes() for array in arrays)).hexdigest()
        own = {"integrator": options, "spp": self.spp, "known": self.known, "masked": self.masked, "arrays": digest}
        own |= {"lit": self.lit} if self.lit else {}
        return situation(config, mi.variant(), purpose=f"gradcheck, {kind} of {of}", **own)

    def steps(self, of: str) -> list[tuple[float, float]]:
        """Return the finite-difference steps of a parameter, with their truncation errors."""
        return [(direction.step, direction.truncation) for direction in self.directions.get(of, ())]

    def restore(self, of: str, steps: Sequence[tuple[float, float]]) -> None:
        """Set the steps that earlier samples have determined."""
        self.directions[of] = [
            replace(direction, step=step, truncation=truncation)
            for direction, (step, truncation) in zip(self.directions[of], steps, strict=True)
        ]

    def sample(self, kind: str, of: str, seed: int) -> np.ndarray:
        """Return one sample as a flat array. `kind` is `gradient`, `image`, `differences` or `tangents`.

        `of` is the label of an integrator. A `gradient` comes from one step, as in the experiment. It covers all
        parameters, followed by the relative rounding error of each. An `image` is black along the film's border if
        some, but not all, image references or estimators lose light there.

        For `differences` and `tangents` (forward derivatives), `of` names a parameter and the kinds of paths
        (`Way.named`), and the sample has the derivatives along the parameter's directions. All estimators of the same
        paths have equal tangents.
        """
        tracer = self.integrators[self._tracer(kind, of)]
        if kind == "gradient":  # a step as in the experiment
            options = {"step": self.case.known_step} if self.known else {}
            self.case.roundings.clear()
            gradient = self.case.gradient(tracer, seed, self.spp, **options)
            return np.append(gradient, [self.case.rounding(key) for key in self.case.keys])
        if kind == "image":
            image = self.case.image(tracer, seed, self.spp)
            return (image * interior(image.shape, self.sensor)[:, :, None] if self.masked else image).ravel()
        if kind == "differences":
            return np.array([along.difference(self.case, tracer, seed, self.spp) for along in self.directions[of]])
        return np.array([self.case.tangent(tracer, d.vector, seed, self.spp) for d in self.directions[of]])


def _alike(label: str, reference: Reference) -> str:
    return f"{label}, as {reference.value}"
