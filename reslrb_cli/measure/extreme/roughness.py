"""Microfacet BSDFs from fully rough to nearly smooth: a plate throws light on a floor, and the camera sees that alone.

The plate itself stays out of view: a nearly smooth lobe that is connected to the sensor has a variance that no number
of samples settles.
"""

from __future__ import annotations

from typing import Any

from reslrb_cli.measure.analytic_scenes import camera
from reslrb_cli.measure.attached.amplitudes import Number
from reslrb_cli.measure.attached.scene import FILTER
from reslrb_cli.measure.extreme.case import Extrapolated, ExtremeCase, Stock
from reslrb_cli.measure.small_scenes import diffuse, rgb, transform

FLOOR = "floor.bsdf.reflectance.value"


def _horizontal(y: float, half: float, turn: float = -90) -> Any:
    return transform(translate=[0, y, 0], rotate=([1, 0, 0], turn), scale=half)


def reflected(bsdf: dict) -> dict:
    """A lamp shines on an upright plate, which reflects it on the floor."""
    return {
        "type": "scene",
        "camera": camera([0, 0.9, 0], [0, 0, 0], [0, 0, -1], 60),
        "floor": {"type": "rectangle", "bsdf": diffuse(0.7, 0.5, 0.6), "to_world": _horizontal(0, 2)},
        "plate": {"type": "rectangle", "bsdf": bsdf,
                  "to_world": transform(translate=[-1, 1, 0], rotate=([0, 1, 0], 90))},
        "lamp": {"type": "rectangle", "bsdf": diffuse(0, 0, 0), "emitter": {"type": "area", "radiance": rgb(5, 6, 4)},
                 "to_world": transform(translate=[0.8, 1.3, 0], rotate=([0, 1, 0], -90), scale=0.4)},
    }  # fmt: skip


def transmitted(bsdf: dict) -> dict:
    """A lamp shines through a horizontal plate on the floor; the camera stands between the two."""
    return reflected(bsdf) | {
        "plate": {"type": "rectangle", "bsdf": bsdf, "to_world": _horizontal(1, 2)},
        "lamp": {"type": "rectangle", "bsdf": diffuse(0, 0, 0), "emitter": {"type": "area", "radiance": rgb(5, 6, 4)},
                 "to_world": _horizontal(1.8, 0.5, 90)},
    }  # fmt: skip


def close() -> dict:
    """A narrow beam that falls on the floor, and a camera that looks at nothing else."""
    return {
        "camera": camera([0, 0.9, 0], [0, 0, 0], [0, 0, -1], 4),
        "lamp": {"type": "rectangle", "bsdf": diffuse(0, 0, 0), "to_world": _horizontal(1.8, 0.01, 90),
                 "emitter": {"type": "directionalarea", "radiance": rgb(5, 6, 4)}},
    }  # fmt: skip


def conductor(alpha: float) -> dict:
    return reflected({"type": "roughconductor", "alpha": alpha, "specular_reflectance": rgb(0.9, 0.7, 0.5)})


def dielectric(alpha: float) -> dict:
    return transmitted({"type": "roughdielectric", "alpha": alpha, "specular_transmittance": rgb(0.9, 0.7, 0.5)})


def plastic(alpha: float) -> dict:
    return reflected({"type": "roughplastic", "alpha": alpha, "diffuse_reflectance": rgb(0.1, 0.2, 0.3),
                      "specular_reflectance": rgb(0.9, 0.7, 0.5)})  # fmt: skip


def principled(roughness: float) -> dict:
    return reflected({"type": "principled", "roughness": roughness, "metallic": 0.9, "base_color": rgb(0.9, 0.7, 0.5)})


#: Maker, colour of the lobe, and roughness, where that is a parameter.
KINDS = {
    "roughconductor": (conductor, "specular_reflectance", "alpha"),
    "roughdielectric": (dielectric, "specular_transmittance", "alpha"),
    "roughplastic": (plastic, "specular_reflectance", None),
    "principled": (principled, "base_color", "roughness"),
}
ROUGHNESS = ("1", "0.1", "1e-2", "1e-4")
#: Roughnesses whose derivative is decided where light follows them. `principled` chooses a lobe: it has none such.
FOLLOWED = [(kind, roughness) for kind in ("roughconductor", "roughdielectric") for roughness in ("0.1", "1e-2")]
NOISE = "the noise of a roughness's derivative grows as 1 / roughness: equal seeds decide"


def followed(kind: str, roughness: str) -> str:
    """Name of the case in which light follows a roughness."""
    return f"{kind}_{roughness}_followed"


def _case(kind: str, roughness: str) -> ExtremeCase:
    make, colour, own = KINDS[kind]
    colour, keys = f"plate.bsdf.{colour}.value", [FLOOR]
    open_ended, elsewhere = {}, {}
    if own is not None:
        keys.append(f"plate.bsdf.{own}.value")
        if (kind, roughness) in FOLLOWED:
            elsewhere[keys[-1]] = followed(kind, roughness)
        elif float(roughness) <= 0.1:
            open_ended[keys[-1]] = NOISE
    return ExtremeCase(
        f"{kind}_{roughness}",
        f"light by way of a {kind} of roughness {roughness}",
        lambda: make(float(roughness)),
        (colour, *keys),
        Stock("prb"),
        spp=256,
        signed=own is not None,
        open_ended=open_ended,
        elsewhere=elsewhere,
    )


def _followed(kind: str, roughness: str) -> ExtremeCase:
    """The derivative by the roughness, of light that follows it: quiet, and known by finite differences.

    What nearly smooth glass blurs is less than a pixel of the camera above, and next to nothing of its derivative is
    left: a closer one looks at a narrow beam.
    """
    make, _, own = KINDS[kind]

    def scene() -> dict:
        made = make(float(roughness))
        if (kind, roughness) == ("roughdielectric", "1e-2"):
            made |= close()
        made["camera"]["film"]["rfilter"] = FILTER  # a box filter has no derivative by where light lands
        return made

    return ExtremeCase(
        followed(kind, roughness),
        f"how light follows the roughness {roughness} of a {kind}",
        scene,
        (),
        Extrapolated(0.05 * float(roughness), 2e-3),
        image="",
        spp=256,
        signed=True,
        options={"max_depth": 3},  # from the plate to the floor, and no farther: beyond it are edges at rest
        ours={"attached": True},
        equal=5e-4,
        moves=lambda scene: [Number(f"plate.bsdf.{own}.value")],
    )


CASES = [_case(kind, roughness) for kind in KINDS for roughness in ROUGHNESS]
CASES += [_followed(kind, roughness) for kind, roughness in FOLLOWED]
