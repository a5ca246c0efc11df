"""Glass with dispersion and illuminants: the catalogue against data sheets, a prism against Snell's law, and the
plugins against Mitsuba's dielectrics at each wavelength.
"""

from __future__ import annotations

from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from kit import with_wavelengths
from turns import taking_turns

from reslrb_cli.glasses import C_LINE, D_LINE, F_LINE, GLASSES, find_glass
from reslrb_cli.scene.dispersion import register
from reslrb_cli.scene.load import load_scene

ROOT = Path(__file__).resolve().parents[2]
PRISM = ROOT / "scenes" / "prism" / "scene.xml"
#: Indices at the lines F, d and C, and Abbe's number, from data sheets.
SHEETS = {
    "N-BK7": (1.52238, 1.51680, 1.51432, 64.17),
    "N-SF11": (1.80651, 1.78472, 1.77596, 25.68),
    "F2": (1.63208, 1.62004, 1.61503, 36.37),
    "fused silica": (1.46313, 1.45846, 1.45637, 67.82),
}
#: Indices at d of the other materials.
OTHERS = {"PMMA": 1.491, "polycarbonate": 1.585, "water": 1.3334, "diamond": 2.4175}
#: Coefficients of F2, from the data sheet, with another B3.
B, C = (1.34533359, 0.209073176, 0.9), (0.00997743871, 0.0470450767, 111.886764)
F2 = "1.34533359, 0.209073176, 0.937357162, 0.00997743871, 0.0470450767, 111.886764"
B3 = '<float name="B3" value="0.9"/>'
#: The angle of incidence in the scene of the prism, and the angle between its faces, in degrees.
INCIDENCE, APEX = 54.0, 60.0


def test_the_catalogue_has_the_indices_of_data_sheets() -> None:
    assert {*SHEETS, *OTHERS} == set(GLASSES)
    for name, (*indices, Vd) in SHEETS.items():
        glass = find_glass(name.lower())
        assert [glass.index(line) for line in (F_LINE, D_LINE, C_LINE)] == pytest.approx(indices, abs=1.1e-5), name
        assert glass.Vd == pytest.approx(Vd, abs=0.011), name
    for name, nd in OTHERS.items():
        assert find_glass(name).nd == pytest.approx(nd, abs=5e-4), name
    page = (ROOT / "docs" / "spectral.md").read_text(encoding="utf-8")
    for name, glass in GLASSES.items():
        assert f"| `{name}` | {glass.nd:.5f} | {glass.Vd:.2f} | {glass.source} |" in page
    with pytest.raises(ValueError, match="did you mean `N-BK7`"):
        find_glass("BK7")


def deflection(n: np.ndarray) -> np.ndarray:
    """Return the deflection of the prism in radians, by Snell's law."""
    i, A = np.radians(INCIDENCE), np.radians(APEX)
    inside = np.arcsin(np.sin(i) / n)
    return i - A + np.arcsin(n * np.sin(A - inside))


def through(scene: mi.Scene, wavelengths: np.ndarray) -> mi.Float:
    """Return the deflection of refracted rays with one wavelength each, traced through the prism."""
    d = mi.Vector3f(float(np.sin(np.radians(66))), 0, float(np.cos(np.radians(66))))
    ray = mi.Ray3f(mi.Point3f(-0.85584, 0, -0.25322) + 0.01 * d, d)
    ray.wavelengths = mi.Spectrum(mi.Float(wavelengths.astype(np.float32)))
    start = ray.d
    glass = next(shape.bsdf() for shape in scene.shapes() if shape.id() == "front")
    for _ in range(2):
        si = scene.ray_intersect(ray)
        bs, weight = glass.sample(mi.BSDFContext(), si, mi.Float(1 - 2**-24), mi.Point2f(0.5))
        assert dr.all(weight[0] > 0.1)
        ray = si.spawn_ray(si.to_world(bs.wo))
    return dr.acos(dr.dot(start, ray.d))


def test_the_prism_deflects_as_snells_law_says(spectral: None) -> None:
    """The derivatives by n_d and V_d are those of Snell's law, too."""
    scene = load_scene(PRISM)
    nF, nd, nC, Vd = SHEETS["F2"]
    n, lines = np.array([nF, nd, nC]), np.array([F_LINE, D_LINE, C_LINE])
    assert np.array(through(scene, lines)) == pytest.approx(deflection(n), abs=1e-4)
    slopes = (deflection(n + 1e-5) - deflection(n - 1e-5)) / 2e-5
    shares = (n - nd) / (nF - nC)  # g at the lines
    check_derivatives(scene, {"glass.nd": slopes * (1 + shares / Vd), "glass.Vd": -slopes * shares * (nd - 1) / Vd**2})


