"""Nearly correct configurations. Each comes from a correct configuration by changes of its text or data, and
may have `--set` overrides.
"""

from __future__ import annotations

import copy
import json
import random
from collections.abc import Sequence
from typing import Any

import yaml
from make_reference import DOCS

from reslrb_cli.config.yaml_text import parse
from reslrb_cli.errors import ConfigError

#: Configuration with every section and every kind of value.
FULL = """\
variant: llvm_ad_rgb
scene: {file: scene.xml, options: {resx: 64, fast: true, scale: 1e-3, text: "1e-3", no: no}}
target: {response: {curve: [1, 1, .9, 1.5, 2, 6e0]}}
views: [{sensor: 2, target: t0.exr}, {sensor: 0, target: /abs/t1.png, mask: w.png, response: {gamma: auto}}]
parameters:
  - {key: "*.reflectance.data", initial: 1, bounds: [-.inf, 1E0], learning_rate: 5e-2, resolution: [64, 32]}
  - {key: white.reflectance.value, initial: [.5, +0.5, 1], bounds: [0, .inf], transform: log}
  - {key: floor.data, initial: {file: floor.png, color_space: srgb}}
integrator: {type: reslrb, max_depth: -1, rr_depth: 3, hide_emitters: true, estimator: event, capacity: 2}
loss: {type: relative_l2, epsilon: 1e-3}
optimizer: {type: adam, learning_rate: 1e-1, schedule: cosine, final_fraction: 1e-2, beta_1: 0, scale: none}
run: {name: "Fläche: rot/blau", output: out, iterations: 3, spp: 16, adjoint: batched, batches: 4}
"""
RENDERED = """\
scene: &s {file: a.xml}
target: {render: {parameters: {a.b: 1e-3, c: {file: x.exr}}, spp: 4, integrator: &i {type: ptracer}}}
parameters: [{key: c}]
integrator: {<<: *i, samples_per_pass: 8}
"""
#: Texts that no setting expects, as they stand in a file, separated by `¦`.
TOKENS = (
    *r"""1e400¦-1e400¦.nan¦.inf¦-.inf¦1e-400¦-0¦18446744073709551615¦18446744073709551616¦2147483648¦0o777¦1_000¦1:30¦~
null¦true¦yes¦''¦""¦"\ud800"¦"\udcff\e[31m"¦"\0"¦"\x9b2J"¦"\u202e"¦../x¦/abs¦~nobody-here/x¦con¦..¦.¦/¦\¦C:\x¦名前¦$x
!!python/object:os.system x¦!!binary x¦!!set {a}¦!!omap [a: 1]¦!!timestamp 2001-01-01¦!!bool x¦!!int x¦!!float x¦!!str
!!str [a]¦!!map []¦!!seq {}¦!!null x¦!!merge x¦!!value x¦!x¦!<tag:x> y¦&a¦*a¦&a [*a]¦&a {x: *a}¦*s¦*i¦<<¦<<: *i¦<<: 3
<<: [*i, *i]¦? [a]¦? {a: 1}¦?¦:¦-¦[¦]¦{¦}¦,¦|¦>¦|9¦%YAML 3¦---¦...¦@x¦`x¦#¦<script>¦[key]¦__class__¦type¦{type: [a]}
{type: {a: 1}}¦{type: 3}¦'¦"¦*.data¦%d¦{0}""".replace("\n", "¦").split("¦"),
    *("0x" + "f" * 5000, "9" * 400, "-" + "9" * 30, "a" * 300, "ü" * 150, "[" * 30, "{a: " * 30, "[" * 3000),
    *("\t", "\r", "\x01", "\x7f", "\x85", "\u202e", "\u2028", "\ufeff"),
)
#: Values that no setting expects, as JSON data.
VALUES = (
    *r"""null¦true¦0¦-1¦10000000000000000000000000¦18446744073709551616¦1e308¦NaN¦Infinity¦""¦" "¦"\u001b[31m"¦"\ud800"
"a\u0000b"¦"scene"¦"all"¦"../../x"¦[]¦{}¦[[]]¦{"file": "x"}¦{"type": "reslrb"}¦{"type": null}¦{"<x>": 1, "[key]": 2}
{"1": 2}¦{"": ""}¦{"null": 1}¦{"\u001b[2J": 1}""".replace("\n", "¦").split("¦"),
    *("[" * 30 + "]" * 30, '{"a": [' * 7 + "]}" * 7),
)


def good_texts() -> list[str]:
    """Return the shipped configurations, which include the reference's example, and two configurations with all kinds
    of settings.
    """
    shipped = sorted((DOCS.parent / "configs").rglob("*.yaml"))
    return [FULL, RENDERED, *(path.read_text(encoding="utf-8") for path in shipped)]


