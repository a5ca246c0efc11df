"""Runs an optimisation and writes its run folder."""

from __future__ import annotations

import logging
import os
import shlex
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from reslrb_cli.errors import NonFinite
from reslrb_cli.optimization import Problem, optimize
from reslrb_cli.optimization.nonfinite import Findings
from reslrb_cli.optimization.rendering import saved_spp
from reslrb_cli.optimization.results import Results
from reslrb_cli.optimization.scaling import Scaled, step_line
from reslrb_cli.records.checkpoint import save_checkpoint, save_nonfinite
from reslrb_cli.records.images import write_image
from reslrb_cli.records.manifest import Manifest, Status
from reslrb_cli.records.metrics import MetricsWriter, Record
from reslrb_cli.records.parameters import write_mask, write_parameters
from reslrb_cli.records.run_folder import RunFolder
from reslrb_cli.records.tally import ClampTally, NonFiniteTally
from reslrb_cli.report import write_report
from reslrb_cli.report.error_map import write_error_map
from reslrb_cli.report.verdict import warnings

logger = logging.getLogger(__name__)

#: Seconds between two checkpoints.
CHECKPOINT_SECONDS = 30.0


@dataclass
class Recording:
    """One run being recorded: `records_done` counts finished iterations, `last` is the newest record."""

    problem: Problem
    folder: RunFolder
    manifest: Manifest
    first: Record | None = None
    last: Record | None = None
    results: Results = field(init=False)
    error_maps: dict[str, Any] = field(default_factory=dict)
    nonfinite: NonFiniteTally = field(default_factory=NonFiniteTally)
    clamped: ClampTally = field(default_factory=ClampTally)
    _saved_nonfinite: bool = False

    def __post_init__(self) -> None:
        self.results = Results(self.problem)

    @property
    def done(self) -> int:
        """The number of finished iterations."""
        return 0 if self.last is None else self.last.iteration + 1

    def run(self, show: Callable[[Record], None], stop: Callable[[], bool]) -> Status:
        """Iterate until the end or until `stop()`, and complete the folder; return how it ended.

        Whatever ends the run, its folder holds the parameters, a checkpoint, the report and a final status; the
        final images are missing only where the run failed or was interrupted again while they were rendered.
        """
        status, error = Status.FAILED, None
        try:
            self._begin()
            self._iterate(show, stop)
            interrupted = self.done < self.problem.config.run.iterations
            self._write_images("final")
            status = Status.INTERRUPTED if interrupted else Status.FINISHED
        except KeyboardInterrupt:
            status = Status.INTERRUPTED
        except NonFinite as failure:
            error = f"{failure}; where: {self._inspection()}" if self._saved_nonfinite else str(failure)
            raise NonFinite(error) from None
        except BaseException as failure:
            error = " ".join(str(failure).split()) or type(failure).__name__
            raise
        finally:
            self._end(status, error)
        return status

    def _begin(self) -> None:
        problem, parameters = self.problem, self.folder.parameters
        self.results.begin()
        for sensor, target in zip(problem.sensors, problem.targets, strict=True):
            write_image(self.folder.images / self._image_name("target", sensor), np.array(target))
        self._write_images("initial")
        write_parameters(parameters / "initial", problem.values())
        if problem.truth:
            write_parameters(parameters / "true", problem.truth)
        for key, mask in problem.masks.items():
            write_mask(parameters, key, mask)

    def _iterate(self, show: Callable[[Record], None], stop: Callable[[], bool]) -> None:
        every, saved = self.problem.config.run.images_every, time.monotonic()
        if stop():
            return
        with MetricsWriter(self.folder.path) as metrics:
            for record in optimize(self.problem, self._on_nonfinite):
                if self.first is None and self.problem.sensitivities is not None:
                    self._note_scaling(self.problem.sensitivities)
                self.first, self.last = self.first or record, record
                metrics.write(record)
                self.results.add(record)
                self.nonfinite.add(record)
                self.clamped.add(record)
                show(record)
                self._check_memory(record)
                if stop():
                    return
                if every and self.done % every == 0 and self.done < self.problem.config.run.iterations:
                    self._write_images(f"iteration-{self.done:06d}")
                if time.monotonic() - saved > CHECKPOINT_SECONDS:
                    self._save_checkpoint()
                    saved = time.monotonic()

    def _note_scaling(self, measured: list[Scaled]) -> None:
        self.manifest.scaling = [row.to_json() for row in measured]
        for row in measured:
            spec = self.problem.selection.spec(row.key)
            line = step_line(row, spec.transform, spec.learning_rate or self.problem.config.optimizer.learning_rate)
            (logger.warning if row.own_length is None else logger.info)(f"scale auto: {line}")

    def _on_nonfinite(self, found: Findings) -> None:
        """Keep the parameters of the first step that met a value that is not finite, and say how to look into it."""
        if self._saved_nonfinite:
            return
        save_nonfinite(self.folder.checkpoint, found.iteration, self.problem.values())
        self._saved_nonfinite = True
        if self.problem.config.run.on_nonfinite != "stop":  # which says so when it ends
            logger.warning(f"{found}; where: {self._inspection()}")

    def _inspection(self) -> str:
        return f"reslrb inspect {shlex.quote(os.path.relpath(self.folder.path / 'config.yaml'))} --nonfinite"

    def _check_memory(self, record: Record) -> None:
        memory = self.problem.memory
        if memory is not None:
            warning = memory.check(record.peak_mib)
            if warning is not None:
                logger.warning(warning)
            self.manifest.memory = memory.to_json()

    def _end(self, status: Status, error: str | None) -> None:
        self.results.end()
        found = self.results.to_json()
        self.manifest.results = {
            "iterations": self.done,
            "loss": self.last and _json_number(self.last.loss),
            "elapsed_s": self.last and self.last.elapsed_s,
            **found,
            "warnings": warnings(found),
            "error_maps": self.error_maps,
            "nonfinite": self.nonfinite.to_json(),
            "clamped": self.clamped.to_json(),
        }
        write_parameters(self.folder.parameters, self.problem.values())
        self._save_checkpoint()
        self.manifest.end(self.folder.path, status, error)
        write_report(self.folder.path)

    def _save_checkpoint(self) -> None:
        save_checkpoint(self.folder.checkpoint, self.done, self.problem.values(), self.problem.optimizer.state())

    def _write_images(self, name: str) -> None:
        spp = saved_spp(self.problem, between=name.startswith("iteration"))
        if name == "final":
            logger.info(f"rendering the final image: {spp} spp")
        for sensor, target in zip(self.problem.sensors, self.problem.targets, strict=True):
            image = self.problem.render(sensor, spp, self.done, "saved image")
            write_image(self.folder.images / self._image_name(name, sensor), image)
            self.results.see(name, image, target)
            if name == "final":
                error = self._image_name("error", sensor)
                self.error_maps[error] = write_error_map(self.folder.images / error, image, np.array(target))

    def _image_name(self, name: str, sensor: int) -> str:
        return name if len(self.problem.sensors) == 1 else f"{name}-{sensor}"


def _json_number(value: float) -> Any:
    return value if np.isfinite(value) else None
