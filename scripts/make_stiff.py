#!/usr/bin/env python3
"""Compare `scale: auto` with plain Adam on the experiments in `configs/stiff/`: a table, and docs/images/stiff.png.

    scripts/make_stiff.py [--only NAME] [--out OUT.png]

Plain Adam has one learning rate for all parameters, the best of a grid of half decades; transforms and scales are left
out, all else is as the configuration says. Both run for the same number of iterations. Times are those of
`metrics.jsonl`, the measurement of `scale: auto` counted, after a warm-up that compiles the kernels of both. Needs the
environment that `scripts/setup` makes: run it with `.venv/bin/python`, on a machine that does nothing else.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import reslrb_cli  # noqa: F401  # chooses libLLVM, so it comes before Mitsuba
from reslrb_cli.backend.variant import set_variant
from reslrb_cli.config.loader import load
from reslrb_cli.optimization.assemble import assemble, assemble_scene
from reslrb_cli.optimization.loop import optimize
from reslrb_cli.optimization.problem import Problem

ROOT = Path(__file__).resolve().parent.parent
TITLES = {"lamp": "albedo and intensity", "plate": "roughness and radiance", "wall": "73,728 texels and one number"}
#: Exponents of the learning rates: half decades around all that the parameters' own units suggest.
GRIDS = {"lamp": (-3, 9), "plate": (-3, 9), "wall": (-3, 4)}
#: What else a user of plain Adam could try, and the learning rates that might suit it.
_FALLING = ("plain, rate falling by 8 decades", "optimizer.final_fraction=1e-8", (1e3, 1e4, 1e5, 1e6, 1e7))
OTHERS: dict[str, tuple[str, str, tuple[float, ...]]] = {
    "lamp": _FALLING,
    "plate": _FALLING,
    "wall": ("plain, epsilon 1e-16", "optimizer.epsilon=1e-16", (0.01, 0.03, 0.1)),
}
#: Texels of the wall that a pixel is wide.
BLOCK = 6
#: Iterations between two points of a curve.
EVERY = 4


@dataclass
class Curve:
    """Errors of a run: time in s, iteration, and the combined error, with that of each parameter at the end."""

    label: str
    points: list[tuple[float, int, float]]
    errors: list[float]

    def at(self, seconds: float) -> float:
        """The combined error at the last point before."""
        return [error for time, _, error in self.points if time <= seconds][-1]

    @property
    def end(self) -> float:
        """When the run ended."""
        return self.points[-1][0]


class Experiment:
    """One configuration, its targets rendered once, and the runs that are compared."""

    def __init__(self, name: str) -> None:
        self.path = str(ROOT / "configs" / "stiff" / f"{name}.yaml")
        self.model = assemble(load(self.path), to_run=True)
        self.plain = ["optimizer.scale=none"]
        self.plain += [f"parameters[{i}].transform=none" for i in range(len(self.model.config.parameters))]
        for sets in (self.plain, []):
            self.run("warm-up", *sets, "run.iterations=6")

    def run(self, label: str, *sets: str) -> Curve:
        """One optimisation."""
        problem = self._problem(sets)
        points = [(0.0, 0, combined(errors(problem)))]
        for record in optimize(problem):
            if record.iteration % EVERY == EVERY - 1:
                points.append((record.elapsed_s, record.iteration + 1, combined(errors(problem))))
        return Curve(label, points, errors(problem))

    def _problem(self, sets: tuple[str, ...]) -> Problem:
        model, problem = self.model, assemble_scene(load(self.path, list(sets)))
        integrator = model.integrator.afresh()  # of the paths that were found to pay
        return replace(problem, integrator=integrator, views=model.views, truth=model.truth, masks=model.masks)


def errors(problem: Problem) -> list[float]:
    """|x - truth| / |truth| of each parameter, over what light and sensor reach.

    Of the texture x and truth are means over blocks of texels, each the size of a pixel: the picture says no more.
    """
    found = []
    for key, truth in problem.truth.items():
        value, mask = problem.selection.array(key).astype(np.float64), problem.masks[key]
        if mask.ndim == 2:
            value, truth = blocks(value, mask, BLOCK), blocks(truth.astype(np.float64), mask, BLOCK)
        else:
            value, truth = value[mask], truth[mask]
        found.append(float(np.linalg.norm(value - truth) / np.linalg.norm(truth)))
    return found


def blocks(texture: Any, mask: Any, size: int) -> Any:
    """Means over the reached texels of each block of which a quarter or more is reached."""

    def total(array: Any) -> Any:
        rows, columns = array.shape[0] // size, array.shape[1] // size
        return array[: rows * size, : columns * size].reshape(rows, size, columns, size, -1).sum((1, 3))

    count = total(mask[:, :, None].astype(np.float64))
    return (total(texture * mask[:, :, None]) / np.maximum(count, 1))[count[:, :, 0] >= size * size / 4]


def combined(parts: list[float]) -> float:
    """The root mean square of the parameters' errors: each parameter counts as much as any other."""
    return float(np.sqrt(np.mean(np.square(parts))))


