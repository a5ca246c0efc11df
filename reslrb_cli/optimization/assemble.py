"""Assembly of a configuration's problem. The problem is loaded and checked, its targets are made, and its open settings
are decided. Also the coarser problem of a stage.
"""

from __future__ import annotations

import difflib
import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from fnmatch import fnmatchcase
from typing import Any

import mitsuba as mi
import numpy as np
from scipy.interpolate import RectBivariateSpline

from reslrb_cli.config.loader import check_code
from reslrb_cli.config.parameters import HEIGHTMAP, ParameterSpec
from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ConfigError
from reslrb_cli.integrators.own import OwnIntegrator
from reslrb_cli.integrators.reslrb import LightTracer
from reslrb_cli.optimization.autotune.sampling import settle
from reslrb_cli.optimization.errors import quantity
from reslrb_cli.optimization.identifiability import check_exposures, find_reached
from reslrb_cli.optimization.loading import (
    check_integrator,
    choose_sensors,
    load_configured,
    make_configured,
    pass_spp,
    paths_of,
    samples_per_pass,
)
from reslrb_cli.optimization.memory import check_announced, check_described, check_films, fit_memory, outlook
from reslrb_cli.optimization.moving import check_moving, moves_anything
from reslrb_cli.optimization.problem import Problem, make_optimizer, make_regularizers
from reslrb_cli.optimization.state import begin_as, decide_as, reach_as
from reslrb_cli.optimization.targets import make_targets
from reslrb_cli.optimization.views import View, expose, make_views
from reslrb_cli.records.decisions import DecisionCache
from reslrb_cli.records.tree import Stored
from reslrb_cli.scene.parameters import Selection, select_parameters
from reslrb_cli.scene.values import resample

Array = np.ndarray[Any, Any]


def assemble(
    config: Config,
    say: Callable[[str], None] = lambda line: None,
    cache: DecisionCache | None = None,
    to_run: bool = False,
    settled: Stored | None = None,
) -> Problem:
    """Load and check the experiment of `config`, make the targets, and decide open settings. A variant must be set.

    All checks happen before anything is rendered. `say` is called with lines about slow work. `cache` has measurements
    of earlier runs, or is None to store nothing. If `to_run` is True, prepare everything for an optimisation. If
    `to_run` is True, check exposures, and find the parameter entries that light and sensor reach. With `settled`,
    measure nothing again. With `settled`, the result is a resumed run's problem before the first iteration. Raises
    ConfigError and UnsupportedScene.
    """
    if to_run:
        check_code(config)
    problem = assemble_scene(config)
    if isinstance(problem.integrator, OwnIntegrator):
        problem.integrator.ready()
    if settled is not None:
        begin_as(problem, settled)
    problem = fit_memory(problem)
    line = outlook(config, problem.scene, problem.sensors) if to_run else None
    if line is not None:
        say(line)
    problem = make_targets(problem, say)
    for view in problem.views if to_run else ():
        for own in view.codes:
            own.attempt(view.target, view.weights)
    if settled is not None:
        return reach_as(decide_as(problem, settled), settled)
    problem = settle(problem, say, cache)
    if to_run:
        check_exposures(problem)
        problem = find_reached(problem)
    return problem


def load_for_rendering(
    config: Config, initial: bool, values: Mapping[str, Any] | None = None
) -> tuple[Any, list[int], Any, int | None]:
    """Load the scene and make the integrator. With `initial`, the parameters get their initial values, and then the
    given `values`. Without `initial`, the scene is as in its file, and `values` is ignored.

    Returns the scene, the indices of the used sensors, the integrator, and its `samples_per_pass`.
    """
    if initial:
        problem = assemble_scene(config)
        if values is not None:
            problem = set_values(problem, values)
        return problem.scene, problem.sensors, problem.integrator, samples_per_pass(config)
    scene = load_configured(config, selects=False)
    sensors = choose_sensors(config, scene)
    check_integrator(config, config.integrator, scene, sensors)
    integrator = make_configured(config, config.integrator, paths_of(config.integrator, scene, sensors))
    return scene, sensors, integrator, samples_per_pass(config)


