"""Every tunable number of lumidock, with its unit and where it comes from. Frozen; unknown keys are refused."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, NonNegativeInt, model_validator

from lumidock.yamlfile import read_mapping, validate

PositiveFloat = Annotated[float, Field(ge=1e-12, le=1e9)]  # its square, and one over that, are numbers too
Risk = Annotated[float, Field(ge=1e-12, le=1e-2)]  # a larger one protects nothing, a smaller one no normal tail backs
Age = Annotated[float, Field(gt=0.0, le=5.0)]  # s; after it the vehicle's motion is anyone's guess
NoisePx = Annotated[float, Field(ge=0.05, le=100.0)]  # no detector is better than a twentieth of a pixel
LogOdds = Annotated[float, Field(ge=4.6, le=1e3)]  # ln 100: less proves nothing
Gate = Annotated[float, Field(ge=6.0, le=100.0)]  # chi-square, 2 dof: 5 % to less than 1e-21 of the true ones outside
Degrees = Annotated[float, Field(ge=0.1, le=180.0)]  # no vehicle is held, and no prior known, more exactly
LogPrior = Annotated[float, Field(ge=-100.0, le=20.0)]
Count = Annotated[int, Field(ge=1, le=10_000)]  # work of a frame: more does not end within a second
Work = Annotated[int, Field(ge=1, le=10_000_000)]  # 15 s of search
Hypotheses = Annotated[int, Field(ge=1, le=256)]  # each holds a bank of covariances, 0.4 MB with 13 lights
Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
Hue = Annotated[int, Field(ge=0, le=179)]
Effort = Annotated[int, Field(ge=1, le=10_000)]


def _rising(bounds: tuple[float, float]) -> tuple[float, float]:
    if bounds[0] >= bounds[1]:
        raise ValueError("wanted the lower bound first")
    return bounds


Bounds = Annotated[tuple[float, float], AfterValidator(_rising)]


class SettingsGroup(BaseModel):
    """A frozen group of settings; the comment beside a field is its documentation (`lumidock config dump`)."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class ExtractConfig(SettingsGroup):
    """Light extraction, paper section 3.1.1."""

    gray: Literal["max", "luma"] = "max"  # the paper says only "grayscale"; luma weighs blue by 0.114
    contrast: PositiveFloat = 5.0  # sigmas of the background that a threshold, or a blob's peak, must clear ...
    max_foreground: Fraction = 0.02  # ... with no more than this share of the frame as foreground
    min_step: PositiveFloat = 4.0  # grey levels above the background mode below which nothing is a light
    class_gap: PositiveFloat = 5.0  # a core this many sigmas above its rim is cut out of it; a blurred disc has 3
    opening: Fraction = 0.5  # radius of the opening, as a share of the region's largest distance to its edge
    min_area_px: Count = 4
    max_radius_px: PositiveFloat = 150.0
    small_area_px: Count = 40  # below it the outline is too coarse for the two shape measures
    min_roundness: Fraction = 0.60  # 4 pi area / perimeter^2
    min_compactness: Fraction = 0.55  # area / area of the fitted circle, or its inverse
    max_arc_error: Fraction = 0.06  # rms distance from the circle, of its radius, where the picture's edge cuts a light
    max_thresholds: Count = 6  # tried in one frame; clean frames need one to three
    max_regions: Count = 80  # more mean that the threshold is still inside the noise; at last the largest are kept


class LayersConfig(SettingsGroup):
    """Layer discrimination, paper section 3.1.2."""

    # auto: colour where the frame has any, else radius; color_or_radius: radius also where no detection is blue
    method: Literal["auto", "color", "radius", "color_or_radius"] = "auto"
    blue_hue: tuple[Hue, Hue] = (98, 132)  # OpenCV hue, 0-179
    min_saturation: int = 60  # of 255; a saturated white core has none
    min_value: int = 25  # of 255
    min_blue: Fraction = 0.5  # share of the ring around the core that must be blue
    radius_gap: PositiveFloat = 0.25  # clusters differ by this share of the larger mean radius
    min_cluster: Count = 4  # lights in each cluster
    dual_frames: Count = 5  # T_cnt