def compare(name: str) -> dict[str, Any]:
    """Run one experiment, and print what came of it."""
    experiment = Experiment(name)
    first, last = GRIDS[name]
    rates = [10 ** (first + half / 2) for half in range(2 * (last - first) + 1)]
    grid = [experiment.run(f"{rate:.1e}", *experiment.plain, f"optimizer.learning_rate={rate!r}") for rate in rates]
    auto = experiment.run("scale: auto")
    transformed = any(spec.transform != "none" for spec in experiment.model.config.parameters)
    without = [setting for setting in experiment.plain if "transform" in setting]
    bare = [experiment.run("scale: auto, no transforms", *without)] if transformed else []
    label, setting, suited = OTHERS[name]
    runs = [experiment.run(label, *experiment.plain, f"optimizer.learning_rate={r!r}", setting) for r in suited]
    tried = min(runs, key=lambda curve: curve.points[-1][2])
    best = min(grid, key=lambda curve: curve.points[-1][2])
    best.label = f"plain, rate {best.label}"
    paths = "".join(f"; {each.setting} {each.value}" for each in experiment.model.decisions)
    print(f"\n{name}: {TITLES[name]}; error at the start {auto.points[0][2]:.3f}{paths}")
    for curve in (best, tried, *bare, auto):
        time = min(curve.end, auto.end)
        each = ", ".join(f"{part:.4f}" for part in curve.errors)
        print(
            f"  {curve.label:46} error {curve.points[-1][2]:.4f} ({each}) after {curve.end:5.2f} s; of scale: auto "
            f"{auto.at(time) / curve.at(time):.3f} in equal time, "
            f"{auto.points[-1][2] / curve.points[-1][2]:.3f} after equal iterations"
        )
    print(
        "  all rates: " + ", ".join(f"{rate:.1e}: {c.points[-1][2]:.3f}" for rate, c in zip(rates, grid, strict=True))
    )
    return {"title": TITLES[name], "grid": grid, "best": best, "tried": tried, "bare": bare, "auto": auto}


def draw(results: list[dict[str, Any]], out: Path) -> None:
    """Error against run time above, against iterations below."""
    figure = Figure(figsize=(4.2 * len(results), 6.4), dpi=90, layout="constrained")
    axes = figure.subplots(2, len(results), squeeze=False, sharey="col")
    for column, result in enumerate(results):
        lines: list[tuple[Curve, str, str, float, str | None]]
        lines = [(curve, "0.8", "-", 0.7, None) for curve in result["grid"]]
        lines += [(result["tried"], "tab:green", ":", 1.5, result["tried"].label)]
        lines += [(result["best"], "tab:red", "-", 1.8, result["best"].label)]
        lines += [(curve, "tab:blue", "--", 1.3, curve.label) for curve in result["bare"]]
        lines += [(result["auto"], "tab:blue", "-", 1.8, "scale: auto")]
        for row, what in enumerate((0, 1)):
            axis = axes[row][column]
            for curve, color, style, width, label in lines:
                xs, ys = [point[what] for point in curve.points], [point[2] for point in curve.points]
                axis.plot(xs, ys, color=color, linestyle=style, linewidth=width, label=label)
            axis.set_yscale("log")
            axis.grid(True, which="both", alpha=0.25)
            axis.set_xlabel(("time in steps and updates (s)", "iteration")[row])
        axes[0][column].set_title(result["title"])
        axes[1][column].legend(fontsize=7, loc="lower left")
    for row in axes:
        row[0].set_ylabel("relative error of the parameters")
    canvas = FigureCanvasAgg(figure)
    canvas.print_png(str(out))


def main() -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=TITLES, help="run one experiment alone")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "images" / "stiff.png")
    arguments = parser.parse_args()
    set_variant("auto")
    results = [compare(name) for name in TITLES if arguments.only in (None, name)]
    draw(results, arguments.out)


if __name__ == "__main__":
    main()
