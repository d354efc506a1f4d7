"""The lights in a frame: centres with their covariance, radii, fluxes, and how much each looks like a lamp.

The whole frame is touched once, for the largest value of every 8 x 8 tile. Tiles that stand out of their surroundings
are looked at in a window of their own. Mono, BGR and raw Bayer of 8 or 16 bits are taken as they come.

The centre of a small light is the maximum-likelihood position of a round Gaussian on each colour's own samples:
nothing is more precise on a spot of a few pixels, and it knows of the mosaic. Of a larger one, or one that is
saturated, it is the balance of what stands over the level at which the spot is round and alone, which asks of the
profile only that it is symmetric. Either comes with the covariance that the noise around the spot gives it, and what
remains without noise.
"""

from __future__ import annotations

import numpy as np

from lumidock._kernels import detect as kernels
from lumidock._kernels import fields, tiles
from lumidock.config import DetectConfig
from lumidock.datatypes import Array, Detections, Frame, Indices

_SATURATED = 250.0  # of 255
_SIXTEEN = 255.0 / 65535.0  # 8-bit levels of a 16-bit step
_TWELVE_BITS = 16.0  # steps of a sensor of 12 bits in 16
SWEEP = 8  # frames in which a tracked search has seen everything
_DRIFT_PX = 20.0  # around a spot, in which it is looked for in the next frame
_MOST_WINDOWS = 0.25  # of the frame; for more a full search is cheaper
_LEAST_SIDE = 4  # pixels; in less nothing stands out
_MOST_SHARED = 6.0  # more is a texture


