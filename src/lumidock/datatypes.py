"""Everything that flows between the stages: frozen structs of arrays, shapes checked on creation."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from lumidock.errors import DataError

Array = NDArray[np.floating[Any]]
Image = NDArray[Any]  # uint8 or uint16
Indices = NDArray[np.int64]

Status = Literal["none", "acquired", "tracking", "coasting"]
Stage = Literal["search", "front", "transition", "rear"]
MOSAICS = ("bayer_rggb", "bayer_bggr", "bayer_grbg", "bayer_gbrg")
ENCODINGS = tuple(f"{kind}{bits}" for kind in ("mono", "bgr", *MOSAICS) for bits in (8, 16))
SATURATED = 250.0  # of 255, in a picture that uses them all: from this grey level on samples tell no more light
MatchSource = Literal["pso", "btekf"]
SensorKind = Literal["gyro", "velocity", "depth", "tilt", "attitude"]
SensorState = Literal["used", "proving", "silent", "declined"]
SENSOR_VALUES: dict[SensorKind, int] = {"gyro": 3, "velocity": 3, "depth": 1, "tilt": 3, "attitude": 4}
"""How many numbers a measurement of each kind has."""


def require_shape(name: str, array: np.ndarray, *shape: int | None) -> None:
    """Check an array's shape; `None` stands for any length.

    Raises: DataError that states the array and both shapes.
    """
    have = getattr(array, "shape", None)
    if have == shape:
        return
    if have is None:
        raise DataError(f"{name} is {_type_of(array)}, wanted an array of shape {_shape_text(shape)}")
    if len(have) != len(shape) or any(want not in (None, n) for n, want in zip(have, shape, strict=True)):
        raise DataError(f"{name} has shape {have}, wanted {_shape_text(shape)}")


def _shape_text(shape: tuple[int | None, ...]) -> str:
    """A shape as the docstrings write it, N for any length."""
    lengths = ["N" if length is None else str(length) for length in shape]
    return f"({', '.join(lengths)}{',' * (len(shape) == 1)})"


def _type_of(value: object) -> str:
    return "None" if value is None else f"of type {type(value).__name__}"


def require_stamp(t_ns: object) -> None:
    """Raises: DataError for a stamp that is no integer of nanoseconds, such as seconds as a float."""
    if not isinstance(t_ns, int | np.integer) or isinstance(t_ns, bool):
        raise DataError(f"t_ns is {t_ns!r}, {_type_of(t_ns)}, wanted an integer of nanoseconds")


def in_seconds(t_ns: int) -> str:
    """Seconds with nine decimals, exactly."""
    whole, part = divmod(abs(t_ns), 10**9)
    return f"{'-' if t_ns < 0 else ''}{whole}.{part:09d}"


@dataclass(frozen=True, slots=True, eq=False)
class Attitude:
    """Orientation `R_dock_cam` (3, 3) by the vehicle's own compass and tilt sensors, 1-sigma error `sigma_rad`."""

    R_dock_cam: Array
    sigma_rad: float

    def __post_init__(self) -> None:
        require_shape("R_dock_cam", self.R_dock_cam, 3, 3)
        if not (np.isfinite(self.R_dock_cam).all() and 0.0 < self.sigma_rad < np.inf):
            raise DataError("an attitude needs a finite rotation and a positive sigma_rad")


