"""The settings ("knobs") of a scenario for water, lamps, surroundings, lens, sensor and stream, as read from YAML.

Each has its unit, its range, and where known the source of its default.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
    model_validator,
)
from typing_extensions import Self

Distance = Annotated[float, Field(ge=-1000.0, le=1000.0)]
Count = Annotated[int, Field(ge=0, le=1000)]
Reach = Annotated[float, Field(ge=0.0, le=1000.0)]
Reaches = tuple[Reach, Reach, Reach]
Probability = Annotated[float, Field(ge=0.0, le=1.0)]
Angle = Annotated[float, Field(ge=0.0, le=180.0)]
Angles = tuple[Angle, Angle, Angle]
Pixels = Annotated[float, Field(ge=0.1, le=1000.0)]
Coefficient = Annotated[float, Field(ge=0.0, le=20.0)]
Coefficients = tuple[Coefficient, Coefficient, Coefficient]
Place = tuple[Distance, Distance, Distance]


def _pair(value: object) -> object:
    """Turn one number into the range whose two ends it is."""
    return value if isinstance(value, (list, tuple)) else (value, value)


def _rising(bounds: tuple[Any, Any]) -> tuple[Any, Any]:
    if bounds[0] > bounds[1]:
        raise ValueError("wanted the lower bound first")
    return bounds


# Each of these takes a number or a range [low, high]; from a range, values are drawn uniformly.
Counts = Annotated[tuple[Count, Count], BeforeValidator(_pair), AfterValidator(_rising)]
Length = Annotated[float, Field(ge=1e-6, le=1e6)]
Lengths = Annotated[tuple[Length, Length], BeforeValidator(_pair), AfterValidator(_rising)]
Size = Annotated[float, Field(ge=0.01, le=100.0)]
Sizes = Annotated[tuple[Size, Size], BeforeValidator(_pair), AfterValidator(_rising)]
Shares = Annotated[tuple[Probability, Probability], BeforeValidator(_pair), AfterValidator(_rising)]
Interval = Annotated[tuple[NonNegativeFloat, NonNegativeFloat], AfterValidator(_rising)]


class KnobSection(BaseModel):
    """A part of a scenario; unknown keys and values that are not finite are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class WaterKnobs(KnobSection):
    """The kind of water; `sim.water` and `sim.scattering` have the tables and their sources."""

    kind: Literal["pure-sea", "IB", "II", "III", "1C", "3C", "5C", "7C", "pool-clear", "pool-murky"] = (
        "III"  # Jerlov types and pools
    )
    b_factor: Annotated[float, Field(ge=0.0, le=20.0)] = 1.0  # on scattering; published values differ by factors
    phase: Literal["auto", "clear", "coastal", "harbour"] = "auto"  # Petzold's water; auto chooses by `kind`
    absorption: Coefficients | None = None  # 1/m at 455, 530, 610 nm; replaces that of `kind`
    scattering: Coefficients | None = None  # likewise
    salinity_psu: Annotated[float, Field(ge=0.0, le=45.0)] = 35.0
    temperature_c: Annotated[float, Field(ge=-2.0, le=40.0)] = 15.0


class Daylight(KnobSection):
    """Daylight from above."""

    # irradiance just below the surface in each band of 80 nm: 100 at noon with a clear sky, 20-30 overcast, 0 at night
    surface_w_m2: NonNegativeFloat = 60.0
    depth_m: NonNegativeFloat = 30.0  # of the camera when it is at the height of the dock's origin
    more: PositiveFloat = 2.0  # all light scattered sidewards over that scattered once; 1.5-3 at optical depths c z > 2


class Lamps(KnobSection):
    """The dock's own lamps."""

    window_radius_m: Annotated[float, Field(gt=0.0, le=1.0)] = 0.0175  # 15-20 mm
    layers: Literal["all", "front", "rear"] = "all"  # which layers are lit; rear is every layer but the front one
    dim: Probability = 1.0  # factor on the power of all lamps
    side_share: Probability = 0.0  # share of the power that window and housing scatter evenly into all directions
    fouling: Shares = (1.0, 1.0)  # transmission of each lamp's window, drawn once a run
    swap_colors: bool = False  # the first layer gets the colour of the last one, and so on
    pwm_hz: NonNegativeFloat = 0.0  # pulse frequency; 0 is direct current; the station's power_w holds while on
    pwm_duty: Annotated[float, Field(gt=0.0, le=1.0)] = 1.0
    failures: dict[str, NonNegativeFloat] = {}  # id of a light and when it goes dark, s


