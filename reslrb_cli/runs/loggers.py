"""Callbacks that pass a run on to TensorBoard, MLflow or Weights & Biases.

Each needs its package: `pip install 'reslrb[tensorboard]'`, `reslrb[mlflow]` or `reslrb[wandb]`.
"""

from __future__ import annotations

import importlib
import inspect
import os
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

    _done = 0

    def begin(self, run: RunInfo) -> None:
        self._done = run.done
        self._open(run)

    def _open(self, run: RunInfo) -> None:
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

    def _open(self, run: RunInfo) -> None:
        place = run.folder if self._folder is None else Path(self._folder)
        if place is None:
            raise ConfigError("callbacks", "TensorBoard", "needs a folder: give the run one, or TensorBoard(FOLDER)")
        self._writer = self._writers.SummaryWriter(str(place))
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
        self._owns = self._runs = False

    def _open(self, run: RunInfo) -> None:
        self._owns = self._mlflow.active_run() is None
        if self._owns:
            self._mlflow.start_run(run_name=run.name if run.folder is None else run.folder.name)
        self._runs = True
        if run.done and not self._owns:
            return  # MLflow refuses to change a parameter
        # MLflow allows some characters only in names, and 6000 in values.
        self._mlflow.log_params({_plain(key): str(value)[:6000] for key, value in run.settings.items()})

    def _scalars(self, values: dict[str, float], iteration: int) -> None:
        self._mlflow.log_metrics({_plain(name): value for name, value in values.items()}, step=iteration)

    def _image(self, name: str, pixels: Array, iteration: int) -> None:
        self._mlflow.log_image(pixels, f"{_plain(name)}.png")

    def end(self, run: RunInfo, status: str) -> None:
        if not self._runs:
            return
        super().end(run, status)
        self._runs = False
        if self._owns:
            self._mlflow.end_run({"finished": "FINISHED", "interrupted": "KILLED"}.get(status, "FAILED"))


class WandB(_Logger):
    """Callback that logs to Weights & Biases: to the active run, or to a new one in the project `reslrb`.

    W&B's own settings apply: `WANDB_PROJECT` and others, and `WANDB_MODE=offline` for a run without the network. Its
    files are in the run folder. Raises ConfigError if wandb is missing.
    """

    def __init__(self) -> None:
        self._wandb = package("wandb", "wandb")
        self._owns = False
        self._run: Any = None

    def _open(self, run: RunInfo) -> None:
        self._owns = self._wandb.run is None
        if self._owns:
            place = {} if run.folder is None else {"dir": str(run.folder)}
            project = os.environ.get("WANDB_PROJECT", "reslrb")
            self._wandb.init(project=project, name=run.name, config=dict(run.settings), **place)
        self._run = self._wandb.run

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

    A name in both counts once. Raises ConfigError, located in the configuration, or in `source` for `more`.
    """
    if isinstance(more, str) or not isinstance(more, Sequence):
        raise ConfigError(source, "", f"is {one_line(repr(more), 60)}, not a list of callbacks")
    check_code(config, config.run.code_callbacks)
    places = [(each, config.source, f"run.callbacks[{n}]") for n, each in enumerate(config.run.callbacks)]
    found = []
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
