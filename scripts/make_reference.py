"""Write the references: docs/config.schema.json and docs/config.md from the schema, and the end of docs/python.md.

Run `python scripts/make_reference.py [FOLDER]` after every change of the schema or of public names. A test checks that
the references match the code.
"""

from __future__ import annotations

import inspect
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pydantic import BaseModel

# Sections defined from here on take their descriptions from docstrings. A run does not need them: pydantic reads the
# source of every section for them, which costs each start 0.05 s.
BaseModel.model_config["use_attribute_docstrings"] = True

import reslrb_cli  # noqa: E402
from reslrb_cli.config.schema import Config  # noqa: E402

DOCS = Path(__file__).resolve().parents[1] / "docs"

#: The example of the reference page.
EXAMPLE = (DOCS.parent / "configs" / "cornell_floor.yaml").read_text(encoding="utf-8")

_HEAD = """\
# Configuration

<!-- Written by `python scripts/make_reference.py` from reslrb_cli/config; edit the descriptions there. -->

One YAML file describes one experiment. Unknown keys are errors. Paths are relative to the YAML file, except
`run.output`, which is relative to the working directory. All paths must be regular files, not pipes or devices.

The file is read as YAML 1.2. `1e-3` is a number, and `yes` and `no` are text. Put quotes around text that begins with
`*`, `&`, `!`, `%`, `@` or a brace, as in `key: "*.data"`.

[config.schema.json](config.schema.json) contains the same reference as JSON Schema, for editors.

On the command line, `--set KEY=VALUE` changes a value. VALUE is YAML as well. If a key is set twice, the last value
counts.

    --set run.spp=64 --set parameters[0].bounds=[0,1] --set 'integrator={type: prb}'
    --set target.render.parameters.floor.reflectance.value=[0.2,0.4,0.6]
    --set 'parameters[0].key="*.reflectance.data"'

The names in `scene.options` and `target.render.parameters` may contain dots. If a section has options that its new
`type` does not have, replace the whole section.

## Example
"""


def json_schema() -> dict[str, Any]:
    """Return the JSON Schema of a configuration file."""
    schema = _tidied(Config.model_json_schema())
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "reslrb configuration", **schema}


def _tidied(node: Any) -> Any:
    """Return a schema without titles. Descriptions of keys come from docstrings and are put on one line."""
    if isinstance(node, list):
        return [_tidied(item) for item in node]
    if not isinstance(node, dict):
        return node
    # a property may be called `title`; its value is then a mapping, not text
    tidied = {k: _tidied(v) for k, v in node.items() if not (k == "title" and isinstance(v, str))}
    for value in tidied.get("properties", {}).values():
        value["description"] = " ".join(value["description"].split())
    return tidied


def markdown() -> str:
    """Return the text of docs/config.md."""
    schema = json_schema()
    lines = [_HEAD, "```yaml", EXAMPLE.rstrip(), "```", "", "## Top level", "", *_table([schema])]
    for key, value in schema["properties"].items():
        lines += _section(key, value, schema["$defs"])
    return "\n".join(lines) + "\n"


# --- sections ---------------------------------------------------------------------------------------------------------


def _section(name: str, value: dict[str, Any], defs: dict[str, Any], level: int = 2) -> Iterator[str]:
    """Yield the lines of the section that `value` describes and of the sections below it. Yield nothing if `value`
    describes no section.
    """
    members = _members(value, defs)
    if not members:
        return
    yield from ("", f"{'#' * level} `{name}`", "")
    if len(members) == 1:
        yield from (members[0]["description"], "")
    else:
        default = members[0]["properties"]["type"]["const"]
        named = all("type" in member.get("required", ()) for member in members)
        yield from (
            "Choose one of these types." if named else f"Choose one of these types. The default is `{default}`.",
            "",
        )
        yield from (f"- `{m['properties']['type']['const']}`: {m['description']}" for m in members)
        yield ""
    yield from _table(members)
    children = {key: child for member in reversed(members) for key, child in member["properties"].items()}
    for key, child in children.items():
        if _has_own_section(name, key):
            yield from _section(f"{name}.{key}", child, defs, level + 1)


def _has_own_section(name: str, key: str) -> bool:
    """Return whether the section of a key of the section `name` has its own heading. The type of other keys describes
    their sections. `target.render.integrator` equals `integrator`, and the response of a view that of `target`.
    """
    return (name, key) == ("target", "response") or key in (
        "render",
        "heightmap",
        "motion",
        "mask",
        "regularizers",
        "white_balance",
    )