class WaterSurface(KnobSection):
    """The water surface above the dock, which reflects its lamps."""

    height_m: Annotated[float, Field(gt=0.0, le=1000.0)] = 2.0  # above the dock's origin
    slope: Annotated[float, Field(ge=0.0, le=0.5)] = (
        0.04  # rms slope of the waves; 0.03 in a pool, 0.1 at a few m/s of wind (Cox & Munk 1954)
    )
    fragments: Annotated[int, Field(ge=1, le=50)] = 5  # into which the waves break each lamp's mirror image
    period_s: PositiveFloat = 1.2  # of the waves


class Glints(KnobSection):
    """Glints: each lamp is reflected by the cage beside it."""

    share: Shares = (0.02, 0.08)  # of the lamp's intensity, drawn once a run
    offset_m: PositiveFloat = 0.06  # from the lamp, away from the axis of the dock


class Headlamp(KnobSection):
    """A lamp on the own vehicle, beside the camera."""

    power_w: PositiveFloat = 10.0  # radiant, white
    offset_m: tuple[float, float, float] = (0.35, 0.25, 0.0)  # in cam: x right, y down, z forward
    beam_deg: Annotated[float, Field(ge=10.0, le=170.0)] = 60.0  # full width at half maximum


class Snow(KnobSection):
    """Marine snow: particles that drift in front of the camera and scatter daylight and the headlamp's light."""

    per_m3: Annotated[float, Field(ge=0.0, le=200.0)] = (
        20.0  # particles over 0.5 mm; 1-100 are found (Alldredge & Silver 1988)
    )
    radius_mm: Sizes = (0.25, 1.5)  # drawn with a density of 1 / radius^3
    albedo: Probability = 0.3
    reach_m: Annotated[float, Field(gt=0.0, le=10.0)] = 3.0  # farther particles are left out
    drift_m_s: tuple[float, float, float] = (0.05, -0.01, 0.02)  # in `dock`


class OtherVehicle(KnobSection):
    """Another vehicle with lamps."""

    start: Place = (-4.0, 1.0, 6.0)  # of its middle at the start, in `dock`, m
    velocity_m_s: Place = (0.25, 0.0, 0.1)  # in `dock`
    lamps: Annotated[int, Field(ge=1, le=20)] = 3
    spacing_m: PositiveFloat = 0.4  # between its lamps, which stand side by side
    power_w: PositiveFloat = 2.0  # of each lamp
    color: Literal["white", "blue", "cyan", "green", "red"] = "white"


class Fish(KnobSection):
    """Fish: dark bodies that cross the picture and hide what is behind them."""

    count: Annotated[int, Field(ge=1, le=100)] = 3
    length_m: Sizes = (0.2, 0.5)  # of each, drawn once a run
    distance_m: Sizes = (1.5, 4.0)  # from the camera
    speed_m_s: Lengths = (0.2, 0.6)  # across the picture


class Surroundings(KnobSection):
    """What shines or hides beside the dock's lamps; by default none of it is there."""

    surface: WaterSurface | None = None
    glints: Glints | None = None
    headlamp: Headlamp | None = None
    snow: Snow | None = None
    vehicle: OtherVehicle | None = None
    fish: Fish | None = None
    hull: Probability = 0.0  # share of the picture's height that the own vehicle's nose hides, from the lower edge up


class Port(KnobSection):
    """A flat window in front of the lens, across its axis."""

    gap_m: Annotated[float, Field(ge=0.0, le=1.0)] = 0.02  # of air, from the entrance pupil to the glass
    glass_m: Annotated[float, Field(ge=0.0, le=1.0)] = 0.01  # thickness
    glass_index: Annotated[float, Field(ge=1.0, le=2.5)] = 1.50
    calibrated_at_m: Lengths = (1.5, 6.0)  # distances of the targets in water, from which camera.yaml was calibrated

    @model_validator(mode="after")
    def _targets_are_in_the_water(self) -> Self:
        if self.calibrated_at_m[0] < self.gap_m + self.glass_m + 0.1:
            raise ValueError("calibrated_at_m: has to be at least 0.1 m beyond the glass")
        return self


