"""Every knob of water, lamps, surroundings, lens, sensor and stream, with unit and source; read from YAML."""

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
    """One number as the range from it to itself."""
    return value if isinstance(value, (list, tuple)) else (value, value)


def _rising(bounds: tuple[Any, Any]) -> tuple[Any, Any]:
    if bounds[0] > bounds[1]:
        raise ValueError("wanted the lower bound first")
    return bounds


# a number or a range [lo, hi], from which a draw is uniform
Counts = Annotated[tuple[Count, Count], BeforeValidator(_pair), AfterValidator(_rising)]
Length = Annotated[float, Field(ge=1e-6, le=1e6)]
Lengths = Annotated[tuple[Length, Length], BeforeValidator(_pair), AfterValidator(_rising)]
Size = Annotated[float, Field(ge=0.01, le=100.0)]
Sizes = Annotated[tuple[Size, Size], BeforeValidator(_pair), AfterValidator(_rising)]
Shares = Annotated[tuple[Probability, Probability], BeforeValidator(_pair), AfterValidator(_rising)]
Interval = Annotated[tuple[NonNegativeFloat, NonNegativeFloat], AfterValidator(_rising)]


class Section(BaseModel):
    """Unknown keys are refused, and so is what is not finite."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Water(Section):
    """Which water; tables and sources in `sim.water` and `sim.scattering`."""

    kind: Literal["pure-sea", "IB", "II", "III", "1C", "3C", "5C", "7C", "pool-clear", "pool-murky"] = (
        "III"  # Jerlov types and pools
    )
    b_factor: Annotated[float, Field(ge=0.0, le=20.0)] = 1.0  # published b values differ by factors: sweep it
    phase: Literal["auto", "clear", "coastal", "harbour"] = "auto"  # Petzold's waters; auto is by kind
    absorption: Coefficients | None = None  # 1/m at 455, 530, 610 nm, in place of the kind's
    scattering: Coefficients | None = None
    salinity_psu: Annotated[float, Field(ge=0.0, le=45.0)] = 35.0
    temperature_c: Annotated[float, Field(ge=-2.0, le=40.0)] = 15.0


class Daylight(Section):
    """Light from above."""

    # irradiance just below the surface in bands of 80 nm: noon under a clear sky 100, overcast 20-30, night 0
    surface_w_m2: NonNegativeFloat = 60.0
    depth_m: NonNegativeFloat = 30.0  # of the camera when it is at the height of the dock's origin
    more: PositiveFloat = 2.0  # light scattered more than once sideways, over that scattered once; 1.5-3 at c z > 2


class Lamps(Section):
    """The dock's own lamps."""

    window_radius_m: Annotated[float, Field(gt=0.0, le=1.0)] = 0.0175  # 15-20 mm
    layers: Literal["all", "front", "rear"] = "all"  # which of them shine; rear is all but the first seen
    dim: Probability = 1.0  # share of their power
    side_share: Probability = 0.0  # of the power that window and housing throw about, evenly into all directions
    fouling: Shares = (1.0, 1.0)  # transmission of each lamp's window, drawn for a run
    swap_colors: bool = False  # the layers in reverse order have each other's colours
    pwm_hz: NonNegativeFloat = 0.0  # 0 is direct current; power_w of the station is that while on
    pwm_duty: Annotated[float, Field(gt=0.0, le=1.0)] = 1.0
    failures: dict[str, NonNegativeFloat] = {}  # id of a light and when it goes dark, s


class Surface(Section):
    """The water surface above the dock, which mirrors its lamps."""

    height_m: Annotated[float, Field(gt=0.0, le=1000.0)] = 2.0  # above the dock's origin
    slope: Annotated[float, Field(ge=0.0, le=0.5)] = (
        0.04  # rms; 0.03 in a pool, 0.1 at a few m/s of wind (Cox & Munk 1954)
    )
    fragments: Annotated[int, Field(ge=1, le=50)] = 5  # of each lamp's image
    period_s: PositiveFloat = 1.2  # of the waves


