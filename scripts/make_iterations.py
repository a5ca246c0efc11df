#!/usr/bin/env python3
"""Compare whole iterations, image, loss and gradient, of the usual Mitsuba loop and of ours: a table and a picture.

    scripts/make_iterations.py [--depths 4 8 16] [--spp 4 16 64] [--rounds 25] [--out docs/images/iterations.png]

The usual loop renders N samples per pixel for the image and N others for the gradient, with `ptracer` under naive AD;
ours takes N in all, in batches (`run.adjoint: batched`). The scene is bench's Cornell box, without roulette, the loss
L2 against a picture of it with another texture. Iterations alternate; ratios are taken in pairs. Each gradient's error
is its distance from the mean of many independent ones, over the size of that mean, which is the root mean square over
all iterations; at equal time it goes with the root of the time that an iteration takes. Needs the environment that
`scripts/setup` makes: run it with `.venv/bin/python`, on a machine that does nothing else.
"""

from __future__ import annotations

import argparse
import statistics
import time
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import reslrb_cli  # noqa: F401  # chooses libLLVM, so it comes before Mitsuba
from reslrb_cli.backend.variant import set_variant

ROOT = Path(__file__).resolve().parent.parent
KEY = "white.reflectance.data"
USUAL = "ptracer, N + N"
#: Label, integrator and its options, and how its steps come by dL/dI.
SERIES: dict[str, tuple[dict[str, Any], str]] = {
    USUAL: ({"type": "ptracer"}, "independent"),
    "stack, batched": ({"type": "reslrb", "estimator": "stack", "freeze": True}, "batched"),
    "event, batched": ({"type": "reslrb", "estimator": "event", "freeze": True}, "batched"),
    "reservoir, batched": ({"type": "reslrb", "estimator": "reservoir", "freeze": True}, "batched"),
}
#: The reference gradient: so many, of so many samples per pixel, with seeds of their own.
REFERENCES, REFERENCE_SPP = 16, 256


class Iterations:
    """Steps of each series in one scene at one depth."""

    def __init__(self, depth: int) -> None:
        import drjit as dr
        import mitsuba as mi

        from reslrb_cli.integrators import make_integrator, render_image
        from reslrb_cli.measure import cornell_box

        self.scene = cornell_box.build({})
        self.params = mi.traverse(self.scene)
        common = {"max_depth": depth, "rr_depth": 1_000_000, "hide_emitters": True}
        self.integrators = {label: make_integrator(**options, **common) for label, (options, _) in SERIES.items()}
        texture = mi.TensorXf(self.params[KEY])
        # The picture has a texture of its own; the camera sees noise of 1 in 1000 of it at most.
        self.params[KEY] = mi.TensorXf(0.9 - 0.7 * np.array(texture))
        self.params.update()
        self.target = render_image(self.integrators[USUAL], self.scene, 0, 1, 1024)
        dr.eval(self.target)
        self.params[KEY] = texture
        dr.enable_grad(self.params[KEY])
        self.params.update()
        self.leaf = self.params[KEY]

    def loss(self, image: Any) -> Any:
        """The mean of squares."""
        import drjit as dr

        return dr.mean(dr.square(image - self.target).array)

    def step(self, integrator: Any, adjoint: str, seed: int, spp: int) -> tuple[float, np.ndarray[Any, Any]]:
        """Milliseconds of an iteration, and its gradient."""
        import drjit as dr

        from reslrb_cli.integrators import gradient_step

        dr.clear_grad(self.leaf)
        dr.sync_thread()
        start = time.perf_counter()
        result = gradient_step(
            integrator, self.scene, 0, self.loss, seed=seed, spp=spp, params=self.params, adjoint=adjoint
        )
        gradient = dr.grad(self.leaf)
        dr.eval(result.image, result.loss, gradient)
        dr.sync_thread()
        return 1e3 * (time.perf_counter() - start), np.array(gradient, np.float64).ravel()

    def reference(self) -> tuple[np.ndarray[Any, Any], float]:
        """The gradient, and the standard error of its mean, in relative L2."""
        exact = self.integrators["stack, batched"]
        samples = np.stack([self.step(exact, "independent", 10_000 + n, REFERENCE_SPP)[1] for n in range(REFERENCES)])
        mean = samples.mean(0)
        error = np.linalg.norm(samples.std(0, ddof=1)) / np.sqrt(REFERENCES)
        return mean, float(error / np.linalg.norm(mean))


def main() -> None:
    """Parse the command line, print the table, and write the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--depths", type=int, nargs="+", default=[4, 8, 16])
    parser.add_argument("--spp", type=int, nargs="+", default=[4, 16, 64])
    parser.add_argument("--rounds", type=int, default=25)
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "images" / "iterations.png")
    arguments = parser.parse_args()
    set_variant("auto")
    figure = Figure(figsize=(4.2 * len(arguments.depths), 3.8), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(arguments.depths), squeeze=False)[0]
    print("depth  spp  series              ms/iteration  over usual           rel. RMSE  at equal time, over usual")
    for axis, depth in zip(axes, arguments.depths, strict=True):
        measure(axis, depth, arguments.spp, arguments.rounds)
    axes[0].set_ylabel("relative RMSE of a gradient")
    axes[0].legend(fontsize="small")
    figure.savefig(arguments.out, dpi=110, metadata={"Software": None})


def measure(axis: Any, depth: int, all_spp: list[int], rounds: int) -> None:
    """Print the lines of one depth, and draw its diagram."""
    iterations = Iterations(depth)
    reference, noise = iterations.reference()
    size = np.linalg.norm(reference)
    curves: dict[str, list[tuple[float, float]]] = {label: [] for label in SERIES}
    for spp in all_spp:
        times: dict[str, list[float]] = {label: [] for label in SERIES}
        errors: dict[str, list[float]] = {label: [] for label in SERIES}
        for n in range(-4, rounds):  # the first compile
            for label, (_, adjoint) in SERIES.items():
                ms, gradient = iterations.step(iterations.integrators[label], adjoint, 100 + n, spp)
                if n >= 0:
                    times[label].append(ms)
                    errors[label].append(float(np.linalg.norm(gradient - reference) / size))
        usual = rms(errors[USUAL]) * np.sqrt(statistics.median(times[USUAL]))
        for label in SERIES:
            ratios = [a / b for a, b in zip(times[label], times[USUAL], strict=True)]
            ms, error = statistics.median(times[label]), rms(errors[label])
            curves[label].append((ms, error))
            print(
                f"{depth:5d}  {spp:3d}  {label:18s}  {ms:12.1f}  {statistics.median(ratios):.2f} "
                f"[{min(ratios):.2f}, {max(ratios):.2f}]  {error:9.4f}  {error * np.sqrt(ms) / usual:.2f}"
            )
    print(f"{depth:5d}       (standard error of the reference: {noise:.4f})", flush=True)
    for label, points in curves.items():
        axis.loglog(*zip(*points, strict=True), marker="o", markersize=4, label=label)
    axis.set(title=f"depth {depth}", xlabel="ms an iteration")
    axis.grid(True, which="both", alpha=0.25)


def rms(values: list[float]) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


if __name__ == "__main__":
    main()
