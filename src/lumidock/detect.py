"""The lights in a frame: centres with their covariance, radii, fluxes, and how much each looks like a lamp.

The whole frame is touched once, for the largest value of every 8 x 8 tile. Tiles that stand out of their surroundings are
looked at in a window of their own. Mono, BGR and raw Bayer of 8 or 16 bits are taken as they come.

The centre of a small light is the maximum-likelihood position of a round Gaussian on each colour's own samples: nothing is
more precise on a spot of a few pixels, and it knows of the mosaic. Of a larger one, or one that is saturated, it is the
balance of what stands over the level at which the spot is round and alone, which asks of the profile only that it is
symmetric. Either comes with the covariance that the noise around the spot gives it, and what remains without noise.
"""

from __future__ import annotations

import numpy as np

from lumidock._kernels import detect as kernels
from lumidock._kernels import tiles
from lumidock.config import DetectConfig
from lumidock.datatypes import Array, Detections, Frame, Indices

_PLANES = {"mono": 1, "bgr": 3, "bayer": 4}
_SATURATED = 250.0  # of 255
_SIXTEEN = 255.0 / 65535.0  # 8-bit levels of a 16-bit step
_TWELVE_BITS = 16.0  # steps of a sensor of 12 bits in 16
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
        self.spots = np.empty((config.max_spots, kernels.COLUMNS))
        self.whole = np.array([[0, h, 0, w]])
        self.shared = np.ones(4)
        self.least_noise = config.min_noise * (1.0 if dtype == np.uint8 else _TWELVE_BITS * _SIXTEEN)
        self.q = _parameters(config, max(height, width), self.least_noise)


def _parameters(config: DetectConfig, longer_side: int, least_noise: float) -> Array:
    """The numbers that the kernel takes, in its order."""
    q = np.empty(kernels.PARAMETERS)
    q[kernels.CONTRAST], q[kernels.MIN_SNR], q[kernels.RING_PX] = config.contrast, config.min_snr, config.ring_px
    q[kernels.MAX_RADIUS_PX] = max(config.max_radius * longer_side, 2.0 * config.ring_px)
    q[kernels.MIN_RADIUS_PX], q[kernels.SMALL_PX] = config.min_radius_px, config.small_px
    q[kernels.MIN_ELONGATION], q[kernels.MIN_FILL] = config.min_elongation, config.min_fill
    q[kernels.SIGNAL_NOISE], q[kernels.FLOOR_PX] = config.signal_noise, config.floor_px
    q[kernels.SATURATED_PX], q[kernels.CUT_SHARE] = config.saturated_px, config.cut
    q[kernels.GLINT_RADII], q[kernels.GLINT_RATIO] = config.glint_radii, config.glint_ratio
    q[kernels.GLINT_TRUST], q[kernels.CLIPPED], q[kernels.MIN_NOISE] = config.glint_trust, _SATURATED, least_noise
    q[kernels.PROMINENT], q[kernels.COARSE_PX] = config.prominent, config.coarse_px
    q[kernels.KIN], q[kernels.LAMPS], q[kernels.RANGE] = config.kin, config.lamps, config.flux_range
    return q


def lights(frame: Frame, config: DetectConfig, scan: Scan | None = None) -> Detections:
    """Find the lights of a frame in all of it.

    The layer is not known yet. Takes any picture; one without lights gives no detections.
    """
    if min(frame.image.shape[:2]) < _LEAST_SIDE:
        return _detections(frame, np.empty((0, kernels.COLUMNS)))
    scan = scan or Scan(frame, config)
    image = np.ascontiguousarray(frame.image)
    rows = image.reshape(len(image), -1)
    _look(rows, scan, (0, len(scan.sigma)))
    return _search(frame, rows, scan, scan.whole, config)


def _look(rows: Array, scan: Scan, blocks: tuple[int, int]) -> None:
    """Bring some rows of blocks up to date, and what goes with them."""
    tiles.survey(rows, scan.planes, blocks, scan.peak, scan.line, scan.raw_level, scan.raw_sigma, scan.by_plane)
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
    return _detections(frame, scan.spots[:n])


def _detections(frame: Frame, spots: Array) -> Detections:
    return Detections(
        frame.name,
        frame.t_ns,
        spots[:, :2].copy(),
        spots[:, kernels.RADIUS].copy(),
        spots[:, kernels.FLUX].copy(),
        spots[:, kernels.P_LIGHT].copy(),
        np.full(len(spots), np.nan),
        spots[:, [kernels.VAR_UU, kernels.VAR_UV, kernels.VAR_UV, kernels.VAR_VV]].reshape(-1, 2, 2),
        frame.attitude,
    )