@dataclass(frozen=True, slots=True)
class AidingMeasurement:
    """One value of a sensor of the vehicle, measured at `t_ns`, with its 1-sigma noise `sigma` on each number.

    `kind` and `value`: `gyro`, rotation rate (3,) rad/s; `velocity`, velocity over ground (3,) m/s, as a DVL measures
    it; `depth`, (1,) m below the surface; `tilt`, the direction upward (3,) of any length, which is what accelerometers
    measure at rest, with `sigma` in rad; `attitude`, quat_xyzw (4,) of R_dock_cam, with `sigma` in rad. Vectors are in
    the axes of the sensor, whose mount the settings `aiding` have; `sigma` is of noise that is independent from one
    value to the next, and the settings have what is not.
    """

    kind: SensorKind
    t_ns: int
    value: tuple[float, ...]
    sigma: float

    def __post_init__(self) -> None:
        require_stamp(self.t_ns)
        wanted = SENSOR_VALUES.get(self.kind)
        if wanted is None:
            raise DataError(f"kind {self.kind!r}, wanted one of {', '.join(SENSOR_VALUES)}")
        numbers = (*self.value, self.sigma)
        if len(self.value) != wanted or not all(math.isfinite(number) for number in numbers):
            raise DataError(f"{self.kind} has value {self.value}, wanted {wanted} finite numbers")
        if not self.sigma > 0.0:
            raise DataError(f"{self.kind} has sigma {self.sigma:g}, wanted a positive one")
        if self.kind in ("tilt", "attitude") and not math.hypot(*self.value) > 1e-6:
            raise DataError(f"{self.kind} has a value of no length")


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One image as the camera gives it, exposed at `t_ns`; `name` as its source calls it.

    `image` (H, W) mono or raw mosaic, or (H, W, 3) BGR, of 8 or 16 bits; 16 bits use their full scale. `encoding` as
    ROS calls it; empty for mono or BGR by shape, `bayer_rggb8`, `bayer_grbg16` and so on for a mosaic, whose letters
    are the first two pixels of the first two rows.
    """

    name: str
    t_ns: int
    image: Image
    attitude: Attitude | None = None
    encoding: str = ""

    def __post_init__(self) -> None:
        require_stamp(self.t_ns)
        if not isinstance(self.image, np.ndarray):
            why = ": was the file read?" if self.image is None else ""  # what cv2.imread gives for a missing file
            raise DataError(f"image is {_type_of(self.image)}, wanted an array (H, W) or (H, W, 3){why}")
        if self.image.dtype not in (np.uint8, np.uint16):
            raise DataError(f"image is {self.image.dtype}, wanted uint8 or uint16")
        if self.image.ndim < 2 or self.image.shape[2:] not in ((), (3,)) or not self.image.size:
            raise DataError(f"image has shape {self.image.shape}, wanted (H, W) or (H, W, 3)")
        bits = 8 * self.image.dtype.itemsize
        fitting = [f"mono{bits}", *(f"{order}{bits}" for order in MOSAICS)] if self.image.ndim == 2 else [f"bgr{bits}"]
        if self.encoding and self.encoding not in fitting:
            raise DataError(f"encoding {self.encoding!r} does not fit, wanted one of {', '.join(fitting)}")


@dataclass(frozen=True, slots=True, eq=False)
class Detections:
    """The N detections of one frame: blobs in the image that may be lights of the dock.

    `uv` (N, 2) centroids px; `radius_px` (N,) equal-area radius at half peak; `flux` (N,) grey levels summed over the
    blob; `p_light` (N,) probability of being a lamp; `p_rear` (N,) probability of belonging to the rear layer, NaN
    where nothing is known; `cov_px2` (N, 2, 2) covariance of the centroids, None where the detector gives none.
    `exposure_factor`: by what the exposure should be multiplied (`lumidock.exposure`), NaN where the detector does not
    know.
    """

    frame: str
    t_ns: int
    uv: Array
    radius_px: Array
    flux: Array
    p_light: Array
    p_rear: Array
    cov_px2: Array | None = None
    attitude: Attitude | None = None
    exposure_factor: float = math.nan

    def __post_init__(self) -> None:
        require_stamp(self.t_ns)
        require_shape("uv", self.uv, None, 2)
        if not np.isfinite(self.uv).all():
            raise DataError("uv is not finite")
        n = len(self.uv)
        require_shape("radius_px", self.radius_px, n)
        require_shape("flux", self.flux, n)
        require_shape("p_light", self.p_light, n)
        require_shape("p_rear", self.p_rear, n)
        if self.cov_px2 is not None:
            require_shape("cov_px2", self.cov_px2, n, 2, 2)

    def __len__(self) -> int:
        return len(self.uv)

    @classmethod
    def from_uv(cls, frame: str, t_ns: int, uv: Array, *, p_rear: Array | None = None) -> Self:
        """Make detections of which only the centroids `uv` (N, 2) px, and perhaps `p_rear` (N,), are known.

        Raises: DataError for another shape, a number that is not finite, or a stamp that is no integer.
        """
        try:
            centroids = np.asarray(uv, float)
        except (TypeError, ValueError):
            raise DataError("uv holds no numbers, wanted an array of shape (N, 2)") from None
        centroids = centroids.reshape(-1, 2) if centroids.shape == (0,) else centroids
        require_shape("uv", centroids, None, 2)
        n = len(centroids)
        unknown = np.full(n, np.nan)
        return cls(
            frame,
            t_ns,
            centroids,
            radius_px=unknown,
            flux=unknown,
            p_light=np.ones(n),
            p_rear=unknown if p_rear is None else p_rear,
        )


@dataclass(frozen=True, slots=True)
class Unusable:
    """A frame that could not be read; `t_ns` is None when its stamp could not either. `reason` is the fixed word."""

    frame: str
    t_ns: int | None
    reason: str
    text: str


@dataclass(frozen=True, slots=True, eq=False)
class Match:
    """Which detection is which light: `light` (N,) holds indices into the station's lights, -1 for spurious."""

    detections: Detections
    light: Indices

    def __post_init__(self) -> None:
        require_shape("light", self.light, len(self.detections))
        identified = [light for light in self.light.tolist() if light >= 0]
        if len(set(identified)) != len(identified):
            raise DataError("two detections are assigned to the same light")


@dataclass(frozen=True, slots=True, eq=False)
class LayerPose:
    """The pose `T_dock_cam` (4, 4) that one layer alone gave in one frame; `source` is the step that matched it."""

    layer: str
    T_dock_cam: Array
    n_used: int
    source: MatchSource


