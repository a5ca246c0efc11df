"""The methods that measurements compare (`Case`), and what these measure, as their options say it. Knows no Mitsuba.

A list is written as `ptracer,reslrb:reservoir(capacity=4)`. `Sweep` is of `bench`, `Plan` of `convergence`, `RunsPlan`
of `convergence --runs`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, get_args

from reslrb_cli.backend.doctor import device_name, memory_bytes
from reslrb_cli.backend.variant import choose
from reslrb_cli.config.base import SEED_END, code_file
from reslrb_cli.config.integrators import ESTIMATOR_OPTIONS, UNDECIDED, AnyIntegrator, LightTracerOptions
from reslrb_cli.config.integrators import Reslrb as ReslrbConfig
from reslrb_cli.config.loader import dump, with_integrator
from reslrb_cli.config.parameters import ByWord, ParameterSpec
from reslrb_cli.config.schema import Config
from reslrb_cli.config.yaml_text import parse
from reslrb_cli.errors import ConfigError
from reslrb_cli.measure import resume_store
from reslrb_cli.records.measurements import Method

#: Options that a case takes over from the configuration's integrator, where it knows them.
SHARED = (
    *("rr_depth", "hide_emitters", "samples_per_pass", "attached", "filter_normalization", "attached_sampling"),
    *("sppc", "sppp", "sppi", *UNDECIDED, "light_share"),
)

#: Options that say which paths there are.
PATHS_OPTIONS = ("paths", "light_share")


def records_of(paths: str, light_share: Any) -> dict[str, Any]:
    """`paths` and `light_share` as records have them: a share where there are both kinds of paths and it is known."""
    known = paths == "both" and isinstance(light_share, (int, float))
    return {"paths": paths, "light_share": float(light_share) if known else None}


def paths_in_records(config: Config) -> dict[str, Any]:
    """Those of an integrator; `auto` where that is left to measurement."""
    options = config.integrator.options()
    usual = "light" if isinstance(config.integrator, LightTracerOptions) else "camera"
    return records_of(str(options.get("paths", usual)), options.get("light_share", BOTH_SHARE))


#: The share of light paths where there are both kinds, and nothing else is asked for.
BOTH_SHARE = 0.5

#: The estimator of a case that names none, as that of the plugin.
PLUGIN_ESTIMATOR = "reservoir"

#: Options of a case that are those of `run`, for itself alone.
ADJOINT = ("adjoint", "batches", "first_batch")
_TYPES = {str(kind.model_fields["type"].default): kind for kind in get_args(get_args(AnyIntegrator)[0])}

#: Options that make an estimator another one, in records.
_ESTIMATOR_OPTIONS = {option for options in ESTIMATOR_OPTIONS.values() for option in options} - {"capacity"}
_ESTIMATOR_OPTIONS |= {*UNDECIDED, "light_share"}

_OPTION = "--integrators"
#: A user's own integrator.
_OWN = re.compile(r"(?P<file>[^()]+\.py):(?P<name>\w+)(?:\((?P<options>.*)\))?")
_ITEM = re.compile(r"(?P<type>\w+)(?::(?P<estimator>\w+))?(?:\((?P<options>.*)\))?")


@dataclass(frozen=True)
class Case:
    """One integrator with its options, at no depth yet; `label` is how the user wrote it, `source` where."""

    label: str
    type: str
    options: dict[str, Any]
    source: str = _OPTION

    def at(self, config: Config, max_depth: int, known: bool, auto: bool = False) -> Config:
        """The experiment with this integrator at this depth. Raises ConfigError where the integrator cannot be.

        `known`: dL/dI is, before the image, so that `run.adjoint` has no part in it. `auto`: options may be left to
        measurement, which whole runs do.
        """
        blame = f"{self.source} {self.label}"
        adjoint = {name: value for name, value in self.options.items() if name in ADJOINT}
        if known and adjoint:
            raise ConfigError(blame, next(iter(adjoint)), "has no effect where dL/dI is known; change --objective")
        if known:
            adjoint = {"adjoint": "independent"}  # which goes with any weight
        shared, own = config.integrator.options(), _TYPES[self.type].model_fields if self.type in _TYPES else {}
        values = {"type": self.type} | {name: shared[name] for name in SHARED if name in shared and name in own}
        # A run decides these by measurement; a method that is named here does not.
        values = {name: value for name, value in values.items() if name not in UNDECIDED or value != "auto"}
        if "paths" in self.options:  # a share is of the experiment's own paths
            values.pop("light_share", None)
        if self.type == "custom":  # which paths it has is its own affair
            values.pop("paths", None)
        given = {name: value for name, value in self.options.items() if name not in ADJOINT}
        if self.type == "custom":  # what is not ours is for the class
            given["arguments"] = {name: given.pop(name) for name in [*given] if name not in own}
        values |= given
        if self.type == "reslrb" and values.setdefault("estimator", PLUGIN_ESTIMATOR) == "auto" and not auto:
            raise ConfigError(blame, "estimator", "`auto` is for whole runs; take `stack`")
        for option in UNDECIDED:
            if values.get(option) == "auto" and not auto:
                ways = [each for each in get_args(ReslrbConfig.model_fields[option].annotation) if each != "auto"]
                compared = " with ".join(f"`{way}`" for way in ways)
                raise ConfigError(blame, option, f"`auto` is for whole runs; compare {compared}")
        made = with_integrator(config, values | {"max_depth": max_depth}, blame, adjoint)
        if self.type == "custom" and not config.allows_code:
            raise ConfigError(blame, "", "would be run, with all your rights; --allow-code has it run")
        return made

    @property
    def estimator(self) -> str | None:
        """Name of the estimator, with the options that make it another than the default one, but for `capacity`."""
        if self.type != "reslrb":
            return None
        name = str(self.options.get("estimator", PLUGIN_ESTIMATOR))
        usual = {option: ReslrbConfig.model_fields[option].default for option in _ESTIMATOR_OPTIONS}
        usual |= {} if name == "auto" else UNDECIDED
        other = [
            f"{option}={value}"
            for option, value in self.options.items()
            if option in ADJOINT or (option in usual and value != usual[option])
        ]
        return f"{name}({','.join(other)})" if other else name


def parse_cases(text: str, source: str = _OPTION, deep: bool = True) -> list[Case]:
    """The cases in a list. Raises ConfigError where one is not written as it must be, or stands there twice.

    `source` is the option that the list was given by; `deep`: depths are what is varied. What an option means is not
    looked at here, but in `Case.at`.
    """
    return _parse(text, source, "", "integrator; write TYPE[:ESTIMATOR][(OPTION=VALUE,...)]", deep)


def parse_estimators(text: str) -> list[Case]:
    """The cases in a list of estimators of `reslrb`, such as `stack,reservoir(capacity=4)`; raises as `parse_cases`."""
    return _parse(text, "--estimators", "reslrb:", "estimator; write ESTIMATOR[(OPTION=VALUE,...)]", False)


def parse_own(text: str) -> list[Case]:
    """The cases in a list of a user's own integrators, FILE.py:CLASS[(OPTION=VALUE,...)]; raises as `parse_cases`."""
    cases = _parse(text, _OPTION, "", "integrator of your own; write FILE.py:CLASS[(OPTION=VALUE,...)]", False)
    if others := [case.label for case in cases if case.type != "custom"]:
        reason = f"`{others[0]}` is none of your own (FILE.py:CLASS); estimators of reslrb go with --estimators"
        raise ConfigError(_OPTION, "", reason)
    return cases


