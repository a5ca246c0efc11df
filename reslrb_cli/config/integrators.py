"""The integrators, each with the options that it knows.

How the samples of a step are split into passes, and what is too many of them, is known before a scene is loaded.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    Discriminator,
    Field,
    SerializerFunctionWrapHandler,
    model_serializer,
    model_validator,
)
from typing_extensions import Self

from reslrb_cli.config.base import (
    MARK,
    NEEDS_TYPE,
    ByType,
    Choice,
    CodePlace,
    Count,
    code_file,
    located,
    mark,
    must,
)  # fmt: skip
from reslrb_cli.config.files import CAPACITY, LOCAL_ENTRIES, PASS_PATHS, PASS_SAMPLES, PASSES, PATH_LENGTH

_DEPTH = must(
    lambda depth: depth <= PATH_LENGTH,
    lambda depth: (
        f"must be at most {PATH_LENGTH} segments, or -1 for no limit, not {depth}: Russian roulette ends a path "
        "long before, so that this limits nothing"
    ),
)

_RECORD = must(
    lambda depth: depth < LOCAL_ENTRIES,
    lambda depth: (
        f"must be less than {LOCAL_ENTRIES}, not {depth}: the record of a path has room for as many vertices, "
        "and thread-local memory has no more places; reslrb needs no such record"
    ),
)

_CAPACITY = must(
    lambda capacity: capacity <= CAPACITY,
    lambda capacity: (
        f"must be at most {CAPACITY}, not {capacity}: each connection that is kept is code of its own in the "
        "kernel, which would take hours to compile; estimator gather keeps all of them"
    ),
)

_DIRECT = must(
    lambda depth: depth == 2,
    lambda depth: f"must be 2, not {depth}: direct_projective has direct light alone; prb_projective has longer paths",
)

#: Samples per pixel of one part of a derivative.
Samples = Annotated[int, Field(ge=0, le=PASS_SAMPLES)]


class Integrator(Choice):
    """Options that all integrators share."""

    type: str
    max_depth: Annotated[int, _DEPTH] = Field(default=8, ge=-1, json_schema_extra={"maximum": PATH_LENGTH})
    """Longest path in segments, from the emitter to the sensor: 1 shows only directly visible emitters, 2 adds direct
    light; -1: no limit (Russian roulette alone ends a path)."""
    rr_depth: Count = Field(default=5, description="Path depth at which Russian roulette begins.")
    hide_emitters: bool = False
    """Whether directly visible emitters are left out of the image."""


class LightTracerOptions(Integrator):
    """Options of integrators that trace from the emitters; `prb` traces all samples in one pass."""

    samples_per_pass: Count | None = None
    """Samples per pixel that one pass traces, to bound its memory; it must divide the samples per pixel. null: all in
    one pass."""


class AttachingTracer(LightTracerOptions):
    """Options of light tracers that have derivatives of what moves light."""

    attached: Annotated[
        Annotated[bool, mark("flag")] | Annotated[Literal["auto"], mark("text")],
        Discriminator(lambda value: MARK + ("flag" if isinstance(value, bool) else "text")),
    ] = "auto"
    """Whether derivatives follow light where it goes: of rays, hit points and film positions, beside those of what
    light carries. `auto`: where a parameter moves anything that light leaves from or meets; true: for roughness and
    index of refraction too, whose derivatives are detached otherwise."""
    filter_normalization: Literal["attached", "detached"] = "attached"
    """Whether the sum of the reconstruction filter's weights has its derivative too, where light moves over the film:
    `attached` is what finite differences find, `detached` what `ptracer` computes."""


#: The options of `reslrb` that belong to an estimator, by its name; the others have no use for them.
ESTIMATOR_OPTIONS: dict[str, tuple[str, ...]] = {
    "auto": (),
    "reservoir": ("capacity", "weight", "jacobian_damping"),
    "gather": (),
    "event": ("capacity", "weight"),
    "stack": ("stack_size",),
}

#: The settings that may be `auto` beside any estimator, and their values before a run decides them
#: (`optimization/autotune/sampling.py`).
UNDECIDED: dict[str, str] = {
    "paths": "light",
    "guiding": "off",
    "sequence": "independent",
    "pixels": "even",
}

#: The estimator of `auto`: the only one with derivatives of camera paths and of both `follow` and `stay`.
AUTO_ESTIMATOR = "stack"

#: Every option that says which estimator, and how.
_ANY_ESTIMATORS = {"estimator", *(option for options in ESTIMATOR_OPTIONS.values() for option in options)}


class Reslrb(AttachingTracer):
    """Reservoir light replay backpropagation: light tracing whose memory does not depend on path length."""

    type: Literal["reslrb"] = "reslrb"
    """Light tracing, derivatives by a replay of each path."""
    estimator: Literal["auto", "reservoir", "gather", "event", "stack"] = "auto"
    """How a path's connections enter its gradient. `reservoir`: few of them, kept at random; `gather`: all, by a second
    traversal; `event`: few scattering events, kept at random; `stack`: all, kept in thread-local memory; `auto`:
    `stack`, which was the most efficient in every experiment that was measured."""
    capacity: Annotated[Count, _CAPACITY] = Field(default=1, json_schema_extra={"maximum": CAPACITY})
    """How many connections, or events, are kept of each path. Only with estimators `reservoir` and `event`."""
    weight: Literal["luminance", "adjoint"] = "luminance"
    """What a connection is kept in proportion to: its `luminance`, or its share in the objective (`adjoint`: less
    variance; not with `run.adjoint: correlated`). Only with estimators `reservoir` and `event`."""
    jacobian_damping: Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)] = 0.1
    """Where light is followed: by how much the ray behind a surface that is not specular is taken to turn with the one
    before it, to either side at random, so that its Jacobian has an inverse. It makes no bias; below 0.01 digits are
    lost, above 0.5 noise grows. Only with estimator `reservoir`."""
    attached_sampling: Literal["auto", "follow", "stay"] = "auto"
    """Where light is followed: what becomes of it behind a surface that is not specular. `follow`: its direction turns
    with the surface, as `ptracer` has it, and sweeps over edges at rest, whose part is then missing; `stay`: it goes on
    to the same place; `auto`: `stay` behind diffuse surfaces, `follow` behind glossy ones, where `stay` is noisy."""
    stack_size: Count = 64
    """Vertices of a path that fit into thread-local memory; longer paths are traced a second time. Only with estimator
    `stack`."""
    paths: Literal["auto", "light", "camera", "both"] = "auto"
    """Where paths begin. `light`: at the emitters, which finds caustics and light through glass, but shows mirrors and
    clear glass black; `camera`: at the sensor, which finds what mirrors and glass show, and most light of rooms, but no
    caustics of small lamps (with estimators `auto` and `stack`); `both`: each path is weighed by how likely either
    side was to find it, so that the image has all light. `auto`: `both`, or `camera` where that finds all light and a
    few steps of each, before the first iteration, show that it is the more efficient; `light` where nothing else can
    render the scene, or finds any of its light, or where guided light paths are the most efficient. What moves light
    has light paths alone. Left out it is `auto` with estimator `auto`, and `light` with one that is named."""
    light_share: Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)] = 0.5
    """Which share of the samples are light paths where `paths` are `both`; with 0 or 1 nothing of the other side is
    compiled."""
    guiding: Literal["auto", "on", "off"] = "auto"
    """Whether light paths start where those of earlier steps had something to say about gradient and image, at least a
    quarter of them anywhere, and end where those had little left to say; in scenes with glossy surfaces they are also
    sent to what the sensor sees. `on`: less noise where few paths say anything (a room lit through windows, a caustic),
    from the second step on; a few of the first, and one in sixteen later, trace as many paths again to learn where that
    is. `auto`: where a few steps with and without it, before the first iteration, show that it pays here. Left out it
    is `auto` with estimator `auto`, and `off` with one that is named."""
    sequence: Literal["auto", "independent", "low_discrepancy"] = "auto"
    """The random numbers that say where light paths start and how they first scatter. `low_discrepancy`: evenly spread
    over all paths of a step, and independent from one step to the next; less noise where little but these numbers says
    where light goes (a beam through glass), a little less elsewhere. `auto`: `low_discrepancy`, or `independent` where
    paths are guided. Left out it is `auto` with estimator `auto`, and `independent` with one that is named."""
    pixels: Literal["auto", "even", "measured"] = "auto"
    """Number of camera paths in each pixel. `even`: the same in all pixels. `measured`: a quarter is spread evenly. The
    other paths go to the pixels whose noise weighs most in the gradient, by the curvature of the loss, 0 in pixels that
    are left out. A few paths through each pixel measure this before the first iteration, at the parameters' initial
    values. A texture that only a mirror shows gains most; a few colours may lose. `auto`: `measured` where
    there are camera paths, the loss is `l2`, and the measurement takes at most 2 % of the run's samples. The default is
    `auto` with estimator `auto`, and `even` with an estimator that you name."""
    freeze: bool = True
    """Record what a step launches and launch that again, so that its Python runs once, not in every iteration. Not with
    passes, nor with more than 4 million paths, beside which Python does not show."""

    @model_validator(mode="after")
    def _leave_off(self) -> Self:
        """Whoever names an estimator, and nothing else, has nothing measured."""
        if self.estimator != "auto":  # not by assignment, which would count them among those that were given
            self.__dict__.update({name: off for name, off in UNDECIDED.items() if name not in self.model_fields_set})
        return self

    @model_validator(mode="after")
    def _check_options(self) -> Self:
        if self.estimator == "stack" and self.max_depth == -1 and self.stack_size >= LOCAL_ENTRIES:
            raise located(
                "stack_size",
                f"{self.stack_size} vertices need as many places of thread-local memory, which has no more than "
                f"{LOCAL_ENTRIES}; leave it at 64: longer paths are traced a second time, and nothing of them is lost",
            )
        if self.paths == "camera" and self.estimator not in ("auto", "stack"):
            raise located(
                "estimator",
                f"`{self.estimator}` chooses among the connections of light paths, of which paths: camera has none; "
                "leave it out, or take stack",
            )
        _check_share(self.paths, self.light_share)
        for option in sorted(self._foreign() & self.model_fields_set):
            owners = " or ".join(f"`{name}`" for name, options in ESTIMATOR_OPTIONS.items() if option in options)
            raise located(option, f"has no effect with estimator `{self.estimator}`, but with {owners}; remove it")
        return self

    @model_serializer(mode="wrap")
    def _without_foreign(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        values: dict[str, Any] = handler(self)
        return {name: value for name, value in values.items() if name not in self._foreign()}

    def undecided_off(self) -> Reslrb:
        """Return these options with estimator `stack` for `auto`, and with all that a run measures turned off."""
        undecided = {name: off for name, off in UNDECIDED.items() if getattr(self, name) == "auto"}
        if self.estimator == "auto":
            undecided["estimator"] = AUTO_ESTIMATOR
        return self.model_copy(update=undecided) if undecided else self

    def _foreign(self) -> set[str]:
        """The options of the other estimators."""
        return _ANY_ESTIMATORS - {"estimator", *ESTIMATOR_OPTIONS[self.estimator]}


class Ptracer(LightTracerOptions, json_schema_extra=NEEDS_TYPE):
    """Mitsuba's own light tracer under naive reverse-mode differentiation: memory grows with depth."""

    type: Literal["ptracer"] = Field(default="ptracer", description="Mitsuba's light tracer, naively differentiated.")


