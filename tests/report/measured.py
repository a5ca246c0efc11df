"""Run folder and files of measurements as the commands write them, made without any measurement."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from records.test_metrics import make_record

from reslrb_cli.optimization.results import summary
from reslrb_cli.records.images import write_image, write_mask, write_parameters
from reslrb_cli.records.manifest import Manifest, Status
from reslrb_cli.records.measurement_files import Origin
from reslrb_cli.records.measurements import (
    BenchRecord,
    BenchStatus,
    GradcheckRecord,
    Kind,
    Method,
    MissingRecord,
    Reference,
    Spread,
    Verdict,
)
from reslrb_cli.records.metrics import MetricsWriter
from reslrb_cli.records.sweeps import Combination, SweepPlan, run_name
from reslrb_cli.report.tonemap import write_error_map

# Files as `bench`, `gradcheck` and `convergence` write them, made without any measurement.

ORIGIN = Origin("a machine, 3 threads", "llvm_ad_rgb", ["reslrb", "bench", "my <box>.yaml"], {"mitsuba": "3.9.1"},
                "Plan 9", "2026-01-02T03:04:05+00:00")  # fmt: skip


def write_bench(path, depths=(2, 4, 8)):
    """Write a bench of two integrators. `ptracer` runs out of memory at the last depth."""
    records = []
    for depth in depths:
        for label, factor in (("ptracer", 3.0), ("reslrb:reservoir", 1.0)):
            ended = label == "ptracer" and depth == depths[-1]
            times = None if ended else Spread(factor * depth, 0.9 * factor * depth, 1.2 * factor * depth)
            status = BenchStatus.OUT_OF_MEMORY if ended else BenchStatus.OK
            cold = None if ended else 900.0
            method = Method(label, {"rr_depth": 99}, 4, depth)
            records.append(BenchRecord(method, status, 64, 48, None, *[times] * 4, None, None, cold, cold, cold, 0, 5))
    write_records(path, records)


def write_gradcheck(path, parameter="floor.reflectance.data"):
    """Write a comparison that holds, one that fails, and the missing part of a derivative."""
    common = {"kind": Kind.EXPECTATION, "seeds": 8, "relative_l2": 0.02, "z_rms": 1.1, "z_rms_limit": 1.4}
    records = [
        GradcheckRecord("box.yaml", parameter, label, {}, Reference.PTRACER, verdict=verdict, z_max=z,
                        z_max_limit=4.0, **common)
        for label, verdict, z in (("reslrb:stack", Verdict.HOLDS, 2.0), ("reslrb:gather", Verdict.FAILS, 9.0))
    ]  # fmt: skip
    write_records(path, [*records, MissingRecord("box.yaml", parameter, 0.25, 0.01, 3, 16)])


def write_records(path, records):
    path.write_text("".join(record.to_json() + "\n" for record in records))


def convergence_lines(parameter="all"):
    """Return lines of two methods and their reference. The errors fall as the square root of time. One time is
    extrapolated, and one error is never reached.
    """
    lines = []
    for label, factor in (("ptracer", 0.5), ("reslrb:stack", 0.2)):
        method = {"label": label, "options": {}, "adjoint": "independent", "parameter": parameter, "spp": 4}
        for elapsed in (0.5, 1.0, 2.0, 4.0):
            figures = {"elapsed_s": elapsed, "relative_rmse": factor / elapsed**0.5, "reference_rmse": 0.01}
            lines.append({"kind": "point", **method, **figures, "steps": 4, "repeats": 8})
        lines.append({
            "kind": "method", **method, "status": "ok", "efficiency": {"value": 4.0, "low": 3.0, "high": 5.0},
            "bias_z": 0.7, "bias_z_limit": 4.5, "biased": False,
            "seconds_to": {"0.1": 3.5, "0.03": 120.0, "0.01": None}, "extrapolated": ["0.03"], "message": "",
        })  # fmt: skip
    return [*lines, {"kind": "reference", **method, "reference_rmse": 0.01, "repeats": 8}]


def write_convergence(path, parameter="all"):
    path.write_text("".join(json.dumps(line) + "\n" for line in convergence_lines(parameter)))


# A run folder as `reslrb optimize` leaves it, made without rendering.

FLOOR, LAMP = "floor.reflectance.data", "lamp.intensity.value"
SCALING = [
    {"key": LAMP, "entries": 3, "value": 3e6, "gradient": 7e-9, "curvature": 4e-15, "first_step": 7.76e5},
]


def texture(height, width, seed=0):
    return np.random.default_rng(seed).uniform(0.05, 0.9, (height, width, 3)).astype(np.float32)


def make_run(folder, keys=(FLOOR, LAMP), sensors=1, truth=True, iterations=30, size=(24, 32), **manifest):
    """Write the run folder of a texture (the first of `keys`) and of colours. `manifest` holds further fields of the
    manifest.
    """
    for name in ("images", "parameters", "checkpoint"):
        (folder / name).mkdir(parents=True)
    moments = {"initial": 0.5, "final": 0.9, "true": 1.0}
    values = {
        moment: {
            key: texture(8, 8) * np.float32(part) if place == 0 else np.array([4.0, 2.0, 1.0], np.float32) * part
            for place, key in enumerate(keys)
        }
        for moment, part in moments.items()
    }
    write_parameters(folder / "parameters", values["final"])
    write_parameters(folder / "parameters" / "initial", values["initial"])
    mask = np.ones((8, 8), dtype=bool)
    mask[:2] = False
    if truth:
        write_parameters(folder / "parameters" / "true", values["true"])
        write_mask(folder / "parameters", keys[0], mask)
    maps, views = {}, []
    for sensor in range(sensors):
        suffix = f"-{sensor}" if sensors > 1 else ""
        target = texture(*size, seed=sensor)
        views.append({"sensor": sensor, "share": 1 / sensors, "held_out": False, "exposure": 1.0, "pixels": 768,
                      "left_out": 0, "kinds": {}, "counted": {}, "shown": 1.0})  # fmt: skip
        for name, part in (("initial", 0.5), ("final", 0.9), ("target", 1.0)):
            write_image(folder / "images" / f"{name}{suffix}", target * np.float32(part))
        image = target * np.float32(0.9)
        maps[f"error{suffix}"] = write_error_map(folder / "images", suffix, image, target, image - target)
    errors = {key: {"initial": 0.5, "final": 0.1} for key in keys} if truth else {}
    results = {
        "iterations": iterations, "loss": 0.0123, "elapsed_s": 95.0, "rmse": {"initial": None, "final": None},
        "parameter_rmse": errors, "relative_error": errors,
        "parameters": {
            key: {
                "quantity": "intensity" if place else "", "shape": list(values["final"][key].shape),
                "reached": 0.75 if truth and not place else None, "scale": 1.0 if truth else None,
                **{moment: summary(values[moment][key]) if truth or moment != "true" else None for moment in moments},
            }
            for place, key in enumerate(keys)
        },
        "loss_trend": None, "worse": [], "error_maps": maps,
    }  # fmt: skip
    results |= manifest.pop("results", {})
    done = Manifest(
        variant="llvm_ad_rgb", device="a machine", seed=3, config="box.yaml", results=results, views=views
    )  # fmt: skip
    for name, value in manifest.items():
        setattr(done, name, value)
    done.end(folder, manifest.get("status", Status.FINISHED), manifest.get("error"))
    (folder / "config.yaml").write_text("run: {iterations: 30}\n")
    with MetricsWriter(folder) as metrics:
        for number in range(iterations):
            known = dict.fromkeys(keys, 0.5 * 0.95**number) if truth else {}
            step = {"step_ms": 90.0, "elapsed_s": 0.1 * number + 0.1}
            metrics.write(make_record(iteration=number, loss=0.9**number, parameter_errors=known, **step))
    return Path(folder)


def write_sweep(folder, seeds=1):
    """Write a sweep of two combinations, with finished runs."""
    combinations = [Combination(f"spp={spp}", {"run.spp": spp}) for spp in (4, 8)]
    plan = SweepPlan("a.yaml", [], combinations, list(range(seeds)))
    for combination, seed in plan.runs:
        make_run(folder / run_name(combination, seed), results={"image_loss": {"initial": 1.0, "final": 0.5}})
    plan.write(folder)
    return folder
