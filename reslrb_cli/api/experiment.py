"""Functions of the Python interface that take an experiment and return a result in one call.

- `load`: read a configuration from a file, a mapping or a run folder.
- `render`, `gradient`, `gradcheck`, `convergence`, `bench`, `write_report`, `export`: the commands, or parts of them,
    as functions.
- `held`: delay an interrupt until it is safe to stop.
"""

from __future__ import annotations

import contextlib
import gc
import logging
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, get_args

import numpy as np

from reslrb_cli.backend.installation import load_packages
from reslrb_cli.backend.variant import keep_variant
from reslrb_cli.config import loader
from reslrb_cli.config.files import NAMELESS, as_path
from reslrb_cli.config.loader import OVERRIDDEN, Override
from reslrb_cli.config.schema import IN_MEMORY, Config
from reslrb_cli.errors import ConfigError, one_line
from reslrb_cli.records.atomic import writing
from reslrb_cli.records.measurement_files import Line
from reslrb_cli.records.measurements import BenchRecord, GradcheckRecord
from reslrb_cli.records.run_folder import exposed, exposures, recovered

if TYPE_CHECKING:
    import mitsuba as mi

    from reslrb_cli.estimators.base import Estimator
    from reslrb_cli.measure.draws import Draws

Array: TypeAlias = "np.ndarray[Any, np.dtype[np.float32]]"
#: Description of an experiment: a configuration file, a run folder, a mapping with the content of YAML, or a `Config`.
Experiment: TypeAlias = "Config | str | os.PathLike[str] | Mapping[str, Any]"

#: A dictionary as for `mi.load_dict`, or an `mi.Scene`.
Scene: TypeAlias = "Mapping[str, Any] | mi.Scene"

#: Quantity that `bench` varies.
Swept: TypeAlias = Literal["depth", "spp"]

#: Advice in error messages on the command line, and its replacement in a script.
ARGUMENTS = {
    "add --set run.output=FOLDER": "give folder=FOLDER",
    "use `render --value KEY=VALUE`": "give `values` to `render`",
    "--allow-code permits it": "allow_code=True permits it, or the experiment `load(...).with_code()`",
}

#: Signals of batch systems and of a terminal that closes.
KILLING = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))

logger = logging.getLogger(__name__)


#: Dr.Jit records and launches kernels on variables that all threads share. Two threads that work at the same time
#: disturb each other's recordings, or wait for each other forever.
_turn = threading.RLock()
#: Signals that wait for the end of the block that `held` makes.
_waiting_signals: list[int] = []


def end_by(number: int, frame: FrameType | None) -> None:
    """Handle a signal that would kill the script: end the script as `sys.exit` does, so that loops complete their run
    folders.
    """
    raise SystemExit(128 + number)


def interrupted() -> bool:
    """Return True if a signal waits for the end of the current block that `held` makes."""
    return bool(_waiting_signals)


@contextlib.contextmanager
def held() -> Iterator[Callable[[], bool]]:
    """Delay Ctrl-C and a notebook's interrupt until the end of the block, then raise KeyboardInterrupt. The blocks of
    different threads take turns.

    An interrupt inside Mitsuba or Dr.Jit would cause a crash or an unrelated error. Yields `interrupted`. Long blocks
    can call the function to stop early, also with a KeyboardInterrupt. Signals that `end_by` handles are also delayed.
    Signals are not delayed outside of the main thread, and not again in a nested `held` block.
    """
    with _turn:
        is_main = threading.current_thread() is threading.main_thread()
        before = {number: handler for number in (signal.SIGINT, *KILLING) if is_main
                  and (handler := signal.getsignal(number)) in (signal.default_int_handler, end_by)}  # fmt: skip

        def mark(number: int, frame: FrameType | None) -> None:
            _waiting_signals.append(number)

        for number in before:
            signal.signal(number, mark)
        came: list[int] = []
        try:
            yield interrupted
        except KeyboardInterrupt:
            if not before or not interrupted():
                raise
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
            if before:
                came += _waiting_signals
                _waiting_signals.clear()
    if came:
        before[came[0]](came[0], None)  # raises


