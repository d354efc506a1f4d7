"""The lights in a frame: centres with their covariance, radii, fluxes, and how much each looks like a lamp.

The whole frame is touched once, for the largest value of every 8 x 8 tile. Tiles that stand out of their surroundings
are looked at in a window of their own. Mono, BGR and raw Bayer of 8 or 16 bits are taken as they come.

The centre of a small light is the maximum-likelihood position of a round Gaussian on each colour's own samples:
nothing is more precise on a spot of a few pixels, and it knows of the mosaic. Of a larger one, or one that is
saturated, it is the balance of what stands over the level at which the spot is round and alone, which asks of the
profile only that it is symmetric. Either comes with the covariance that the noise around the spot gives it, and what
remains without noise.

How much a spot looks like a lamp follows from its contrast, shape, size and blur, from what stands around it, and from
whether it was there, as bright, in the frame before: snow and the images in a moving surface hardly ever are.
"""

from __future__ import annotations

import numpy as np

from lumidock._kernels.detection import detect as kernels
from lumidock._kernels.detection import fields, patch, tiles
from lumidock._kernels.detection.samples import picture
from lumidock._kernels.detection.saturation import SATURATED
from lumidock.config import DetectConfig
from lumidock.datatypes import Array, Detections, Frame

_TWELVE_BITS = 16.0  # steps of a sensor of 12 bits in 16
SWEEP = kernels.SWEEP
_LEAST_SIDE = 4  # pixels; in less nothing stands out
_NOWHERE = np.empty((0, 3))


class Scan:
    """What is known of a camera's tiles: scratch and, between frames, the memory of a tracked search."""

    def __init__(self, frame: Frame, config: DetectConfig) -> None:
        """Make room for frames like this one."""
        height, width = frame.image.shape[:2]
        dtype = frame.image.dtype
        h, w = -(-height // tiles.TILE_PX), -(-width // tiles.TILE_PX)
        hb, wb = -(-h // tiles.BLOCK), -(-w // tiles.BLOCK)
        self.like = (frame.image.shape, dtype, frame.encoding)
        shown = picture(frame)
        planes, channels = shown.planes, 3 if shown.planes == 3 else 1
        maps = 1 if planes == 1 else 3
        self.known = tiles.Map(
            peak=np.zeros((maps, h, w), np.uint16),
            raw_level=np.zeros((maps, hb, wb), np.uint16),
            raw_sigma=np.zeros((hb, wb), np.float32),
            by_plane=np.zeros((2, maps, hb, -(-wb // tiles.SPARSE)), np.float32),
            level=np.zeros((maps, hb, wb), np.float32),
            sigma=np.zeros((hb, wb), np.float32),
            spread=np.ones(maps),
            shared=np.ones(4),
            line=np.empty((3, w * tiles.TILE_PX * channels * shown.deep), np.uint8),
            difference=np.empty((2, w * tiles.TILE_PX * channels), np.int32),
            middle=np.empty((tiles.BLOCK + 1, w), np.uint16),
            ordered=np.empty(hb * wb + 4, np.float32),
            top=np.zeros(tiles.TOPS, np.int32),
            least=np.empty((2, w), np.int32),
            worth=np.empty(w * tiles.TILE_PX, np.uint8),
            seen=np.zeros((h, w), np.uint8),
            found=np.empty((h * w, 5)),
            queue=np.empty((2, h * w)),
        )
        self.close = patch.close_up()
        least_noise = config.min_noise * (1.0 if dtype == np.uint8 else _TWELVE_BITS * shown.scale)
        self.q = _parameters(config, max(height, width), least_noise, planes == 4 or dtype != np.uint8)
        self.most = (config.max_candidates, config.max_measured)
        self.spots, self.count = np.empty((config.max_detections, fields.COLUMNS)), 0
        self.rects = np.empty((config.max_detections + 1, 4), np.int64)
        self.past = np.empty((config.max_detections, fields.FLUX + 1))
        self.part = -1  # of SWEEP, whose turn it is; nothing was seen yet
        self.t_ns: int | None = None
        self.saw_all = False

    def fits(self, frame: Frame) -> bool:
        """Whether a frame is like those that this was made for."""
        return self.like == (frame.image.shape, frame.image.dtype, frame.encoding)

    @property
    def saturated(self) -> float:
        """The grey level, of 255, from which on samples are saturated in the frames that were seen."""
        return float(self.q[fields.CLIPPED])

    def forget(self) -> None:
        """Drop what the frame before says of which spots are steady."""
        self.t_ns = None

    def since(self, t_ns: int, config: DetectConfig) -> tuple[float, bool]:
        """How far, px, a lamp may have moved since the frame before, 0 if that is too long ago; whether it saw all."""
        dt_s = (t_ns - self.t_ns) * 1e-9 if self.t_ns is not None else 0.0
        return (config.drift_px_s * dt_s if 0.0 < dt_s <= config.memory_s else 0.0), self.saw_all


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
    q[fields.GLINT_TRUST], q[fields.CLIPPED], q[fields.MIN_NOISE] = config.glint_trust, SATURATED, least_noise
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
    if expected is None:
        scan.part, expected = -1, _NOWHERE
    if len(scan.rects) <= len(expected) + scan.count:
        scan.rects = np.empty((len(expected) + len(scan.spots) + 1, 4), np.int64)
    scan.count, whole = kernels.see(
        picture(frame),
        scan.known,
        scan.close,
        scan.part,
        expected,
        scan.count,
        scan.since(frame.t_ns, config),
        scan.most,
        scan.q,
        scan.rects,
        scan.past,
        scan.spots,
    )
    scan.t_ns, scan.saw_all, scan.part = frame.t_ns, whole, 0 if whole else (scan.part + 1) % SWEEP
    return _detections(frame, scan.spots[: scan.count])


def _detections(frame: Frame, spots: Array) -> Detections:
    columns = spots.T.copy()
    return Detections(
        frame.name,
        frame.t_ns,
        spots[:, : fields.V + 1].copy(),
        columns[fields.RADIUS],
        columns[fields.FLUX],
        columns[fields.P_LIGHT],
        np.full(len(spots), np.nan),
        spots[:, fields.VAR_UU : fields.VAR_VV + 1].copy().reshape(-1, 2, 2),
        frame.attitude,
    )
