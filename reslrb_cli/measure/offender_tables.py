"""Which tables the samples of a guided step were drawn from, noted while the step is taken again."""

from __future__ import annotations

import mitsuba as mi

from reslrb_cli.integrators.guiding import Guiding, Purpose
from reslrb_cli.integrators.hearing import Said
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.views import View
from reslrb_cli.transport.guide import Table


class Witness(Guiding):
    """What another has learned, which goes on learning, and notes which tables samples are drawn from.

    `drawn` are the tables of the samples so far, in order, those of samples that were learned from left out.
    """

    def __init__(self, other: Guiding) -> None:
        super().__init__()
        self.images, self.held, self.grid = other.images, other.held, other.grid
        self.learned, self.films = dict(other.learned), dict(other.films)
        self.drawn: list[Table] = []

    def table(self, number: int, purpose: Purpose, delta: mi.TensorXf | None = None) -> Table:
        """What samples for sensor `number` are drawn from."""
        found = super().table(number, purpose, delta)
        self.drawn.append(found)
        return found

    def learn(self, number: int, paths: int, said: Said) -> None:
        """Have the table of a sensor learn from paths that were drawn for this alone."""
        self.drawn.pop()
        super().learn(number, paths, said)


def purposes(problem: Problem, view: View) -> list[tuple[int, str, Purpose]]:
    """What a step draws samples for, in order: the place of each among `sample_sets`, a word to its name, what for."""
    options = problem.config.step_options()
    gradient = Purpose.GRADIENT if problem.on_samples(view) is None else Purpose.BOTH
    if options["adjoint"] == "correlated":
        return [(0, "", Purpose.BOTH)]
    if options["adjoint"] == "independent":
        return [(0, "", Purpose.IMAGE), (1, "", gradient)]
    found = [(0, "", Purpose.IMAGE), *((b, "", Purpose.BOTH) for b in range(1, options["batches"]))]
    return [*found, (0, ", again", gradient)] if options["first_batch"] == "again" else found
