"""Radiometry of lamps and other small sources: how much of their light reaches the lens, and where its image is."""

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
# share of a lamp's radiant power in each band, by its colour
SPECTRUM = {
    "white": (0.30, 0.40, 0.30),
    "blue": (0.97, 0.03, 0.0),
    "cyan": (0.50, 0.50, 0.0),
    "green": (0.03, 0.95, 0.02),
    "red": (0.0, 0.02, 0.98),
}


@dataclass(frozen=True, slots=True, eq=False)
class Exposure:
    """One exposure through a lens: pose `T_dock_cam` (4, 4), its length `exposure_s`, time `t_s` since the start."""

    lens: Lens
    T_dock_cam: Array
    exposure_s: float
    t_s: float = 0.0

    def p_cam(self, p_dock: Array) -> Array:
        """Points `p_cam` (N, 3) of points `p_dock` (N, 3)."""
        return transform_points(se3_inverse(self.T_dock_cam), p_dock)


@dataclass(frozen=True, slots=True, eq=False)
class Emitters:
    """N small sources of light in one frame.

    `kind` (N,): a word of spurious_truth.csv, or "lamp" for the station's own; `p_cam` (N, 3) m; pixels `uv` (N, 2);
    `at_lens` (N, 3): photons in each band that would enter the aperture during the exposure if there were no water;
    `range_m` (N,); `window_px` (N,): radius of the image; `core`, `halo` (N,): shares of the direct image and of the
    scattered light that are drawn; `lit` (N,): whether it shines and its image is in the picture.
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
    """All emitters of `parts`, in this order."""
    return Emitters(*(np.concatenate([getattr(part, name) for part in parts]) for name in Emitters.__slots__))


def beam_exponent(beam_deg: Array | float) -> Array:
    """Exponent n of a beam cos^n whose full width at half maximum is `beam_deg`; arrays of any shape."""
    return np.asarray(np.log(0.5) / np.log(np.cos(np.deg2rad(np.minimum(beam_deg, 179.0)) / 2.0)))


def intensity(power_w: Array, beam_deg: Array, cosine: Array, side_share: float = 0.0) -> Array:
    """Radiant intensity (N,) W/sr at the `cosine` of the angle to the axis: P (n + 1) / (2 pi) cos^n.

    The part `side_share` of the power P goes evenly into all directions instead, P / (4 pi).
    """
    n = beam_exponent(beam_deg)
    beam = np.asarray(power_w * (n + 1.0) / (2.0 * np.pi) * np.maximum(cosine, 0.0) ** n)
    return beam if side_share == 0.0 else (1.0 - side_share) * beam + side_share * power_w / (4.0 * np.pi)


def emitters(
    kind: str,
    exposure: Exposure,
    p_cam: Array,
    watt_sr: Array,
    radius_m: Array | float,
    *,
    core: Array | float = 1.0,
    halo: Array | float = 1.0,
) -> Emitters:
    """Emitters of `radius_m` at `p_cam` (N, 3) with intensities `watt_sr` (N, 3) W/sr toward the camera."""
    lens, distance = exposure.lens, np.maximum(np.linalg.norm(p_cam, axis=1), 1e-3)
    uv = lens.project(p_cam)
    lit = lens.camera.contains(uv) & (watt_sr.sum(axis=1) > 0.0)
    at = np.where(lit[:, None], uv, lens.camera.center_px)
    photons = watt_sr / distance[:, None] ** 2 * lens.aperture_m2 * exposure.exposure_s / PHOTON_J
    pupil = np.sqrt(lens.aperture_m2 / np.pi)  # near points are blurred to the size of the pupil
    size = np.hypot(radius_m, pupil) / distance / np.sqrt(lens.solid_angle(at))
    return Emitters(
        kind=np.full(len(p_cam), kind),
        p_cam=p_cam,
        uv=uv,
        at_lens=photons * lens.throughput(at)[:, None],
        range_m=distance,
        window_px=size,
        core=np.broadcast_to(np.asarray(core, float), len(p_cam)),
        halo=np.broadcast_to(np.asarray(halo, float), len(p_cam)),
        lit=lit,
    )


def lamp_watts(scenario: Scenario, station: Station, transmission: Array, duty: float) -> Array:
    """Radiant power (M, 3) W of the station's M lamps in each band, averaged over the exposure.

    `transmission` (M,) is that of their windows, `duty` the share of the exposure during which they are on.
    """
    color: tuple[str, ...] = station.color
    if scenario.lamps.swap_colors:
        order = station.layers_front_to_rear()
        color = _swapped(station, dict(zip(order, reversed(order), strict=True)))
    power = station.power_w * transmission * scenario.lamps.dim * duty
    power = power * shown_layers(scenario, station)
    return np.asarray(power[:, None] * np.array([SPECTRUM[name] for name in color]))


def _swapped(station: Station, other: dict[str, str]) -> tuple[str, ...]:
    """Colour of each light where each layer has the colour of the `other` layer: that of its first light."""
    first = {name: station.color[int(station.lights_of(name)[0])] for name in other}
    return tuple(first[other[station.layers[layer]]] for layer in station.layer)


def on_share(pwm_hz: float, duty: float, start_s: float, exposure_s: float) -> float:
    """Share of an exposure from `start_s` on during which pulse-width modulated lamps are on.

    Each period begins with the pulse; the first one begins at time zero.
    """
    if pwm_hz == 0.0:
        return duty

    def on_until(t: float) -> float:
        periods = np.floor(t * pwm_hz)
        return float((periods * duty + min(t * pwm_hz - periods, duty)) / pwm_hz)

    return (on_until(start_s + exposure_s) - on_until(start_s)) / exposure_s


def lamps(exposure: Exposure, station: Station, p_dock: Array, watts: Array, knobs: Lamps) -> Emitters:
    """The station's M lamps, truly at `p_dock` (M, 3), with radiant power `watts` (M, 3) W in each band."""
    cosine = emission_cosine(p_dock, station.axis, exposure.T_dock_cam[:3, 3])
    watt_sr = intensity(np.ones(len(watts)), station.beam_deg, cosine, knobs.side_share)[:, None] * watts
    return emitters("lamp", exposure, exposure.p_cam(p_dock), watt_sr, knobs.window_radius_m)