class LensKnobs(KnobSection):
    """Light and sharpness of the lens, by default 7.2 mm f/2.8; camera.yaml says how it projects."""

    f_number: Annotated[float, Field(ge=0.5, le=100.0)] = 2.8
    focal_m: Annotated[float, Field(ge=1e-4, le=1.0)] = 7.2e-3
    blur_px: Pixels = 0.7  # 1 sigma of the Gaussian image of a point
    falloff: Probability = 0.1  # vignetting: loss of light in the corners, beside the cosine of the angle to the axis
    glare: Probability = 0.01  # veiling glare: share of all light that the lens scatters
    glare_px: Pixels = 60.0  # radius of the glare; half of it falls within about twice this
    ghost: Probability = 1e-5  # share of the light in the ghost image, mirrored at the centre: two reflections of 0.3 %
    ghost_px: Pixels = 40.0  # radius of a point's ghost image, which is out of focus
    port: Port | None = None
    focal_error: Annotated[float, Field(gt=-0.5, lt=0.5)] = 0.0  # relative, of the true one against camera.yaml
    motion: bool = True  # whether the motion of the camera during the exposure blurs the picture


class AutoExposure(KnobSection):
    """Automatic exposure: a control loop on the mean and the brightest pixels, which acts on the next frame."""

    mean: PositiveFloat = 0.12  # target of the mean level, as a share of full scale
    bright: Annotated[float, Field(gt=0.0, le=1.0)] = 0.9  # target of the level that 0.1 % of pixels exceed
    gain: Annotated[float, Field(gt=0.0, le=1.0)] = 0.5  # of the loop, on the logarithm of the exposure
    min_ms: PositiveFloat = 0.1
    max_ms: PositiveFloat = 10.0


class Sensor(KnobSection):
    """The image sensor, by default a Sony IMX264 as measured to EMVA 1288: 3.45 um, 12 bit, global shutter."""

    exposure_ms: Annotated[float, Field(gt=0.0, le=1000.0)] = 2.0  # the first one, with auto_exposure
    auto_exposure: AutoExposure | None = None
    gain_db: Annotated[float, Field(ge=0.0, le=36.0)] = 0.0
    full_well_e: Annotated[float, Field(ge=1.0, le=1e9)] = 10700.0
    read_noise_e: Annotated[float, Field(ge=0.0, le=1e6)] = 2.3
    gamma: Annotated[float, Field(ge=0.1, le=10.0)] = 2.2  # 8-bit level = 255 linear^(1 / gamma)
    hot_pixels: Count = 0  # pixels with a large dark current; the same ones through a run
    hot_e_s: Lengths = (2e4, 5e5)  # dark current of a hot pixel, electrons a second


_NO_VIDEO = ("none", "full", "0-255")


class Output(KnobSection):
    """The format in which pictures are written."""

    pixels: Literal["bgr8", "mono8", "mono16", "bayer8", "bayer16"] = "bgr8"  # 16 bit: linear 12-bit level times 16
    file: Literal["jpg", "png"] = "jpg"
    quality: Annotated[int, Field(ge=1, le=100)] = 95  # of JPEG files
    pattern: Literal["rggb", "bggr", "grbg", "gbrg"] = "rggb"  # of the Bayer mosaic
    color: bool = True  # False: a monochrome sensor
    channel_gains: tuple[PositiveFloat, PositiveFloat, PositiveFloat] = (1.0, 1.0, 1.0)  # of B, G, R in colour pictures
    # interlaced video. woven: even and odd rows are exposed one after the other; single: only the even rows are written
    fields: Literal["none", "woven", "single"] = "none"
    field_s: PositiveFloat = 0.02  # between the two fields: 0.02 s at 25 frames a second, 0.0167 s at 30
    chroma: Literal["full", "half"] = "full"  # half: 4:2:0 after BT.601, colour at half the width and height
    levels: Literal["0-255", "16-235"] = "0-255"  # 16-235: renderer range of video, not expanded to 0-255

    @model_validator(mode="after")
    def _file_can_hold_it(self) -> Self:
        if self.file == "jpg" and self.pixels not in ("bgr8", "mono8"):
            raise ValueError(f"pixels: {self.pixels} needs file: png")
        if not self.color and self.pixels not in ("mono8", "mono16"):
            raise ValueError(f"pixels: a sensor without colour gives no {self.pixels}")
        if self.pixels not in ("bgr8", "mono8") and (self.fields, self.chroma, self.levels) != _NO_VIDEO:
            raise ValueError(f"fields, chroma and levels of video: pixels have to be bgr8 or mono8, not {self.pixels}")
        return self