class PsoConfig(SettingsGroup):
    """Enhanced particle swarm, paper section 3.2.1."""

    particles: Effort = 80
    iterations: Effort = 120
    inertia: PositiveFloat = 0.7  # w of eq. (3)
    c1: tuple[float, float] = (2.5, 0.5)  # base and final, eq. (5)
    c2: tuple[float, float] = (1.5, 0.5)  # base and final, eq. (6)
    k: PositiveFloat = 0.8  # eq. (4)
    theta_deg: Bounds = (-10.0, 10.0)
    scale: Bounds = (
        0.5,
        12.0,
    )  # the paper's (0.5, 8) and (-1, 1) hold the alignment with one spurious detection at the picture's edge ...
    shift: Bounds = (-2.0, 2.0)  # ... from 18.64 m on; from 30 m it takes more
    # eq. (2) prints the sum over all pairs, which has no minimum at the alignment
    residual: Literal["one_to_one", "all_pairs"] = "one_to_one"
    w1: PositiveFloat = 1.0  # eq. (8), this frame's residual
    w2: Annotated[float, Field(ge=0.0)] = 0.3  # eq. (8), distance from the previous frame
    penalty: Annotated[float, Field(ge=0.0)] = 0.5  # eq. (7)
    stagnation: Count = 12  # iterations without gain before a particle starts anew
    seed: NonNegativeInt = 0


class ConsistencyConfig(SettingsGroup):
    """Distance and angle ratios, paper section 3.2.2."""

    ratio: PositiveFloat = 0.10  # eq. (9), relative
    angle_deg: PositiveFloat = 5.0  # eq. (10)


class BtekfConfig(SettingsGroup):
    """Backtracking EKF, paper section 3.2.3."""

    noise_in_gate: bool = True  # eq. (11), (12) print the gate without measurement noise
    missing_branch: bool = True  # section 3.2.3 d prints none: every gated light must find its detection
    gate: PositiveFloat = 13.8  # M^2 of eq. (12): chi-square, 2 dof, 99.9 %
    pixel_sigma: PositiveFloat = 1.0  # px, R of eq. (13)
    accept_px: PositiveFloat = 4.0  # reprojection residual after an update
    # section 3.2.3 e as printed: the filter's own pose is the answer of its frame, and the next frame is associated by
    # the lights reprojected from it; otherwise SQPnP solves every frame, and the swarm opens the next one
    pose_from_filter: bool = False
    min_lights: Annotated[int, Field(ge=3)] = 3  # section 3.2.3 e
    three_light_gap_s: PositiveFloat = 0.5  # three lights fit any three detections; only so soon after four
    accel_m_s2: PositiveFloat = 0.5  # white noise on the velocity, per axis
    accel_rad_s2: PositiveFloat = 0.15
    start_speed_m_s: PositiveFloat = 1.0  # 1 sigma of the unknown velocity at the first fix
    start_rate_rad_s: PositiveFloat = 0.1
    max_nodes: Count = 400  # of the backtracking search
    max_gap_s: PositiveFloat = 2.0  # older history is forgotten


class PoseConfig(SettingsGroup):
    """When the pose of a layer is accepted, paper section 3.3."""

    max_rms_px: PositiveFloat = 6.0  # of the reprojection


# What `preset: as_printed` changes of the defaults; docs/paper-method.md gives the reason and the effect of each.
AS_PRINTED: dict[str, dict[str, Any]] = {
    "extract": {"gray": "luma"},
    "layers": {"method": "color_or_radius"},
    "pso": {"particles": 20, "iterations": 40, "scale": (0.5, 8.0), "shift": (-1.0, 1.0)},
    "btekf": {
        "noise_in_gate": False,
        "missing_branch": False,
        "pose_from_filter": True,
        "three_light_gap_s": 2.0,
    },
}


class PaperConfig(SettingsGroup):
    """The paper's method; settings that are given beside a `preset` go before those of the preset."""

    preset: Literal["recommended", "as_printed"] = "recommended"
    extract: ExtractConfig = ExtractConfig()
    layers: LayersConfig = LayersConfig()
    pso: PsoConfig = PsoConfig()
    consistency: ConsistencyConfig = ConsistencyConfig()
    max_detections: Count = 200  # a frame with more is refused: `too_many`
    max_lights: Count = 40  # of a layer; the ratio filter looks at all triples
    btekf: BtekfConfig = BtekfConfig()
    pose: PoseConfig = PoseConfig()

    @model_validator(mode="before")
    @classmethod
    def _with_preset(cls, given: Any) -> Any:  # noqa: ANN401  # pydantic passes whatever the file holds
        if not isinstance(given, dict) or given.get("preset") != "as_printed":
            return given
        preset = {name: settings for name, settings in AS_PRINTED.items() if isinstance(given.get(name, {}), dict)}
        return given | {name: settings | given.get(name, {}) for name, settings in preset.items()}


