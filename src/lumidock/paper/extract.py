"""Light extraction from a frame, paper section 3.1.1.

The interval-adaptive Otsu threshold (the paper's [22]) is not specified there. Read here as: Otsu on the grey levels
above the background's mode, repeated on the levels above each result until the classes separate; first for the whole
frame, then within every region until its own light stands at half height.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice

import cv2
import numpy as np

from lumidock.config import ExtractConfig
from lumidock.datatypes import Array, Detections, Frame, Image, Indices

_FRAME_PX = 2


@dataclass(frozen=True, slots=True)
class _Blob:
    """One light found: circle centre (u, v) px, equal-area radius px, grey levels summed above the background."""

    u: float
    v: float
    radius: float
    flux: float


@dataclass(frozen=True, slots=True, eq=False)
class _Region:
    """A connected region: its window of the gray image and its mask there.

    `offset` (u, v) of the window in the whole image, whose `size` is (width, height).
    """

    gray: Image
    mask: Image
    offset: tuple[int, int]
    size: tuple[int, int]

    @property
    def cut_by_edge(self) -> bool:
        """Whether the region runs out of the picture."""
        (u, v), (height, width) = self.offset, self.mask.shape
        return u == 0 or v == 0 or u + width == self.size[0] or v + height == self.size[1]


def lights(frame: Frame, config: ExtractConfig) -> Detections:
    """Find the lights of a frame: centres, radii and fluxes; the layer is not known yet."""
    gray = to_gray(frame.image, config.gray)
    background, threshold, binary, outlines = _separated(gray, config)
    regions = _connected_regions(gray, binary, outlines)
    blobs = [blob for region in regions for blob in _blobs(region, threshold, background, config)]
    blobs = sorted((s for s in blobs if _stands_out(s, gray, config)), key=lambda s: -s.flux)[: config.max_regions]
    columns = np.array([[s.u, s.v, s.radius, s.flux] for s in blobs]).reshape(-1, 4)
    unknown = np.full(len(blobs), np.nan)
    uv, radius_px, flux = columns[:, :2].copy(), columns[:, 2].copy(), columns[:, 3].copy()
    likely = np.ones(len(blobs))
    return Detections(frame.name, frame.t_ns, uv, radius_px, flux, p_light=likely, p_rear=unknown)


def _separated(gray: Image, config: ExtractConfig) -> tuple[int, int, Image, list[Array]]:
    """Background, threshold, binarised frame and outlines at the lowest threshold that leaves few enough regions."""
    for background, threshold in islice(separating_thresholds(gray, config), config.max_thresholds):  # noqa: B007
        binary, outlines = _outlines(gray, threshold)
        if len(outlines) <= config.max_regions:
            break
    return background, threshold, binary, sorted(outlines, key=len)[-config.max_regions :]


def to_gray(image: Image, kind: str) -> Image:
    """Gray image (H, W): the largest of the three channels, or luma, which weighs blue by 0.114."""
    if image.ndim == 2:
        return image
    if kind == "luma":
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
    blue, green, red = cv2.split(image)
    return np.asarray(cv2.max(cv2.max(blue, green), red), np.uint8)


def separating_thresholds(gray: Image, config: ExtractConfig) -> Iterator[tuple[int, int]]:
    """The background's mode and thresholds that separate what is brighter, lowest first, in grey levels 0-255.

    The next one is wanted when a threshold leaves more regions than there can be lights.
    """
    histogram = np.asarray(cv2.calcHist([gray], [0], None, [256], [0, 256]), float).ravel()
    background = int(np.argmax(histogram[:255]))
    floor = background + max(config.min_step, config.contrast * _spread_below(histogram, background))
    threshold = int(np.ceil(floor))
    while threshold < 254:
        if histogram[threshold + 1 :].sum() <= config.max_foreground * gray.size:
            yield background, threshold
        above = otsu(histogram, threshold + 1)  # parts the brightest cores; dim lights lie in the interval below
        threshold = otsu(histogram[: above + 1], threshold + 1)
    yield background, 254


def _spread_below(histogram: Array, mode: int) -> float:
    """Standard deviation of the background, from the half of its histogram that no light reaches."""
    below = histogram[: mode + 1]
    steps = np.arange(mode, -1, -1.0)
    return float(np.sqrt((below * steps**2).sum() / max(float(below.sum()), 1.0)))


def otsu(histogram: Array | Indices, low: int) -> int:
    """Otsu's threshold over the grey levels from `low` up; `low` itself when only one level is left.

    Source: N. Otsu, 1979: the cut that maximises the between-class variance.
    """
    counts = np.asarray(histogram[low:], float)
    levels = np.arange(low, len(histogram))
    weight = np.cumsum(counts)
    moment = np.cumsum(counts * levels)
    total, mean = weight[-1], moment[-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        between = (mean * weight - total * moment) ** 2 / (weight * (total - weight))
    if not np.isfinite(between).any():
        return low
    return int(levels[int(np.nanargmax(np.where(np.isfinite(between), between, -1.0)))])


def _outlines(gray: Image, threshold: int) -> tuple[Image, list[Array]]:
    """The binarised frame and the outlines of its Canny edges."""
    _, binary = cv2.threshold(gray, threshold, 255, cv2.THRESH_BINARY)
    # a dark frame around the picture closes the outlines of lights that its edge cuts; dilation, the gaps Canny leaves
    framed = cv2.copyMakeBorder(binary, _FRAME_PX, _FRAME_PX, _FRAME_PX, _FRAME_PX, cv2.BORDER_CONSTANT, value=0)
    edges = cv2.dilate(cv2.Canny(framed, 100, 200), np.ones((3, 3), np.uint8))
    contours, _ = cv2.findContours(edges, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE, offset=(-_FRAME_PX, -_FRAME_PX))
    last = np.array(gray.shape[::-1]) - 1
    return np.asarray(binary, np.uint8), [np.clip(contour, 0, last) for contour in contours]


def _connected_regions(gray: Image, binary: Image, outlines: list[Array]) -> Iterator[_Region]:
    """The connected regions inside the outlines."""
    for outline in outlines:
        u, v, width, height = cv2.boundingRect(outline)
        window = np.s_[v : v + height, u : u + width]
        inside = cv2.drawContours(np.zeros((height, width), np.uint8), [outline], -1, 255, cv2.FILLED, offset=(-u, -v))
        lit = np.asarray(cv2.bitwise_and(binary[window], inside), np.uint8)
        yield from _components(gray[window], lit, (u, v), (gray.shape[1], gray.shape[0]))


def _components(gray: Image, binary: Image, offset: tuple[int, int], size: tuple[int, int]) -> Iterator[_Region]:
    """Connected components of a binary window, each in a window of its own."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(binary, connectivity=8)
    for label in range(1, count):
        u, v, width, height = (int(x) for x in stats[label, :4])
        window = np.s_[v : v + height, u : u + width]
        mask = np.asarray((labels[window] == label) * np.uint8(255))
        yield _Region(gray[window], mask, (offset[0] + u, offset[1] + v), size)


