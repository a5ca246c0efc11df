"""How long a run is, with how many samples, in which parts, where to, and what it keeps (`run`)."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    SerializerFunctionWrapHandler,
    WithJsonSchema,
    model_serializer,
    model_validator,
)
from typing_extensions import Self

from reslrb_cli.config.base import Count, Positive, Section, Seed, WorkPath, by_kind, located, mark, wrong
from reslrb_cli.config.files import NAME_BYTES
from reslrb_cli.config.optimizers import Stage, Standing
from reslrb_cli.config.views import SensorName

#: Names that Windows takes for devices, whatever suffix they have: a folder that is called so cannot be copied there.
_RESERVED = re.compile(r"(con|prn|aux|nul|(com|lpt)[0-9])(\..*)?", re.IGNORECASE)

#: What begins at a root or at a home, or has `.` or `..` for a part. A slash between words is none of that.
_PATH = re.compile(r"^([/\\~]|[A-Za-z]:[/\\])|(^|[/\\])\.\.?($|[/\\])")


def folder_name(name: str) -> str:
    """A run's name as the name of a folder: what is no letter, digit, `.`, `_`, `+`, `=` becomes `-`."""
    return re.sub(r"[^\w.+=]+", "-", name).strip("-.")


def check_name(name: str) -> str:
    """`name`, where it can name a run; else raises an error that says what is wrong with it."""
    folder = folder_name(name)
    if _PATH.search(name.strip()):
        raise wrong("must be a name and not a path; run.output says where the run's folder is")
    if not folder:
        raise wrong("must hold a letter or a digit")
    if _RESERVED.fullmatch(folder):
        raise wrong(f"must be another name: {folder} is a device on Windows, and not a folder's name there")
    if len(folder.encode()) > NAME_BYTES:
        raise wrong(f"must have at most {NAME_BYTES} bytes in UTF-8, not {len(folder.encode())}")
    return name


MIB = 2**20
_UNITS = {"b": 1, "kb": 10**3, "mb": 10**6, "gb": 10**9, "kib": 2**10, "mib": MIB, "gib": 2**30}
_SIZE = re.compile(r"(\d+(?:\.\d*)?|\.\d+)\s*([A-Za-z]+)")


def memory_bytes(value: int | float | str) -> int:
    """Bytes of a number of MiB, or of text such as "512 MiB", "2GiB", "500 MB".

    Raises ValueError where it is neither, or less than one byte.
    """
    number, unit = float("nan"), "mib"
    if isinstance(value, str):
        match = _SIZE.fullmatch(value.strip())
        if match:
            number, unit = float(match[1]), match[2].lower()
    elif not isinstance(value, bool):
        number = float(value) if abs(value) < 2**63 else float("inf")  # longer integers fit into no float
    if unit not in _UNITS or not 1 <= number * _UNITS[unit] < 2**63:
        raise ValueError(f"{value!r} is no amount of memory")
    return int(number * _UNITS[unit])


def _check_memory(value: Any) -> Any:
    try:
        memory_bytes(value)
    except (TypeError, ValueError):
        raise wrong("must be a number of MiB, or text such as 512 MiB or 2GiB, and more than 0") from None
    return value


#: A number of MiB, or text with a unit (B, kB, KiB, MB, MiB, GB, GiB); kept as it was written.
Memory = Annotated[
    int | float | str,
    BeforeValidator(_check_memory),
    WithJsonSchema({"anyOf": [{"type": "number", "exclusiveMinimum": 0}, {"type": "string"}]}),
]


