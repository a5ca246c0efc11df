"""An experiment of 24x24 pixels with a spot light, a glass slab and a floor below the slab. The slab's lower face is a
flat mesh.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from kit import diffuse, ref, scene, sensor, shape

CELLS = 16
SCENE = scene(
    '<default name="filter" value="gaussian"/>',
    sensor("0, 1, 0", up="0, 0, -1", size=24, fov=90, id="camera", rfilter="$filter"),
    '<bsdf type="dielectric" id="glass"/>',
    shape("rectangle", "floor", diffuse("0.8, 0.7, 0.6"), place='<rotate x="1" angle="-90"/>'),
    shape("rectangle", "top", ref("glass"), place='<rotate x="1" angle="-90"/><translate y="2.2"/>'),
    shape("ply", "slab", '<string name="filename" value="slab.ply"/>', ref("glass")),
    shape("cube", "bare", '<boolean name="face_normals" value="true"/>', diffuse("0.1, 0.2, 0.3"),
          place='<scale value="0.05"/><translate x="30"/>'),
    """<emitter type="spot" id="lamp">
        <rgb name="intensity" value="10, 9, 8"/>
        <float name="cutoff_angle" value="12"/> <float name="beam_width" value="4"/>
        <transform name="to_world"><lookat origin="0, 5, 0" target="0, 0, 0" up="0, 0, -1"/></transform>
    </emitter>""",
)  # fmt: skip
CONFIG = """
variant: llvm_ad_rgb
scene: {file: scene.xml}
target: {render: {spp: 64, parameters: {lamp.translation: [0.05, 0.1, -0.05]}}}
parameters:
  - motion: {of: lamp, free: [translation]}
    learning_rate: 0.02
integrator: {max_depth: 4, rr_depth: 100, estimator: stack}
run: {iterations: 3, spp: 16, final_spp: 16}
"""


def write_experiment(folder: Path) -> Path:
    """Write the scene, the mesh and `glass.yaml` to `folder`. A variant must be set."""
    import mitsuba as mi

    axis = np.linspace(-1, 1, CELLS + 1)
    x, z = np.meshgrid(axis, axis, indexing="ij")
    y = np.full_like(x, 2)
    index = np.arange(x.size).reshape(x.shape)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    mesh = mi.Mesh("slab", x.size, len(faces), has_vertex_normals=True, has_vertex_texcoords=True)
    params = mi.traverse(mesh)
    params["vertex_positions"] = np.stack([x, y, z], -1).ravel().astype(np.float32)
    params["vertex_texcoords"] = np.stack([(x + 1) / 2, (z + 1) / 2], -1).ravel().astype(np.float32)
    params["faces"] = faces.ravel().astype(np.uint32)
    params.update()
    mesh.recompute_vertex_normals()
    mesh.write_ply(str(folder / "slab.ply"))
    (folder / "scene.xml").write_text(SCENE)
    path = folder / "glass.yaml"
    path.write_text(CONFIG)
    return path


def assemble(folder: Path, *sets: str) -> Any:
    """Write the experiment, and return its problem without targets."""
    from reslrb_cli.config.loader import load
    from reslrb_cli.optimization.assemble import assemble_scene

    return assemble_scene(load(write_experiment(folder), list(sets)))
