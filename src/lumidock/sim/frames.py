"""Renders one frame: all sources of light and all bodies in view, the expected electrons, and the truth about them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from lumidock.datatypes import Array, Indices
from lumidock.geometry import se3_exp, se3_inverse, se3_log, transform_points
from lumidock.sim import surroundings
from lumidock.sim.canvas import Canvas, Core, Mosaic
from lumidock.sim.draws import Draw
from lumidock.sim.knobs import Fish, WaterSurface
from lumidock.sim.lens import Lens
from lumidock.sim.matter_renderer import MatterRenderer, compact_points, visible_share
from lumidock.sim.optics import PHOTON_J, Emitters, Exposure, joined, lamp_watts, lamps, on_share
from lumidock.sim.scenario import Scenario
from lumidock.sim.sensor import electrons_per_level, hot_pixels, picture, read_out, saturation_e
from lumidock.sim.water import absorption_scattering, green_index, phase_kind
from lumidock.station import Station

_BODY_ALBEDO = 0.1  # of fish and of the hull `around.hull`
_TWILIGHT = 0.3  # irradiance of a vertical face over that from above


@dataclass(frozen=True, slots=True, eq=False)
class FrameConditions:
    """What determines one frame, beside the scenario.

    `t_s`: time since the start; `exposure_s`; `T_dock_cam`: pose at the middle of the exposure; `T_cam_later`: motion
    of the camera during the exposure; `p_dock` (M, 3): true positions of the M lamps; `transmission` (M,): of their
    windows; `dark`: indices of lamps that are off; `spurious` (S, 2) px: images of lamps that are not of the dock;
    `surface`: water surface that reflects the lamps; `dock`: whether the dock's lamps are drawn; `draws`: seed of what
    stays the same through a run.
    """

    t_s: float
    exposure_s: float
    T_dock_cam: Array
    T_cam_later: Array
    p_dock: Array
    transmission: Array
    dark: Indices
    spurious: Array
    surface: WaterSurface | None
    dock: bool = True
    draws: tuple[int, ...] = (0,)

    def shifted(self, lapse_s: float) -> FrameConditions:
        """The conditions `lapse_s` later, with the camera moving on at the same velocity."""
        way = se3_log(self.T_cam_later) * (lapse_s / self.exposure_s)
        return replace(self, t_s=self.t_s + lapse_s, T_dock_cam=self.T_dock_cam @ se3_exp(way))

    def rng(self, purpose: Draw) -> np.random.Generator:
        """A generator that gives the same draws in every frame of a run."""
        return np.random.default_rng([*self.draws, purpose])


@dataclass(frozen=True, slots=True, eq=False)
class ExpectedFrame:
    """Expected electrons (H, W) of one frame, and the N emitters in it with their matched-filter SNR (N,).

    The first M emitters are the lamps of the station. `reflections` (R, 2) px are compact bright points on solids.
    """

    electrons: Array
    emitters: Emitters
    snr: Array
    reflections: Array


class FrameRenderer:
    """Renders frames of one scenario through one lens."""

    def __init__(self, scenario: Scenario, station: Station, lens: Lens, draws: tuple[int, ...] = (0,)) -> None:
        a, b = absorption_scattering(scenario.water)
        self.scenario, self.station, self.lens = scenario, station, lens
        self.canvas = Canvas(lens, Mosaic.of(scenario.output), a, b, phase_kind(scenario.water))
        shape = (lens.camera.height, lens.camera.width)
        self.matter_renderer = (
            MatterRenderer(scenario, station, lens, self.canvas.colors) if scenario.matter.is_present else None
        )
        self.hot_at, self.hot_e_s = hot_pixels(scenario.sensor, shape, np.random.default_rng([*draws, Draw.HOT_PIXELS]))

    @cached_property
    def lamp_sr(self) -> Array | None:
        """Radiance (h, w, 3) W/(m2 sr) of headlamp light that the water scatters back; the same in every frame."""
        lamp = self.scenario.around.headlamp
        return surroundings.headlamp_sr(self.scenario, lamp, self.canvas.wide_rays) if lamp else None

    def expect(self, conditions: FrameConditions) -> ExpectedFrame:
        """Compute the expected electrons of one frame."""
        self.canvas.clear()
        emitters, watts = self._emitters(conditions)
        reflections: Array = np.empty((0, 2))
        if self.matter_renderer is not None:
            emitters, reflections = self._draw_matter(self.matter_renderer, conditions, emitters, watts)
        cores = self.canvas.add(emitters, self._smear(conditions, emitters))
        if self.matter_renderer is None:
            surroundings.add_background(self.canvas, self.scenario, self._exposure(conditions), self.lamp_sr)
        electrons = self.canvas.expected()
        self._occlude(conditions, electrons, cores)
        rows, columns = self.hot_at
        electrons[rows, columns] += (self.hot_e_s * conditions.exposure_s).astype(np.float32)
        return ExpectedFrame(electrons, emitters, np.array([self._snr(electrons, core) for core in cores]), reflections)

    def picture_of(self, expected: ExpectedFrame, rng: np.random.Generator) -> np.ndarray:
        """The picture with noise drawn from `rng`: (H, W, 3) bgr8, or (H, W) in the other formats."""
        return picture(
            read_out(expected.electrons, self.scenario.sensor, rng), self.scenario.sensor, self.scenario.output
        )

    def _exposure(self, conditions: FrameConditions) -> Exposure:
        return Exposure(self.lens, conditions.T_dock_cam, conditions.exposure_s, conditions.t_s)

    def _draw_matter(
        self, matter_renderer: MatterRenderer, conditions: FrameConditions, emitters: Emitters, watts: Array
    ) -> tuple[Emitters, Array]:
        """Draw the solids; returns the emitters without what solids hide, and compact bright points (R, 2) px."""
        moves = self.scenario.lens.motion
        later = conditions.T_cam_later if moves else np.eye(4)
        drawn = matter_renderer.draw(
            self._exposure(conditions), conditions.p_dock, watts, later, conditions.rng(Draw.JELLYFISH)
        )
        self.canvas.mosaic[...] = drawn.electrons
        self.canvas.range_m = drawn.range_m
        share = visible_share(drawn.solids, emitters, self.scenario.lamps.window_radius_m)
        share[emitters.kind == "injected"] = 1.0
        emitters = replace(emitters, core=emitters.core * share)
        apart = compact_points(drawn.electrons, self.scenario.sensor.read_noise_e)
        lamps = emitters.uv[emitters.lit & (emitters.core > 0.0)]
        near = (
            np.linalg.norm(apart[:, None] - lamps[None], axis=2)
            < 3.0 + emitters.window_px[emitters.lit & (emitters.core > 0.0)]
        )
        return emitters, apart[~near.any(axis=1)]

    def _emitters(self, conditions: FrameConditions) -> tuple[Emitters, Array]:
        """All emitters, the station's M lamps first, and the radiant power (M, 3) W of these in each band."""
        scenario, station, exposure = self.scenario, self.station, self._exposure(conditions)
        knobs = scenario.around
        p_dock, radius_m = conditions.p_dock, scenario.lamps.window_radius_m
        duty = on_share(scenario.lamps.pwm_hz, scenario.lamps.pwm_duty, conditions.t_s, conditions.exposure_s)
        watts = lamp_watts(scenario, station, conditions.transmission, duty)
        own = lamps(exposure, station, p_dock, watts, scenario.lamps)
        shining = ~np.isin(np.arange(len(station)), conditions.dark)
        parts = [replace(own, lit=own.lit & shining & conditions.dock)]
        watts = watts * shining[:, None]
        if conditions.surface is not None:
            n, rng = green_index(scenario.water), conditions.rng(Draw.MIRROR_IMAGES)
            own_lamps = surroundings.LampSet(station, p_dock, watts, radius_m)
            parts += surroundings.mirrored(conditions.surface, n, exposure, own_lamps, rng)
        if knobs.glints is not None and conditions.dock:
            parts.append(
                surroundings.glints(knobs.glints, exposure, station, p_dock, watts, conditions.rng(Draw.GLINTS))
            )
        if knobs.vehicle is not None:
            parts.append(surroundings.vehicle(knobs.vehicle, exposure, radius_m))
        if knobs.snow is not None:
            parts.append(surroundings.snow(knobs.snow, scenario, exposure, conditions.rng(Draw.SNOW)))
        if len(conditions.spurious):
            parts.append(_spurious(own, conditions.spurious))
        return joined(parts), watts * conditions.dock

    def _smear(self, conditions: FrameConditions, emitters: Emitters) -> Array:
        """Motion (N, 2) px of the image of each emitter during the exposure."""
        if not self.scenario.lens.motion or np.array_equal(conditions.T_cam_later, np.eye(4)):
            return np.zeros((len(emitters), 2))
        later = transform_points(se3_inverse(conditions.T_cam_later), emitters.p_cam)
        smear = self.lens.project(later) - self.lens.project(emitters.p_cam)
        still = (emitters.kind == "injected") | ~np.isfinite(smear).all(axis=1)
        return np.where(still[:, None], 0.0, np.clip(smear, -200.0, 200.0))

    def _snr(self, electrons: Array, core: Core | None) -> float:
        """Signal-to-noise ratio of the image of one emitter for a filter that matches its shape.

        sqrt(sum of s^2 / v) over the pixels of the core: s are its electrons as far as they do not saturate, v is the
        variance by shot noise of all other light, read noise and rounding. Source: D. North, RCA Report PTR-6C, 1943.
        """
        if core is None or not core.own.size:
            return 0.0
        sensor, full = self.scenario.sensor, saturation_e(self.scenario.sensor)
        total = electrons[core.rows, core.columns]
        rest = np.maximum(total - core.own, 0.0)
        signal = np.minimum(total, full) - np.minimum(rest, full)
        variance = rest + sensor.read_noise_e**2 + electrons_per_level(sensor) ** 2 / 12.0
        return float(np.sqrt((signal * signal / variance).sum(dtype=np.float64)))

    def _occlude(self, conditions: FrameConditions, electrons: Array, cores: list[Core | None]) -> None:
        """Draw dark bodies in front of everything: fish, and the own hull."""
        camera, knobs = self.lens.camera, self.scenario.around
        if knobs.fish is None and knobs.hull == 0.0:
            return
        mask = np.zeros((camera.height, camera.width), np.uint8)
        if knobs.fish is not None:
            _draw_fish(mask, knobs.fish, float(camera.focal_px.mean()), conditions)
        if knobs.hull > 0.0:
            across, up = int(0.55 * camera.width), int(knobs.hull * camera.height)
            _fill_ellipse(mask, (camera.width // 2, camera.height), (across, up))
        clear = np.float32(1.0) - mask * np.float32(1.0 / 255.0)
        day = surroundings.daylight_w_m2(self.scenario, float(conditions.T_dock_cam[1, 3])) * _TWILIGHT
        photons = day * _BODY_ALBEDO / np.pi * (self.lens.aperture_m2 * conditions.exposure_s / PHOTON_J)
        body = self.canvas.colors.qe @ photons * float(self.lens.solid_angle(camera.center_px[None])[0])
        electrons *= clear
        step = self.canvas.colors.step
        for channel, row, column in self.canvas.colors.sites:
            electrons[row::step, column::step] += np.float32(body[channel]) * (1.0 - clear[row::step, column::step])
        for core in cores:
            if core is not None:
                core.own[...] *= clear[core.rows, core.columns]


def _spurious(own: Emitters, uv: Array) -> Emitters:
    """Emitters at pixels `uv` (S, 2), each with the brightness of the brightest of the station's lamps."""
    like = np.full(len(uv), int(np.argmax(own.at_lens.sum(axis=1) * np.isfinite(own.uv).all(axis=1))))
    some = Emitters(*(getattr(own, name)[like] for name in Emitters.__slots__))
    return replace(some, kind=np.full(len(uv), "injected"), uv=uv, lit=np.ones(len(uv), bool))


def _fill_ellipse(mask: np.ndarray, center: tuple[int, int], semi_axes: tuple[int, int]) -> None:
    """Set the pixels of an upright ellipse to 255, with smooth edges."""
    cv2.ellipse(
        mask, center, semi_axes, 0.0, startAngle=0.0, endAngle=360.0, color=255, thickness=-1, lineType=cv2.LINE_AA
    )


def _draw_fish(mask: np.ndarray, knobs: Fish, focal_px: float, conditions: FrameConditions) -> None:
    """Mark the pixels that fish hide; each fish crosses the picture repeatedly."""
    rng, (height, width) = conditions.rng(Draw.FISH), mask.shape
    for _ in range(knobs.count):
        far, length, speed = (rng.uniform(*reach) for reach in (knobs.distance_m, knobs.length_m, knobs.speed_m_s))
        half, way = 0.5 * length * focal_px / far, width + 2.0 * length * focal_px / far
        heading = rng.choice((-1.0, 1.0))
        u = (rng.uniform(0.0, way) + heading * speed * conditions.t_s * focal_px / far) % way - half * 2.0
        v = rng.uniform(0.2, 0.8) * height + 0.02 * height * np.sin(2.0 * conditions.t_s + rng.uniform(0.0, 6.0))
        body = (int(half), max(int(0.28 * half), 1))
        _fill_ellipse(mask, (int(u), int(v)), body)
        tail = np.array([[u - heading * 0.8 * half, v], [u - heading * 1.4 * half, v - 0.3 * half]])
        tail = np.vstack([tail, [tail[1, 0], v + 0.3 * half]])
        cv2.fillPoly(mask, [tail.astype(np.int32)], 255, cv2.LINE_AA)
