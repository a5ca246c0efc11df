"""The configuration: one YAML file is one experiment. Knows no Mitsuba."""

from .choices import (
    L1,
    L2,
    SGD,
    Adam,
    AdamW,
    Integrator,
    LogL2,
    Loss,
    Optimizer,
    Prb,
    Ptracer,
    RelativeL2,
    Reslrb,
    RMSProp,
    WalkAd,
)
from .loader import dump, load
from .schema import ColorSpace, Config, ImageFile, ParameterSpec, Rendering, RunConfig, SceneConfig, TargetConfig

__all__ = [
    "L1",
    "L2",
    "SGD",
    "Adam",
    "AdamW",
    "ColorSpace",
    "Config",
    "ImageFile",
    "Integrator",
    "LogL2",
    "Loss",
    "Optimizer",
    "ParameterSpec",
    "Prb",
    "Ptracer",
    "RMSProp",
    "RelativeL2",
    "Rendering",
    "Reslrb",
    "RunConfig",
    "SceneConfig",
    "TargetConfig",
    "WalkAd",
    "dump",
    "load",
]