def all_estimators(config: Config) -> list[Case]:
    """Every estimator of `reslrb`; that of the configuration has the options that stand there.

    Where paths are left to measurement, both kinds of them as well: light paths are what all estimators have.
    """
    cases, own = [], config.integrator
    camera = isinstance(own, ReslrbConfig) and own.paths == "camera"  # of which there is one estimator alone
    for name in ESTIMATOR_OPTIONS:
        if name != "auto" and (name == "stack" or not camera):
            mine = isinstance(own, ReslrbConfig) and own.estimator == name
            names = [option for option in ESTIMATOR_OPTIONS[name] if mine and option in own.model_fields_set]
            options = {option: getattr(own, option) for option in names}
            text = ",".join(f"{option}={value}" for option, value in options.items())
            label = f"reslrb:{name}({text})" if text else f"reslrb:{name}"
            cases.append(Case(label, "reslrb", {"estimator": name} | options))
    if isinstance(own, ReslrbConfig) and own.paths == "auto":
        cases.append(Case("reslrb:stack(paths=both)", "reslrb", {"estimator": "stack", "paths": "both"}))
    return cases


def _parse(text: str, source: str, prefix: str, wanted: str, deep: bool) -> list[Case]:
    cases: list[Case] = []
    for item in _split(text):
        match = _ITEM.fullmatch(prefix + item)
        kind, options = (match["type"], {"estimator": match["estimator"]}) if match else ("", {})
        if own := None if prefix else _OWN.fullmatch(item):
            place = f"{Path(own['file']).expanduser().absolute()}:{own['name']}"
            match, kind, options = own, "custom", {"file": place}
        options = {name: value for name, value in options.items() if value is not None}
        if match is None or (prefix and "estimator" not in options):
            raise ConfigError(source, "", f"`{item}` is no {wanted}")
        for pair in _split(match["options"]) if match["options"] else []:
            name, equals, value = (part.strip() for part in pair.partition("="))
            if not equals or not name:
                raise ConfigError(source, item, f"`{pair}` must be OPTION=VALUE")
            if name == "max_depth" and deep:
                raise ConfigError(source, item, "max_depth is what is varied; --max-depth says how far")
            if name == "max_depth" or (name in ADJOINT and prefix):
                section = "run" if name in ADJOINT else "integrator"
                raise ConfigError(source, item, f"all share one {name}; take --set {section}.{pair}")
            options[name] = parse(value, f"{source} {item}", name_line=False)
        case = Case(prefix + item, kind, options, source)
        if case.label in [other.label for other in cases]:
            raise ConfigError(source, "", f"`{item}` is named twice")
        cases.append(case)
    return cases


