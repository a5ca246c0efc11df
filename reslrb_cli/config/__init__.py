"""The configuration: one YAML file is one experiment. Knows no Mitsuba."""

from .integrators import Integrator, Prb, Ptracer, Reslrb, Trajectory, WalkAd
from .loader import dump, load, loads, with_integrator
from .losses import L1, L2, LogL2, Loss, RelativeL2
from .moving import HEIGHTMAP, WORDS, HeightmapSpec, MotionSpec
from .optimizers import SGD, Adam, AdamW, Optimizer, RMSProp
from .parameters import ColorSpace, ImageFile, ParameterSpec, RunValue, Settings
from .schema import Config, Rendering, RunConfig, SceneConfig, TargetConfig
from .views import Mask, ViewSpec

__all__ = [
    "HEIGHTMAP",
    "L1",
    "L2",
    "SGD",
    "WORDS",
    "Adam",
    "AdamW",
    "ColorSpace",
    "Config",
    "HeightmapSpec",
    "ImageFile",
    "Integrator",
    "LogL2",
    "Loss",
    "Mask",
    "MotionSpec",
    "Optimizer",
    "ParameterSpec",
    "Prb",
    "Ptracer",
    "RMSProp",
    "RelativeL2",
    "Rendering",
    "Reslrb",
    "RunConfig",
    "RunValue",
    "SceneConfig",
    "Settings",
    "TargetConfig",
    "Trajectory",
    "ViewSpec",
    "WalkAd",
    "dump",
    "load",
    "loads",
    "with_integrator",
]