class Prb(Integrator, json_schema_extra=NEEDS_TYPE):
    """Mitsuba's path replay backpropagation: paths from the sensor; it cannot see caustics of small lights."""

    type: Literal["prb"] = Field(default="prb", description="Mitsuba's path replay backpropagation, from the sensor.")


class ProjectiveOptions(Integrator):
    """Options of Mitsuba's projective integrators. They trace from the sensor and differentiate outlines and shadow
    edges of shapes that move. A derivative has three parts, each with its own samples."""

    sppc: Samples | None = None
    """Samples per pixel of what changes smoothly. 0 leaves that part out. null: those of the step."""
    sppp: Samples | None = None
    """Samples per pixel of outlines that the sensor sees. 0 leaves them out. null: those of the step."""
    sppi: Samples | None = None
    """Samples per pixel of shadow edges and of all else behind the first surface. 0 leaves them out. null: those of the
    step."""


class PrbProjective(ProjectiveOptions, json_schema_extra=NEEDS_TYPE):
    """Mitsuba's path replay backpropagation with the derivatives of outlines and shadow edges."""

    type: Literal["prb_projective"] = "prb_projective"
    """Mitsuba's projective path replay, from the sensor."""


class DirectProjective(ProjectiveOptions, json_schema_extra=NEEDS_TYPE):
    """Mitsuba's integrator of direct light with the derivatives of outlines and shadow edges."""

    type: Literal["direct_projective"] = "direct_projective"
    """Mitsuba's projective integrator of direct light, from the sensor."""
    max_depth: Annotated[int, _DIRECT] = Field(default=2, json_schema_extra={"const": 2})
    """Longest path in segments: direct light has two."""


