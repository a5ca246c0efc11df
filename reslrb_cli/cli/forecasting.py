"""`reslrb optimize --dry-run`: the forecast of a run, in lines."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from reslrb_cli.backend.memory import resident_bytes
from reslrb_cli.cli.output import echo
from reslrb_cli.config.files import in_words
from reslrb_cli.errors import printable
from reslrb_cli.records.clock import rough_duration

if TYPE_CHECKING:
    from reslrb_cli.config import Config
    from reslrb_cli.optimization.forecast import Forecast


def show_forecast(config: Config) -> None:
    """Measure what a run of `config` will take, and print it; a variant must be set, and nothing is written but the
    caches of kernels and pilots."""
    from reslrb_cli.optimization.forecast import make_forecast
    from reslrb_cli.records.pilot_cache import PilotCache

    forecast = make_forecast(config, logging.getLogger(__name__).info, PilotCache())
    echo(f"forecast of {printable(config.source)}; nothing was written")
    for line in [*memory_lines(forecast, config.run.budget_bytes), *time_lines(forecast)]:
        echo(line)


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


def time_lines(forecast: Forecast) -> list[str]:
    """What the parts of the run take."""
    compiled = f"and {rough_duration(forecast.compile_s)} of compiling, which is done now and kept"
    pilot = (
        f"{rough_duration(forecast.pilot_s)}, done now and kept" if forecast.pilot_s else "none, or kept from before"
    )
    sums = f"{forecast.iterations} x {1e3 * forecast.iteration_s:.3g} ms"
    sums += f" + {rough_duration(forecast.start_s)}" if forecast.start_s > 0.01 * forecast.elapsed_s else ""
    return [
        f"time of the iterations: {rough_duration(forecast.elapsed_s)} ({sums}), {compiled}",
        f"  by steps of {forecast.spp} samples per pixel",
        f"  {rough_duration(forecast.target_s):>10}  rendering the target",
        f"  {pilot:>10}  pilot",
        f"  {rough_duration(forecast.images_s):>10}  saved images",
        f"  {rough_duration(forecast.verdicts_s):>10}  verdicts on the values, or so",
        f"time of the whole run: about {rough_duration(forecast.whole_s)}",
    ]