@contextlib.contextmanager
def called() -> Iterator[Callable[[], bool]]:
    """Do the same as `held`. In the text of a ConfigError, also replace command-line options by the function's
    arguments.
    """
    with held() as stop:
        try:
            yield stop
        except ConfigError as error:
            name, message = error.source, error.message
            for option, argument in ARGUMENTS.items():
                message = message.replace(option, argument)
            if name.startswith("--"):
                name = name.removeprefix("--").replace("-", "_")
                name, message = {"output": "folder"}.get(name, name), message.replace("--output", "folder")
            raise ConfigError(name, error.key, message) from None


def load(
    experiment: Experiment,
    overrides: Mapping[str, object] | None = None,
    base: str | os.PathLike[str] | None = None,
    scene: Scene | None = None,
) -> Config:
    """Load and check an experiment, and fill in the defaults.

    `experiment` can be given in four forms.

    - A YAML file.
    - A mapping with the same content as a YAML file. Paths, tuples and NumPy numbers and arrays are allowed.
    - A run folder. The parameters then start from the values that the run has reached.
    - A `Config`.

    `overrides` maps keys to values, with the keys of `--set`: `{"run.iterations": 5, "parameters[0].bounds": [0, 1]}`.
    Paths in a file are relative to the file. Paths in a mapping are relative to `base`, by default the working
    directory. `load` does not open the files that the experiment names, and sets no Mitsuba variant.

    `scene` replaces the section `scene` of the experiment. It is a dictionary as for `mi.load_dict`, or an `mi.Scene`.
    In a mapping, the section `scene` may be one of these, too. Both need a variant: `load` sets the experiment's
    variant if none is set. `load` writes a dictionary as a scene file into the cache (`~/.cache/reslrb/scenes`), so
    that it can be used as any scene file. File names in a dictionary are relative to `base`. An `mi.Scene` must be
    loaded with `optimize=False`. It exists only in this process, so its runs can be neither resumed nor exported later.

    Raises ConfigError if a key is unknown or missing or a value has a wrong type. The error names the file and the key,
    or `overrides`.
    """
    return load_with(experiment, loader.overrides_of(overrides), base, scene)


def load_with(
    experiment: Experiment,
    put_in: Sequence[Override],
    base: str | os.PathLike[str] | None = None,
    scene: Scene | None = None,
) -> Config:
    """Do the same as `load`, with overrides that are already parsed."""
    source: object = "scene"
    if scene is None and isinstance(experiment, Mapping):
        given = experiment.get("scene")
        objects = list(given.values()) if isinstance(given, Mapping) else []
        is_dictionary = any("type" in each for each in [given, *objects] if isinstance(each, Mapping))
        if is_dictionary or type(given).__module__.startswith("mitsuba"):
            scene, source = given, NAMELESS
            experiment = {name: value for name, value in experiment.items() if name != "scene"}
    if scene is None:
        return _load_from_file(experiment, put_in, base)
    stand_in = Override("scene", ("scene",), {"file": str(Path(IN_MEMORY).absolute())})
    config = _load_from_file(experiment, [stand_in, *put_in], base)
    if config.scene.file.name != IN_MEMORY:
        raise ConfigError(OVERRIDDEN, "scene.file", "is given besides scene; leave one of them out")
    keep_variant(config.variant, config.source)
    import mitsuba as mi

    if isinstance(scene, Mapping):
        from reslrb_cli.scene.xml.dictionary import write_dictionary

        file = write_dictionary(scene, source, Path.cwd() if base is None else Path(base).absolute())
        return loader.changed(config, [Override("scene", ("scene", "file"), str(file))])
    if not isinstance(scene, mi.Scene):
        what = "one of another variant" if type(scene).__name__ == "Scene" else one_line(repr(scene), 60)
        raise ConfigError(source, "", f"must be a Mitsuba dictionary or an mi.Scene, not {what}")
    from reslrb_cli.scene.load import SceneInMemory

    return config.with_scene(SceneInMemory(scene, source))


