"""The film: splatting through its reconstruction filter, and the exact adjoint of splatting.

The adjoint of a splat looks up dL/dI at the film position. filter_p(u) is the weight of pixel p for film position u.
The weights sum to 1 over the pixels.

    splat:   I_p += filter_p(u) C
    lookup:  delta = sum_p filter_p(u) dL/dI_p

In a spectral variant, C has a value for each wavelength of the path, and a pixel has channels. `Colours` converts from
wavelengths to channels, and adjoints from channels to wavelengths.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.backend.memory import own_memory
from reslrb_cli.scene.rays import visible
from reslrb_cli.transport.factors import showing

N_COLOR = 3  # a film's block holds R, G, B, optional alpha, and a weight that light tracing leaves at 0


@dataclass
class Colours:
    """Wavelengths of each lane's path, and the film's response to them.

    A value C_k at wavelength k adds weights[c]_k C_k to channel c. In other than spectral variants there are no
    wavelengths, `weights` is empty, and the values of a path are the channels of the film.
    """

    wavelengths: mi.Wavelength
    weights: list[mi.Spectrum]

    def channels(self, value: mi.Spectrum, count: int) -> list[mi.Float]:
        """Return the `count` channels of a value (C,) of a path."""
        if self.weights:
            return [dr.dot(weights, value) for weights in self.weights]
        return [value[c % len(value)] for c in range(count)]  # a mono variant fills all three

    def adjoint(self, delta: Channels) -> mi.Spectrum:
        """Return the adjoint (C,) of a path's value. `delta` is the adjoint of the film's channels."""
        if not self.weights:
            return delta
        return sum((weights * own for weights, own in zip(self.weights, delta, strict=True)), mi.Spectrum(0))

    def seen(self, value: mi.Spectrum) -> mi.Spectrum:
        """Return the magnitude (C,) of a path's value, as the film sees it."""
        return value * sum(dr.abs(weights) for weights in self.weights) if self.weights else value


#: Values of a film's channels: a Spectrum, or an array with an entry for each channel in a spectral variant.
Channels = Any


