"""Radiometry of everything that shines like a lamp: how much light of it reaches the lens, and where."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lumidock.datatypes import Array
from lumidock.geometry import se3_inverse, transform_points
from lumidock.sim.detections import emission_cosine, shown_layers
from lumidock.sim.knobs import Lamps
from lumidock.sim.lens import Lens
from lumidock.sim.scenario import Scenario
from lumidock.sim.water import BAND_NM
from lumidock.station import Station

PHOTON_J = 6.62607e-34 * 2.99792e8 / (BAND_NM * 1e-9)
# share of a lamp's radiant power in each band
SPECTRUM = {
    "white": (0.30, 0.40, 0.30),
    "blue": (0.97, 0.03, 0.0),
    "cyan": (0.50, 0.50, 0.0),
    "green": (0.03, 0.95, 0.02),
    "red": (0.0, 0.02, 0.98),
}


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """From where, when and how long is looked: pose `T_dock_cam` (4, 4), `t_s` since the start, `exposure_s`."""

    lens: Lens
    T_dock_cam: Array
    exposure_s: float
    t_s: float = 0.0

    def p_cam(self, p_dock: Array) -> Array:
        """Points (N, 3) of the dock as the camera has them."""
        return transform_points(se3_inverse(self.T_dock_cam), p_dock)


@dataclass(frozen=True, slots=True, eq=False)
class Emitters:
    """N small bright things in one frame.

    `kind` (N,), `p_cam` (N, 3) m, pixels `uv` (N, 2), photons `at_lens` (N, 3) in each band that would enter the
    aperture during the exposure if there were no water, the length `range_m` (N,) of their way, the radius
    `window_px` (N,), shares of the light drawn as `core` and as `halo` (N,), and which are `lit` (N,) and in view.
    """

    kind: np.ndarray
    p_cam: Array
    uv: Array
    at_lens: Array
    range_m: Array
    window_px: Array
    core: Array
    halo: Array
    lit: np.ndarray

    def __len__(self) -> int:
        return len(self.kind)


def joined(parts: list[Emitters]) -> Emitters:
    """All of them in a row."""
    return Emitters(*(np.concatenate([getattr(part, name) for part in parts]) for name in Emitters.__slots__))


def beam_exponent(beam_deg: Array | float) -> Array:
    """Exponent n of cos^n, a beam that has half its intensity at half of `beam_deg`, of any shape."""
    return np.asarray(np.log(0.5) / np.log(np.cos(np.deg2rad(np.minimum(beam_deg, 179.0)) / 2.0)))


def intensity(power_w: Array, beam_deg: Array, cosine: Array, side_share: float = 0.0) -> Array:
    """Radiant intensity (N,) W/sr at the `cosine` of the angle to the axis: P (n + 1) / 2 pi cos^n.

    Of the power, `side_share` goes evenly into all directions.
    """
    n = beam_exponent(beam_deg)
    beam = np.asarray(power_w * (n + 1.0) / (2.0 * np.pi) * np.maximum(cosine, 0.0) ** n)
    return beam if side_share == 0.0 else (1.0 - side_share) * beam + side_share * power_w / (4.0 * np.pi)


def emitters(
    kind: str,
    view: View,
    p_cam: Array,
    watt_sr: Array,
    radius_m: Array | float,
    *,
    core: Array | float = 1.0,
    halo: Array | float = 1.0,
) -> Emitters:
    """Emitters at `p_cam` (N, 3) with intensities `watt_sr` (N, 3) in each band toward the camera."""
    lens, distance = view.lens, np.maximum(np.linalg.norm(p_cam, axis=1), 1e-3)
    uv = lens.project(p_cam)
    lit = lens.camera.contains(uv) & (watt_sr.sum(axis=1) > 0.0)
    at = np.where(lit[:, None], uv, lens.camera.center_px)
    photons = watt_sr / distance[:, None] ** 2 * lens.aperture_m2 * view.exposure_s / PHOTON_J
    pupil = np.sqrt(lens.aperture_m2 / np.pi)  # focused far away: what is near is blurred to the size of the pupil
    size = np.hypot(radius_m, pupil) / distance / np.sqrt(lens.solid_angle(at))
    return Emitters(
        np.full(len(p_cam), kind),
        p_cam,
        uv,
        photons * lens.throughput(at)[:, None],
        distance,
        size,
        np.broadcast_to(np.asarray(core, float), len(p_cam)),
        np.broadcast_to(np.asarray(halo, float), len(p_cam)),
        lit,
    )


def lamp_watts(scenario: Scenario, station: Station, transmission: Array, duty: float) -> Array:
    """Radiant power (M, 3) W of the station's lamps in each band, `duty` the share of the exposure they are on."""
    color: tuple[str, ...] = station.color
    if scenario.lamps.swap_colors:
        order = station.layers_front_to_rear()
        color = _swapped(station, dict(zip(order, reversed(order), strict=True)))
    power = station.power_w * transmission * scenario.lamps.dim * duty
    power = power * shown_layers(scenario, station)
    return np.asarray(power[:, None] * np.array([SPECTRUM[name] for name in color]))


def _swapped(station: Station, other: dict[str, str]) -> tuple[str, ...]:
    """Each light's colour, which is that of the first light of the `other` layer."""
    first = {name: station.color[int(station.lights_of(name)[0])] for name in other}
    return tuple(first[other[station.layers[layer]]] for layer in station.layer)


def on_share(pwm_hz: float, duty: float, start_s: float, exposure_s: float) -> float:
    """Share of the exposure during which pulse-width modulated lamps are on; they start a period being on."""
    if pwm_hz == 0.0:
        return duty

    def on_until(t: float) -> float:
        periods = np.floor(t * pwm_hz)
        return float((periods * duty + min(t * pwm_hz - periods, duty)) / pwm_hz)

    return (on_until(start_s + exposure_s) - on_until(start_s)) / exposure_s


def lamps(view: View, station: Station, p_dock: Array, watts: Array, knobs: Lamps) -> Emitters:
    """The station's M lamps, which stand at `p_dock` (M, 3) and have `watts` (M, 3) in each band."""
    cosine = emission_cosine(p_dock, station.axis, view.T_dock_cam[:3, 3])
    watt_sr = intensity(np.ones(len(watts)), station.beam_deg, cosine, knobs.side_share)[:, None] * watts
    return emitters("lamp", view, view.p_cam(p_dock), watt_sr, knobs.window_radius_m)