def _load_from_file(experiment: Experiment, put_in: Sequence[Override], base: str | os.PathLike[str] | None) -> Config:
    """Load an experiment whose scene is a file."""
    if isinstance(experiment, Config):
        return loader.changed(experiment, put_in)
    if isinstance(experiment, Mapping):
        path = Path(NAMELESS) if base is None else as_path(base, "base", "the path of a folder") / NAMELESS
        data = loader.plain(experiment, NAMELESS)
        run = {} if data.get("run") is None else data["run"]
        data["run"] = {"name": "run", **run} if isinstance(run, dict) else run
        return loader.resolve(data, path, put_in)
    path = as_path(experiment, "experiment", "a file, a mapping or a run's folder")
    if path.is_dir():
        return recovered(path, put_in)
    return loader.load(path, put_in)


def render(
    experiment: Experiment,
    spp: int | None = None,
    values: Mapping[str, Any] | None = None,
    initial: bool = True,
    exposure: bool = False,
) -> dict[int, Array]:
    """Render every view of an experiment and return the images by sensor index.

    Images are (height, width, channels) float32, in linear radiance. The experiment's integrator renders the images
    with `spp` samples per pixel (default: `run.spp`). With `exposure=True`, the images of a run folder are multiplied
    by the exposures of the run.

    The parameters have their initial values. For a run folder, the parameters have the recovered values. With
    `initial=False` the scene is as in its file. Then `values` are set. `values` maps keys to new values: any key that
    `reslrb inspect` lists as recoverable, and the keys of motions and heightmaps of the experiment. A value is a
    number, a list with one number for each channel, an array of the parameter's shape, or `{"file": IMAGE}`.

    Sets the experiment's Mitsuba variant if none is set. Raises ConfigError (also if another variant is set) and
    UnsupportedScene.
    """
    with called():
        config = load(experiment)
        factors = _exposures(experiment) if exposure else {}
        keep_variant(config.variant, config.source)
        from reslrb_cli.optimization.assemble import check_passes, load_for_rendering
        from reslrb_cli.optimization.loading import render_in_passes
        from reslrb_cli.optimization.views import color_channels

        with _scene_given_back(config):
            scene, sensors, integrator, multiple = load_for_rendering(config, initial, values)
            samples = config.run.spp if spp is None else spp
            check_passes("spp", samples, multiple)
            images = {
                sensor: render_in_passes(integrator, scene, sensor, samples, config.run.seed, 0, "render", multiple)
                for sensor in sensors
            }
            for sensor in set(images) & set(factors):
                colours = color_channels(scene.sensors()[sensor].film())
                images[sensor] = exposed(images[sensor], factors[sensor], colours)
            return images


def _exposures(experiment: Experiment) -> dict[int, Array]:
    """Return the exposure of each sensor of a run folder. Raises ConfigError if the experiment is no run folder."""
    if isinstance(experiment, (str, os.PathLike)) and Path(experiment).is_dir():
        return exposures(Path(experiment))
    raise ConfigError("exposure", "", "is of a run folder; give the folder, or leave out `exposure=True`")


def gradient(
    experiment: Experiment,
    values: Mapping[str, Any] | None = None,
    spp: int | None = None,
    seed: int | None = None,
) -> tuple[float, dict[str, Array]]:
    """Return the loss of an experiment and its gradients by key.

    Each gradient is a float32 array with the shape of its parameter. The unit of a gradient is the loss per unit of the
    parameter. The result equals the gradient of a run's first iteration, but `integrator.edges: auto` counts as `off`.
    If shapes move, set `edges: on`. The adjoint image also comes from the samples that `run.adjoint` selects. The
    parameters have their initial values, or `values` as for `render`.

    `spp` replaces `run.spp`. `seed` replaces `run.seed` for the samples only. The target and the measurements before
    the first iteration (`guiding: auto`, ...) still use the experiment's seed. Regularizers contribute to the gradient
    but not to the loss. Entries that are not finite are returned unchanged.

    Sets the experiment's Mitsuba variant if none is set. Raises ConfigError and UnsupportedScene.
    """
    with called():
        config = load(experiment, None if spp is None else {"run.spp": spp})
        reseeded = config if seed is None else load(config, {"run.seed": seed})
        keep_variant(config.variant, config.source)
        from reslrb_cli.optimization.assemble import assemble, set_values
        from reslrb_cli.optimization.loop import gradient as step_gradient
        from reslrb_cli.records.decisions import DecisionCache

        with _scene_given_back(config):
            problem = assemble(config, logger.info, DecisionCache())
            if values is not None:
                problem = set_values(problem, values)
            problem = replace(problem, config=reseeded)
            loss = step_gradient(problem, 0)[0]
            found = {key: problem.optimizer.gradient(key) for key in problem.selection.keys}
            return float(loss[0]), {key: problem.selection.shown(key, value) for key, value in found.items()}


