"""Callbacks that pass a run on to TensorBoard, MLflow or Weights & Biases.

Each needs its package: `pip install 'reslrb[tensorboard]'`, `reslrb[mlflow]` or `reslrb[wandb]`.
"""

from __future__ import annotations

import importlib
import inspect
import os
import time
from collections.abc import Callable, Sequence
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from reslrb_cli.config.base import code_file, is_code
from reslrb_cli.config.code import guarded, load_named
from reslrb_cli.config.loader import check_code
from reslrb_cli.config.parameters import HEIGHTMAP
from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ConfigError, one_line
from reslrb_cli.records.images import as_bytes, finite_range, in_range
from reslrb_cli.records.metrics import Record
from reslrb_cli.runs.callbacks import Array, Callback, RunInfo

#: Largest number of entries of a parameter whose entries are logged one by one.
FEW = 4


def package(name: str, extra: str) -> Any:
    """Return the module `name`, which the extra `extra` of this package installs. Raises ConfigError without it."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        reason = f"needs the package {name} ({error}); `pip install 'reslrb[{extra}]'` installs it"
        raise ConfigError(extra, "", reason) from None


class _Logger(Callback):
    """Common part of the loggers. `_done` is the number of finished iterations, the place of an image."""

    optional = True
    _done = 0
    _run_before: tuple[str, Path | None] | None = None

    def begin(self, run: RunInfo) -> None:
        self._done = run.done
        which = run.name, run.folder
        self._open(run, again=run.done > 0 and which == self._run_before)
        self._run_before = which

    def _open(self, run: RunInfo, again: bool) -> None:
        """Start to log. `again` is True for another loop over the run that this logger has logged before."""
        raise NotImplementedError

    def _scalars(self, values: dict[str, float], iteration: int) -> None:
        raise NotImplementedError

    def _image(self, name: str, pixels: Array, iteration: int) -> None:
        """Log an image of bytes, (H, W, C) with 1 or 3 channels."""
        raise NotImplementedError

    def iteration(self, run: RunInfo, record: Record) -> None:
        values = {"loss": record.loss, "lr": record.lr, "grad_norm": record.grad_norm, "step_ms": record.step_ms,
                  "peak_mib": record.peak_mib, "nonfinite": record.nonfinite}  # fmt: skip
        for name in ("parameter_rmse", "held_out"):
            if (value := getattr(record, name)) is not None:
                values[name] = value
        values |= {f"error/{key}": value for key, value in record.parameter_errors.items()}
        for key, shape in run.shapes.items():
            if np.prod(shape, dtype=int) <= FEW:
                entries = run.value(key).ravel().tolist()
                names = [f"value/{key}"] if len(entries) == 1 else [f"value/{key}/{n}" for n in range(len(entries))]
                values |= dict(zip(names, entries, strict=True))
        self._scalars(values, record.iteration)
        self._done = record.iteration + 1

    def image(self, run: RunInfo, name: str, image: Array, exposure: float) -> None:
        self._image(f"image/{name}", as_bytes(image * np.float32(exposure)), self._done)

    def end(self, run: RunInfo, status: str) -> None:
        for key, shape in run.shapes.items():
            if len(shape) == 3:
                value = run.value(key)
                shown = in_range(value, *finite_range([value])) if key.endswith(f".{HEIGHTMAP}") else value
                self._image(f"value/{key}", as_bytes(shown), self._done)


class TensorBoard(_Logger):
    """Callback that writes event files for TensorBoard into `folder`, by default the run folder.

    `tensorboard --logdir runs` shows them. Raises ConfigError if tensorboardX is missing, or a run without a run folder
    gives no `folder`.
    """

    def __init__(self, folder: str | os.PathLike[str] | None = None) -> None:
        self._writers = package("tensorboardX", "tensorboard")
        self._folder = folder
        self._writer: Any = None

    def _open(self, run: RunInfo, again: bool) -> None:
        place = run.folder if self._folder is None else Path(self._folder)
        if place is None:
            raise ConfigError("callbacks", "TensorBoard", "needs a folder: give the run one, or TensorBoard(FOLDER)")
        # TensorBoard hides what an earlier process wrote of the iterations that are computed again.
        self._writer = self._writers.SummaryWriter(str(place), purge_step=run.done or None)
        self._writer.add_text("settings", "\n".join(f"    {key}: {value}" for key, value in run.settings.items()))

    def _scalars(self, values: dict[str, float], iteration: int) -> None:
        event, *others = (self._writers.summary.scalar(name, value) for name, value in values.items())
        for other in others:  # one event for all: each costs its writer's thread a checksum in Python
            event.MergeFrom(other)
        self._writer.file_writer.add_summary(event, iteration)

    def _image(self, name: str, pixels: Array, iteration: int) -> None:
        self._writer.add_image(name, pixels, iteration, dataformats="HWC")

    def end(self, run: RunInfo, status: str) -> None:
        if self._writer is not None:
            super().end(run, status)
            self._writer.close()
            self._writer = None


class MLflow(_Logger):
    """Callback that logs to MLflow: to the active run, or to a new one with the name of the run.

    MLflow's own settings (`mlflow.set_experiment`, `MLFLOW_TRACKING_URI`) determine the place. Raises ConfigError if
    MLflow is missing.
    """

    def __init__(self) -> None:
        self._mlflow = package("mlflow", "mlflow")
        self._client: Any = None
        self._id, self._owns = "", False

    def _open(self, run: RunInfo, again: bool) -> None:
        self._client = self._mlflow.MlflowClient()
        active, name = self._mlflow.active_run(), run.name if run.folder is None else run.folder.name
        if again:
            self._client.update_run(self._id, status="RUNNING")
            return
        self._owns = active is None
        if self._owns:  # not left active, because other runs of the process would log to it
            with self._mlflow.start_run(run_name=name) as active:
                pass
        self._id = active.info.run_id
        if self._owns:
            self._client.update_run(self._id, status="RUNNING")
        elif run.done:
            return  # MLflow refuses to change a parameter
        # MLflow allows some characters only in names, and 6000 in values.
        for key, value in run.settings.items():
            self._client.log_param(self._id, _plain(key), str(value)[:6000])

    def _scalars(self, values: dict[str, float], iteration: int) -> None:
        Metric, now = self._mlflow.entities.Metric, int(1000 * time.time())
        metrics = [Metric(_plain(name), value, now, iteration) for name, value in values.items()]
        self._client.log_batch(self._id, metrics)

    def _image(self, name: str, pixels: Array, iteration: int) -> None:
        self._client.log_image(self._id, pixels, f"{_plain(name)}.png")

    def end(self, run: RunInfo, status: str) -> None:
        if self._client is None:
            return
        super().end(run, status)
        if self._owns:
            ended = {"finished": "FINISHED", "interrupted": "KILLED"}.get(status, "FAILED")
            self._client.set_terminated(self._id, ended)
        self._client = None


class WandB(_Logger):
    """Callback that logs to Weights & Biases: to the active run, or to a new one in the project `reslrb`.

    W&B's own settings apply: `WANDB_PROJECT` and others, and `WANDB_MODE=offline` for a run without the network. Its
    files are in the run folder. Raises ConfigError if wandb is missing.
    """

    def __init__(self) -> None:
        self._wandb = package("wandb", "wandb")
        self._owns, self._id = False, ""
        self._run: Any = None

    def _open(self, run: RunInfo, again: bool) -> None:
        self._owns = self._wandb.run is None
        if not self._owns:
            self._run = self._wandb.run
            return
        place = {} if run.folder is None else {"dir": str(run.folder)}
        earlier = {"id": self._id, "resume": "allow"} if again and self._id else {}
        # `create_new` does not become the active run, to which other runs of the process would log.
        self._run = self._wandb.init(
            project=os.environ.get("WANDB_PROJECT", "reslrb"), name=run.name, config=dict(run.settings),
            reinit="create_new", **place, **earlier,
        )  # fmt: skip
        self._id = self._run.id

    def _scalars(self, values: dict[str, float], iteration: int) -> None:
        self._run.log(values, step=iteration)

    def _image(self, name: str, pixels: Array, iteration: int) -> None:
        shown = pixels[:, :, 0] if pixels.shape[2] == 1 else pixels
        self._run.log({name: self._wandb.Image(shown)}, step=iteration)

    def end(self, run: RunInfo, status: str) -> None:
        if self._run is None:
            return
        super().end(run, status)
        if self._owns:
            self._run.finish(0 if status == "finished" else 1)
        self._run = None


#: Loggers by their name in `--log` and `callbacks`.
LOGGERS: dict[str, Callable[[], Callback]] = {"tensorboard": TensorBoard, "mlflow": MLflow, "wandb": WandB}


#: Group of entry points of other packages: the name for `--log`, and a class of callbacks.
GROUP = "reslrb.callbacks"
#: Callbacks, or names of `LOGGERS` and of entry points.
Callbacks: TypeAlias = "Sequence[Callback | str]"


def callbacks_of(config: Config, more: Callbacks, source: str) -> list[Callback]:
    """Return the callbacks of `run.callbacks`, then those that `more` adds. A variant must be set.

    A repeated name counts once. Raises ConfigError, located in the configuration, or in `source` for `more`.
    """
    if isinstance(more, str) or not isinstance(more, Sequence):
        raise ConfigError(source, "", f"is {one_line(repr(more), 60)}, not a list of callbacks")
    check_code(config, config.run.code_callbacks)
    places = [(each, config.source, f"run.callbacks[{n}]") for n, each in enumerate(config.run.callbacks)]
    found = []
    more = [each for n, each in enumerate(more) if not isinstance(each, str) or more.index(each) == n]
    for each, where, key in [*places, *((each, source, "") for each in more if each not in config.run.callbacks)]:
        one = _named(each, where, key) if isinstance(each, str) else each
        if not isinstance(one, Callback):
            instead = "; call it" if inspect.isclass(one) and issubclass(one, Callback) else ""
            raise ConfigError(where, key, f"has {one_line(repr(one), 60)}, which is no reslrb_cli.Callback{instead}")
        found.append(one)
    return found


def _named(name: str, source: object, key: str) -> Any:
    if is_code(name):
        if not key:
            raise ConfigError(source, "", f"a file is named by the setting `run.callbacks: [{name}]`")
        file = code_file(name)
        kind = load_named(file, name.rpartition(":")[2], source, key)
        with guarded(source, key, file, "the callback"):
            return kind()
    others = {point.name: point for point in entry_points(group=GROUP)}
    if name not in LOGGERS and name not in others:
        raise ConfigError(source, key, f"there is no `{name}`; there are {', '.join(sorted({*LOGGERS, *others}))}")
    with guarded(source, key or name, None, "the callback"):
        return LOGGERS[name]() if name in LOGGERS else others[name].load()()


def _plain(name: str) -> str:
    return "".join(c if c.isalnum() or c in "_-./ " else "_" for c in name)
