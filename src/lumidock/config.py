"""Every tunable number of lumidock, with its unit and where it comes from. Frozen; unknown keys are refused."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, NonNegativeInt, PositiveFloat, PositiveInt

from lumidock.yamlfile import read_mapping, validate

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
    max_spots: PositiveInt = 200  # a frame with more is refused: `too_many`
    max_lights: PositiveInt = 40  # of a layer; the ratio filter looks at all triples
    btekf: BtekfConfig = BtekfConfig()
    pose: PoseConfig = PoseConfig()


class Config(Section):
    """Everything; saved with every run."""

    paper: PaperConfig = PaperConfig()


def load_config(path: Path) -> Config:
    """Read a configuration file; what it does not name keeps its default. Raises: InputError, one line."""
    return validate(Config, read_mapping(path), str(path))
