"""Sections that are chosen by their `type`: integrators, losses and optimisers, each with the options that it knows."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Discriminator, Field, SerializerFunctionWrapHandler, model_serializer, model_validator
from typing_extensions import Self

from .base import MARK, Count, Positive, Section, by_type, located, mark

#: For JSON Schema: `type` may be left out only for the first member of a union.
_NEEDS_TYPE = ConfigDict(json_schema_extra={"required": ["type"]})


class Choice(Section):
    """A section whose `type` says which options it has."""

    def options(self) -> dict[str, Any]:
        """The options of this type by name, without `type` and without those that are None."""
        return self.model_dump(exclude={"type"}, exclude_none=True)


# --- integrators ------------------------------------------------------------------------------------------------------


class Integrator(Choice):
    """Options that all integrators share."""

    type: str
    max_depth: int = Field(
        default=8,
        ge=-1,
        lt=2**31,
        description="Longest path in segments, from the emitter to the sensor: 1 shows only directly visible "
        "emitters, 2 adds direct light; -1: no limit (Russian roulette alone ends a path).",
    )
    rr_depth: Count = Field(default=5, description="Path depth at which Russian roulette begins.")
    hide_emitters: bool = Field(
        default=False, description="Whether directly visible emitters are left out of the image."
    )


class LightTracer(Integrator):
    """Options of integrators that trace from the emitters; `prb` traces all samples in one pass."""

    samples_per_pass: Count | None = Field(
        default=None,
        description="Samples per pixel that one pass traces, to bound its memory; it must divide the samples per "
        "pixel. null: all in one pass.",
    )


class AttachingTracer(LightTracer):
    """Options of light tracers that have derivatives of what moves light."""

    attached: Annotated[
        Annotated[bool, mark("flag")] | Annotated[Literal["auto"], mark("text")],
        Discriminator(lambda value: MARK + ("flag" if isinstance(value, bool) else "text")),
    ] = Field(
        default="auto",
        description="Whether derivatives follow light where it goes: of rays, hit points and film positions, beside "
        "those of what light carries. `auto`: where a parameter moves anything that light leaves from or meets; true: "
        "for roughness and index of refraction too, whose derivatives are detached otherwise.",
    )
    filter_normalization: Literal["attached", "detached"] = Field(
        default="attached",
        description="Whether the sum of the reconstruction filter's weights has its derivative too, where light moves "
        "over the film: `attached` is what finite differences find, `detached` what `ptracer` computes.",
    )


#: The options of `reslrb` that belong to an estimator, by its name; the others have no use for them.
ESTIMATOR_OPTIONS: dict[str, tuple[str, ...]] = {
    "auto": (),
    "reservoir": ("capacity", "weight", "image"),
    "gather": (),
    "event": ("capacity", "weight"),
    "stack": ("stack_size",),
}
#: Every option that says which estimator, and how.
_ANY_ESTIMATORS = {"estimator", *(option for options in ESTIMATOR_OPTIONS.values() for option in options)}


class Reslrb(AttachingTracer):
    """Reservoir light replay backpropagation: light tracing whose memory does not depend on path length."""

    type: Literal["reslrb"] = Field(
        default="reslrb", description="Light tracing, derivatives by a replay of each path."
    )
    estimator: Literal["auto", "reservoir", "gather", "event", "stack"] = Field(
        default="auto",
        description="How a path's connections enter its gradient. `reservoir`: few of them, kept at random; `gather`: "
        "all, by a second traversal; `event`: few scattering events, kept at random; `stack`: all, kept in "
        "thread-local memory; `auto`: the one of these, with its options, that a short pilot measures to be the most "
        "efficient, 1 / (variance * time).",
    )
    capacity: Count = Field(
        default=1,
        description="How many connections, or events, are kept of each path. Only with estimators `reservoir` "
        "and `event`.",
    )
    weight: Literal["luminance", "adjoint"] = Field(
        default="luminance",
        description="What a connection is kept in proportion to: its `luminance`, or its share in the objective "
        "(`adjoint`: less variance; not with `run.adjoint: correlated`). Only with estimators `reservoir` and "
        "`event`.",
    )
    image: Literal["all", "retained"] = Field(
        default="all",
        description="Which connections the image shows: `all`, or the `retained` ones alone, weighted (noisier). "
        "Only with estimator `reservoir`.",
    )
    stack_size: Count = Field(
        default=64,
        description="Vertices of a path that fit into thread-local memory; longer paths are traced a second time. "
        "Only with estimator `stack`.",
    )
    freeze: bool = Field(
        default=True,
        description="Record what a step launches and launch that again, so that its Python runs once, not in every "
        "iteration. Not with passes, nor with more than 4 million paths, beside which Python does not show.",
    )

    @model_validator(mode="after")
    def _check_options(self) -> Self:
        if self.image == "retained" and self.weight == "adjoint":
            raise located("weight", "`adjoint` does not go with image: retained, which is made before dL/dI is known")
        for option in sorted(self._foreign() & self.model_fields_set):
            owners = " or ".join(f"`{name}`" for name, options in ESTIMATOR_OPTIONS.items() if option in options)
            raise located(option, f"has no effect with estimator `{self.estimator}`, but with {owners}; remove it")
        return self

    @model_serializer(mode="wrap")
    def _without_foreign(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        values: dict[str, Any] = handler(self)
        return {name: value for name, value in values.items() if name not in self._foreign()}

    def chosen(self, **options: Any) -> Reslrb:
        """The same with an `estimator` and its options in place of those it has."""
        kept = {name: getattr(self, name) for name in self.model_fields_set if name not in _ANY_ESTIMATORS}
        return Reslrb(**{**kept, **options})

    def _foreign(self) -> set[str]:
        """The options of the other estimators."""
        return _ANY_ESTIMATORS - {"estimator", *ESTIMATOR_OPTIONS[self.estimator]}


class Ptracer(LightTracer):
    """Mitsuba's own light tracer under naive reverse-mode differentiation: memory grows with depth."""

    model_config = _NEEDS_TYPE
    type: Literal["ptracer"] = Field(default="ptracer", description="Mitsuba's light tracer, naively differentiated.")


