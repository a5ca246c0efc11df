"""Integrators from a name and options, and light tracers as Mitsuba plugins.

`mi.load_dict({"type": "reslrb", ...})` makes a plugin after `reslrb_cli.register()`.
"""

from __future__ import annotations

import functools
import importlib
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import mitsuba as mi

from reslrb_cli.backend.llvm import loaded_fault
from reslrb_cli.backend.variant import check_variant, works_under
from reslrb_cli.config.integrators import AUTO_ESTIMATOR, AUTO_VALUES, PLAIN
from reslrb_cli.estimators import ATTACHED, ESTIMATORS, make_estimator, options_of
from reslrb_cli.estimators.base import one_of
from reslrb_cli.integrators.baselines import Trajectory, WalkAd
from reslrb_cli.integrators.context import resolve_sensor
from reslrb_cli.integrators.own import OwnIntegrator
from reslrb_cli.integrators.plans import AttachedOptions, SamplingOptions
from reslrb_cli.integrators.protocol import Job, StepIntegrator
from reslrb_cli.integrators.reslrb import LightTracer, Reslrb
from reslrb_cli.integrators.step import interface_of
from reslrb_cli.scene import dispersion
from reslrb_cli.scene.plastic import PlasticTables, with_tables

#: Our integrators by the names of their plugins.
TRACERS = ("reslrb", "walk_ad", "trajectory")

#: Files of our integrators.
_FILES = (__file__, str(Path(__file__).with_name("reslrb_basic.py")))
_registered_with_callback = False

#: Options of `reslrb` and their defaults. The estimator has more (`options_of`). With an estimator that the user names,
#: the defaults of the settings in PLAIN are their plain values.
OPTIONS: dict[str, Any] = {
    **LightTracer.OPTIONS,
    "estimator": "auto",
    "freeze": False,
    "attached": "auto",
    "filter_normalization": "attached",
    "attached_sampling": "auto",
    **PLAIN,
    **dict.fromkeys(AUTO_VALUES, "auto"),
}


def register() -> None:
    """Register the plugins with Mitsuba, for the current variant and for variants that are set later: integrators,
    `dispersivedielectric`, `illuminant` and `sensitivity`.

    Dr.Jit replaces each error in `mi.render` by a `RuntimeError` without its reason. `register` therefore also replaces
    `mi.render` by a function that raises the errors of these integrators themselves, such as UnsupportedScene.

    Raises BackendError, which lists the supported variants, if the current variant is not supported. If an unsupported
    variant is set later, loading one of the integrators raises an error.
    """
    global _registered_with_callback
    if not _registered_with_callback:
        mi.detail.add_variant_callback(_on_variant)
        _registered_with_callback = True
    if mi.variant() is not None:
        _on_variant(None, mi.variant())
        check_variant(mi.variant())


def make_integrator(type: str, **options: Any) -> StepIntegrator:
    """Make an integrator from its plugin's name and options.

    The name is `reslrb`, `walk_ad`, `trajectory`, a stock integrator such as `ptracer` and `prb`, or `custom` for a
    user's own integrator (`OwnIntegrator`). Options that are None are left out, because Mitsuba would crash. Raises
    ValueError for an unknown option.
    """
    given = {name: value for name, value in options.items() if value is not None}
    if type in TRACERS:
        return make_tracer(type, given)
    if type == "custom":
        return OwnIntegrator(**given)
    properties = mi.Properties(type)
    for name, value in given.items():
        properties[name] = value
    # `mi.load_dict` would search for a library `plugins/prb.so` and run one from the working folder: it does not know
    # plugins written in Python.
    integrator = mi.PluginManager.instance().create_object(properties)
    if properties.unqueried():
        raise ValueError(f"{type} has no option {', '.join(properties.unqueried())}")
    return interface_of(integrator)


def make_tracer(type: str, options: Mapping[str, Any]) -> Reslrb | WalkAd | Trajectory:
    """Make one of the light tracers. Raises ValueError if an option is wrong."""
    unknown = [name for name in options if name not in _option_names(type, options.get("estimator"))]
    if unknown:
        raise ValueError(f"{type} has no option {', '.join(unknown)}")
    if type == "reslrb":
        return make_reslrb(**options)
    return WalkAd(**options) if type == "walk_ad" else Trajectory(**options)


def make_reslrb(**given: Any) -> Reslrb:
    """Make `reslrb` from its options, including those of the estimator. Raises ValueError if one is wrong."""
    named = given.get("estimator", "auto") != "auto"
    options = {**OPTIONS, **(PLAIN if named else {}), **given}
    estimator = options.pop("estimator")
    estimator = AUTO_ESTIMATOR if estimator == "auto" else estimator
    one_of("estimator", estimator, ("auto", *ESTIMATORS))
    if options["paths"] == "camera" and estimator != "stack":
        raise ValueError(
            f'"estimator" {estimator} needs the connections of light paths, and paths: camera has none; remove it, '
            "or use stack"
        )
    obstacle = None
    if estimator not in ATTACHED:
        obstacle = (
            f"estimator {estimator} has no derivatives of moving light: it would need the Jacobians that reservoir "
            f"computes at every vertex, without a benefit; use {', '.join(ATTACHED)}"
        )
    light_share, chosen = options.pop("light_share"), {name: options.pop(name) for name in AUTO_VALUES}
    for name, value in chosen.items():
        one_of(name, value, ("auto", *AUTO_VALUES[name]))
    chosen = _without_measuring(chosen)
    motion = AttachedOptions(
        options.pop("attached"),
        options.pop("filter_normalization"),
        obstacle,
        options.pop("attached_sampling"),
    )
    sampling = SamplingOptions(chosen.pop("paths"), light_share, chosen)
    own = {name: options.pop(name) for name in options_of(estimator) if name in options}
    return Reslrb(make_estimator(estimator, own), motion=motion, sampling=sampling, **options)