class DetectConfig(SettingsGroup):
    """Light detection of the default method: docs/detector.md derives each number or shows what it changes."""

    min_snr: PositiveFloat = 4.0  # of a blob's response, sigmas of its noise
    clear: PositiveFloat = 2.0  # of a blob's response, sigmas of the texture around it
    roundness: Fraction = 0.12  # smaller over larger curvature of a response; an edge or a rope has none
    share: Fraction = 0.35  # of the strongest blob's height, that a more precise one of the same light must have
    compact: Fraction = 0.05  # of its size, that counts as error where planes and scales compete for a light
    reach: PositiveFloat = 1.2  # of its size, within which another blob is of the same light
    wide: PositiveFloat = 3.0  # times larger, and a blob is a halo around others, ...
    texture: Fraction = 0.5  # ... which are lights of their own if they have this share of its height
    agree: PositiveFloat = 9.2  # chi-square, 2 dof, 1 %: planes whose centroids agree as well are averaged
    texture_share: Fraction = 0.15  # of the texture around, that counts as noise of the centroid
    spread: Fraction = (
        0.25  # of the way of the maximum to the filters half an octave finer and wider, that is error, 1 sigma
    )
    lost: Fraction = 0.04  # of the filter's variance, that stands for this way where such a filter has no maximum
    size_share: Fraction = 0.01  # of its size, that is error, 1 sigma
    border_share: Fraction = 0.3  # of what a centroid is nearer to the border than 2.5 sizes, that is error, 1 sigma
    mosaic_px: PositiveFloat = (
        0.5  # error of a point in blue or red of a mosaic, whose samples lie two pixels apart, 1 sigma
    )
    floor_px: Annotated[float, Field(ge=0.01, le=10.0)] = 0.04  # error of any centroid, 1 sigma
    live_sigmas: PositiveFloat = 5.0  # by which a tile's brightest pixels must stand out
    live_clear: PositiveFloat = 2.0  # the same, of the tiles around
    live_least: PositiveFloat = 0.05  # least such sigma, grey levels
    margin_px: Count = 24  # of picture around what is searched: 3 sigma of the widest Gaussian of the third level
    window_sizes: PositiveFloat = 4.0  # the same in a tracked frame, in sizes of the largest lamp of the frame before
    full_area_px: PositiveFloat = 6e5  # of the picture searched at full resolution; of more, coarser
    window_area_px: PositiveFloat = 1e5  # the same of all windows of a tracked frame
    square: PositiveFloat = 1.25  # ratio of the focal lengths up to which pixels count as square
    min_p_light: Fraction = 0.01  # less is no detection: a frame of matter has hundreds, and they cost the matcher time
    max_blobs: Count = 4000  # maxima of a frame, over all planes and scales
    max_lights: Count = 200  # detections of a frame; the strongest are kept


class LabelConfig(SettingsGroup):
    """Front or rear layer by colour: the rear lights are blue, the front ones white."""

    gamma: PositiveFloat = 2.2  # of the camera; ratios of colours mean something only in linear light
    clear_px: PositiveFloat = 3.0  # beyond a saturated core's edge, where clipping and demosaicing make it white
    ring: tuple[PositiveFloat, PositiveFloat] = (1.5, 6.0)  # the colour is read up to this many radii + px
    min_reach_px: PositiveFloat = 2.0  # radius within which small unsaturated blobs are read whole
    blue_ratio: PositiveFloat = 1.2  # blue over the larger of green and red, at which both layers are as likely
    softness: PositiveFloat = 0.2  # 1 sigma of the logarithm of that ratio, without any pixel noise
    min_signal: PositiveFloat = 3.0  # sigmas of the ring's noise; with less signal the layer stays unknown
    limit: Annotated[float, Field(gt=0.0, lt=0.5)] = 0.03  # p_rear stays this far from 0 and 1