class Prb(Integrator):
    """Mitsuba's path replay backpropagation: paths from the sensor; it cannot see caustics of small lights."""

    model_config = _NEEDS_TYPE
    type: Literal["prb"] = Field(default="prb", description="Mitsuba's path replay backpropagation, from the sensor.")


class WalkAd(AttachingTracer):
    """The light-path walk of `reslrb` under naive reverse-mode differentiation, for comparisons at equal seeds."""

    model_config = _NEEDS_TYPE
    type: Literal["walk_ad"] = Field(default="walk_ad", description="The walk of `reslrb`, naively differentiated.")


class Trajectory(LightTracer):
    """The same walk, reversed by Dr.Jit itself: it records each path's loop state in thread-local memory."""

    model_config = _NEEDS_TYPE
    type: Literal["trajectory"] = Field(default="trajectory", description="The walk of `reslrb`, reversed by Dr.Jit.")
    max_depth: int = Field(
        default=8,
        ge=0,
        lt=2**31,
        description="Longest path in segments, as above; the record has room for as many vertices, so that there must "
        "be a limit.",
    )


AnyIntegrator = Annotated[
    Annotated[Reslrb, mark("reslrb")]
    | Annotated[Ptracer, mark("ptracer")]
    | Annotated[Prb, mark("prb")]
    | Annotated[WalkAd, mark("walk_ad")]
    | Annotated[Trajectory, mark("trajectory")],
    by_type("reslrb"),
]

# --- losses -----------------------------------------------------------------------------------------------------------


class Loss(Choice):
    """A mean over pixels and channels of a function of the image I and the target T."""

    type: str


class L2(Loss):
    """Mean of (I - T)², I the image, T the target, over pixels and channels; so are the others."""

    type: Literal["l2"] = Field(default="l2", description="Mean of (I - T)².")


class L1(Loss):
    """Mean of |I - T|."""

    model_config = _NEEDS_TYPE
    type: Literal["l1"] = Field(default="l1", description="Mean of |I - T|.")


class RelativeL2(Loss):
    """Mean of (I - T)² / (T² + epsilon)."""

    model_config = _NEEDS_TYPE
    type: Literal["relative_l2"] = Field(default="relative_l2", description="Mean of (I - T)² / (T² + epsilon).")
    epsilon: Positive = Field(
        default=1e-2,
        description="Added to the denominator, in squared units of radiance; keeps dark pixels from dominating.",
    )


class LogL2(Loss):
    """Mean of (log(I + epsilon) - log(T + epsilon))², negative values as 0."""

    model_config = _NEEDS_TYPE
    type: Literal["log_l2"] = Field(default="log_l2", description="Mean of (log(I + epsilon) - log(T + epsilon))².")
    epsilon: Positive = Field(default=1e-2, description="Added inside both logarithms, in units of radiance.")


