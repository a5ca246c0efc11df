"""Loading and checking of scene, sensors and integrator of an experiment. Also images of many samples, in passes.

A pass is small enough to fit into memory.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.config.integrators import Integrator, Own, ReslrbConfig, WalkAdConfig, traced_paths
from reslrb_cli.config.loader import check_code
from reslrb_cli.config.parameters import ParameterSpec
from reslrb_cli.config.schema import IN_MEMORY, Config
from reslrb_cli.errors import ConfigError, UnsupportedScene, did_you_mean
from reslrb_cli.integrators.context import sensors_in_words
from reslrb_cli.integrators.freezing import MOST_PATHS_APART
from reslrb_cli.integrators.own import load_estimator
from reslrb_cli.integrators.plugin import make_integrator
from reslrb_cli.integrators.protocol import StepIntegrator
from reslrb_cli.integrators.reslrb import LightTracer, Reslrb
from reslrb_cli.integrators.step import render_image
from reslrb_cli.scene.cameras import read_cameras, repeat_sensors, replace_sensors, sensor_id, sensor_ids
from reslrb_cli.scene.deformation import Moves, where_moved
from reslrb_cli.scene.dispersion import bends_light
from reslrb_cli.scene.load import INSTEAD, load_scene, warn_once
from reslrb_cli.scene.needs import check_paths, scene_needs, stock_clip, usual_paths
from reslrb_cli.scene.parameters import Selection
from reslrb_cli.scene.xml.mend import name_objects
from reslrb_cli.scene.xml.read import Description, read_description
from reslrb_cli.seeds import seed

#: Paths in one pass. Baselines keep the state of every path in memory; 2**22 of them stay below 2 GB.
PATHS_PER_PASS = 2**22

#: Minimum number of samples per pixel of images saved between the first and the last.
BETWEEN_SPP = 64


def passes(spp: int, pixels: int, multiple: int | None, paths_per_pass: int = PATHS_PER_PASS) -> Iterator[int]:
    """Yield the samples per pixel of each pass. They sum to `spp`.

    `multiple` is the integrator's `samples_per_pass`. `multiple` divides both `spp` and the sample count of every pass.
    None sets no such limit.
    """
    unit = multiple or 1
    most = max(paths_per_pass // (pixels * unit), 1) * unit
    while spp > 0:
        yield min(most, spp)
        spp -= most


def render_in_passes(
    integrator: Any,
    scene: Any,
    sensor: int,
    spp: int,
    run_seed: int,
    iteration: int,
    purpose: str,
    multiple: int | None,
) -> np.ndarray[Any, Any]:
    """Render `sensor` with `spp` samples per pixel and return the image, (H, W, C) float32.

    Each pass has its own seed, which depends on `run_seed`, `iteration`, `sensor`, `purpose` and the number of the
    pass. The mean is computed in double precision.
    """
    width, height = scene.sensors()[sensor].film().crop_size()
    pixels = int(width) * int(height)
    if isinstance(integrator, Reslrb) and min(spp * pixels, PATHS_PER_PASS) > MOST_PATHS_APART:
        integrator = integrator.with_options(samples_per_pass=integrator.samples_per_pass, freeze=False)
    total: np.ndarray[Any, Any] | None = None
    for number, part in enumerate(passes(spp, pixels, multiple)):
        pass_seed = seed(run_seed, iteration, sensor, f"{purpose}, pass {number}")
        with dr.suspend_grad():
            image = np.array(render_image(integrator, scene, sensor, pass_seed, part), dtype=np.float64) * (part / spp)
        total = image if total is None else total + image
    assert total is not None, "spp must be at least 1"
    return total.astype(np.float32)


#: Types of integrators that trace from the light, and so cannot render every scene.
LIGHT_TRACERS = ("reslrb", "ptracer", "walk_ad", "trajectory")


def load_configured(
    config: Config,
    look: Callable[[Description], object] | None = None,
    selects: bool = True,
    keys: Iterable[str] = (),
) -> mi.Scene:
    """Load the scene of `config`. `look` is called with the scene's description before the scene is built. Raises
    ConfigError.

    With `selects`, the 8-bit and 16-bit textures that parameters select are read as floating point. Those of `keys`,
    which may be globs, always are.
    """
    scene = config.scene
    keys = [*(selected_keys(config) if selects else []), *keys]
    if scene.file.name == IN_MEMORY:
        return _lent_scene(config, keys, config.parameters if selects else [])

    def prepare(description: Description) -> None:
        if config.shares_sensors:
            repeat_sensors(description, _sensors_of_views(config, sensor_ids(description)))
        if look is not None:
            look(description)

    named = strings_in(config.model_dump(exclude={"run"}))
    return load_scene(scene.file, scene.options, scene.size, scene.cameras, prepare, keys, named)


def strings_in(settings: Any) -> Iterator[str]:
    """Yield all strings in settings. They may be keys, globs or ids of the scene."""
    if isinstance(settings, str):
        yield settings
    elif isinstance(settings, Mapping):
        for name, value in settings.items():
            yield str(name)
            yield from strings_in(value)
    elif isinstance(settings, (list, tuple)):
        for value in settings:
            yield from strings_in(value)


def _lent_scene(config: Config, keys: list[str], specs: Sequence[ParameterSpec]) -> mi.Scene:
    """Return the caller's scene with its first values. Raises ConfigError for settings that need a scene file."""
    scene, own = config.scene, config.own_scene
    if own is None:
        reason = f"was an mi.Scene in the memory of another process; {INSTEAD}"
        raise ConfigError(config.source, "scene.file", reason)
    if config.shares_sensors:
        reason = "views share a sensor, of which an mi.Scene cannot get copies; give the scene one sensor for each view"
        raise ConfigError(config.source, "views", reason)
    changed = next((name for name in ("options", "size", "cameras") if getattr(scene, name)), None)
    if changed is not None:
        raise ConfigError(config.source, f"scene.{changed}", f"cannot change an mi.Scene; {INSTEAD}")
    moved = [name for spec in specs for _, _, name in spec.objects()]
    own.check_merged([key for key in keys if key.rpartition(".")[0] not in moved], moved, config.source)
    return own.restore()


