"""Renders the solids of a scenario, lit by all lamps and by daylight, as expected electrons of the mosaic."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import cv2
import numpy as np

from lumidock._kernels.rendering import render as kernel
from lumidock._kernels.rendering.raycast import FAR_M, Solids
from lumidock._kernels.rendering.shading import Lights, LitScene, Medium
from lumidock.datatypes import Array
from lumidock.geometry import se3_inverse, transform_points
from lumidock.sim import surroundings
from lumidock.sim.canvas import Mosaic
from lumidock.sim.lens import Lens
from lumidock.sim.optics import PHOTON_J, SPECTRUM, Emitters, Exposure, beam_exponent
from lumidock.sim.scattering import halo
from lumidock.sim.scenario import Scenario
from lumidock.sim.solids import SolidScene, jellyfish, still_solids
from lumidock.sim.water import absorption_scattering, phase_kind
from lumidock.station import Station

_MOST_SAMPLES = 2.0e6  # small pictures are rendered at twice their size up to this; less aliasing of thin bodies
_FAINT_E = 0.25  # lamps that add less than this many electrons to a pixel get no shadows
_COSINES = 512  # angles to the vertical at which scattered daylight is tabulated
_RANGE_LAYERS = 4  # layers of range for which forward scattering of light from solids is computed
_WINDOW = 7  # points of a lamp's window that are tested for visibility
_NOISE = np.random.default_rng(0).uniform(-1.0, 1.0, (128, 128))  # of which stains are made
_NO_MOTION_PX = 0.3  # motion during the exposure below which no blur is computed, px
_LEAST_ROUNDNESS = 0.14  # least determinant over squared trace of the Hessian: curvatures in a ratio of 5
_POINT_SIGMAS, _MOST_POINTS = (0.8, 2.4), 100  # of the difference of Gaussians, in cells; most points per picture
_MOUNT_M = 0.03  # solids this close to a lamp are its mount and do not hide it


@dataclass(frozen=True, slots=True, eq=False)
class MatterImage:
    """Electrons (H, W) of solids and water on the mosaic, ranges (H, W) m of the solids, and the solids in `cam`."""

    electrons: Array
    range_m: Array
    solids: Solids


class MatterRenderer:
    """Renders the solids of one scenario through one lens."""

    def __init__(self, scenario: Scenario, station: Station, lens: Lens, colors: Mosaic) -> None:
        self.scenario, self.station, self.lens, self.colors = scenario, station, lens, colors
        self.still = still_solids(scenario.matter, station)
        camera = lens.camera
        self.scale = 2 if 4 * camera.width * camera.height <= _MOST_SAMPLES else 1
        self.rows, self.columns = (-(-size * self.scale // kernel.BLOCK) for size in (camera.height, camera.width))

    @cached_property
    def _nodes_uv(self) -> Array:
        """Pixels (m, n, 2) of the corners of blocks of samples."""
        v, u = ((np.arange(count + 1) * kernel.BLOCK + 0.5) / self.scale - 0.5 for count in (self.rows, self.columns))
        return np.stack(np.meshgrid(u, v), axis=-1)

    @cached_property
    def _rays(self) -> Array:
        return self.lens.rays(self._nodes_uv.reshape(-1, 2)).reshape(*self._nodes_uv.shape[:2], 3)

    @cached_property
    def _etendue(self) -> Array:
        uv = self._nodes_uv.reshape(-1, 2)
        values = self.lens.solid_angle(uv) * self.lens.throughput(uv)
        return np.asarray(values.reshape(self._nodes_uv.shape[:2]))

    @cached_property
    def _lamp_sr(self) -> Array:
        """Radiance (T, m, n, 3) W/(m2 sr) of scattered headlamp light up to T ranges, at the corners of blocks."""
        lamp = self.scenario.around.headlamp
        if lamp is None:
            return np.zeros((0, 2, 2, 3))
        return surroundings.headlamp_sums(self.scenario, lamp, self._rays)

    def draw(
        self, exposure: Exposure, p_dock: Array, watts: Array, T_cam_later: Array, rng: np.random.Generator
    ) -> MatterImage:
        """Render one frame with M lamps at `p_dock` (M, 3), of power `watts` (M, 3) W in each band.

        `T_cam_later` (4, 4) is the camera's motion during the exposure.
        """
        scene = self._scene(exposure, rng)
        solids = scene.solids(exposure.T_dock_cam)
        gain = self.colors.qe * (self.lens.aperture_m2 * exposure.exposure_s / PHOTON_J)
        faint = _FAINT_E / float(gain.max() * self._etendue.max())
        lights = self._lights(exposure, p_dock, watts)
        blockers = kernel.no_blockers(len(lights.exponent), len(solids.kind))
        lit_scene = LitScene(
            solids, scene.surfaces(), lights, self._medium(exposure), faint=faint, blockers=blockers, noise=_NOISE
        )
        spread = float(np.arccos(np.clip((self._rays[1:, 1:] * self._rays[:-1, :-1]).sum(-1).min(), -1.0, 1.0)))
        step = float(np.sqrt(self._etendue.max())) / self.scale
        sight = kernel.Sight(self._rays, self._etendue, gain, spread, step, float(kernel.BLOCK))
        shape = (self.rows * kernel.BLOCK, self.columns * kernel.BLOCK)
        picture = kernel.Picture(
            np.empty((*shape, len(gain)), np.float32),
            np.empty(shape, np.float32),
            np.zeros((shape[0] // self._stride, shape[1] // self._stride, len(gain)), np.float32),
        )
        kernel.render(lit_scene, sight, kernel.scratch(len(solids.kind)), picture)
        return self._on_mosaic(picture, solids, self._smear(picture.range_m, T_cam_later))

    def _smear(self, range_m: Array, T_cam_later: Array) -> Array:
        """Motion (2,) in samples of the middle of the picture during the exposure, for the median range."""
        middle = self.lens.camera.center_px[None]
        p_cam = self.lens.rays(middle) * float(np.median(range_m[:: kernel.BLOCK, :: kernel.BLOCK]))
        later = self.lens.project(transform_points(se3_inverse(T_cam_later), p_cam))
        return np.asarray((later - middle)[0] * self.scale)

    def _scene(self, exposure: Exposure, rng: np.random.Generator) -> SolidScene:
        knobs = self.scenario.matter
        moving = jellyfish(knobs.jellyfish, exposure.T_dock_cam, exposure.t_s, rng) if knobs.jellyfish else []
        return SolidScene.of(self.still + moving, knobs)

    def _lights(self, exposure: Exposure, p_dock: Array, watts: Array) -> Lights:
        """The lamps of the dock and the headlamp, in `cam`."""
        station, lamps = self.station, self.scenario.lamps
        n = beam_exponent(station.beam_deg)
        p_cam, axis = exposure.p_cam(p_dock), station.axis @ exposure.T_dock_cam[:3, :3]
        peak = watts * (1.0 - lamps.side_share) * ((n + 1.0) / (2.0 * np.pi))[:, None]
        even = watts * lamps.side_share / (4.0 * np.pi)
        radius = np.full(len(n), lamps.window_radius_m)
        head = self.scenario.around.headlamp
        if head is not None:
            own = float(beam_exponent(head.beam_deg))
            p_cam, axis = np.vstack([p_cam, head.offset_m]), np.vstack([axis, [0.0, 0.0, 1.0]])
            bright = head.power_w * (own + 1.0) / (2.0 * np.pi) * np.array(SPECTRUM["white"])
            peak, even = np.vstack([peak, bright]), np.vstack([even, np.zeros(3)])
            n, radius = np.append(n, own), np.append(radius, lamps.window_radius_m)
        lit = (peak + even).sum(axis=1) > 0.0
        return Lights(p_cam[lit], np.ascontiguousarray(axis[lit]), peak[lit], even[lit], n[lit], radius[lit])

    def _medium(self, exposure: Exposure) -> Medium:
        """The water and the daylight in it, as the kernels need them."""
        scenario = self.scenario
        a, b = absorption_scattering(scenario.water)
        height = float(exposure.T_dock_cam[1, 3])
        return Medium(
            beam=a + b,
            surface=np.full(3, scenario.daylight.surface_w_m2),
            decay=surroundings.daylight_decay(scenario),
            up=np.ascontiguousarray(exposure.T_dock_cam[1, :3]),
            depth_m=scenario.daylight.depth_m - height,
            sideways=surroundings.daylight_sideways(scenario, np.linspace(-1.0, 1.0, _COSINES)),
            lamp_sr=self._lamp_sr,
            edge_m=surroundings.LAMP_EDGES_M if len(self._lamp_sr) else np.zeros(0),
        )

    def _on_mosaic(self, picture: kernel.Picture, solids: Solids, smear: Array) -> MatterImage:
        """Blur by motion and lens, resample to pixels, select each pixel's channel, and add light scattered forward."""
        camera, knobs = self.lens.camera, self.lens.knobs
        spread = self._spread(picture.cells, picture.range_m)
        electrons: Array = picture.electrons
        if np.hypot(*smear) > _NO_MOTION_PX:
            electrons = np.asarray(cv2.filter2D(electrons, -1, _line(smear), borderType=cv2.BORDER_REPLICATE))
        blurred = self._cropped(np.asarray(cv2.GaussianBlur(electrons, (0, 0), knobs.blur_px * self.scale)))
        range_m = self._cropped(picture.range_m)
        if self.scale > 1:
            size = (camera.width, camera.height)
            blurred = np.asarray(cv2.resize(blurred, size, interpolation=cv2.INTER_AREA))
            range_m = np.asarray(cv2.resize(range_m, size, interpolation=cv2.INTER_NEAREST))
        blurred = blurred.reshape(camera.height, camera.width, -1)
        mosaic, step = np.empty((camera.height, camera.width), np.float32), self.colors.step
        for channel, row, column in self.colors.sites:
            at = np.s_[row::step, column::step]
            mosaic[at] = blurred[(*at, channel)]
            for source_m, light in spread:
                plane = _sampled(light[:, :, channel], mosaic[at].shape, step * self.scale / self._stride, row, column)
                plane *= np.minimum(range_m[at] * np.float32(1.0 / source_m), np.float32(1.0))
                mosaic[at] += plane
        return MatterImage(mosaic, np.ascontiguousarray(range_m), solids)

    def _cropped(self, samples: Array) -> Array:
        """The samples inside the picture, as blocks extend beyond it."""
        camera = self.lens.camera
        return samples[: camera.height * self.scale, : camera.width * self.scale]

    @property
    def _stride(self) -> int:
        """Samples along the side of a cell of the grid on which forward scattering is computed."""
        return kernel.BLOCK // 2 if self.scale > 1 else kernel.BLOCK

    def _spread(self, coarse: Array, range_m: Array) -> list[tuple[float, Array]]:
        """Light from solids that water and lens scatter forward, (h, w, C), for each of some layers of range.

        With each layer comes its range m. Each layer of range is convolved with the halo that a lamp at this range has.
        """
        height, width, channels = coarse.shape
        far = cv2.resize(range_m, (width, height), interpolation=cv2.INTER_NEAREST)
        solid = far < FAR_M
        if not solid.any():
            return []
        edges = np.geomspace(far.min(), 1.001 * max(float(far[solid].max()), float(far.min()) + 0.1), _RANGE_LAYERS + 1)
        pixel_rad = float(np.sqrt(self.lens.solid_angle(self.lens.camera.center_px[None])[0])) / self.scale
        spread = []
        for near, end in pairwise(edges):
            part = coarse * (solid & (far >= near) & (far < end))[:, :, None]
            middle = float(f"{np.sqrt(near * end):.3g}")
            if part.max() > _FAINT_E:
                kernels = (self._kernel(channel, middle, self._stride * pixel_rad) for channel in range(channels))
                planes = [_convolved(part[:, :, channel], k) for channel, k in enumerate(kernels)]
                spread.append((middle, np.stack(planes, axis=2)))
        return spread

    def _kernel(self, channel: int, range_m: float, cell_rad: float) -> Array:
        """Scattered light that a cell at a range adds to the cells around it, over its direct light: (65, 65)."""
        a, b = absorption_scattering(self.scenario.water)
        band = channel if len(self.colors.qe) == 3 else 1
        theta, scattered = halo(float(a[band]), float(b[band]), phase_kind(self.scenario.water), range_m, 0.0)
        ratio = scattered * np.exp((a[band] + b[band]) * range_m)
        ring = np.concatenate(
            [[0.0], np.cumsum(0.5 * (ratio[1:] * theta[1:] + ratio[:-1] * theta[:-1]) * np.diff(theta))]
        )
        reach = 32
        offset = np.arange(-reach, reach + 1)
        angle = np.hypot(offset[:, None], offset[None, :]) * cell_rad
        values = np.exp(np.interp(np.log(np.maximum(angle, 1e-9)), np.log(theta), np.log(np.maximum(ratio, 1e-30))))
        values *= cell_rad**2
        values[reach, reach] = 2.0 * np.pi * float(np.interp(cell_rad / np.sqrt(np.pi), theta, ring))
        knobs = self.lens.knobs
        wide = knobs.glare_px * np.sqrt(float(self.lens.solid_angle(self.lens.camera.center_px[None])[0]))
        glare = knobs.glare / (2.0 * np.pi * wide**2) * (1.0 + (angle / wide) ** 2) ** -1.5
        fade = np.clip((reach + 1.0 - angle / cell_rad) / (0.4 * reach), 0.0, 1.0)
        return np.asarray((values + glare * cell_rad**2) * fade * fade * (3.0 - 2.0 * fade), np.float32)


