"""Every parameter that `reslrb inspect` lists as recoverable, of every BSDF, emitter and texture of Mitsuba: its
derivative by `reslrb`, and differences of images.

The scenes are those of cli/every_plugin.py, with all options of a BSDF in the scene. The objective is a weighted sum of
the pixels. Differences are central inside of a parameter's range, and one-sided at its bounds, with the random numbers
of the derivative. Two point lamps light a BSDF at first, one from each side, and paths have two segments. All
directions are then fixed, and differences have no noise. A parameter without effect there, such as that of a mirror,
gets an area lamp and longer paths.

`python tests/conformance/every_key.py` measures all keys and writes keys.json beside this file. docs/plugins.md has its
table of derivatives from there.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from scipy import stats

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from cli.every_plugin import CAMERA, FLOOR, LIGHT, MATERIALS, RADIANCE, ROWS, Row, thing, write_files

Stage: TypeAlias = tuple[str, int, int, int, float]
RESULTS = Path(__file__).with_name("keys.json")
KINDS = ("bsdf", "emitter", "texture", "volume")
#: Numbers of seeds of a mean: at first without noise, and otherwise. The two-sided limit of Student's t is that of a
#: false alarm in 1000 sweeps of about 1000 tests.
FEW_SEEDS, SEEDS = 4, 16
LIMITS = {count: float(stats.t.isf(1e-6 / 2, count - 1)) for count in (FEW_SEEDS, SEEDS)}
#: Allowed error of the differences by their step, and largest derivative that counts as 0, relative to the objective.
TRUNCATION, NOTHING = 0.02, 2e-6
#: Largest standard error, times the limit, and relative to the derivative, that shows a derivative that is 10 % off.
RESOLVED = 0.06
#: Lamps of BSDFs, samples per pixel at first and at most, segments of paths, and step relative to the range.
POINT = '<emitter type="point"><point name="position" {}/><rgb name="intensity" value="8, 9, 7"/></emitter>'
POINTS = POINT.format('x="0.5" y="2" z="2.5"') + POINT.format('x="-0.4" y="1" z="-2"')
STAGES = ((POINTS, 2**7, 2**11, 2, 0.004), (LIGHT.format(RADIANCE), 2**10, 2**12, 3, 0.02))
#: Lower ends of ranges, by the end of the name. Mitsuba renders a `specular` of 0 as 0.001. Few samples meet the narrow
#: peak of a lower roughness. The derivative by a k below 0.001 changes by tens of per cent, and a tint jumps at black.
#: A normal map below 0.5 turns normals into the surface.
LOWEST = {"Principled.specular": 1e-3, "Conductor.k": 1e-3, "NormalMap.normalmap": 0.6, ".base_color": 1e-3,
          ".roughness": 0.15, "al_roughness": 0.15, ".alpha": 0.15, ".alpha_u": 0.15, ".alpha_v": 0.15}  # fmt: skip
#: Factors of the step, by the end of the name or of the name with the point. The width of the clearcoat's peak falls to
#: a hundredth at a gloss of 1. The image is linear in `sheen_tint`, whose small effect would drown in rounding.
STEPS = {"Conductor.eta": 0.1, "Conductor.k": 0.1, "RoughPlastic.eta": 3, "RoughPlastic.eta low": 1,
         "RoughPlastic.eta high": 10, "RoughPlastic.alpha": 5, "PolarizedPlastic.eta low": 0.1,
         ".clearcoat_gloss high": 0.05, ".sheen_tint": 10, ".base_color low": 0.02,
         "Conductor.k low": 0.01}  # fmt: skip
#: Rounding of the tables that Mitsuba makes of a parameter, relative to the objective and equal for all seeds.
ROUNDING = {"RoughPlastic.eta": 2e-3, "RoughPlastic.alpha": 3e-3}


def _rgb(name: str, value: str) -> str:
    return f'<rgb name="{name}" value="{value}"/>'


def _floats(**values: float) -> str:
    return "".join(f'<float name="{name}" value="{value}"/>' for name, value in values.items())


def _bsdf(kind: str, inner: str) -> str:
    return f'<bsdf type="{kind}">{inner}</bsdf>'


SPECULAR, THROUGH = _rgb("specular_reflectance", "0.8, 0.7, 0.6"), _rgb("specular_transmittance", "0.6, 0.8, 0.7")
DIFFUSE, BASE = _rgb("diffuse_reflectance", "0.6, 0.8, 0.7"), _rgb("base_color", "0.6, 0.5, 0.3")
GGX, NONLINEAR = '<string name="distribution" value="ggx"/>', '<boolean name="nonlinear" value="true"/>'
COPPER = '<string name="material" value="Cu"/>'
ROUGH_COPPER = _bsdf("roughconductor", COPPER + _floats(alpha=0.3))
PLASTIC = _bsdf("plastic", SPECULAR + DIFFUSE)
#: By eta, the derivatives of a bright peak and of the diffuse lobe nearly cancel.
DULL = _rgb("specular_reflectance", "0.2, 0.15, 0.1")
ROUGH_PLASTIC = _bsdf("roughplastic", _floats(alpha=0.3) + DULL + DIFFUSE)
THIN_GLASS = _bsdf("thindielectric", SPECULAR + THROUGH)
#: BSDFs with all their parameters, by plugin and form. A plugin without an entry has the form of every_plugin.py.
FORMS = {
    "conductor": {"": _bsdf("conductor", COPPER + SPECULAR), "without a material": _bsdf("conductor", "")},
    "roughconductor": {
        "": _bsdf("roughconductor", COPPER + SPECULAR + _floats(alpha=0.3)),
        "anisotropic": _bsdf("roughconductor", COPPER + GGX + _floats(alpha_u=0.3, alpha_v=0.5)),
        "without a material": _bsdf("roughconductor", _floats(alpha=0.3)),
    },
    "dielectric": {"": _bsdf("dielectric", SPECULAR + THROUGH)},
    "thindielectric": {"": THIN_GLASS},
    "roughdielectric": {
        "": _bsdf("roughdielectric", SPECULAR + THROUGH + _floats(alpha=0.3)),
        "anisotropic": _bsdf("roughdielectric", GGX + _floats(alpha_u=0.3, alpha_v=0.5)),
    },
    "plastic": {"": PLASTIC, "nonlinear": _bsdf("plastic", NONLINEAR + SPECULAR + DIFFUSE)},
    "roughplastic": {
        "": ROUGH_PLASTIC,
        "nonlinear": _bsdf("roughplastic", NONLINEAR + GGX + _floats(alpha=0.4) + DULL + DIFFUSE),
    },
    "pplastic": {
        "": _bsdf("pplastic", _floats(alpha=0.3) + SPECULAR + DIFFUSE),
        "anisotropic": _bsdf("pplastic", _floats(alpha_u=0.3, alpha_v=0.5) + DIFFUSE),
    },
    "principled": {
        "": _bsdf("principled", BASE + _floats(
            roughness=0.5, metallic=0.3, anisotropic=0.4, spec_trans=0.4, spec_tint=0.3, sheen=0.9, sheen_tint=0.4,
            flatness=0.4, clearcoat=0.6, clearcoat_gloss=0.3, eta=1.4)),
        "as exported": _bsdf("principled", BASE + _floats(roughness=0.5, specular=0.4)),
    },
    "principledthin": {
        "": _bsdf("principledthin", BASE + _floats(
            roughness=0.5, anisotropic=0.4, spec_trans=0.4, spec_tint=0.3, sheen=0.5, sheen_tint=0.4, flatness=0.4,
            diff_trans=0.8, eta=1.4)),
    },
    "mask": {
        "": MATERIALS["mask"],
        "over plastic": _bsdf("mask", _floats(opacity=0.6) + PLASTIC),
        "over thindielectric": _bsdf("mask", _floats(opacity=0.6) + THIN_GLASS),
    },
    "twosided": {"": MATERIALS["twosided"], "over roughplastic": _bsdf("twosided", ROUGH_PLASTIC)},
    "blendbsdf": {
        "": _bsdf("blendbsdf", _floats(weight=0.4) + MATERIALS["diffuse"] + ROUGH_COPPER),
    },
    "bumpmap": {"": MATERIALS["bumpmap"].replace(MATERIALS["diffuse"], ROUGH_PLASTIC)},
    "hair": {"": _bsdf("hair", "")},
}  # fmt: skip


@dataclass(frozen=True)
class Outcome:
    """Derivative of the objective along one parameter at one point, by `reslrb` (`ad`) and by differences (`fd`), with
    the standard error of their difference.

    `at` is `inside`, `low` or `high`, and `size` is the objective.
    """

    form: str
    key: str
    owner: str
    at: str
    paths: str
    fd: float
    ad: float
    error: float
    size: float
    spp: int
    seeds: int = SEEDS

    @property
    def z(self) -> float:
        """Difference in standard errors."""
        return (self.ad - self.fd) / self.error if self.error > 0 else 0.0

    @property
    def tolerance(self) -> float:
        """Largest difference that agrees."""
        return LIMITS[self.seeds] * self.error + TRUNCATION * abs(self.fd) + self._nothing

    @property
    def resolved(self) -> bool:
        """True if a derivative that is 10 % off, or 0 in place of this one, would be found."""
        return LIMITS[self.seeds] * self.error <= max(RESOLVED * abs(self.fd), self._nothing)

    @property
    def vanishes(self) -> bool:
        """True if neither derivative differs from 0."""
        return max(abs(self.ad), abs(self.fd)) <= self._nothing

    @property
    def _nothing(self) -> float:
        return ROUNDING.get(self.owner, NOTHING) * self.size

    @property
    def holds(self) -> bool:
        """True if both derivatives agree."""
        return abs(self.ad - self.fd) <= self.tolerance


@dataclass(frozen=True)
class Form:
    """Scene of a plugin with certain options, by its `name`. `stages` are XML, samples per pixel at first and at most,
    depth, and relative
    step.
    """

    name: str
    row: Row
    stages: tuple[Stage, ...]

    @property
    def points(self) -> dict[str, tuple[str, ...]]:
        """Points at which a parameter is tested, by the kinds of paths that render the scene. The last kind takes the
        bounds.
        """
        kinds = [kind for kind, why in (("light", self.row.light), ("camera", self.row.camera)) if not why]
        return {kind: ("inside", "low", "high") if kind == kinds[-1] else ("inside",) for kind in kinds}

    def owns(self, key: str) -> bool:
        """Return whether a key belongs to the plugin, and not to the rest of the scene."""
        if 'id="thing"' in self.stages[0][0]:
            return key.startswith("thing")
        return not key.startswith(("floor", "lamp.bsdf"))


def forms() -> list[Form]:
    """Return all scenes that some integrator renders."""
    found = []
    for row in (row for row in ROWS if row.kind in KINDS and not row.refused):
        if row.kind != "bsdf":
            _, first, most, *rest = STAGES[1]
            found.append(Form(row.name, row, ((_small(row.xml()), first, 4 * most, *rest),)))  # type: ignore[arg-type]
            continue
        known = FORMS.get(row.plugin, {"": ""}) if not row.where else {"": ""}
        for form, bsdf in known.items():
            inner = thing(bsdf) if bsdf else row.scene
            stages = tuple((_small(f'<scene version="3.0.0">\n{CAMERA}\n{FLOOR}\n{lamps}\n{inner}\n</scene>\n'), *rest)
                           for lamps, *rest in STAGES)  # fmt: skip
            found.append(Form(f"{row.name} {form}".strip(), row, stages))  # type: ignore[arg-type]
    return found


def _small(xml: str) -> str:
    return xml.replace('value="16"', 'value="4"')


def load(xml: str, folder: Path) -> Any:
    """Load a scene file of this text in `folder`, with bitmaps as floating point."""
    from reslrb_cli.scene.load import load_scene

    (folder / "scene.xml").write_text(xml)
    return load_scene(folder / "scene.xml", keys=["*"])


def recoverable(scene: Any) -> list[Any]:
    """Return the parameters that `reslrb inspect` lists as recoverable, without those that move light. The tests of
    moving shapes and lamps, and of dispersion, have those.
    """
    import mitsuba as mi

    from reslrb_cli.measure.gradients import moves_light
    from reslrb_cli.scene.catalog import list_parameters

    params = mi.traverse(scene)
    return [
        info for info in list_parameters(params, True) if info.obstacle is None and not moves_light(params, info.key)
    ]


def identity(params: Any, key: str) -> str:
    """Return class and name of a parameter, such as `Principled.sheen`, and the class of its texture."""
    from reslrb_cli.scene.catalog import owner_of

    kind, name = owner_of(params, key)
    own = params.properties[key][2].class_name()
    return f"{kind}.{name}" if own == kind else f"{kind}.{name} ({own})"


def _by_end(table: dict[str, float], default: float, *names: str) -> float:
    """Return the entry of `table` for the end of the first of `names` that has one."""
    found = (value for name in names for end, value in table.items() if name.endswith(end))
    return next(found, default)


def _range(params: Any, info: Any) -> tuple[float, float]:
    from reslrb_cli.scene.catalog import owner_of
    from reslrb_cli.scene.proposal import usual_bounds

    text = usual_bounds(info, owner_of(params, info.key))
    low, high = (float(word) for word in text.strip("[]").replace(".inf", "inf").split(",")) if text else (0.0, np.inf)
    return low, high


def point(params: Any, info: Any, at: str) -> float | None:
    """Return the value of a parameter `at` its lower or upper bound, or NaN `inside`. An infinite bound gives None."""
    low, high = _range(params, info)
    low = max(low, _by_end(LOWEST, -np.inf, identity(params, info.key).partition(" ")[0]))
    value = {"inside": np.nan, "low": low, "high": high}[at]
    return None if np.isinf(value) else value


def measure(form: Form, folder: Path, paths: str, points: tuple[str, ...], fault: float = 1.0, only: str = "",
            stages: slice = slice(None)) -> Iterator[Outcome]:  # fmt: skip
    """Yield the outcome of each key of a form at the `points`. `fault` multiplies the derivative of `reslrb`."""
    left: dict[tuple[str, str], Outcome] = {}
    for number, stage in enumerate(form.stages[stages]):
        for outcome in _measure(form, stage, folder, paths, points, fault, only, set(left) if number else None):
            if outcome.vanishes or not outcome.resolved:
                left[outcome.key, outcome.at] = outcome
            else:
                left.pop((outcome.key, outcome.at), None)
                yield outcome
        if not left:
            return
    yield from left.values()


def _differences(case: Any, ours: Any, direction: np.ndarray, spp: int, h: float, sides: str, count: int
                 ) -> np.ndarray:  # fmt: skip
    """Return the difference of second order for each of `count` seeds. Each node sets the parameters once."""
    from reslrb_cli.measure.gradients import seeds

    nodes = {"both": {1: 0.5, -1: -0.5}, "up": {0: -1.5, 1: 2, 2: -0.5}, "down": {0: 1.5, -1: -2, -2: 0.5}}[sides]
    total = np.zeros(count)
    for node, coefficient in nodes.items():
        case.set({key: case.initial[key] + h * node * direction[at] for key, at in case.places.items()})
        total += coefficient * np.array([case.weighted(case.image(ours, seed, spp)) for seed in seeds(count)])
    return total / h


def _measure(form: Form, stage: Stage, folder: Path, paths: str, points: tuple[str, ...],
             fault: float, only: str, wanted: set[tuple[str, str]] | None) -> Iterator[Outcome]:  # fmt: skip
    from reslrb_cli.measure.gradients import Case, embed, integrator, seeds
    from reslrb_cli.scene.catalog import open_domain

    xml, first, most, depth, step = stage
    scene = load(xml, folder)
    infos = [info for info in recoverable(scene) if form.owns(info.key) and re.search(only, info.key)]
    if not infos:
        return
    case = Case(scene, [info.key for info in infos])
    ours = integrator("reslrb", depth, paths=paths, estimator="stack")
    inside = {key: np.clip(value, *open_domain(case.params, key)) for key, value in case.initial.items()}
    size = float(np.mean([case.weighted(case.image(ours, seed, first)) for seed in seeds(2)]))
    gradients: dict[tuple[str, str, int, int], np.ndarray] = {}
    for info in infos:
        key, (low, high) = info.key, _range(case.params, info)
        scale = high - low if np.isfinite(high - low) else float(np.abs(inside[key]).mean()) or 1.0
        for at in (at for at in points if wanted is None or (key, at) in wanted):
            name = identity(case.params, key).partition(" ")[0]
            if (bound := point(case.params, info, at)) is None:
                continue
            value = inside[key] if at == "inside" else np.full_like(inside[key], bound)
            h = step * scale * _by_end(STEPS, 1, f"{name} {at}", name)
            sides = {"inside": "both", "low": "up", "high": "down"}[at]
            if at == "inside" and np.any((value - h < low) | (value + h > high)):
                sides = "up" if np.all(value + 2 * h <= high) else "down"
            direction, spp = embed(case, key, np.random.default_rng(3).uniform(0.5, 1, len(value))), first
            count = FEW_SEEDS
            while True:
                mark = ("inside", "", spp, count) if at == "inside" else (at, key, spp, count)
                if mark not in gradients:
                    case.initial = {**inside, key: np.clip(value, *open_domain(case.params, key))}
                    case.set(case.initial)
                    gradients[mark] = np.stack(
                        [case.gradient(ours, seed, spp, step=case.known_step) for seed in seeds(count)])  # fmt: skip
                case.initial = {**inside, key: value}
                ad = fault * gradients[mark] @ direction
                fd = _differences(case, ours, direction, spp, h, sides, count)
                error = float((ad - fd).std(ddof=1) / np.sqrt(count))
                outcome = Outcome(form.name, key, identity(case.params, key), at, paths, float(fd.mean()),
                                  float(ad.mean()), error, size, spp, count)  # fmt: skip
                if outcome.resolved or spp >= most:
                    break
                spp, count = 4 * spp, SEEDS
            yield outcome
    case.set(inside)


def stored(file: Path = RESULTS) -> list[Outcome]:
    """Return the outcomes of a sweep, by default of the last one."""
    return [Outcome(**entry) for entry in json.loads(file.read_text())] if file.exists() else []


def main(names: list[str], file: Path = RESULTS) -> None:
    """Measure the scenes whose names match any of `names`, by default all, and replace their outcomes in `file`."""
    import gc
    import os
    import tempfile
    import time

    from compilation import combine, leave_out_optimisations

    import reslrb_cli  # noqa: F401
    from reslrb_cli.backend.variant import set_variant
    from reslrb_cli.integrators.plugin import register

    leave_out_optimisations()
    combine(True)
    set_variant("llvm_ad_rgb")
    register()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        write_files(folder)
        os.chdir(folder)
        for form in forms():
            if names and not any(re.fullmatch(pattern, form.name) for pattern in names):
                continue
            found, start = [], time.monotonic()
            for paths, points in form.points.items():
                for outcome in measure(form, folder, paths, points):
                    found.append(outcome)
                    mark = "ok " if outcome.holds and outcome.resolved else "BAD"
                    print(
                        f"{mark} {paths:6s} {outcome.at:6s} {form.name}: {outcome.owner} fd {outcome.fd:+.5f} "
                        f"ad {outcome.ad:+.5f} +- {outcome.error:.5f} z {outcome.z:+.1f} spp {outcome.spp}",
                        flush=True,
                    )
                gc.collect()
            known = [one for one in stored(file) if one.form != form.name]
            lines = [json.dumps(asdict(one)) for one in [*known, *found]]
            file.write_text("[\n" + ",\n".join(lines) + "\n]\n")
            print(f"   {form.name}: {time.monotonic() - start:.0f} s", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
