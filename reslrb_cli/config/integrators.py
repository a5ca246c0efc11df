"""The integrators and their options.

The limits on samples, passes and paths are checked here, before a scene is loaded.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, get_args

from pydantic import (
    Discriminator,
    Field,
    PlainSerializer,
    ValidationInfo,
    ValidatorFunctionWrapHandler,
    WithJsonSchema,
    WrapValidator,
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
    code_place,
    is_code,
    located,
    mark,
)  # fmt: skip
from reslrb_cli.config.files import CAPACITY, PASS_PATHS, PASS_SAMPLES, PASSES, PATH_LENGTH


class Integrator(Choice):
    """Options of all integrators."""

    type: str
    max_depth: int = Field(default=8, ge=-1, le=PATH_LENGTH)
    """Length of the longest path in segments, from the emitter to the sensor. 1: only emitters that the sensor sees
    directly. 2: also direct light. -1: no limit; only Russian roulette ends paths. `trajectory` needs a limit, because
    its record of a path has room for this many vertices."""
    rr_depth: Count = Field(default=5, description="Path depth at which Russian roulette starts.")
    hide_emitters: bool = False
    """Whether the image leaves out emitters that the sensor sees directly."""


class LightTracerOptions(Integrator):
    """Options of integrators that trace from the emitters; `prb` traces all samples in one pass."""

    samples_per_pass: Count | None = None
    """Samples per pixel in one pass. Fewer samples need less memory. Must divide the samples per pixel. null: all
    samples in one pass."""


class AttachingTracer(LightTracerOptions):
    """Options of light tracers that can differentiate the geometry of light paths."""

    attached: Annotated[
        Annotated[bool, mark("flag")] | Annotated[Literal["auto"], mark("text")],
        Discriminator(lambda value: MARK + ("flag" if isinstance(value, bool) else "text")),
    ] = "auto"
    """Whether to differentiate the geometry of light paths (rays, hit points and film positions) in addition to their
    throughput. `auto`: if a parameter moves emitters or surfaces that light meets. true: also for roughness and index
    of refraction, whose derivatives are detached otherwise."""
    filter_normalization: Literal["attached", "detached"] = "attached"
    """Whether to differentiate the sum of the weights of the reconstruction filter when light moves over the film.
    `attached`: yes, which agrees with finite differences. `detached`: no, as `ptracer` does."""


#: Options of `reslrb` that only some estimators use, by estimator.
ESTIMATOR_OPTIONS: dict[str, tuple[str, ...]] = {
    "auto": (),
    "reservoir": ("capacity", "weight"),
    "gather": (),
    "event": ("capacity", "weight"),
    "stack": (),
}


@dataclass(frozen=True)
class Plain:
    """Mark of a setting that a run may decide (`optimization/autotune/sampling.py`), with its plain value: the default
    beside an estimator that the user names.
    """

    value: str | float


#: The estimator for `auto`: only `stack` has derivatives of camera paths and both `follow` and `stay`.
AUTO_ESTIMATOR = "stack"

_OWN_SCHEMA = WithJsonSchema(
    {"anyOf": [{"enum": [*ESTIMATOR_OPTIONS], "type": "string"}, {"pattern": r"\.py:\w+$", "type": "string"}]}
)

#: Names of estimators that the user has registered in this process (`rl.register_estimator`).
OWN_ESTIMATORS: set[str] = set()


def _own_estimator(value: Any, handler: ValidatorFunctionWrapHandler, info: ValidationInfo) -> Any:
    """Return the name of one of the user's estimators. Other values pass on to `handler`."""
    if isinstance(value, str) and is_code(value):
        return code_place(value, info)
    return value if value in OWN_ESTIMATORS else handler(value)


#: All options that select or configure the estimator.
_ANY_ESTIMATORS = {"estimator", *(option for options in ESTIMATOR_OPTIONS.values() for option in options)}


