"""Every tunable number of lumidock, with its unit and where it comes from. Frozen; unknown keys are refused."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, NonNegativeInt, PositiveInt

from lumidock.yamlfile import read_mapping, validate

PositiveFloat = Annotated[float, Field(ge=1e-12, le=1e9)]  # its square, and one over that, are numbers too
Risk = Annotated[float, Field(ge=1e-12, le=1e-2)]  # a larger one protects nothing, a smaller one no normal tail backs
Age = Annotated[float, Field(gt=0.0, le=5.0)]  # s; after it the vehicle's motion is anyone's guess
NoisePx = Annotated[float, Field(ge=0.05, le=100.0)]  # no detector is better than a twentieth of a pixel
Pairs = Annotated[int, Field(ge=1, le=10_000_000)]  # 15 s of search
Hypotheses = Annotated[int, Field(ge=1, le=256)]  # each holds a bank of covariances, 0.4 MB with 13 lights
Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
Hue = Annotated[int, Field(ge=0, le=179)]
Effort = Annotated[int, Field(ge=1, le=10_000)]


def _rising(bounds: tuple[float, float]) -> tuple[float, float]:
    if bounds[0] >= bounds[1]:
        raise ValueError("wanted the lower bound first")
    return bounds


Bounds = Annotated[tuple[float, float], AfterValidator(_rising)]


class Section(BaseModel):
    """A frozen group of settings."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class ExtractConfig(Section):
    """Light extraction, paper section 3.1.1."""

    gray: Literal["max", "luma"] = "max"  # luma weighs blue by 0.114 and loses the rear layer
    contrast: PositiveFloat = 5.0  # sigmas of the background that a threshold, or a spot's peak, must clear ...
    max_foreground: Fraction = 0.02  # ... with no more than this share of the frame as foreground
    min_step: PositiveFloat = 4.0  # grey levels above the background mode below which nothing is a light
    class_gap: PositiveFloat = 5.0  # a core this many sigmas above its rim is cut out of it; a blurred disc has 3
    opening: Fraction = 0.5  # radius of the opening, as a share of the region's largest distance to its edge
    min_area_px: PositiveInt = 4
    max_radius_px: PositiveFloat = 150.0
    small_area_px: PositiveInt = 40  # below it the outline is too coarse for the two shape measures
    min_roundness: Fraction = 0.60  # 4 pi area / perimeter^2
    min_compactness: Fraction = 0.55  # area / area of the fitted circle, or its inverse
    max_arc_error: Fraction = 0.06  # rms distance from the circle, of its radius, where the picture's edge cuts a light
    max_thresholds: PositiveInt = 6  # tried in one frame; clean frames need one to three
    max_regions: PositiveInt = (
        80  # more mean that the threshold is still inside the noise; at last the largest are kept
    )


class LayersConfig(Section):
    """Layer discrimination, paper section 3.1.2."""

    method: Literal["auto", "color", "radius"] = "auto"  # auto: colour where the frame has any
    blue_hue: tuple[Hue, Hue] = (98, 132)  # OpenCV hue, 0-179
    min_saturation: int = 60  # of 255; a saturated white core has none
    min_value: int = 25  # of 255
    min_blue: Fraction = 0.5  # share of the ring around the core that must be blue
    radius_gap: PositiveFloat = 0.25  # clusters differ by this share of the larger mean radius
    min_cluster: PositiveInt = 4  # lights in each cluster
    dual_frames: PositiveInt = 5  # T_cnt


class PsoConfig(Section):
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
    )  # the paper's (0.5, 8) and (-1, 1) bear a stray light at the picture's edge
    shift: Bounds = (-2.0, 2.0)  # from 18.64 m on; from 30 m it takes more
    residual: Literal["one_to_one", "all_pairs"] = "one_to_one"  # eq. (2) prints the sum over all pairs, which has no
    # minimum at the alignment
    w1: PositiveFloat = 1.0  # eq. (8), this frame's residual
    w2: Annotated[float, Field(ge=0.0)] = 0.3  # eq. (8), distance from the previous frame
    penalty: Annotated[float, Field(ge=0.0)] = 0.5  # eq. (7)
    stagnation: PositiveInt = 12  # iterations without gain before a particle starts anew
    seed: NonNegativeInt = 0


