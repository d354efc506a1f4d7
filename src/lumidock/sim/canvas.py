"""Draws emitters and background light as the electrons that each pixel is expected to collect during the exposure."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np

from lumidock.datatypes import Array
from lumidock.sim.knobs import Output
from lumidock.sim.lens import Lens
from lumidock.sim.optics import Emitters
from lumidock.sim.scattering import halo

# Quantum efficiency of the B, G, R pixels (rows) in the three bands (columns). Sony IMX264: peaks .48, .57, .52.
_QE_COLOR = np.array([[0.48, 0.12, 0.02], [0.12, 0.57, 0.08], [0.03, 0.08, 0.52]])
_QE_MONO = np.array([[0.60, 0.65, 0.55]])
_MID, _WIDE = 4, 16  # pixels between two nodes of the coarse canvases
# A halo is drawn on the mosaic up to _NEAR_PX from its lamp, then up to _FAR_PX on the canvas `mid`, beyond on `wide`.
_NEAR_PX, _FAR_PX = 28.0, 170.0
_FAINT_E = 0.02  # electrons per pixel below which a halo is not drawn
_HALO_RINGS = 256  # angles at which a halo is tabulated
_STEPS_PER_PX = 2.0  # of the path along which motion blurs a core


@dataclass(frozen=True, slots=True)
class Mosaic:
    """Colours of the pixels: quantum efficiency `qe` (C, 3) by channel and band; the pattern repeats every `step`."""

    qe: Array
    step: int
    sites: tuple[tuple[int, int, int], ...]  # channel, row and column of each pixel of the pattern

    @classmethod
    def of(cls, output: Output) -> Mosaic:
        """The Bayer mosaic of the knobs, or a monochrome sensor."""
        if not output.color:
            return cls(_QE_MONO, 1, ((0, 0, 0),))
        channels = ["bgr".index(letter) for letter in output.pattern]
        return cls(_QE_COLOR, 2, tuple((c, i // 2, i % 2) for i, c in enumerate(channels)))


@dataclass(eq=False)
class Canvas:
    """Sums up light: sharp images on the `mosaic` (H, W), wide halos on the coarse canvases `mid` and `wide` (h, w, C).

    `absorption` and `scattering` (3,) 1/m and `phase` are those of the water.
    """

    lens: Lens
    colors: Mosaic
    absorption: Array
    scattering: Array
    phase: str
    range_m: Array | None = None  # (H, W) of the solids, which hide the part of a halo that comes from behind them
    mosaic: Array = field(init=False)
    mid: Array = field(init=False)
    wide: Array = field(init=False)

    def __post_init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Remove all light."""
        camera, channels = self.lens.camera, len(self.colors.qe)
        height, width = (-(-size // _WIDE) for size in (camera.height, camera.width))
        self.wide = np.zeros((height, width, channels), np.float32)
        self.mid = np.zeros((height * _WIDE // _MID, width * _WIDE // _MID, channels), np.float32)
        self.mosaic = np.zeros((camera.height, camera.width), np.float32)
        self.range_m = None

    @cached_property
    def wide_uv(self) -> Array:
        """Pixels (h, w, 2) of the nodes of the canvas `wide`."""
        return _nodes(self.wide.shape, _WIDE)

    @cached_property
    def wide_rays(self) -> Array:
        """Unit rays (h, w, 3) in `cam` of the nodes of the canvas `wide`."""
        return self.lens.rays(self.wide_uv.reshape(-1, 2)).reshape(*self.wide.shape[:2], 3)

    @cached_property
    def wide_etendue(self) -> Array:
        """Solid angle (h, w) sr of the pixels at these nodes, times the relative transmission of the lens."""
        uv = self.wide_uv.reshape(-1, 2)
        return (self.lens.solid_angle(uv) * self.lens.throughput(uv)).reshape(self.wide.shape[:2])

    def add_background(self, photons_sr: Array) -> None:
        """Add background light: photons (h, w, 3) per sr in each band that enter the aperture, at nodes of `wide`."""
        self.wide += (photons_sr @ self.colors.qe.T * self.wide_etendue[:, :, None]).astype(np.float32)

    def add(self, emitters: Emitters, smear_px: Array) -> list[Core | None]:
        """Draw N emitters, moving by `smear_px` (N, 2) during the exposure; returns the core of each, or None."""
        cores: list[Core | None] = [None] * len(emitters)
        for i in np.flatnonzero(emitters.lit):
            direct = emitters.at_lens[i] * np.exp(-(self.absorption + self.scattering) * emitters.range_m[i])
            if emitters.core[i] > 0.0:
                cores[i] = self._add_core(emitters, int(i), self.colors.qe @ direct * emitters.core[i], smear_px[i])
            if emitters.core[i] > 0.0 and self.lens.knobs.ghost > 0.0:
                self._add_ghost(emitters.uv[i], self.colors.qe @ direct * emitters.core[i])
            if emitters.halo[i] > 0.0:
                self._add_halo(emitters, int(i), self.colors.qe @ direct, cores[i])
        return cores

    def _add_core(self, emitters: Emitters, i: int, electrons: Array, smear_px: Array) -> Core:
        knobs = self.lens.knobs
        window_px = float(emitters.window_px[i])
        reach = int(np.ceil(window_px + 5.0 * knobs.blur_px + 1.0 + 0.5 * float(np.hypot(*smear_px))))
        rows, columns = _window(emitters.uv[i], reach, self.mosaic.shape)
        du, dv = (
            np.arange(columns.start, columns.stop) - emitters.uv[i, 0],
            np.arange(rows.start, rows.stop) - emitters.uv[i, 1],
        )
        shares = core_profile(du, dv, window_px, knobs.blur_px, smear_px)
        patch = self._on_mosaic(
            rows, columns, np.broadcast_to(electrons.astype(np.float32), (*shares.shape, len(electrons)))
        )
        patch *= shares * np.float32(1.0 - knobs.glare - knobs.ghost)
        self.mosaic[rows, columns] += patch
        return Core(rows, columns, patch)

    def _add_ghost(self, uv: Array, electrons: Array) -> None:
        """Add the ghost image of an emitter: reflected by sensor and lens, out of focus, mirrored at the centre."""
        knobs = self.lens.knobs
        per_px = knobs.ghost / (np.pi * knobs.ghost_px**2) * electrons
        if per_px.max() < _FAINT_E:
            return
        node = (2.0 * self.lens.camera.center_px - uv + 0.5) / _MID - 0.5
        radius = knobs.ghost_px / _MID
        rows, columns = _window(node, int(radius) + 2, self.mid.shape)
        du, dv = (np.arange(s.start, s.stop) - c for s, c in zip((columns, rows), node, strict=True))
        disc = np.clip(radius - np.hypot(du[None, :], dv[:, None]) + 0.5, 0.0, 1.0)
        self.mid[rows, columns] += (disc[:, :, None] * per_px).astype(np.float32)

    def _on_mosaic(self, rows: slice, columns: slice, values: Array) -> Array:
        """Select from `values` (V, U, C) over a part of the picture the channel (V, U) that each pixel measures."""
        step, out = self.colors.step, np.empty(values.shape[:2], np.float32)
        for channel, row, column in self.colors.sites:
            at = np.s_[(row - rows.start) % step :: step, (column - columns.start) % step :: step]
            out[at] = values[(*at, channel)]
        return out

    def _add_halo(self, emitters: Emitters, i: int, direct_e: Array, core: Core | None) -> None:
        """Add light scattered by the water and glare of the lens, each part on the coarsest canvas that resolves it."""
        J = self.lens.tangents(emitters.uv[i : i + 1])[0]
        focal_px = 1.0 / np.sqrt(np.linalg.norm(np.cross(J[:, 0], J[:, 1])))
        profile = self._profile(emitters, i, direct_e, focal_px)
        near = _NEAR_PX + 2.0 * float(emitters.window_px[i])
        far = max(_FAR_PX, 3.0 * near)
        uv = emitters.uv[i]
        if core is not None and core.own.size:
            core.own[...] += self._peak(profile, J, uv, core)
        rows, columns = _window(uv, int(near) + 1, self.mosaic.shape)
        theta = _angles(J, np.arange(columns.start, columns.stop) - uv[0], np.arange(rows.start, rows.stop) - uv[1])
        patch = self._before_matter(profile.at(theta, 0.0, near / focal_px), rows, columns, 1, emitters.range_m[i])
        self.mosaic[rows, columns] += self._on_mosaic(rows, columns, patch)
        reach = min(profile.reach_px, far)
        if reach > 0.4 * near:
            node = (uv + 0.5) / _MID - 0.5
            rows, columns = _window(node, int(reach) // _MID + 1, self.mid.shape)
            du, dv = (np.arange(s.start, s.stop) - c for s, c in zip((columns, rows), node, strict=True))
            theta = _angles(J, du * _MID, dv * _MID)
            patch = profile.at(theta, near / focal_px, far / focal_px)
            self.mid[rows, columns] += self._before_matter(patch, rows, columns, _MID, emitters.range_m[i])
        if profile.reach_px > 0.4 * far:
            node = (uv + 0.5) / _WIDE - 0.5
            rows, columns = _window(node, int(profile.reach_px) // _WIDE + 1, self.wide.shape)
            apart = np.linalg.norm(self.wide_rays[rows, columns] - self.lens.rays(uv[None])[0], axis=2)
            scale = self.wide_etendue[rows, columns] * (focal_px**2 / float(self.lens.throughput(uv[None])[0]))
            light = profile.at(2.0 * np.arcsin(0.5 * apart), far / focal_px, np.inf)
            light = self._before_matter(light, rows, columns, _WIDE, emitters.range_m[i])
            self.wide[rows, columns] += light * scale[:, :, None].astype(np.float32)

    def _before_matter(self, light: Array, rows: slice, columns: slice, stride: int, lamp_m: float) -> Array:
        """Reduce a halo (V, U, C) where a solid stands in front of the lamp.

        The share of the line of sight that lies before the solid remains, as light that is scattered once comes about
        evenly from all of the line of sight up to the range of the lamp, `lamp_m`.
        """
        if self.range_m is None:
            return light
        middle = stride // 2
        nearer = self.range_m[middle::stride, middle::stride] if stride > 1 else self.range_m
        shape = (rows.stop - rows.start, columns.stop - columns.start)
        part = nearer[rows, columns]
        part = np.pad(part, ((0, shape[0] - part.shape[0]), (0, shape[1] - part.shape[1])), mode="edge")
        return np.asarray(light * np.minimum(part * np.float32(1.0 / lamp_m), np.float32(1.0))[:, :, None])

    def _peak(self, profile: Profile, J_ray_uv: Array, uv: Array, core: Core) -> Array:
        """Electrons of the halo on the pixels of the core, less those at the border of the core."""
        across, down = (np.arange(s.start, s.stop) - c for s, c in zip((core.columns, core.rows), uv, strict=True))
        theta = _angles(J_ray_uv, across, down)
        border = profile.at(theta.max(keepdims=True), 0.0, np.inf)
        return self._on_mosaic(core.rows, core.columns, profile.at(theta, 0.0, np.inf) - border)

    def _profile(self, emitters: Emitters, i: int, direct_e: Array, focal_px: float) -> Profile:
        """Electrons per pixel of the halo as a function of the angle from the lamp."""
        knobs = self.lens.knobs
        blur_rad = np.sqrt(knobs.blur_px**2 + emitters.window_px[i] ** 2 / 4.0 + 1.0 / 12.0) / focal_px
        # rounded to three digits, so that similar emitters share a cached halo
        blur_rad, range_m = (float(f"{value:.3g}") for value in (blur_rad, emitters.range_m[i]))
        bands = [
            halo(float(a), float(b), self.phase, range_m, blur_rad)
            for a, b in zip(self.absorption, self.scattering, strict=True)
        ]
        theta = bands[0][0]
        scattered = np.stack([values for _, values in bands], axis=1) * emitters.at_lens[i]
        electrons = scattered @ self.colors.qe.T / focal_px**2
        r0 = knobs.glare_px / focal_px
        ring = np.gradient(np.pi * theta**2)
        total = direct_e + (electrons * ring[:, None]).sum(axis=0) * focal_px**2
        glare = knobs.glare / (2.0 * np.pi * knobs.glare_px**2) * (1.0 + (theta / r0) ** 2) ** -1.5
        return Profile.of(theta, (electrons + glare[:, None] * total) * emitters.halo[i], focal_px)

    def expected(self) -> Array:
        """Expected electrons (H, W) of every pixel: the mosaic and both coarse canvases, interpolated."""
        step = self.colors.step
        size = (self.mid.shape[1], self.mid.shape[0])
        wide = cv2.resize(self.wide, size, interpolation=cv2.INTER_CUBIC).reshape(self.mid.shape)
        smooth = np.maximum(self.mid + wide, 0.0)
        for channel, row, column in self.colors.sites:
            plane = self.mosaic[row::step, column::step]
            scale, offset = step / _MID, ((row + 0.5) / _MID - 0.5, (column + 0.5) / _MID - 0.5)
            to_node = np.array([[scale, 0.0, offset[1]], [0.0, scale, offset[0]]])
            plane += cv2.warpAffine(
                np.ascontiguousarray(smooth[:, :, channel]),
                to_node,
                (plane.shape[1], plane.shape[0]),
                flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
                borderMode=cv2.BORDER_REPLICATE,
            )
        return self.mosaic


@dataclass(frozen=True, slots=True, eq=False)
class Core:
    """The sharp image of one emitter with the peak of its halo: electrons `own` on rows and columns of the mosaic."""

    rows: slice
    columns: slice
    own: Array


@dataclass(frozen=True, slots=True, eq=False)
class Profile:
    """A halo: electrons per pixel `values` (R, C) at R angles evenly spaced in their logarithm.

    `first` is the logarithm of the first angle, `per_ring` the inverse step, `rises` (R - 1, C) the differences, and
    beyond `reach_px` the halo is too faint to be drawn.
    """

    first: float
    per_ring: float
    values: Array
    rises: Array
    reach_px: float

    @classmethod
    def of(cls, theta: Array, electrons: Array, focal_px: float) -> Profile:
        """The profile of a halo given as electrons (A, C) at the angles `theta` (A,) rad."""
        logs = np.linspace(np.log(0.2 / focal_px), np.log(theta[-1]), _HALO_RINGS)
        values = np.stack([np.interp(logs, np.log(theta), column) for column in electrons.T], axis=1)
        bright = np.flatnonzero(values.max(axis=1) > _FAINT_E)
        reach = float(np.exp(logs[bright[-1]]) * focal_px) if len(bright) else 0.0
        values = values.astype(np.float32)
        return cls(float(logs[0]), float(1.0 / (logs[1] - logs[0])), values, np.diff(values, axis=0), reach)

    def at(self, theta: Array, inner: float, outer: float) -> Array:
        """Electrons (..., C) at angles `theta` (...) rad, with weights that fade in at `inner` and out at `outer`.

        The weights of canvases that share a border add up to one.
        """
        theta = np.maximum(theta, 1e-12, dtype=np.float32)
        place = (np.log(theta) - np.float32(self.first)) * np.float32(self.per_ring)
        np.clip(place, 0.0, _HALO_RINGS - 1.01, out=place)
        ring = place.astype(np.intp)
        place -= ring
        values = self.values.take(ring, axis=0)
        values += place[..., None] * self.rises.take(ring, axis=0)
        if np.isfinite(outer):
            values *= _fade(theta, outer)[..., None]
        if inner > 0.0:
            values *= (np.float32(1.0) - _fade(theta, inner))[..., None]
        return np.asarray(values)


def _fade(theta: Array, end: float) -> Array:
    """Weight that is one up to 0.4 of `end`, zero from `end` on, and a smooth step between; float32."""
    x = np.clip((theta * np.float32(1.0 / end) - np.float32(0.4)) * np.float32(1.0 / 0.6), 0.0, 1.0)
    return np.asarray(np.float32(1.0) - x * x * x * (np.float32(10.0) - x * (np.float32(15.0) - np.float32(6.0) * x)))


def _nodes(shape: tuple[int, ...], stride: int) -> Array:
    u, v = (np.arange(n) * stride + 0.5 * (stride - 1) for n in (shape[1], shape[0]))
    return np.stack(np.meshgrid(u, v), axis=-1)


def _window(at: Array, reach: int, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Rows and columns of a canvas of `shape` within `reach` nodes of the point `at` (2,) u, v."""
    u, v = int(np.floor(at[0])), int(np.floor(at[1]))
    return (
        slice(max(v - reach, 0), max(min(v + reach + 2, shape[0]), 0)),
        slice(max(u - reach, 0), max(min(u + reach + 2, shape[1]), 0)),
    )


def _angles(J_ray_uv: Array, du: Array, dv: Array) -> Array:
    """Angles (V, U) rad between the emitter and pixels at offsets `du` (U,), `dv` (V,) px from it."""
    (uu, cross), (_, vv) = J_ray_uv.T @ J_ray_uv
    return np.asarray(np.sqrt(uu * du[None, :] ** 2 + 2.0 * cross * du[None, :] * dv[:, None] + vv * dv[:, None] ** 2))


def core_profile(du: Array, dv: Array, window_px: float, blur_px: float, smear_px: Array | None = None) -> Array:
    """Share (V, U) of a lamp's direct light on each pixel, at offsets `du` (U,), `dv` (V,) px from its centre.

    A uniform disc of radius `window_px`, moved evenly along `smear_px` (2,), blurred by a Gaussian of `blur_px` and
    integrated over each pixel. The disc is a sum of Gaussians whose centres form a sunflower pattern with its mean at
    the centre, so that the centroid is exact at any radius.
    """
    count = min(max(1, int(2.0 * (window_px / blur_px) ** 2)), 4000)
    k = np.arange(count) + 0.5
    r, angle = window_px * np.sqrt(k / count), k * np.pi * (3.0 - np.sqrt(5.0))
    x, y = r * np.cos(angle), r * np.sin(angle)
    x, y = x - x.mean(), y - y.mean()
    if smear_px is not None and float(np.hypot(*smear_px)) > 0.1:
        steps = int(np.ceil(_STEPS_PER_PX * float(np.hypot(*smear_px)))) + 1
        along = (np.arange(steps) + 0.5) / steps - 0.5
        x, y = ((c[:, None] + s * along[None, :]).ravel() for c, s in zip((x, y), smear_px, strict=True))
    columns = _pixel_integral(du[:, None] - x, blur_px)
    rows = _pixel_integral(dv[:, None] - y, blur_px)
    return np.asarray((rows @ columns.T) / len(x), np.float32)


def _pixel_integral(offset: Array, sigma: float) -> Array:
    """Integral over one pixel of a unit Gaussian of `sigma` px whose centre is `offset` px away."""
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
