"""Plugins of `reslrb`: glass with dispersion, and spectra of standard illuminants and cameras.

`dispersivedielectric` is a boundary to a glass whose index depends on the wavelength (`glasses.py`). Mitsuba's own
dielectrics have one index.

A ray carries several wavelengths. A sample draws one of them, and scatters like `dielectric` or `roughdielectric` with
the index at this wavelength. The density is the mean over the wavelengths that the ray carries (balance heuristic).

- Behind a smooth boundary, refracted light keeps only wavelengths that equal the drawn one. If a ray carries one
    wavelength four times, its weight is that of a dielectric. If a ray carries four, three weights are 0, and that of
    the drawn one is 4. Both are unbiased with every integrator; k refractions of four wavelengths leave 4^-k of them.
- Behind a rough boundary, all wavelengths go on. If the lobe is wide compared with the dispersion, weights are near 1.

In variants without wavelengths, the index is n_d.
"""

from __future__ import annotations

import functools
import re
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.colorimetry import colour_of, illuminant, sensitivity
from reslrb_cli.glasses import Glass, cauchy_shape, find_glass, index_of
from reslrb_cli.scene.rays import visible

#: Names of our plugins in scene files.
GLASS, ILLUMINANT, SENSITIVITY = "dispersivedielectric", "illuminant", "sensitivity"
#: Keys of Sellmeier coefficients.
COEFFICIENT = re.compile(r"\.([BC])\d$")
#: Name of the class of `GLASS`.
GLASS_CLASS = "DispersiveDielectric"
#: Shortest wavelength in nm at which an index is evaluated: idle lanes have none, and Sellmeier's formula has poles
#: in the ultraviolet.
_SHORTEST = 300.0


def register() -> None:
    """Register the plugins for the current variant. A second call has no effect."""
    mi.register_bsdf(GLASS, lambda props: _glass_class(mi.variant())(props))
    mi.register_texture(ILLUMINANT, make_illuminant)
    mi.register_texture(SENSITIVITY, make_sensitivity)


def bends_light(params: mi.SceneParameters, key: str) -> bool:
    """True if a parameter changes directions of refraction: n_d, V_d, or a coefficient of a glass with dispersion."""
    node = params.properties[key][2] if key in params.properties else None
    return node is not None and node.class_name() == GLASS_CLASS and not key.endswith(".alpha")


def make_illuminant(props: mi.Properties) -> mi.Texture:
    """Return the spectrum of the illuminant `name` (such as D65, A, FL2, LED-B1), times `scale`.

    The luminance at a scale of 1 equals that of a uniform spectrum of 1. Variants without wavelengths have the colour
    of the illuminant. Raises ValueError for an unknown name.
    """
    wavelengths = visible()
    values = float(props.get("scale", 1.0)) * illuminant(props["name"], wavelengths)
    if mi.is_spectral:
        return _regular(wavelengths, values)
    made = mi.Properties("srgb")
    made["color"] = mi.ScalarColor3f(*colour_of(values, wavelengths))
    made["unbounded"] = True
    return mi.PluginManager.instance().create_object(made)


def make_sensitivity(props: mi.Properties) -> mi.Texture:
    """Return the spectrum of a `channel` (red, green or blue) of a `camera`, for a film's response.

    A uniform spectrum of 1 gives 1 in the most sensitive channel. Raises ValueError for unknown names, and in variants
    without wavelengths.
    """
    curve = sensitivity(props["camera"], props["channel"])
    if not mi.is_spectral:
        raise ValueError(f"{SENSITIVITY} needs wavelengths: set `variant` to llvm_ad_spectral or cuda_ad_spectral")
    return _regular(*curve)


def _regular(wavelengths: np.ndarray, values: np.ndarray) -> mi.Texture:
    """Return a spectrum that is linear between its values.

    The spectrum does not have the id of the plugin that makes it, so that `export` replaces this plugin by a spectrum
    with the recovered values.
    """
    made = mi.Properties("regular")
    made["wavelength_min"], made["wavelength_max"] = float(wavelengths[0]), float(wavelengths[-1])
    made["values"] = ", ".join(f"{value:.9g}" for value in values)
    return mi.PluginManager.instance().create_object(made)


