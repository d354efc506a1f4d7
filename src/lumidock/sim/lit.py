"""Draws the solids of a scenario, lit by every lamp and by the day, into the electrons of the mosaic."""

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
from lumidock.sim import around
from lumidock.sim.canvas import Mosaic
from lumidock.sim.lens import Lens
from lumidock.sim.optics import PHOTON_J, SPECTRUM, Emitters, View, beam_exponent
from lumidock.sim.scattering import halo
from lumidock.sim.scenario import Scenario
from lumidock.sim.solids import Scene, jellyfish, still_solids
from lumidock.sim.water import absorption_scattering, phase_kind
from lumidock.station import Station

_MOST_SAMPLES = 2.0e6  # up to this many, pictures are drawn at twice their size, so that ropes and screws are no dots
_FAINT_E = 0.25  # light below this many electrons is interpolated, and casts no shadow
_COARSE = 16  # samples between two columns of the grid for what changes slowly
_COSINES = 512
_RINGS_M = 4  # ranges at which the light that matter scatters forward is spread
_WINDOW = 7  # rays to a lamp's window, from which its visible share is counted
_NOISE = np.random.default_rng(0).uniform(-1.0, 1.0, (128, 128))  # that stains are made of
_STILL_PX = 0.3  # motion during the exposure that does not show
_ROUND = 0.14  # least determinant over squared trace of the curvatures, a ratio of 5 between them
_POINT_PX, _MOST_POINTS = (0.8, 2.4), 100  # Gaussians, in cells, that tell a compact point; as many are noted
_MOUNT_M = 0.03  # what is this close to a lamp carries it and hides nothing of it


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """Electrons (H, W) of matter and open water on the mosaic, the ranges (H, W) m, and what is in the way."""

    electrons: Array
    range_m: Array
    solids: Solids


