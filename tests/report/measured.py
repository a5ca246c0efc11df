"""Files as `bench`, `gradcheck` and `convergence` write them, made without measuring anything."""

from __future__ import annotations

import json

import numpy as np

from reslrb_cli.records.images import write_layers
from reslrb_cli.records.measurement_files import Origin
from reslrb_cli.records.measurements import (
    BenchRecord,
    BenchStatus,
    GradcheckRecord,
    Kind,
    MissingRecord,
    Reference,
    Spread,
    Verdict,
)

ORIGIN = Origin("a machine, 3 threads", "llvm_ad_rgb", ["reslrb", "bench", "my <box>.yaml"], {"mitsuba": "3.9.1"},
                "Plan 9", "2026-01-02T03:04:05+00:00")  # fmt: skip


def write_bench(path, depths=(2, 4, 8), spps=(4,)):
    """Two integrators; `ptracer` runs out of memory at the last depth."""
    records = []
    for spp in spps:
        for depth in depths:
            for integrator, estimator, factor in (("ptracer", None, 3.0), ("reslrb", "reservoir", 1.0)):
                ended = estimator is None and depth == depths[-1]
                times = None if ended else Spread(factor * depth, 0.9 * factor * depth, 1.2 * factor * depth)
                status = BenchStatus.OUT_OF_MEMORY if ended else BenchStatus.OK
                cold = None if ended else 900.0
                records.append(BenchRecord(integrator, estimator, None, depth, 99, spp, 64, 48, status, times, times,
                                           times, times, cold, cold, cold, 0, 5))  # fmt: skip
    write_records(path, records)


def write_gradcheck(path, parameter="floor.reflectance.data"):
    """One comparison that holds, one that fails, and what is missing of a derivative."""
    common = {"kind": Kind.EXPECTATION, "seeds": 8, "relative_l2": 0.02, "z_rms": 1.1, "z_rms_limit": 1.4}
    records = [
        GradcheckRecord("box.yaml", parameter, "reslrb", estimator, Reference.PTRACER, verdict=verdict, z_max=z,
                        z_max_limit=4.0, **common)
        for estimator, verdict, z in (("stack", Verdict.HOLDS, 2.0), ("gather", Verdict.FAILS, 9.0))
    ]  # fmt: skip
    write_records(path, [*records, MissingRecord("box.yaml", parameter, 0.25, 0.01, 3, 16)])


def write_records(path, records):
    path.write_text("".join(record.to_json() + "\n" for record in records))


def convergence_lines(parameter="all"):
    """Two methods that fall as the square root, and their reference; one time is extrapolated, one is never reached."""
    lines = []
    for integrator, estimator, factor in (("ptracer", None, 0.5), ("reslrb", "stack", 0.2)):
        label = integrator if estimator is None else f"{integrator}:{estimator}"
        method = {"label": label, "integrator": integrator, "estimator": estimator, "capacity": None}
        method |= {"adjoint": "independent", "parameter": parameter, "spp": 4}
        for elapsed in (0.5, 1.0, 2.0, 4.0):
            figures = {"elapsed_s": elapsed, "relative_rmse": factor / elapsed**0.5, "reference_rmse": 0.01}
            lines.append({"kind": "point", **method, **figures, "steps": 4, "repeats": 8})
        lines.append({
            "kind": "method", **method, "status": "ok", "slope": {"value": -0.5, "low": -0.55, "high": -0.45},
            "efficiency": {"value": 4.0, "low": 3.0, "high": 5.0}, "bias_z": 0.7, "bias_z_limit": 4.5, "biased": False,
            "seconds_to": {"0.1": 3.5, "0.03": 120.0, "0.01": None}, "extrapolated": ["0.03"], "message": "",
        })  # fmt: skip
    return [*lines, {"kind": "reference", **method, "reference_rmse": 0.01, "repeats": 8}]


def runs_lines(label="reslrb:stack", finite=True):
    """Three seeds of two methods, whose losses and errors are known: (1 + seed) times a factor over time."""
    lines = []
    for integrator, estimator, name, factor in (("ptracer", None, "ptracer", 5.0), ("reslrb", "stack", label, 1.0)):
        method = {"label": name, "integrator": integrator, "estimator": estimator, "capacity": None}
        method |= {"adjoint": "batched", "spp": 4}
        for seed in range(3):
            for elapsed in (1.0, 2.0, 4.0):
                loss = factor * (1 + seed) / elapsed if finite else None
                error = {"loss": loss, "parameter_error": 0.1 * factor * (1 + seed) / elapsed}
                lines.append(
                    {"kind": "run_point", **method, "seed": seed, "elapsed_s": elapsed, "iteration": 3, **error}
                )
        bands = {what: {"median": scale * factor / 2, "low": scale * factor / 4, "high": 3 * scale * factor / 4}
                 for what, scale in (("loss", 1.0), ("parameter_error", 0.1))}  # fmt: skip
        lines.append({
            "kind": "run_method", **method, "status": "ok", "runs": 3, "elapsed_s": 4.0, "message": "",
            "iterations": {"median": 30, "low": 28, "high": 33}, "first_s": {"median": 1.5, "low": 1.4, "high": 1.7},
        } | bands)  # fmt: skip
    return [*lines, {"kind": "summary", "line": "best by the loss is reslrb:stack"}]


def write_convergence(path, parameter="all"):
    path.write_text("".join(json.dumps(line) + "\n" for line in convergence_lines(parameter)))


def write_maps(folder, name="floor-stack"):
    """A map of a gradient as `gradcheck --images` writes it."""
    folder.mkdir()
    gradient = np.random.default_rng(1).normal(size=(8, 12, 3)).astype(np.float32)
    layers = {"gradient": gradient, "reference": 1.1 * gradient, "difference": -0.1 * gradient, "z": gradient[:, :, 0]}
    write_layers(folder / f"{name}.exr", layers)
