"""What was found out about a scene, and is no longer so once shapes have moved."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi

from reslrb_cli.scene.graph import SceneGraph
from reslrb_cli.scene.horizon import Surroundings
from reslrb_cli.scene.lamps import find_lamps
from reslrb_cli.scene.needs import interpolates_normals
from reslrb_cli.transport.plan import Plan


class Renewal:
    """Brings the plans of one scene up to date, ahead of tracing; no more of them than has changed."""

    def __init__(self, scene: mi.Scene) -> None:
        graph = SceneGraph.of(scene)
        self._surroundings = Surroundings()
        self._infinite = any(mi.has_flag(e.flags(), mi.EmitterFlags.Infinite) for e in scene.emitters())
        self._lamps = [lamp.shape for lamp in find_lamps(scene, graph) if lamp.faces_by_area]
        # Vertices as they were when it was decided that interpolated normals need no correction, because meshes are
        # flat. They are held, so that other arrays do not get their place.
        smooth = [shape for shape in graph.shapes() if interpolates_normals(shape)]
        self._before = [(shape, _vertices(shape)) for shape in smooth]
        self._bent = False

    def renew(self, plan: Plan, scene: mi.Scene) -> Plan:
        """The plan of `scene`, as it is now."""
        for mesh in self._lamps:
            mesh.surface_area()  # else Mitsuba adds up its faces when they are first sampled, in the midst of tracing
        if self._infinite:
            plan = replace(plan, horizon=self._surroundings.follow(scene))
        # Once needed, kept: a mesh that bends and is flat again would have kernels compiled anew each time.
        self._bent = self._bent or any(
            [array.index for array in _vertices(shape)] != [array.index for array in before]
            for shape, before in self._before
        )
        return with_shading_normals(plan) if self._bent else plan


def with_shading_normals(plan: Plan) -> Plan:
    """The plan of a scene whose interpolated normals differ from its geometric ones."""
    return replace(plan, needs=replace(plan.needs, has_shading_normals=True))


def _vertices(mesh: mi.Mesh) -> tuple[mi.Float, mi.Float]:
    return mesh.vertex_positions_buffer(), mesh.vertex_normals_buffer()
