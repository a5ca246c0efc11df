"""Our light tracers as Mitsuba plugins: `mi.load_dict({"type": "reslrb", ...})` after `reslrb_cli.register()`."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from reslrb_cli.errors import UnsupportedScene
from reslrb_cli.estimators import ESTIMATORS, Estimator
from reslrb_cli.integrators import freezing
from reslrb_cli.integrators import light_tracer as lt
from reslrb_cli.integrators.differentiated import differentiated
from reslrb_cli.integrators.freezing import Recordings
from reslrb_cli.scene.graph import SceneGraph
from reslrb_cli.scene.needs import check_supported, scene_needs
from reslrb_cli.transport.accumulation import in_passes
from reslrb_cli.transport.plan import Plan, make_plan
from reslrb_cli.transport.samples import Samples, passes
from reslrb_cli.transport.splat import Film

_registered_with_callback = False


def register() -> None:
    """Make our integrators known to Mitsuba, in the current variant and in any that is set later."""
    global _registered_with_callback
    if not _registered_with_callback:
        mi.detail.add_variant_callback(_on_variant)
        _registered_with_callback = True
    if mi.variant() is not None:
        _on_variant(None, mi.variant())


def _on_variant(old: str | None, new: str) -> None:
    if not new.endswith(("_ad_rgb", "_ad_mono")):
        return
    for name, kind in _make_classes().items():
        mi.register_integrator(name, lambda props, kind=kind: kind(props))


def _make_classes() -> dict[str, Any]:
    """Plugins by name. The classes derive from one of the variant's, so they exist once for each variant."""

    class LightIntegrator(mi.CppADIntegrator):
        """What all have in common: `ptracer`'s options, and the image."""

        def __init__(self, props: Any) -> None:
            # Taken before the base class sees it, which has another idea of a pass and warns.
            self.samples_per_pass: int | None = props.get("samples_per_pass", None)
            if self.samples_per_pass is not None:
                del props["samples_per_pass"]
                if self.samples_per_pass <= 0:
                    raise ValueError('"samples_per_pass" must be greater than zero')
            super().__init__(props)
            self.max_depth = props.get("max_depth", -1)
            if self.max_depth < -1:
                raise ValueError('"max_depth" must be -1 (no limit) or a value >= 0')
            self.rr_depth = props.get("rr_depth", 5)
            if self.rr_depth <= 0:
                raise ValueError('"rr_depth" must be greater than zero')
            self.freeze = False
            self._track_zeros = False
            self._plans: dict[Any, Plan] = {}  # of the sensors of one scene
            self.recordings = Recordings()  # the same scene's
            self._scene: Any = None  # its address, and, to keep that from being used again, itself
            self._owners: dict[Any, list[Any]] = {}  # BSDFs of its surfaces that use a node, and under None all of them

        def plan(self, scene: Any, sensor: Any, params: Any = None) -> Plan:
            """What a walk of this scene needs; refuses what cannot work. `params`: those to look for derivatives in."""
            if self._scene is None or self._scene[0] != scene.ptr:
                # The scene's own integrator does not hold the scene: neither would ever be freed.
                owner = scene.integrator()
                self._scene = (scene.ptr, None if owner is not None and owner.ptr == self.ptr else scene)
                self._plans.clear()
                self._owners.clear()
                self.recordings.clear()
            key = sensor.ptr
            if key not in self._plans:
                check_supported(scene, sensor, self.hide_emitters)
                needs = scene_needs(scene, sensor)
                lt.settle(scene)
                self._plans[key] = make_plan(needs, self.max_depth, self.rr_depth, self.hide_emitters)
            plan = self._plans[key]
            if params is None:
                return plan
            which = differentiated(params)
            # Once needed, kept: otherwise kernels would be compiled anew whenever a texel enters or leaves zero.
            self._track_zeros |= which.zeros
            only = self._bsdfs(scene, which.bsdf_nodes)
            return plan.differentiating(bool(which.bsdf_nodes), which.emission, self._track_zeros, only)

        def _bsdfs(self, scene: Any, nodes: tuple[Any, ...]) -> tuple[Any, ...]:
            """The surfaces' BSDFs that use any of these nodes; empty where that is all of them."""
            if any(node not in self._owners for node in nodes):
                graph = SceneGraph.of(scene)
                owners = {n: [n.bsdf()] if isinstance(n, mi.Shape) else graph.owning_bsdfs(n) for n in nodes}
                self._owners |= owners | {None: graph.surface_bsdfs()}
            used = {bsdf: None for node in nodes for bsdf in self._owners[node]}
            return () if all(bsdf in used for bsdf in self._owners.get(None, [])) else tuple(used)

        def passes(self, scene: Any, sensor: Any, seed: Any, spp: int, params: Any = None) -> list[Samples]:
            """The samples of one image, and the sensor's own sample count where `spp` is 0."""
            spp = spp or sensor.sampler().sample_count()
            plan = self.plan(scene, sensor, params)
            return passes(plan, scene, sensor, seed, spp, self.samples_per_pass)

        def render(self, scene: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0, develop: bool = True,
                   evaluate: bool = True) -> Any:  # fmt: skip
            if not develop:
                raise ValueError("develop=True must be specified when invoking AD integrators")
            sensor, estimator = resolve_sensor(scene, sensor), self.image_estimator()

            def image(samples: Samples) -> Any:
                return lt.image_of([samples], estimator)

            with dr.suspend_grad():
                parts = self.passes(scene, sensor, seed, spp)
                if evaluate and self._freezes(parts):
                    return self.recordings.call("image", parts[0], image)
                result = lt.image_of(parts, estimator)
                if evaluate:
                    dr.eval(result)
                return result

        def render_forward(self, scene: Any, params: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0) -> Any:
            sensor = resolve_sensor(scene, sensor)
            params = _parameters(scene, params)
            with dr.suspend_grad():
                samples = self.passes(scene, sensor, seed, spp, params)
                film = samples[0].film
                block = film.block()
                in_passes(samples, lt.splat_tangents, block)
                return film.develop_tangent(block)

        def _freezes(self, parts: list[Samples]) -> bool:
            """Whether these samples are traced from a recording; large ones, and so several passes, gain little."""
            return self.freeze and len(parts) == 1 and parts[0].width <= freezing.MOST_PATHS

        def image_estimator(self) -> Estimator | None:
            """The estimator that makes images of its own; None where they show every connection."""
            return None

        def aov_names(self) -> list[str]:
            return []

        def to_string(self) -> str:
            return f"{type(self).__name__}[max_depth = {self.max_depth}, rr_depth = {self.rr_depth}]"

    class ReslrbIntegrator(LightIntegrator):
        """Reservoir light replay backpropagation: derivatives by a replay of each path."""

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            name = props.get("estimator", "reservoir")
            if name == "auto":
                raise ValueError(
                    '"estimator" auto needs an experiment to measure on (`reslrb optimize`); as a plugin, name one of '
                    + ", ".join(ESTIMATORS)
                )
            if name not in ESTIMATORS:
                raise ValueError(f'"estimator" must be one of {", ".join(ESTIMATORS)}, not "{name}"')
            # An option that the estimator does not know stays unread, which Mitsuba reports as an error.
            kind = ESTIMATORS[name]
            self.freeze = props.get("freeze", False)
            self.estimator = kind(**{key: props.get(key, default) for key, default in kind.OPTIONS.items()})

        def image_estimator(self) -> Estimator | None:
            return None if self.estimator.splats_all else self.estimator

        def trace(self, scene: Any, sensor: Any, seed: Any, spp: int, params: Any) -> lt.Trace:
            """The image, and what a replay of the same samples needs; both evaluated."""
            estimator = self.estimator

            def trace(samples: Samples) -> tuple[Any, Any]:
                result = lt.trace_image([samples], estimator)
                return result.image, result.state

            with dr.suspend_grad():
                parts = self.passes(scene, sensor, seed, spp, params)
                if not self._freezes(parts):
                    return lt.trace_image(parts, estimator)
                return lt.Trace(parts, *self.recordings.call("trace", parts[0], trace))

        def replay(self, trace: lt.Trace, gradient: Any, params: Any) -> None:
            """Add the gradient of the objective with dL/dI `gradient` (H, W, C) to the parameters."""
            estimator = self.estimator

            def replay(samples: Samples, gradient: Any, *state: Any) -> None:
                lt.replay_all(lt.Trace([samples], None, *state), estimator, gradient)

            with dr.suspend_grad():
                if not self._freezes(trace.samples):
                    lt.replay_all(trace, estimator, gradient, params)
                elif trace.state is None:
                    self.recordings.call("trace and replay", trace.samples[0], replay, gradient)
                else:
                    self.recordings.call("replay", trace.samples[0], replay, gradient, trace.state)

        def fused(self, scene: Any, sensor: Any, seed: Any, spp: int, gradient: Any, params: Any) -> Any:
            """The image, and the gradient of the objective with dL/dI `gradient` (H, W, C), known before either.

            One set of samples, traced once for both where the estimator can.
            """
            estimator = self.estimator

            def fused(samples: Samples, gradient: Any) -> Any:
                return lt.fused([samples], estimator, gradient)

            with dr.suspend_grad():
                parts = self.passes(scene, sensor, seed, spp, params)
                if not self._freezes(parts):
                    return lt.fused(parts, estimator, gradient, params)
                return self.recordings.call("fused", parts[0], fused, gradient)

        def render_backward(self, scene: Any, params: Any, grad_in: Any, sensor: Any = 0, seed: Any = 0,
                            spp: int = 0) -> None:  # fmt: skip
            sensor = resolve_sensor(scene, sensor)
            params = _parameters(scene, params)
            with dr.suspend_grad():
                trace = lt.Trace(self.passes(scene, sensor, seed, spp, params))
            self.replay(trace, grad_in, params)

    class WalkAdIntegrator(LightIntegrator):
        """The same walk under naive AD: for comparisons at equal seeds."""

        def tracked_image(self, scene: Any, sensor: Any, seed: Any, spp: int, params: Any) -> Any:
            """The image with its whole graph."""
            film = Film(sensor)
            block = film.block()
            for samples in self.passes(scene, sensor, seed, spp, params):
                lt.splat_tracked(samples, block)
            return film.develop(block)

        def render_backward(self, scene: Any, params: Any, grad_in: Any, sensor: Any = 0, seed: Any = 0,
                            spp: int = 0) -> None:  # fmt: skip
            sensor = resolve_sensor(scene, sensor)
            with dr.resume_grad():
                image = self.tracked_image(scene, sensor, seed, spp, _parameters(scene, params))
                dr.backward_from(image * grad_in)

        def render_forward(self, scene: Any, params: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0) -> Any:
            sensor = resolve_sensor(scene, sensor)
            with dr.resume_grad():
                image = self.tracked_image(scene, sensor, seed, spp, _parameters(scene, params))
                return dr.forward_to(image)

    class TrajectoryIntegrator(LightIntegrator):
        """The same walk in a loop that Dr.Jit itself reverses, from a record of its state in thread-local memory."""

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            if self.max_depth == -1:
                raise ValueError('"max_depth" must be given: it is the size of the record')

        def render_backward(self, scene: Any, params: Any, grad_in: Any, sensor: Any = 0, seed: Any = 0,
                            spp: int = 0) -> None:  # fmt: skip
            sensor = resolve_sensor(scene, sensor)
            params = _parameters(scene, params)
            with dr.suspend_grad():
                parts = self.passes(scene, sensor, seed, spp, params)
                if parts[0].plan.differentiate_null:
                    raise UnsupportedScene(
                        "trajectory: Dr.Jit cannot reverse the loop through masks within that of the path; give "
                        "parameters to other surfaces than masks alone"
                    )
                adjoint = parts[0].film.adjoint(grad_in)

                def differentiate(part: Samples, block: None) -> None:
                    with dr.isolate_grad():  # as in `replay_all`; without it the derivatives of textures are lost
                        lt.reverse_recorded(part, adjoint)

                in_passes(parts, differentiate, None, params)

    return {"reslrb": ReslrbIntegrator, "walk_ad": WalkAdIntegrator, "trajectory": TrajectoryIntegrator}


def resolve_sensor(scene: Any, sensor: Any) -> Any:
    """A sensor of the scene, given as itself or as its index."""
    return scene.sensors()[sensor] if isinstance(sensor, int) else sensor


def _parameters(scene: Any, params: Any) -> Any:
    """Parameters to look for derivatives in: the user's, or all of the scene's."""
    return params if isinstance(params, mi.SceneParameters) else mi.traverse(scene)
