"""The room of the paper's Figures 5 and 6, as an experiment: Wig42's "Grey & White Room" from Mitsuba's gallery.

It is not part of this project (CC BY 3.0): its folder is named by the user, and not changed.
"""

from __future__ import annotations

from pathlib import Path

from reslrb_cli.config.loader import load
from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ConfigError

#: What commands say of the argument that names it.
ROOM = "folder of the Grey & White Room (Mitsuba's gallery)"
FLOOR = "Floor.brdf_0.diffuse_reflectance.data"
#: What the floor's texture stands in, and with what it has derivatives: 8 bits a channel have none.
_BEFORE = '<string name="filename" value="textures/wood.jpg" />'
_AFTER = _BEFORE + '<string name="format" value="variant" />'
_CONFIG = """\
scene:
  file: scene.xml
  options: {resx: 160, resy: 90}
target:
  render: {spp: 1024, parameters: {%s: 0.3}}
parameters:
  - key: %s
    resolution: [512, 228]
integrator: {type: reslrb, estimator: reservoir, max_depth: 32}
loss: {type: l2}
run: {spp: 32}
"""


def room_config(room: Path, folder: Path, overrides: list[str]) -> Config:
    """The experiment, written into `folder`: the floor's texture, from an image with a grey floor.

    Raises ConfigError.
    """
    file = room / "scene.xml" if room.is_dir() else room
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(str(room), "", f"cannot be read: {error}; it must be the folder of the room") from None
    if text.count(_BEFORE) != 1:
        raise ConfigError(str(file), "", "is not the Grey & White Room of Mitsuba's gallery: its floor has no wood.jpg")
    for name in ("models", "textures"):
        (folder / name).symlink_to((file.parent / name).resolve(), target_is_directory=True)
    (folder / "scene.xml").write_text(text.replace(_BEFORE, _AFTER), encoding="utf-8")
    (folder / "room.yaml").write_text(_CONFIG % (FLOOR, FLOOR), encoding="utf-8")
    return load(folder / "room.yaml", overrides)
