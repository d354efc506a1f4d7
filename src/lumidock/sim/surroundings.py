"""Sources of light beside the dock's lamps: mirror images, glints, marine snow, other lamps, light from the water."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lumidock.datatypes import Array
from lumidock.sim.canvas import Canvas
from lumidock.sim.detections import emission_cosine
from lumidock.sim.knobs import Glints, Headlamp, OtherVehicle, Snow, WaterSurface
from lumidock.sim.optics import PHOTON_J, SPECTRUM, Emitters, Exposure, emitters, intensity
from lumidock.sim.scattering import backscatter_share, phase_at
from lumidock.sim.scenario import Scenario
from lumidock.sim.water import absorption_scattering, diffuse_attenuation, phase_kind
from lumidock.station import Station

_SNOW_TILE_M = 8.0  # the particles repeat with this period in x, y and z
_NEAREST_M, _FAR_M = 0.15, 100.0  # of particles; of the water whose light is summed up
_GLINT_M = 0.006  # radius of a glint
_LAMP_ROW = np.array([0.9, 0.15, 0.4])  # direction in `dock` along which the other vehicle's lamps stand
LAMP_EDGES_M = np.concatenate([[0.0], np.logspace(-1.0, 1.3, 28)])  # ranges between which headlamp light is integrated
_FORWARD_RAD = np.deg2rad(30.0)  # daylight comes from a cone of about this half-angle


@dataclass(frozen=True, slots=True, eq=False)
class LampSet:
    """The M lamps of a station: true positions `p_dock` (M, 3), power `watts` (M, 3) W by band, window `radius_m`."""

    station: Station
    p_dock: Array
    watts: Array
    radius_m: float


def mirrored(
    knobs: WaterSurface, index: float, exposure: Exposure, lamps: LampSet, rng: np.random.Generator
) -> list[Emitters]:
    """Mirror images of lamps in a wavy water surface: a core for each fragment of an image, a halo for each image.

    Every fragment is the image in a plane facet whose slope follows the waves. Its intensity is that of the lamp toward
    the facet times Fresnel's reflectance from water of refractive `index`.
    Source: slopes: C. Cox, W. Munk, J. Opt. Soc. Am. 44, 1954.
    """
    station, p_dock, radius_m = lamps.station, lamps.p_dock, lamps.radius_m
    camera_m = exposure.T_dock_cam[:3, 3]
    m, k = len(p_dock), knobs.fragments
    period = knobs.period_s * rng.uniform(0.6, 1.6, (3, m, k))
    wave = np.sin(2.0 * np.pi * exposure.t_s / period + rng.uniform(0.0, 2.0 * np.pi, (3, m, k)))
    below, own = knobs.height_m - p_dock[:, 1], knobs.height_m - camera_m[1]
    if own <= 0.0 or (below <= 0.0).any():
        return []
    at = p_dock + (camera_m - p_dock) * (below / (below + own))[:, None]
    at[:, 1] = knobs.height_m
    normal = np.stack(
        [knobs.slope * np.sqrt(2.0) * wave[0], np.ones((m, k)), knobs.slope * np.sqrt(2.0) * wave[1]], axis=-1
    )
    normal[:, 0, [0, 2]] *= 0.3  # one fragment stays near the image in a flat surface
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    image = p_dock[:, None] + 2.0 * ((at - p_dock)[:, None] * normal).sum(axis=-1, keepdims=True) * normal
    share = 0.05 + (1.0 + wave[2]) ** 2
    share /= share.sum(axis=1, keepdims=True)
    axis = station.axis * [1.0, -1.0, 1.0]
    still = p_dock * [1.0, -1.0, 1.0] + [0.0, 2.0 * knobs.height_m, 0.0]
    cosine = emission_cosine(still, axis, camera_m)
    path_m = np.linalg.norm(still - camera_m, axis=1)
    back = fresnel((below + own) / path_m, index)
    watt_sr = (intensity(np.ones(m), station.beam_deg, cosine) * back)[:, None] * lamps.watts
    fragments = np.repeat(watt_sr, k, axis=0) * share.reshape(-1, 1)
    cores = emitters("mirror", exposure, exposure.p_cam(image.reshape(-1, 3)), fragments, radius_m, halo=0.0)
    spread_m = np.hypot(radius_m, 2.0 * knobs.slope * below)  # of the fragments, whose halos overlap
    halos = emitters("mirror", exposure, exposure.p_cam(still), watt_sr, spread_m, core=0.0)
    return [cores, halos]


def fresnel(cosine: Array, index: float) -> Array:
    """Reflectance (N,) of the water surface from below, unpolarised; `cosine` (N,) of the angle to the vertical."""
    sine2 = (1.0 - cosine**2) * index**2
    out = np.sqrt(np.maximum(1.0 - sine2, 0.0))
    across = ((index * cosine - out) / (index * cosine + out)) ** 2
    along = ((cosine - index * out) / (cosine + index * out)) ** 2
    return np.asarray(np.where(sine2 >= 1.0, 1.0, 0.5 * (across + along)))


def glints(
    knobs: Glints, exposure: Exposure, station: Station, p_dock: Array, watts: Array, rng: np.random.Generator
) -> Emitters:
    """Reflections of M lamps at `p_dock` (M, 3), with `watts` (M, 3), on the tube beside each, away from the axis."""
    outward = p_dock * [1.0, 1.0, 0.0]
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9)
    before = emission_cosine(p_dock, station.axis, exposure.T_dock_cam[:3, 3]) > 0.0
    watt_sr = (rng.uniform(*knobs.share, len(p_dock)) / (2.0 * np.pi) * before)[:, None] * watts
    return emitters("glint", exposure, exposure.p_cam(p_dock + knobs.offset_m * outward), watt_sr, _GLINT_M, halo=0.0)


def vehicle(knobs: OtherVehicle, exposure: Exposure, radius_m: float) -> Emitters:
    """Lamps of another vehicle, side by side; each shines evenly into all directions."""
    side = (np.arange(knobs.lamps) - 0.5 * (knobs.lamps - 1)) * knobs.spacing_m
    middle = np.array(knobs.start) + np.array(knobs.velocity_m_s) * exposure.t_s
    watt_sr = np.tile(knobs.power_w / (4.0 * np.pi) * np.array(SPECTRUM[knobs.color]), (knobs.lamps, 1))
    return emitters("vehicle", exposure, exposure.p_cam(middle + side[:, None] * _LAMP_ROW), watt_sr, radius_m)


def snow(knobs: Snow, scenario: Scenario, exposure: Exposure, rng: np.random.Generator) -> Emitters:
    """Particles that drift slowly through the water, lit by headlamp and daylight."""
    count = int(knobs.per_m3 * _SNOW_TILE_M**3)
    tile, share = rng.uniform(0.0, _SNOW_TILE_M, (count, 3)), rng.random(count)
    low, high = (1e-3 * value for value in knobs.radius_mm)
    radius = (low**-2.0 - share * (low**-2.0 - high**-2.0)) ** -0.5
    camera_m = exposure.T_dock_cam[:3, 3]
    apart = tile + np.array(knobs.drift_m_s) * exposure.t_s - camera_m
    apart = (apart + 0.5 * _SNOW_TILE_M) % _SNOW_TILE_M - 0.5 * _SNOW_TILE_M
    p_cam = apart @ exposure.T_dock_cam[:3, :3]
    close = (p_cam[:, 2] > _NEAREST_M) & (p_cam[:, 2] < knobs.reach_m)
    close[close] = exposure.lens.camera.contains(exposure.lens.project(p_cam[close]))
    p_cam, radius = p_cam[close], radius[close]
    light = np.broadcast_to(daylight_w_m2(scenario, float(camera_m[1])), p_cam.shape)
    if scenario.around.headlamp is not None:
        light = light + headlamp_w_m2(scenario, scenario.around.headlamp, p_cam)
    watt_sr = light * knobs.albedo * radius[:, None] ** 2  # diffuse sphere: albedo / pi times its cross section
    return emitters("snow", exposure, p_cam, watt_sr, radius, halo=0.0)


def headlamp_w_m2(scenario: Scenario, knobs: Headlamp, p_cam: Array) -> Array:
    """Irradiance (N, 3) W/m2 in each band by the headlamp at points `p_cam` (N, 3)."""
    a, b = absorption_scattering(scenario.water)
    way = p_cam - np.array(knobs.offset_m)
    far = np.linalg.norm(way, axis=1)
    watt_sr = intensity(np.array(knobs.power_w), np.array(knobs.beam_deg), way[:, 2] / far)
    return np.asarray((watt_sr / far**2)[:, None] * np.array(SPECTRUM["white"]) * np.exp(-(a + b) * far[:, None]))


def daylight_w_m2(scenario: Scenario, height_m: float) -> Array:
    """Downward irradiance (3,) W/m2 of daylight in each band, `height_m` above the dock's origin."""
    depth = max(scenario.daylight.depth_m - height_m, 0.0)
    return np.asarray(scenario.daylight.surface_w_m2 * np.exp(-daylight_decay(scenario) * depth))


