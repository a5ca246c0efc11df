"""A run folder as `reslrb optimize` leaves it, made without rendering anything."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from records.test_metrics import make_record

from reslrb_cli.optimization.results import summary
from reslrb_cli.records.images import write_image, write_mask, write_parameters
from reslrb_cli.records.manifest import Manifest, Status
from reslrb_cli.records.metrics import MetricsWriter
from reslrb_cli.report.tonemap import write_error_map

FLOOR, LAMP = "floor.reflectance.data", "lamp.intensity.value"
PILOT = {
    "chosen": {"estimator": "event", "capacity": 4}, "label": "event, capacity 4", "spp": 8, "advantage": 1.25,
    "next_label": "stack", "measure_s": 2.5, "compile_s": 75.0, "share": 0.047, "cached": False,
    "rows": [
        {"estimator": "stack", "options": {}, "rounds": 4, "kernel_ms": 12.5, "variance": 0.5, "efficiency": 0.16,
         "note": ""},
        {"estimator": "event", "options": {"capacity": 4}, "rounds": 4, "kernel_ms": 10.0, "variance": 0.5,
         "efficiency": 0.2, "note": ""},
        {"estimator": "gather", "options": {}, "rounds": 0, "kernel_ms": None, "variance": None, "efficiency": None,
         "note": "not measured: at most 0.50 of the best's efficiency"},
    ],
}  # fmt: skip
MEMORY = {
    "budget_bytes": 2**30, "samples_per_pass": 8, "passes": 2, "peak_mib": 612.5, "exceeded": False,
    "expected_bytes": {"fixed": 2**20, "images": 2**20, "scratch": 0, "paths": 2**21},
}  # fmt: skip
SCALING = [{"key": LAMP, "entries": 3, "value": 3e6, "gradient": 7e-9, "noise": 2e-10, "change": 1e-7,
            "curvature": 4e-15, "length": 7.76e6, "own_length": 7.76e6, "first_step": 7.76e5}]  # fmt: skip


def texture(height, width, seed=0):
    return np.random.default_rng(seed).uniform(0.05, 0.9, (height, width, 3)).astype(np.float32)


def make_run(folder, keys=(FLOOR, LAMP), sensors=1, truth=True, iterations=30, size=(24, 32), **manifest):
    """Write the folder of a run of a texture (the first of `keys`) and of colours; `manifest` is passed on."""
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
    maps = {}
    for sensor in range(sensors):
        suffix = f"-{sensor}" if sensors > 1 else ""
        target = texture(*size, seed=sensor)
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
    done = Manifest(variant="llvm_ad_rgb", device="a machine", seed=3, config="box.yaml", results=results)
    for name, value in manifest.items():
        setattr(done, name, value)
    done.end(folder, manifest.get("status", Status.FINISHED), manifest.get("error"))
    (folder / "config.yaml").write_text("run: {iterations: 30}\n")
    with MetricsWriter(folder) as metrics:
        for number in range(iterations):
            known = dict.fromkeys(keys, 0.5 * 0.95**number) if truth else {}
            step = {"step_ms": 90.0, "primal_ms": 40.0, "adjoint_ms": 50.0, "elapsed_s": 0.1 * number + 0.1}
            metrics.write(make_record(iteration=number, loss=0.9**number, parameter_errors=known, **step))
    return Path(folder)
