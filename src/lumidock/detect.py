"""The lights in a frame: centroids with their covariance, radii, fluxes, and how likely each is a lamp.

A light is a maximum of a difference-of-Gaussians scale space in one of the planes blue, green, red and their mean. Its
centroid is the maximum of that filter in the plane where it is most precise. Which steps there are, with which
equations and why, is the subject of docs/detector.md.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from lumidock import exposure, lamp
from lumidock._kernels.detection import blobs, centroid, groups, live, profiles
from lumidock._kernels.detection.canvas import Canvas, canvas
from lumidock.config import DetectConfig
from lumidock.datatypes import SATURATED, Array, Detections, Frame, Image, Indices
from lumidock.lamp import Seen
from lumidock.picture import in_color

_SCALES = 0.9 * np.sqrt(2.0) ** np.arange(3)  # standard deviations of the Gaussians, pixels of their level
_TAPS = 3.0  # standard deviations on each side that a filter sums: 0.3 % of a Gaussian is beyond
_SAMPLES = 1024  # responses whose median absolute value is the noise: known to 4 %
_SQUARES, _SQUARE_PX = (4, 3), 24  # columns and rows of squares of the frame where noise is measured, and their side
_SIGMA = 1.4826  # standard deviation of a Gaussian over its median absolute deviation
_ROUNDING = 0.29 * 0.115  # response noise of rounding at scale 1: 1/sqrt(12) grey levels times the filter's gain
_BORDER = 2.5  # distance from the border, in blob sizes, within which mirrored samples bias the centroid toward it
_TINY = 1e-6  # px^2, that keep a covariance regular
_COARSE = 3  # pyramid level from which on the whole frame is searched: one of its pixels is a tile
_LEAST_TOP = 160.0  # grey levels; nothing saturates lower
_STEP = 3.0  # grey levels of a histogram step, over which compression spreads a saturated level
_PLATEAU = 16  # least pixels of the half-size image that are saturated
_FLATTER = 3  # least ratio of the pixels in the highest step to those in the next
_LEAST_SIDE = 4  # pixels; in less nothing stands out


class Scan:
    """How a camera's frames are looked at and, from frame to frame, where they saturate and how large lights are.

    `aspect` is the camera's focal length in u over that in v, px: where the two are far apart, as in a single field of
    interlaced video, the frame is stretched so that a round lamp is round.
    """

    def __init__(self, frame: Frame, config: DetectConfig, aspect: float = 1.0) -> None:
        """For frames like this one."""
        self.like = (frame.image.shape, frame.image.dtype, frame.encoding)
        self.config = config
        square = 1.0 / config.square < aspect < config.square
        self.stretch = np.array([max(1.0 / aspect, 1.0), max(aspect, 1.0)]) if not square else np.ones(2)
        self.forget()

    def fits(self, frame: Frame) -> bool:
        """Whether a frame is like those that this was made for."""
        return self.like == (frame.image.shape, frame.image.dtype, frame.encoding)

    def forget(self) -> None:
        """Drop what the frames before say."""
        self.saturated = SATURATED
        self.glare = 0.0  # share of the picture that is saturated
        self.size_px = 0.0
        self.noise: dict[tuple[int, int], Array] = {}  # (P,) of the responses of a level and a scale


class Blobs(NamedTuple):
    """Blobs: `rows` (N, columns of `blobs`), U and V px among them, `cov` (N, 2, 2) px^2, `measured` (N, MEASURES)."""

    rows: Array
    cov: Array
    measured: Array


def lights(frame: Frame, config: DetectConfig, scan: Scan | None = None, predicted: Array | None = None) -> Detections:
    """Find the lights of a frame: in all of it, or in windows around predicted ones.

    `predicted` (n, 3) u, v and reach px. The layer is not known yet. Takes any picture; one without lights gives no
    detections.
    """
    scan = scan if scan is not None and scan.fits(frame) else Scan(frame, config)
    if min(frame.image.shape[:2]) < _LEAST_SIDE:
        return _none(frame, scan)
    found = seen(frame, scan, predicted)
    return _none(frame, scan) if found is None else _detections(frame, found, scan)


def seen(frame: Frame, scan: Scan, predicted: Array | None = None) -> Seen | None:
    """The blobs of `lights`, with what is known of each; in px of the frame as `scan` stretches it."""
    image = _squared(in_color(frame), scan.stretch)
    if predicted is None:
        views = everywhere(image, scan)
    else:
        views = _windows(image, predicted * [*scan.stretch, scan.stretch.max()], scan)
    if not views:
        return None
    patches = np.concatenate([view.patches for view in views])
    if predicted is None:
        scan.noise = {}
    else:
        scan.glare = 0.0
    maxima = one_per_plane(candidates(views, patches, scan), image.shape, scan.config)
    found = measured(views, patches, maxima, image.shape, scan.config)
    if frame.encoding.startswith("bayer"):
        _widen_sparse(found, scan.config.mosaic_px)
    best = one_per_light(found, image.shape, scan.config)
    area = float(image.shape[0] * image.shape[1]) if predicted is None else _searched(views[0])
    return _described(views, patches, best, area)


def _none(frame: Frame, scan: Scan) -> Detections:
    nothing = np.empty(0)
    uv, cov = np.empty((0, 2)), np.empty((0, 2, 2))
    return Detections(
        frame.name,
        frame.t_ns,
        uv,
        radius_px=nothing,
        flux=nothing,
        p_light=nothing,
        p_rear=nothing,
        cov_px2=cov,
        attitude=frame.attitude,
        exposure_factor=exposure.factor(nothing, scan.glare, linear=True),
    )


def _squared(image: Image, stretch: Array) -> Image:
    """The picture with pixels as wide as they are high."""
    if (stretch == 1.0).all():
        return image
    height, width = image.shape[:2]
    size = (round(width * stretch[0]), round(height * stretch[1]))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_LINEAR))


def everywhere(image: Image, scan: Scan) -> list[Canvas]:
    """The live tiles at fine levels, and all of the frame at coarse ones."""
    config, (height, width) = scan.config, image.shape[:2]
    whole = np.array([[0, 0, width, height]], np.int64)
    margin = config.margin_px
    if min(height, width) < 2 * live.TILE_PX:
        return [canvas(image, 0, whole, margin, (0, _COARSE))]
    pyramid = live.halvings(image, _COARSE)
    scan.saturated = _saturation(pyramid[1])
    scan.glare = float((pyramid[_COARSE] >= scan.saturated * _full_scale(image) / 255.0).mean())
    if height * width <= config.full_area_px:
        cores = whole
    else:
        cores = live.cores(image, pyramid[1], config.live_sigmas, config.live_clear, config.live_least)
    top = max(_COARSE, int(math.log2(max(min(height, width) / 12.0, 1.0))))
    coarse = canvas(pyramid[_COARSE - 1], _COARSE - 1, whole, margin, (_COARSE - 1, top))._replace(first=_COARSE)
    if not len(cores):
        return [coarse]
    area = float(((cores[:, 2:] - cores[:, :2]) + 2 * margin).prod(axis=1).sum())
    if area > height * width:
        cores, area = whole, float(height * width)
    base = _base(area, config.full_area_px)
    if cores is whole:
        return [coarse, canvas(image, 0, cores, margin, (base, _COARSE - 1))]
    squares = _squares(height, width)
    return [coarse, canvas(image, 0, np.concatenate([cores, squares]), margin, (base, _COARSE - 1), len(squares))]


def _squares(height: int, width: int) -> Indices:
    """Boxes (N, 4) u0, v0, u1, v1 px, spread evenly over a frame: live tiles are full of lamps and tell no noise."""
    columns, rows = _SQUARES
    v, u = np.meshgrid(np.arange(rows) + 0.5, np.arange(columns) + 0.5, indexing="ij")
    low = np.column_stack([u.ravel() * width / columns, v.ravel() * height / rows]).astype(np.int64) - _SQUARE_PX // 2
    return np.concatenate([low, low + _SQUARE_PX], axis=1)


def _full_scale(image: Image) -> float:
    return float(np.iinfo(image.dtype).max)


def _base(area: float, most: float) -> int:
    """The level at which an area has no more than so many pixels."""
    return min(max(math.ceil(0.5 * math.log2(max(area / most, 1.0))), 0), _COARSE - 1)


def _saturation(half: Image) -> float:
    """The grey level, of 255, from which on samples are saturated: about 235 in video of limited range.

    The highest step of the histogram that holds far more pixels than the next one is saturated. At the peak of a light
    that is not saturated, successive steps hold about as many.
    """
    scale = 1.0 if half.dtype == np.uint8 else 255.0 / 65535.0
    top = scale * float(half.max())
    if not _LEAST_TOP <= top < SATURATED:
        return SATURATED
    first, second = (int((half >= (top - k * _STEP) / scale).sum()) for k in (1, 2))
    return top - 2.0 * _STEP if first >= max(_PLATEAU, _FLATTER * (second - first)) else SATURATED


def _windows(image: Image, predicted: Array, scan: Scan) -> list[Canvas]:
    """Windows around predicted lights, with room for lights of the size that there were."""
    config, size_px, (height, width) = scan.config, scan.size_px, image.shape[:2]
    margin = max(config.margin_px, int(config.window_sizes * size_px))
    top = max(_COARSE - 1, math.ceil(math.log2(max(size_px, 1.0))))
    low = np.floor(predicted[:, :2] - predicted[:, 2:]).astype(np.int64)
    high = np.ceil(predicted[:, :2] + predicted[:, 2:]).astype(np.int64) + 1
    cores = np.column_stack([np.maximum(low, 0), np.minimum(high, (width, height))])
    cores = cores[(cores[:, 2:] > cores[:, :2]).all(axis=1)]
    if not len(cores):
        return []
    area = float(((cores[:, 2:] - cores[:, :2]) + 2 * margin).prod(axis=1).sum())
    base = min(_base(area, config.window_area_px), top)
    return [canvas(image, 0, cores, margin, (base, max(top, base)))]


def _blur(image: Array, sigma: float) -> Array:
    taps = 2 * math.ceil(_TAPS * sigma) + 1
    out = cv2.GaussianBlur(image, (taps, taps), sigma, borderType=cv2.BORDER_REFLECT)
    return np.asarray(out.reshape(image.shape))


def candidates(views: list[Canvas], patches: Indices, scan: Scan) -> Array:
    """Maxima (N, columns of `blobs`) over all planes, scales and levels."""
    config = scan.config
    found, count, first = np.empty((config.max_blobs, blobs.COLUMNS)), 0, 0
    for view in views:
        last = first + len(view.patches)
        where = _sampled(view)
        for k, image in reversed(list(enumerate(view.levels))):  # if room runs out, it is fine texture that is left out
            level = view.base + k
            if level < view.first:
                continue
            places = where[0] >> level, where[1] >> level
            response = np.empty((*image.shape[:2], 4 if image.shape[2] == 3 else 1), np.float32)
            fine = _blur(image, _SCALES[0])
            for scale, (a, b) in enumerate(pairwise(_SCALES.tolist())):
                wide = _blur(fine, math.sqrt(b * b - a * a))
                blobs.differences(fine, wide, response)
                noise = _noise(response[places], _ROUNDING / a)
                noise = scan.noise.setdefault((level, scale), noise).clip(max=noise)
                least = config.min_snr * noise
                count = blobs.maxima(
                    response,
                    least,
                    noise,
                    roundness=config.roundness,
                    clear=config.clear,
                    level=level,
                    scale=a,
                    patches=patches,
                    first=first,
                    last=last - view.unsearched,
                    found=found,
                    count=count,
                )
                fine = wide
        first = last
    return found[:count]


def one_per_plane(rows: Array, shape: tuple[int, ...], config: DetectConfig) -> Array:
    """Those of the maxima that stand for themselves in their own plane, the strongest first."""
    order = np.argsort(-rows[:, blobs.HEIGHT], kind="stable")
    kept = np.ones(len(rows))
    edge, limits = _edge(rows, shape).min(axis=1), (config.reach, config.wide, config.texture)
    groups.strongest(rows, edge, order, *limits, kept)
    return np.asarray(rows[order[kept[order] > 0.0]])


def _noise(sampled: Array, least: float) -> Array:
    """Standard deviation (P,) of responses (N, P), most of which are noise."""
    away = np.sort(np.abs(sampled.T), axis=1)
    return np.asarray(np.maximum(_SIGMA * away[:, away.shape[1] // 2], least), np.float64)


def _sampled(view: Canvas) -> tuple[Indices, Indices]:
    """Rows and columns of the canvas px where noise is measured, spread evenly over patches."""
    measured = view.patches[-view.unsearched :] if view.unsearched else view.patches
    low = measured[:, [blobs.CORE_LEFT, blobs.CORE_TOP]]
    size = measured[:, [blobs.CORE_RIGHT, blobs.CORE_BOTTOM]] - low
    if not view.unsearched:
        low, size = measured[:, :2], measured[:, 2:4] - measured[:, :2]
    area = size.prod(axis=1)
    ends = np.cumsum(area)
    at = np.linspace(0, ends[-1] - 1, _SAMPLES).astype(np.int64)
    k = np.searchsorted(ends, at, side="right")
    inside = at - (ends[k] - area[k])
    return low[k, 1] + inside // size[k, 0], low[k, 0] + inside % size[k, 0]


def _edge(rows: Array, shape: tuple[int, ...]) -> Array:
    """Distances (N, 2) px of blobs from the border in u and v."""
    at = rows[:, [blobs.U, blobs.V]] + 0.5
    return np.asarray(np.minimum(at, (shape[1], shape[0]) - at))


def measured(views: list[Canvas], patches: Indices, rows: Array, shape: tuple[int, ...], config: DetectConfig) -> Blobs:
    """Their centroids and covariances; without those that are no maxima of the continuous filter."""
    rows = _finer(views, rows)
    out = np.zeros((len(rows), centroid.MEASURES))
    for view, mine in _by_view(views, rows):
        part, its = rows[mine], out[mine]
        for k, image in enumerate(view.levels):
            centroid.centroids(image, patches, view.base + k, part, its)
        out[mine] = its
    holds = (out[:, centroid.M_OK] == 1.0) & (out[:, centroid.M_HEIGHT] > config.clear * rows[:, blobs.NOISE])
    rows, out = rows[holds], out[holds]
    pixel = 2.0 ** rows[:, blobs.LEVEL]
    patch = patches[rows[:, blobs.PATCH].astype(np.int64)]
    at = (out[:, [centroid.M_X, centroid.M_Y]] + 0.5) * pixel[:, None] - 0.5
    rows[:, [blobs.U, blobs.V]] = at - patch[:, :2] + patch[:, 4:6]
    rows[:, blobs.HEIGHT] = out[:, centroid.M_HEIGHT]
    cov = _covariance(rows, out, pixel, config)
    near = np.maximum(_BORDER * rows[:, [blobs.SIZE]] - _edge(rows, shape), 0.0)  # mirrored samples draw it there
    for axis in range(2):
        cov[:, axis, axis] += (config.border_share * near[:, axis]) ** 2
    return Blobs(rows, cov, out)


def _by_view(views: list[Canvas], rows: Array) -> Iterator[tuple[Canvas, NDArray[np.bool_]]]:
    """Each view with a mask (N,) of the blobs that lie on it."""
    first = 0
    for view in views:
        last = first + len(view.patches)
        yield view, (rows[:, blobs.PATCH] >= first) & (rows[:, blobs.PATCH] < last)
        first = last


def _widen_sparse(found: Blobs, mosaic_px: float) -> None:
    """Add to the covariance of small blobs in blue and red of a mosaic, of which every fourth pixel is a sample."""
    size, plane = found.rows[:, blobs.SIZE], found.rows[:, blobs.PLANE]
    sparse = np.where((plane == 0.0) | (plane == 2.0), mosaic_px**2 * np.exp(-0.5 * size**2), 0.0)
    found.cov[:] += sparse[:, None, None] * np.eye(2)


def _finer(views: list[Canvas], rows: Array) -> Array:
    """The same blobs on the next finer level where there is one: its samples are dense enough for a Newton step."""
    ends = np.cumsum([len(view.patches) for view in views])
    bases = np.array([view.base for view in views])
    base = bases[np.searchsorted(ends, rows[:, blobs.PATCH], side="right")]
    finer = rows[:, blobs.LEVEL] > base
    rows = rows.copy()
    rows[finer, blobs.LEVEL] -= 1.0
    rows[finer, blobs.SCALE] *= 2.0
    rows[finer, blobs.X] = 2.0 * rows[finer, blobs.X] + 0.5
    rows[finer, blobs.Y] = 2.0 * rows[finer, blobs.Y] + 0.5
    return rows


def _covariance(rows: Array, out: Array, pixel: Array, config: DetectConfig) -> Array:
    """(N, 2, 2) px^2: noise and texture, the shift of the maximum between scales, and a share of the size."""
    xx, xy, yy = out[:, centroid.M_XX], out[:, centroid.M_XY], out[:, centroid.M_YY]
    noise = rows[:, blobs.NOISE] ** 2 + (config.texture_share * rows[:, blobs.TEXTURE]) ** 2
    cov = np.stack([xx, xy, xy, yy], axis=1).reshape(-1, 2, 2) * noise[:, None, None]
    lost = (2.0 - out[:, centroid.M_SHIFTS]) * rows[:, blobs.SCALE] ** 2
    for axis, shift in enumerate((centroid.M_SHIFT_X, centroid.M_SHIFT_Y)):
        cov[:, axis, axis] += config.spread**2 * (out[:, shift] + config.lost * lost)
    cov *= (pixel**2)[:, None, None]
    rest = (config.size_share * rows[:, blobs.SIZE]) ** 2 + _TINY
    return np.asarray(cov + rest[:, None, None] * np.eye(2))


def one_per_light(found: Blobs, shape: tuple[int, ...], config: DetectConfig) -> Blobs:
    """The blob that stands for each light, the strongest first."""
    rows = found.rows
    order = np.argsort(-rows[:, blobs.HEIGHT], kind="stable")
    var = 0.5 * (found.cov[:, 0, 0] + found.cov[:, 1, 1]) + (config.compact * rows[:, blobs.SIZE]) ** 2
    best, partner = np.empty(len(rows) + 1, np.int64), np.empty((len(rows) + 1, 4), np.int64)
    edge = _edge(rows, shape).min(axis=1)
    count = groups.group(rows, edge, var, order, share=config.share, reach=config.reach, best=best, partner=partner)
    best, partner = best[: min(count, config.max_lights)], partner[: min(count, config.max_lights)]
    uv, cov = _fused(found, best, partner, config)
    rows = rows[best]
    rows[:, [blobs.U, blobs.V]] = uv
    return Blobs(rows, cov, found.measured[best])


def _fused(found: Blobs, best: Indices, partner: Indices, config: DetectConfig) -> tuple[Array, Array]:
    """Centroids (n, 2) and covariances of lights: of the best blob, or of all planes that show the same core.

    The estimates of blue, green and red are weighted by their inverse covariances where they agree with the best one.
    """
    uv, cov = found.rows[best][:, [blobs.U, blobs.V]], found.cov[best]
    total, weighted = np.zeros_like(cov), np.zeros_like(uv)
    for p in range(3):
        k = partner[:, p]
        at, its = found.rows[k][:, [blobs.U, blobs.V]], found.cov[k]
        away = at - uv
        agrees = np.einsum("ni,nij,nj->n", away, np.linalg.inv(cov + its), away) < config.agree
        weight = np.where(((k >= 0) & agrees)[:, None, None], np.linalg.inv(its), 0.0)
        total += weight
        weighted += np.einsum("nij,nj->ni", weight, away)
    known = np.linalg.det(total) > 0.0
    total[~known] = np.linalg.inv(cov[~known])
    fused = np.linalg.inv(total)
    better = known & (np.trace(fused, axis1=1, axis2=2) < np.trace(cov, axis1=1, axis2=2))
    uv[better] += np.einsum("nij,nj->ni", fused, weighted)[better]
    cov[better] = fused[better]
    return uv, cov + config.floor_px**2 * np.eye(2)


def _searched(view: Canvas) -> float:
    """Area of the cores of patches, px^2."""
    low, high = [blobs.CORE_LEFT, blobs.CORE_TOP], [blobs.CORE_RIGHT, blobs.CORE_BOTTOM]
    return float((view.patches[:, high] - view.patches[:, low]).prod(axis=1).sum())


def _described(views: list[Canvas], patches: Indices, best: Blobs, area_px2: float) -> Seen:
    """The same with the rings around them."""
    planes = 4 if views[0].levels[0].shape[2] == 3 else 1
    rings = np.zeros((len(best.rows), 3, planes, profiles.RINGS))
    xy = np.ascontiguousarray(best.measured[:, [centroid.M_X, centroid.M_Y]])
    for view, mine in _by_view(views, best.rows):
        part, its_rings = best.rows[mine], rings[mine]
        for k, image in enumerate(view.levels):
            profiles.rings(image, patches, view.base + k, part, xy[mine], its_rings)
        rings[mine] = its_rings
    return Seen(best.rows, best.cov, best.measured, rings, np.full(len(rings), area_px2))


def _detections(frame: Frame, found: Seen, scan: Scan) -> Detections:
    """What is said of them, in pixels of the frame as it came."""
    p_light, radius_px, flux = lamp.likelihood(found), *lamp.radius_and_flux(found)
    asked = _exposure_factor(frame, found, p_light, scan)
    shown = p_light >= scan.config.min_p_light
    p_light, radius_px, flux = p_light[shown], radius_px[shown], flux[shown]
    found = Seen(*(part[shown] for part in found))
    lamps = found.rows[p_light > 0.5, blobs.SIZE]
    scan.size_px = float(lamps.max(initial=0.0))
    high, wide = frame.image.shape[:2]
    uv = (found.rows[:, [blobs.U, blobs.V]] + 0.5) / scan.stretch - 0.5
    uv = np.clip(uv, -0.5, (wide - 0.5, high - 0.5))
    cov = found.cov / (scan.stretch[:, None] * scan.stretch[None, :])
    area = scan.stretch.prod()
    unknown = np.full(len(uv), np.nan)
    radius_px, flux = radius_px / np.sqrt(area), flux / area
    return Detections(
        frame.name,
        frame.t_ns,
        uv,
        radius_px=radius_px,
        flux=flux,
        p_light=p_light,
        p_rear=unknown,
        cov_px2=cov,
        attitude=frame.attitude,
        exposure_factor=asked,
    )


def _exposure_factor(frame: Frame, found: Seen, p_light: Array, scan: Scan) -> float:
    """What the cores of the lamps, each in its own plane, say of the exposure."""
    lamps = np.flatnonzero(p_light > 0.5)
    cores = found.rings[lamps, profiles.MEAN, found.rows[lamps, blobs.PLANE].astype(np.int64), 0]
    linear = frame.encoding.startswith("bayer") or frame.image.dtype == np.uint16
    return exposure.factor(cores / scan.saturated, scan.glare, linear=linear)
