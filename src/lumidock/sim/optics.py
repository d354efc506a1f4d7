"""The light of the dock's lamps that reaches the sensor: electrons per pixel in three bands.

Bands are 455, 530 and 610 nm, in the order B, G, R throughout.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lumidock.camera import Camera
from lumidock.datatypes import Array
from lumidock.geometry import se3_inverse, transform_points
from lumidock.sim.scenario import Scenario
from lumidock.sim.spots import emission_cosine, in_view
from lumidock.station import Station

_BAND_NM = np.array([455.0, 530.0, 610.0])
_PHOTON_J = 6.62607e-34 * 2.99792e8 / (_BAND_NM * 1e-9)
_LENS_AREA_M2 = np.pi * (7.2e-3 / 2.8 / 2.0) ** 2  # 7.2 mm at f/2.8
_WINDOW_RADIUS_M = 0.0175  # of a lamp
_FORWARD_SHARE = 0.9  # of scattering that stays within a few degrees; Petzold's phase functions, 0.85-0.93
_HALO_RAD_PER_DEPTH = 0.012  # angular scale of the halo per unit of optical depth in scattering
# share of a lamp's radiant power in each band
_SPECTRUM = {
    "white": (0.30, 0.40, 0.30),
    "blue": (0.97, 0.03, 0.0),
    "cyan": (0.50, 0.50, 0.0),
    "green": (0.03, 0.95, 0.02),
    "red": (0.0, 0.02, 0.98),
}
# quantum efficiency of the B, G, R pixels (rows) in the three bands (columns); IMX264, peaks .48, .57, .52
_QE = np.array([[0.48, 0.12, 0.02], [0.12, 0.57, 0.08], [0.03, 0.08, 0.52]])
_TAIL_E = 0.25  # electrons per pixel below which a halo is no longer drawn
_MAX_REACH_PX = 420


@dataclass(frozen=True, slots=True, eq=False)
class Lamps:
    """The M lamps in one frame.

    Pixels `uv` (M, 2), direct and halo electrons in B, G, R (M, 3), radius of the window and of the halo in px (M,),
    and whether each is `lit` and in the picture (M,).
    """

    uv: Array
    direct_e: Array
    halo_e: Array
    window_px: Array
    halo_px: Array
    lit: np.ndarray


def lamps(scenario: Scenario, station: Station, camera: Camera, T_dock_cam: Array) -> Lamps:
    """Light of every lamp of the station at one pose.

    Source: Lambert-Beer with small-angle forward scattering: what is scattered forward arrives as a halo.
    """
    uv, lit = in_view(station, camera, T_dock_cam)
    distance = np.linalg.norm(transform_points(se3_inverse(T_dock_cam), station.p_dock), axis=1)[:, None]
    a, b = np.array(scenario.water.absorption), np.array(scenario.water.scattering)
    power = station.power_w[:, None] * np.array([_SPECTRUM[color] for color in station.color])
    at_lens = power * _beam(station, T_dock_cam)[:, None] / distance**2 * _LENS_AREA_M2
    photons = at_lens * scenario.sensor.exposure_ms * 1e-3 / _PHOTON_J
    direct = photons * np.exp(-(a + b) * distance)
    arriving = photons * np.exp(-(a + (1.0 - _FORWARD_SHARE) * b) * distance)
    focal = float(camera.focal_px.mean())
    halo_rad = _HALO_RAD_PER_DEPTH * (1.0 + float(b[1]) * distance[:, 0])
    window_px = _WINDOW_RADIUS_M / distance[:, 0] * focal
    # a Bayer pixel of each colour sees its quantum efficiency's share of the light that falls on it
    return Lamps(uv, direct @ _QE.T, (arriving - direct) @ _QE.T, window_px, halo_rad * focal, lit)


def _beam(station: Station, T_dock_cam: Array) -> Array:
    """Radiant intensity per watt (M,) 1/sr toward the camera: (n + 1) / 2 pi cos^n, n from the half angle."""
    n = np.log(0.5) / np.log(np.cos(np.deg2rad(np.minimum(station.beam_deg, 179.0)) / 2.0))
    cosine = np.maximum(emission_cosine(station, T_dock_cam), 0.0)
    return np.asarray((n + 1.0) / (2.0 * np.pi) * cosine**n)


def expose(scenario: Scenario, seen: Lamps, camera: Camera) -> Array:
    """Expected electrons (H, W) float32 on the RGGB mosaic, lamps and ambient light together."""
    mosaic = np.empty((camera.height, camera.width), np.float32)
    ambient = np.array(scenario.water.ambient_e) * scenario.sensor.exposure_ms / 2.0
    fade = np.linspace(1.15, 0.85, camera.height, dtype=np.float32)[:, None]  # a little lighter toward the surface
    for channel, rows, columns in _MOSAIC:
        mosaic[rows::2, columns::2] = (fade * ambient[channel])[rows::2]
    for i in np.flatnonzero(seen.lit):
        _add_lamp(mosaic, seen, int(i), scenario.sensor.blur_px)
    return mosaic


def with_strays(seen: Lamps, strays: Array) -> Lamps:
    """The lamps with others added at pixels `strays` (S, 2), each as bright as the station's brightest."""
    if not len(strays):
        return seen
    like = int(np.argmax(seen.direct_e.sum(axis=1)))

    def grown(values: Array) -> Array:
        return np.concatenate([values, np.repeat(values[like : like + 1], len(strays), axis=0)])

    return Lamps(
        np.concatenate([seen.uv, strays]),
        grown(seen.direct_e),
        grown(seen.halo_e),
        grown(seen.window_px),
        grown(seen.halo_px),
        np.concatenate([seen.lit, np.ones(len(strays), bool)]),
    )


