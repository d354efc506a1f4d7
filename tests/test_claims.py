import numpy as np
import pytest
from conftest import assert_close, transforms
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from scipy.spatial.transform import Rotation

from lumidock.alert_limits import DEFAULT_ALERT_LIMITS
from lumidock.config import FilesConfig
from lumidock.evaluation.claims import (
    GuideClaims,
    PoseClaims,
    consistency,
    continuity,
    hazardous,
    nees,
    nees_in_words,
    over_level,
    pose_error,
    stanford,
    stanford_of,
    true_guide,
)

UNKNOWN = np.nan
SECOND = 10**9


def spread(rng, sigmas):
    """A covariance with these sigmas and correlations of every sign."""
    A = rng.normal(size=(len(sigmas), 2 * len(sigmas)))
    P = A @ A.T
    scale = np.array(sigmas) / np.sqrt(np.diag(P))
    return P * np.outer(scale, scale)


def claims(*rows, covariance=None, stage=None):
    """Poses of rows (z, ex, ey, ez, angle about x in deg, levels lateral m, axial m, angle deg)."""
    table = np.array(rows, float).reshape(-1, 8)
    errors = np.zeros((len(table), 6))
    errors[:, :3], errors[:, 3] = table[:, 1:4], np.deg2rad(table[:, 4])
    covariance = np.full((len(table), 6, 6), np.nan) if covariance is None else covariance
    stage = stage or ["front"] * len(table)
    return PoseClaims(table[:, 0], errors, table[:, 5:] * [1, 1, np.pi / 180], covariance, stage, DEFAULT_ALERT_LIMITS)


def guides(*rows):
    """Guides of rows (claimed bearing x deg, y deg, range m, true ones, levels bearing deg, range m)."""
    table = np.array(rows, float).reshape(-1, 8)
    table[:, [0, 1, 3, 4, 6]] *= np.pi / 180
    return GuideClaims(table[:, :3], table[:, 3:6], table[:, 6:], DEFAULT_ALERT_LIMITS)


@given(transforms(), st.integers(0, 2**32 - 1))
def test_the_error_is_that_of_the_contract(T_dock_cam, seed):
    e = np.random.default_rng(seed).normal(size=6) * [3, 3, 3, 0.5, 0.5, 0.5]
    estimated = np.eye(4)
    estimated[:3, 3] = T_dock_cam[:3, 3] + e[:3]
    estimated[:3, :3] = Rotation.from_rotvec(e[3:]).as_matrix() @ T_dock_cam[:3, :3]
    assert_close(pose_error(estimated, T_dock_cam), e, atol=1e-9)


@given(transforms())
def test_the_guide_is_that_of_the_contract(T_dock_cam):
    x, y, z = np.linalg.inv(T_dock_cam)[:3, 3]
    assert_close(true_guide(T_dock_cam), [np.arctan2(x, z), np.arctan2(y, z), np.hypot(np.hypot(x, y), z)], atol=1e-6)


# Covariances


@pytest.mark.parametrize(("swollen", "wanted"), [(1.0, 6.0), (4.0, 1.5), (0.25, 24.0)])
def test_an_honest_covariance_has_a_nees_of_six(rng, swollen, wanted):
    P = spread(rng, [2.0, 0.5, 0.01, 1e-3, 0.05, 0.1])
    errors = rng.multivariate_normal(np.zeros(6), P, 20_000)
    squares = nees(errors, np.broadcast_to(swollen * P, (20_000, 6, 6)))
    assert_close(squares.mean() * swollen, 6.0, atol=4.0 * np.sqrt(12 / 20_000))
    assert_close(squares.mean(), wanted, atol=0.1 * wanted)


def test_each_error_meets_its_own_covariance(rng):
    covariances = np.array([spread(rng, 10.0 ** rng.uniform(-4, 1, 6)) for _ in range(50)])
    errors = rng.normal(size=(50, 6))
    wanted = [e @ np.linalg.solve(P, e) for e, P in zip(errors, covariances, strict=True)]
    assert_close(nees(errors, covariances) / wanted, 1.0, atol=1e-6)


IMPROPER = {
    "zero": np.zeros((6, 6)),
    "negative variance": np.diag([1.0, 1, 1, 1, 1, -1]),
    "correlation of one": np.ones((6, 6)),
    "correlation over one": np.eye(6) + 2 * np.eye(6)[::-1],
}


@pytest.mark.parametrize("P", IMPROPER.values(), ids=IMPROPER)
def test_what_is_no_covariance_is_counted_apart(P):
    rows = [[9, 1, 0, 0, 0, *[UNKNOWN] * 3]] * 3
    poses = claims(*rows, covariance=np.array([np.eye(6), P, np.full((6, 6), np.nan)]))
    found = nees(poses.errors, poses.covariance)
    assert_close(found, [1.0, np.nan, np.nan])
    counted = consistency(poses)
    assert counted == {"frames": 1, "mean": 1.0, "improper": 1, "by_stage": {"front": {"frames": 1, "mean": 1.0}}}


