"""Five lamps and four roughnesses at once: whatever is wrong of them is told to be."""

from __future__ import annotations

import numpy as np
import pytest
from optimization.judged import CONFIG, Toy, lamp, run

LAMPS = {
    "a": (-2.4, "9, 6, 4"),
    "b": (-1.2, "3, 5, 8"),
    "c": (0.1, "4, 4, 4"),
    "d": (1.2, "6, 2, 5"),
    "e": (2.6, "2, 7, 3"),
}
PLATES = {"p": (-0.9, -0.8, 0.1), "q": (0.9, -0.8, 0.2), "r": (-0.9, 0.8, 0.35), "s": (0.9, 0.8, 0.5)}
SCENE = """<scene version="3.0.0">
    <sensor type="perspective">
        <float name="fov" value="42"/>
        <transform name="to_world"><lookat origin="0, -0.5, 4" target="0, 0, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm">
            <integer name="width" value="24"/> <integer name="height" value="24"/>
            <string name="pixel_format" value="rgb"/> <rfilter type="box"/>
        </film>
    </sensor>
    <shape type="rectangle" id="back">
        <transform name="to_world"><scale value="3"/><translate z="-0.5"/></transform>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.6, 0.4, 0.25"/></bsdf>
    </shape>
    BODY
</scene>
"""
#: How far off a value may be that is said to be settled: in standard deviations of its spread, and as a share of it.
SPREADS, SHARE = 3.0, 0.15


def plate(name: str, x: float, y: float, alpha: float) -> str:
    return f"""<shape type="rectangle" id="{name}">
        <transform name="to_world"><scale value="0.55"/><translate x="{x}" y="{y}"/></transform>
        <bsdf type="roughconductor"><float name="alpha" value="{alpha}"/></bsdf>
    </shape>"""


@pytest.mark.long
@pytest.mark.parametrize("spp", [4, 64])
def test_wrong_values_are_told_to_be(llvm, tmp_path, spp):
    shapes = [lamp(name, x, radiance, 0.4) for name, (x, radiance) in LAMPS.items()]
    shapes += [plate(name, *place) for name, place in PLATES.items()]
    (tmp_path / "scene.xml").write_text(SCENE.replace("BODY", "\n".join(shapes)))
    (tmp_path / "toy.yaml").write_text(CONFIG.replace("wall.reflectance.value", "p.bsdf.alpha.value"))
    radiance = {
        f"{name}.emitter.radiance.value": "initial: 1.0, bounds: [0, 1000], learning_rate: 0.1" for name in LAMPS
    }
    alphas = {f"{name}.bsdf.alpha.value": "initial: 0.6, bounds: [0.02, 1]" for name in PLATES}
    found = run(tmp_path, Toy("many", radiance | alphas, {}, (f"run.spp={spp}",)))
    kind, wrong = [], 0
    for key, about in found.certainty.parameters.items():
        relative = np.abs(found.errors[key]).max() / np.abs(found.true[key]).max()
        off = relative > SHARE
        wrong += off
        spread = "" if about.spread is None else np.array2string(np.array(about.spread, dtype=float), precision=3)
        print(f"{key}: {about.verdict}, off by {100 * relative:.0f} %, spread {spread}, {about.partner or ''}")
        if about.verdict == "settled" and off:
            far = np.abs(found.errors[key]).ravel() > SPREADS * np.array(about.spread, dtype=float)
            kind += [key] if far.any() else []
    print(
        f"{wrong} of {len(found.certainty.parameters)} wrong; measured in {found.certainty.share:.3f} of the run's time"
    )
    assert wrong >= 3  # else nothing is shown
    assert not kind