# channel (B, G, R = 0, 1, 2), first row and first column of each plane of an RGGB mosaic
_MOSAIC = ((2, 0, 0), (1, 0, 1), (1, 1, 0), (0, 1, 1))


def _add_lamp(mosaic: Array, seen: Lamps, i: int, blur_px: float) -> None:
    """Add one lamp's core and halo to the mosaic."""
    window_px, halo_px = float(seen.window_px[i]), float(seen.halo_px[i])

    def core(du: Array, dv: Array) -> Array:
        return core_profile(du, dv, window_px, blur_px)

    def halo(du: Array, dv: Array) -> Array:
        radius = np.hypot(du[None, :], dv[:, None], dtype=np.float32)
        return np.asarray(np.exp(radius / np.float32(-halo_px)) / np.float32(2.0 * np.pi * halo_px**2))

    peak = float(seen.halo_e[i].max()) / (2.0 * np.pi * halo_px**2)
    _add_patch(mosaic, seen.uv[i], window_px + 5.0 * blur_px + 1.0, core, seen.direct_e[i])
    _add_patch(mosaic, seen.uv[i], halo_px * np.log(max(peak / _TAIL_E, 1.0)), halo, seen.halo_e[i])


def _add_patch(
    mosaic: Array, uv: Array, reach_px: float, profile: Callable[[Array, Array], Array], electrons: Array
) -> None:
    """Add `electrons` (3,) B, G, R, spread by `profile` over the pixels within `reach_px` of `uv` (2,)."""
    reach = int(np.ceil(min(reach_px, _MAX_REACH_PX)))
    u, v = uv
    u0, v0 = max(int(u) - reach, 0), max(int(v) - reach, 0)
    columns = np.arange(u0, min(int(u) + reach + 1, mosaic.shape[1]))
    rows = np.arange(v0, min(int(v) + reach + 1, mosaic.shape[0]))
    shares = profile(columns - u, rows - v)
    for channel, first_row, first_column in _MOSAIC:
        at = np.s_[(first_row - v0) % 2 :: 2, (first_column - u0) % 2 :: 2]
        mosaic[v0 : v0 + len(rows), u0 : u0 + len(columns)][at] += np.float32(electrons[channel]) * shares[at]


def core_profile(du: Array, dv: Array, window_px: float, blur_px: float) -> Array:
    """Share (V, U) of a lamp's direct light on each pixel: a uniform disc, blurred by a Gaussian, summed over pixels.

    The disc is a sum of Gaussians on a sunflower of points, so that the centre is exact at any radius.
    """
    count = max(1, int(4.0 * (window_px / blur_px) ** 2))
    k = np.arange(count) + 0.5
    r, angle = window_px * np.sqrt(k / count), k * np.pi * (3.0 - np.sqrt(5.0))
    x, y = r * np.cos(angle), r * np.sin(angle)
    columns = _pixel_integral(du[:, None] - (x - x.mean()), blur_px)
    rows = _pixel_integral(dv[:, None] - (y - y.mean()), blur_px)
    return np.asarray((rows @ columns.T) / count, np.float32)


def _pixel_integral(offset: Array, sigma: float) -> Array:
    """Integral over one pixel of a unit Gaussian centred `offset` px away."""
    scaled = np.float32(1.0 / sigma) * np.asarray(offset, np.float32)
    half = np.float32(0.5 / sigma)
    return _normal_cdf(scaled + half) - _normal_cdf(scaled - half)


def _normal_cdf(x: Array) -> Array:
    """Normal distribution function to 1e-7. Source: Abramowitz & Stegun 7.1.26."""
    z = np.abs(x) * np.float32(0.70710678)
    t = 1.0 / (1.0 + np.float32(0.3275911) * z)
    poly = t * (0.254829592 + t * (-0.284496736 + t * (1.421413741 + t * (-1.453152027 + t * 1.061405429))))
    erf = 1.0 - poly * np.exp(-z * z)
    return np.asarray(0.5 * (1.0 + np.where(x < 0, -erf, erf)))


def matched_filter_snr(scenario: Scenario, seen: Lamps) -> Array:
    """Signal-to-noise ratio (M,) of each lamp's core for a filter of its own shape, best of the three colours.

    Source: D. O. North, 1943; the core is taken as a Gaussian of the same area and noise as shot and read noise of the
    background.
    """
    sensor = scenario.sensor
    ambient = np.array(scenario.water.ambient_e) * sensor.exposure_ms / 2.0
    variance = ambient + sensor.read_noise_e**2
    width2 = sensor.blur_px**2 + seen.window_px**2 / 4.0 + 1.0 / 12.0
    share = np.array([0.25, 0.5, 0.25])  # of the pixels that have this colour
    power = seen.direct_e**2 * share / (4.0 * np.pi * width2[:, None])
    snr = np.sqrt((power / variance).max(axis=1))
    return np.asarray(np.where(seen.lit, snr, 0.0))