def test_words_on_nees_give_the_range_of_one_docking():
    low, high = stats.chi2.ppf([0.025, 0.975], 6)
    assert f"{low:.1f} to {high:.1f} in 19 of 20" in nees_in_words(7.0)[0]
    assert [len(nees_in_words(mean)) for mean in (0.5 * low, 5.9, 6.1, 0.99 * high, 1.01 * high)] == [2, 2, 1, 1, 2]
    config = FilesConfig()
    assert f"{100 * config.layer_m:g} cm" in nees_in_words(3.0)[1]
    assert f"{100 * config.focal:g} %" in nees_in_words(3.0)[1]
    assert "too small" in nees_in_words(20.0)[1]


def test_the_nees_has_a_mean_for_each_stage():
    rows = [[9, e, 0, 0, 0, *[UNKNOWN] * 3] for e in (1, 2, 3)]
    unknown = np.full((6, 6), np.nan)
    covariance = np.array([np.eye(6)] * 3 + [unknown])
    poses = claims(*rows, [9, 9, 9, 9, 0, *[UNKNOWN] * 3], covariance=covariance, stage=["front", "rear", "rear", "x"])
    found = consistency(poses)
    assert (found["frames"], found["improper"]) == (3, 0)
    assert_close(found["mean"], 14 / 3)
    assert found["by_stage"] == {"front": {"frames": 1, "mean": 1.0}, "rear": {"frames": 2, "mean": 6.5}}
    assert consistency(claims()) == {"frames": 0, "mean": None, "improper": 0, "by_stage": {}}


# Alert limits


LIMITS = {  # one frame each: z, errors x, y, z m, angle deg, levels; which kinds are over
    "within all": ([1.0, 0.17, 0.24, 0.29, 4.9, 0.1, 0.1, 1.0], ""),
    "lateral by both axes": ([1.0, 0.2, 0.23, 0.0, 0.0, 0.1, 0.1, 1.0], "lateral"),
    "axial downward": ([1.0, 0.0, 0.0, -0.31, 0.0, 0.1, 0.1, 1.0], "axial"),
    "angle": ([1.0, 0.0, 0.0, 0.0, 5.1, 0.1, 0.1, 1.0], "angle"),
    "inside the dock": ([-3.0, 0.31, 0.0, 0.0, 0.0, 0.1, 0.1, 1.0], "lateral"),
    "to 5 m": ([4.8, 0.49, 0.0, 0.49, 4.9, 0.1, 0.1, 1.0], ""),
    "to 12 m": ([11.0, 0.99, 0.0, 0.99, 7.9, 0.1, 0.1, 1.0], ""),
    "beyond, a tenth": ([20.0, 1.98, 0.0, 1.98, 9.9, 0.1, 0.1, 1.0], ""),
    "beyond, over a tenth": ([20.0, 2.01, 0.0, 2.01, 10.1, 0.1, 0.1, 1.0], "lateral axial angle"),
    "strictest over the axial level": ([13.0, 1.1, 0.0, 1.1, 8.5, 0.1, 1.5, 1.0], "lateral axial angle"),
    "a tenth of the near end": ([20.0, 1.85, 0.0, 0.0, 0.0, 0.1, 2.0, 1.0], "lateral"),
    "no level": ([13.0, 1.2, 0.0, 1.2, 8.5, UNKNOWN, UNKNOWN, UNKNOWN], ""),
}


@pytest.mark.parametrize(("row", "wanted"), LIMITS.values(), ids=LIMITS)
def test_a_pose_is_hazardous_over_its_alert_limit(row, wanted):
    found = hazardous(claims(row))
    assert found.pop("any") == bool(wanted)
    assert found == {name: int(name in wanted.split()) for name in ("lateral", "axial", "angle")}


def test_a_frame_with_two_errors_is_hazardous_once():
    over, good = [1.0, 0.5, 0.0, 0.5, 0.0, 0.1, 0.1, 1.0], [1.0, *[0.0] * 4, 0.1, 0.1, 1.0]
    assert hazardous(claims(over, good, over)) == {"any": 2, "lateral": 2, "axial": 2, "angle": 0}
    assert hazardous(claims()) == {"any": 0, "lateral": 0, "axial": 0, "angle": 0}


GUIDE_LIMITS = {  # claimed bearings deg and range m, true ones, levels; which kinds are over
    "within both": ([1.0, -1.0, 20.0, 0.0, 0.0, 21.9, 1, 1], ""),
    "bearing by both angles": ([1.1, -1.1, 20.0, 0.0, 0.0, 20.0, 1, 1], "bearing"),
    "range too far": ([0.0, 0.0, 20.0, 0.0, 0.0, 17.9, 1, 1], "range"),
    "range near": ([0.0, 0.0, 3.01, 0.0, 0.0, 3.33, 1, 1], "range"),
    "near enough": ([0.0, 0.0, 2.9, 40.0, 0.0, 9.0, 1, 1], ""),
    "claimed behind the camera": ([170.0, 5.0, 20.0, 0.0, 0.0, 9.0, 1, 1], ""),
    "truly behind the camera": ([0.0, 0.0, 20.0, 180.0, 0.0, 20.0, 1, 1], "bearing"),
    "no level": ([2.0, 0.0, 20.0, 0.0, 0.0, 20.0, UNKNOWN, UNKNOWN], "bearing"),
}