class WalkAd(AttachingTracer, json_schema_extra=NEEDS_TYPE):
    """The light-path walk of `reslrb` under naive reverse-mode differentiation, for comparisons at equal seeds."""

    type: Literal["walk_ad"] = Field(default="walk_ad", description="The walk of `reslrb`, naively differentiated.")
    paths: Literal["light", "camera", "both"] = "light"
    """Where paths begin, as with `reslrb`."""
    light_share: Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)] = 0.5
    """Which share of the samples are light paths where `paths` are `both`."""

    @model_validator(mode="after")
    def _check_options(self) -> Self:
        _check_share(self.paths, self.light_share)
        return self


class Trajectory(LightTracerOptions, json_schema_extra=NEEDS_TYPE):
    """The same walk, reversed by Dr.Jit itself: it records each path's loop state in thread-local memory."""

    type: Literal["trajectory"] = Field(default="trajectory", description="The walk of `reslrb`, reversed by Dr.Jit.")
    max_depth: Annotated[int, _RECORD] = Field(default=8, ge=0, json_schema_extra={"exclusiveMaximum": LOCAL_ENTRIES})
    """Longest path in segments, as above; the record has room for as many vertices, so that there must be a limit."""


class Own(Integrator, json_schema_extra=NEEDS_TYPE):
    """A Mitsuba integrator of one's own, a class in a file of Python code; only where the command line has
    `--allow-code` ([your_integrator.md](your_integrator.md))."""

    type: Literal["custom"] = Field(default="custom", description="A Mitsuba integrator of one's own.")
    file: CodePlace
    """`FILE.py:CLASS`: a file of Python code, relative to the config file, and the class in it, which is made of a
    `mi.Properties` with `max_depth`, `rr_depth`, `hide_emitters` and `arguments`. A run keeps a digest of the file's
    bytes, not of what it imports, and goes on with no other."""
    paths: Literal["camera", "light"] = "camera"
    """Where its paths begin: what it can see, and whether its images are darker along the film's border, as those of
    light paths are."""
    arguments: dict[str, bool | int | float | str] = Field(default_factory=dict)
    """What else it is made of."""

    @property
    def path(self) -> Path:
        """The file of code."""
        return code_file(self.file)


