"""Execution of a new or resumed run: computes its iterations and writes its folder."""

from __future__ import annotations

import contextlib
import functools
import logging
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from reslrb_cli.errors import MachineError, describe, is_machine_fault
from reslrb_cli.optimization.loop import iterate
from reslrb_cli.optimization.nonfinite import Findings
from reslrb_cli.optimization.problem import Problem, saved_spp
from reslrb_cli.optimization.sensitivity import scale_line
from reslrb_cli.optimization.state import State
from reslrb_cli.optimization.uncertainty.measuring import LEAST_ITERATIONS
from reslrb_cli.optimization.uncertainty.verdicts import CertaintyRecord
from reslrb_cli.records.atomic import remove_parts
from reslrb_cli.records.checkpoint import (
    STATE_FILE,
    newest_checkpoint,
)
from reslrb_cli.records.decisions import Scaled
from reslrb_cli.records.images import load_image, write_file, write_image, write_mask, write_parameters
from reslrb_cli.records.manifest import Manifest, Status
from reslrb_cli.records.measurement_files import LivePage
from reslrb_cli.records.measurements import incomplete_records
from reslrb_cli.records.metrics import MetricsWriter, Record, finite
from reslrb_cli.records.run_folder import FABRICATION_FILE, RunFolder
from reslrb_cli.report.page import write_report
from reslrb_cli.report.perceptual import seen_errors
from reslrb_cli.report.run_summary import warnings
from reslrb_cli.report.tonemap import shown_exposures, write_error_map
from reslrb_cli.runs.callbacks import Calls
from reslrb_cli.runs.log import append_log, collected, log_line
from reslrb_cli.runs.prepare import RunProgress

logger = logging.getLogger(__name__)


