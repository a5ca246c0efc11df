"""Loading of Mitsuba scene files, with errors that say where."""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mitsuba as mi

from ..errors import ConfigError
from .extent import lost_light

logger = logging.getLogger(__name__)

#: "[parser.cpp:482] " and "[PluginManager] ": where in Mitsuba's sources a message comes from.
_ORIGIN = re.compile(r"\[[\w.]+(:\d+)?\]\s*")
#: "At scene.xml (line 3, col 7): " and the like, before the message proper.
_PLACE = re.compile(r"\(line (\d+), col (\d+)\)")
_PREAMBLE = re.compile(r"^(At|Error while loading|While loading) .*?\(line \d+, col \d+\):? ?")


def load_scene(file: Path, options: Mapping[str, Any] | None = None) -> Any:
    """Load a Mitsuba scene (XML, versions 0.5 to 3); a variant must be set.

    `options` are the values of the file's `$name` variables. Shapes are not merged, so that all parameters keep their
    names. Returns a `mi.Scene`. Raises ConfigError, located in the scene file, where it is missing or wrong, has
    nothing in it, or no light. Warns, in the log, of one that is too far from the origin, or too small.
    """
    file = Path(file)
    try:
        with file.open("rb"):
            pass
    except IsADirectoryError:
        raise ConfigError(file, "", "is a folder, not a Mitsuba scene file (XML)") from None
    except OSError as error:
        raise ConfigError(file, "", f"cannot be read: {error.strerror}") from None
    values = {name: _as_text(value) for name, value in (options or {}).items()}
    try:
        scene = mi.load_file(str(file), optimize=False, **values)
    except Exception as error:
        raise _located(file, str(error)) from None
    if not isinstance(scene, mi.Scene):
        raise ConfigError(file, "", "its root is a single object, not a <scene>")
    if len(scene.shapes()) == 0:
        raise ConfigError(file, "", "the scene is empty: it has no shapes")
    if len(scene.emitters()) == 0:
        raise ConfigError(file, "", "the scene has no emitters: no light path can start")
    if len(scene.sensors()) == 0:
        raise ConfigError(file, "", "the scene has no sensor")
    loss = lost_light(scene)
    if loss is not None:
        logger.warning("%s: %s", file, loss)
    return scene


def _as_text(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def _located(file: Path, message: str) -> ConfigError:
    """Mitsuba's message as one located line, without the places in Mitsuba's own sources."""
    place = _PLACE.search(message)
    source = f"{file}:{place[1]}" if place else str(file)
    text = _ORIGIN.sub("", message)
    undefined = re.search(r"undefined parameter: \$(\w+)", text)
    if undefined:
        name = undefined[1]
        return ConfigError(source, f"${name}", f"has no value and no default; set scene.options.{name}")
    unused = re.findall(r"- \$(\w+)=", text) if "unused parameters" in text else []
    if unused:
        names = ", ".join(f"${name}" for name in unused)
        return ConfigError(source, names, "is set in scene.options, but the scene file does not use it")
    if "XML" in text and "failed:" in text:
        text = "not valid XML: " + _PLACE.sub("", text.split("failed:", 1)[1]).strip()
    text = _PREAMBLE.sub("", text.strip())
    return ConfigError(source, "", text)
