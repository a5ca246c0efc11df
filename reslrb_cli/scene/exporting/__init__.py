"""A scene with other values of its parameters, written as files that Mitsuba alone loads."""

from .export import export_scene

__all__ = ["export_scene"]