@dataclass
class Recording:
    """Recording of one run. `course` holds its progress."""

    course: RunProgress
    folder: RunFolder
    manifest: Manifest
    calls: Calls
    #: Lines for the log file.
    said: list[str] = field(default_factory=list)
    page: LivePage = field(init=False)
    #: Images at the initial values by sensor, until the first iteration. An interrupt before it must not wait for them.
    initial: dict[int, Any] = field(default_factory=dict)
    error_maps: dict[str, Any] = field(default_factory=dict)
    seen: dict[str, Any] = field(default_factory=dict)
    certainty: CertaintyRecord | None = None
    #: One line about each measurement after the run that was not possible.
    unmeasured: list[str] = field(default_factory=list)
    #: How the run ended, or RUNNING.
    status: Status = Status.RUNNING
    _told_nonfinite: bool = False
    #: Iterations that the newest checkpoint contains; None before the first one.
    _saved: int | None = None

    def __post_init__(self) -> None:
        self.page = LivePage(self._write_live_page)

    @property
    def problem(self) -> Problem:
        """The optimisation problem."""
        return self.course.problem

    @property
    def done(self) -> int:
        """The number of finished iterations."""
        return self.course.done

    def run(self, show: Callable[[Record], None], stop: Callable[[], bool]) -> Status:
        """Iterate until the end or until `stop()` is true, and complete the folder. Returns how the run ended.

        See `records`. An exception in `show` ends the run with that exception.
        """
        records = self.records(stop)
        for record in records:
            try:
                show(record)
            except BaseException as error:
                with contextlib.suppress(StopIteration):
                    records.throw(error)
        return self.status

    def records(self, stop: Callable[[], bool] = lambda: False) -> Generator[Record, None, None]:
        """Yield the record of each iteration, then complete the folder and set `status`. Write the log file.

        Iteration stops at the last iteration, when `stop()` is true, or when the generator is closed. `stop()` also
        stops measurements for `scale: curvature`. In all cases, the folder finally has a checkpoint, the parameters,
        the report, and a manifest with the outcome. If the run did not fail, the folder also has the final images.
        Raises the error that ended the run. The error is a MachineError if the run could not write to the folder.
        """
        self.course.stop_when(stop)
        records = self._records()
        advance: Callable[[], Record] = records.__next__
        left = f"{self.problem.config.run.iterations - self.done} iterations of {self.manifest.config}"
        append_log(self.folder, [*self.said, log_line(f"begins {left}")])
        while True:
            with collected() as lines:  # and not while other runs have their turn
                try:
                    record = advance()
                except StopIteration:
                    lines.append(log_line(f"{self.status.value} after {self.done} iterations"))
                    return
                except BaseException as error:
                    lines.append(log_line(describe(error), "ERROR"))
                    raise
                finally:
                    append_log(self.folder, lines)
            try:
                yield record
            except BaseException as error:
                advance = functools.partial(records.throw, error)
            else:
                advance = records.__next__

    def _records(self) -> Generator[Record, None, None]:
        status: Status = Status.FAILED
        failure: BaseException | None = None
        try:
            self.page.refresh()
            if self.done:  # a run with iterations has already written the files of `_begin`
                self._saved = self.done
            self.calls.begin()
            if not self.done:
                self._begin()
            (self.folder.path / FABRICATION_FILE).unlink(missing_ok=True)  # outdated once the run goes on
            with contextlib.suppress(GeneratorExit):
                yield from self._iterate()
            left = self.done < self.problem.config.run.iterations and not self.course.state.stopped
            status = Status.INTERRUPTED if left else Status.FINISHED
        except KeyboardInterrupt:
            self.course.stand()
            status = Status.INTERRUPTED
        except BaseException as error:
            failure = error
        self.status = self._end(status, failure)

    def abandon(self) -> None:
        """Mark the run as interrupted in the manifest. The process is about to exit during an iteration."""
        if not self.manifest.results and self.course.last is not None:
            self.manifest.results = {"iterations": self.done, "elapsed_s": self.course.last.elapsed_s}
        if self.folder.is_there:
            self.manifest.end_for_good(self.folder.path, Status.INTERRUPTED)

    def _begin(self) -> None:
        problem, parameters = self.problem, self.folder.parameters
        self._save_checkpoint()
        for view in problem.views:
            self._write_image("target", view.sensor, np.array(view.target))
            if view.weights is not None:
                write_image(self.folder.images / self._image_name("weights", view.sensor), np.array(view.weights))
        self._write_images("initial")
        write_parameters(parameters / "initial", problem.values())
        if problem.truth:
            write_parameters(parameters / "true", problem.truth)
        for key, mask in problem.masks.items():
            write_mask(parameters, key, mask)

    def _iterate(self) -> Iterator[Record]:
        run, saved, saved_at = self.problem.config.run, self.done, time.monotonic()
        told = self.course.state.scaling
        if self.problem.interrupted():
            return
        with MetricsWriter(self.folder.path) as metrics:
            for state, record in self._iterations():
                if state.scaling is not None and state.scaling is not told:
                    self._tell_scaling(state.scaling)
                told = state.scaling
                metrics.write(record)  # first, because a checkpoint needs the lines of its iterations
                self.course.add(state, record)
                self.initial.clear()
                self.calls.iteration(record)
                yield record
                if (fault := self.folder.fault) is not None:  # the folder may have been removed or replaced
                    raise fault
                if self.problem.interrupted():
                    return
                if run.checkpoint_every.is_due(self.done - saved, time.monotonic() - saved_at):
                    metrics.sync()
                    self._save_checkpoint()
                    saved, saved_at = self.done, time.monotonic()
                self.page.refresh()

    def _iterations(self) -> Iterator[tuple[State, Record]]:
        course = self.course
        yield from iterate(course.problem, course.state, self._on_nonfinite)
        if course.state.stopped:
            logger.info(f"stopped after {self.done} iterations: {course.state.stopped}")

    def _tell_scaling(self, measured: Sequence[Scaled]) -> None:
        """Record the measurements for `scale` in the manifest, and log the resulting steps."""
        self.manifest.scaling = [row.to_json() for row in measured]
        for row in measured:
            level = logging.WARNING if row.curvature is None else logging.INFO
            logger.log(level, f"scale {self.problem.config.optimizer.scale}: {scale_line(row)}")

    def _on_nonfinite(self, found: Findings) -> None:
        """Print the first values that are not finite. With `stop`, the error says so."""
        if not self._told_nonfinite and self.problem.config.run.on_nonfinite != "stop":
            logger.warning(f"{found}")
        self._told_nonfinite = True

    def _end(self, status: Status, failure: BaseException | None) -> Status:
        """Complete the folder, starting with the state, and return how the run ended. Raises the first error."""
        if (fault := self.folder.fault) is not None:
            failure = failure or fault
            with contextlib.suppress(Exception):
                self.calls.end(Status.FAILED.value)
            raise MachineError(describe(failure)) if isinstance(failure, OSError) else failure
        parts = [self._save_last_checkpoint, self._write_parameters, self._note_results]
        for part in parts if failure is not None else [*parts, self._write_final_images]:
            try:
                part()
            except Exception as error:
                failure = failure or error
        try:
            self.calls.end((status if failure is None else Status.FAILED).value)
        except Exception as error:
            failure = failure or error
        if failure is not None:
            status = Status.FAILED
        elif status is Status.FINISHED:  # an interrupt must not wait
            self._add("the certainty of the values was not measured", self._measure_certainty)
            self._add("perceptual errors were not measured", self._measure_seen_errors)
            if self.problem.config.fabrication is not None:
                self._add("the fabrication data of the solid were not measured", self._measure_solid)
        # Only files of the run folder are written here, and the folder was writable when the run started.
        if isinstance(failure, OSError) or (failure is not None and is_machine_fault(failure)):
            failure = MachineError(f"{describe(failure)}; {self._kept()}")
        try:
            self.manifest.end(self.folder.path, status, None if failure is None else describe(failure))
        except OSError as error:
            failure = failure or MachineError(f"{describe(error)}; {self._kept()}")
        try:
            write_report(self.folder.path)
        except Exception as error:
            if failure is None:
                logger.warning("the page was not written: %s; the rest is in %s", describe(error), self.folder.path)
            with contextlib.suppress(OSError):  # the previous page shows the run as still running
                (self.folder.path / "report.html").unlink()
        remove_parts(self.folder.path)
        if failure is not None:
            raise failure
        return status

    def _write_parameters(self) -> None:
        write_parameters(self.folder.parameters, self.course.problem.values())

    def _write_live_page(self) -> None:
        if self.course.last is None:  # there is nothing to draw yet
            write_report(self.folder.path, self.manifest.content(), {})
        else:
            content = self.manifest.content() | {"results": self._found()}
            write_report(self.folder.path, content, self.problem.values())

    def _add(self, failed: str, measure: Callable[[], None]) -> None:
        """Add the results of `measure`. An error does not fail the run. The last line reports it after the text
        `failed`.
        """
        try:
            measure()
        except Exception as error:
            self.unmeasured.append(f"{failed}: {describe(error)}")
            logger.warning(self.unmeasured[-1])
        self._note_results()

    def _measure_certainty(self) -> None:
        last = self.course.last
        config = self.problem.config
        for view in self.problem.views:  # an earlier end of this run may have written maps
            self._misfit_path(view.sensor).unlink(missing_ok=True)
        if last is None or self.done < LEAST_ITERATIONS or not config.run.certainty:
            return
        if not config.by_pixel:
            self.unmeasured.append("the certainty of the values was not measured: it needs a loss of separate pixels")
            return
        logger.info("measuring the certainty of the values")
        measured = self.course.certainty.measure(self.done, last.elapsed_s, self.problem.interrupted)
        self.certainty = measured and measured.without_derivatives(
            [record.parameter for record in incomplete_records(self.manifest.incomplete)]
        )
        if left_out := sum(self.problem.take_left_out().values()):
            logger.warning("the certainty of the values was measured without %d values that are not finite", left_out)
        for key, shown in self.course.certainty.shown.items():
            if key not in self.problem.masks:  # `_begin` has written the masks of the problem
                write_mask(self.folder.parameters, key, shown)
        for sensor, shown in self.course.certainty.misfits.items():
            write_file(self._misfit_path(sensor), shown, linear=True)

    def _misfit_path(self, sensor: int) -> Path:
        return self.folder.images / f"{self._image_name('misfit', sensor)}.exr"

    def _measure_seen_errors(self) -> None:
        self.seen = finite(seen_errors(self.folder.path, self.manifest.views))

    def _measure_solid(self) -> None:
        from reslrb_cli.runs.export import keep_solid

        view = self.problem.views[0]
        shown = load_image(self.folder.images / f"{self._image_name('final', view.sensor)}.exr")
        if shown is not None:
            logger.info("making the solid")
            problem = self.problem
            keep_solid(
                problem.config, problem.scene, problem.selection.params, view.sensor, self.folder.path, shown,
                np.array(view.target),
            )  # fmt: skip

    def _write_final_images(self) -> None:
        self._write_images("final")
        self._note_results()

    def _note_results(self) -> None:
        self.manifest.results = self._found()

    def _found(self) -> dict[str, Any]:
        """Return the results of the run so far."""
        last = self.course.last
        found = self._ended()
        if self.manifest.incomplete:
            found["incomplete"] = self.manifest.incomplete
        config = self.problem.config
        if config.fabrication is not None and not config.run.certainty:
            found["is_design"] = True
        if self.certainty is not None:
            found["certainty"] = finite(self.certainty.to_json())
        if self.unmeasured:
            found["unmeasured"] = self.unmeasured
        found["warnings"] = warnings({"iterations": self.done, **found})
        return {
            "iterations": self.done,
            "loss": last and finite(last.loss),
            "elapsed_s": last and last.elapsed_s,
            **found,
            "error_maps": self.error_maps,
            **({"seen": self.seen} if self.seen else {}),
            "nonfinite": self.course.nonfinite.to_json(),
            **({"regularized": self.course.regularized.to_json()} if self.course.regularized.iterations else {}),
        }

    def _ended(self) -> dict[str, Any]:
        """Return the results with the final values."""
        course, results = self.course, self.course.results
        results.end()
        stopped = {"stopped": course.state.stopped} if course.state.stopped else {}
        return {**results.to_json(), **stopped}

    def _kept(self) -> str:
        """Return a line about the saved state of the run."""
        if self._saved is None or newest_checkpoint(self.folder.checkpoint) is None:
            return "nothing of the run was saved"
        return f"saved: the state after {self._saved} of {self.done} iterations, in {self.folder.checkpoint}"

    def _save_last_checkpoint(self) -> None:
        """Save the state unless it is already saved. A second save would replace the earlier state in
        `previous.npz`.
        """
        if self._saved != self.done or not (self.folder.checkpoint / STATE_FILE).exists():
            self._save_checkpoint()

    def _save_checkpoint(self) -> None:
        self._saved = self.course.save(self.folder.checkpoint)

    def _write_images(self, name: str) -> None:
        spp = saved_spp(self.problem)
        if name == "final" and not self.initial:
            logger.info(f"rendering the final image: {spp} spp")
        for view in self.problem.views:
            image = self.initial.get(view.sensor)
            if image is None:
                image = self.problem.render(view.sensor, spp, self.done, "saved image")
            if not self.done:
                self.initial[view.sensor] = image
            shown = view.shown_array(image)
            self._write_image(name, view.sensor, shown)
            self.course.results.see(name, view, image)
            if name == "final":
                suffix = self._image_name("", view.sensor)
                towards = self.problem.image_gradient(view, image)
                about = write_error_map(self.folder.images, suffix, shown, np.array(view.target), towards)
                self.error_maps[f"error{suffix}"] = about

    def _write_image(self, name: str, sensor: int, image: np.ndarray[Any, Any]) -> None:
        """Write an image of a sensor. The PNG file uses the exposure that suits the sensor's target."""
        exposure = shown_exposures(self.manifest.views).get(self._image_name("", sensor), 1.0)
        write_image(self.folder.images / self._image_name(name, sensor), image, image * np.float32(exposure))
        self.calls.image(name, self._image_name("", sensor), image)

    def _image_name(self, name: str, sensor: int) -> str:
        return name if len(self.problem.views) == 1 else f"{name}-{sensor}"