def check_passes(source: str, spp: int, multiple: int | None) -> None:
    """Raise ConfigError if passes of `multiple` samples do not divide `spp`. `source` locates the error."""
    if spp < 1:
        raise ConfigError(source, "", f"is {spp}; it must be at least 1")
    if multiple is not None and spp % min(multiple, spp):
        raise ConfigError(source, "", f"{spp} is not a multiple of integrator.samples_per_pass, {multiple}")


def set_values(problem: Problem, values: Mapping[str, Any]) -> Problem:
    """Return the problem before its first iteration. `values` has arrays for some of the problem's parameters. Each
    array has the parameter's shape.

    Raises ConfigError with `values` and the key as location.
    """
    found = {}
    for key, value in values.items():
        if key not in problem.selection.keys:
            near = difflib.get_close_matches(key, problem.selection.keys, n=1, cutoff=0)
            raise ConfigError("values", key, f"is not a parameter of this experiment; did you mean {near[0]}?")
        shape = problem.selection.array(key).shape
        try:
            array = np.broadcast_to(np.asarray(value, np.float32), shape).copy()
        except (TypeError, ValueError):
            has = f"of shape {np.shape(value)}" if isinstance(value, np.ndarray) else "no array"
            raise ConfigError(
                "values", key, f"is {has}; it must have the parameter's shape {shape} and contain numbers"
            ) from None
        if not np.isfinite(array).all():
            raise ConfigError("values", key, "has a value that is not finite")
        found[key] = array
    return problem.afresh({**problem.values(), **found})


def assemble_scene(config: Config, scene: Any = None, values: Mapping[str, Array] | None = None) -> Problem:
    """Load and check the experiment of `config` without its targets.

    `scene` replaces `scene.file`, and `values` replace the initial values of the parameters. Raises ValueError unless
    `values` has one finite array of the right shape for each parameter.
    """
    check_announced(config)
    scene = load_configured(config, functools.partial(check_described, config)) if scene is None else scene
    views = make_views(config, scene)
    check_films(config, scene, [view.sensor for view in views])
    sensors = [view.sensor for view in views]
    selection = select_parameters(scene, config.parameters, config.source, values)
    moves = moves_anything(config, selection)
    check_integrator(config, config.integrator, scene, sensors, moves)
    paths = paths_of(config.integrator, scene, sensors, moves)
    expose(views, scene, selection)
    if values is not None:
        _check_values(selection, values)
        selection.set_arrays(values)
    problem = Problem(
        config=config,
        scene=scene,
        views=views,
        selection=selection,
        integrator=make_configured(config, config.integrator, paths),
        paths=paths,
        moves=moves,
        optimizer=make_optimizer(config, selection),
        samples_per_pass=samples_per_pass(config),
        regularizers=make_regularizers(selection),
        quantities={
            key: "" if key in selection.factors else selection.quantity(key) or quantity(selection.params, key)
            for key in selection.keys
        },
    )
    if isinstance(problem.integrator, LightTracer):
        problem.integrator.expect(pass_spp(config))
    problem.apply()
    check_moving(problem)
    if values is None:
        _check_plates(problem)
    for number in range(len(config.run.stages)):
        _film_at(problem, number)
        _specs_at(problem, number)
    return problem


def _check_plates(problem: Problem) -> None:
    """Raise ConfigError if two free faces start closer to each other than their minimum distance."""
    for key, plate in problem.plates.items():
        thin = float(plate.thickness(*(problem.selection.array(each).astype(np.float64) for each in (key, plate.other)))
                     .min())  # fmt: skip
        if thin < plate.settings.thinnest:
            index = next(i for i, spec in enumerate(problem.config.parameters) if key in spec.names)
            reason = (
                f"`{key}` and `{plate.other}` start {thin:.3g} apart at their nearest point, but must stay "
                f"{plate.settings.thinnest:.3g} apart, a tenth of `least`; lower `least`, or thicken the plate"
            )
            raise ConfigError(problem.config.source, f"parameters[{index}].regularizers", reason)


def _check_values(selection: Selection, values: Mapping[str, Array]) -> None:
    foreign = sorted(set(values) ^ set(selection.keys))
    if foreign:
        raise ValueError(f"it {'has' if foreign[0] in values else 'lacks'} `{foreign[0]}`")
    for key, value in values.items():
        shape = selection.array(key).shape
        if value.shape != shape or value.dtype.kind != "f":
            raise ValueError(f"`{key}` is {value.dtype} of shape {value.shape}, not numbers of shape {shape}")
        if not np.isfinite(value).all():
            raise ValueError(f"`{key}` has a value that is not finite")


