import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import assert_close
from scipy.stats import chi

from lumidock import integrity, track
from lumidock._kernels.tracking.track import FilterState
from lumidock.alert_limits import DEFAULT_ALERT_LIMITS
from lumidock.camera import load_camera
from lumidock.config import Config, IntegrityConfig
from lumidock.datatypes import Guide, Protection
from lumidock.evaluation import claims
from lumidock.geometry import bearing_and_range, se3_exp, se3_inverse
from lumidock.integrity import Bounds, bounds, excess, guide_holds, pose_holds, sigma_factors
from lumidock.model import station_model
from lumidock.station import load_station
from lumidock.track import NO_PLANE, FrameResult, LastSeen, Track

ROOT = Path(__file__).parents[1]
STATION = load_station(ROOT / "src" / "lumidock" / "stations" / "cage-2x2x5.yaml")
CAMERA = load_camera(ROOT / "src" / "lumidock" / "cameras" / "imx264-60deg.yaml")
MODEL = station_model(STATION, CAMERA, Config().match)
M = len(STATION)


def hypothesis(T_dock_cam, P6, *, lights=4, log_weight=0.0, pulled=None):
    """A track that holds `T_dock_cam` possible with the pose covariance `P6` (6, 6)."""
    T_cam_dock = se3_inverse(T_dock_cam)
    x, P = track.calibration_prior(STATION, None)
    P[:6, :6] = P6
    name = np.where(np.arange(M) < lights, np.arange(M), -1)
    R, t = np.ascontiguousarray(T_cam_dock[:3, :3]), np.ascontiguousarray(T_cam_dock[:3, 3])
    last = FrameResult(name, MODEL.count(name), NO_PLANE, 1.0, 0.0)
    seen, state = LastSeen(0, 0, (0, 0)), FilterState(R, t, x, P)
    bank = track.open_bank(MODEL) if pulled is None else pulled
    return Track(0, 0, state, bank, seen, last, log_weight=log_weight, agreeing_frames=2)


def at(z, rng=None):
    """A pose `T_dock_cam` at `z` m, head-on or a little off."""
    T = np.eye(4)
    T[:3, :3], T[2, 3] = np.diag([1.0, -1.0, -1.0]), z
    return T if rng is None else T @ se3_exp(rng.uniform(-1, 1, 6) * [1, 1, 1, 0.1, 0.1, 0.3])