def test_derivatives_by_sellmeiers_coefficients_are_those_of_snells_law(spectral: None, tmp_path: Path) -> None:
    """They are derivatives of n^2 = 1 + sum_i B_i l^2 / (l^2 - C_i), for l in micrometres. `B3` replaces its value."""
    text = PRISM.read_text().replace('name="material" value="F2"/>', f'name="sellmeier" value="{F2}"/>{B3}')
    (tmp_path / "scene.xml").write_text(text)
    scene = load_scene(tmp_path / "scene.xml")
    lines = np.array([F_LINE, D_LINE, C_LINE])
    square = (lines / 1000) ** 2
    terms = square / (square - np.array(C)[:, None])
    n = np.sqrt(1 + (np.array(B)[:, None] * terms).sum(0))
    assert np.array(through(scene, lines)) == pytest.approx(deflection(n), abs=2e-6)
    slopes = (deflection(n + 1e-5) - deflection(n - 1e-5)) / 2e-5 / (2 * n)
    wanted = {f"glass.B{i + 1}": slopes * terms[i] for i in range(3)}
    wanted |= {f"glass.C{i + 1}": slopes * B[i] * terms[i] ** 2 / square for i in range(3)}
    assert {key for key in mi.traverse(scene).properties if key.startswith("glass.")} == {*wanted}
    check_derivatives(scene, wanted)


def check_derivatives(scene: mi.Scene, wanted: dict[str, np.ndarray]) -> None:
    """Assert that the deflections of three rays have these derivatives by the parameters."""
    params, lines = mi.traverse(scene), np.array([F_LINE, D_LINE, C_LINE])
    for key, derivative in wanted.items():
        value = mi.Float(dr.detach(params[key]))
        dr.enable_grad(value)
        params[key] = value
        params.update()
        found = through(scene, lines)
        dr.forward(value)
        rounding = 1e-4 * np.abs(derivative).max()
        assert np.array(dr.grad(found)) == pytest.approx(derivative, rel=2e-3, abs=rounding), key
        params[key] = mi.Float(dr.detach(value))


def rays(count: int) -> tuple[mi.SurfaceInteraction3f, mi.Float, mi.Point2f]:
    """Return interactions from both sides of a boundary, each with four wavelengths, and random numbers."""
    random = mi.PCG32(size=count)
    draw = lambda: random.next_float32()  # noqa: E731
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.wi = mi.warp.square_to_uniform_sphere(mi.Point2f(draw(), draw()))
    si.sh_frame, si.n = mi.Frame3f(mi.Vector3f(0, 0, 1)), mi.Normal3f(0, 0, 1)
    if mi.is_spectral:
        si.wavelengths = mi.sample_shifted(draw()) * 400 + 380
    return si, draw(), mi.Point2f(draw(), draw())


GLASS = {"type": "dispersivedielectric", "material": "N-SF11"}


@taking_turns("mode", ["Radiance", "Importance"], "rough", [None, 0.3])
def test_each_wavelength_scatters_as_in_mitsubas_dielectric(rough: float | None, mode: str, spectral: None) -> None:
    """With one wavelength, samples, values and densities are equal to those of Mitsuba's plugins. With four, the mean
    of each weighted by a function of the direction is that of the wavelength alone.
    """
    context, count = mi.BSDFContext(getattr(mi.TransportMode, mode)), 50_000
    more = {} if rough is None else {"alpha": rough}
    glass = mi.load_dict(GLASS | more)
    si, sample1, sample2 = rays(count)
    n = find_glass("N-SF11").index(550.0)
    one = type(si)(si)
    one.wavelengths = mi.Spectrum(550.0)
    kind = "dielectric" if rough is None else "roughdielectric"
    stock = mi.load_dict({"type": kind, "int_ior": n, "ext_ior": 1.0} | more)
    # Four equal wavelengths: the drawn one does not matter, only the rest of the random number does.
    number = mi.Float(sample1)
    ours, theirs = glass.sample(context, one, number / 4, sample2), stock.sample(context, one, number, sample2)
    same = np.array((ours[0].sampled_type == theirs[0].sampled_type) | (ours[1][0] == theirs[1][0]))
    assert same.mean() > 0.9999
    same &= np.array(theirs[1][0] > 0)  # otherwise Mitsuba's densities have no meaning
    for a, b in ((ours[0].wo, theirs[0].wo), (ours[0].pdf, theirs[0].pdf), (ours[0].eta, theirs[0].eta),
                 (ours[1], theirs[1])):  # fmt: skip
        first, second = (np.atleast_2d(np.array(each))[:, same] for each in (a, b))
        assert np.mean(np.isclose(first, second, rtol=2e-3, atol=2e-4)) > 0.999
    if rough is not None:
        wo = mi.warp.square_to_uniform_sphere(sample2)
        for a, b in zip(glass.eval_pdf(context, one, wo), stock.eval_pdf(context, one, wo), strict=True):
            assert np.allclose(np.array(a), np.array(b), rtol=1e-3, atol=1e-5)

    def means(where: mi.SurfaceInteraction3f) -> tuple[np.ndarray, np.ndarray]:
        bs, weight = glass.sample(context, where, sample1, sample2)
        tests = [mi.Float(1), bs.wo.x, dr.select(bs.wo.z > 0, 1, 0), bs.wo.x * where.wi.x]
        values = np.array([np.array(weight[c] * test) for c in range(4) for test in tests])
        return values.mean(1), values.std(1) / np.sqrt(count)

    mixed, errors = means(si)
    bs, weight = glass.sample(context, si, sample1, sample2)
    for c in range(4):
        alone = type(si)(si)
        alone.wavelengths = mi.Spectrum(si.wavelengths[c])
        if rough is None:  # whatever arrives at this wavelength is reflected, or follows Snell's law
            n = find_glass("N-SF11").index(si.wavelengths[c])
            bent = -si.wi.x * dr.select(si.wi.z > 0, 1 / n, n)
            follows = (bs.wo.z * si.wi.z > 0) | (dr.abs(bs.wo.x - bent) < 1e-5)
            assert dr.all(follows | (weight[c] == 0))
        else:
            together, single = (glass.eval(context, each, wo) for each in (si, alone))
            assert np.allclose(np.array(together[c]), np.array(single[c]), rtol=1e-4)
        wanted, noise = means(alone)
        part = slice(4 * c, 4 * c + 4)
        z = (mixed[part] - wanted[part]) / np.hypot(errors[part], noise[part])
        assert np.abs(z).max() < 4, z