# --- stages -----------------------------------------------------------------------------------------------------------


def at_stage(problem: Problem, number: int, values: Mapping[str, Array] | None = None) -> Problem:
    """Return the problem of a stage with its own resolution or film. The problem has another scene, with coarser maps
    and targets.

    The stage's problem samples like `problem`, but has no learned state. `values` are the values of the stage's
    parameters, in the stage's resolution. If `values` is None, the current values of `problem` are resampled. Raises
    ValueError for wrong shapes.
    """
    config, film = problem.config.without_stages(), _film_at(problem, number)
    scene = config.scene if film is None else config.scene.model_copy(update={"size": film})
    config = config.model_copy(update={"parameters": _specs_at(problem, number), "scene": scene})
    # Warnings about the scene were given for the whole problem.
    made = assemble_scene(config, load_configured(config, warn=False), values)
    if values is None:
        made.selection.set_arrays({key: bounded(made, key, resized(made, key, value))
                                   for key, value in problem.values().items()})  # fmt: skip
        made = replace(made, optimizer=make_optimizer(made.config, made.selection))
        made.apply()
    for view, whole in zip(made.views, problem.views, strict=True):
        _see_coarsely(view, whole, made.scene.sensors()[view.sensor].film())
        view.follow(made.scene)
    integrator, size = problem.integrator, problem.samples_per_pass
    if isinstance(integrator, LightTracer):
        integrator = integrator.afresh()
        if config.run.memory_budget is not None and integrator.samples_per_pass is not None:
            size = math.gcd(integrator.samples_per_pass, config.set_spp)
            integrator = integrator.with_options(samples_per_pass=size, freeze=integrator.freeze)
        integrator.expect(pass_spp(config))
    return replace(
        made, integrator=integrator, samples_per_pass=size, paths=problem.paths, truth=problem.truth,
        masks=problem.masks, decisions=problem.decisions,
    )  # fmt: skip


def _film_at(problem: Problem, number: int) -> tuple[int, int] | None:
    """Return the (width, height) of all films in a stage, or None if the stage uses the scene's films. Raises
    ConfigError.
    """
    config, share, key = problem.config, problem.config.stage(number).film, f"run.stages[{number}].film"
    if share == 1:
        return None
    films = [problem.scene.sensors()[sensor].film() for sensor in problem.sensors]
    sizes = {tuple(int(n) for n in film.crop_size()) for film in films}
    if len(sizes) > 1 or sizes != {tuple(int(n) for n in film.size()) for film in films}:
        raise ConfigError(config.source, key, "requires films of one size without a crop window; remove it")
    (size,) = sizes
    width, height = (round(n * share) for n in size)
    if min(width, height) < 1 or (size[0] % width, size[1] % height) != (0, 0) or size[0] * height != size[1] * width \
            or abs(size[0] / width * share - 1) > 1e-3:  # fmt: skip
        least = math.gcd(*size)
        would = [f"1/{n}" for n in range(2, least + 1) if least % n == 0][:4]
        advice = f"{', '.join(would)} would do" if would else "no smaller film has an integer size"
        raise ConfigError(
            config.source, key, f"{share:g} of {size[0]}x{size[1]} pixels is not an integer size; {advice}"
        )
    return width, height


def _specs_at(problem: Problem, number: int) -> list[ParameterSpec]:
    """Return the parameters of a stage, with globs replaced by the selected keys.

    Raises ConfigError if the stage asks for coarser parameters, but no parameter can be made coarser.
    """
    config, selection, share = problem.config, problem.selection, problem.config.stage(number).resolution
    specs: list[ParameterSpec] = []
    coarser = share == 1
    for spec in config.parameters:
        if share == 1 or spec.motion is not None or len(spec.keys) > 1:
            specs.append(spec)
            continue
        for key in selection.keys:
            if not any(key == name or fnmatchcase(key, name) for name in spec.names):
                continue
            changes: dict[str, Any] = {} if spec.heightmap is not None else {"key": key}
            slot = selection.slot(key)
            if slot.is_texture:
                height, width = slot.get().shape[:2]
                size = max(round(width * share), 3 if slot.halo else 2), max(round(height * share), 2)
                coarser = True
                if spec.heightmap is None:
                    changes["resolution"] = size
                else:
                    grid = {"grid": size} if _is_grid(problem, key, spec) else {}
                    changes["heightmap"] = spec.heightmap.model_copy(update={"resolution": size, **grid})
            specs.append(spec.model_copy(update=changes))
    if not coarser:
        place = f"run.stages[{number}].resolution"
        raise ConfigError(config.source, place, "makes nothing coarser: no parameter is only a texture or a heightmap")
    return specs