class ConsistencyConfig(Section):
    """Distance and angle ratios, paper section 3.2.2."""

    ratio: PositiveFloat = 0.10  # eq. (9), relative
    angle_deg: PositiveFloat = 5.0  # eq. (10)


class BtekfConfig(Section):
    """Backtracking EKF, paper section 3.2.3."""

    noise_in_gate: bool = True  # eq. (11), (12) print the gate without measurement noise
    missing_branch: bool = True  # section 3.2.3 d prints none: every gated light must find its spot
    gate: PositiveFloat = 13.8  # M^2 of eq. (12): chi-square, 2 dof, 99.9 %
    pixel_sigma: PositiveFloat = 1.0  # px, R of eq. (13)
    accept_px: PositiveFloat = 4.0  # reprojection residual after an update
    min_lights: Annotated[int, Field(ge=3)] = 3  # section 3.2.3 e
    three_light_gap_s: PositiveFloat = 0.5  # three lights fit any three spots: only so long after a fix of four or more
    accel_m_s2: PositiveFloat = 0.5  # white noise on the velocity, per axis
    accel_rad_s2: PositiveFloat = 0.15
    start_speed_m_s: PositiveFloat = 1.0  # 1 sigma of the unknown velocity at the first fix
    start_rate_rad_s: PositiveFloat = 0.1
    max_nodes: PositiveInt = 400  # of the backtracking search
    max_gap_s: PositiveFloat = 2.0  # older history is forgotten


class PoseConfig(Section):
    """When a layer's pose is believed, paper section 3.3."""

    max_rms_px: PositiveFloat = 6.0  # of the reprojection


class PaperConfig(Section):
    """The paper's method."""

    extract: ExtractConfig = ExtractConfig()
    layers: LayersConfig = LayersConfig()
    pso: PsoConfig = PsoConfig()
    consistency: ConsistencyConfig = ConsistencyConfig()
    max_detections: PositiveInt = 200  # a frame with more is refused: `too_many`
    max_lights: PositiveInt = 40  # of a layer; the ratio filter looks at all triples
    btekf: BtekfConfig = BtekfConfig()
    pose: PoseConfig = PoseConfig()


class DetectConfig(Section):
    """Light detection of the default method; figures without a source were set on rendered approaches."""

    contrast: PositiveFloat = 1.9  # sigmas by which a tile's largest pixel must clear that of the tiles around
    min_snr: PositiveFloat = 6.0  # of a spot; a small one's is that of a matched filter
    min_noise: PositiveFloat = 0.7  # steps of the sensor; rounding alone leaves 0.3
    ring_px: PositiveFloat = 8.0  # radius of the ring that is a small spot's background; larger spots take 3 radii
    max_detections: PositiveInt = 100  # in a frame; the strongest are kept
    max_candidates: PositiveInt = 1500  # tiles looked at in a frame, the most outstanding ...
    max_measured: PositiveInt = 300  # ... and those of them that are worth a measurement, the brightest
    max_radius: Fraction = 0.06  # of the picture's longer side
    min_radius_px: PositiveFloat = 0.9  # no lens makes a smaller spot
    small_px: PositiveFloat = 3.2  # up to this radius the centre comes from the fit of a Gaussian
    min_elongation: Fraction = 0.6  # shorter over longer axis of a round spot; below, its level is raised
    min_fill: Fraction = 0.85  # area over that of the ellipse with the same moments
    signal_noise: PositiveFloat = 0.01  # variance of a pixel per grey level of signal: shot noise, mosaic, JPEG
    linear_noise: PositiveFloat = 0.024  # the same of mosaics and of 16 bits, which no gamma bends: 255 over 10.7 ke-
    texture: PositiveFloat = 0.5  # share of its radius by which texture as strong as a spot moves the centre, 1 sigma
    floor_px: PositiveFloat = 0.008  # 1 sigma of a centre that has no noise
    coarse_px: PositiveFloat = 0.026  # the same where blue or red is brightest: JPEG has fewer samples of them
    saturated_px: PositiveFloat = 0.025  # the same of a wide or saturated spot, over the root of its radius, in samples
    cut: Fraction = 0.3  # 1 sigma, of the radius, of a centre whose spot the picture's edge cuts
    glint_radii: PositiveFloat = 3.6  # a spot this near, in radii of the stronger one, ...
    glint_ratio: PositiveFloat = 2.2  # ... with this many times less flux is a glint, ...
    glint_trust: PositiveFloat = 0.5  # ... if the stronger looks like a lamp to this share of how much itself does
    lamps: PositiveFloat = 16.0  # of a kind in view; more spots than that of one kind share the probability
    prominent: Fraction = 0.1  # of the brightest; for spots with more flux a crowd says nothing
    kin: PositiveFloat = 3.0  # spots are of a kind whose fluxes are within this factor
    flux_range: PositiveFloat = 300.0  # of the lamps in one view; a spot fainter than that by the brightest is none
    memory_s: PositiveFloat = 0.25  # an older frame says nothing of which spots are steady
    drift_px_s: PositiveFloat = 400.0  # a lamp moves no faster over the picture, or counts as new


