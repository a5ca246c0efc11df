"""The section `run`: length, samples, output and checkpoints of a run."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    Field,
    model_validator,
)
from typing_extensions import Self

from reslrb_cli.config.base import (
    Count,
    NamedOrCode,
    Positive,
    Section,
    Seed,
    WorkPath,
    by_kind,
    is_code,
    located,
    mark,
    wrong,
)
from reslrb_cli.config.files import NAME_BYTES
from reslrb_cli.config.views import SensorName

#: Paths: text that starts at a root or a home folder, or contains `.` or `..` as a part. Words with a slash between
#: them are no path.
_PATH = re.compile(r"^([/\\~]|[A-Za-z]:[/\\])|(^|[/\\])\.\.?($|[/\\])")


def folder_name(name: str) -> str:
    """Return the folder name for a run's name. Each sequence of characters other than letters, digits, `.`, `_`, `+`
    and `=` becomes `-`.
    """
    return re.sub(r"[^\w.+=]+", "-", name).strip("-.")


def check_name(name: str) -> str:
    """Return `name` if it is a valid name of a run; otherwise raise an error that says why."""
    folder = folder_name(name)
    if _PATH.search(name.strip()):
        raise wrong("must be a name and not a path; set run.output to choose the folder")
    if not folder:
        raise wrong("must contain a letter or a digit")
    if len(folder.encode()) > NAME_BYTES:
        raise wrong(f"must have at most {NAME_BYTES} bytes in UTF-8, not {len(folder.encode())}")
    return name


class CheckpointEvery(Section):
    """Time between two checkpoints, set by exactly one of `iterations` and `seconds`."""

    iterations: Count | None = Field(default=None, description="Iterations between two checkpoints.")
    seconds: Positive | None = Field(default=None, description="Smallest number of seconds between two checkpoints.")

    @model_validator(mode="after")
    def _check_one(self) -> Self:
        if (self.iterations is None) == (self.seconds is None):
            has = "none" if self.seconds is None else "both"
            raise located("", f"must have exactly one of `iterations` and `seconds`, and has {has}")
        return self

    def is_due(self, iterations: int, seconds: float) -> bool:
        """Return whether a checkpoint is due this many iterations and seconds after the last one."""
        return iterations >= self.iterations if self.iterations is not None else seconds > (self.seconds or 0.0)


def _without_default(schema: dict[str, Any]) -> None:
    """Remove a default value from the schema. The loader fills in the default instead."""
    del schema["default"]


#: Largest number of shards for `auto`.
AUTO_SHARDS = 16

_Shards = Annotated[
    Annotated[Count, mark("number")] | Annotated[Literal["auto"], mark("text")],
    by_kind("a number of shards, or `auto`", "auto"),
]


_Blur = Annotated[
    Annotated[float, Field(ge=0, le=1000, allow_inf_nan=False), mark("number")]
    | Annotated[Literal["auto"], mark("text")],
    by_kind("a number of pixels, or `auto`", "auto"),
]


class RunConfig(Section):
    """Length, samples and output of a run."""

    name: Annotated[str, AfterValidator(check_name)] = Field(
        default="run", min_length=1, json_schema_extra=_without_default
    )
    """Name of the run and of its folder, at most 200 bytes. It is not a path. Default: the name of the config file
    without its suffix."""
    output: WorkPath = Field(default=Path("runs"), validate_default=True)
    """Folder for run folders, relative to the working directory."""
    iterations: Count = Field(default=200, description="Total number of optimisation steps, also for a resumed run.")
    max_seconds: Positive | None = None
    """Time limit in seconds. The run ends, as finished, before the iteration that would exceed the limit if it took the
    mean time of an iteration. The first iteration is always completed. The limit includes the measurement of automatic
    settings, compiling, steps and updates, but not loading, targets and saved images. `optimizer.schedule` ends with
    the time or with the iterations, whichever comes first. null: no limit."""
    spp: Count = Field(default=16, description="Samples per pixel in each step.")
    seed: Seed = Field(default=0, description="Seed of the run. All other seeds are derived from it.")
    adjoint: Literal["auto", "correlated", "independent", "batched"] = "auto"
    """Samples from which the adjoint image dL/dI is computed. `correlated`: the samples of the gradient itself.
    `independent`: a second set of samples, which doubles the number of paths. `batched`: the batches before the one
    that is differentiated. `auto`: if `shards` splits the samples of a view, the other shards, so that each path is
    traced twice; otherwise `batched` if `batches` divides `spp`, otherwise `independent`. Gradients of `l2` and
    `relative_l2` are unbiased with all settings except `correlated`. With `correlated`, the noise that image and
    gradient share pulls parameters, mostly towards darker values; a run reports by how much if its measurement before
    the first iteration can see it. Gradients of `l1` and `ssim` are biased with all settings, because noise in the
    image does not average out of their derivatives; more samples help. A list of losses has the bias of its entries,
    and your own loss that of its formula."""
    batches: Annotated[int, Field(ge=2)] = 4
    """Number of batches that the samples of a step, or of a shard, are split into. With `adjoint: batched` it must
    divide them. Not with `correlated` and `independent`."""
    shards: _Shards = 1
    """Number of parts that the samples of an iteration are split into. Each part has its own seed, so that results do
    not depend on the process that computes it. Up to the number of views, each shard has some of the views. A multiple
    of the number of views gives each shard a part of the samples of one view; `adjoint` and `batches` then apply to
    each shard. Gradients of shards are summed in order, in double precision. `auto`: 16, or the largest number below 16
    that the settings allow; whole views if only `scene.cameras` tells their number. 1: no shards. Not used for single
    steps (`bench`, `gradcheck`, `convergence`, `inspect`, the measurement of automatic settings, `certainty`)."""
    on_nonfinite: Literal["stop", "skip", "zero"] = "skip"
    """Action if a loss, its derivative, or a gradient is not finite. `stop`: end the run (exit code 5). `skip`: leave
    the parameter, or all parameters, unchanged in this iteration. `zero`: replace such entries of a gradient or of the
    loss's derivative by 0 and continue. Values that are not finite never reach a parameter. A run without progress for
    10 iterations ends."""
    blur: _Blur = "auto"
    """Standard deviation, in pixels, of a Gaussian blur of image and target in the first iteration. The derivative of
    the loss is that of the blurred images, so that shapes and caustics also attract each other from a distance. The
    blur falls linearly to 0 at half of the run, and with `optimizer: auto` after at most 20 iterations. The recorded
    loss is that of images without blur. `auto`: a sixteenth of the shorter side of the image if the run recovers a
    `motion`, otherwise 0. 0: no blur."""
    final_spp: Count = 256
    """Samples per pixel of the initial and the final image, rounded up to whole passes of `samples_per_pass`."""
    views_per_iteration: Count | None = None
    """Number of views that an iteration renders. Each iteration draws them at random by the run's seed, and scales
    their loss so that its mean is the loss of all views. null: all views."""
    held_out: list[SensorName] = Field(default=[])
    """Sensors whose views are not used for training, by index or id. The id of a sensor in `scene.cameras` is the name
    of its image without the suffix. The loss of these views is recorded every 10 iterations (`held_out`), and for the
    first and the last image."""
    measuring: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.1
    """Time limit for measurements before the first iteration, as a fraction of the expected time of the run. They
    decide `integrator.paths` and `integrator.guiding` if these are `auto`. The limit includes the compilation of
    kernels for the measurement. First steps of camera paths, which most runs need anyway, may take longer. If there is
    no time for a measurement, `paths` is `both`, and `guiding` is `off`. The share of the derivative that is missing,
    which decides `integrator.edges`, takes at most the same fraction of the samples of the run, and as many again if
    edges are turned on. 0: measure nothing."""
    accept_incomplete: bool = False
    """Run even if more than half of the derivative of the loss is missing for a parameter that moves light. Without
    `integrator.edges`, the derivative lacks silhouettes and shadow edges. With it, some edges are still missing. A run
    measures the missing share before its first iteration, with a fraction `measuring` of its samples. By default it
    refuses to start if the share is more than half, because the steps could go the wrong way. A parameter that lacks a
    significant share gets the verdict `derivative incomplete`, and never `settled`."""
    certainty: bool = True
    """Whether to measure, after the last iteration, how certain the values are: their spread, and a verdict for each
    parameter. This takes as long as some iterations, about ten if there are few parameters. Runs of fewer than 20
    iterations and interrupted runs skip it."""
    checkpoint_every: CheckpointEvery = CheckpointEvery(seconds=30.0)
    """`iterations` or `seconds` between two checkpoints, for `reslrb optimize --resume`. A run also writes a checkpoint
    before the first iteration and at its end, unless it is killed."""

    callbacks: list[NamedOrCode] = Field(default=[])
    """Loggers and callbacks of the run ([Loggers and callbacks](python.md#loggers-and-callbacks)): `tensorboard`,
    `mlflow`, `wandb`, a name that another package offers, or `FILE.py:CLASS`, a file relative to the config file and
    a class in it, which is called without arguments. Files need `--allow-code` on the command line. `--log NAME` adds
    to the list."""

    @property
    def code_callbacks(self) -> dict[str, str]:
        """FILE.py:CLASS of the user's own callbacks, by key."""
        return {f"run.callbacks[{n}]": name for n, name in enumerate(self.callbacks) if is_code(name)}

    def idle(self) -> set[str]:
        return set() if self.adjoint in ("auto", "batched") else {"batches"}

    @property
    def folder_name(self) -> str:
        """The folder name for the run's name."""
        return folder_name(self.name)