def daylight_decay(scenario: Scenario) -> Array:
    """Diffuse attenuation coefficient (3,) 1/m of daylight in each band."""
    a, b = absorption_scattering(scenario.water)
    return diffuse_attenuation(a, b * backscatter_share(phase_kind(scenario.water)))


def daylight_sideways(scenario: Scenario, up: Array) -> Array:
    """Daylight scattered into a line of sight: radiance per length over downward irradiance (..., 3) 1/(m sr).

    `up` (...) is the cosine of the line of sight to the vertical. The value is `daylight.more` times b times the phase
    function, for light that comes straight down.
    """
    _, b = absorption_scattering(scenario.water)
    angle = np.maximum(np.arccos(np.clip(up, -1.0, 1.0)), _FORWARD_RAD)
    return np.asarray(scenario.daylight.more * b * phase_at(phase_kind(scenario.water), angle)[..., None])


def daylight_sr(scenario: Scenario, R_dock_cam: Array, height_m: float, rays: Array) -> Array:
    """Radiance (h, w, 3) W/(m2 sr) of daylight that the water scatters along `rays` (h, w, 3).

    Single scattering of downward light, integrated along the line of sight to the surface, times `daylight.more`.
    """
    a, b = absorption_scattering(scenario.water)
    kind, knobs = phase_kind(scenario.water), scenario.daylight
    decay = diffuse_attenuation(a, b * backscatter_share(kind))
    up = (rays @ R_dock_cam.T)[..., 1]
    depth = max(knobs.depth_m - height_m, 0.01)
    length = np.where(up > 1e-3, np.minimum(depth / np.maximum(up, 1e-3), _FAR_M), _FAR_M)[..., None]
    rate = (a + b) - decay * up[..., None]
    rate = np.where(np.abs(rate) < 1e-6, 1e-6, rate)
    angle = np.maximum(np.arccos(np.clip(up, -1.0, 1.0)), _FORWARD_RAD)
    along = -np.expm1(-np.minimum(rate * length, 50.0)) / rate
    return np.asarray(knobs.more * daylight_w_m2(scenario, height_m) * b * phase_at(kind, angle)[..., None] * along)