class CheckpointEvery(Section):
    """Exactly one of `iterations` and `seconds`."""

    iterations: Count | None = Field(default=None, description="Iterations between two checkpoints.")
    seconds: Positive | None = Field(default=None, description="Seconds between two checkpoints, at least.")

    @model_validator(mode="after")
    def _check_one(self) -> Self:
        if (self.iterations is None) == (self.seconds is None):
            has = "none" if self.seconds is None else "both"
            raise located("", f"must have exactly one of `iterations` and `seconds`, and has {has}")
        return self

    @model_serializer(mode="wrap")
    def _without_unused(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return {key: value for key, value in handler(self).items() if value is not None}

    def is_due(self, iterations: int, seconds: float) -> bool:
        """Whether it is time for one, so many iterations and seconds after the last."""
        return iterations >= self.iterations if self.iterations is not None else seconds > (self.seconds or 0.0)


def _without_default(schema: dict[str, Any]) -> None:
    """For a default that the loader fills in, from what the schema does not know."""
    del schema["default"]


#: Shards of `auto`, at most.
AUTO_SHARDS = 16

_Shards = Annotated[
    Annotated[Count, mark("number")] | Annotated[Literal["auto"], mark("text")],
    by_kind("a number of shards, or `auto`", "auto"),
]


class RunConfig(Section):
    """How long, with how many samples, and where to."""

    name: Annotated[str, AfterValidator(check_name)] = Field(
        default="run", min_length=1, json_schema_extra=_without_default
    )
    """Name of the run and of its folder, not a path, of at most 200 bytes; left out: the config file's name without its
    suffix."""
    output: WorkPath = Field(default=Path("runs"), validate_default=True)
    """Folder of the run folders, relative to the working directory."""
    iterations: Count = Field(default=200, description="Optimisation steps.")
    spp: Count = Field(default=16, description="Samples per pixel and step.")
    seed: Seed = Field(default=0, description="Seed of the run; every other seed is made from it.")
    adjoint: Literal["auto", "correlated", "independent", "batched", "others"] = "auto"
    """Samples that the adjoint image dL/dI comes from: the batches before the one that is differentiated (`batched`), a
    second set (`independent`, twice the paths), those of the gradient (`correlated`), or, where the samples of a view
    are in `shards`, the other shards (`others`, each path traced twice; as `auto` where shards are whole views).
    Gradients of `l2` and `relative_l2` are unbiased with all but `correlated`, with which the noise that both share
    pulls parameters, mostly towards darker: a run says by how much, where a measurement before its first iteration can
    see it. `l1`, `log_l2`, `smape` and `ssim` are biased with any of them, since noise in the image does not average
    out of their derivatives; more samples help. A list of losses is as its entries are, and one of one's own as its
    formula is. `auto`: `others` where it can be; else `batched` where `batches` divides `spp`, else `independent`."""
    batches: Annotated[int, Field(ge=2)] = 4
    """Batches of a step's samples, or of a shard's; with `adjoint: batched` it must divide them. Not with `correlated`
    and `independent`."""
    first_batch: Literal["image", "again"] = "image"
    """What the first batch is for: an `image` alone, or to be traced `again` for its gradient, with the adjoint image
    of all others. Not with `correlated` and `independent`."""
    shards: _Shards = 1
    """Parts that the samples of an iteration are split into, each with a seed of its own, whatever computes them: at
    most as many as it has views, each is some of these; a multiple of that, each is a share of one view's samples
    (`adjoint` and `batches` are then of a shard). Their gradients are added up in their order, in double precision.
    `auto`: 16, or the most below that which these settings allow; where `scene.sensors` is `all`, whole views. 1: none.
    Not in what measures single steps (`bench`, `gradcheck`, `convergence`, `inspect`, what is `auto`, `certainty`)."""
    memory_budget: Memory | None = None
    """Memory that the iterations may take, with what stands before them: a number of MiB, or text such as 512 MiB or
    2GiB. The samples of a step are split into passes that fit. It covers what the backend's allocator gives out (the
    scene's textures and buffers, targets, images of a step, parameters and what the optimiser keeps of them, what is
    kept of paths; `peak_mib` in `metrics.jsonl` is that) and thread-local memory; not Python, libraries, the code of
    kernels, the structure that rays are traced in, nor what targets and saved images take while they are rendered.
    null: no limit but what is free. Only with integrator `reslrb`."""
    on_nonfinite: Literal["stop", "skip", "zero"] = "skip"
    """What to do where a loss, its derivative, or a gradient is not finite. `stop`: end the run (exit code 5); `skip`:
    leave the parameter as it is in this iteration, or all of them; `zero`: take such entries of a gradient or of the
    loss's derivative for 0, and go on. No such value ever reaches a parameter; a run that comes to a standstill for 10
    iterations ends."""
    images_every: Annotated[int, Field(ge=0)] = 0
    """Iterations between two saved images; 0: only the initial and the final one."""
    final_spp: Count = 256
    """Samples per pixel of the saved initial and final image, rounded up to whole passes of `samples_per_pass`."""
    views_per_iteration: Count | None = None
    """Views that an iteration renders, drawn anew each time by the run's seed; their loss is scaled so that its mean is
    that of all. null: all of them."""
    held_out: list[SensorName] = Field(default=[])
    """Sensors whose views are not trained on, by index or id, which for those of `scene.cameras` is the image's name
    without its suffix; their loss is recorded every 10 iterations (`held_out`), and of the first and the last image."""
    measuring: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.1
    """The time for measurements before the first iteration, as a share of the time that the run itself is expected to
    take. They decide `integrator.paths` and `integrator.guiding` where these are `auto`. The time includes kernels that
    are compiled for them; first steps of camera paths, which most runs need anyway, may take more. Without time for a
    measurement `paths` are `both`, and `guiding` is `off`. 0: nothing is measured."""
    accept_incomplete: bool = False
    """Run although more than half of the loss's derivative is missing for a parameter that moves light. The derivative
    lacks silhouettes and edges of shadows. A run measures their share before its first iteration, for `measuring` of
    its samples, and refuses to begin if they are more than half of it; the steps could lead the other way. A parameter
    that lacks a significant share gets the verdict `derivative incomplete`, and never `settled`."""
    certainty: bool = True
    """After the last iteration, measure how certain the values are: their spread, and a verdict on each parameter.
    Takes as long as some iterations, ten or so where parameters are few; runs of fewer than 20 iterations, and
    interrupted ones, go without."""
    checkpoint_every: CheckpointEvery = CheckpointEvery(seconds=30.0)
    """When the state of the run is kept, for `reslrb optimize --resume`: `iterations` or `seconds` between two
    checkpoints. Besides, before the first iteration and at the end, whatever ends it but a kill."""
    reach_spp: Count = Field(default=64, description="Samples for the mask of the texels that light and sensor reach.")
    stages: list[Stage] = Field(default=[], max_length=16)
    """How the run begins, in parts, from coarse to fine: resolution, film, samples, rates and weights until a share of
    the iterations is done. After the last of them it is as configured. Where resolution or film change, the optimizer
    begins anew, and so does what `optimizer.scale` measures."""

    stop: Standing | None = None
    """End the run before its last iteration, as finished, once its loss stands: that of held-out views where there are
    any, else that of the iterations; with `schedule: plateau` not before the rate is at its least. At most 5 % of runs
    are stopped whose loss still falls by more than `relative` a window. With the defaults, a run goes on for about 300
    iterations after its loss stands where losses have 10 % noise, and for 500 at 30 %
    ([method.md](method.md#when-a-loss-stands)). `{}`: the defaults. null: never."""

    @model_serializer(mode="wrap")
    def _without_unused(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        values: dict[str, Any] = handler(self)
        if not self.stages:
            del values["stages"]
        if self.stop is None:
            values.pop("stop", None)
        if self.adjoint not in ("auto", "batched", "others"):
            del values["batches"], values["first_batch"]
        return values

    @property
    def budget_bytes(self) -> int | None:
        """`memory_budget` in bytes."""
        return None if self.memory_budget is None else memory_bytes(self.memory_budget)

    @property
    def folder_name(self) -> str:
        """The run's name as the name of a folder: what is no letter, digit, `.`, `_`, `+`, `=` becomes `-`."""
        return folder_name(self.name)