class ReslrbConfig(AttachingTracer):
    """Reservoir light replay backpropagation: light tracing with memory that does not depend on path length."""

    type: Literal["reslrb"] = "reslrb"
    """Light tracing that computes derivatives by replaying each path."""
    estimator: Annotated[
        Literal["auto", "reservoir", "gather", "event", "stack"],
        WrapValidator(_own_estimator), PlainSerializer(str, return_type=str), _OWN_SCHEMA,
    ] = "auto"  # fmt: skip
    """How the connections of a path enter its gradient. `reservoir`: a few connections, selected at random. `gather`:
    all connections, by a second traversal. `event`: a few scattering events, selected at random. `stack`: all
    connections, stored in thread-local memory. `auto`: `stack`, the most efficient one in every experiment on CPUs.
    On a GPU, `event` was more efficient in configs/cornell_floor.yaml, and less efficient in configs/grey_room.yaml.
    `FILE.py:CLASS`: your own estimator, a file relative to the config file and a class in it, which needs
    `--allow-code` on the command line ([Your own estimator](your_estimator.md)). With an estimator that you name, also
    with `stack`, no setting is `auto` unless you say so: `paths` is `light`, `guiding` and `edges` are `off`,
    `sequence` is `independent`, and `pixels` is `even`."""
    capacity: Annotated[Count, Field(le=CAPACITY)] = 1
    """Number of connections (`reservoir`) or scattering events (`event`) that are stored for each path. Each adds
    code to the kernel; `gather` uses all connections. Only with estimators `reservoir` and `event`."""
    weight: Literal["luminance", "adjoint"] = "luminance"
    """Selection probability of a connection: in proportion to its `luminance`, or to its contribution to the objective
    (`adjoint`). `adjoint` has less variance; it does not work with `run.adjoint: correlated`. Only with estimators
    `reservoir` and `event`."""
    attached_sampling: Literal["auto", "follow", "stay"] = "auto"
    """Where light goes after a moving surface that is not specular, in attached derivatives. `follow`: its direction
    turns with the surface, as in `ptracer`. It then sweeps over edges of objects that do not move, and the derivative
    lacks this effect. `stay`: light still arrives at the same point. `auto`: `stay` after diffuse surfaces, `follow`
    after glossy ones, where `stay` is noisy."""
    paths: Annotated[Literal["auto", "light", "camera", "both"], Plain("light")] = "auto"
    """Where paths start. `light`: at the emitters. Finds caustics and light through glass; mirrors and clear glass are
    black. `camera`: at the sensor. Finds reflections in mirrors, the view through glass, and most light in rooms, but
    no caustics of small lamps. Only with estimators `auto` and `stack`. `both`: at both, with each path weighted by how
    likely either side was to find it, so that the image has all light. `auto`: usually `both`. It is `camera` if camera
    paths find all light and a few steps before the first iteration show that they are more efficient. It is `light` if
    `both` and `camera` cannot render the scene or find none of its light, or if guided light paths are more efficient.
    If shapes move, `both` divides the light: light paths have the light that meets a mirror, glass or metal first, and
    camera paths have the rest. `auto` is then `camera` if no surface is a mirror, clear glass or metal, `both` if the
    sensor sees a mirror or clear glass, and otherwise `light`. Runs that move lamps always use `light`. The default is
    `auto` with estimator `auto`, and `light` with an estimator that you name."""
    light_share: Annotated[float, Field(ge=0, le=1, allow_inf_nan=False), Plain(0.5)] = 0.5
    """Fraction of the samples that are light paths, with `paths: both`. With 0 or 1 the code of the other side is not
    compiled."""
    guiding: Annotated[Literal["auto", "on", "off"], Plain("off")] = "auto"
    """Importance sampling of light paths, learned in earlier steps. `on`: paths start where earlier paths contributed
    to the gradient and the image (at least a quarter start anywhere), and end early where earlier paths contributed
    little. In scenes with glossy surfaces, paths are also aimed at points that the sensor sees. From the second step
    on, this reduces noise where few paths contribute, as in a room lit through windows or in a caustic. A few of the
    first steps, and one in sixteen later steps, trace as many paths again to learn. `auto`: `on` if a few steps with
    and without guiding, before the first iteration, show that it is more efficient. Runs that move geometry or lamps
    are guided only with `paths: both`. The default is `auto` with estimator `auto`, and `off` with an estimator that
    you name."""
    sequence: Annotated[Literal["auto", "independent", "low_discrepancy"], Plain("independent")] = "auto"
    """Random numbers that decide where light paths start and how they first scatter. `low_discrepancy`: spread evenly
    over all paths of a step, and independent between steps. This reduces noise where little else decides where light
    goes, as in a beam through glass, and a little elsewhere. `auto`: `low_discrepancy`, or `independent` if
    paths are guided. The default is `auto` with estimator `auto`, and
    `independent` with an estimator that you name."""
    pixels: Annotated[Literal["auto", "even", "measured"], Plain("even")] = "auto"
    """Number of camera paths in each pixel. `even`: the same in all pixels. `measured`: a quarter of the paths is
    spread evenly, and the others go to the pixels whose noise adds most to the noise of the gradient, by the curvature
    of the loss (0 in pixels that a mask leaves out). A few paths through each pixel measure this before the first
    iteration, at the initial values of the parameters. A texture that only a mirror shows gains most; a few colours may
    get noisier. `auto`: `measured` if there are camera paths, the loss is `l2`, and the measurement takes at most 2 %
    of the samples of the run. The default is `auto` with estimator `auto`, and `even` with an estimator that you
    name."""
    edges: Annotated[Literal["auto", "on", "off"], Plain("off")] = "auto"
    """Whether the derivatives of moving shapes contain their outlines and shadows: the light that edges cover and
    uncover. `on`: a step also samples points on the edges of moving shapes, as lamps, the sensor and other surfaces see
    them. Meshes, rectangles, disks, spheres and cylinders have edges. `auto`: `on` if finite differences before the
    first iteration find that a significant part of the derivative is missing otherwise, or cannot tell. The default is
    `auto` with estimator `auto`, and `off` with an estimator that you name."""

    @model_validator(mode="after")
    def _leave_plain(self) -> Self:
        """Give settings their plain values unless the user has set them, if the user has named an estimator."""
        if self.estimator != "auto":  # without assignment, which would mark them as given
            self.__dict__.update({name: plain for name, plain in PLAIN.items() if name not in self.model_fields_set})
        return self

    @model_validator(mode="after")
    def _check_options(self) -> Self:
        if self.paths == "camera" and self.estimator not in ("auto", "stack"):
            raise located(
                "estimator",
                f"`{self.estimator}` needs the connections of light paths, and paths: camera has none; "
                "remove it, or use stack",
            )
        if self.light_share != PLAIN["light_share"] and self.paths in ("light", "camera"):
            raise located("light_share", f"has no effect with paths: {self.paths}, only with both; remove it")
        for option in sorted(self.idle() & self.model_fields_set):
            owners = " or ".join(f"`{name}`" for name, options in ESTIMATOR_OPTIONS.items() if option in options)
            raise located(option, f"has no effect with estimator `{self.estimator}`, only with {owners}; remove it")
        return self

    def plain(self) -> ReslrbConfig:
        """Return these options with the plain value of each setting that is `auto`."""
        values = {"estimator": AUTO_ESTIMATOR, **PLAIN}
        return self.model_copy(update={name: plain for name, plain in values.items() if getattr(self, name) == "auto"})

    def idle(self) -> set[str]:
        """Return the options that belong only to other estimators."""
        return _ANY_ESTIMATORS - {"estimator", *ESTIMATOR_OPTIONS.get(self.estimator, ())}

    @property
    def file(self) -> str | None:
        """FILE.py:CLASS of the user's estimator, or None."""
        return self.estimator if is_code(self.estimator) else None

    @property
    def path(self) -> Path | None:
        """The file of code, or None."""
        return None if self.file is None else code_file(self.file)