def mutate(rng: random.Random, texts: Sequence[str]) -> tuple[bytes, list[str]]:
    """Return the bytes of a configuration, and overrides. Most results have an error somewhere."""
    text, overrides = rng.choice(texts), []
    for _ in range(rng.choice((0, 1, 1, 1, 1, 1, 2, 4))):
        [change] = rng.choices((_as_text, _as_data), (1, 2))
        text = change(rng, text)
    for _ in range(rng.choice((0, 0, 0, 0, 1, 1, 2, 5))):
        overrides.append(_override(rng))
    data = text.encode("utf-8", "surrogatepass")
    if rng.random() < 0.05:
        position = rng.randrange(len(data) + 1)
        data = data[:position] + rng.randbytes(rng.choice((1, 2, 40))) + data[position + rng.choice((0, 1, 40)) :]
    return data, overrides


def _as_text(rng: random.Random, text: str) -> str:
    start = rng.randrange(len(text) + 1)
    end = min(len(text), start + rng.choice((0, 1, 3, 20, 200)))
    kind = rng.randrange(6)
    if kind == 0:
        return text[:start] + text[end:]
    if kind == 1:
        return text[:end] + text[start:end] * rng.choice((1, 2, 300)) + text[end:]
    if kind == 2:
        return text[:start] + rng.choice(TOKENS) + text[end:]
    if kind == 3:
        return text[:start]
    lines = text.splitlines(keepends=True)
    if kind == 4:
        rng.shuffle(lines)
    elif lines:
        i = rng.randrange(len(lines))
        lines[i] = rng.choice((" ", "  ", "\t", "- ", "")) + rng.choice((lines[i], lines[i].lstrip(), lines[i] * 2))
    return "".join(lines)


def _as_data(rng: random.Random, text: str) -> str:
    try:
        data = copy.deepcopy(parse(text, "x"))
    except ConfigError:
        return text
    for _ in range(rng.choice((1, 1, 2, 4))):
        places = list(_places(data))
        if not places:
            break
        container, key = rng.choice(places)
        kind = rng.randrange(5)
        if kind == 0 and isinstance(container, dict):
            name = rng.choice(("spp", "type", "file", "<x>", "[key]", "\x1b[2J", f"{key}x"))
            container[name] = container.pop(key)
        elif kind == 1:
            other, where = rng.choice(places)
            if _depth(other) < 8:
                container[key] = json.loads(json.dumps(other[where], default=str))
        elif kind == 2 and isinstance(container, list):
            container.append(container[key])
        else:
            container[key] = json.loads(rng.choice(VALUES))
    if rng.random() < 0.5:
        return json.dumps(data, default=str)
    return str(
        yaml.safe_dump(data, default_flow_style=rng.choice((True, False, None)), allow_unicode=rng.random() < 0.5)
    )


def _places(data: Any) -> Any:
    """Yield places in the data: a list or mapping, and one of its indices or keys. Stop after some hundreds of
    places.
    """
    waiting, count = [data], 0
    while waiting and count < 300:
        value = waiting.pop()
        for key in list(value) if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ():
            yield value, key
            count += 1
            if isinstance(value[key], (dict, list)):
                waiting.append(value[key])


def _depth(data: Any) -> int:
    children = data.values() if isinstance(data, dict) else data if isinstance(data, list) else ()
    return 1 + max(map(_depth, children), default=0)


#: Valid overrides.
_OVERRIDES = (
    *("run.spp=16", "run.name=x", "scene.options.a.b=3", "parameters[0].bounds=[0, 1]", "parameters.0.key=a"),
    *("integrator={type: prb}", "parameters[1].key=b", "target={render: {}}", "optimizer.type=sgd", "loss=l1"),
    *("target.render.parameters.x.y={file: a.png}", "views=[{sensor: 1}]", "variant=auto"),
    "run.output=/tmp/x",
)


def _override(rng: random.Random) -> str:
    text = rng.choice(_OVERRIDES)
    key, _, value = text.partition("=")
    kind = rng.randrange(6)
    if kind == 0:
        return f"{key}={rng.choice(TOKENS)}"
    if kind == 1:
        return f"{rng.choice(TOKENS)}={value}"
    if kind == 2:
        return ".".join(["a"] * rng.choice((2, 19, 21, 3000))) + "=1"
    if kind == 3:
        return "parameters" + rng.choice(("[0]" * 30, "[99999999999999999999]", "[-1]", "[x]", "[", "..")) + "=1"
    return _as_text(rng, text)