def _split(text: str) -> list[str]:
    """The parts between commas that stand in no parentheses."""
    parts, depth = [""], 0
    for character in text:
        depth += {"(": 1, ")": -1}.get(character, 0)
        if character == "," and depth == 0:
            parts.append("")
        else:
            parts[-1] += character
    return [part.strip() for part in parts]


def depths(max_depth: int) -> list[int]:
    """2, 4, 8, ... up to `max_depth`, which comes last."""
    powers = [2**k for k in range(1, max_depth.bit_length()) if 2**k < max_depth]
    return [*powers, max_depth]


#: What can be swept, and what it is called where a single value of it is named.
SWEPT = {"depth": "depth", "spp": "spp", "film": "film width", "texture": "texture width"}

#: Samples per pixel that are measured where the user names none, as shares of those of the experiment.
SHARES = (0.25, 0.5, 1, 2, 4)

#: Widths that are measured where the user names none, in pixels or texels.
WIDTHS = {"film": (32, 64, 128, 256), "texture": (16, 64, 256, 1024)}


def usual_values(swept: str, config: Config) -> list[int]:
    """What is measured of anything but depth, where the user names nothing."""
    if swept == "spp":
        return sorted({max(round(share * config.run.spp), 1) for share in SHARES})
    return list(WIDTHS[swept])


def with_run(config: Config, **changes: Any) -> Config:
    """The experiment with other settings of `run`."""
    return config.model_copy(update={"run": config.run.model_copy(update=changes)})


def code_files(cases: Iterable[Case]) -> dict[str, Path]:
    """Return the files of integrators of the user's own among `cases`, by label."""
    return {case.label: code_file(case.options["file"]) for case in cases if case.type == "custom"}