def selected_keys(config: Config) -> list[str]:
    """Return the keys and globs of parameters that `config` recovers, or for which `config` gives true values."""
    render = config.target.render
    return [*(key for spec in config.parameters for key in spec.keys), *(render.parameters if render else ())]


def choose_sensors(config: Config, scene: mi.Scene) -> list[int]:
    """Return the index of each view's sensor. Raises ConfigError for a sensor that does not exist."""
    if config.views is None:
        return [0] if config.scene.cameras is None else list(range(len(scene.sensors())))
    return view_sensors(config, [sensor.id() for sensor in scene.sensors()])


def read_sensor_ids(config: Config) -> list[str]:
    """Return the ids of the scene's sensors. The scene is not built, unless it is in memory. Raises ConfigError."""
    scene = config.scene
    if scene.file.name == IN_MEMORY:
        return [sensor.id() for sensor in _lent_scene(config, [], []).sensors()]
    description = read_description(scene.file, scene.options)
    if scene.cameras is not None:
        replace_sensors(description, read_cameras(scene.cameras))
    name_objects(description.root)
    return sensor_ids(description)


def view_sensors(config: Config, ids: Sequence[str]) -> list[int]:
    """Return the index of each view's sensor in the loaded scene, whose sensors have these `ids`. The list is empty
    without `views`. Raises ConfigError.
    """
    if config.shares_sensors:
        return list(range(len(config.views or ())))
    found = _sensors_of_views(config, ids)
    for place, sensor in enumerate(found):
        if sensor in found[:place]:
            reason = f"is also the sensor of views[{found.index(sensor)}]; name it in the same way, or remove one"
            raise ConfigError(config.source, f"views[{place}].sensor", reason)
    return found