class StreamFaults(KnobSection):
    """Faults of the stream of frames; each number is a probability per frame unless its comment says otherwise."""

    dropped: Probability = 0.0  # the frame has no row and no file
    frozen: Probability = 0.0  # the last picture is repeated under new stamps for `frozen_frames` frames
    frozen_frames: PositiveInt = 5
    duplicated: Probability = 0.0  # the row appears twice, with the same stamp and file
    disordered: Probability = 0.0  # the row changes places with the one before it
    half_written: Probability = 0.0  # the second half of the picture's file is missing
    black: Probability = 0.0  # the whole picture is zero
    white: Probability = 0.0  # the whole picture is at full scale
    over_exposed: Probability = 0.0  # the exposure is 50 times as long
    clock_jump_s: Annotated[float, Field(ge=-1e9, le=1e9)] = 0.0  # size of a jump; all later stamps are shifted
    clock_jumps: Probability = 0.0  # probability of a jump


class SensorKnobs(KnobSection):
    """Errors of a sensor of the vehicle, in rad/s (gyro), m/s (DVL), m (depth) or parts of 1 (tilt)."""

    rate_hz: Annotated[float, Field(ge=0.1, le=100.0)] = 10.0
    noise: Annotated[float, Field(ge=1e-9, le=1e3)] = 0.01  # 1 sigma of each number, independent from value to value
    bias: Annotated[float, Field(ge=0.0, le=1e3)] = 0.0  # 1 sigma of each number, drawn once a run
    scale: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0  # 1 sigma of the relative error, drawn once a run
    mount_deg: Angle = 0.0  # by which it is turned about an axis that is drawn once a run
    late_s: Annotated[float, Field(ge=-2.0, le=2.0)] = 0.0  # by which its stamps are late
    wrong_from_s: NonNegativeFloat = 0.0  # time since the start from which it also has ...
    wrong_bias: tuple[float, float, float] = (0.0, 0.0, 0.0)  # ... this bias ...
    wrong_scale: float = 0.0  # ... and this relative error


class GyroKnobs(SensorKnobs):
    """A gyro with the errors that the localizer's settings declare."""

    rate_hz: Annotated[float, Field(ge=0.1, le=100.0)] = 50.0
    noise: Annotated[float, Field(ge=1e-9, le=1e3)] = 0.001  # rad/s
    bias: Annotated[float, Field(ge=0.0, le=1e3)] = 0.0052  # rad/s: 0.3 degrees/s


class DvlKnobs(SensorKnobs):
    """A DVL with the errors that the localizer's settings declare."""

    rate_hz: Annotated[float, Field(ge=0.1, le=100.0)] = 5.0
    scale: Annotated[float, Field(ge=0.0, le=1.0)] = 0.03
    mount_deg: Angle = 2.0


class DepthKnobs(SensorKnobs):
    """A depth sensor, above or below the depth of the dock by what its bias says."""

    bias: Annotated[float, Field(ge=0.0, le=1e3)] = 2.0  # m


class TiltKnobs(SensorKnobs):
    """A sensor of the direction upward."""

    rate_hz: Annotated[float, Field(ge=0.1, le=100.0)] = 20.0
    noise: Annotated[float, Field(ge=1e-9, le=1e3)] = 0.005
    mount_deg: Angle = 1.0


class AidingKnobs(KnobSection):
    """The vehicle's own sensors: none unless given, `{}` for one with its defaults."""

    gyro: GyroKnobs | None = None
    velocity: DvlKnobs | None = None
    depth: DepthKnobs | None = None
    tilt: TiltKnobs | None = None


class DockingKnobs(KnobSection):
    """What a vehicle meets that steers itself into the dock; `path` then gives only the frame rate."""

    current_m_s: Annotated[tuple[Reach, Reach], BeforeValidator(_pair), AfterValidator(_rising)] = (0.0, 0.5)  # speed
    # 1 sigma of the turbulence over the speed of the current; 0.1 is usual in tidal flow near the bed
    turbulence: Probability = 0.1
    start_z_m: Annotated[tuple[Reach, Reach], BeforeValidator(_pair), AfterValidator(_rising)] = (18.0, 24.0)
    start_off_m: Reach = 1.5  # distance from the axis in x and in y, 1 sigma
    start_yaw_deg: Angle = 5.0  # heading error, 1 sigma
    rocking_deg: Angle = 0.5  # largest roll and pitch of the vehicle in the waves
    station_off_m: Reach = 0.0  # by which every light is off its surveyed position along each axis, 1 sigma
    time_limit_s: Annotated[float, Field(ge=10.0, le=3600.0)] = 300.0