class Painter:
    """Draws matter through one lens."""

    def __init__(self, scenario: Scenario, station: Station, lens: Lens, colors: Mosaic) -> None:
        self.scenario, self.station, self.lens, self.colors = scenario, station, lens, colors
        self.still = still_solids(scenario.matter, station)
        camera = lens.camera
        self.scale = 2 if 4 * camera.width * camera.height <= _MOST_SAMPLES else 1
        self.rows, self.columns = (-(-size * self.scale // kernel.BLOCK) for size in (camera.height, camera.width))

    @cached_property
    def _nodes_uv(self) -> Array:
        """Pixels (m, n, 2) of the samples at the corners of blocks."""
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
        """Light of the vehicle's lamp that the water scatters, up to each range, on the coarse grid."""
        lamp = self.scenario.around.headlamp
        if lamp is None:
            return np.zeros((0, 2, 2, 3))
        return around.headlamp_sums(self.scenario, lamp, self._rays)

    def draw(self, view: View, p_dock: Array, watts: Array, T_cam_later: Array, rng: np.random.Generator) -> Drawn:
        """One frame; the M lamps stand at `p_dock` (M, 3) and have `watts` (M, 3) in each band.

        `T_cam_later` is the camera's motion during the exposure.
        """
        scene = self._scene(view, rng)
        solids = scene.solids(view.T_dock_cam)
        gain = self.colors.qe * (self.lens.aperture_m2 * view.exposure_s / PHOTON_J)
        faint = _FAINT_E / float(gain.max() * self._etendue.max())
        lights = self._lights(view, p_dock, watts)
        blockers = kernel.no_blockers(len(lights.exponent), len(solids.kind))
        world = LitScene(solids, scene.surfaces(), lights, self._medium(view), faint, blockers, _NOISE)
        spread = float(np.arccos(np.clip((self._rays[1:, 1:] * self._rays[:-1, :-1]).sum(-1).min(), -1.0, 1.0)))
        step = float(np.sqrt(self._etendue.max())) / self.scale
        sight = kernel.Sight(self._rays, self._etendue, gain, spread, step, float(kernel.BLOCK))
        shape = (self.rows * kernel.BLOCK, self.columns * kernel.BLOCK)
        picture = kernel.Picture(
            np.empty((*shape, len(gain)), np.float32),
            np.empty(shape, np.float32),
            np.zeros((shape[0] // self._stride, shape[1] // self._stride, len(gain)), np.float32),
        )
        kernel.render(world, sight, kernel.scratch(len(solids.kind)), picture)
        return self._developed(picture, solids, self._smear(picture.range_m, T_cam_later))

    def _smear(self, range_m: Array, T_cam_later: Array) -> Array:
        """How far (2,) samples the middle of the picture moves during the exposure."""
        middle = self.lens.camera.center_px[None]
        p_cam = self.lens.rays(middle) * float(np.median(range_m[:: kernel.BLOCK, :: kernel.BLOCK]))
        later = self.lens.project(transform_points(se3_inverse(T_cam_later), p_cam))
        return np.asarray((later - middle)[0] * self.scale)

    def _scene(self, view: View, rng: np.random.Generator) -> Scene:
        knobs = self.scenario.matter
        moving = jellyfish(knobs.jellyfish, view.T_dock_cam, view.t_s, rng) if knobs.jellyfish else []
        return Scene.of(self.still + moving, knobs)

    def _lights(self, view: View, p_dock: Array, watts: Array) -> Lights:
        """The dock's lamps, and that of the vehicle, in `cam`."""
        station, lamps = self.station, self.scenario.lamps
        n = beam_exponent(station.beam_deg)
        p_cam, axis = view.p_cam(p_dock), station.axis @ view.T_dock_cam[:3, :3]
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

    def _medium(self, view: View) -> Medium:
        """The water, as `sim.around` has it."""
        scenario = self.scenario
        a, b = absorption_scattering(scenario.water)
        height = float(view.T_dock_cam[1, 3])
        return Medium(
            beam=a + b,
            surface=np.full(3, scenario.daylight.surface_w_m2),
            decay=around.daylight_decay(scenario),
            up=np.ascontiguousarray(view.T_dock_cam[1, :3]),
            depth_m=scenario.daylight.depth_m - height,
            sideways=around.daylight_sideways(scenario, np.linspace(-1.0, 1.0, _COSINES)),
            lamp_sr=self._lamp_sr,
            edge_m=around.LAMP_EDGES_M if len(self._lamp_sr) else np.zeros(0),
        )

    def _developed(self, picture: kernel.Picture, solids: Solids, smear: Array) -> Drawn:
        """Blurred by the lens, brought to the size of the picture, each pixel's own channel, spread by the water."""
        camera, knobs = self.lens.camera, self.lens.knobs
        spread = self._spread(picture.cells, picture.range_m)
        electrons: Array = picture.electrons
        if np.hypot(*smear) > _STILL_PX:
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
        return Drawn(mosaic, np.ascontiguousarray(range_m), solids)

    def _cropped(self, samples: Array) -> Array:
        """Without what whole blocks have beyond the picture."""
        camera = self.lens.camera
        return samples[: camera.height * self.scale, : camera.width * self.scale]

    @property
    def _stride(self) -> int:
        """Samples between two cells of the grid on which light is spread."""
        return kernel.BLOCK // 2 if self.scale > 1 else kernel.BLOCK

    def _spread(self, coarse: Array, range_m: Array) -> list[tuple[float, Array]]:
        """Ranges m of matter, and the light (h, w, C) from there that water scatters forward and the lens throws about.

        Each range's share is spread as a lamp at that range would be; a nearer solid is before a part of it.
        """
        height, width, channels = coarse.shape
        far = cv2.resize(range_m, (width, height), interpolation=cv2.INTER_NEAREST)
        solid = far < FAR_M
        if not solid.any():
            return []
        edges = np.geomspace(far.min(), 1.001 * max(float(far[solid].max()), float(far.min()) + 0.1), _RINGS_M + 1)
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
        """What a coarse cell of matter at a range sends to the cells around it, over what it shows directly."""
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
    """The kernel that smears evenly along (2,) px, its middle where the middle of the way is."""
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
    """Pixels (R, 2) of the compact bright points of a picture (H, W) of electrons, at most `_MOST_POINTS`.

    Maxima of the difference of two Gaussians over cells of 2 x 2 pixels, which noise does not hide, which stand out
    from what is around them and which are no ridges. Source: D. Lowe, IJCV 60, 2004, 3 and 4.1.
    """
    cells = cv2.resize(electrons, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    narrow, wide = (cv2.GaussianBlur(cells, (0, 0), sigma) for sigma in _POINT_PX)
    apart = narrow - wide
    noise = np.sqrt(np.maximum(wide, 0.0) + read_noise_e**2)
    uu, vv, cross = (cv2.Sobel(apart, -1, dx, dy, ksize=3) for dx, dy in ((2, 0), (0, 2), (1, 1)))
    ridge = uu * vv - cross * cross < _ROUND * (uu + vv) ** 2
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
    """A coarse grid (h, w) at the sites (H, W) of a mosaic that are `scale` cells apart, from a row and a column on."""
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


def visible_share(solids: Solids, seen: Emitters, radius_m: float) -> Array:
    """Share (N,) of each emitter's window, of `radius_m`, that no solid hides."""
    count = len(seen)
    across = np.cross(seen.p_cam, [0.0, 1.0, 0.0])
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    down = np.cross(seen.p_cam, across)
    down /= np.maximum(np.linalg.norm(down, axis=1, keepdims=True), 1e-9)
    k = np.arange(_WINDOW) + 0.5
    r, angle = radius_m * np.sqrt(k / _WINDOW), k * np.pi * (3.0 - np.sqrt(5.0))
    points = (
        seen.p_cam[:, None]
        + (r * np.cos(angle))[:, None] * across[:, None]
        + (r * np.sin(angle))[:, None] * down[:, None]
    )
    shows = np.zeros(count * _WINDOW, np.int64)
    kernel.seen_from_origin(solids, points.reshape(-1, 3), np.full(count * _WINDOW, _MOUNT_M), shows)
    return np.asarray(shows.reshape(count, _WINDOW).mean(axis=1))