def _without_measuring(chosen: dict[str, str]) -> dict[str, str]:
    """Return the settings with decisions in place of `auto`, as far as they need neither a scene nor a measurement.

    `paths` and `edges` may stay `auto`: they depend on the scene and on its differentiated parameters.
    """
    open_ = [name for name in ("guiding", "pixels") if chosen[name] == "auto"]
    if open_:
        plain = ", ".join(f"{name} {PLAIN[name]}" for name in open_)
        mi.Log(mi.LogLevel.Info, f"reslrb: {plain}, because only `reslrb optimize` measures whether it pays")
    found = chosen | {name: PLAIN[name] for name in open_}
    if found["sequence"] == "auto":
        found["sequence"] = "low_discrepancy" if found["guiding"] == "off" else "independent"
    return found


def _on_variant(old: str | None, new: str) -> None:
    # `check_variant` raises: Mitsuba's own message, "no such plugin", would not help.
    usable = works_under(new) and not (new.startswith("llvm") and loaded_fault())
    plugin = _plugin_class() if usable else lambda name, props: check_variant(mi.variant())
    if usable and not hasattr(mi.render, "_reslrb"):
        mi.render = _with_reasons(mi.render)
    for name in TRACERS:
        mi.register_integrator(name, lambda props, name=name: plugin(name, props))
    mi.register_integrator("reslrb_basic", _basic if usable else lambda props: check_variant(mi.variant()))
    if usable:
        dispersion.register()


def _basic(props: mi.Properties) -> mi.Integrator:
    """Make a `reslrb_basic` of the current variant. Its class derives from a class of the variant."""
    module = importlib.import_module(f"{__package__}.reslrb_basic")
    if mi.variant() != module.VARIANT:
        module = importlib.reload(module)
    return module.ReslrbBasic(props)


def _with_reasons(render: Callable[..., Any]) -> Callable[..., Any]:
    """Return `mi.render` with errors of our integrators in place of the `RuntimeError` that Dr.Jit makes of them."""

    @functools.wraps(render)
    def call(*args: Any, **options: Any) -> Any:
        try:
            return render(*args, **options)
        except RuntimeError as error:
            cause = error.__cause__
            frames = traceback.walk_tb(cause.__traceback__) if cause is not None else ()
            if not any(frame.f_code.co_filename in _FILES for frame, _ in frames):
                raise
            assert cause is not None
            reason = cause
        raise reason from None

    call._reslrb = True  # type: ignore[attr-defined]
    return call


def _plugin_class() -> type[mi.CppADIntegrator]:
    """Return the class of the plugins. The class derives from a class of the variant. Each variant therefore needs a
    separate class.
    """

    class LightTracerPlugin(mi.CppADIntegrator):
        """Light tracer under `mi.render`."""

        def __init__(self, type: str, props: mi.Properties) -> None:
            # Mitsuba reports every unread option as unknown; queried options count as read.
            names = _option_names(type, props.get("estimator", None) if type == "reslrb" else None)
            options = {name: props.get(name) for name in names if name in props}
            # Before the base class sees it, which means something else by a pass and warns.
            if "samples_per_pass" in props:
                del props["samples_per_pass"]
            super().__init__(props)
            self.type = type
            self.tracer = make_tracer(type, options)
            self.max_depth, self.rr_depth = self.tracer.max_depth, self.tracer.rr_depth
            self.samples_per_pass = self.tracer.samples_per_pass

        def render(self, scene: mi.Scene, sensor: mi.Sensor | int = 0, seed: mi.UInt32 | int = 0, spp: int = 0,
                   develop: bool = True, evaluate: bool = True) -> mi.TensorXf:  # fmt: skip
            if not develop:
                raise ValueError("develop=True must be specified when invoking AD integrators")
            return self.tracer.image(Job(scene, resolve_sensor(scene, sensor), seed, spp), evaluate)

        def render_forward(self, scene: mi.Scene, params: Any, sensor: mi.Sensor | int = 0, seed: mi.UInt32 | int = 0,
                           spp: int = 0) -> mi.TensorXf:  # fmt: skip
            job = _job(scene, params, sensor, seed, spp)
            PlasticTables(job.params).push()
            return self.tracer.tangent(job)

        def render_backward(self, scene: mi.Scene, params: Any, grad_in: mi.TensorXf, sensor: mi.Sensor | int = 0,
                            seed: mi.UInt32 | int = 0, spp: int = 0) -> None:  # fmt: skip
            job = _job(scene, params, sensor, seed, spp)
            with with_tables(job.params):
                self.tracer.backward(job, grad_in)

        def aov_names(self) -> list[str]:
            return []

        def to_string(self) -> str:
            return f"{self.type}[max_depth = {self.max_depth}, rr_depth = {self.rr_depth}]"

    return LightTracerPlugin


def _option_names(type: str, estimator: str | None) -> list[str]:
    """Return the names of an integrator's options, including those of its estimator."""
    if type != "reslrb":
        return list(WalkAd.OPTIONS if type == "walk_ad" else Trajectory.OPTIONS)
    name = AUTO_ESTIMATOR if estimator in (None, "auto") else estimator
    return [*OPTIONS, *(options_of(name) if name in ESTIMATORS else ())]


def _job(scene: mi.Scene, params: Any, sensor: mi.Sensor | int, seed: mi.UInt32 | int, spp: int) -> Job:
    """Return a job that differentiates the user's parameters, or all parameters of the scene."""
    params = params if isinstance(params, mi.SceneParameters) else mi.traverse(scene)
    return Job(scene, resolve_sensor(scene, sensor), seed, spp, params)
