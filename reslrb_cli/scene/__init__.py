"""Scenes: loading, what they contain and need, the parameters that can be recovered, and images to compare with."""

from .catalog import ParameterInfo, list_parameters
from .graph import SceneGraph
from .inspect import SceneSummary, SensorSummary, summarise
from .load import load_scene
from .needs import SceneNeeds, View, check_camera_paths, check_supported, look, scene_needs, stock_clip
from .parameters import select_parameters, set_values
from .reach import visible_texels
from .selection import Selection
from .target import Photo, check_photo, read_image, read_photo, read_weights, turned_line

__all__ = [
    "ParameterInfo",
    "Photo",
    "SceneGraph",
    "SceneNeeds",
    "SceneSummary",
    "Selection",
    "SensorSummary",
    "View",
    "check_camera_paths",
    "check_photo",
    "check_supported",
    "list_parameters",
    "load_scene",
    "look",
    "read_image",
    "read_photo",
    "read_weights",
    "scene_needs",
    "select_parameters",
    "set_values",
    "stock_clip",
    "summarise",
    "turned_line",
    "visible_texels",
]
