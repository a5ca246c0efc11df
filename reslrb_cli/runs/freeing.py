"""Recovery of further parameters: the experiment of a run or of a configuration, with more entries of `parameters`."""

from __future__ import annotations

import re
from collections.abc import Sequence

import yaml

from reslrb_cli.config.parameters import ParameterSpec
from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ConfigError
from reslrb_cli.optimization.loading import load_configured
from reslrb_cli.scene.catalog import describe, owner_of
from reslrb_cli.scene.parameters import select_parameters
from reslrb_cli.scene.proposal import usual_bounds


def with_freed(config: Config, keys: Sequence[str], source: str) -> Config:
    """Return the experiment that also recovers the scene's parameters `keys`, within their usual bounds. They start at
    the values of the scene. A variant must be set.

    Raises a ConfigError, located by `source`, for a key that the scene does not have, that cannot be recovered, or that
    the experiment recovers already.
    """
    if wrong := [key for key in keys if not isinstance(key, str) or not key]:
        raise ConfigError(source, "", f"is {wrong[0]!r}; give a key that `reslrb inspect` lists")
    keys, count = list(dict.fromkeys(keys)), len(config.parameters)
    if not keys:
        return config
    scene = load_configured(config, keys=keys)
    try:
        specs = [*config.parameters, *(ParameterSpec(key=key) for key in keys)]
        params = select_parameters(scene, specs, config.source).params
    except ConfigError as error:
        place = re.match(r"parameters\[(\d+)\]", error.key)
        if place is None or int(place[1]) < count:
            raise
        raise ConfigError(source, "", error.message) from None
    for key in keys:
        if key not in params.properties:
            raise ConfigError(source, "", f"`{key}` is a glob; name each parameter")
        bounds = usual_bounds(describe(params, key, values=True), owner_of(params, key))
        specs[count + keys.index(key)] = ParameterSpec(
            key=key, bounds=None if bounds is None else yaml.safe_load(bounds)
        )
    return config.model_copy(update={"parameters": specs})
