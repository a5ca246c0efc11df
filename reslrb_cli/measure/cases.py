"""What a measurement compares: a list such as `ptracer,reslrb:reservoir(capacity=4)`, and the depths of a bench."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from reslrb_cli.config import Config, Prb, Ptracer, Reslrb, Trajectory, WalkAd, with_integrator
from reslrb_cli.config.integrators import ESTIMATOR_OPTIONS, UNDECIDED
from reslrb_cli.config.text import parse
from reslrb_cli.errors import ConfigError

#: Options that a case takes over from the configuration's integrator, where it knows them.
SHARED = (
    *("rr_depth", "hide_emitters", "samples_per_pass", "attached", "filter_normalization", "attached_sampling"),
    *UNDECIDED,
)
#: The estimator of a case that names none, as that of the plugin.
PLUGIN_ESTIMATOR = "reservoir"
#: Options of a case that are those of `run`, for itself alone.
ADJOINT = ("adjoint", "batches", "first_batch")
_TYPES = {str(kind.model_fields["type"].default): kind for kind in (Reslrb, Ptracer, Prb, WalkAd, Trajectory)}
#: Options that make an estimator another one, in records.
_ESTIMATOR_OPTIONS = {option for options in ESTIMATOR_OPTIONS.values() for option in options} - {"capacity"}
_ESTIMATOR_OPTIONS |= set(UNDECIDED)
_OPTION = "--integrators"
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

        `known`: dL/dI is, before the image, so that `run.adjoint` has no part in it. `auto`: the estimator may be left
        to a pilot, as what is measured has one.
        """
        blame = f"{self.source} {self.label}"
        adjoint = {name: value for name, value in self.options.items() if name in ADJOINT}
        if known and adjoint:
            raise ConfigError(blame, next(iter(adjoint)), "has no effect where dL/dI is known; change --objective")
        if known:
            adjoint = {"adjoint": "independent"}  # which goes with any weight
        shared, own = config.integrator.options(), _TYPES[self.type].model_fields if self.type in _TYPES else {}
        values = {"type": self.type} | {name: shared[name] for name in SHARED if name in shared and name in own}
        # Of the experiment, whose pilot decides it; what is named here has none.
        values = {name: value for name, value in values.items() if name not in UNDECIDED or value != "auto"}
        values |= {name: value for name, value in self.options.items() if name not in ADJOINT}
        if self.type == "reslrb" and values.setdefault("estimator", PLUGIN_ESTIMATOR) == "auto" and not auto:
            raise ConfigError(blame, "estimator", "`auto` measures which to take; name those to compare")
        for option, compared in (("guiding", "`on` with `off`"), ("sequence", "`independent` with `low_discrepancy`")):
            if values.get(option) == "auto" and not auto:
                raise ConfigError(blame, option, f"`auto` measures whether it pays; compare {compared}")
        return with_integrator(config, values | {"max_depth": max_depth}, blame, adjoint)

    @property
    def estimator(self) -> str | None:
        """Name of the estimator, with the options that make it another than the default one, but for `capacity`."""
        if self.type != "reslrb":
            return None
        name = str(self.options.get("estimator", PLUGIN_ESTIMATOR))
        usual = {option: Reslrb.model_fields[option].default for option in _ESTIMATOR_OPTIONS}
        usual |= dict.fromkeys(UNDECIDED, "auto") if name == "auto" else UNDECIDED
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
    return _parse(_split(text), source, "", "integrator; write TYPE[:ESTIMATOR][(OPTION=VALUE,...)]", deep)


def parse_estimators(text: str) -> list[Case]:
    """The cases in a list of estimators of `reslrb`, such as `stack,reservoir(capacity=4)`; raises as `parse_cases`."""
    return _parse(_split(text), "--estimators", "reslrb:", "estimator; write ESTIMATOR[(OPTION=VALUE,...)]", False)


def all_estimators(config: Config) -> list[Case]:
    """Every estimator of `reslrb`; that of the configuration has the options that stand there."""
    cases, own = [], config.integrator
    for name in ESTIMATOR_OPTIONS:
        if name != "auto":
            mine = isinstance(own, Reslrb) and own.estimator == name
            names = [option for option in ESTIMATOR_OPTIONS[name] if mine and option in own.model_fields_set]
            options = {option: getattr(own, option) for option in names}
            text = ",".join(f"{option}={value}" for option, value in options.items())
            label = f"reslrb:{name}({text})" if text else f"reslrb:{name}"
            cases.append(Case(label, "reslrb", {"estimator": name} | options))
    return cases


def _parse(items: list[str], source: str, prefix: str, wanted: str, deep: bool) -> list[Case]:
    cases: list[Case] = []
    for item in items:
        match = _ITEM.fullmatch(prefix + item)
        if match is None or (prefix and not match["estimator"]):
            raise ConfigError(source, "", f"`{item}` is no {wanted}")
        options = {} if match["estimator"] is None else {"estimator": match["estimator"]}
        for pair in _split(match["options"] or "") if match["options"] else []:
            name, equals, value = pair.partition("=")
            if not equals or not name.strip():
                raise ConfigError(source, item, f"`{pair}` must be OPTION=VALUE")
            if name.strip() == "max_depth" and deep:
                raise ConfigError(source, item, "max_depth is what is varied; --max-depth says how far")
            if name.strip() == "max_depth" or (name.strip() in ADJOINT and prefix):
                section = "run" if name.strip() in ADJOINT else "integrator"
                raise ConfigError(source, item, f"all share one {name.strip()}; take --set {section}.{pair}")
            options[name.strip()] = parse(value, f"{source} {item}", name_line=False)
        case = Case(prefix + item, match["type"], options, source)
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


def choose_baseline(cases: Sequence[Case], name: str | None) -> Case:
    """The case that the others are compared with: that of this label, else `ptracer` where it is there, or the first.

    Raises ConfigError where none has the label.
    """
    for case in cases:
        if case.label == name or (name is None and case.type == "ptracer"):
            return case
    if name is not None:
        labels = ", ".join(case.label for case in cases)
        raise ConfigError("--baseline", "", f"`{name}` is none of {labels}")
    return cases[0]


def depths(max_depth: int) -> list[int]:
    """2, 4, 8, ... up to `max_depth`, which comes last."""
    powers = [2**k for k in range(1, max_depth.bit_length()) if 2**k < max_depth]
    return [*powers, max_depth]