def test_variants_without_wavelengths_have_the_index_at_d(llvm: str) -> None:
    if mi.is_spectral:
        pytest.skip("this variant has wavelengths")
    register()
    glass = mi.load_dict(GLASS)
    stock = mi.load_dict({"type": "dielectric", "int_ior": find_glass("N-SF11").nd, "ext_ior": 1.0})
    si, sample1, sample2 = rays(1000)
    for ours, theirs in zip(*(bsdf.sample(mi.BSDFContext(), si, sample1, sample2)[0].wo for bsdf in (glass, stock)),
                            strict=True):  # fmt: skip
        assert np.allclose(np.array(ours), np.array(theirs), atol=1e-6)
    assert set(mi.traverse(glass).properties) == {"nd"}  # V_d has no effect


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"material": "BK7"}, "did you mean `N-BK7`"),
        ({"nd": 1.5}, "both `nd` and `Vd`"),
        ({"nd": 0.9, "Vd": 50.0}, "nd above 1"),
        ({"sellmeier": "1, 2, 3"}, "as many coefficients B as C"),
        ({"sellmeier": " "}, "as many coefficients B as C"),
        ({"material": "F2", "sellmeier": "1, 0.1"}, "remove one"),
        ({"sellmeier": "1, 0.2"}, "pole at a visible wavelength"),
        ({"sellmeier": "1, 3"}, "not above 1"),
    ],
)
def test_wrong_glass_is_refused(options: dict[str, object], said: str, llvm: str) -> None:
    register()
    with pytest.raises(Exception, match=said):
        mi.load_dict({"type": "dispersivedielectric"} | options)


def test_a_white_surface_has_the_colour_of_the_illuminant(llvm: str) -> None:
    """Colours by wavelength and by RGB agree, and D65 is white."""
    colours = {}
    with_them = with_wavelengths(llvm)
    for variant in (with_them, llvm):
        mi.set_variant(variant)
        register()
        for name in ("D65", "A", "LED-B3"):
            lamp = {"type": "constant", "radiance": {"type": "illuminant", "name": name, "scale": 0.5}}
            film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
            scene = mi.load_dict({"type": "scene", "lamp": lamp, "camera": {"type": "perspective", "film": film},
                                  "integrator": {"type": "path", "hide_emitters": False}})  # fmt: skip
            colours[variant, name] = np.array(mi.render(scene, spp=1024)).mean((0, 1))[:3]
    assert colours[llvm, "D65"] == pytest.approx([0.5, 0.5, 0.5], abs=2e-3)
    for name in ("D65", "A", "LED-B3"):
        assert colours[with_them, name] == pytest.approx(colours[llvm, name], abs=0.015), name
    with pytest.raises(Exception, match="there is no illuminant 'D64'; did you mean `D65`"):
        mi.load_dict({"type": "illuminant", "name": "D64"})


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"camera": "Nikon D5100", "channel": "red"}, "no camera 'Nikon D5100'; did you mean `Nikon 5100`"),
        ({"camera": "Nikon 5100", "channel": "R"}, "no channel 'R'; known are red, green, blue"),
        ({"camera": "Nikon 5100", "channel": "red"}, "needs wavelengths"),
    ],
)
def test_wrong_cameras_are_refused(options: dict[str, str], said: str, llvm: str) -> None:
    register()
    with pytest.raises(Exception, match=said):
        mi.load_dict({"type": "sensitivity"} | options)