def _blobs(region: _Region, threshold: int, background: int, config: ExtractConfig) -> Iterator[_Blob]:
    """Lights in a region: cut at its own Otsu level until each part stands at half height, then opened and judged."""
    inside = region.gray[region.mask > 0]
    half = background + (int(inside.max()) - background) // 2
    higher = _next_level(inside, threshold, half, config)
    if higher > threshold:
        _, binary = cv2.threshold(cv2.bitwise_and(region.gray, region.mask), higher, 255, cv2.THRESH_BINARY)
        for part in _components(region.gray, np.asarray(binary, np.uint8), region.offset, region.size):
            yield from _blobs(part, higher, background, config)
        return
    measured = (_measure(piece, background, config) for piece in _opened(region, config))
    yield from (blob for blob in measured if blob is not None)


def _next_level(inside: Image, threshold: int, half: int, config: ExtractConfig) -> int:
    """The region's own Otsu level while under half height, or where it parts two clear classes; else the threshold."""
    higher = otsu(np.bincount(inside, minlength=256), threshold + 1)
    core = inside > higher
    if np.count_nonzero(core) < config.min_area_px:
        return threshold
    if threshold < half:
        return min(higher, half)
    rim = inside[~core]
    if not rim.size:
        return threshold
    apart = float(inside[core].mean()) - float(rim.mean())
    return higher if apart > config.class_gap * max(float(rim.std()), 1.0) else threshold


def _opened(region: _Region, config: ExtractConfig) -> Iterator[_Region]:
    """Morphological opening, part by part: what lies deeper than a share of the region's depth, grown back by as much.

    Growing the parts back one at a time keeps lights apart whose halos touch.
    """
    padded = np.pad(region.mask, 1)
    depth = cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    radius = int(config.opening * float(depth.max()))
    if radius < 1 or region.cut_by_edge:  # at the picture's edge opening would round off what the edge cut straight
        yield region
        return
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    count, parts = cv2.connectedComponents(np.asarray(depth > radius, np.uint8))
    for part in range(1, count):
        grown = cv2.bitwise_and(cv2.dilate(np.asarray(parts == part, np.uint8), kernel) * 255, region.mask)
        yield from _components(region.gray, np.asarray(grown, np.uint8), region.offset, region.size)