def _sensors_of_views(config: Config, ids: Sequence[str]) -> list[int]:
    views = enumerate(config.views or ())
    return [find_sensor(view.sensor, ids, config.source, f"views[{place}].sensor") for place, view in views]


def find_sensor(given: int | str, ids: Sequence[str], source: object, key: str) -> int:
    """Return the index of a sensor that a setting names by its index or its id. Raises ConfigError if there is none, or
    if the number is also the id of another sensor.
    """
    if isinstance(given, str):
        places = [place for name in (given, sensor_id(given)) for place, id in enumerate(ids) if id == name]
        if places:
            return places[0]
        raise ConfigError(source, key, f"is {given}, which is no sensor of the scene; {did_you_mean(given, ids, 3, 0)}")
    named = next((id for place, id in enumerate(ids) if id.isdecimal() and int(id) == given != place), None)
    if named is not None:
        reason = f'is the number {given}, which could be an index or the sensor "{named}"; write an id in quotes'
        raise ConfigError(source, key, reason)
    if given >= len(ids):
        raise ConfigError(source, key, f"is {given}, but the scene has {sensors_in_words(len(ids))}")
    return given


def lit_emitters(config: Config, scene: mi.Scene) -> dict[int, tuple[int, ...]]:
    """Return the indices of the emitters that are on, by sensor, for views in which others are off. Raises ConfigError
    for a lamp that does not exist.
    """
    emitters, found = scene.emitters(), {}
    sensors = choose_sensors(config, scene) if config.views else []
    names = [{item.id() for item in (emitter, emitter.get_shape()) if item is not None} for emitter in emitters]
    for place, (view, sensor) in enumerate(zip(config.views or (), sensors, strict=True)):
        lit: set[int] = set()
        for number, lamp in enumerate(view.lamps or ()):
            own = {index for index, known in enumerate(names) if any(fnmatchcase(name, lamp) for name in known)}
            if not own:
                shown = [emitter.id() if (shape := emitter.get_shape()) is None else shape.id() for emitter in emitters]
                reason = f"is `{lamp}`, which is no lamp of the scene; {did_you_mean(lamp, shown, 3, 0)}"
                raise ConfigError(config.source, f"views[{place}].lamps[{number}]", reason)
            lit |= own
        if lit and len(lit) < len(emitters):
            found[sensor] = tuple(sorted(lit))
    return found


def are_upright(config: Config) -> bool:
    """Whether images of views are rotated by their EXIF orientation.

    Cameras read from a file refer to pixels in their stored orientation. COLMAP ignores orientations on purpose,
    because all images of one camera must have one projection.
    """
    return config.scene.cameras is None


def what_moves(config: Config, selection: Selection) -> Moves:
    """Return what the selected parameters move. With the integrator option `attached: true`, and if a parameter moves
    refracted light, lamps count as moving.
    """
    bends = any(bends_light(selection.params, key) for key in selection.scene_keys)
    if bends or config.integrator.options().get("attached", "auto") is True:
        return Moves.LAMPS
    return Moves.of(where_moved(selection.params, selection.scene_keys))


def paths_of(
    integrator: Integrator, scene: mi.Scene, sensors: list[int], moves: Moves = Moves.NOTHING
) -> str:  # fmt: skip
    """Return the kind of paths that render the images of `integrator`: `light`, `camera`, or `both`. If a lamp moves,
    it is `light`.

    If a measurement chooses the kind of paths, the result is `both`. If only one kind can render the scene, the result
    is the usable kind.
    """
    if isinstance(integrator, Own):
        return integrator.paths
    if not isinstance(integrator, ReslrbConfig | WalkAdConfig):
        return "light" if integrator.type in LIGHT_TRACERS else "camera"
    if moves is Moves.LAMPS:
        return "light"
    if moves and (isinstance(integrator, WalkAdConfig) or integrator.attached_sampling == "follow"):
        return "light"  # naive differentiation and `follow` have no derivatives of camera paths
    if integrator.paths != "auto":
        return traced_paths(integrator.paths, integrator.light_share)
    looked = [scene.sensors()[sensor] for sensor in sensors]
    return usual_paths(scene, looked, integrator.max_depth, integrator.hide_emitters, bool(moves))