def _is_grid(problem: Problem, key: str, spec: ParameterSpec) -> bool:
    """True if a heightmap's mesh is a flat grid with a vertex at each texel. If True, both mesh and heightmap can be
    made coarser.
    """
    assert spec.heightmap is not None
    height, width = problem.selection.array(key).shape[:2]
    points, uv = problem.selection.deformation.laid_over(key)
    if len(spec.heightmap.mesh) > 1 or len(points) != width * height:
        return False
    place = uv * (width, height) - 0.5
    nodes = np.rint(place)
    if np.abs(place - nodes).max() > 1e-2 or len(np.unique(nodes, axis=0)) < len(nodes):
        return False
    design = np.column_stack([np.ones(len(nodes)), nodes])
    away = design @ np.linalg.lstsq(design, points, rcond=None)[0] - points
    return bool(np.abs(away).max() < 1e-4 * np.ptp(points, axis=0).max())


def resized(problem: Problem, key: str, value: Array) -> Array:
    """Return `value`, a parameter value of another problem, in the resolution of `problem`. `value` may also be a
    change of the parameter's value.

    Heights are resampled by cubic splines at their positions in space. On a flat grid with a vertex for each height,
    the heights cover the grid from edge to edge. On other meshes, heights are at the centres of texels. Along an axis
    that shrinks, texels of a texture are averaged. Along an axis that grows, texels are interpolated linearly.
    """
    shape, selection = problem.selection.array(key).shape, problem.selection
    if value.shape == shape:
        return value
    if selection.kind(key) != HEIGHTMAP:
        return resample(value, (shape[1], shape[0]))
    spec = next(spec for spec in problem.config.parameters if key in spec.names)
    whole = _is_grid(problem, key, spec)
    rows, columns = (_places(new, old, whole) for new, old in zip(shape[:2], value.shape[:2], strict=True))
    (kx, ky), nodes = (min(3, n - 1) for n in value.shape[:2]), (np.arange(n) for n in value.shape[:2])
    spline = RectBivariateSpline(*nodes, value[:, :, 0], kx=kx, ky=ky)
    return np.asarray(spline(rows, columns), np.float32)[:, :, None]


def bounded(problem: Problem, key: str, value: Array) -> Array:
    """Return the value of a parameter, clamped to its bounds."""
    low, high = problem.selection.spec(key).bounds or (-np.inf, np.inf)
    return np.clip(value, np.float32(low), np.float32(high))


def _places(new: int, old: int, edge_to_edge: bool) -> Array:
    """Return the positions of `new` nodes among `old` nodes, in units of the distance of old nodes."""
    if edge_to_edge:
        return np.linspace(0, old - 1, new)
    return np.clip((np.arange(new) + 0.5) * old / new - 0.5, 0, old - 1)


def _see_coarsely(view: View, whole: View, film: mi.Film) -> None:
    """Set the target of a view with a smaller film, from the full film's target. Each coarse pixel is a weighted mean
    of the full film's pixels that the coarse pixel covers.
    """
    target, weights = np.array(whole.target, dtype=np.float64), whole.fixed
    if weights is None:
        weights = np.ones(target.shape[:2]) if whole.weights is None else np.array(whole.weights)[:, :, 0]
    weights = weights.astype(np.float64)
    width, height = (int(n) for n in film.crop_size())
    down, across = target.shape[0] // height, target.shape[1] // width

    def summed(image: Array) -> Array:
        return image.reshape(height, down, width, across, -1).sum(axis=(1, 3))

    total = summed(weights)
    view.masked = whole.masked
    coarse = total[:, :, 0] / (down * across)
    view.see(summed(weights[:, :, None] * target) / np.maximum(total, 1e-300), coarse)
    view.fixed = None if whole.fixed is None else coarse
