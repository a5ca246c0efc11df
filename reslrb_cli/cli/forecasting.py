"""`reslrb optimize --dry-run`: the forecast of a run, in lines."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from reslrb_cli.backend.memory import resident_bytes
from reslrb_cli.cli.output import echo
from reslrb_cli.config.files import in_words
from reslrb_cli.errors import printable
from reslrb_cli.records.clock import rough_duration

if TYPE_CHECKING:
    from reslrb_cli.config import Config
    from reslrb_cli.optimization.forecast import Forecast
    from reslrb_cli.optimization.problem import Problem


def show_forecast(config: Config) -> None:
    """Measure what a run of `config` will take, and print it; a variant must be set, and nothing is written but the
    caches of kernels and pilots."""
    from reslrb_cli.measure.rival import RIVAL, measure_rival
    from reslrb_cli.optimization.correlated_rounds import measure_correlated_bias
    from reslrb_cli.optimization.forecast import make_forecast
    from reslrb_cli.records.pilot_cache import PilotCache

    cache, say = PilotCache(), logging.getLogger(__name__).info
    measured: list[Before] = []

    def measure_before(problem: Problem) -> None:
        begin = time.perf_counter()
        if measure_correlated_bias(problem, say) is not None:
            measured.append(Before("bias of correlated", time.perf_counter() - begin, kept=False))
        begin = time.perf_counter()
        rival = measure_rival(problem, cache, say)
        rival_s = 0.0 if rival is None or rival.cached else time.perf_counter() - begin
        measured.append(Before(f"{RIVAL} beside it", rival_s, cache.keeps))

    forecast = make_forecast(config, say, cache, measure_before)
    before = [Before("pilot", forecast.pilot_s, cache.keeps), *measured]
    echo(f"forecast of {printable(config.source)}; nothing was written")
    for line in [*memory_lines(forecast, config.run.budget_bytes), *time_lines(forecast, before)]:
        echo(line)


@dataclass(frozen=True)
class Before:
    """What is measured once, before the first iteration: it took `seconds` now (0: nothing was to be measured), and the
    run finds it where it was `kept`."""

    name: str
    seconds: float
    kept: bool

    @property
    def run_s(self) -> float:
        """Seconds of the run."""
        return 0.0 if self.kept else self.seconds

    def line(self) -> str:
        """What of it the run has still to do."""
        took = rough_duration(self.seconds)
        if not self.seconds:
            return f"{'none, or kept from before':>10}  {self.name}"
        return f"{took + ', done now and kept':>10}  {self.name}" if self.kept else f"{took:>10}  {self.name}"


def memory_lines(forecast: Forecast, budget: int | None) -> list[str]:
    """What the iterations take, by part, beside what is free, and what `memory_budget` allows."""
    allowed = "" if budget is None else f", run.memory_budget allows {in_words(budget)}"
    lines = [
        f"memory of the iterations: {in_words(forecast.peak)} at the most; {in_words(forecast.free)} are free{allowed}"
    ]
    lines += [f"  {in_words(size):>10}  {part}" for part, size in forecast.parts.items()]
    lines.append(f"  {in_words(forecast.scratch):>10}  thread-local memory of paths (stack), beside it")
    resident = resident_bytes()
    if resident:
        lines.append(
            f"  {in_words(resident):>10}  this process as a whole: Python, libraries, kernels' code, and all above"
        )
    return lines


def time_lines(forecast: Forecast, before: Sequence[Before]) -> list[str]:
    """What the parts of the run take."""
    compiled = f"and {rough_duration(forecast.compile_s)} of compiling, which is done now and kept"
    sums = f"{forecast.iterations} x {1e3 * forecast.iteration_s:.3g} ms"
    sums += f" + {rough_duration(forecast.start_s)}" if forecast.start_s > 0.01 * forecast.elapsed_s else ""
    return [
        f"time of the iterations: {rough_duration(forecast.elapsed_s)} ({sums}), {compiled}",
        f"  by steps of {forecast.spp} samples per pixel",
        f"  {rough_duration(forecast.target_s):>10}  rendering the target",
        *(f"  {each.line()}" for each in before),
        f"  {rough_duration(forecast.images_s):>10}  saved images",
        f"  {rough_duration(forecast.verdicts_s):>10}  verdicts on the values, or so",
        f"time of the whole run: about {rough_duration(forecast.whole_s + sum(each.run_s for each in before))}",
    ]