class PriorConfig(SettingsGroup):
    """Prior of the camera's attitude about head-on where no sensor measures it, 1 sigma."""

    roll_deg: Degrees = 10.0
    pitch_deg: Degrees = 15.0
    yaw_deg: Degrees = 15.0
    # share of approaches with any roll, beyond `match.roll_gate`; poses that fit there are rivals of this weight
    any_roll: Annotated[float, Field(ge=1e-9, le=0.5)] = 1e-3


class MatchConfig(SettingsGroup):
    """Acquisition: the evidence of an association, and when it decides."""

    noise_px: NoisePx = 0.5  # 1 sigma of a centroid that comes without a covariance
    unlikely_radii: Fraction = 0.5  # 1 sigma of a centroid, in blob radii, as the blob's p_light goes to 0
    detect: Annotated[float, Field(gt=0, lt=1)] = 0.8  # probability that a light in view is detected
    layer_absent: Annotated[float, Field(gt=0, lt=1)] = 0.3  # probability that a whole layer is not seen
    # share of vehicles whose attitude is closer to head-on than the prior by the factor `steadier`; without a sensor
    steady: Annotated[float, Field(ge=0, lt=1)] = 0.7
    steadier: PositiveFloat = 7.0
    label_trust: Fraction = 0.6  # weight of p_rear against 0.5: a p_rear of 0.95 counts as 0.77
    spurious: PositiveFloat = 5.0  # mean number of spurious detections in an image
    clutter_near: Fraction = 0.02  # share of spurious detections that lie as close together as the lights do
    clutter_margin_px: PositiveFloat = 100.0  # around the projected lights, within which such detections count
    gate: Gate = 18.4  # squared Mahalanobis distance: chi-square, 2 dof, exceeded with 1e-4
    pair_gate: Gate = 11.8  # the same for a light predicted from two others and the attitude; 0.3 %
    bend: PositiveFloat = 0.7  # a tilt of variance s shortens the array by a share of this times s, 1 sigma
    roll_gate: PositiveFloat = 3.3  # sigmas of the prior, beyond which a roll counts as any
    near_m: PositiveFloat = 0.3  # least and ...
    far_m: PositiveFloat = 40.0  # ... greatest distance of a light
    hypotheses: Hypotheses = 64  # kept while lights are added to them
    # of more detections only the likeliest lamps are considered: so many, or `detections_per_light` times the lights
    least_detections: Count = 16
    detections_per_light: Count = 2
    # units of work of one frame's acquisition, a pose of two detections or a quarter of a fit, 1.4 us each (bench
    # `acquisition-time`); what is found before all is searched is no answer: `too_many`
    max_work: Work = 18_000
    log_dock: LogPrior = 2.0  # log prior odds that the dock is in view at all
    max_detections_three: Count = 14  # among more detections, three lights of a layer identify nothing
    sure: LogOdds = 15.0  # log evidence above which associations of three lights a layer are not searched for
    margin: LogOdds = 6.9  # log odds of an association that one frame decides, ln 1000
    margin_gathered: LogOdds = 9.2  # the same gathered over frames, or with three lights; ln 10,000
    lead: Annotated[float, Field(ge=1.0, le=1e3)] = (
        3.5  # log odds by which a gathered hypothesis must also lead in the last frame alone
    )
    extra: LogOdds = 7.5  # log odds of an identified light beyond those four
    prune: LogOdds = 5.0  # log odds below which an identified light is dropped in any case
    keep: LogOdds = 14.0  # log evidence behind the best at which a hypothesis is dropped
    log_mirror: LogPrior = -8.1  # log prior of seeing only the mirror image of the dock


