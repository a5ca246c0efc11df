"""Indices of refraction by wavelength: a catalogue of glasses, and two numbers that describe any glass.

The index at the wavelength lambda is

    n(lambda) = n_d + (n_d - 1) / V_d g(lambda),      g(d) = 0,   g(F) - g(C) = 1

n_d is the index at the helium line d, V_d = (n_d - 1) / (n_F - n_C) is Abbe's number, and g is the shape of the
dispersion. For a glass of the catalogue, g comes from its Sellmeier coefficients, so n(lambda) equals their curve. For
any other glass, g is linear in 1 / lambda^2, which is Cauchy's formula with two terms. Indices are relative to air,
wavelengths are in nm.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from reslrb_cli.errors import known_name

#: Spectral lines of n_d and V_d, in nm: helium d, hydrogen F and C.
D_LINE, F_LINE, C_LINE = 587.5618, 486.1327, 656.2725


@dataclass(frozen=True)
class Glass:
    """Material with Sellmeier's formula n^2 = 1 + sum_i B_i lambda^2 / (lambda^2 - C_i), for lambda in micrometres.

    Coefficients are numbers, or arrays of Dr.Jit. `source` is their publication.
    """

    B: tuple[Any, ...]
    C: tuple[Any, ...]
    source: str = ""

    def index(self, wavelength: Any) -> Any:
        """Return n at a wavelength in nm: a number, or an array of NumPy or Dr.Jit."""
        square = (wavelength * 1e-3) ** 2
        return (1 + sum(b * square / (square - c) for b, c in zip(self.B, self.C, strict=True))) ** 0.5

    @property
    def nd(self) -> float:
        """The index n_d."""
        return float(self.index(D_LINE))

    @property
    def dispersion(self) -> float:
        """The mean dispersion n_F - n_C."""
        return float(self.index(F_LINE) - self.index(C_LINE))

    @property
    def ends(self) -> tuple[float, float]:
        """The differences n_F - n_d of blue light and n_C - n_d of red light."""
        return float(self.index(F_LINE)) - self.nd, float(self.index(C_LINE)) - self.nd

    @property
    def Vd(self) -> float:
        """Abbe's number V_d."""
        return (self.nd - 1) / self.dispersion

    def shape(self, wavelength: Any) -> Any:
        """Return g at a wavelength in nm."""
        return (self.index(wavelength) - self.nd) / self.dispersion


def cauchy_shape(wavelength: Any) -> Any:
    """Return g of Cauchy's formula with two terms at a wavelength in nm."""
    return (wavelength**-2 - D_LINE**-2) / (F_LINE**-2 - C_LINE**-2)


def index_of(nd: Any, Vd: Any, shape: Callable[[Any], Any], wavelength: Any) -> Any:
    """Return n at a wavelength in nm, from n_d, V_d, and g."""
    return nd + (nd - 1) / Vd * shape(wavelength)


_SCHOTT = "SCHOTT, Optical Glass Data Sheets"
#: Materials by name.
GLASSES = {
    "N-BK7": Glass(
        (1.03961212, 0.231792344, 1.01046945), (0.00600069867, 0.0200179144, 103.560653), _SCHOTT
    ),
    "N-SF11": Glass(
        (1.73759695, 0.313747346, 1.89878101), (0.013188707, 0.0623068142, 155.23629), _SCHOTT
    ),
    "F2": Glass(
        (1.34533359, 0.209073176, 0.937357162), (0.00997743871, 0.0470450767, 111.886764), _SCHOTT
    ),
    "fused silica": Glass(
        (0.6961663, 0.4079426, 0.8974794), (0.0684043**2, 0.1162414**2, 9.896161**2),
        "I. H. Malitson, J. Opt. Soc. Am. 55, 1205 (1965)",
    ),
    "PMMA": Glass(
        (0.99654, 0.18964, 0.00411), (0.00787, 0.02191, 3.85727),
        "M. Szczurowski, measurement of 2013, in the database refractiveindex.info",
    ),
    "polycarbonate": Glass(
        (1.4182,), (0.021304,), "N. Sultanova, S. Kasarova, I. Nikolov, Acta Phys. Pol. A 116, 585 (2009)"
    ),
    "water": Glass(
        (0.5684027565, 0.1726177391, 0.02086189578, 0.1130748688),
        (0.005101829712, 0.01821153936, 0.02620722293, 10.69792721),
        "M. Daimon, A. Masumura, Appl. Opt. 46, 3811 (2007), at 20 °C",
    ),
    "diamond": Glass((0.3306, 4.3356), (0.175**2, 0.106**2), "F. Peter, Z. Phys. 15, 358 (1923)"),
}  # fmt: skip


def find_glass(name: str) -> Glass:
    """Return a material of the catalogue. Case does not matter. Raises ValueError for an unknown name."""
    return GLASSES[known_name("glass", name, GLASSES)]