def traced_paths(paths: str, light_share: float) -> str:
    """Return the kinds of paths that are traced: `both` with a share of 0 or 1 are paths of one kind."""
    if paths == "both" and light_share in (0, 1):
        return "light" if light_share else "camera"
    return paths


#: The plain value of each setting that a run may decide. `light_share` is never `auto`; measurements of single steps
#: take its value from here.
PLAIN: dict[str, Any] = {
    name: mark.value
    for name, setting in ReslrbConfig.model_fields.items()
    for mark in setting.metadata
    if isinstance(mark, Plain)
}

#: The possible decisions on each setting that may be `auto`. The first is its plain value.
AUTO_VALUES: dict[str, tuple[str, ...]] = {
    name: (
        plain,
        *(value for value in get_args(ReslrbConfig.model_fields[name].annotation) if value not in ("auto", plain)),
    )
    for name, plain in PLAIN.items()
    if name != "light_share"
}


class Ptracer(LightTracerOptions, json_schema_extra=NEEDS_TYPE):
    """Mitsuba's light tracer with naive reverse-mode differentiation. Its memory grows with depth."""

    type: Literal["ptracer"] = Field(default="ptracer", description="Mitsuba's light tracer, naively differentiated.")


class Prb(Integrator, json_schema_extra=NEEDS_TYPE):
    """Mitsuba's path replay backpropagation. The integrator traces paths from the sensor, and misses caustics of small
    lamps.
    """

    type: Literal["prb"] = Field(default="prb", description="Mitsuba's path replay backpropagation, from the sensor.")