class TrackConfig(SettingsGroup):
    """Tracking: the filter's motion model, association and hypotheses."""

    # white noise on the velocity: what a second adds to it, 1 sigma
    accel_m_s2: Annotated[float, Field(ge=0.01, le=100.0)] = 0.3
    accel_rad_s2: Annotated[float, Field(ge=0.002, le=100.0)] = 0.05  # the same on the rotation rate
    # 1 sigma of a stamp against the exposure, by which the pose is off along the motion: a driver's clock on a busy
    # host has some milliseconds, a hardware trigger microseconds; 10 ms keep the valid poses that 30 ms of jitter take
    stamp_s: Annotated[float, Field(ge=0.0, le=0.5)] = 0.0
    # factor on the covariance of centroids in the filter: errors with memory average out more slowly than white ones.
    # 1.4 takes one valid pose in seventy and keeps the trust of a vehicle that hovers with such errors (faults/
    # hover-memory); 3 also holds the levels where two thirds of the variance have a memory of 0.5-2 s
    # (faults/noise-memory), and takes one in twenty
    memory: Annotated[float, Field(ge=1.0, le=100.0)] = 1.4
    start_m_s: Annotated[float, Field(ge=0.05, le=100.0)] = 1.5  # 1 sigma of the unknown velocity at the start
    start_rad_s: Annotated[float, Field(ge=0.01, le=100.0)] = 0.15  # 1 sigma of the unknown rotation rate at the start
    gate: Gate = 18.4  # squared Mahalanobis distance: chi-square, 2 dof, exceeded with 1e-4
    reach: PositiveFloat = 10.0  # log evidence behind the best at which an association is not followed
    max_nodes: Work = 100_000  # of the association's search, 0.1 us each; a hypothesis that needs more is dropped
    log_appear: LogPrior = -6.9  # log prior that a layer comes into view in one frame
    # 1 sigma to which the others predict a light that geometry proves; glints lie 2 cm and more beside the lamps
    proven_m: Annotated[float, Field(ge=1e-6, le=0.05)] = 0.01
    max_gap_s: Age = 2.0  # without lights; after it only the calibration states are kept
    max_deviate: Annotated[float, Field(ge=2.0, le=8.0)] = 4.0  # of one frame's NIS, as a standard normal deviate
    max_mean_deviate: Annotated[float, Field(ge=2.0, le=8.0)] = 3.5  # of the running mean of that deviate
    deviate_memory: Annotated[float, Field(ge=0.0, le=0.99)] = (
        0.8  # share of the running mean that is kept from frame to frame
    )
    hypotheses: Hypotheses = 32  # poses or associations followed side by side
    forget: LogOdds = 16.0  # log odds behind the best at which one of them is dropped


class IntegrityConfig(SettingsGroup):
    """When a pose may be used."""

    # probability in a frame that an error exceeds its protection level, or that the association is wrong
    risk: Risk = 1e-6
    # prior probability that an associated light is wrong, until geometry has proven it
    fault: Annotated[float, Field(ge=1e-6, le=0.1)] = 1e-3
    fault_proven: Annotated[float, Field(ge=1e-7, le=0.1)] = 2e-6  # afterwards; as often as in nominal campaigns
    # prior probability that a sensor of the vehicle is not as declared, until the lights have proven that it is
    fault_sensor: Annotated[float, Field(ge=1e-6, le=0.1)] = 1e-2
    # frames in a row with fewer than four lights, after which a fresh acquisition must agree
    thin_frames: Annotated[int, Field(ge=1, le=30)] = 3
    max_age_s: Age = 0.3  # of the last detected light, up to which a fix is predicted


class FilesConfig(SettingsGroup):
    """What is believed of the station and the camera file; docs/safety-case.md says how smaller sigmas are earned."""

    # least 1 sigma of a layer's rigid offset where the file declares one and the dock has several layers: what welding
    # and tape leave over some metres; a survey from images declares none
    layer_m: Annotated[float, Field(ge=0.0, le=1.0)] = 0.02
    # least 1 sigma of the focal length, relative, where the station file states no calibration_sigma: a board gives
    # 0.2-1 %, and the refractive index of water lies between 1.333, fresh and warm, and 1.344, salt and cold; 0.7 %
    # takes the guidance of a single ring of 2 m at the edge of the image
    focal: Annotated[float, Field(ge=0.0, le=0.1)] = 0.005


Quaternion = tuple[float, float, float, float]
Vector = tuple[float, float, float]


class GyroConfig(SettingsGroup):
    """The gyro: its mount and its errors, 1 sigma."""

    quat_xyzw: Quaternion = (0.0, 0.0, 0.0, 1.0)  # of R_cam_sensor: the axes of its values in `cam`
    mount_sigma_deg: PositiveFloat = 2.0  # by which this is off
    bias_deg_s: PositiveFloat = 0.3  # of an industrial MEMS gyro that was at rest once; a state of the filter
    walk_deg_s: PositiveFloat = 0.01  # what a second adds to the bias
    delay_s: Annotated[float, Field(ge=-2.0, le=2.0)] = 0.0  # by which its stamps are late
    delay_sigma_s: PositiveFloat = 0.1


