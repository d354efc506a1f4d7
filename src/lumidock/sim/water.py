"""Optical properties of water: absorption, scattering, refractive index, and the decay of daylight with depth.

The simulator computes light in three bands, at 455, 530 and 610 nm, in the order B, G, R everywhere.
"""

from __future__ import annotations

import numpy as np

from lumidock.datatypes import Array
from lumidock.sim.knobs import WaterKnobs

BAND_NM = np.array([455.0, 530.0, 610.0])

# Absorption and scattering coefficients 1/m of water and all that it contains. Jerlov types: C. Williamson, R. Hollins,
# Applied Optics 61, 2022 (measured); 7C and pure sea water: M. Solonenko, C. Mobley, Applied Optics 54, 2015. Published
# values of b differ by factors; `water.b_factor` scales it.
_IOP: dict[str, tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    "pure-sea": ((0.0119, 0.0429, 0.269), (0.0043, 0.0022, 0.0012)),
    "IB": ((0.0398, 0.0519, 0.273), (0.134, 0.124, 0.117)),
    "II": ((0.0605, 0.0607, 0.277), (0.194, 0.180, 0.168)),
    "III": ((0.107, 0.0806, 0.287), (0.308, 0.291, 0.277)),
    "1C": ((0.141, 0.0948, 0.294), (0.454, 0.432, 0.413)),
    "3C": ((0.191, 0.128, 0.314), (0.684, 0.652, 0.624)),
    "5C": ((0.295, 0.169, 0.333), (1.27, 1.21, 1.16)),
    "7C": ((0.511, 0.225, 0.327), (3.24, 2.50, 1.97)),
    # No survey of pools is known. Clear: pure water and 0.05 /m of fine particles at 530 nm, b at the turbidity of
    # well kept pools (0.2-0.5 NTU, at 0.1-0.3 /m per NTU). Murky: ten times that and a little yellow matter, as in
    # test tanks whose filters are off. b falls as 1 / wavelength, as for particles of all sizes.
    "pool-clear": ((0.0105, 0.0445, 0.264), (0.058, 0.050, 0.043)),
    "pool-murky": ((0.0500, 0.0650, 0.275), (0.580, 0.500, 0.430)),
}
# Petzold's water with the phase function of each kind; where not listed harbour, whose function is nearest to the mean
# particle phase function from which the tables above were derived.
_PHASE = {"pure-sea": "clear"}
# Change of absorption, 1/m, per psu and per kelvin. Source: J. Sullivan et al., Applied Optics 45, 2006, as tabulated
# in WOPP 3 by R. Roettgers, 2011
_A_PER_PSU, _A_PER_KELVIN = np.array([0.0, 1.4e-5, 3.5e-5]), np.array([0.0, 1.8e-5, 9.2e-4])
_A_TABLE_PSU, _A_TABLE_C = 35.0, 20.0  # salinity and temperature for which the table holds
_DOWNWARD_COSINE = 0.85  # mean cosine of daylight below the surface


def absorption_scattering(water: WaterKnobs) -> tuple[Array, Array]:
    """Absorption (3,) and scattering (3,) coefficients 1/m of a water at its salinity and temperature."""
    a, b = (np.array(values) for values in _IOP[water.kind])
    fresh = 0.0 if water.kind.startswith("pool") else _A_TABLE_PSU
    a = a + _A_PER_PSU * (water.salinity_psu - fresh) + _A_PER_KELVIN * (water.temperature_c - _A_TABLE_C)
    a = np.maximum(a, 1e-4) if water.absorption is None else np.array(water.absorption)
    return a, (b if water.scattering is None else np.array(water.scattering)) * water.b_factor


def phase_kind(water: WaterKnobs) -> str:
    """Name of the one of Petzold's phase functions that describes the scattering of this water."""
    return _PHASE.get(water.kind, "harbour") if water.phase == "auto" else water.phase


def index(water: WaterKnobs) -> Array:
    """Refractive index (3,) of the water. Source: X. Quan, E. Fry, Applied Optics 34, 1995, eq. (3)."""
    s, t, nm = water.salinity_psu, water.temperature_c, BAND_NM
    salt = (1.779e-4 - 1.05e-6 * t + 1.6e-8 * t * t) * s
    return np.asarray(
        1.31405 + salt - 2.02e-6 * t * t + (15.868 + 0.01155 * s - 0.00423 * t) / nm - 4382.0 / nm**2 + 1.1455e6 / nm**3
    )


def green_index(water: WaterKnobs) -> float:
    """Refractive index in the middle band, which is used for the geometry in all bands."""
    return float(index(water)[1])


def diffuse_attenuation(a: Array, backscatter: Array) -> Array:
    """Diffuse attenuation coefficient Kd (3,) 1/m of daylight: 1.04 (a + bb) / 0.85, bb the backscattering coefficient.

    Source: H. Gordon, Limnology and Oceanography 34, 1989.
    """
    return np.asarray(1.04 * (a + backscatter) / _DOWNWARD_COSINE)
