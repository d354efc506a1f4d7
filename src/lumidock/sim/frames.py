"""One frame: everything in view at one moment, drawn, read out, and what truth says of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from lumidock.datatypes import Array, Indices
from lumidock.geometry import se3_exp, se3_inverse, se3_log, transform_points
from lumidock.sim import around
from lumidock.sim.canvas import Canvas, Core, Mosaic
from lumidock.sim.knobs import Fish, Surface
from lumidock.sim.lens import Lens
from lumidock.sim.lit import Painter, compact_points, visible_share
from lumidock.sim.optics import PHOTON_J, Emitters, View, joined, lamp_watts, lamps, on_share
from lumidock.sim.scenario import Scenario
from lumidock.sim.sensor import electrons_per_level, hot_pixels, picture, read_out, saturation_e
from lumidock.sim.water import absorption_scattering, green_index, phase_kind
from lumidock.station import Station

_BODY_ALBEDO = 0.1
_TWILIGHT = 0.3  # light on a body's side over that from above


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """What decides one frame beside the scenario.

    Time `t_s` since the start, `exposure_s`, pose `T_dock_cam`, and where the camera is an exposure later as seen from
    there, `T_cam_later`; where the M lamps really stand, `p_dock` (M, 3), what their windows let through,
    `transmission` (M,), which are `dark`; pixels of `strays` (S, 2) that look like lamps; the `surface` that mirrors
    the dock, whether the `dock` itself is in view, and the numbers that seed what is drawn for the run.
    """

    t_s: float
    exposure_s: float
    T_dock_cam: Array
    T_cam_later: Array
    p_dock: Array
    transmission: Array
    dark: Indices
    spurious: Array
    surface: Surface | None
    dock: bool = True
    draws: tuple[int, ...] = (0,)

    def shifted(self, lapse_s: float) -> Moment:
        """The same a little later, as the camera goes on moving."""
        way = se3_log(self.T_cam_later) * (lapse_s / self.exposure_s)
        return replace(self, t_s=self.t_s + lapse_s, T_dock_cam=self.T_dock_cam @ se3_exp(way))

    def rng(self, what: int) -> np.random.Generator:
        """Draws that stay the same through a run."""
        return np.random.default_rng([*self.draws, what])


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """Expected electrons (H, W), everything that was drawn, the first M of it the station's lamps, and its SNR (N,).

    `reflections` (R, 2) px are compact bright points on matter.
    """

    electrons: Array
    seen: Emitters
    snr: Array
    reflections: Array


class Studio:
    """Draws frames of one scenario through one lens."""

    def __init__(self, scenario: Scenario, station: Station, lens: Lens, draws: tuple[int, ...] = (0,)) -> None:
        a, b = absorption_scattering(scenario.water)
        self.scenario, self.station, self.lens = scenario, station, lens
        self.canvas = Canvas(lens, Mosaic.of(scenario.output), a, b, phase_kind(scenario.water))
        shape = (lens.camera.height, lens.camera.width)
        self.painter = Painter(scenario, station, lens, self.canvas.colors) if scenario.matter.is_any else None
        self.hot_at, self.hot_e_s = hot_pixels(scenario.sensor, shape, np.random.default_rng([*draws, 20]))

    @cached_property
    def lamp_sr(self) -> Array | None:
        """Radiance (h, w, 3) W/(m2 sr) of the water in the light of the vehicle's own lamp, the same in every frame."""
        lamp = self.scenario.around.headlamp
        return around.headlamp_sr(self.scenario, lamp, self.canvas.wide_rays) if lamp else None

    def shoot(self, moment: Moment) -> Shot:
        """Expose one frame."""
        self.canvas.clear()
        seen, watts = self._emitters(moment)
        reflections: Array = np.empty((0, 2))
        if self.painter is not None:
            seen, reflections = self._draw_matter(self.painter, moment, seen, watts)
        cores = self.canvas.add(seen, self._smear(moment, seen))
        if self.painter is None:
            around.add_background(self.canvas, self.scenario, self._view(moment), self.lamp_sr)
        electrons = self.canvas.expected()
        self._occlude(moment, electrons, cores)
        rows, columns = self.hot_at
        electrons[rows, columns] += (self.hot_e_s * moment.exposure_s).astype(np.float32)
        return Shot(electrons, seen, np.array([self._snr(electrons, core) for core in cores]), reflections)

    def develop(self, shot: Shot, rng: np.random.Generator) -> np.ndarray:
        """The picture of a shot, with its noise: (H, W, 3) bgr8, or (H, W) of the other kinds of pixels."""
        return picture(read_out(shot.electrons, self.scenario.sensor, rng), self.scenario.sensor, self.scenario.output)

    def _view(self, moment: Moment) -> View:
        return View(self.lens, moment.T_dock_cam, moment.exposure_s, moment.t_s)

    def _draw_matter(self, painter: Painter, moment: Moment, seen: Emitters, watts: Array) -> tuple[Emitters, Array]:
        """Put matter on the canvas; returns the emitters less what it hides, and its compact bright points (R, 2)."""
        moves = self.scenario.lens.motion
        later = moment.T_cam_later if moves else np.eye(4)
        drawn = painter.draw(self._view(moment), moment.p_dock, watts, later, moment.rng(21))
        self.canvas.mosaic[...] = drawn.electrons
        self.canvas.range_m = drawn.range_m
        share = visible_share(drawn.solids, seen, self.scenario.lamps.window_radius_m)
        share[seen.kind == "injected"] = 1.0
        seen = replace(seen, core=seen.core * share)
        apart = compact_points(drawn.electrons, self.scenario.sensor.read_noise_e)
        lamps = seen.uv[seen.lit & (seen.core > 0.0)]
        near = np.linalg.norm(apart[:, None] - lamps[None], axis=2) < 3.0 + seen.window_px[seen.lit & (seen.core > 0.0)]
        return seen, apart[~near.any(axis=1)]

    def _emitters(self, moment: Moment) -> tuple[Emitters, Array]:
        """Everything that shines, the station's lamps first, and the power (M, 3) W of those in each band."""
        scenario, station, knobs, view = self.scenario, self.station, self.scenario.around, self._view(moment)
        p_dock, radius_m = moment.p_dock, scenario.lamps.window_radius_m
        duty = on_share(scenario.lamps.pwm_hz, scenario.lamps.pwm_duty, moment.t_s, moment.exposure_s)
        watts = lamp_watts(scenario, station, moment.transmission, duty)
        own = lamps(view, station, p_dock, watts, scenario.lamps)
        shining = ~np.isin(np.arange(len(station)), moment.dark)
        parts = [replace(own, lit=own.lit & shining & moment.dock)]
        watts = watts * shining[:, None]
        if moment.surface is not None:
            n, rng = green_index(scenario.water), moment.rng(11)
            parts += around.mirrored(moment.surface, n, view, station, p_dock, watts, radius_m, rng)
        if knobs.glints is not None and moment.dock:
            parts.append(around.glints(knobs.glints, view, station, p_dock, watts, moment.rng(12)))
        if knobs.vehicle is not None:
            parts.append(around.vehicle(knobs.vehicle, view, radius_m))
        if knobs.snow is not None:
            parts.append(around.snow(knobs.snow, scenario, view, moment.rng(13)))
        if len(moment.spurious):
            parts.append(_spurious(own, moment.spurious))
        return joined(parts), watts * moment.dock

    def _smear(self, moment: Moment, seen: Emitters) -> Array:
        """How far (N, 2) px each emitter moves during the exposure."""
        if not self.scenario.lens.motion or np.array_equal(moment.T_cam_later, np.eye(4)):
            return np.zeros((len(seen), 2))
        later = transform_points(se3_inverse(moment.T_cam_later), seen.p_cam)
        smear = self.lens.project(later) - self.lens.project(seen.p_cam)
        still = (seen.kind == "injected") | ~np.isfinite(smear).all(axis=1)
        return np.where(still[:, None], 0.0, np.clip(smear, -200.0, 200.0))

    def _snr(self, electrons: Array, core: Core | None) -> float:
        """Signal-to-noise ratio of one spot for a filter of its own shape, against all else that is in the picture.

        Shot noise of ambient light, back-scatter and every halo, read noise, rounding; where all is saturated, the spot
        does not show. Source: D. North, RCA Report PTR-6C, 1943.
        """
        if core is None or not core.own.size:
            return 0.0
        sensor, full = self.scenario.sensor, saturation_e(self.scenario.sensor)
        total = electrons[core.rows, core.columns]
        rest = np.maximum(total - core.own, 0.0)
        signal = np.minimum(total, full) - np.minimum(rest, full)
        variance = rest + sensor.read_noise_e**2 + electrons_per_level(sensor) ** 2 / 12.0
        return float(np.sqrt((signal * signal / variance).sum(dtype=np.float64)))

    def _occlude(self, moment: Moment, electrons: Array, cores: list[Core | None]) -> None:
        """Put dark bodies before everything: fish, and the own hull."""
        camera, knobs = self.lens.camera, self.scenario.around
        if knobs.fish is None and knobs.hull == 0.0:
            return
        mask = np.zeros((camera.height, camera.width), np.uint8)
        if knobs.fish is not None:
            _draw_fish(mask, knobs.fish, float(camera.focal_px.mean()), moment)
        if knobs.hull > 0.0:
            across, up = int(0.55 * camera.width), int(knobs.hull * camera.height)
            cv2.ellipse(mask, (camera.width // 2, camera.height), (across, up), 0.0, 0.0, 360.0, 255, -1, cv2.LINE_AA)
        clear = np.float32(1.0) - mask * np.float32(1.0 / 255.0)
        day = around.daylight_w_m2(self.scenario, float(moment.T_dock_cam[1, 3])) * _TWILIGHT
        photons = day * _BODY_ALBEDO / np.pi * (self.lens.aperture_m2 * moment.exposure_s / PHOTON_J)
        body = self.canvas.colors.qe @ photons * float(self.lens.solid_angle(camera.center_px[None])[0])
        electrons *= clear
        step = self.canvas.colors.step
        for channel, row, column in self.canvas.colors.sites:
            electrons[row::step, column::step] += np.float32(body[channel]) * (1.0 - clear[row::step, column::step])
        for core in cores:
            if core is not None:
                core.own[...] *= clear[core.rows, core.columns]


def _spurious(own: Emitters, uv: Array) -> Emitters:
    """Emitters at pixels `uv` (S, 2), each as bright as the brightest of the station's lamps."""
    like = np.full(len(uv), int(np.argmax(own.at_lens.sum(axis=1) * np.isfinite(own.uv).all(axis=1))))
    some = Emitters(*(getattr(own, name)[like] for name in Emitters.__slots__))
    return replace(some, kind=np.full(len(uv), "injected"), uv=uv, lit=np.ones(len(uv), bool))


def _draw_fish(mask: np.ndarray, knobs: Fish, focal_px: float, moment: Moment) -> None:
    """Mark the pixels that fish hide; each crosses the view again and again."""
    rng, (height, width) = moment.rng(14), mask.shape
    for _ in range(knobs.count):
        far, length, speed = (rng.uniform(*reach) for reach in (knobs.distance_m, knobs.length_m, knobs.speed_m_s))
        half, way = 0.5 * length * focal_px / far, width + 2.0 * length * focal_px / far
        heading = rng.choice((-1.0, 1.0))
        u = (rng.uniform(0.0, way) + heading * speed * moment.t_s * focal_px / far) % way - half * 2.0
        v = rng.uniform(0.2, 0.8) * height + 0.02 * height * np.sin(2.0 * moment.t_s + rng.uniform(0.0, 6.0))
        body = (int(half), max(int(0.28 * half), 1))
        cv2.ellipse(mask, (int(u), int(v)), body, 0.0, 0.0, 360.0, 255, -1, cv2.LINE_AA)
        tail = np.array([[u - heading * 0.8 * half, v], [u - heading * 1.4 * half, v - 0.3 * half]])
        tail = np.vstack([tail, [tail[1, 0], v + 0.3 * half]])
        cv2.fillPoly(mask, [tail.astype(np.int32)], 255, cv2.LINE_AA)