@dataclass(frozen=True, slots=True)
class Protection:
    """Protection levels of a pose: its error exceeds each of them at most once in a million frames.

    `lateral_m` bounds hypot(ex, ey), `axial_m` |ez|, `angle_rad` the total rotation error.
    """

    lateral_m: float
    axial_m: float
    angle_rad: float


@dataclass(frozen=True, slots=True)
class Guide:
    """Bearings atan2(x, z) and atan2(y, z) and distance of the dock's origin in `cam`, with their protection levels."""

    bearing_x_rad: float
    bearing_y_rad: float
    range_m: float
    pl_bearing_rad: float
    pl_range_m: float


@dataclass(frozen=True, slots=True)
class Contradiction:
    """What the lights say against a file, in one sentence `text`; `file` is the reason of the fix.

    `subject`: the id of the light, the layer, or the parameter of the camera that is off.
    """

    file: Literal["calibration", "survey"]
    subject: str
    text: str


@dataclass(frozen=True, slots=True, eq=False)
class Velocity:
    """The motion of `cam` in `dock`, in the axes of `cam`: `linear_m_s` (3,) and `angular_rad_s` (3,).

    `covariance` (6, 6) of both, in this order. No protection level bounds it.
    """

    linear_m_s: Array
    angular_rad_s: Array
    covariance: Array

    @property
    def sigma(self) -> Array:
        """1-sigma errors (6,): m/s, then rad/s."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance)))


@dataclass(frozen=True, slots=True)
class SensorUse:
    """What the filter does with one of the vehicle's sensors.

    `state`: `used`; `proving`: used too, while the protection levels still allow for its lying; `silent`: it has given
    no value lately; `declined`: left out, for the `reason` bias (it contradicts its declared errors), noise (its noise
    is larger than declared) or jumps (value after value is far from what the filter expects).
    """

    kind: SensorKind
    state: SensorState
    reason: str = ""

    def __str__(self) -> str:
        """As fixes.csv has it."""
        return f"{self.kind}={self.state}" + (f":{self.reason}" if self.reason else "")


@dataclass(frozen=True, slots=True)
class Excess:
    """The protection level that is over its alert limit, of several the one by the larger factor.

    `of`: lateral and axial in m, angle in rad.
    """

    of: Literal["lateral", "axial", "angle"]
    level: float
    limit: float

    @property
    def factor(self) -> float:
        """Level over limit."""
        return self.level / self.limit


@dataclass(frozen=True, slots=True, eq=False)
class Alternative:
    """A pose `T_dock_cam` (4, 4) that fits where none is proven, with its `probability` among those that fit."""

    probability: float
    T_dock_cam: Array


@dataclass(frozen=True, slots=True, eq=False)
class Fix:
    """The answer for one frame: `T_dock_cam` (4, 4) when `valid`, otherwise no pose and a `reason`.

    `covariance` (6, 6) of [t_est - t_true, w], R_est = Exp(w) R_true, in dock axes, and `protection` come with a pose
    from a method that knows them. `guide` is there when bearing and range may be used. `nis` is the normalised
    innovation squared of a tracked frame over its degrees of freedom, 1 on average where noise is as stated; NaN
    without history. `n_seen` counts the frame's detections and `n_used` those behind the pose; `by_layer` holds what
    each layer's lights give alone, where a method works by layer. `alternatives`: the poses that fit while none is
    proven, the likeliest first; never a fix. `contradiction`: what is wrong with which file, where that is the reason;
    `excess`: which level is too large, where the reason is `protection`.
    `velocity` comes with a pose or a guide from a method that knows it; `aiding` says what became of each sensor that
    has given values.
    """

    frame: str
    t_ns: int
    status: Status
    stage: Stage
    n_seen: int = 0
    n_used: int = 0
    T_dock_cam: Array | None = None
    reason: str = ""
    match: Match | None = None
    by_layer: tuple[LayerPose, ...] = field(default=())
    covariance: Array | None = None
    protection: Protection | None = None
    guide: Guide | None = None
    nis: float = math.nan
    alternatives: tuple[Alternative, ...] = ()
    contradiction: Contradiction | None = None
    excess: Excess | None = None
    velocity: Velocity | None = None
    aiding: tuple[SensorUse, ...] = ()

    def __post_init__(self) -> None:
        if (self.T_dock_cam is None) != bool(self.reason):
            raise DataError("a fix holds either a pose or the reason why there is none")
        if self.T_dock_cam is None:
            if self.covariance is not None or self.protection is not None:
                raise DataError("without a pose there is neither a covariance nor a protection level")
            return
        require_shape("T_dock_cam", self.T_dock_cam, 4, 4)
        if self.covariance is not None:
            require_shape("covariance", self.covariance, 6, 6)
        if not np.isfinite(self.T_dock_cam).all():
            raise DataError("T_dock_cam is not finite")

    @property
    def valid(self) -> bool:
        """Whether the full pose may be used."""
        return self.T_dock_cam is not None

    @property
    def exposure_factor(self) -> float:
        """By what exposure times gain should be multiplied: 1 right, below 1 too bright; NaN where it is not known."""
        return math.nan if self.match is None else self.match.detections.exposure_factor