@contextlib.contextmanager
def _scene_given_back(config: Config) -> Iterator[None]:
    """At the end of the block, give a scene in memory its first values again."""
    try:
        yield
    finally:
        if config.own_scene is not None:
            config.own_scene.restore()


def gradcheck(
    experiment: Experiment,
    integrators: str | None = None,
    budget: float = 120.0,
    seeds: int | None = None,
    spp: int | None = None,
    allow_code: bool = False,
) -> list[GradcheckRecord]:
    """Compare gradients with independent references, as `reslrb gradcheck` does (docs/gradcheck.md).

    Returns one record per comparison, with the fields that `--json` writes. `record.holds` is False if the comparison
    fails.

    - `integrators`: a list of estimators, such as `reslrb:stack,reslrb:reservoir(capacity=4)`, and of your own Mitsuba
        integrators, `FILE.py:CLASS[(OPTION=VALUE,...)]` (docs/your_integrator.md). Default: all four estimators.
    - `budget`: total time in seconds. Comparisons with too few seeds by then are unresolved.
    - `seeds`: number of seeds, at least 3, regardless of `budget`. Default: 16, within `budget`.
    - `spp`: samples per pixel of one gradient.
    - `allow_code`: permit running the code of the integrators' files.

    An interrupt stops the check after the current gradient and raises KeyboardInterrupt. Sets the experiment's Mitsuba
    variant if none is set. Raises ConfigError and UnsupportedScene.
    """
    began = time.monotonic()
    with called() as stop:
        config = load(experiment)
        config = config.with_code(allow_code or config.allows_code)
        for name, value, least in (("seeds", seeds, 3), ("spp", spp, 1)):
            if value is not None and value < least:
                raise ConfigError(name, "", f"is {value}; at least {least} are needed")
        keep_variant(config.variant, config.source)
        from reslrb_cli.measure.gradcheck import Gradcheck
        from reslrb_cli.measure.methods import parse_checked
        from reslrb_cli.measure.participants import CheckSettings

        gc.collect()  # earlier scenes and the gradients of their parameters would otherwise take part in the check
        named = None if integrators is None else parse_checked(integrators)
        check = Gradcheck(CheckSettings(config, named, budget, seeds, spp, time.monotonic() - began))
        with _scene_given_back(config):
            return list(check.run(stop, logger.info))


#: Scenes of `check_estimator`: factors of zero, roulette, emission, a closed sphere, glossy surfaces, masks, glass, a
#: film's border, and dL/dI of both signs. References: differences, `ptracer`, `prb`, and exact values.
CHECKED = ("albedo_0_in_one_channel", "albedo_1e-6_roulette", "black_lamp", "furnace", "roughplastic_0.1",
           "opacity_texture_0_and_1", "nested_dielectrics", "film_crop", "negative_loss")  # fmt: skip