def _members(value: dict[str, Any], defs: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the definitions that `value` refers to. The reference may be direct, in a union, in the items of a list,
    or beside null.
    """
    if "$ref" in value:
        return [defs[value["$ref"].rsplit("/", 1)[1]]]
    if value.get("type") == "array":
        return _members(value["items"], defs)
    found = [m for option in (*value.get("oneOf", ()), *value.get("anyOf", ())) for m in _members(option, defs)]
    return list({id(member): member for member in found}.values())  # one, or a list of such


def _table(members: list[dict[str, Any]]) -> Iterator[str]:
    """Yield the lines of a table of the members' keys. If only some members have a key, its row names these members."""
    yield "| key | type | default | meaning |"
    yield "|---|---|---|---|"
    rows: dict[tuple[str, str], tuple[dict[str, Any], bool, list[str]]] = {}  # by key and meaning
    for member in members:
        for key, value in member["properties"].items():
            if key == "type" and len(members) > 1:
                continue
            has = rows.setdefault((key, value["description"]), (value, key in member.get("required", ()), []))[2]
            has.append(member["properties"].get("type", {}).get("const", ""))
    for (key, _), (value, required, has) in rows.items():
        only = "" if len(has) == len(members) else f"*Only {', '.join(f'`{name}`' for name in has)}.* "
        default = "**required**" if required else _default(value)
        cells = (f"`{key}`", _type(value), default, only + value["description"])
        yield "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _default(value: dict[str, Any]) -> str:
    default = value.get("default")
    if isinstance(default, dict):
        words = ", ".join(f"{key}: {value:g}" for key, value in default.items() if type(value) in (int, float))
        return f"type `{default['type']}`" if "type" in default else f"`{{{words}}}`" if words else ""
    return "" if "default" not in value else f"`{json.dumps(default) if not isinstance(default, str) else default}`"


# --- types ------------------------------------------------------------------------------------------------------------


#: Sections that are written in the line of their key.
_IN_A_LINE = {
    "ImageFile": "{file, color_space}",
    "RunValue": "{run}",
    "CheckpointEvery": "{iterations} or {seconds}",
    **dict.fromkeys(
        ("MotionInitial", "MotionBounds", "MotionTransform", "MotionRates"), "{translation, x, y, z, rotation, scale}"
    ),
}


def _type(value: dict[str, Any]) -> str:
    """Return a key's type in words, from its JSON Schema."""
    for union in ("oneOf", "anyOf"):
        if union in value:
            names = list(dict.fromkeys(_type(option) for option in value[union]))
            if "number" in names and "integer" in names:
                names.remove("integer")
            if "section" in names:  # a section's own table describes its other types
                names = [name for name in ("section", "list of sections", "text", "null") if name in names]
            return " or ".join(names)
    if "$ref" in value:
        return _IN_A_LINE.get(value["$ref"].rsplit("/", 1)[1], "section")
    if "enum" in value:
        return ", ".join(f"`{name}`" for name in value["enum"])
    if "const" in value:
        return f"`{value['const']}`"
    kind = value.get("type")
    if kind == "array":
        if "prefixItems" in value:
            return "[" + ", ".join(_type(item) for item in value["prefixItems"]) + "]"
        return "list of " + _plural(_type(value["items"]))
    if "patternProperties" in value:
        pairs = value["patternProperties"].items()
        return " or ".join(f"`{{{key.strip('^$')}: {_type(each)}}}`" for key, each in pairs)
    if kind == "object":
        return "mapping from text to " + _type(value["additionalProperties"])
    if kind == "string":
        return "path" if value.get("format") == "path" else "text"
    if kind in ("integer", "number"):
        return kind + _range(value)
    return {"boolean": "true/false"}.get(str(kind), str(kind))


def _plural(name: str) -> str:
    if name.startswith("`"):  # words of which each is one
        return name
    head, *rest = name.split(" ", 1)
    return head + "s" + "".join(f" {part}" for part in rest)


def _range(value: dict[str, Any]) -> str:
    signs = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}
    # the ends of int32 and uint32 say nothing to a reader
    bounds = [f"{sign} {value[key]:g}" for key, sign in signs.items() if key in value and value[key] < 2**31]
    return f" {', '.join(bounds)}" if bounds else ""


# --- Python -----------------------------------------------------------------------------------------------------------

#: Where in docs/python.md what is written by hand ends.
_MARK = "## Reference\n"