@pytest.mark.parametrize(("row", "wanted"), GUIDE_LIMITS.values(), ids=GUIDE_LIMITS)
def test_a_guide_is_hazardous_over_its_alert_limit(row, wanted):
    found = hazardous(guides(row))
    assert found.pop("any") == bool(wanted)
    assert found == {name: int(name in wanted.split()) for name in ("bearing", "range")}


def test_a_bearing_goes_round():
    assert_close(guides([179.5, 0, 9, -179.5, 0, 9, 1, 1]).sizes(), [[np.deg2rad(1.0), 0.0]])


# Protection levels


def test_errors_over_their_levels_are_counted_where_there_is_a_level():
    poses = claims(
        [9, 0.3, 0.4, 0.2, 1.0, 0.49, 0.21, 0.9],
        [9, 0.3, 0.4, 0.2, 1.0, 0.51, 0.19, 1.1],
        [9, 9.0, 9.0, 9.0, 9.0, UNKNOWN, UNKNOWN, UNKNOWN],
    )
    assert over_level(poses) == {name: {"frames": 2, "over": 1} for name in ("lateral", "axial", "angle")}
    found = over_level(guides([1, 0, 9, 0, 0, 8, 0.9, 1.1], [1, 0, 9, 0, 0, 8, UNKNOWN, 0.9]))
    assert found == {"bearing": {"frames": 1, "over": 1}, "range": {"frames": 2, "over": 1}}
    assert over_level(claims())["angle"] == {"frames": 0, "over": 0}


def region(error, level, limit):
    """The region of one frame in the Stanford diagram."""
    if not level <= limit:
        return "unavailable"
    if error > limit:
        return "hazardous"
    return "misleading" if error > level else "nominal"


triples = st.tuples(st.sampled_from([0.0, 1.0, 2.0, 3.0]), *[st.sampled_from([0.0, 1.0, 2.0, 3.0, np.nan, np.inf])] * 2)


@given(st.lists(triples))
def test_every_frame_is_in_one_region_of_the_stanford_diagram(frames):
    found = stanford(*np.array(frames).reshape(-1, 3).T)
    regions = [region(*frame) for frame in frames]
    assert found == {name: regions.count(name) for name in ("nominal", "misleading", "hazardous", "unavailable")}


def test_a_frame_without_a_pose_is_unavailable():
    poses = claims(
        [1, 0.10, 0, 0.10, 1, 0.20, 0.05, 2],
        [1, 0.40, 0, 0.01, 6, 0.20, 0.05, 7],
    )
    assert stanford_of(poses, 5) == {
        "lateral": {"nominal": 1, "misleading": 0, "hazardous": 1, "unavailable": 3},
        "axial": {"nominal": 1, "misleading": 1, "hazardous": 0, "unavailable": 3},
        "angle": {"nominal": 1, "misleading": 0, "hazardous": 0, "unavailable": 4},
    }


def test_an_honest_level_is_exceeded_as_often_as_it_says(rng):
    e = rng.normal(size=(100_000, 6)) * [0.1, 0.1, 0.2, 0.01, 0.01, 0.01]
    level = 0.1 * np.sqrt(-2.0 * np.log(0.01))  # of a Rayleigh distribution, once in a hundred
    levels = np.tile([level, 10.0, 10.0], (len(e), 1))
    poses = PoseClaims(
        np.full(len(e), 20.0), e, levels, np.full((len(e), 6, 6), np.nan), ["front"] * len(e), DEFAULT_ALERT_LIMITS
    )
    assert_close(over_level(poses)["lateral"]["over"], 1000, atol=4 * np.sqrt(1000))


# Continuity


@pytest.mark.parametrize(
    ("t_ns", "longest", "long"),
    [
        ([], None, 0),
        ([5], None, 0),
        ([0, 450_000_000], 0.45, 0),
        ([0, 450_000_001, 500_000_000, 2 * SECOND], 1.5, 2),
        ([1795368000 * SECOND, 1795368000 * SECOND + 450_000_001], 0.450000001, 1),
    ],
)
def test_gaps_are_measured_between_usable_frames(t_ns, longest, long):
    found = continuity(t_ns)
    assert found["long_gaps"] == long
    assert (found["longest_gap_s"] is None) == (longest is None)
    assert longest is None or abs(found["longest_gap_s"] - longest) < 1e-12


@pytest.mark.parametrize("name", ["errors", "levels", "covariance"])
def test_claims_of_unequal_length_are_refused(name):
    fields = {"errors": np.zeros((2, 6)), "levels": np.zeros((2, 3)), "covariance": np.zeros((2, 6, 6))}
    with pytest.raises(ValueError, match=f"{name} has shape"):
        PoseClaims(
            z_m=np.zeros(2), stage=["front"] * 2, alert_limits=DEFAULT_ALERT_LIMITS, **fields | {name: fields[name][:1]}
        )