@functools.cache
def _glass_class(variant: str) -> type[mi.BSDF]:
    """Return the class of `dispersivedielectric` for a variant, which must be set."""

    class DispersiveDielectric(mi.BSDF):
        """Boundary to a glass with dispersion, on the side against the normal. `ext_ior` is the index outside.

        The glass has the name `material` of the catalogue, or the numbers `nd` and `Vd`, or the coefficients
        `sellmeier` (B1, ..., C1, ..., with C in square micrometres). `nd` and `Vd` may also replace those of a
        material or of coefficients. The shape g of the dispersion stays the same. With `alpha`, the boundary is rough,
        and its normals have the `distribution`.

        Its parameters are the coefficients if the scene gives only `sellmeier`, otherwise `nd` and `Vd`.
        """

        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            if mi.is_polarized:
                raise ValueError(f"{GLASS} does not support polarization")
            glass = _glass_of(props)
            self.shape = cauchy_shape if glass is None else glass.shape
            nd, Vd = (float(props[name]) if name in props else getattr(glass, name, None) for name in ("nd", "Vd"))
            if nd is None or Vd is None:
                raise ValueError(f"{GLASS} needs `material`, `sellmeier`, or both `nd` and `Vd`")
            self.ext_ior = float(props.get("ext_ior", 1.0))
            self.alpha = mi.Float(props["alpha"]) if "alpha" in props else None
            self.distribution = props.get("distribution", "beckmann")
            if not (nd > 1 and Vd > 0 and self.ext_ior >= 1):
                raise ValueError(f"{GLASS} needs nd above 1, Vd above 0, and ext_ior of at least 1")
            if self.distribution not in ("ggx", "beckmann"):
                raise ValueError(f"distribution must be ggx or beckmann, not {self.distribution!r}")
            self.nd, self.Vd = mi.Float(nd), mi.Float(Vd)
            #: The glass by its coefficients, if these are the parameters.
            self.coefficients: Glass | None = None
            if glass is not None and mi.is_spectral and "sellmeier" in props and not {"nd", "Vd"} & {*props.keys()}:
                self.coefficients = Glass(tuple(map(mi.Float, glass.B)), tuple(map(mi.Float, glass.C)))
            sides, flags = mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide, mi.BSDFFlags
            smooth = self.alpha is None
            reflection = flags.DeltaReflection if smooth else flags.GlossyReflection
            transmission = flags.DeltaTransmission if smooth else flags.GlossyTransmission
            self.m_components = [int(reflection | sides), int(transmission | sides | flags.NonSymmetric)]
            self.m_flags = self.m_components[0] | self.m_components[1]

        def traverse(self, callback: mi.TraversalCallback) -> None:
            flags = mi.ParamFlags.Differentiable | mi.ParamFlags.Discontinuous
            if self.coefficients is not None:
                for letter, values in (("B", self.coefficients.B), ("C", self.coefficients.C)):
                    for number, value in enumerate(values, 1):
                        callback.put(f"{letter}{number}", value, flags)
            else:
                callback.put("nd", self.nd, flags)
                if mi.is_spectral:  # it has no effect in other variants
                    callback.put("Vd", self.Vd, flags)
            if self.alpha is not None:
                callback.put("alpha", self.alpha, flags)

        def indices(self, si: mi.SurfaceInteraction3f) -> list[mi.Float]:
            """Return the index inside, divided by that outside, for each wavelength of the ray."""
            if not mi.is_spectral:
                return [self.nd / self.ext_ior]
            wavelengths = dr.maximum(si.wavelengths, _SHORTEST)
            if self.coefficients is not None:
                n = self.coefficients.index(wavelengths)
            else:
                n = index_of(self.nd, self.Vd, self.shape, wavelengths)
            return [each / self.ext_ior for each in n]

        def sample(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, sample1: mi.Float, sample2: mi.Point2f,
            active: mi.Bool | bool = True,
        ) -> tuple[mi.BSDFSample3f, mi.Spectrum]:  # fmt: skip
            cos_i, indices = mi.Frame3f.cos_theta(si.wi), self.indices(si)
            active = active & (cos_i != 0)
            m = mi.Normal3f(0, 0, 1)
            if self.alpha is not None:
                m, _ = self._normals().sample(dr.mulsign(si.wi, cos_i), sample2)
            # Draw a wavelength, and then reflection or refraction.
            count = len(indices)
            drawn = dr.minimum(mi.UInt32(sample1 * count), count - 1)
            rest, eta = sample1 * count - drawn, indices[0]
            for number in range(1, count):
                eta = dr.select(drawn == number, indices[number], eta)
            R, cos_t, eta_it, eta_ti = mi.fresnel(dr.dot(si.wi, m), eta)
            reflects = rest <= R
            refracted = mi.refract(si.wi, m, cos_t, eta_ti)
            bs = dr.zeros(mi.BSDFSample3f)
            bs.wo = dr.select(reflects, mi.reflect(si.wi, m), refracted)
            bs.eta = dr.select(reflects, 1, eta_it)
            types = [mi.UInt32(flags & int(mi.BSDFFlags.All)) for flags in self.m_components]
            bs.sampled_type = dr.select(reflects, *types)
            bs.sampled_component = dr.select(reflects, mi.UInt32(0), mi.UInt32(1))
            if self.alpha is None:
                bs.pdf, factors = self._smooth(ctx, si, indices, drawn, reflects)
            else:
                bs.pdf, values = self._rough(ctx, si, bs.wo, indices)
                # The choice between reflection and refraction has no derivative of its own.
                chosen = dr.select(reflects, R, 1 - R)
                kept = dr.select(chosen > 0, chosen / dr.detach(chosen), 1) / bs.pdf
                factors = [value * kept for value in values]
            active &= bs.pdf > 0
            bs.pdf = dr.select(active, bs.pdf, 0)
            return bs, dr.select(active, _spectrum(factors), 0)

        def _smooth(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, indices: list[mi.Float], drawn: mi.UInt32,
            reflects: mi.Bool,
        ) -> tuple[mi.Float, list[mi.Float]]:  # fmt: skip
            """Return the probability of a sampled direction, without derivatives, and the weight by wavelength."""
            found = [mi.fresnel(mi.Frame3f.cos_theta(si.wi), eta) for eta in indices]
            goes = [mi.Bool(True)]  # whether a wavelength has the refracted direction
            if len(indices) > 1:
                wavelength = si.wavelengths[0]
                for number in range(1, len(indices)):
                    wavelength = dr.select(drawn == number, si.wavelengths[number], wavelength)
                goes = [si.wavelengths[number] == wavelength for number in range(len(indices))]
            refracted = [dr.select(same, 1 - R, 0) for (R, *_), same in zip(found, goes, strict=True)]
            shares = [dr.select(reflects, R, T) for (R, *_), T in zip(found, refracted, strict=True)]
            pdf = dr.detach(sum(shares) / len(indices))
            values = [share / pdf for share in shares]
            if ctx.mode == mi.TransportMode.Radiance:
                values = [dr.select(reflects, each, each * dr.square(eta_ti))
                          for each, (*_, eta_ti) in zip(values, found, strict=True)]  # fmt: skip
            return pdf, values

        def _normals(self) -> mi.MicrofacetDistribution:
            kind = mi.MicrofacetType.GGX if self.distribution == "ggx" else mi.MicrofacetType.Beckmann
            return mi.MicrofacetDistribution(kind, self.alpha, True)

        def _rough(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, indices: list[mi.Float]
        ) -> tuple[mi.Float, list[mi.Float]]:  # fmt: skip
            """Return the density of the direction `wo`, and the value of the BSDF times cosine by wavelength."""
            wi, normals = si.wi, self._normals()
            cos_i, cos_o = mi.Frame3f.cos_theta(wi), mi.Frame3f.cos_theta(wo)
            reflects, density, values = cos_i * cos_o > 0, mi.Float(0), []
            for index in indices:
                eta = dr.select(cos_i > 0, index, 1 / index)
                m = dr.normalize(wi + wo * dr.select(reflects, 1, eta))
                m = mi.Normal3f(dr.mulsign(m, m.z))
                i, o = dr.dot(wi, m), dr.dot(wo, m)
                valid = (cos_i != 0) & (i * cos_i > 0) & (o * cos_o > 0)
                R, D, G = mi.fresnel(i, index)[0], normals.eval(m), normals.G(wi, wo, m)
                share = dr.select(reflects, R, 1 - R)
                # Derivative of the microfacet normal by wo, without |o|.
                stretch = dr.select(reflects, 0.25, dr.square(eta) * dr.abs(i * o) / dr.square(i + eta * o))
                value = share * D * G * stretch / dr.abs(cos_i)
                if ctx.mode == mi.TransportMode.Radiance:
                    value = dr.select(reflects, value, value / dr.square(eta))
                pdf = share * normals.pdf(dr.mulsign(wi, cos_i), m) * stretch / dr.abs(i)
                values.append(dr.select(valid, value, 0))
                density += dr.select(valid, pdf, 0) / len(indices)
            return density, values

        def eval_pdf(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool | bool = True
        ) -> tuple[mi.Spectrum, mi.Float]:  # fmt: skip
            if self.alpha is None:
                return mi.Spectrum(0), mi.Float(0)
            density, values = self._rough(ctx, si, wo, self.indices(si))
            return dr.select(active, _spectrum(values), 0), dr.select(active, density, 0)

        def eval(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool | bool = True
        ) -> mi.Spectrum:  # fmt: skip
            return self.eval_pdf(ctx, si, wo, active)[0]

        def pdf(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool | bool = True
        ) -> mi.Float:  # fmt: skip
            return self.eval_pdf(ctx, si, wo, active)[1]

        def class_name(self) -> str:
            return GLASS_CLASS

        def to_string(self) -> str:
            rough = "" if self.alpha is None else f", alpha = {self.alpha[0]:g}"
            glass = self.coefficients
            if glass is None:
                return f"{GLASS_CLASS}[nd = {self.nd[0]:g}, Vd = {self.Vd[0]:g}{rough}]"
            numbers = ", ".join(f"{value[0]:g}" for value in (*glass.B, *glass.C))
            return f"{GLASS_CLASS}[sellmeier = {numbers}{rough}]"

    return DispersiveDielectric