class Glints(Section):
    """Reflections of each lamp on the cage beside it."""

    share: Shares = (0.02, 0.08)  # of the lamp's intensity, drawn for a run
    offset_m: PositiveFloat = 0.06  # outward from the axis of the dock


class Headlamp(Section):
    """A lamp on the vehicle, beside the camera."""

    power_w: PositiveFloat = 10.0  # radiant, white
    offset_m: tuple[float, float, float] = (0.35, 0.25, 0.0)  # in cam: x right, y down, z forward
    beam_deg: Annotated[float, Field(ge=10.0, le=170.0)] = 60.0  # full width at half maximum


class Snow(Section):
    """Particles that drift in front of the camera and shine in the light that falls on them."""

    per_m3: Annotated[float, Field(ge=0.0, le=200.0)] = (
        20.0  # larger than half a millimetre: 1-100 (Alldredge & Silver 1988)
    )
    radius_mm: Sizes = (0.25, 1.5)  # drawn as 1 / radius^3
    albedo: Probability = 0.3
    reach_m: Annotated[float, Field(gt=0.0, le=10.0)] = 3.0
    drift_m_s: tuple[float, float, float] = (0.05, -0.01, 0.02)  # in dock


class Vehicle(Section):
    """Another vehicle with lamps."""

    start: Place = (-4.0, 1.0, 6.0)  # of its middle in dock, m
    velocity_m_s: Place = (0.25, 0.0, 0.1)
    lamps: Annotated[int, Field(ge=1, le=20)] = 3
    spacing_m: PositiveFloat = 0.4  # of the lamps, side by side
    power_w: PositiveFloat = 2.0
    color: Literal["white", "blue", "cyan", "green", "red"] = "white"


class Fish(Section):
    """Dark bodies that cross the view."""

    count: Annotated[int, Field(ge=1, le=100)] = 3
    length_m: Sizes = (0.2, 0.5)
    distance_m: Sizes = (1.5, 4.0)  # from the camera
    speed_m_s: Lengths = (0.2, 0.6)


class Around(Section):
    """What there is beside the dock's lamps; nothing of it by default."""

    surface: Surface | None = None
    glints: Glints | None = None
    headlamp: Headlamp | None = None
    snow: Snow | None = None
    vehicle: Vehicle | None = None
    fish: Fish | None = None
    hull: Probability = 0.0  # share of the picture's height, from below, that the own vehicle's nose hides


class Port(Section):
    """A flat window before a lens calibrated in air; its axis is the lens's."""

    gap_m: Annotated[float, Field(ge=0.0, le=1.0)] = 0.02  # from the entrance pupil to the glass
    glass_m: Annotated[float, Field(ge=0.0, le=1.0)] = 0.01
    glass_index: Annotated[float, Field(ge=1.0, le=2.5)] = 1.50
    calibrated_at_m: Lengths = (1.5, 6.0)  # distances of the in-water calibration that camera.yaml holds

    @model_validator(mode="after")
    def _boards_are_in_the_water(self) -> Self:
        if self.calibrated_at_m[0] < self.gap_m + self.glass_m + 0.1:
            raise ValueError("calibrated_at_m: wanted at least 0.1 m beyond the glass")
        return self


class Lens(Section):
    """7.2 mm f/2.8; camera.yaml says how it projects."""

    f_number: Annotated[float, Field(ge=0.5, le=100.0)] = 2.8
    focal_m: Annotated[float, Field(ge=1e-4, le=1.0)] = 7.2e-3
    blur_px: Pixels = 0.7  # 1 sigma
    falloff: Probability = 0.1  # loss at the corner beyond the cosine law
    glare: Probability = 0.01  # share of all light that the lens scatters, about 1 %
    glare_px: Pixels = 60.0  # half of it within about twice this
    ghost: Probability = 1e-5  # share that is mirrored about the centre: two reflections of 0.3 %
    ghost_px: Pixels = 40.0  # radius of that
    port: Port | None = None
    focal_error: Annotated[float, Field(gt=-0.5, lt=0.5)] = 0.0  # the true focal length over camera.yaml's, less one
    motion: bool = True  # blur along the way during the exposure