class LabelConfig(Section):
    """Front or rear by colour: the rear lights are blue, the front ones white."""

    gamma: PositiveFloat = 2.2  # of the camera; ratios of colours mean something only in linear light
    clear_px: PositiveFloat = 3.0  # beyond a saturated core's edge, where clipping and demosaicing make it white
    ring: tuple[PositiveFloat, PositiveFloat] = (1.5, 6.0)  # its colour is read up to this many radii + px
    min_reach_px: PositiveFloat = 2.0  # other spots are read whole, small ones to here
    blue_ratio: PositiveFloat = 1.2  # blue over the larger of green and red, where both layers are as likely
    softness: PositiveFloat = 0.2  # of the logarithm of that ratio, without any noise
    min_signal: PositiveFloat = 3.0  # sigmas of the ring's noise below which nothing is known
    limit: Annotated[float, Field(gt=0.0, lt=0.5)] = 0.03  # p_rear stays this far from 0 and 1


class PriorConfig(Section):
    """Attitude of the camera about head-on where no sensor gives it, 1 sigma."""

    roll_deg: PositiveFloat = 10.0
    pitch_deg: PositiveFloat = 15.0
    yaw_deg: PositiveFloat = 15.0


class MatchConfig(Section):
    """Cold start: the evidence and the decision."""

    noise_px: NoisePx = 0.5  # of a centre that comes without a covariance
    doubtful_share: Fraction = 0.5  # 1 sigma, of its radius, of the centroid of a detection that is surely no lamp
    detect: Annotated[float, Field(gt=0, lt=1)] = 0.8  # probability that a light in view is detected
    layer_absent: Annotated[float, Field(gt=0, lt=1)] = 0.3  # that a layer is not seen at all
    steady: Annotated[float, Field(ge=0, lt=1)] = 0.7  # share of vehicles that hold head-on better than the prior ...
    steadier: PositiveFloat = 7.0  # ... by this factor; without an attitude sensor
    label_trust: Fraction = 0.6  # p_rear counts this much; a label of 0.95 becomes 0.77
    spurious: PositiveFloat = 5.0  # mean number of spurious spots
    clutter_near: Fraction = 0.02  # share of spurious spots that stand as close as the detections do
    clutter_margin_px: PositiveFloat = 100.0
    gate: PositiveFloat = 18.4  # chi-square, 2 dof, 1e-4
    pair_gate: PositiveFloat = 11.8  # of a light that two others and the attitude prior place; 2 dof, 0.3 %
    bend: PositiveFloat = 0.7  # a tilt of variance s foreshortens by this times s, 1 sigma
    roll_gate: PositiveFloat = 3.3  # sigma of the prior
    near_m: PositiveFloat = 0.3
    far_m: PositiveFloat = 40.0  # of a light
    hypotheses: Hypotheses = 64
    least_detections: PositiveInt = 16  # of more detections only the likeliest lamps are looked at, ...
    detections_per_light: PositiveInt = 2  # ... so many, or this times the station's lights
    max_pairs: Pairs = 40_000  # pairs looked at in a frame, some 1.5 us each; a frame that wants more is refused
    log_dock: float = 2.0  # log prior odds that the dock is in view at all
    max_detections_three: PositiveInt = 14  # among more, three lights of a layer say nothing
    sure: PositiveFloat = 15.0  # log evidence above which three lights of each layer need not be looked for
    margin: PositiveFloat = 6.9  # log odds of the names on one frame, ln 1000
    margin_gathered: PositiveFloat = 9.2  # over frames, or with three lights; of names that one frame alone may prove
    lead: PositiveFloat = 3.5  # log odds by which a naming gathered over frames must lead in the last one alone
    extra: PositiveFloat = 7.5  # log odds of a name that a lock does not need
    prune: PositiveFloat = 5.0  # log odds below which a single name is dropped in any case
    keep: PositiveFloat = 14.0  # candidates this far below the best are forgotten
    log_mirror: float = -8.1  # log prior of seeing the mirror image alone