#: The names in their order; what else is public comes behind them.
_FIRST = ("load", "optimize", "Run", "Record", "render", "gradient", "gradcheck", "convergence", "bench", "export")

#: Of these, what is below them stands elsewhere.
_ELSEWHERE = {"Config": "Its sections are its attributes: `config.run.iterations` ([Configuration](config.md))."}

_PYTHON = f"""\
{_MARK}
<!-- From here on written by `python scripts/make_reference.py` from docstrings; edit these. -->

The signatures use these types:

- `Experiment`: any argument that `load` accepts
- `Folder`: a path as text or as a `Path`
- `Array`: a NumPy array of float32
- `Loss`: a function as described at `optimize`
- `Objective`: a function of an image
- `Scene`: a dictionary as for `mi.load_dict`, or an `mi.Scene`

`GradcheckRecord` and `Line` have one attribute for each field of a `--json` line. Their method `to_json()` returns
that line.
"""


def python_reference() -> str:
    """Return the end of docs/python.md: all public names with their signatures and docstrings."""
    public = [name for name in reslrb_cli.__all__ if not name.startswith("_")]
    names = [*_FIRST, *(name for name in public if name not in _FIRST)]
    things = {name: getattr(reslrb_cli, name) for name in names}
    things["torch.render"] = things.pop("torch").render  # of the module
    return "\n".join([_PYTHON, *("\n".join(_described(name, thing)) for name, thing in things.items())])


def _described(name: str, thing: Any) -> Iterator[str]:
    """Yield the lines about one public name."""
    yield from (f"### `{name}`", "")
    if inspect.isclass(thing):
        yield from (_text(thing), "")
        if name in _ELSEWHERE:
            yield from (_ELSEWHERE[name], "")
            return
        if issubclass(thing, Exception):
            return
        for field, kind in _fields(thing).items():
            yield f"- `{field}: {kind}`"
        yield from [""] if _fields(thing) else []
        for member, value in vars(thing).items():
            if member.startswith("_") or not (inspect.isfunction(value) or isinstance(value, property)):
                continue
            function = value.fget if isinstance(value, property) else value
            if function.__doc__ is None:  # its base class describes it
                continue
            shown = _signature(member, function, method=True)
            if isinstance(value, property):
                shown = f"{member}: {function.__annotations__['return']}"
            yield from (f"**`{name}.{shown}`**", "", _text(function), "")
    else:
        yield from ("```text", _signature(name, thing), "```", "", _text(thing), "")


def _fields(thing: Any) -> dict[str, str]:
    """Return the names of a dataclass's fields and their types in words."""
    found = getattr(thing, "__dataclass_fields__", {})
    return {
        name: str(each.type).replace("Figure", "float")
        for name, each in found.items()
        if not (name.isupper() or name[0] == "_")
    }


def _signature(name: str, function: Any, method: bool = False) -> str:
    """Return the signature on one line. A long signature of a function has one line for each argument."""
    signature = inspect.signature(function)
    parameters = []
    for each in list(signature.parameters.values())[method:]:
        default = "" if each.default is inspect.Parameter.empty else f" = {each.default!r}"
        stars = {inspect.Parameter.VAR_POSITIONAL: "*", inspect.Parameter.VAR_KEYWORD: "**"}.get(each.kind, "")
        parameters.append(f"{stars}{each.name}: {each.annotation}{default}")
    end = f") -> {signature.return_annotation}"
    line = f"{name}({', '.join(parameters)}{end}"
    return line if len(line) <= 100 or method else "\n".join([f"{name}(", *(f"    {p}," for p in parameters), end])


def _text(thing: Any) -> str:
    return re.sub(r"\n{3,}", "\n\n", inspect.getdoc(thing) or "")


def python_page(before: str) -> str:
    """Return the new text of docs/python.md: the handwritten part of the current text `before`, and the new
    reference.
    """
    return before.partition(_MARK)[0].rstrip() + "\n\n" + python_reference().rstrip() + "\n"


def write(folder: Path = DOCS) -> None:
    """Write the reference files into `folder`."""
    schema = json.dumps(json_schema(), indent=2, ensure_ascii=False) + "\n"
    (folder / "config.schema.json").write_text(schema, encoding="utf-8")
    (folder / "config.md").write_text(markdown(), encoding="utf-8")
    before = (DOCS / "python.md").read_text(encoding="utf-8")
    (folder / "python.md").write_text(python_page(before), encoding="utf-8")


if __name__ == "__main__":
    write(*(Path(argument) for argument in sys.argv[1:2]))
