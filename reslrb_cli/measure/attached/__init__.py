"""Scenes in which parameters move light, so made that finite differences hold, and the comparison with these."""

from __future__ import annotations

from reslrb_cli.measure.attached import glass, mirrors, places, rooms
from reslrb_cli.measure.attached.scene import AttachedScene, Differenced, compare_with_differences

__all__ = ["SCENES", "AttachedScene", "Differenced", "compare_with_differences"]

SCENES: dict[str, AttachedScene] = {
    scene.name: scene for scene in (*glass.SCENES, *mirrors.SCENES, *places.SCENES, *rooms.SCENES)
}