def _line(smear: Array) -> Array:
    """Convolution kernel of an even motion by `smear` (2,) samples, centred on the middle of the motion."""
    reach = int(np.ceil(0.5 * np.abs(smear).max())) + 1
    steps = 8 * int(np.ceil(np.hypot(*smear)))
    along = (np.arange(steps) + 0.5) / steps - 0.5
    sums = np.zeros((2 * reach + 1, 2 * reach + 1), np.float32)
    u, v = (reach + along * way for way in smear)
    for column, fu in ((np.floor(u), 1.0 - u % 1.0), (np.floor(u) + 1.0, u % 1.0)):
        for row, fv in ((np.floor(v), 1.0 - v % 1.0), (np.floor(v) + 1.0, v % 1.0)):
            np.add.at(sums, (row.astype(int), column.astype(int)), (fu * fv).astype(np.float32))
    return sums / np.float32(steps)


def compact_points(electrons: Array, read_noise_e: float) -> Array:
    """Pixels (R, 2) of compact bright points in a picture (H, W) of electrons, the brightest `_MOST_POINTS` of them.

    Maxima of a difference of Gaussians over cells of 2 x 2 pixels that exceed four times the noise and a fifth of the
    light around them, and are not ridges. Source: D. Lowe, IJCV 60, 2004, sections 3 and 4.1.
    """
    cells = cv2.resize(electrons, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    narrow, wide = (cv2.GaussianBlur(cells, (0, 0), sigma) for sigma in _POINT_SIGMAS)
    apart = narrow - wide
    noise = np.sqrt(np.maximum(wide, 0.0) + read_noise_e**2)
    uu, vv, cross = (cv2.Sobel(apart, -1, dx, dy, ksize=3) for dx, dy in ((2, 0), (0, 2), (1, 1)))
    ridge = uu * vv - cross * cross < _LEAST_ROUNDNESS * (uu + vv) ** 2
    peaks = (
        ~ridge & (apart == cv2.dilate(apart, np.ones((5, 5), np.uint8))) & (apart > np.maximum(4.0 * noise, 0.2 * wide))
    )
    v, u = np.nonzero(peaks)
    order = np.argsort(-apart[v, u], kind="stable")[:_MOST_POINTS]
    return np.column_stack([u[order], v[order]]) * 2.0 + 0.5


def _convolved(plane: Array, kernel_px: Array) -> Array:
    plane = np.ascontiguousarray(plane)
    return np.asarray(cv2.filter2D(plane, -1, kernel_px, borderType=cv2.BORDER_REPLICATE))


def _sampled(coarse: Array, shape: tuple[int, ...], scale: float, row: int, column: int) -> Array:
    """A coarse grid (h, w) interpolated at those pixels of a mosaic that measure one channel: `shape` (H, W).

    These pixels are `scale` cells of the grid apart; the first one is in `row` and `column` of the pattern.
    """
    half = 0.5 * scale
    to_cell = np.array([[scale, 0.0, half * (column + 0.5) - 0.5], [0.0, scale, half * (row + 0.5) - 0.5]])
    return np.asarray(
        cv2.warpAffine(
            np.ascontiguousarray(coarse),
            to_cell,
            (shape[1], shape[0]),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )
    )


def visible_share(solids: Solids, emitters: Emitters, radius_m: float) -> Array:
    """Share (N,) of the window of each emitter that solids do not hide; `radius_m` is that of the windows."""
    count = len(emitters)
    across = np.cross(emitters.p_cam, [0.0, 1.0, 0.0])
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    down = np.cross(emitters.p_cam, across)
    down /= np.maximum(np.linalg.norm(down, axis=1, keepdims=True), 1e-9)
    k = np.arange(_WINDOW) + 0.5
    r, angle = radius_m * np.sqrt(k / _WINDOW), k * np.pi * (3.0 - np.sqrt(5.0))
    points = (
        emitters.p_cam[:, None]
        + (r * np.cos(angle))[:, None] * across[:, None]
        + (r * np.sin(angle))[:, None] * down[:, None]
    )
    shows = np.zeros(count * _WINDOW, np.int64)
    kernel.seen_from_origin(solids, points.reshape(-1, 3), np.full(count * _WINDOW, _MOUNT_M), shows)
    return np.asarray(shows.reshape(count, _WINDOW).mean(axis=1))
