"""Gradients of an experiment with dL/dI held at a reference image's, one by one, at the parameters' initial values.

From their own images gradients of different noise, or of different numbers of samples, have different expectations:
noise in the image biases each by its own amount. With one dL/dI for all they have the same, and can be compared.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.config.integrators import Prb, Ptracer, WalkAd
from reslrb_cli.config.integrators import Reslrb as ReslrbConfig
from reslrb_cli.config.loader import loads
from reslrb_cli.config.schema import Config
from reslrb_cli.measure.participants import ALIKE, NEVER
from reslrb_cli.measure.stepper import Steps
from reslrb_cli.measure.workers import Begun
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.views import to_tensor
from reslrb_cli.records.clock import peak_mib, reset_peak
from reslrb_cli.records.measurements import Reference
from reslrb_cli.scene.visibility import interior, sees_specular

#: The purpose, and the seed's part in it, of the samples of the image that dL/dI is held at.
_REFERENCE = "reference"


def comparable(config: Config, by: str) -> Config:
    """The experiment with gradients `by` one that all estimate the same: nobody has roulette, nor what `ptracer` lacks.

    `own` is the experiment's `reslrb`, `ptracer` and `walk_ad` are naive AD, of the stock walk and of ours, `prb`
    replays paths from the sensor, and any other name is that of an estimator. Naive AD does not differentiate
    roulette's decision.
    """
    assert isinstance(config.integrator, ReslrbConfig), "checked by whoever compares"
    own = config.integrator.undecided_off()
    alike: dict[str, Any] = {**ALIKE[Reference.PTRACER], "rr_depth": NEVER}
    shared: dict[str, Any] = {"max_depth": own.max_depth, "rr_depth": NEVER, "hide_emitters": own.hide_emitters}
    integrator: Prb | Ptracer | ReslrbConfig | WalkAd = own.model_copy(
        update=alike if by == "own" else alike | {"estimator": by}
    )
    if by == "ptracer":
        integrator = Ptracer(type="ptracer", **shared)
    elif by == "prb":
        integrator = Prb(type="prb", **shared)
    elif by == "walk_ad":
        detached: Any = {"filter_normalization": "detached"}
        integrator = WalkAd(type="walk_ad", attached=own.attached, **shared | detached)
    return config.model_copy(update={"integrator": integrator})


def pictures(config: Config, spp: int, masked: bool = False) -> dict[str, np.ndarray]:
    """Target and initial image (H, W, C) of the first sensor, the latter with `spp` samples, and dL/dI at it.

    If `masked`, dL/dI is 0 where light paths find less than paths from the sensor do: in pixels that see smooth
    specular lobes, and at the film's border.
    """
    problem = assemble(config.with_exposures_fixed())
    view = problem.views[0]
    initial = problem.render(view.sensor, spp, 0, _REFERENCE)
    image = mi.TensorXf(initial)
    dr.enable_grad(image)
    dr.backward(view.compare(image))
    adjoint = np.array(dr.grad(image))
    if masked:
        at = problem.scene.sensors()[view.sensor]
        seen = sees_specular(problem.scene, at)
        adjoint *= (interior(adjoint.shape, at) & ~(seen.alone | seen.mixed))[:, :, None]
    return {"target": np.array(view.target), "initial": initial, "adjoint": adjoint}


class Held:
    """Takes gradients with respect to the first parameter, through the first sensor; `adjoint` is dL/dI (H, W, C)."""

    def __init__(self, config: Config, adjoint: np.ndarray) -> None:
        self.steps = Steps(config)
        self.key = self.steps.problem.selection.keys[0]
        self.adjoint = to_tensor(adjoint)

    def gradient(self, seed: int, spp: int) -> np.ndarray:
        """One gradient, of the parameter's shape."""
        gradients, _ = self.steps.gradient(seed, self.adjoint, spp)
        shape = self.steps.problem.selection.array(self.key).shape
        return np.array(gradients[self.key], np.float32).reshape(shape)


def begin_holding(first: dict[str, Any]) -> Begun:
    """Begin a process (`workers.py`): with an `adjoint`, a file, one of gradients, else of pictures.

    A question names the file that its answer's arrays are written to, `out`, the samples `spp` and, of gradients, the
    `seed`; answers to those have `peak_mib`, Dr.Jit's arrays at their most. `by` says by what they are.
    """
    config = loads(first["config"], first["source"])
    if first["adjoint"] is None:

        def picture(question: dict[str, Any]) -> dict[str, Any]:
            np.savez(question["out"], **pictures(config, question["spp"], question["masked"]))  # type: ignore[arg-type]
            return {}

        return {}, picture
    held = Held(comparable(config, first["by"]), np.load(first["adjoint"]))

    def gradient(question: dict[str, Any]) -> dict[str, Any]:
        reset_peak()
        np.save(question["out"], held.gradient(question["seed"], question["spp"]))
        return {"peak_mib": peak_mib(dr.backend_v(mi.Float))}

    return {"key": held.key}, gradient