class AutoExposure(Section):
    """A control loop on the mean and the bright end of the picture, a step behind as real ones are."""

    mean: PositiveFloat = 0.12  # wanted mean level, share of full scale
    bright: Annotated[float, Field(gt=0.0, le=1.0)] = 0.9  # level that the brightest 0.1 % may reach
    gain: Annotated[float, Field(gt=0.0, le=1.0)] = 0.5  # of the loop, in logarithms
    min_ms: PositiveFloat = 0.1
    max_ms: PositiveFloat = 10.0


class Sensor(Section):
    """Sony IMX264 as measured to EMVA 1288: 3.45 um, 12 bit, global shutter."""

    exposure_ms: Annotated[float, Field(gt=0.0, le=1000.0)] = 2.0
    auto_exposure: AutoExposure | None = None
    gain_db: Annotated[float, Field(ge=0.0, le=36.0)] = 0.0
    full_well_e: Annotated[float, Field(ge=1.0, le=1e9)] = 10700.0
    read_noise_e: Annotated[float, Field(ge=0.0, le=1e6)] = 2.3
    gamma: Annotated[float, Field(ge=0.1, le=10.0)] = 2.2
    hot_pixels: Count = 0  # fixed for a run
    hot_e_s: Lengths = (2e4, 5e5)  # electrons a second of each


_NO_VIDEO = ("none", "full", "0-255")


class Output(Section):
    """What is written of each picture."""

    pixels: Literal["bgr8", "mono8", "mono16", "bayer8", "bayer16"] = "bgr8"  # 16: the linear 12 bit, shifted up by 4
    file: Literal["jpg", "png"] = "jpg"
    quality: Annotated[int, Field(ge=1, le=100)] = 95  # of JPEG
    pattern: Literal["rggb", "bggr", "grbg", "gbrg"] = "rggb"  # of the mosaic
    color: bool = True  # False: a sensor without a mosaic
    white_balance: tuple[PositiveFloat, PositiveFloat, PositiveFloat] = (1.0, 1.0, 1.0)  # gains of B, G, R
    # interlaced video: two fields of alternate rows in one frame, or the even rows alone, which halves the height
    fields: Literal["none", "woven", "single"] = "none"
    field_s: PositiveFloat = 0.02  # between the two fields: 0.02 s at 25 frames a second, 0.0167 s at 30
    chroma: Literal["full", "half"] = "full"  # half: 4:2:0, colour at half the width and height, through BT.601
    levels: Literal["0-255", "16-235"] = "0-255"  # 16-235: of video that nobody expanded

    @model_validator(mode="after")
    def _file_can_hold_it(self) -> Self:
        if self.file == "jpg" and self.pixels not in ("bgr8", "mono8"):
            raise ValueError(f"pixels: {self.pixels} needs file: png")
        if not self.color and self.pixels not in ("mono8", "mono16"):
            raise ValueError(f"pixels: a sensor without colour gives no {self.pixels}")
        if self.pixels not in ("bgr8", "mono8") and (self.fields, self.chroma, self.levels) != _NO_VIDEO:
            raise ValueError(f"fields, chroma and levels of video: pixels have to be bgr8 or mono8, not {self.pixels}")
        return self


class Stream(Section):
    """What befalls the stream of frames: the probability of each in a frame, unless it says otherwise."""

    dropped: Probability = 0.0  # no row, no file
    frozen: Probability = 0.0  # the picture before once more, under new stamps, for `frozen_frames`
    frozen_frames: PositiveInt = 5
    duplicated: Probability = 0.0  # row, stamp and file twice
    disordered: Probability = 0.0  # changes places with the next row
    half_written: Probability = 0.0  # the file ends half-way
    black: Probability = 0.0  # all zero
    white: Probability = 0.0  # all at full scale
    over_exposed: Probability = 0.0  # at 50 times the exposure
    clock_jump_s: Annotated[float, Field(ge=-1e9, le=1e9)] = 0.0  # how far the clock jumps ...
    clock_jumps: Probability = 0.0  # ... and how often
