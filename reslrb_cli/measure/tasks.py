"""What processes of their own do: each begins with one of these functions, by its name.

A function imports what its task needs, and whoever starts a process needs none of it.
"""

from __future__ import annotations

from typing import Any

from reslrb_cli.backend.installation import python_command
from reslrb_cli.measure.processes import Process
from reslrb_cli.measure.workers import Begin, Begun


def start_process(first: dict[str, Any], does: str = "measured_steps") -> Process:
    """A process that does what the function `does` of this file returns; `first` is its first message."""
    imports = f"from reslrb_cli.measure.tasks import {does}\nfrom reslrb_cli.measure.workers import run"
    return Process(first, python_command(f"{imports}\nrun({does})"))


def measured_steps() -> Begin:
    """Steps as `bench` measures them. Whatever is imported for it is, here and in the function below."""
    from reslrb_cli.config.loader import loads
    from reslrb_cli.measure.stepper import Stepper

    def begin(first: dict[str, Any]) -> Begun:
        config = loads(first["config"], first["source"])
        stepper = Stepper(config, first["objective"], first.get("film_width"), first.get("texture_width"))
        size = {"width": stepper.size[0], "height": stepper.size[1], "texels": stepper.texels}
        return size, lambda question: stepper.step(question["round"], question["cold"], question["release"])

    return begin


def surveyed() -> Begin:
    """What `convergence` asks before it measures."""
    from reslrb_cli.measure.convergence.setup import begin_survey

    return begin_survey


def sampled_steps() -> Begin:
    """Steps as `convergence` measures them, with what they estimate."""
    from reslrb_cli.measure.convergence.setup import begin_sampling

    return begin_sampling


def judged_runs() -> Begin:
    """What whole optimisations are judged by."""
    from reslrb_cli.measure.optimization_benchmark.evaluate import begin_judging

    return begin_judging


def whole_runs() -> Begin:
    """A whole optimisation, bit by bit."""
    from reslrb_cli.measure.optimization_benchmark.evaluate import begin_run

    return begin_run
