"""Kinds of gradients that have one dL/dI, each sampled in a process of its own: what figures of the paper compare.

The processes load `paper_fixed_adjoint.py`, which holds dL/dI at a reference image's; this module knows no Mitsuba.
Seeds differ between kinds, but for those that are asked to share them.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from reslrb_cli.backend.installation import python_command
from reslrb_cli.config.integrators import Reslrb as ReslrbConfig
from reslrb_cli.config.loader import dump
from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ConfigError
from reslrb_cli.measure.processes import Ended, Process
from reslrb_cli.seeds import seed

MIB = 2**20

#: On a GPU address space says nothing of the memory that arrays take.
VARIANT = "llvm_ad_rgb"

#: Who takes gradients: the experiment's own integrator.
OWN = "own"
_ADJOINT = "adjoint.npy"


@dataclass
class Kind:
    """One kind of gradient: `samples` (N, H, W, C), the peak of Dr.Jit's arrays, and of the process's address space.

    `by` is who takes them, as `comparable` has it. `end` is how a process ended that did not come to its
    first gradient.
    """

    name: str
    spp: int
    by: str
    samples: np.ndarray | None = None
    arrays_mib: float | None = None
    address_mib: float = 0.0
    end: Ended | None = None

    @property
    def label(self) -> str:
        """Its name and samples."""
        return f"{self.name}, {self.spp} spp"

    @property
    def rows(self) -> np.ndarray:
        """The samples in rows, (N, P), in double precision."""
        assert self.samples is not None, "asked of kinds that have been sampled"
        return self.samples.reshape(len(self.samples), -1).astype(np.float64)


def check_config(config: Config) -> str:
    """The label of the experiment's own estimator. Raises ConfigError where gradients could not be compared."""
    integrator = config.integrator
    if config.variant not in ("auto", VARIANT):
        raise ConfigError(config.source, "variant", f"must be auto or {VARIANT}: the limit bounds address space alone")
    if not isinstance(integrator, ReslrbConfig) or integrator.estimator == "auto":
        raise ConfigError(config.source, "integrator.estimator", "must name an estimator of `reslrb`")
    if integrator.max_depth < 0:
        raise ConfigError(config.source, "integrator.max_depth", "must be a limit: paths are traced without roulette")
    return f"reslrb:{integrator.estimator}"


def take_pictures(config: Config, spp: int, folder: Path, masked: bool = False) -> dict[str, np.ndarray]:
    """Target, initial image and dL/dI of `pictures`; what `sample` does in this folder has that dL/dI."""
    process = _start(config, None, OWN, None)
    try:
        process.answer(_never)
        process.ask({"spp": spp, "out": str(folder / "pictures.npz"), "masked": masked})
        process.answer(_never)
    finally:
        process.close()
    with np.load(folder / "pictures.npz") as arrays:
        pictures = {name: arrays[name] for name in arrays.files}
    np.save(folder / _ADJOINT, pictures["adjoint"])
    return pictures


def sample(kind: Kind, count: int, config: Config, folder: Path, series: str, limit: int | None = None) -> str:
    """Take `count` gradients of a kind; what ends their process is the kind's end. Returns the parameter's key.

    `limit` is of the process's address space, in bytes. Kinds of one `series` have the same seeds.
    """
    process, out, taken = _start(config, limit, kind.by, folder / _ADJOINT), folder / "gradient.npy", []
    key = ""
    try:
        key = str(process.answer(_never)["key"])
        for number in range(count):
            process.ask({"seed": seed(config.run.seed, number, 0, series), "spp": kind.spp, "out": str(out)})
            answer: dict[str, Any] = process.answer(_never)
            kind.arrays_mib = max(kind.arrays_mib or 0.0, float(answer["peak_mib"]))
            taken.append(np.load(out))
        kind.samples = np.stack(taken)
    except Ended as end:
        kind.end = end
    finally:
        process.close()
        kind.address_mib = process.peak_bytes / MIB
    return key


def _start(config: Config, limit: int | None, by: str, adjoint: Path | None) -> Process:
    first = {
        "config": dump(config),
        "source": str(config.source),
        "variant": VARIANT,
        "memory_limit": limit,
        "by": by,
        "adjoint": None if adjoint is None else str(adjoint),
    }
    imports = "from paper_fixed_adjoint import begin_holding\nfrom reslrb_cli.measure.workers import run"
    return Process(first, python_command(f"{imports}\nrun(lambda: begin_holding)"))


def _never() -> bool:
    return False