AnyLoss = Annotated[
    Annotated[L2, mark("l2")]
    | Annotated[L1, mark("l1")]
    | Annotated[RelativeL2, mark("relative_l2")]
    | Annotated[LogL2, mark("log_l2")],
    by_type("l2"),
]

# --- optimisers -------------------------------------------------------------------------------------------------------

_Decay = Annotated[float, Field(ge=0, lt=1)]


class Optimizer(Choice):
    """Options that all optimisers share: the learning rate and its schedule."""

    type: str
    learning_rate: Positive = Field(
        default=0.02,
        description="Step size at the first iteration, in the parameter's units; in those of its `transform`, where it "
        "has one; with `scale: auto`, as a share of the measured length.",
    )
    scale: Literal["none", "auto"] = Field(
        default="none",
        description="`auto`: before the first iteration, measure for each parameter the length by which it would have "
        "to change to make up the image where it has an effect, and how large its gradient is, and let the optimizer "
        "move each in units of its own: one learning rate serves parameters that differ by orders of magnitude, and "
        "`epsilon` does not matter. Learning rates are then shares of that length: 0.02 is 2 % a step.",
    )
    schedule: Literal["constant", "cosine", "exponential"] = Field(
        default="constant", description="How the learning rate runs from its first value to its last."
    )
    final_fraction: float = Field(
        default=0.01,
        gt=0,
        le=1,
        description="Last learning rate over the first; only with a schedule other than `constant`.",
    )

    clamp_gradient: Annotated[float, Field(ge=1)] | None = Field(
        default=None,
        description="Clamp each entry of a gradient at so many times its usual size: the larger of the running means "
        "of its own absolute value and of those of all entries of the parameter. Takes the noise of rare bright paths, "
        "and is biased by what it takes, which the run reports. null: no clamp.",
    )

    @model_validator(mode="after")
    def _check_schedule(self) -> Self:
        if self.schedule == "constant" and "final_fraction" in self.model_fields_set:
            raise located("final_fraction", "has no effect on a constant learning rate; set `schedule` or remove it")
        return self

    @model_serializer(mode="wrap")
    def _without_unused(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        values: dict[str, Any] = handler(self)
        if self.schedule == "constant":
            values.pop("final_fraction", None)
        return values

    def own_options(self) -> dict[str, Any]:
        """Options of the update rule itself (beta_1, momentum, ...): those that not all types share."""
        return {name: value for name, value in self.options().items() if name not in Optimizer.model_fields}


class _AdamOptions(Optimizer):
    beta_1: _Decay = Field(default=0.9, description="Decay of the running mean of the gradient.")
    beta_2: _Decay = Field(default=0.999, description="Decay of the running mean of the squared gradient.")
    epsilon: Positive = Field(default=1e-8, description="Added to the root of the mean squared gradient.")


class Adam(_AdamOptions):
    """Adam (Kingma and Ba 2015)."""

    type: Literal["adam"] = Field(default="adam", description="Adam (Kingma and Ba 2015).")


class AdamW(_AdamOptions):
    """Adam with decoupled weight decay (Loshchilov and Hutter 2019)."""

    model_config = _NEEDS_TYPE
    type: Literal["adamw"] = Field(
        default="adamw", description="Adam with decoupled weight decay (Loshchilov, Hutter 2019)."
    )
    weight_decay: float = Field(
        default=0.01, ge=0, description="Share of the value that a step removes, per learning rate."
    )


class RMSProp(Optimizer):
    """RMSProp (Hinton 2012)."""

    model_config = _NEEDS_TYPE
    type: Literal["rmsprop"] = Field(default="rmsprop", description="RMSProp (Hinton 2012).")
    decay: _Decay = Field(default=0.99, description="Decay of the running mean of the squared gradient.")
    epsilon: Positive = Field(default=1e-8, description="Added to the root of the mean squared gradient.")


class SGD(Optimizer):
    """Gradient descent with momentum."""

    model_config = _NEEDS_TYPE
    type: Literal["sgd"] = Field(default="sgd", description="Gradient descent, with momentum if that is above 0.")
    momentum: _Decay = Field(default=0.0, description="Decay of the running sum of gradients; 0: none.")


AnyOptimizer = Annotated[
    Annotated[Adam, mark("adam")]
    | Annotated[AdamW, mark("adamw")]
    | Annotated[RMSProp, mark("rmsprop")]
    | Annotated[SGD, mark("sgd")],
    by_type("adam"),
]
