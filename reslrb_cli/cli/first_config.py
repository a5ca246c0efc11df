"""The text of a configuration for a scene, to begin with: what is set, what could be, and why, in comments."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap

from reslrb_cli.errors import printable
from reslrb_cli.scene.catalog import Value
from reslrb_cli.scene.depth import Depth
from reslrb_cli.scene.proposal import Proposal

#: Pixels with which a run takes minutes on two cores, at the samples below.
PIXELS = 2**14
SPP, ITERATIONS, RATE = 16, 200, 0.03
#: The same with a parameter that has no upper bound, of which rates are shares: it and what it shines on are told apart
#: in many steps.
UNBOUNDED_ITERATIONS, UNBOUNDED_RATE = 300, 0.1
#: Commented lines of parameters; a scene can have thousands.
_MOST_OTHERS = 60
#: Variables and sensors that a comment names, and characters of a variable there.
_MOST_VARIABLES, _MOST_SENSORS, _LONGEST = 8, 6, 40
#: Columns of a comment of several lines.
_COMMENT = 110
_NUMBER = re.compile(r"-?\d{1,15}(\.\d{1,15})?")
_PLAIN = re.compile(r"(\.\./)*[A-Za-z_][\w.\-]*(/[\w.\-]+)*")


@dataclass(frozen=True)
class FirstConfig:
    """What a configuration is written from; `target` is the image that exists, or None. Sizes are (width, height).

    `options` are the scene file's variables that the user has set, `variables` all that it has, as text; `sensors` the
    ids of its sensors, of which the one with the index `sensor` is used; `reason` says why the integrator is not
    `reslrb`, None where it is.
    """

    scene: Path
    options: Mapping[str, bool | int | float | str]
    variables: Mapping[str, str]
    sensors: Sequence[str]
    sensor: int
    target: Path | None
    is_integer: bool
    size: tuple[int, int]
    film: tuple[int, int]
    integrator: str
    reason: str | None
    hides_emitters: bool
    depth: Depth
    proposals: Sequence[Proposal]

    def text(self, path: Path) -> str:
        """The YAML of the configuration in the file `path`."""
        folder = path.absolute().parent
        lines = [
            "# Every setting and its default: docs/config.md. Begin with",
            f"#     reslrb optimize {path.name}",
            "scene:",
            f"  file: {_path(self.scene, folder)}",
            *self._option_lines(),
            *self._size_lines(),
            *self._sensor_lines(),
            "target:",
            *self._target_lines(folder),
            "parameters:  # by their share of the picture; bounds are the usual ones",
            *self._parameter_lines(),
            "integrator:",
            *self._reason_lines(),
            f"  type: {self.integrator}",
            f"  max_depth: {self.depth.segments}  # {self._depth_words()}; depth costs time alone, no memory",
            *(["  hide_emitters: true  # as the scene's own integrator has it"] if self.hides_emitters else []),
            "loss:",
            "  type: relative_l2  # by l2 the noise of the brightest parts would drown what the others say",
            "optimizer:",
            *self._step_lines(),
            "  schedule: cosine  # to next to nothing, so that the noise of the last iterations counts little",
            "run:",
            f"  iterations: {UNBOUNDED_ITERATIONS if self._is_scaled else ITERATIONS}",
            f"  spp: {SPP}",
        ]
        return "\n".join(lines) + "\n"

    def _reason_lines(self) -> list[str]:
        if self.reason is None:
            return []
        words = f"by paths from the sensor, since light paths cannot render this: {printable(self.reason)}"
        return wrap(words, _COMMENT, initial_indent="  # ", subsequent_indent="  # ", break_long_words=False)

    def _step_lines(self) -> list[str]:
        """The size of steps: between bounds it is known beforehand, of a lamp it has to be measured."""
        if not self._is_scaled:
            return [f"  learning_rate: {RATE}  # by so much a value moves in an iteration, at first"]
        return [
            "  scale: auto  # a lamp may be of any brightness: in what units each parameter moves is measured first",
            f"  learning_rate: {UNBOUNDED_RATE}  # by so much of its unit a value moves in an iteration, at first",
        ]

    @property
    def _is_scaled(self) -> bool:
        """Whether steps have to be measured: something that may be of any size is to begin with."""
        return any(item.first and not item.is_bounded for item in self.proposals)

    @property
    def _has_exposure(self) -> bool:
        """Whether one is recovered; beside a lamp, which it could not be told from, it is not."""
        return self.is_integer and not any(item.first and item.info.kind == "emitter" for item in self.proposals)

    def _depth_words(self) -> str:
        missing = self.depth.missing
        return "light bounces on and on" if missing is None else f"longer paths have {missing:.1%} of the light in view"

    def _option_lines(self) -> list[str]:
        given = ", ".join(f"{_word(name)}: {json.dumps(value)}" for name, value in self.options.items())
        others = [
            f"{_word(name)}: {_word(self.variables[name])}" for name in self.variables if name not in self.options
        ]
        listed = [text for text in others if len(text) <= _LONGEST][:_MOST_VARIABLES]
        rest = ", ".join([*listed, "..."] if len(listed) < len(others) else listed)
        if given:
            return [f"  options: {{{given}}}" + (f"  # the scene file also has {rest}" if rest else "")]
        return [f"  # options: {{{rest}}}  # variables of the scene file, and what they are there"] if rest else []

    def _sensor_lines(self) -> list[str]:
        if len(self.sensors) == 1:
            return []
        listed = [f"{number} is {_word(name)}" for number, name in enumerate(self.sensors[:_MOST_SENSORS])]
        more = " ..." if len(self.sensors) > _MOST_SENSORS else ""
        return [
            f"  sensors: [{self.sensor}]  # {', '.join(listed)}{more}; `views` take several, each with its photograph"
        ]

    def _size_lines(self) -> list[str]:
        if self.size == self.film:
            return []
        width, height = self.film
        note = f"runs in minutes; the scene's own film has {width}x{height}"
        return [f"  size: {list(self.size)}  # {note}"]

    def _target_lines(self, folder: Path) -> list[str]:
        if self.target is not None:
            return [f"  file: {_path(self.target, folder)}", *self._exposure_lines()]
        width, height = self.size
        return [
            f"  file: photo.png  # put your photograph there, of {width}x{height} pixels, or have it made by",
            "  # reslrb init --target PHOTO from one of any size in that ratio. To try without, in place of `file`:",
            "  # render: {spp: 1024, parameters: {KEY: VALUE}}  # the scene itself with other values",
        ]

    def _exposure_lines(self) -> list[str]:
        """For a photograph: of 8 or 16 bits its exposure is not known. `mask: auto` is the default."""
        if self._has_exposure:
            return ["  exposure: auto  # one factor for the whole image, recovered beside the parameters"]
        return [
            "  # exposure: auto  # one factor for the whole image; the lamps below make up for it"
        ] * self.is_integer

    def _parameter_lines(self) -> list[str]:
        first = [proposal for proposal in self.proposals if proposal.first]
        others = [proposal for proposal in self.proposals if not proposal.first]
        lines = [f"  - {_entry(proposal, True)}  # {_note(proposal)}" for proposal in first]
        if others:
            lines.append("  # What else can be recovered; take away the # of what is to be:")
        lines += [f"  # - {_entry(item, self._is_scaled)}  # {_note(item)}" for item in others[:_MOST_OTHERS]]
        if len(others) > _MOST_OTHERS:
            lines.append(f"  # and {len(others) - _MOST_OTHERS} more, as reslrb inspect --all lists them")
        return lines


def _entry(proposal: Proposal, is_scaled: bool) -> str:
    """What has no upper bound has a rate of its own where steps are not measured."""
    parts = [f"key: {_text(proposal.info.key)}"]
    parts += [f"bounds: {proposal.bounds}"] if proposal.bounds is not None else []
    parts += [f"resolution: {list(proposal.resolution)}"] if proposal.resolution is not None else []
    size = 0.0 if proposal.info.value is None else abs(proposal.info.value.mean)
    if size and not (is_scaled or proposal.is_bounded):
        parts.append(f"learning_rate: {float(f'{UNBOUNDED_RATE * size:.2g}')}")
    return "{" + ", ".join(parts) + "}"


def _note(proposal: Proposal) -> str:
    info = proposal.info
    seen = f"{100 * proposal.share:.0f} % of the picture" if proposal.share >= 0.005 else "not seen itself"
    size = f", {info.shape[1]}x{info.shape[0]} texels" if len(info.shape) == 3 else ""
    return f"{seen}{size}{_value(info.value)}" + (f", {info.remark}" if info.remark is not None else "")


def _value(value: Value | None) -> str:
    if value is None:
        return ""
    if value.numbers is not None:
        return f", {'now ' + ' '.join(f'{number:.3g}' for number in value.numbers)}"
    return f", {value.low:.3g} to {value.high:.3g}"


def _path(path: Path, folder: Path) -> str:
    relative = os.path.relpath(path, folder)
    # What lies elsewhere altogether does not move with the configuration.
    return _text(str(path.absolute()) if relative.startswith(os.path.join("..", "..", "..")) else relative)


def _word(text: str) -> str:
    """A name or a value of the scene file within a comment, where no character may end the line."""
    return text if _PLAIN.fullmatch(text) or _NUMBER.fullmatch(text) else json.dumps(text)


def _text(text: str) -> str:
    return text if _PLAIN.fullmatch(text) else json.dumps(text, ensure_ascii=False)