def _glass_of(props: mi.Properties) -> Glass | None:
    """Return the glass of a plugin's `material`, or of its `sellmeier`. `B1`, ..., `C1`, ... replace its coefficients.
    Raises ValueError if there are both, or a wrong one.
    """
    if "material" in props and "sellmeier" in props:
        raise ValueError(f"{GLASS} has both `material` and `sellmeier`; remove one")
    if "material" in props:
        return find_glass(props["material"])
    if "sellmeier" not in props:
        return None
    numbers = [float(word) for word in str(props["sellmeier"]).replace(",", " ").split()]
    half = len(numbers) // 2
    if not numbers or len(numbers) % 2:
        raise ValueError("sellmeier needs as many coefficients B as C, such as `1.04, 0.23, 1.01, 0.006, 0.02, 103.6`")
    names = [f"{letter}{number}" for letter in "BC" for number in range(1, half + 1)]
    numbers = [float(props.get(name, value)) for name, value in zip(names, numbers, strict=True)]
    B, C = tuple(numbers[:half]), tuple(numbers[half:])
    ends = [(float(end) / 1000) ** 2 for end in visible()[[0, -1]]]
    if any(ends[0] <= pole <= ends[1] for pole in C):
        raise ValueError(f"sellmeier has a pole at a visible wavelength; C must be below {ends[0]:.3f} or above "
                         f"{ends[1]:.3f}")  # fmt: skip
    glass = Glass(B, C)
    with np.errstate(invalid="ignore"):
        least = glass.index(visible()).min()
    if not least > 1:
        raise ValueError("sellmeier gives an index that is not above 1 at all visible wavelengths")
    return glass


def _spectrum(values: list[Any]) -> mi.Spectrum:
    return mi.Spectrum(values[0]) if len(values) == 1 else mi.Spectrum(*values)