def check_estimator(
    estimator: str | type[Estimator],
    scenes: Sequence[str] = CHECKED,
    seeds: int | None = None,
    allow_code: bool = False,
) -> list[GradcheckRecord]:
    """Compare the gradients of an estimator with independent references, in standard errors.

    The scenes are those of the extreme suite (docs/extreme.md). The references are finite differences, `ptracer`,
    `prb`, exact values, and naive AD of the same paths. Each comparison is one record with the fields of `gradcheck`:
    `record.holds` is False if the comparison fails, and `record.case` is the scene. The log (`logging.INFO`) names each
    scene. The default scenes take minutes, mostly for the compilation of kernels.

    - `estimator`: a class derived from `reslrb_cli.estimators.base.Estimator`, a registered or built-in name, or
        `FILE.py:CLASS`.
    - `scenes`: names of scenes.
    - `seeds`: number of seeds, at least 3. None: as many as each scene needs.
    - `allow_code`: permit running the file.

    An interrupt stops the check after the current scene. Sets the variant of `variant: auto` if none is set. Raises
    ConfigError.
    """
    with called() as stop:
        if seeds is not None and seeds < 3:
            raise ConfigError("seeds", "", f"is {seeds}; at least 3 are needed")
        keep_variant("auto", "check_estimator")
        from reslrb_cli.config.base import is_code
        from reslrb_cli.estimators import ESTIMATORS, check_own
        from reslrb_cli.integrators.own import load_estimator
        from reslrb_cli.measure.extreme import CASES, run_case

        unknown = [name for name in scenes if name not in CASES]
        if unknown:
            raise ConfigError("scenes", "", f"has {one_line(repr(unknown[0]), 60)}, which is no scene of the suite")
        if isinstance(estimator, str) and is_code(estimator):
            if not allow_code:
                reason = f"would run the code of {estimator} with all your rights; allow_code=True permits it"
                raise ConfigError("estimator", "", reason)
            estimator = ESTIMATORS[load_estimator(os.path.abspath(estimator), "estimator", "")]
        if isinstance(estimator, str):
            if estimator not in ESTIMATORS:
                raise ConfigError("estimator", "", f"there is no `{estimator}`; there are {', '.join(ESTIMATORS)}")
            name = estimator
        else:
            check_own(estimator, "estimator")
            name = "checked"
            ESTIMATORS[name] = estimator
        try:
            found: list[GradcheckRecord] = []
            for scene in scenes:
                if not stop():
                    logger.info(f"checking {scene}: {CASES[scene].about}")
                    found += run_case(CASES[scene], [name], seeds)
        finally:
            if name == "checked":
                del ESTIMATORS[name]
        return found


class ConvergenceLines(list[Line]):
    """Records of `convergence`. `draws` has the draws of each method by its label. References have names such as
    `reference reslrb:stack`.
    """

    draws: Mapping[str, Draws]


def convergence(
    experiment: Experiment,
    integrators: str | None = None,
    objective: Literal["fixed", "loss", "image"] = "fixed",
    budget: float = 240.0,
    rounds: int | None = None,
    spps: Sequence[int] = (),
    reference: str | None = None,
    draws: str | os.PathLike[str] | None = None,
    allow_code: bool = False,
) -> ConvergenceLines:
    """Measure how fast the error of each method falls, as `reslrb convergence` does (docs/convergence.md).

    Returns a list of the records that `--json` writes: points, methods, references and a summary sentence. Its
    attribute `draws` maps the label of each method to its samples as arrays (`Draws`). The arguments are the options of
    the command.

    - `integrators`, `reference`: as for `--integrators` and `--reference`.
    - `budget`: total time in seconds.
    - `rounds`: number of rounds, regardless of `budget`. Default: 64, within `budget`.
    - `spps`: sample counts per pixel to compare.
    - `draws`: file that keeps all draws. Draws that it has are not drawn again.
    - `allow_code`: permit running the files of your own integrators.

    Each method runs in its own process with the experiment's variant. The calling process sets no variant. An interrupt
    stops the measurement soon and raises KeyboardInterrupt. Raises ConfigError.
    """
    began = time.monotonic()
    with called() as stop:
        config = _for_processes(experiment, allow_code)
        from reslrb_cli.measure.convergence import Session
        from reslrb_cli.measure.draws import DrawsFile
        from reslrb_cli.measure.judgement import Judgement
        from reslrb_cli.measure.methods import convergence_plan
        from reslrb_cli.report.tables import result_lines

        _check_counts(rounds=[rounds], spps=spps)
        values = tuple(dict.fromkeys(spps))
        plan = convergence_plan(config, objective, integrators, reference, values, budget_s=budget, rounds=rounds)
        file = DrawsFile(None if draws is None else as_path(draws, "draws", "a file"))
        session = Session(plan, stop, logger.info, spent_s=time.monotonic() - began, file=file)
        for _ in session.run():
            pass
        if stop():
            raise KeyboardInterrupt
        found = ConvergenceLines(result_lines(Judgement(session).results()))
        found.draws = {member.name: member.draws for member in session.members}
        return found