class VelocityConfig(SettingsGroup):
    """The DVL, with lock on a ground that does not move: its mount and its errors, 1 sigma."""

    quat_xyzw: Quaternion = (0.0, 0.0, 0.0, 1.0)  # of R_cam_sensor: the axes of its values in `cam`
    position_m: Vector = (0.0, 0.0, 0.0)  # of its transducers in `cam`
    mount_sigma_deg: PositiveFloat = 2.0  # by which the axes are off; a state of the filter
    scale: PositiveFloat = (
        0.03  # relative error, most of it of the speed of sound (1 % is 15 m/s); a state of the filter
    )
    walk: PositiveFloat = 0.0002  # what a second adds to both, relative and rad
    delay_s: Annotated[float, Field(ge=-2.0, le=2.0)] = 0.0  # by which its stamps are late
    delay_sigma_s: PositiveFloat = 0.1


class DepthConfig(SettingsGroup):
    """The depth sensor: its place and its errors, 1 sigma."""

    position_m: Vector = (0.0, 0.0, 0.0)  # in `cam`
    dock_depth_m: float = 0.0  # what it reads at the height of the dock's origin ...
    dock_depth_sigma_m: PositiveFloat = 100.0  # ... and how well that is known; a state of the filter
    walk_m: PositiveFloat = 0.005  # what a second adds to it: tide and waves
    delay_s: Annotated[float, Field(ge=-2.0, le=2.0)] = 0.0  # by which its stamps are late


class TiltConfig(SettingsGroup):
    """The sensor of the direction upward: its mount. Its bias is held to be part of `dock_level_deg`."""

    quat_xyzw: Quaternion = (0.0, 0.0, 0.0, 1.0)  # of R_cam_sensor: the axes of its values in `cam`
    delay_s: Annotated[float, Field(ge=-2.0, le=2.0)] = 0.0  # by which its stamps are late


class DockMotionConfig(SettingsGroup):
    """How a moored or hung dock moves about its mean place, 1 sigma; a dock on the ground does not."""

    angle_deg: Annotated[float, Field(ge=0.0, le=90.0)] = 0.0
    rate_deg_s: Annotated[float, Field(ge=0.0, le=90.0)] = 0.0
    position_m: Annotated[float, Field(ge=0.0, le=10.0)] = 0.0
    velocity_m_s: Annotated[float, Field(ge=0.0, le=10.0)] = 0.0


class AidingConfig(SettingsGroup):
    """The vehicle's own sensors in the filter: what they are held to measure, and when they are believed."""

    gyro: GyroConfig = GyroConfig()
    velocity: VelocityConfig = VelocityConfig()
    depth: DepthConfig = DepthConfig()
    tilt: TiltConfig = TiltConfig()
    dock_motion: DockMotionConfig = DockMotionConfig()
    dock_level_deg: PositiveFloat = 3.0  # by which the dock's +y is off the vertical, as tilt and depth have it
    group_s: Annotated[float, Field(ge=0.001, le=0.5)] = 0.1  # values of a sensor within it are applied as their mean
    max_age_s: Age = 4.0  # of the last detected light, up to which a fix is predicted with gyro and velocity


class Config(SettingsGroup):
    """All settings; saved with every run."""

    paper: PaperConfig = PaperConfig()
    prior: PriorConfig = PriorConfig()
    match: MatchConfig = MatchConfig()
    track: TrackConfig = TrackConfig()
    integrity: IntegrityConfig = IntegrityConfig()
    files: FilesConfig = FilesConfig()
    aiding: AidingConfig = AidingConfig()
    detect: DetectConfig = DetectConfig()
    label: LabelConfig = LabelConfig()
    methods: dict[str, dict[str, Any]] = {}  # settings of the methods that installed packages add, by their names


def load_config(path: Path | str) -> Config:
    """Read a configuration file; what it does not name keeps its default. Raises: InputError, one line."""
    return validate(Config, read_mapping(Path(path), "configuration"), str(path))