class TrackConfig(Section):
    """The filter with history."""

    accel_m_s2: Annotated[float, Field(ge=0.01, le=100.0)] = (
        0.3  # white noise on the twist: what a second adds to it, 1 sigma
    )
    accel_rad_s2: Annotated[float, Field(ge=0.002, le=100.0)] = 0.05
    start_m_s: PositiveFloat = 1.5  # 1 sigma of the unknown twist at the start
    start_rad_s: PositiveFloat = 0.15
    gate: PositiveFloat = 18.4  # chi-square, 2 dof, 1e-4
    reach: PositiveFloat = 10.0  # log evidence; associations farther behind the best are not followed
    max_nodes: Pairs = 100_000  # of the association's search, 0.1 us each; a track that wants more is dropped
    log_appear: float = -6.9  # log prior that a layer comes into view in one frame
    proven_m: Annotated[float, Field(ge=1e-6, le=0.05)] = (
        0.01  # a light that all others predict to this, 1 sigma, is proven by geometry: glints
    )
    # stand 2 cm and more beside the lamps
    max_gap_s: Age = 2.0  # without lights; after it only survey and calibration are kept
    max_deviate: Annotated[float, Field(ge=2.0, le=8.0)] = (
        4.0  # of one frame's innovation, as a standard normal deviate
    )
    max_mean_deviate: Annotated[float, Field(ge=2.0, le=8.0)] = 3.5  # of its running mean
    deviate_memory: Fraction = 0.8  # of that mean, a frame
    hypotheses: Hypotheses = 32  # poses or associations followed side by side
    forget: PositiveFloat = 16.0  # log odds at which one is given up


class IntegrityConfig(Section):
    """When a pose may be used."""

    risk: Risk = 1e-6  # of a frame
    fault: Annotated[float, Field(ge=1e-6, le=0.1)] = (
        1e-3  # prior probability that an associated light is wrong, until geometry has proven it
    )
    fault_proven: Annotated[float, Field(ge=1e-7, le=0.1)] = 2e-6  # afterwards; so often in campaigns of proven tracks
    evidence: Annotated[float, Field(ge=4.6, le=1e3)] = (
        13.8  # log odds that stand for the risk, where too few lights can check each other
    )
    carried_frames: Annotated[int, Field(ge=2, le=10_000)] = (
        2  # frames of four lights or more in a row that stand for it as well
    )
    gathered_frames: PositiveInt = 15  # the same for names that no single frame could decide
    thin_frames: Annotated[int, Field(ge=1, le=30)] = (
        3  # in a row held by fewer than four lights, after which a fresh acquisition must agree
    )
    max_age_s: Age = 0.3  # of the last light


class Config(Section):
    """Everything; saved with every run."""

    paper: PaperConfig = PaperConfig()
    prior: PriorConfig = PriorConfig()
    match: MatchConfig = MatchConfig()
    track: TrackConfig = TrackConfig()
    integrity: IntegrityConfig = IntegrityConfig()
    detect: DetectConfig = DetectConfig()
    label: LabelConfig = LabelConfig()


def load_config(path: Path) -> Config:
    """Read a configuration file; what it does not name keeps its default. Raises: InputError, one line."""
    return validate(Config, read_mapping(path), str(path))