def check_integrator(
    config: Config, integrator: Integrator, scene: mi.Scene, sensors: list[int], moves: Moves = Moves.NOTHING
) -> None:
    """Raise ConfigError at `scene.file` if `integrator` cannot render `scene` through `sensors`."""
    try:
        paths = paths_of(integrator, scene, sensors, moves)
        for sensor in sensors:
            if integrator.type in LIGHT_TRACERS or (integrator.type == "custom" and paths == "light"):
                check_paths(scene, scene.sensors()[sensor], paths, integrator.hide_emitters)
                if integrator.type == "ptracer":
                    _warn_of_clipping(config, scene.sensors()[sensor], scene)
            else:
                check_paths(scene, scene.sensors()[sensor], "prb")
    except UnsupportedScene as error:
        raise ConfigError(config.source, "scene.file", str(error)) from error


def _warn_of_clipping(config: Config, sensor: mi.Sensor, scene: mi.Scene) -> None:
    wrong = stock_clip(scene_needs(scene, sensor))
    if wrong is not None:
        warn_once(f"{config.scene.file}: sensor {sensor.id()}: ptracer {wrong}; reslrb is correct there")


def make_configured(config: Config, integrator: Integrator, paths: str, scene: mi.Scene) -> StepIntegrator:
    """Make `integrator`, which `config` gives for the run or for the target, for a scene of `config`. `paths` is the
    result of `paths_of`.

    Settings that are `auto` have their plain values. Raises ConfigError.
    """
    if isinstance(integrator, ReslrbConfig):
        integrator = integrator.plain().model_copy(update={"paths": paths})
    elif isinstance(integrator, WalkAdConfig):
        integrator = integrator.model_copy(update={"paths": paths})
    options: dict[str, Any] = integrator.options()
    if isinstance(integrator, ReslrbConfig):
        options["freeze"] = True  # the launches of a step are recorded, so that its Python runs once
        if integrator.file is not None:
            check_code(config, {"integrator.estimator": integrator.file})
            load_estimator(integrator.file, config.source, "integrator.estimator")
    if isinstance(integrator, Own):
        options["allowed"] = config.allows_code
    return with_lamps_of_views(config, integrator.type, make_integrator(integrator.type, **options), scene)


def with_lamps_of_views(config: Config, type: str, made: StepIntegrator, scene: mi.Scene) -> StepIntegrator:
    """Return an integrator of this `type` for which only the lamps of each view are on. Raises ConfigError if there is
    none.
    """
    lit = lit_emitters(config, scene)
    if not lit:
        return made
    if not isinstance(made, LightTracer):
        place = next(number for number, view in enumerate(config.views or ()) if view.lamps is not None)
        reason = f"lights only some lamps, which {type} cannot do; use integrator.type: reslrb"
        raise ConfigError(config.source, f"views[{place}].lamps", reason)
    if made.preparation.guiding is not None:
        reason = "is on, but views with different `lamps` cannot share its tables; use off"
        raise ConfigError(config.source, "integrator.guiding", reason)
    return made.lit_by(lit)


def pass_spp(config: Config) -> int:
    """Return the samples per pixel of each pass of a step's gradient."""
    call = config.set_spp
    return min(samples_per_pass(config) or call, call)


def samples_per_pass(config: Config) -> int | None:
    """Return the integrator's own limit for samples per pass."""
    value = config.integrator.options().get("samples_per_pass")
    return None if value is None else int(value)
