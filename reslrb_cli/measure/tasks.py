"""What processes of their own can be asked for, by the name that `processes.Process` takes.

Nothing but a process that is to do one of these imports this file: each function imports what its task needs, and a
process that asks for a task needs none of it.
"""

from __future__ import annotations

from typing import Any

from reslrb_cli.measure.worker import Begin, Begun, run

__all__ = ["held_gradients", "judged_runs", "measured_steps", "run", "sampled_steps", "surveyed", "whole_runs"]


def measured_steps() -> Begin:
    """Steps as `bench` measures them. Whatever is imported for it is, here and in the function below."""
    from reslrb_cli.config import loads
    from reslrb_cli.measure.stepper import Stepper

    def begin(first: dict[str, Any]) -> Begun:
        config = loads(first["config"], first["source"])
        stepper = Stepper(config, first["objective"], first.get("film_width"), first.get("texture_width"))
        size = {"width": stepper.size[0], "height": stepper.size[1], "texels": stepper.texels}
        return size, lambda question: stepper.step(question["round"], question["cold"], question["release"])

    return begin


def held_gradients() -> Begin:
    """Gradients with dL/dI held, and what they are taken at."""
    from reslrb_cli.measure.held import begin

    return begin


def surveyed() -> Begin:
    """What `convergence` asks before it measures."""
    from reslrb_cli.measure.convergence.survey import begin

    return begin


def sampled_steps() -> Begin:
    """Steps as `convergence` measures them, with what they estimate."""
    from reslrb_cli.measure.convergence.sampler import begin

    return begin


def judged_runs() -> Begin:
    """What whole optimisations are judged by."""
    from reslrb_cli.measure.whole_runs.judge import begin

    return begin


def whole_runs() -> Begin:
    """A whole optimisation, bit by bit."""
    from reslrb_cli.measure.whole_runs.runner import begin

    return begin