def _measure(piece: _Region, background: int, config: ExtractConfig) -> _Blob | None:
    """Circle, roundness and compactness of a piece; None when it is no light."""
    contours, _ = cv2.findContours(piece.mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    outline = max(contours, key=len)[:, 0, :] + np.array(piece.offset, float)
    area = float(np.count_nonzero(piece.mask))
    if area < config.min_area_px or len(outline) < 3:
        return None
    weights = np.where(piece.mask > 0, piece.gray.astype(float) - background, 0.0)
    if area < config.small_area_px:
        center, radius = _centroid(weights) + piece.offset, float(np.sqrt(area / np.pi))
    elif piece.cut_by_edge:
        center, radius, round_ = _fit_arc(outline, piece.size, config)
    else:
        center, radius = fit_circle(outline)
        round_ = _is_round(outline, area, radius, config)
    if radius > config.max_radius_px or not (area < config.small_area_px or round_):
        return None
    equal_area = radius if piece.cut_by_edge else float(np.sqrt(area / np.pi))
    return _Blob(float(center[0]), float(center[1]), equal_area, float(weights.sum()))


def _fit_arc(outline: Array, size: tuple[int, int], config: ExtractConfig) -> tuple[Array, float, bool]:
    """Circle through an outline's points (N, 2) inside the picture; whether they are an arc around a visible centre."""
    last = np.array(size) - 1.0
    arc = outline[((outline > 0) & (outline < last)).all(axis=1)]
    if len(arc) < 8:
        return np.zeros(2), 0.0, False
    center, radius = fit_circle(arc)
    off = np.hypot(*(arc - center).T) - radius
    return (
        center,
        radius,
        bool((center > 0).all() and (center < last).all() and off.std() < config.max_arc_error * radius),
    )


def _stands_out(blob: _Blob, gray: Image, config: ExtractConfig) -> bool:
    """Whether the peak of a small blob clears the noise around it; large ones were judged by their shape."""
    if np.pi * blob.radius**2 >= config.small_area_px:
        return True
    u, v, reach = round(blob.u), round(blob.v), int(1.5 * blob.radius) + 4
    window = gray[max(v - reach, 0) : v + reach + 1, max(u - reach, 0) : u + reach + 1].astype(float)
    rows, columns = np.indices(window.shape)
    distance = np.hypot(columns + max(u - reach, 0) - blob.u, rows + max(v - reach, 0) - blob.v)
    core, ring = window[distance <= max(blob.radius, 1.0)], window[distance > blob.radius + 2.0]
    noise = max(float(np.subtract(*np.percentile(ring, [75, 25]))) / 1.35, 1.0)
    return float(core.max() - np.median(ring)) > config.contrast * noise


def _centroid(weights: Array) -> Array:
    """Centroid (2,) of a blob too small for a circle, weighted by its grey levels."""
    rows, columns = np.indices(weights.shape)
    return np.asarray([(weights * columns).sum(), (weights * rows).sum()] / weights.sum())


def fit_circle(points: Array) -> tuple[Array, float]:
    """Least-squares circle through `points` (N, 2): centre (2,) and radius. Source: I. Kasa, 1976."""
    mean = points.mean(axis=0)
    x, y = (points - mean).T
    A = np.stack([2.0 * x, 2.0 * y, np.ones(len(x))], axis=1)
    (a, b, c), *_ = np.linalg.lstsq(A, x * x + y * y, rcond=None)
    return mean + np.array([a, b]), float(np.sqrt(max(c + a * a + b * b, 0.0)))


def _is_round(outline: Array, area: float, radius: float, config: ExtractConfig) -> bool:
    """The two shape measures: roundness 4 pi A / P^2 and compactness, the area against the fitted circle's."""
    perimeter = float(np.linalg.norm(outline - np.roll(outline, 1, axis=0), axis=1).sum())
    roundness = 4.0 * np.pi * area / max(perimeter, 1e-9) ** 2
    disc = np.pi * radius**2
    compactness = min(area, disc) / max(area, disc, 1e-9)
    return roundness >= config.min_roundness and compactness >= config.min_compactness
