"""Integrators behind one interface: our light tracers as Mitsuba plugins, stock baselines, and the gradient step."""

from reslrb_cli.integrators.adapter import register
from reslrb_cli.integrators.interface import Job, StepIntegrator
from reslrb_cli.integrators.refusal import Refused, first_channels
from reslrb_cli.integrators.reslrb import Reslrb
from reslrb_cli.integrators.step import (
    OnSamples,
    StepResult,
    cross_step,
    gradient_step,
    known_step,
    make_integrator,
    render_image,
    sample_sets,
)

__all__ = [
    "Job",
    "OnSamples",
    "Refused",
    "Reslrb",
    "StepIntegrator",
    "StepResult",
    "cross_step",
    "first_channels",
    "gradient_step",
    "known_step",
    "make_integrator",
    "register",
    "render_image",
    "sample_sets",
]