def headlamp_sr(scenario: Scenario, knobs: Headlamp, rays: Array) -> Array:
    """Radiance (h, w, 3) W/(m2 sr) along `rays` (h, w, 3) of headlamp light that the water scatters once."""
    return np.asarray(headlamp_sums(scenario, knobs, rays)[-1])


def headlamp_sums(scenario: Scenario, knobs: Headlamp, rays: Array) -> Array:
    """The same radiance from the camera up to each of the ranges `LAMP_EDGES_M`: (29, h, w, 3)."""
    a, b = absorption_scattering(scenario.water)
    kind, edges = phase_kind(scenario.water), LAMP_EDGES_M
    sums = [np.zeros(rays.shape)]
    for sight, step in zip(0.5 * (edges[1:] + edges[:-1]), np.diff(edges), strict=True):
        p_cam = (rays * sight).reshape(-1, 3)
        way = p_cam - np.array(knobs.offset_m)
        cosine = -(way * rays.reshape(-1, 3)).sum(axis=1) / np.linalg.norm(way, axis=1)
        beta = phase_at(kind, np.arccos(np.clip(cosine, -1.0, 1.0)))
        light = headlamp_w_m2(scenario, knobs, p_cam) * b * np.exp(-(a + b) * sight)
        sums.append(sums[-1] + (light * beta[:, None]).reshape(rays.shape) * step)
    return np.array(sums)


def add_background(canvas: Canvas, scenario: Scenario, exposure: Exposure, lamp_sr: Array | None) -> None:
    """Add light that the water scatters: daylight, and headlamp light of radiance `lamp_sr` (h, w, 3)."""
    T_dock_cam = exposure.T_dock_cam
    sr = daylight_sr(scenario, T_dock_cam[:3, :3], float(T_dock_cam[1, 3]), canvas.wide_rays)
    sr = sr if lamp_sr is None else sr + lamp_sr
    canvas.add_background(sr * (canvas.lens.aperture_m2 * exposure.exposure_s / PHOTON_J))
