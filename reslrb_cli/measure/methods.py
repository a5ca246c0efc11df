"""The methods that measurements compare (`NamedIntegrator`), and the plans of `bench` and `convergence`
(`MeasurementPlan`). Does not import Mitsuba.

A list of methods looks like `ptracer,reslrb:reservoir(capacity=4)`.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

from reslrb_cli.backend.doctor import device_name, memory_bytes
from reslrb_cli.backend.variant import choose
from reslrb_cli.config.integrators import (
    AUTO_ESTIMATOR,
    ESTIMATOR_OPTIONS,
    PLAIN,
    AnyIntegrator,
    ReslrbConfig,
)
from reslrb_cli.config.loader import dump, with_integrator
from reslrb_cli.config.schema import Config
from reslrb_cli.config.yaml_text import parse
from reslrb_cli.errors import ConfigError

#: Options that a case inherits from the configuration's integrator if its own integrator has them.
SHARED = (
    *("rr_depth", "hide_emitters", "samples_per_pass", "attached", "filter_normalization", "attached_sampling"),
    *PLAIN,
)

#: Options that set the kinds of paths.
PATHS_OPTIONS = ("paths", "light_share")


#: The estimator of a case that names none, as in the plugin.
PLUGIN_ESTIMATOR = "reservoir"

#: Options of `run` that a case can set for itself.
ADJOINT = ("adjoint", "batches")
_TYPES = {str(kind.model_fields["type"].default): kind for kind in get_args(get_args(AnyIntegrator)[0])}

_OPTION = "--integrators"
#: A user's own integrator.
_OWN = re.compile(r"(?P<file>[^()]+\.py):(?P<name>\w+)(?:\((?P<options>.*)\))?")
_ITEM = re.compile(r"(?P<type>\w+)(?::(?P<estimator>\w+|[^():]+\.py:\w+))?(?:\((?P<options>.*)\))?")


@dataclass(frozen=True)
class NamedIntegrator:
    """One integrator with its options, but without a depth. `label` is the user's text for the integrator. `source` is
    the command-line option that contains the text.
    """

    label: str
    type: str
    options: dict[str, Any]
    source: str = _OPTION

    def at(
        self, config: Config, max_depth: int, known: bool, auto: bool = False, has_lamps: bool = False
    ) -> Config:  # fmt: skip
        """Return the experiment with this integrator at this depth. Raises ConfigError if the integrator is invalid.

        `known` tells whether dL/dI is known before the image, so that `run.adjoint` has no effect. If the argument
        `auto` is True, options may have the value `auto`, as in whole runs. Otherwise, and if views name their lamps,
        the experiment has its first view alone. All lamps are on, or with `has_lamps` those of the view.
        """
        blame = f"{self.source} {self.label}"
        adjoint = {name: value for name, value in self.options.items() if name in ADJOINT}
        if known and adjoint:
            raise ConfigError(
                blame, next(iter(adjoint)), "has no effect if dL/dI is known; use convergence --objective loss"
            )
        if known:
            adjoint = {"adjoint": "independent"}  # valid with any loss
        shared, own = config.integrator.options(), _TYPES[self.type].model_fields if self.type in _TYPES else {}
        # A run chooses options that are `auto` by measurement, but a method has fixed values.
        left = {name for name in SHARED if name not in own or (name in PLAIN and shared.get(name) == "auto")}
        values = {"type": self.type} | {name: shared[name] for name in SHARED if name in shared and name not in left}
        if "paths" in self.options:  # the experiment's share belongs to its own paths
            values.pop("light_share", None)
        if self.type == "custom":  # a user's integrator chooses its own paths
            values.pop("paths", None)
        given = {name: value for name, value in self.options.items() if name not in ADJOINT}
        if self.type == "custom":  # unknown options are arguments of the user's class
            given["arguments"] = {name: given.pop(name) for name in [*given] if name not in own}
        values |= given
        if self.type == "reslrb":
            values.setdefault("estimator", PLUGIN_ESTIMATOR)
        for option, fixed in {"estimator": AUTO_ESTIMATOR, **PLAIN}.items():
            if values.get(option) == "auto" and not auto:
                raise ConfigError(blame, option, f"`auto` is for whole runs; use `{fixed}`, or another value")
        if not auto:
            config = _with_first_view(config, has_lamps)
        made = with_integrator(config, values | {"max_depth": max_depth}, blame, adjoint)
        if getattr(made.integrator, "file", None) is not None and not config.allows_code:
            raise ConfigError(blame, "", "would run with all your rights; --allow-code permits it")
        return made


def parse_cases(text: str, source: str = _OPTION) -> list[NamedIntegrator]:
    """Parse a list of cases. Raises ConfigError if a case has a wrong format or is listed twice.

    `source` is the command-line option that contains the list. `NamedIntegrator.at` checks the options of the cases.
    """
    cases: list[NamedIntegrator] = []
    for item in _split(text):
        if match := _ITEM.fullmatch(item):
            kind, options = match["type"], {} if match["estimator"] is None else {"estimator": match["estimator"]}
            if ":" in (match["estimator"] or ""):
                options = {"estimator": _absolute(*match["estimator"].rsplit(":", 1))}
        elif match := _OWN.fullmatch(item):
            kind, options = "custom", {"file": _absolute(match["file"], match["name"])}
        else:
            wanted = "TYPE[:ESTIMATOR][(OPTION=VALUE,...)] or FILE.py:CLASS"
            raise ConfigError(source, "", f"`{item}` is not an integrator; write {wanted}")
        for pair in _split(match["options"]) if match["options"] else []:
            name, equals, value = (part.strip() for part in pair.partition("="))
            if not equals or not name:
                raise ConfigError(source, item, f"`{pair}` must be OPTION=VALUE")
            if name == "max_depth":
                reason = f"all share one depth; use --set integrator.{pair}, or bench --max-depth"
                raise ConfigError(source, item, reason)
            options[name] = parse(value, f"{source} {item}", str)
        case = NamedIntegrator(item, kind, options, source)
        if case.label in [other.label for other in cases]:
            raise ConfigError(source, "", f"`{item}` is given twice")
        cases.append(case)
    return cases


def _absolute(file: str, name: str) -> str:
    """Return FILE.py:NAME with an absolute path."""
    return f"{Path(file).expanduser().absolute()}:{name}"


def parse_checked(text: str) -> list[NamedIntegrator]:
    """Parse the list of a gradient check: estimators of `reslrb`, and the user's own integrators. Raises
    ConfigError.
    """
    cases = parse_cases(text)
    for case in cases:
        if case.type != "custom" and "estimator" not in case.options:
            reason = f"`{case.label}` is neither an estimator, reslrb:ESTIMATOR, nor your own integrator, FILE.py:CLASS"
            raise ConfigError(_OPTION, "", reason)
        for name in ADJOINT:
            if name in case.options and case.type != "custom":
                raise ConfigError(_OPTION, case.label, f"all share one {name}; use --set run.{name}=VALUE")
    return cases


def all_estimators(config: Config) -> list[NamedIntegrator]:
    """Return every estimator of `reslrb`. The estimator that the configuration selects keeps the options from the
    configuration.

    All estimators use light paths. If `paths` is `auto`, a case with both kinds of paths is added, and if `guiding` is
    `auto`, a case with guided paths.
    """
    cases, own = [], config.integrator
    camera = isinstance(own, ReslrbConfig) and own.paths == "camera"  # only `stack` has camera paths
    for name in ESTIMATOR_OPTIONS:
        if name != "auto" and (name == "stack" or not camera):
            mine = isinstance(own, ReslrbConfig) and own.estimator == name
            names = [option for option in ESTIMATOR_OPTIONS[name] if mine and option in own.model_fields_set]
            options = {option: getattr(own, option) for option in names}
            text = ",".join(f"{option}={value}" for option, value in options.items())
            label = f"reslrb:{name}({text})" if text else f"reslrb:{name}"
            cases.append(NamedIntegrator(label, "reslrb", {"estimator": name} | options))
    more = {"paths": "both", "guiding": "on"} if isinstance(own, ReslrbConfig) else {}
    for option, value in more.items():
        # Views with different lamps cannot share tables, and camera paths alone use none.
        without = option == "guiding" and (camera or config.names_lamps)
        if getattr(own, option) == "auto" and not without:
            options = {"estimator": "stack", option: value}
            cases.append(NamedIntegrator(f"reslrb:stack({option}={value})", "reslrb", options))
    return cases


def _with_first_view(config: Config, has_lamps: bool) -> Config:
    """Return the experiment with its first view alone, if views name their lamps. All lamps are on unless `has_lamps`
    is true, because stock integrators cannot switch lamps off.
    """
    if config.views is None or not config.names_lamps:
        return config
    view = config.views[0]
    return config.model_copy(
        update={
            "views": [view if has_lamps else view.model_copy(update={"lamps": None})],
            "run": config.run.model_copy(update={"held_out": [], "views_per_iteration": None}),
        }
    )


def _split(text: str) -> list[str]:
    """Split at commas outside of parentheses."""
    parts, depth = [""], 0
    for character in text:
        depth += {"(": 1, ")": -1}.get(character, 0)
        if character == "," and depth == 0:
            parts.append("")
        else:
            parts[-1] += character
    return [part.strip() for part in parts]


def with_option(label: str, option: str) -> str:
    """Return the label of a method with a further `option`, such as `paths=both`."""
    return f"{label.removesuffix(')')}{',' if label.endswith(')') else '('}{option})"


def depths(max_depth: int) -> list[int]:
    """Return 2, 4, 8, ... and finally `max_depth`."""
    powers = [2**k for k in range(1, max_depth.bit_length()) if 2**k < max_depth]
    return [*powers, max_depth]


#: Default sample counts of a sweep, as multiples of the experiment's.
SHARES = (0.25, 0.5, 1, 2, 4)


def sample_counts(spp: int) -> list[int]:
    """Return the default sample counts of a sweep, for an experiment with `spp` samples per pixel."""
    return sorted({max(round(share * spp), 1) for share in SHARES})


#: Integrators that `bench` compares by default.
BENCHED = "ptracer,reslrb:reservoir,reslrb:event,reslrb:gather,reslrb:stack,trajectory"

#: Greatest depth that `bench` measures by default.
DEEPEST = 32

#: Default cases of `convergence` by objective: the gradient with fixed dL/dI, the gradient of the configuration's loss,
#: or the image.
DEFAULTS = {
    "fixed": "ptracer,prb,reslrb:reservoir,reslrb:event,reslrb:gather,reslrb:stack,reslrb:stack(guiding=on),"
    "reslrb:stack(paths=camera),reslrb:stack(paths=both)",
    "loss": "reslrb:stack(adjoint=correlated),reslrb:stack(adjoint=independent),reslrb:stack(adjoint=batched)",
    "image": "ptracer,prb,reslrb:stack,reslrb:stack(paths=camera),reslrb:stack(paths=both)",
}

#: Default reference for errors, and what it becomes for the kinds of paths that the scene allows.
REFERENCE = "reslrb:stack(paths=auto)"
REFERENCES = {
    "light": "reslrb:stack",
    "camera": "reslrb:stack(paths=camera)",
    "both": f"reslrb:stack(paths=both,light_share={PLAIN['light_share']})",
}

#: An `rr_depth` at which Russian roulette never starts.
NEVER = 1_000_000

#: Default numbers of rounds of `bench` and of `convergence`.
BENCH_ROUNDS, ROUNDS = 9, 64

#: Number of images whose dL/dI are used in turn for the configuration's loss. The noise of a single image would look
#: like a bias of methods that take dL/dI from their own images.
IMAGES = 8

#: Key of all parameters together.
ALL = "all"


def plays_roulette(depth: int, rr_depth: int) -> bool:
    """Whether paths of at most `depth` segments can meet Russian roulette. A depth of -1 is unbounded.

    The last segment plays no roulette, so roulette needs a `depth` above `rr_depth`.
    """
    return not 0 <= depth <= rr_depth


@dataclass(frozen=True, kw_only=True)
class MeasurementPlan:
    """The plan of `bench` or `convergence`: each of the `cases` at each of the `values` of the `swept` quantity
    (`depth` or `spp`).

    - `quantity` is the quantity of a draw, as in `steps.Sampler`: `step` for `bench`, otherwise a key of `DEFAULTS`.
    - `default` tells whether `cases` is the default list. Cases that do not support the scene are then left out.
    - `budget_s` ends the measurement early, unless the user gave the number of `rounds`.
    - `reference` is the method whose mean is the reference for errors. `bench` has none.
    - `memory_limit` is the limit of each process in bytes, or None. `device` is the name of the device.
    """

    config: Config
    cases: Sequence[NamedIntegrator]
    values: Sequence[int]
    swept: str = "spp"
    quantity: str = "step"
    default: bool = False
    reference: NamedIntegrator | None = None
    budget_s: float
    rounds: int | None = None
    variant: str
    memory_limit: int | None
    device: str = ""

    @classmethod
    def of(cls, config: Config, integrators: str | None, usual: str, **others: Any) -> MeasurementPlan:
        """Return a plan from a list of integrators as text, or from the list `usual`. `others` are further fields.
        Raises ConfigError if an integrator of the list, or the reference, is invalid.

        The memory limit limits the address space, which does not include the memory of a GPU.
        """
        variant, _ = choose(config.variant)
        limit = None if variant.startswith("cuda") else memory_bytes(variant)
        plan = cls(config=config, cases=parse_cases(integrators or usual), default=integrators is None, variant=variant,
                   memory_limit=limit, device=device_name(variant), **others)  # fmt: skip
        for case in plan.cases:
            for value in plan.values:
                plan.at(case, value)
        if plan.reference is not None:
            plan.of_reference(plan.reference)
        return plan

    @property
    def baseline(self) -> NamedIntegrator:
        """The first `ptracer` case in the list, or the first case if the list has no `ptracer`."""
        return next((case for case in self.cases if case.type == "ptracer"), self.cases[0])

    def at(self, case: NamedIntegrator, value: int) -> Config:
        """Return the experiment of one case at one value. Raises ConfigError."""
        config, depth = self.config, self.config.integrator.max_depth
        if self.swept == "spp":
            config = config.model_copy(update={"run": config.run.model_copy(update={"spp": value})})
        return case.at(config, value if self.swept == "depth" else depth, known=self.quantity != "loss")

    def of_reference(self, case: NamedIntegrator) -> Config:
        """Return the experiment of a reference, which has known dL/dI. Raises ConfigError."""
        return case.at(self.config, self.config.integrator.max_depth, True, auto=case.label == REFERENCE)

    def settled_reference(self, paths: str) -> NamedIntegrator:
        """Return the reference case for the scene's kinds of `paths`. It has edges if any of the cases has."""
        assert self.reference is not None, "bench has no reference"
        if self.reference.label != REFERENCE:
            return self.reference
        name = REFERENCES[paths]
        if any(case.options.get("edges") == "on" for case in self.cases):
            name = with_option(name, "edges=on")
        return parse_cases(name, "--reference")[0]

    def independent_reference(self, name: str) -> NamedIntegrator:
        """Return the case of a stock integrator. `ptracer` runs without Russian roulette, because naive AD with
        roulette would be wrong.
        """
        own = self.config.integrator
        roulette = name == "ptracer" and plays_roulette(own.max_depth, own.rr_depth)
        return NamedIntegrator(name, name, {"rr_depth": NEVER} if roulette else {}, "the independent reference")