AnyIntegrator = Annotated[
    Reslrb | Ptracer | Prb | PrbProjective | DirectProjective | WalkAd | Trajectory | Own, ByType("reslrb")
]


def _check_share(paths: str, light_share: float) -> None:
    if light_share != 0.5 and paths in ("light", "camera"):
        raise located("light_share", f"has no effect with paths: {paths}, but with both; remove it")


def passes_obstacle(spp: int, per_pass: int | None, pixels: int, splits: bool = True) -> str | None:
    """Why `spp` samples per pixel of a film of so many `pixels` cannot be traced, and what would be right; or None.

    `per_pass` is the integrator's `samples_per_pass`; it divides `spp`, or is larger. An integrator that does not
    split its samples by itself (`splits`) has none.
    """
    unit = min(per_pass or spp, spp)
    parts = -(-unit // PASS_SAMPLES) if splits else 1
    paths = -(-unit // parts) * pixels
    most = largest_pass(spp, pixels)
    if paths > PASS_PATHS:
        advice = f"set integrator.samples_per_pass to {most}, or lower run.spp" if splits and most else "lower run.spp"
        advice = advice if PASS_PATHS >= pixels else "take a smaller film"
        return f"makes {paths} light paths in one pass, and no pass has more than {PASS_PATHS}: {advice}"
    if spp // unit * parts > PASSES:
        advice = f"set integrator.samples_per_pass to {most}" if most and spp // most <= PASSES else "lower run.spp"
        return f"makes {spp // unit * parts} passes of a step, and no step has more than {PASSES}: {advice}"
    return None


def largest_pass(spp: int, pixels: int) -> int | None:
    """The largest `samples_per_pass` that divides `spp` and makes no more paths than a pass can have; None without."""
    most = min(PASS_PATHS // pixels, PASS_SAMPLES, spp)
    return max((n for n in divisors(spp) if n <= most), default=None)


def divisors(number: int) -> list[int]:
    """All divisors of a number, the smallest first; of one of 31 bits at once."""
    small = [n for n in range(1, int(number**0.5) + 1) if number % n == 0]
    return sorted({*small, *(number // n for n in small)})