class PrbProjective(Integrator, json_schema_extra=NEEDS_TYPE):
    """Mitsuba's path replay backpropagation, with the derivatives of outlines and shadow edges. A derivative has three
    parts, each with as many samples as the step."""

    type: Literal["prb_projective"] = "prb_projective"
    """Mitsuba's projective path replay, from the sensor."""


class WalkAdConfig(AttachingTracer, json_schema_extra=NEEDS_TYPE):
    """The paths of `reslrb` with naive reverse-mode differentiation, for comparisons at equal seeds."""

    type: Literal["walk_ad"] = Field(default="walk_ad", description="The walk of `reslrb`, naively differentiated.")
    paths: Literal["light", "camera", "both"] = "light"
    """Where paths start, as for `reslrb`."""
    #: Fraction of the samples that are light paths, with `paths: both`.
    light_share: ClassVar[float] = PLAIN["light_share"]


class TrajectoryConfig(LightTracerOptions, json_schema_extra=NEEDS_TYPE):
    """The light paths of `reslrb`, reversed by Dr.Jit. Dr.Jit records each path's loop state in thread-local memory."""

    type: Literal["trajectory"] = Field(default="trajectory", description="The walk of `reslrb`, reversed by Dr.Jit.")

    @model_validator(mode="after")
    def _check_record(self) -> Self:
        if self.max_depth < 0:
            raise located("max_depth", "must be at least 0: the record of a path has one entry for each vertex")
        return self


class Own(Integrator, json_schema_extra=NEEDS_TYPE):
    """Your own Mitsuba integrator, a class in a Python file. Needs `--allow-code` on the command line
    ([Your own integrator](your_integrator.md))."""

    type: Literal["custom"] = Field(default="custom", description="Your own Mitsuba integrator.")
    file: CodePlace
    """`FILE.py:CLASS`: a Python file, relative to the config file, and a class in it. The class is constructed from a
    `mi.Properties` with `max_depth`, `rr_depth`, `hide_emitters` and `arguments`. A run stores a digest of the file,
    without the modules that it imports, and resumes only with the same file."""
    paths: Literal["camera", "light"] = "camera"
    """Where its paths start. This tells which light they can find, and whether images are darker along the film's
    border, as with light paths."""
    arguments: dict[str, bool | int | float | str] = Field(default_factory=dict)
    """Further properties of the integrator, by name."""

    @property
    def path(self) -> Path:
        """The file of code."""
        return code_file(self.file)


AnyIntegrator = Annotated[
    ReslrbConfig | Ptracer | Prb | PrbProjective | WalkAdConfig | TrajectoryConfig | Own, ByType("reslrb")
]


def passes_obstacle(spp: int, per_pass: int | None, pixels: int, splits: bool = True) -> str | None:
    """Return why a film of `pixels` pixels cannot be traced with `spp` samples per pixel, and a remedy. Otherwise,
    return None.

    `per_pass` is the integrator's `samples_per_pass`. It divides `spp`, or is larger. `splits` is true for integrators
    that split their samples themselves. Other integrators have no `samples_per_pass`.
    """
    unit = min(per_pass or spp, spp)
    parts = -(-unit // PASS_SAMPLES) if splits else 1
    paths = -(-unit // parts) * pixels
    if paths > PASS_PATHS:
        advice = f"set integrator.samples_per_pass to at most {PASS_PATHS // pixels}, or lower run.spp"
        advice = advice if splits else "lower run.spp"
        return f"makes {paths} light paths in one pass, above the limit of {PASS_PATHS}; {advice}"
    if spp // unit * parts > PASSES:
        return (
            f"makes {spp // unit * parts} passes of a step, above the limit of {PASSES}; "
            "raise integrator.samples_per_pass, or lower run.spp"
        )
    return None