def first_message(config: Config, variant: str, memory_limit: int | None, **more: Any) -> dict[str, Any]:
    """Return the first message to a process that measures `config`. `more` are further entries."""
    return {"config": dump(config), "source": str(config.source), "variant": variant, "memory_limit": memory_limit,
            "allow_code": config.allows_code, **more}  # fmt: skip


def bench_plan(
    config: Config, swept: str, values: Sequence[int], integrators: str | None, max_depth: int, **others: Any
) -> MeasurementPlan:
    """Return the plan of `bench`. Without `values`, the plan has the default depths up to `max_depth`, or the default
    sample counts. `others` are further fields. Raises ConfigError.
    """
    usual = depths(max_depth) if swept == "depth" else sample_counts(config.run.spp)
    return MeasurementPlan.of(config, integrators, BENCHED, swept=swept, values=sorted(values or usual), **others)


def convergence_plan(
    config: Config, objective: str, integrators: str | None, reference: str | None, spps: Sequence[int], **others: Any
) -> MeasurementPlan:
    """Return the plan of `convergence`. Without `spps`, steps have the samples per pixel of `run`. `others` are further
    fields. Raises ConfigError.
    """
    if objective not in DEFAULTS:
        raise ConfigError("objective", "", f"is {objective!r}; there are {', '.join(DEFAULTS)}")
    stands = parse_cases(reference or REFERENCE, "--reference")
    if len(stands) != 1:
        raise ConfigError("--reference", "", "errors are relative to one method; name one")
    values = spps or [config.run.spp]
    return MeasurementPlan.of(
        config, integrators, DEFAULTS[objective], quantity=objective, values=values, reference=stands[0], **others
    )