def bench(
    experiment: Experiment,
    integrators: str | None = None,
    sweep: Swept = "depth",
    values: Sequence[int] = (),
    budget: float = 240.0,
    rounds: int | None = None,
    allow_code: bool = False,
) -> list[BenchRecord]:
    """Measure time and memory of gradient steps, as `reslrb bench` does (docs/benchmarks.md).

    Returns one record per integrator and value, with the fields that `--json` writes. The arguments are the options of
    the command.

    - `integrators`: as for `--integrators`.
    - `values`: path depths, or samples per pixel with `sweep="spp"`. Default: those of the command.
    - `budget`: total time in seconds.
    - `rounds`: number of rounds, regardless of `budget`. Default: 9, within `budget`.
    - `allow_code`: permit running the files of your own integrators.

    Each integrator runs in its own process with the experiment's variant. The calling process sets no variant. An
    interrupt stops the measurement soon and raises KeyboardInterrupt. Raises ConfigError.
    """
    began = time.monotonic()
    with called() as stop:
        config = _for_processes(experiment, allow_code)
        from reslrb_cli.measure.bench import Bench
        from reslrb_cli.measure.methods import DEEPEST, bench_plan

        if sweep not in get_args(Swept):
            raise ConfigError("sweep", "", f"is {sweep!r}; there are {', '.join(get_args(Swept))}")
        _check_counts(rounds=[rounds], values=values)
        plan = bench_plan(config, sweep, tuple(values), integrators, DEEPEST, budget_s=budget, rounds=rounds)
        session = Bench(plan, stop, logger.info, spent_s=time.monotonic() - began)
        for _ in session.run():
            pass
        if stop():
            raise KeyboardInterrupt
        return session.results()


def _for_processes(experiment: Experiment, allow_code: bool) -> Config:
    """Return the experiment for a measurement in other processes. Raises ConfigError if they cannot have a part of
    it.
    """
    config = load(experiment)
    reason = "which the processes of this measurement do not have; give"
    if config.own_scene is not None:
        raise ConfigError(config.source, "scene", f"is an mi.Scene, {reason} a file or a dictionary")
    if config.own_loss is not None:
        raise ConfigError(config.source, "loss", f"is a function, {reason} {{type: custom, file: FILE.py:NAME}}")
    return config.with_code(allow_code or config.allows_code)


def _check_counts(**options: Sequence[int | None]) -> None:
    """Raise ConfigError if a given count is below 1."""
    for option, counts in options.items():
        for number in counts:
            if number is not None and number < 1:
                raise ConfigError(option, "", f"is {number}; at least 1 is needed")


def write_report(
    sources: str | os.PathLike[str] | Sequence[str | os.PathLike[str]] | Sequence[Line], path: str | os.PathLike[str]
) -> Path:
    """Write a page, a figure or a table about runs and measurements, as `reslrb report` does (docs/report.md). Return
    its path.

    `sources` are run folders, folders of sweeps, and files that `bench`, `gradcheck` and `convergence` wrote with
    `--json`, or the records that one of these functions returned. `path` is the file to write. Its suffix selects the
    output: a page (`.html`), a figure (`.pdf`, `.svg`, `.png`) or a table (`.csv`, `.tex`). Raises ConfigError.
    """
    with called():
        load_packages()  # Mitsuba reads the images
        from reslrb_cli.report.publish import as_sources, write

        file, found = as_path(path, "path", "the path of a file"), as_sources(sources)
        with writing("path", file):
            write(found, file, "path")
        return file


def export(run: str | os.PathLike[str], folder: str | os.PathLike[str], tolerances: bool = False) -> Path:
    """Write the scene of a run with the recovered values for plain Mitsuba, and return the path of `scene.xml`.

    `run` is the run folder. `folder` must not exist or must be empty. `mi.load_file` loads the returned file.

    For a lens or a mirror, the folder also holds the solid in millimetres. `tolerances` adds how deviations from the
    plan change the image, as `reslrb export` does.

    Sets the experiment's Mitsuba variant if none is set. Raises ConfigError and UnsupportedScene.
    """
    with called():
        begun = "the folder of a run, which `optimize(..., folder=...)` makes as its loop begins"
        path, out = as_path(run, "run", begun), as_path(folder, "folder", "the path of a folder")
        config = recovered(path, ())
        from reslrb_cli.runs.export import check_export, write_export

        check_export(config, out, tolerances)
        keep_variant(config.variant, config.source)
        write_export(config, path, out, tolerances, logger.info)
        return out / "scene.xml"
