"""Cameras of a file: NeRF's `transforms.json`, and COLMAP's `images.txt` with the `cameras.txt` beside it.

Mitsuba's perspective sensor looks along +z, with x to the left and y up. Its pixels are squares, and its lens has no
distortion. Files with other cameras are refused.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from reslrb_cli.config.files import read_file
from reslrb_cli.errors import ConfigError, one_line
from reslrb_cli.scene.images import image_size
from reslrb_cli.scene.xml.read import Description, Element

#: Maximum relative difference between the focal lengths of rows and columns.
SQUARE = 1e-3

#: COLMAP's models without distortion, and the names of their parameters; `f` is both focal lengths.
MODELS = {"SIMPLE_PINHOLE": ("f", "cx", "cy"), "PINHOLE": ("fx", "fy", "cx", "cy")}

_DISTORTION = re.compile(r"k|[kp]\d|\w*distortion\w*")
#: Camera models of `transforms.json` that are pinholes if their distortion is 0.
_PINHOLES = ("", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "OPENCV", "FULL_OPENCV", "RADIAL", "SIMPLE_RADIAL")
#: Keys of `transforms.json` that give the camera model, and keys that are true for other cameras than pinholes.
_MODELS = ("camera_model", "camera_type", "projection_type", "projection")
_OTHERS = re.compile(r"(is_)?(fisheye|latlong|equirectangular|spherical|panoram\w*|ortho\w*)")
#: From a camera's axes to the sensor's: NeRF (x right, y up, view along -z) and COLMAP (y down, view along +z).
_NERF, _COLMAP = np.diag([-1.0, 1.0, -1.0, 1.0]), np.diag([-1.0, -1.0, 1.0, 1.0])


@dataclass(frozen=True)
class Camera:
    """Camera as a Mitsuba sensor. `focal` and `center` (x, y) are in pixels, and `to_world` is (4, 4)."""

    name: str
    image: Path
    size: tuple[int, int]
    focal: float
    center: tuple[float, float]
    to_world: np.ndarray


def read_cameras(file: Path) -> list[Camera]:
    """Return the cameras of a file, in order. Raises a ConfigError that names the file if entries are missing or
    unsupported.
    """
    cameras = _nerf(file) if file.suffix.lower() == ".json" else _colmap(file)
    if not cameras:
        raise ConfigError(file, "", "has no cameras")
    return cameras


def replace_sensors(description: Description, cameras: list[Camera]) -> None:
    """Replace the sensors of a scene by cameras. The cameras get the filter and the sampler of the scene's first
    sensor.
    """
    root = description.root
    own = [child for child in root.children if child.tag == "sensor"]
    root.children = [child for child in root.children if child.tag != "sensor"]
    taken = {element.id for element in root.walk()}
    for camera in cameras:
        name = sensor_id(camera.name)
        while name in taken:
            name += "_"
        taken.add(name)
        root.children.append(_sensor(own[0] if own else root.new("sensor"), camera, name))


def sensor_id(name: str) -> str:
    """Return the id of the sensor of an image with this `name`, without its suffix. Keys have no dots or dashes."""
    return re.sub(r"\W+", "_", name) or "camera"


def sensor_ids(description: Description) -> list[str]:
    """Return the ids of the sensors directly below the root."""
    return [child.id for child in description.root.children if child.tag == "sensor"]


def repeat_sensors(description: Description, order: Sequence[int]) -> None:
    """Replace the sensors of a scene by one sensor for each entry of `order`, which has indices of the sensors. Further
    copies of a sensor get ids of their own, such as `camera_view2`. Raises IndexError for an index without a sensor.
    """
    root = description.root
    own = [child for child in root.children if child.tag == "sensor"]
    made: list[Element] = []
    for place, index in enumerate(order):
        if not any(own[index] is each for each in made):
            made.append(own[index])
            continue
        copied = _copy(own[index])
        copied.attributes["id"] = f"{own[index].id or 'sensor'}_view{place}"
        made.append(copied)
    root.children = [*(child for child in root.children if child.tag != "sensor"), *made]


def _sensor(like: Element, camera: Camera, name: str) -> Element:
    film = next((child for child in like.children if child.tag == "film"), like.new("film"))
    sizes = [
        like.new("integer", name=key, value=str(n)) for key, n in zip(("width", "height"), camera.size, strict=True)
    ]
    kept = [_copy(child) for child in film.children if not child.name.startswith(("width", "height", "crop"))]
    fov = math.degrees(2 * math.atan(camera.size[0] / (2 * camera.focal)))
    offsets = [
        like.new("float", name=f"principal_point_offset_{axis}", value=repr(offset))
        for axis, center, n in zip("xy", camera.center, camera.size, strict=True)
        if abs(offset := 0.5 - center / n) > 1e-6
    ]
    matrix = like.new("matrix", value=" ".join(repr(float(entry)) for entry in camera.to_world.ravel()))
    clips = ("near_clip", "far_clip", "nearClip", "farClip")
    return like.new(
        "sensor",
        like.new("string", name="fov_axis", value="x"),
        like.new("float", name="fov", value=repr(fov)),
        *offsets,
        like.new("transform", matrix, name="to_world"),
        like.new("film", *sizes, *kept, type=film.type or "hdrfilm"),
        *(_copy(child) for child in like.children if child.tag == "sampler" or child.name in clips),
        type="perspective",
        id=name,
    )


def _copy(element: Element) -> Element:
    """Return a copy of the element for another sensor, without the ids inside it."""
    attributes = {key: value for key, value in element.attributes.items() if key != "id"}
    return element.new(element.tag, *map(_copy, element.children), **attributes)


# --- transforms.json --------------------------------------------------------------------------------------------------


def _nerf(file: Path) -> list[Camera]:
    try:
        data = json.loads(read_file(file))
        frames = [{**data, **frame} for frame in data["frames"]]
    except (ValueError, KeyError, TypeError, RecursionError):
        raise ConfigError(file, "", "is not a transforms.json: a JSON object with a list of `frames`") from None
    return [_frame(file, f"frames[{number}]", frame) for number, frame in enumerate(frames)]


def _frame(file: Path, key: str, frame: Mapping[str, Any]) -> Camera:
    if not isinstance(frame.get("file_path"), str) or not frame["file_path"]:
        raise ConfigError(file, f"{key}.file_path", "must name the camera's image")
    for name, value in frame.items():
        is_other = name in _MODELS and str(value or "").upper() not in _PINHOLES
        if is_other or (value and _OTHERS.fullmatch(name.lower())):
            reason = f"is {one_line(str(value), 40)}; only pinhole cameras are supported: undistort the images"
            raise ConfigError(file, f"{key}.{name}", reason)
        if _DISTORTION.fullmatch(name.lower()) and np.any(np.array(value, dtype=object) != 0):
            what = f"has distortion ({name} = {value}), which Mitsuba's sensors lack"
            raise ConfigError(file, key, f"{what}; undistort the images")
    try:
        matrix = np.array(frame["transform_matrix"], dtype=np.float64)
    except (KeyError, ValueError, TypeError):
        matrix = np.zeros(0)
    if matrix.shape not in ((4, 4), (3, 4)) or not np.isfinite(matrix).all():
        raise ConfigError(file, f"{key}.transform_matrix", "must be four rows of four numbers, from camera to world")
    to_world = np.vstack([matrix[:3], [0, 0, 0, 1]]) @ _NERF
    image = file.parent / frame["file_path"]
    if not image.suffix and not image.exists():  # Blender's files omit the suffix
        image = image.with_suffix(".png")
    names = ("w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x")
    w, h, fx, fy, cx, cy, angle = (_number(file, f"{key}.{name}", frame.get(name)) for name in names)
    width, height = (int(w), int(h)) if w and h else image_size(image)
    focal = fx or (width / (2 * math.tan(angle / 2)) if angle else None)
    if focal is None:
        raise ConfigError(file, f"{key}.fl_x", "missing, and so is `camera_angle_x`")
    _check_square(file, key, focal, fy or focal)
    return Camera(image.stem, image, (width, height), focal, (cx or width / 2, cy or height / 2), to_world)


def _number(file: Path, key: str, value: Any) -> float | None:
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value) or value <= 0:
        raise ConfigError(file, key, "must be a positive number")
    return float(value)


def _check_square(source: object, key: str, fx: float, fy: float) -> None:
    if abs(fx - fy) > SQUARE * fx:
        what = f"has focal lengths {fx:g} and {fy:g}, but Mitsuba's pixels are squares"
        raise ConfigError(source, key, f"{what}; undistort to equal focal lengths")


# --- COLMAP -----------------------------------------------------------------------------------------------------------


def _colmap(file: Path) -> list[Camera]:
    from scipy.spatial.transform import Rotation  # late, because few scenes have such a file

    models = dict(_models(file.with_name("cameras.txt")))
    cameras = []
    lines = _lines(file)
    for place, words in lines:
        if not words:
            continue
        next(lines, None)  # the image's points
        try:
            w, *pose = (float(word) for word in words[1:8])
            camera, name = int(words[8]), " ".join(words[9:])
            rotation = Rotation.from_quat([*pose[:3], w]).as_matrix()
        except (ValueError, IndexError):
            raise ConfigError(
                place, "", "is not an image: IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME"
            ) from None
        if not np.isfinite([w, *pose]).all():
            raise ConfigError(place, "", "has a number that is not finite")
        if camera not in models or not name:
            raise ConfigError(place, "", f"has camera {camera}, which cameras.txt lacks, or no name")
        to_world = np.eye(4)
        to_world[:3, :3], to_world[:3, 3] = rotation.T, -rotation.T @ pose[3:]
        cameras.append(Camera(Path(name).stem, file.parent / name, *models[camera], to_world @ _COLMAP))
    return cameras


def _models(file: Path) -> Iterator[tuple[int, tuple[tuple[int, int], float, tuple[float, float]]]]:
    """Yield the number, size, focal length and centre of each camera."""
    for place, words in _lines(file):
        if not words:
            continue
        model = words[1] if len(words) > 1 else ""
        if model not in MODELS:
            what = f"has model {model or 'none'}, which Mitsuba lacks"
            raise ConfigError(place, "", f"{what}; undistort the images to PINHOLE")
        try:
            number, width, height = int(words[0]), int(words[2]), int(words[3])
            found = dict(zip(MODELS[model], map(float, words[4:]), strict=True))
        except (ValueError, IndexError):
            raise ConfigError(place, "", f"is not a camera: CAMERA_ID, {model}, WIDTH, HEIGHT, parameters") from None
        focal = found.get("f", found.get("fx", 0.0))
        if not (focal > 0 and math.isfinite(focal) and width > 0 and height > 0):
            raise ConfigError(place, "", "must have a positive focal length and size")
        _check_square(place, "", focal, found.get("fy", focal))
        yield number, ((width, height), focal, (found["cx"], found["cy"]))


def _lines(file: Path) -> Iterator[tuple[str, list[str]]]:
    """Yield the location and the words of each line that is no comment. A line of points may be empty."""
    text = read_file(file).decode("utf-8", errors="replace")
    for number, line in enumerate(text.splitlines(), 1):
        if not line.startswith("#"):
            yield f"{file}:{number}", line.split()