class Film:
    """Film of one sensor in light tracing: image blocks for splatting, adjoint images for lookups."""

    def __init__(self, sensor: mi.Sensor, whole: bool = False, responses: mi.Float | None = None) -> None:
        """Prepare the film of a sensor.

        With `whole`, each pixel is divided by the part of its filter that lies on the film, as Mitsuba's camera
        integrators do. Otherwise, pixels at the border lack the light that falls off the film, as with `ptracer`.
        Recordings pass the `responses` of `responses_of` as an input.
        """
        self.film, self.whole = sensor.film(), whole
        self.responses = responses_of(self.film) if responses is None else responses
        #: Whether recordings take all data of the film. Mitsuba 3.9 leaves out a film's own responses.
        self.is_recordable = not _is_spectral(self.film)
        #: Number of colour channels in a block.
        self.colors = int(self.film.base_channels_count()) if _is_spectral(self.film) else N_COLOR
        self.integrals = _integrals(self.film.rfilter()) if whole else []
        self.film.prepare([])
        self.size = self.film.crop_size()
        self.offset = self.film.crop_offset()

    def colours(self, wavelengths: mi.Wavelength) -> Colours:
        """Return the response of the film to paths with these wavelengths."""
        if self.responses is None:
            return Colours(wavelengths, [])
        wavelengths = dr.detach(wavelengths)
        return Colours(wavelengths, responses_at(self.responses, self.colors, wavelengths))

    def block(self) -> mi.ImageBlock:
        """Return an empty image block that covers the crop window. Filter weights are normalised per splat."""
        block = self.film.create_block(normalize=not self.whole, borders=False)
        block.set_offset(self.offset)
        block.set_coalesce(False)  # splats of neighbouring lanes land in arbitrary pixels
        return block

    def put(
        self, block: mi.ImageBlock, u: mi.Point2f, value: mi.Spectrum, active: mi.Bool, colours: Colours,
        normalization: bool = False,
    ) -> None:  # fmt: skip
        """Add `value` (C,) of paths with these `colours` at film position `u` (pixels, relative to the crop window)
        through the filter.

        Under naive AD, the pixels' weights have derivatives with respect to `u`. Mitsuba divides the filter weights by
        their sum, and detaches this sum. With `normalization`, the sum is differentiated as well. If the film is
        `whole`, the filter weights are not divided by their sum.
        """
        if normalization and not self.whole:
            _, total = self.taps(u, normalization)
            value = value * dr.select(total != 0, dr.detach(total) / total, 1)
        color = colours.channels(value, self.colors)
        if block.channel_count() != len("RGBW"):
            color = [showing(c) for c in color]  # they are added one by one, not as a packet
        block.put(u + mi.Vector2f(self.offset), color + [mi.Float(0)] * (block.channel_count() - len(color)), active)

    def taps(self, u: mi.Point2f, normalization: bool) -> tuple[list[tuple[mi.Point2u, mi.Float]], mi.Float]:
        """Return the pixels that a splat at film position `u` touches, with the filter weights of `ImageBlock.put`, and
        the total that divides the weights. The total includes pixels off the film, and is 1 if the film is `whole`.

        Without `normalization`, the total has no derivative.
        """
        rfilter = self.film.rfilter()
        radius, center = rfilter.radius(), u - 0.5
        n = int(dr.ceil(2 * radius))
        first = mi.Point2i(dr.ceil(center - radius))
        columns = [rfilter.eval(mi.Float(first.x + i) - center.x) for i in range(n)]
        rows = [rfilter.eval(mi.Float(first.y + i) - center.y) for i in range(n)]
        total = mi.Float(1) if self.whole else sum(columns) * sum(rows)
        if not normalization:
            total = dr.detach(total)
        return [
            (mi.Point2u(mi.Point2i(first.x + x, first.y + y)), columns[x] * rows[y]) for y in range(n) for x in range(n)
        ], total

    def add(
        self, block: mi.ImageBlock, pixel: mi.Point2u, value: mi.Spectrum, active: mi.Bool, colours: Colours
    ) -> None:
        """Add `value` (C,) to one pixel if it is on the film."""
        inside = active & (pixel.x < self.size.x) & (pixel.y < self.size.y)
        index, channels = dr.fma(pixel.y, mi.UInt32(self.size.x), pixel.x), block.channel_count()
        for c, own in enumerate(colours.channels(value, self.colors)):
            at, one = index * channels + c, showing(own)
            dr.scatter_reduce(dr.ReduceOp.Add, block.tensor().array, one, at, inside)

    def develop(self, block: mi.ImageBlock, tangent: bool = False) -> mi.TensorXf:
        """Return the image (H, W, channels) in the film's own pixel format, differentiable with respect to the block.

        With `tangent`, the block is a derivative. The opaque alpha channel has no derivative.
        """
        self.film.prepare([])
        if block.channel_count() == self.colors + len("AW") and not tangent:
            # Light tracing computes no coverage: every pixel is opaque.
            alpha = dr.arange(mi.UInt32, dr.prod(self.size)) * block.channel_count() + N_COLOR
            dr.scatter(block.tensor().array, mi.Float(1), alpha)
        self.film.put_block(block)
        image = self.film.develop()
        return image / self._filter_on_film(image.shape) if self.whole else image

    def _filter_on_film(self, shape: tuple[int, ...]) -> mi.TensorXf:
        """Return the part of each pixel's filter that lies on the film, for an image of this shape (H, W, channels)."""
        height, width, channels = shape
        lane = dr.arange(mi.UInt32, height * width * channels)
        pixel = lane // channels
        part = mi.Float(1)
        for place, n in ((pixel % width, width), (pixel // width, height)):
            inside = mi.Float(0)
            for offset, integral in self.integrals:
                there = mi.Int32(place) + offset
                inside += dr.select((there >= 0) & (there < n), integral, 0)
            part *= inside
        if channels in (2, 4) and not _is_spectral(self.film):
            part = dr.select(lane % channels == channels - 1, 1, part)  # alpha is unchanged
        return mi.TensorXf(part, shape)

    def adjoint(self, image_gradient: mi.TensorXf) -> AdjointImage:
        """Return the adjoint of splatting to a block, given dL/dI of the developed image (`image_gradient`)."""
        with dr.resume_grad():
            block = self.block()
            dr.enable_grad(block.tensor())
            before = type(block.tensor())(block.tensor())  # `develop` overwrites an alpha channel
            image = self.develop(block)
            dr.backward_from(image * dr.detach(image_gradient))
            gradient = dr.grad(before)
        dr.eval(gradient)  # evaluated before tracing, where it would split a kernel
        return AdjointImage(self, mi.Float(gradient.array), block.channel_count())


class AdjointImage:
    """dL/dI for lookups at film positions, through the pixel filter.

    `image` is the derivative of L with respect to the film's block, in the block's order: H * W * `channels` values. It
    differs from dL/dI of the developed image by the pixel format and, on a `whole` film, by a factor at the border.
    """

    def __init__(self, film: Film, image: mi.Float, channels: int) -> None:
        self.image, self.channels, self.film = image, channels, film

    def lookup(
        self, u: mi.Point2f, active: mi.Bool, colours: Colours, normalization: bool = True
    ) -> mi.Spectrum:  # fmt: skip
        """Return delta (C,) at film position `u` (pixels, relative to the crop window), for paths with these
        `colours`. If gradients are enabled, delta has a derivative with respect to `u`.

        Without `normalization`, the sum that divides the filter's weights has no derivative, as in Mitsuba.
        """
        if self.film.film.rfilter().is_box_filter():  # 1 within a pixel, with or without normalisation
            pixel = mi.Point2u(mi.Point2i(dr.floor(u)))
            inside = active & (pixel.x < self.film.size.x) & (pixel.y < self.film.size.y)
            return colours.adjoint(self._pixel(pixel, inside))
        delta = self._channels([mi.Float(0)] * self.film.colors)
        taps, total = self.film.taps(u, normalization)
        for pixel, weight in taps:
            inside = active & (pixel.x < self.film.size.x) & (pixel.y < self.film.size.y)
            delta += self._pixel(pixel, inside) * weight
        return colours.adjoint(delta * dr.select(total != 0, dr.rcp(total), 0))

    def _pixel(self, pixel: mi.Point2u, active: mi.Bool) -> Channels:
        index = dr.fma(pixel.y, mi.UInt32(self.film.size.x), pixel.x)
        if self.channels == len("RGBW"):
            color = dr.gather(mi.Vector4f, self.image, index, active)  # one packet
        else:
            colors = range(self.film.colors)
            color = [dr.gather(mi.Float, self.image, index * self.channels + c, active) for c in colors]
        return self._channels([color[c] for c in range(self.film.colors)])

    def _channels(self, color: list[mi.Float]) -> Channels:
        if mi.is_spectral:
            return mi.Color3f(*color) if len(color) == N_COLOR else mi.ArrayXf(color)
        return mi.Spectrum(*color) if mi.is_rgb else mi.Spectrum(sum(color))


STEPS = 256  # for a filter's integral, in each pixel


@functools.lru_cache(maxsize=64)
def _integrals(rfilter: mi.ReconstructionFilter) -> list[tuple[int, float]]:
    """Return the integral of a pixel's filter over each pixel that the filter reaches, along one axis. Each integral
    comes with the offset of the reached pixel.
    """
    taps = int(np.ceil(float(rfilter.radius()) - 0.5))
    x = (np.arange((2 * taps + 1) * STEPS) + 0.5) / STEPS - taps - 0.5
    values = np.array(rfilter.eval(mi.Float(x.astype(np.float32))), np.float64)
    return list(zip(range(-taps, taps + 1), values.reshape(-1, STEPS).mean(1).tolist(), strict=True))


# ---- Response to wavelengths ----

#: Distance in nm between wavelengths at which a film's own responses are evaluated.
FINE = 0.5


def responses_of(film: mi.Film) -> mi.Float | None:
    """Return the responses of a film's channels at evenly spaced wavelengths, one channel after the other. Without
    wavelengths, the result is None.
    """
    if not mi.is_spectral:
        return None
    if not _is_spectral(film):
        return _rgb_responses(mi.variant())
    channels = int(film.base_channels_count())
    film.prepare([])
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wavelengths = mi.Spectrum(mi.Float(visible(FINE).astype(np.float32)))
    # The film divides each value by the sum of all responses, by which its sensor multiplies radiance.
    total = film.sensor_response_function().eval(si)
    parts = film.prepare_sample(total, si.wavelengths, channels + 1)
    return own_memory(mi.Float, np.ravel([np.array(part) for part in parts[:channels]]).astype(np.float32))


@functools.lru_cache(maxsize=2)
def _rgb_responses(variant: str) -> mi.Float:
    values = np.array(mi.linear_rgb_rec(mi.Float(visible().astype(np.float32)))) * float(mi.MI_CIE_Y_NORMALIZATION)
    return own_memory(mi.Float, np.ravel(values).astype(np.float32))


def responses_at(table: mi.Float, channels: int, wavelengths: mi.Wavelength) -> list[mi.Spectrum]:
    """Return the response of each channel at the wavelengths, divided by the number of wavelengths. `table` is that of
    `responses_of`.
    """
    count = dr.width(table) // channels
    low, high = mi.MI_CIE_MIN, mi.MI_CIE_MAX
    place = (wavelengths - low) * ((count - 1) / (high - low))
    visible = (wavelengths >= low) & (wavelengths <= high)
    result = [mi.Spectrum(0) for _ in range(channels)]
    for k in range(len(wavelengths)):
        below = dr.clip(mi.UInt32(place[k]), 0, count - 2)
        share = place[k] - mi.Float(below)
        for c in range(channels):
            values = [dr.gather(mi.Float, table, below + (c * count + step), visible[k]) for step in (0, 1)]
            result[c][k] = dr.lerp(*values, share) * (1 / len(wavelengths))
    return result


def _is_spectral(film: mi.Film) -> bool:
    """True if the film has its own response functions."""
    return bool(mi.has_flag(film.flags(), mi.FilmFlags.Spectral))