class Scan:
    """What is known of a camera's tiles: scratch and, between frames, the memory of a tracked search."""

    def __init__(self, frame: Frame, config: DetectConfig) -> None:
        """Make room for frames like this one."""
        height, width = frame.image.shape[:2]
        dtype = frame.image.dtype
        h, w = -(-height // tiles.TILE_PX), -(-width // tiles.TILE_PX)
        hb, wb = -(-h // tiles.BLOCK), -(-w // tiles.BLOCK)
        self.like = (frame.image.shape, dtype, frame.encoding)
        self.channels = 3 if frame.image.ndim == 3 else 1
        self.planes = 4 if frame.encoding.startswith("bayer") else self.channels
        self.scale = 1.0 if dtype == np.uint8 else _SIXTEEN
        maps = 1 if self.planes == 1 else 3
        self.peak = np.zeros((maps, h, w), dtype)
        self.line = np.empty((2, (width + 2 * tiles.TILE_PX) * self.channels), dtype)
        self.raw_level, self.level = np.zeros((maps, hb, wb), dtype), np.zeros((maps, hb, wb), np.float32)
        self.raw_sigma, self.sigma = np.zeros((hb, wb), np.float32), np.zeros((hb, wb), np.float32)
        self.by_plane = np.zeros((2, maps, hb, -(-wb // tiles.SPARSE)), np.float32)
        self.spread = np.ones(maps)
        self.seen = np.zeros((h, w), np.uint8)
        self.found = np.empty((h * w, 5))
        self.spots = np.empty((config.max_spots, fields.COLUMNS))
        self.whole = np.array([[0, h, 0, w]])
        self.shared = np.ones(4)
        self.least_noise = config.min_noise * (1.0 if dtype == np.uint8 else _TWELVE_BITS * _SIXTEEN)
        self.q = _parameters(config, max(height, width), self.least_noise, self.planes == 4 or dtype != np.uint8)
        self.swept, self.part = False, 0
        self.last = np.empty((0, 3))

    def fits(self, frame: Frame) -> bool:
        """Whether a frame is like those that this was made for."""
        return self.like == (frame.image.shape, frame.image.dtype, frame.encoding)

    def next_part(self) -> tuple[int, int]:
        """The rows of blocks whose turn it is; after the last ones, what all of them say is brought up to date."""
        rows = len(self.sigma)
        first, last = self.part * rows // SWEEP, (self.part + 1) * rows // SWEEP
        self.part = (self.part + 1) % SWEEP
        if self.part == 0:
            _settle(self)
        return first, last

    def windows(self, expected: Array) -> Indices:
        """Tiles (n, 4) around the expected lights and the spots of the last frame, and of the part whose turn it is.

        The whole frame where windows would be a good part of it.
        """
        rows, (h, w) = len(self.sigma), self.peak.shape[1:]
        first, last = self.part * rows // SWEEP, (self.part + 1) * rows // SWEEP
        rects = np.empty((len(expected) + len(self.last) + 1, 4), np.int64)
        count = tiles.windows(expected, self.last, _DRIFT_PX, h, w, rects)
        rects[count] = first * tiles.BLOCK, min(last * tiles.BLOCK, h), 0, w
        rects = rects[: count + 1]
        return rects if tiles.area(rects) < _MOST_WINDOWS * h * w else self.whole


def _parameters(config: DetectConfig, longer_side: int, least_noise: float, linear: bool) -> Array:
    """The numbers that the kernel takes, in its order."""
    q = np.empty(fields.PARAMETERS)
    q[fields.CONTRAST], q[fields.MIN_SNR], q[fields.RING_PX] = config.contrast, config.min_snr, config.ring_px
    q[fields.MAX_RADIUS_PX] = max(config.max_radius * longer_side, 2.0 * config.ring_px)
    q[fields.MIN_RADIUS_PX], q[fields.SMALL_PX] = config.min_radius_px, config.small_px
    q[fields.MIN_ELONGATION], q[fields.MIN_FILL] = config.min_elongation, config.min_fill
    q[fields.SIGNAL_NOISE] = config.linear_noise if linear else config.signal_noise
    q[fields.FLOOR_PX], q[fields.TEXTURE] = config.floor_px, config.texture
    q[fields.SATURATED_PX], q[fields.CUT_SHARE] = config.saturated_px, config.cut
    q[fields.GLINT_RADII], q[fields.GLINT_RATIO] = config.glint_radii, config.glint_ratio
    q[fields.GLINT_TRUST], q[fields.CLIPPED], q[fields.MIN_NOISE] = config.glint_trust, _SATURATED, least_noise
    q[fields.PROMINENT], q[fields.COARSE_PX] = config.prominent, config.coarse_px
    q[fields.KIN], q[fields.LAMPS], q[fields.RANGE] = config.kin, config.lamps, config.flux_range
    return q


def lights(frame: Frame, config: DetectConfig, scan: Scan | None = None, expected: Array | None = None) -> Detections:
    """Find the lights of a frame: in all of it, or where they are expected and in the next part of the rest.

    `expected` (n, 3) u, v and reach px of the lights foretold, for a `scan` that has seen the frame before; the rest
    comes round in `SWEEP` frames. The layer is not known yet. Takes any picture; one without lights gives no
    detections.
    """
    if min(frame.image.shape[:2]) < _LEAST_SIDE:
        return _detections(frame, np.empty((0, fields.COLUMNS)))
    scan = scan if scan is not None and scan.fits(frame) else Scan(frame, config)
    rows = np.ascontiguousarray(frame.image).reshape(len(frame.image), -1)
    rects = scan.windows(expected) if expected is not None and scan.swept else scan.whole
    if rects is scan.whole:
        _look(rows, scan, (0, len(scan.sigma)))
        _settle(scan)
        scan.swept, scan.part = True, 0
    else:
        first, last = scan.next_part()
        _look(rows, scan, (first, last))
        tiles.revisit(rows, scan.planes, rects[:-1], scan.peak, scan.line)
    return _search(frame, rows, scan, rects, config)


def _look(rows: Array, scan: Scan, blocks: tuple[int, int]) -> None:
    """Bring some rows of blocks up to date."""
    tiles.survey(rows, scan.planes, blocks, scan.peak, scan.line, scan.raw_level, scan.raw_sigma, scan.by_plane)


def _settle(scan: Scan) -> None:
    """What all blocks say together."""
    most = 1.0 if scan.planes == 4 else _MOST_SHARED
    least = scan.least_noise / scan.scale
    tiles.settle(
        scan.raw_level, scan.raw_sigma, scan.by_plane, least, most, scan.level, scan.sigma, scan.spread, scan.shared
    )


def _search(frame: Frame, rows: Array, scan: Scan, rects: Indices, config: DetectConfig) -> Detections:
    image = rows.reshape(len(rows), -1, scan.channels)
    n = kernels.search(
        image,
        scan.planes,
        scan.scale,
        scan.peak,
        scan.level,
        scan.sigma,
        scan.spread,
        scan.shared,
        rects,
        (config.max_candidates, config.max_measured),
        scan.q,
        scan.seen,
        scan.found,
        scan.spots,
    )
    scan.last = scan.spots[:n, [fields.U, fields.V, fields.RADIUS]]
    return _detections(frame, scan.spots[:n])


def _detections(frame: Frame, spots: Array) -> Detections:
    return Detections(
        frame.name,
        frame.t_ns,
        spots[:, :2].copy(),
        spots[:, fields.RADIUS].copy(),
        spots[:, fields.FLUX].copy(),
        spots[:, fields.P_LIGHT].copy(),
        np.full(len(spots), np.nan),
        spots[:, [fields.VAR_UU, fields.VAR_UV, fields.VAR_UV, fields.VAR_VV]].reshape(-1, 2, 2),
        frame.attitude,
    )