@dataclass(frozen=True, kw_only=True)
class Measurement:
    """What every measurement by processes has; `memory_limit` is of each, None: none.

    `memory` is what the machine has, in bytes, `device` what computes, in words. `rounds` is None where `budget_s`
    decides their number; else there are so many, whatever time they take. Of the `cases`, those that cannot do what the
    scene asks for are left out where they are the `default` ones.
    """

    config: Config
    variant: str
    cases: Sequence[Case]
    objective: str
    memory_limit: int | None
    memory: int
    budget_s: float
    rounds: int | None = None
    default: bool = False
    device: str = ""

    #: What is kept says that it is of this.
    KIND: ClassVar[str]

    def first(self, config: Config) -> dict[str, Any]:
        """What a process is told first, to measure `config`."""
        return {"config": dump(config), "source": str(config.source), "variant": self.variant,
                "memory_limit": self.memory_limit, "allow_code": config.allows_code}  # fmt: skip

    def settings(self) -> dict[str, Any]:
        """What has to be the same in all sessions, as JSON has it; see `resume_store.settings`."""
        labels = [case.label for case in self.cases]
        options = {"integrators": labels, **self._options(), "memory limit": self.memory_limit}
        codes = code_files([*self.cases, *(each for each in vars(self).values() if isinstance(each, Case))])
        return resume_store.settings(self.config, codes, self.variant, self.device, **options)

    def _options(self) -> dict[str, Any]:
        """Those of the command that count among the settings."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class Sweep(Measurement):
    """What is measured: at each of `values` of what is `swept`, times over those of the `baseline`."""

    values: Sequence[int]
    swept: str = "depth"

    KIND = "bench"

    @property
    def baseline(self) -> Case:
        """`ptracer` where it is there, or the first."""
        return next((case for case in self.cases if case.type == "ptracer"), self.cases[0])

    def _options(self) -> dict[str, Any]:
        return {"values": list(self.values), "objective": self.objective, "sweep": self.swept}

    def may_refuse(self, case: Case) -> bool:
        """Whether the rest goes on without this case, where it refuses the scene."""
        return self.default and case != self.baseline

    def at(self, case: Case, value: int) -> Config:
        """The experiment of one case, all but the sizes of film and textures. Raises ConfigError."""
        config = with_run(self.config, spp=value) if self.swept == "spp" else self.config
        depth = value if self.swept == "depth" else config.integrator.max_depth
        return case.at(config, depth, known=self.objective == "fixed")

    def name(self, *values: int) -> str:
        """Some values of what is swept, in words: `depth 2, 4`."""
        return f"{SWEPT[self.swept]} {', '.join(map(str, values))}"

    def check(self) -> None:
        """Raise ConfigError where an integrator of the list cannot be."""
        for case in self.cases:
            for value in self.values if self.swept == "spp" else self.values[:1]:
                self.at(case, value)


#: What is compared where the user names nothing, by what is estimated: the gradient with dL/dI held, that of the
#: configuration's loss, or the image.
DEFAULTS = {
    "fixed": "ptracer,prb,reslrb:reservoir,reslrb:event,reslrb:gather,reslrb:stack,reslrb:stack(guiding=on),"
    "reslrb:stack(paths=camera),reslrb:stack(paths=both)",
    "loss": "reslrb:stack(adjoint=correlated),reslrb:stack(adjoint=independent),reslrb:stack(adjoint=batched)",
    "image": "ptracer,prb,reslrb:stack,reslrb:stack(paths=camera),reslrb:stack(paths=both)",
}

#: What errors are taken from where the user names nothing: all light, `both` at a share that nothing is measured for,
#: where the scene allows it, and else what paths can render it.
REFERENCE = "reslrb:stack(paths=auto)"

#: A depth at which roulette never begins.
NEVER = 1_000_000

#: Images that dL/dI is held at in turn where the loss is the configuration's: the noise of a single one would look like
#: a bias of those that take dL/dI from images of their own.
IMAGES = 8

#: All parameters together.
ALL = "all"


@dataclass(frozen=True, kw_only=True)
class Plan(Measurement):
    """What is measured, and what errors are taken from, the `reference`.

    `spps` are samples per pixel of a step, nothing for those of `run`.
    """

    reference: Case
    spps: Sequence[int] = ()

    KIND = "convergence"

    def _options(self) -> dict[str, Any]:
        return {"objective": self.objective, "reference": self.reference.label, "spp": list(self.spps)}

    @property
    def known(self) -> bool:
        """Whether dL/dI is known before the image, or not asked for."""
        return self.objective != "loss"

    @property
    def camera(self) -> dict[str, bool]:
        """Whether paths from the `camera` take part, whether that is so in any case, `named`, and whether those from
        the `light` alone do, as `survey` asks."""
        spp = self.config.run.spp
        sides = [self._has_camera_paths(self.config_of(case, spp)) for case in self.cases]
        named = self._has_camera_paths(self.reference_config)  # what errors are taken from is a side too
        return {"camera": named or any(sides), "named": named or not self.default,
                "light": not (named and all(sides))}  # fmt: skip

    def _has_camera_paths(self, config: Config) -> bool:
        """Whether an integrator's images lose nothing by the film's border, as far as that is known of it."""
        return str(paths_in_records(config)["paths"]) != "light"

    @property
    def entries(self) -> list[tuple[Case, int]]:
        """What is compared: cases, each with its samples per pixel."""
        return [(case, spp) for case in self.cases for spp in self.spps or [self.config.run.spp]]

    def config_of(self, case: Case, spp: int) -> Config:
        """The experiment with the integrator of a case, and so many samples per pixel. Raises ConfigError."""
        return case.at(with_run(self.config, spp=spp), self.config.integrator.max_depth, self.known)

    @property
    def reference_config(self) -> Config:
        """The experiment with the integrator that errors are taken from, dL/dI known. Raises ConfigError."""
        return self.reference.at(self.config, self.config.integrator.max_depth, True, auto=True)

    def settled_reference(self, paths: str) -> Case:
        """What errors are taken from, with these `paths` where that was left to what the scene allows."""
        if self.reference.options.get("paths") != "auto":
            return self.reference
        own: dict[str, Any] = {} if paths == "light" else {"paths": paths}
        own |= {"light_share": BOTH_SHARE} if paths == "both" else {}
        options = {name: value for name, value in self.reference.options.items() if name not in PATHS_OPTIONS} | own
        text = ",".join(f"{name}={value}" for name, value in options.items() if name != "estimator")
        kind = f"{self.reference.type}:{options['estimator']}"
        return replace(self.reference, label=f"{kind}({text})" if text else kind, options=options)

    def independent_config(self, name: str) -> Config:
        """The experiment with a stock integrator: without roulette, which naive AD does not differentiate rightly."""
        depth = self.config.integrator.max_depth
        roulette = depth < 0 or self.config.integrator.rr_depth <= depth
        options = {"rr_depth": NEVER} if name == "ptracer" and roulette else {}
        return Case(name, name, options, "the independent reference").at(self.config, depth, True)

    def check(self) -> None:
        """Raise ConfigError where an integrator of the list, or the reference, cannot be."""
        if self.reference.options.get("estimator") == "auto":
            raise ConfigError("--reference", "", "`auto` measures which estimator to take; name one")
        for case, spp in self.entries:
            self.config_of(case, spp)
        _ = self.reference_config

    def method(self, case: Case, config: Config, spp: int, known: bool, reference: bool) -> Method:
        """How a case, or a `reference`, stands in records."""
        options: dict[str, Any] = config.integrator.options()
        adjoint = None if known else config.adjoint
        own = {name: value for name, value in case.options.items() if name not in ADJOINT}
        estimator = replace(case, options=own).estimator
        label = f"{case.label}, {spp} spp" if self.spps and not reference else case.label
        capacity = options.get("capacity")
        return Method(label, case.type, estimator, capacity, adjoint, spp, **paths_in_records(config))


#: What is compared where the user names nothing.
DEFAULT = "ptracer,prb,reslrb:stack,reslrb:auto(paths=light),reslrb:auto"


@dataclass(frozen=True)
class Side:
    """What has runs of its own: a case, samples per pixel, and what learning rates are multiplied by, None: nothing."""

    case: Case
    spp: int
    rate: float | None = None


def compared(integrators: str | None, reference: str | None, usual: str, before: Mapping[str, Any]) -> dict[str, Any]:
    """What a `Plan` compares, and takes errors from: lists as written, or None for those of `before`, or the `usual`.

    `before` are the settings of what is gone on from, whose defaults may have been others. Raises ConfigError.
    """
    cases = parse_cases(integrators or ",".join(before.get("integrators", ())) or usual, deep=False)
    stands = parse_cases(reference or before.get("reference") or REFERENCE, "--reference", deep=False)
    if len(stands) != 1:
        raise ConfigError("--reference", "", "errors are taken from one method; name one")
    return {"cases": cases, "reference": stands[0], "default": integrators is None}


def machine_of(config: Config, memory_limit: int | None) -> dict[str, Any]:
    """What computes, as a `Measurement` has it: variant, memory, and the limit of each process. Raises ConfigError."""
    variant, _ = choose(config.variant)
    on_gpu, memory = variant.startswith("cuda"), memory_bytes(variant)
    if on_gpu and memory_limit is not None:
        raise ConfigError("--memory-limit", "", f"bounds address space, which says nothing of {variant}'s memory")
    limit = memory_limit or (None if on_gpu else memory)
    return {"variant": variant, "memory": memory, "memory_limit": limit, "device": device_name(variant)}


@dataclass(frozen=True, kw_only=True)
class RunsPlan(Plan):
    """What is measured; see `Plan`. `runs` is the number of seeds, which all methods have in common.

    `reference` is what renders the images that losses are taken of. Each method has runs with all its learning rates
    times each of `rates`, of which its best then counts; without any, with those of the configuration.
    """

    runs: int = 3
    rates: Sequence[float] = ()

    KIND = "convergence --runs"

    def _options(self) -> dict[str, Any]:
        return {"reference": self.reference.label, "spp": list(self.spps), "rates": list(self.rates)}

    def settings(self) -> dict[str, Any]:
        """What has to be the same in all sessions; files of such runs name the variant with the device, always have."""
        return super().settings() | {"device": f"{self.device}, {self.variant}"}

    @property
    def sides(self) -> list[Side]:
        """What has runs of its own, all rates of a method beside each other."""
        return [Side(case, spp, rate) for case, spp in self.entries for rate in self.rates or (None,)]

    @property
    def names(self) -> dict[str, str]:
        """The method's label by that of each of its rates."""
        return {self.method_of(side).label: self.method_of(replace(side, rate=None)).label for side in self.sides}

    @property
    def seeds(self) -> list[int]:
        """`run.seed` of each run: that of the configuration, and those after it."""
        return [(self.config.run.seed + number) % SEED_END for number in range(self.runs)]

    def config_of(self, case: Case, spp: int) -> Config:
        """The experiment with the integrator of a case, which may be `auto`, and so many samples per pixel.

        Raises ConfigError.
        """
        return case.at(with_run(self.config, spp=spp), self.config.integrator.max_depth, False, auto=True)

    def config_at(self, side: Side) -> Config:
        """The experiment as a side has it. Raises ConfigError."""
        config = self.config_of(side.case, side.spp)
        return config if side.rate is None else at_rate(config, side.rate)

    def method_of(self, side: Side) -> Method:
        """How a side stands in records."""
        config = self.config_of(side.case, side.spp)
        method = self.method(side.case, config, side.spp, known=False, reference=False)
        return method if side.rate is None else replace(method, label=f"{method.label}, rates x {side.rate:g}")


def at_rate(config: Config, factor: float) -> Config:
    """The experiment with every learning rate, the optimiser's and those of single parameters, times `factor`."""
    optimizer = config.optimizer.model_copy(update={"learning_rate": config.optimizer.learning_rate * factor})
    parameters = [_at_rate(spec, factor) for spec in config.parameters]
    return config.model_copy(update={"optimizer": optimizer, "parameters": parameters})


def _at_rate(spec: ParameterSpec, factor: float) -> ParameterSpec:
    rate: Any = spec.learning_rate
    if rate is None:  # the optimiser's
        return spec
    if isinstance(rate, ByWord):
        rate = rate.model_copy(update={word: value * factor for word, value in rate.words().items()})
    else:
        rate = rate * factor
    return spec.model_copy(update={"learning_rate": rate})
