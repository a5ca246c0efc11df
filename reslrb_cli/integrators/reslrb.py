"""Reservoir light replay backpropagation: images and gradients by one of the estimators."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi

from reslrb_cli.estimators import ESTIMATORS
from reslrb_cli.estimators.base import Estimator, one_of
from reslrb_cli.guiding.tables import Purpose
from reslrb_cli.integrators import light_tracer as lt
from reslrb_cli.integrators.context import Motion
from reslrb_cli.integrators.light_tracer import LightTracer
from reslrb_cli.integrators.protocol import Derivative, Job
from reslrb_cli.transport.samples import Samples


class Reslrb(LightTracer):
    """Derivatives by a replay of each path; the options beside OPTIONS are those of the estimator."""

    OPTIONS: ClassVar[Mapping[str, Any]] = {
        **LightTracer.OPTIONS,
        "estimator": "reservoir",
        "freeze": False,
        "attached": "auto",
        "filter_normalization": "attached",
        "attached_sampling": "auto",
        "guiding": "off",
        "sequence": "independent",
    }

    def __init__(self, estimator: Estimator, **common: Any) -> None:
        super().__init__(**common)
        self.estimator = estimator

    @classmethod
    def of(
        cls,
        estimator: str = "reservoir",
        attached: bool | str = "auto",
        filter_normalization: str = "attached",
        attached_sampling: str = "auto",
        guiding: str = "off",
        sequence: str = "independent",
        **options: Any,
    ) -> Reslrb:
        """From the estimator's name and all options. Raises ValueError where one is wrong."""
        if estimator == "auto":
            raise ValueError(
                '"estimator" auto needs an experiment to measure on (`reslrb optimize`); as a plugin, name one of '
                + ", ".join(ESTIMATORS)
            )
        if estimator not in ESTIMATORS:
            raise ValueError(f'"estimator" must be one of {", ".join(ESTIMATORS)}, not "{estimator}"')
        kind = ESTIMATORS[estimator]
        own = {name: options.pop(name) for name in kind.OPTIONS if name in options}
        obstacle = None if kind.attaches else _no_attached(estimator)
        motion = Motion(attached, filter_normalization, obstacle, attached_sampling)
        if guiding == "auto":
            raise ValueError('"guiding" auto needs an experiment to measure on (`reslrb optimize`); say on or off')
        one_of("guiding", guiding, ("on", "off"))
        if sequence == "auto":
            raise ValueError(
                '"sequence" auto needs an experiment to measure on (`reslrb optimize`); say independent or '
                "low_discrepancy"
            )
        one_of("sequence", sequence, ("independent", "low_discrepancy"))
        low_discrepancy = sequence == "low_discrepancy"
        return cls(kind(**own), motion=motion, guided=guiding == "on", low_discrepancy=low_discrepancy, **options)

    def image_estimator(self) -> Estimator | None:
        return None if self.estimator.splats_all else self.estimator

    def correlated(self, job: Job, derivative: Derivative) -> mi.TensorXf:
        """The image, and the gradient of the same samples with the dL/dI that `derivative(image)` returns."""
        estimator = self.estimator

        def trace(samples: Samples) -> tuple[mi.TensorXf, Any]:
            result = lt.trace_image([samples], estimator)
            return result.image, result.state

        with dr.suspend_grad():
            parts = self.passes(job, Purpose.BOTH)
            if self.freezes(parts):
                traced = lt.Trace(parts, *self.preparation.recordings.call("trace", parts[0], trace))
            else:
                traced = lt.trace_image(parts, estimator)
        gradient = derivative(traced.image)
        self._replay(traced, gradient, job.params)
        self.learn(job, gradient)
        return traced.image

    def backward(self, job: Job, gradient: mi.TensorXf) -> None:
        """Add the gradient of the objective with dL/dI `gradient` (H, W, C)."""
        with dr.suspend_grad():
            trace = lt.Trace(self.passes(job, delta=gradient))
        self._replay(trace, gradient, job.params)
        self.learn(job, gradient)

    def known(self, job: Job, gradient: mi.TensorXf) -> mi.TensorXf:
        """The image, and the gradient of the objective with dL/dI `gradient` (H, W, C), known before either.

        One set of samples, traced once for both where the estimator can.
        """
        estimator = self.estimator

        def fused(samples: Samples, gradient: mi.TensorXf) -> mi.TensorXf:
            return lt.fused([samples], estimator, gradient)

        with dr.suspend_grad():
            parts = self.passes(job, Purpose.BOTH, gradient)
            if self.freezes(parts):
                image = self.preparation.recordings.call("fused", parts[0], fused, gradient)
            else:
                image = lt.fused(parts, estimator, gradient, job.params)
        self.learn(job, gradient)
        return image

    def _replay(self, trace: lt.Trace, gradient: mi.TensorXf, params: mi.SceneParameters | None) -> None:
        estimator = self.estimator

        def replay(samples: Samples, gradient: mi.TensorXf, *state: Any) -> None:
            lt.replay_all(lt.Trace([samples], None, *state), estimator, gradient)

        with dr.suspend_grad():
            recordings = self.preparation.recordings
            if not self.freezes(trace.samples):
                lt.replay_all(trace, estimator, gradient, params)
            elif trace.state is None:
                recordings.call("trace and replay", trace.samples[0], replay, gradient)
            else:
                recordings.call("replay", trace.samples[0], replay, gradient, trace.state)


def _no_attached(estimator: str) -> str:
    able = ", ".join(name for name, kind in ESTIMATORS.items() if kind.attaches)
    return (
        f"estimator {estimator} has no derivatives of what moves light: it would need the Jacobians that reservoir "
        f"takes at every vertex, and gain nothing by them; take {able}"
    )