def pose(place):
    """Head-on at `place` (3,) m in the dock."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.diag([1.0, -1.0, -1.0]), place
    return T


def covariance(rng, sigma=(0.01, 0.01, 0.03, 0.002, 0.002, 0.001)):
    """A correlated pose covariance (6, 6), small enough to be linear."""
    A = np.diag(sigma) @ rng.normal(size=(6, 9)) / 3.0
    return A @ A.T


def sizes(T_dock_cam, truth):
    """Lateral m, axial m, angle rad, bearing rad and range m of an error (5,)."""
    e = claims.pose_error(T_dock_cam, truth)
    b = np.array(bearing_and_range(T_dock_cam)) - np.array(bearing_and_range(truth))
    return [math.hypot(e[0], e[1]), abs(e[2]), np.linalg.norm(e[3:]), math.hypot(b[0], b[1]), abs(b[2])]


def levels_of(bound):
    p, g = bound.protection, bound.guide
    return np.array([p.lateral_m, p.axial_m, p.angle_rad, g.pl_bearing_rad, g.pl_range_m])


@pytest.mark.parametrize("risk", [0.5, 0.05, 1e-3, 1e-6, 1e-9])
def test_sigma_factors_are_those_of_the_chi_distribution(risk):
    assert_close(sigma_factors(risk), chi.isf(risk, [1, 2, 3]), atol=1e-6)


@pytest.mark.parametrize("z_m", [1.0, 6.0, 20.0])
def test_levels_hold_as_often_as_they_say(z_m, rng):
    risk, n = 0.01, 8000
    T_dock_cam, P6 = at(z_m, rng), covariance(rng)
    bound = bounds([hypothesis(T_dock_cam, P6)], MODEL, IntegrityConfig(risk=risk))
    draws = rng.multivariate_normal(np.zeros(6), P6, n)
    truths = [se3_inverse(se3_inverse(T_dock_cam) @ se3_exp(xi)) for xi in draws]
    over = np.mean([np.array(sizes(T_dock_cam, truth)) > levels_of(bound) for truth in truths], axis=0)
    slack = 4.0 * math.sqrt(risk / n)
    assert (over <= risk + slack).all(), over
    assert abs(over[[1, 4]] - risk).max() < slack  # in one dimension the level is exact
    assert (over > 0.0).any()
    errors = np.array([claims.pose_error(T_dock_cam, truth) for truth in truths])
    scale = np.sqrt(np.diagonal(bound.covariance))
    assert_close(np.cov(errors.T) / np.outer(scale, scale), bound.covariance / np.outer(scale, scale), atol=0.12)
    assert abs(claims.nees(errors, np.repeat(bound.covariance[None], n, axis=0)).mean() - 6.0) < 0.3


@pytest.mark.parametrize("place", [[0.0, 0.5, 0.08], [0.4, 0.01, 0.09], [0.02, 0.01, 0.0], [0.3, 0.02, -0.08]])
def test_bearings_beside_the_origin_are_bounded(place, rng):
    T_cam_dock = se3_inverse(pose(place))
    level = bounds([hypothesis(pose(place), np.eye(6) * 0.02**2)], MODEL, IntegrityConfig()).guide.pl_bearing_rad
    x, y, z = (T_cam_dock[:3, 3] + rng.normal(0.0, 0.02, (1_000_000, 3))).T
    off = [
        np.arctan2(a, z) - math.atan2(c, T_cam_dock[2, 3]) for a, c in ((x, T_cam_dock[0, 3]), (y, T_cam_dock[1, 3]))
    ]
    assert np.hypot(*(np.remainder(a + np.pi, 2 * np.pi) - np.pi for a in off)).max() < level


def test_bounds_say_where_the_dock_is(rng):
    T_dock_cam = at(8.0, rng)
    bound = bounds([hypothesis(T_dock_cam, covariance(rng))], MODEL, IntegrityConfig())
    assert_close(bound.T_dock_cam, T_dock_cam, atol=1e-12)
    guide = bound.guide
    expected = bearing_and_range(T_dock_cam)
    assert_close([guide.bearing_x_rad, guide.bearing_y_rad, guide.range_m], expected)


def test_levels_rise_with_the_covariance_and_with_less_risk(rng):
    T_dock_cam, P6 = at(8.0, rng), covariance(rng)
    config = IntegrityConfig()
    plain = levels_of(bounds([hypothesis(T_dock_cam, P6)], MODEL, config))
    assert_close(levels_of(bounds([hypothesis(T_dock_cam, 4.0 * P6)], MODEL, config)), 2.0 * plain, rtol=1e-9)
    more = covariance(rng)
    assert (levels_of(bounds([hypothesis(T_dock_cam, P6 + more)], MODEL, config)) >= plain).all()
    assert (levels_of(bounds([hypothesis(T_dock_cam, P6)], MODEL, IntegrityConfig(risk=1e-7))) > plain).all()


def test_levels_hold_every_other_hypothesis_that_is_not_out_of_the_question(rng):
    config = IntegrityConfig()
    for _ in range(20):
        T_a, T_b = at(8.0, rng), at(9.0, rng)
        a = hypothesis(T_a, covariance(rng))
        near = hypothesis(T_b, covariance(rng), log_weight=-10.0)
        far = replace(near, log_weight=-15.0)  # e^-15 < 1e-6
        wide = levels_of(bounds([a, near], MODEL, config))
        assert (wide[:2] >= np.array(sizes(T_a, T_b))[:2]).all()
        assert wide[2] >= np.linalg.norm(claims.pose_error(T_a, T_b)[3:])
        assert (wide >= levels_of(bounds([near], MODEL, config))).all()
        assert_close(levels_of(bounds([a, far], MODEL, config)), levels_of(bounds([a], MODEL, config)))


def bank_with(light, offset, P6, *, proven=False):
    """A bank in which only the state that is blind to one light has begun: `offset` (6,) off, of covariance `P6`."""
    bank, s = track.open_bank(MODEL), MODEL.group[light]
    bank.begun[s], bank.offset[s, :6] = 1, offset
    bank.P[s] = 0.0
    bank.P[s, :6, :6] = P6
    return bank._replace(used=np.eye(M, dtype=np.int64)[light], proven=np.eye(M, dtype=np.int64)[light] * proven)


@pytest.mark.parametrize("lights", [4, 6, 13])
@pytest.mark.parametrize("proven", [False, True])
def test_levels_reach_the_state_that_never_saw_a_light(lights, proven, rng):
    T_dock_cam, P6, config = at(8.0, rng), covariance(rng), IntegrityConfig()
    apart = np.array([0.05, -0.03, 0.07, 0.001, 0.002, -0.003])  # small: the levels are linear
    T_blind = se3_inverse(se3_inverse(T_dock_cam) @ se3_exp(apart))
    plain = levels_of(bounds([hypothesis(T_dock_cam, P6, lights=lights)], MODEL, config))
    pulled = bank_with(2, apart, 2.0 * P6, proven=proven)
    level = levels_of(bounds([hypothesis(T_dock_cam, P6, lights=lights, pulled=pulled)], MODEL, config))
    assert (level >= plain).all()
    fault = config.fault_proven if proven else config.fault
    without = IntegrityConfig.model_construct(**(config.model_dump() | {"risk": config.risk / fault}))
    alone = levels_of(bounds([hypothesis(T_dock_cam, 2.0 * P6)], MODEL, without))
    assert (level > 0.98 * (np.array(sizes(T_dock_cam, T_blind)) + alone)).all()


def test_a_light_that_cannot_be_left_out_leaves_no_level(rng):
    pulled = bank_with(1, np.zeros(6), np.full((6, 6), np.nan))
    bound = bounds([hypothesis(at(8.0, rng), covariance(rng), lights=7, pulled=pulled)], MODEL, IntegrityConfig())
    assert not np.isfinite(levels_of(bound)).any()
    assert not pose_holds(bound, DEFAULT_ALERT_LIMITS)
    assert not guide_holds(bound, DEFAULT_ALERT_LIMITS)


def bound_of(z, lateral=0.01, axial=0.01, angle=0.01, bearing=0.001, distance=0.01, *, x=0.0):
    T = at(z)
    T[0, 3] = x
    guide = Guide(*bearing_and_range(T), bearing, distance)
    return Bounds(T, np.eye(6), Protection(lateral, axial, angle), guide)


def test_the_level_over_its_limit_by_the_largest_factor_is_named():
    limit_m, _, limit_rad = DEFAULT_ALERT_LIMITS.of_pose(4.0, 0.0)
    assert excess(bound_of(4.0), DEFAULT_ALERT_LIMITS) is None
    found = excess(bound_of(4.0, lateral=2.0 * limit_m, angle=3.0 * limit_rad), DEFAULT_ALERT_LIMITS)
    assert (found.of, found.limit, found.factor) == ("angle", limit_rad, pytest.approx(3.0))


@pytest.mark.parametrize("z_m", [0.5, 2.0, 6.0, 20.0])
def test_a_pose_holds_only_inside_all_its_limits(z_m):
    limit_m, _, limit_rad = DEFAULT_ALERT_LIMITS.of_pose(z_m, 0.0)
    assert pose_holds(bound_of(z_m), DEFAULT_ALERT_LIMITS)
    assert not pose_holds(bound_of(z_m, lateral=limit_m), DEFAULT_ALERT_LIMITS)
    assert not pose_holds(bound_of(z_m, axial=1.01 * limit_m), DEFAULT_ALERT_LIMITS)
    assert not pose_holds(bound_of(z_m, angle=limit_rad), DEFAULT_ALERT_LIMITS)
    assert not pose_holds(bound_of(z_m, axial=math.nan), DEFAULT_ALERT_LIMITS)
    assert not pose_holds(bound_of(z_m, angle=math.inf), DEFAULT_ALERT_LIMITS)


def test_a_guide_from_afar_has_its_own_limits():
    assert guide_holds(bound_of(20.0, lateral=9.0, axial=9.0, angle=9.0), DEFAULT_ALERT_LIMITS)
    assert guide_holds(bound_of(20.0, bearing=0.99 * math.radians(1.5), distance=1.8), DEFAULT_ALERT_LIMITS)
    assert not guide_holds(bound_of(20.0, bearing=math.radians(1.5)), DEFAULT_ALERT_LIMITS)
    assert not guide_holds(bound_of(20.0, distance=1.82), DEFAULT_ALERT_LIMITS)  # a tenth of the near end, 18.18 m
    assert not guide_holds(bound_of(20.0, bearing=math.nan), DEFAULT_ALERT_LIMITS)
    assert guide_holds(bound_of(3.2, distance=0.15), DEFAULT_ALERT_LIMITS)


@pytest.mark.parametrize("angle", [0.01, 0.2])
@pytest.mark.parametrize("z_m", [-2.5, 0.1, 1.0, 2.9])
def test_a_guide_near_the_dock_holds_as_the_pose_does(z_m, angle):
    bound = bound_of(z_m, angle=angle, bearing=9.0, distance=0.0)
    assert (
        guide_holds(bound, DEFAULT_ALERT_LIMITS) == pose_holds(bound, DEFAULT_ALERT_LIMITS) == (angle < math.radians(5))
    )
    # a far guide whose range may end near the dock is near
    assert guide_holds(bound_of(3.5, angle=angle, distance=0.6), DEFAULT_ALERT_LIMITS) == (angle < math.radians(5))


@pytest.mark.parametrize(
    ("lights", "stage"),
    [((), None), ((0, 1, 2), "front"), ((7, 8), "rear"), ((0, 12), "transition"), (tuple(range(M)), "transition")],
)
def test_stage_is_what_the_pose_rests_on(lights, stage):
    name = np.full(M, -1, np.int64)
    name[list(lights)] = np.arange(len(lights))
    one = hypothesis(at(8.0), np.eye(6))
    last = replace(one.last, assignment=name, count=MODEL.count(name))
    assert integrity.stage(replace(one, last=last), MODEL) == stage
