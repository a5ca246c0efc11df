"""A mesh as it stands in a loaded scene, as a PLY file in place of what its element names."""

from __future__ import annotations

import mitsuba as mi

from ...records.file_names import file_stem
from ..description.element import Element
from .parts import Parts

#: Parameters of a mesh that a PLY file does not hold.
_KEPT = ("face_normals", "flip_normals")


def put_mesh(owner: Element, mesh: mi.Mesh, parts: Parts, key: str) -> None:
    """Have the element of `mesh`, which has the parameter `key`, name a file that holds the mesh.

    That has vertices as they stand in the world, faces and attributes.
    """
    owner.children[:] = [item for item in owner.children if not item.is_value or item.name in _KEPT]
    owner.attributes["type"] = "ply"
    parts.add(owner, file_stem(key.rpartition(".")[0]), ".ply", lambda path: mesh.write_ply(str(path)))
