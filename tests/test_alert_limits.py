"""Alert limits: the defaults of the contract, those of a station file, and one by one as all at once."""

import math
from dataclasses import replace

import numpy as np
import pytest
import yaml
from bench.shipped import STATION_FILE
from conftest import assert_close, refused

from lumidock.alert_limits import DEFAULT_ALERT_LIMITS, AlertLimits, Band, GuideLimits
from lumidock.station import load_station

STATION = load_station(STATION_FILE)
STRICT = AlertLimits((Band(2.0, 0.05, 0.1, 0.02), Band(8.0, 0.2, 0.3, 0.05)), GuideLimits(0.01, 0.1, 0.05, 1.0))


@pytest.mark.parametrize(
    ("z_m", "limit_m", "limit_deg"),
    [(-3, 0.3, 5), (1.49, 0.3, 5), (1.5, 0.5, 5), (4.99, 0.5, 5), (5, 1, 8), (11.99, 1, 8), (12, 1.2, 10), (30, 3, 10)],
)
def test_the_defaults_are_the_contracts(z_m, limit_m, limit_deg):
    assert_close(DEFAULT_ALERT_LIMITS.of_pose(z_m, 0.0), (limit_m, limit_m, math.radians(limit_deg)))
    assert STATION.alert_limits == DEFAULT_ALERT_LIMITS


@pytest.mark.parametrize("limits", [DEFAULT_ALERT_LIMITS, STRICT])
def test_limits_are_the_same_one_by_one_and_do_not_fall_with_distance(limits, rng):
    z, axial = rng.uniform(-4, 35, 500), rng.exponential(0.5, 500)
    found = limits.of_poses(z, axial)
    assert_close([limits.of_pose(a, b) for a, b in zip(z, axial, strict=True)], found)
    assert (np.diff(found[np.argsort(z - axial)], axis=0) >= 0).all()
    inside = z[:, None] + axial[:, None] * np.linspace(-1, 1, 21)  # the strictest limit anywhere in z +- level
    assert_close(limits.of_poses(inside, np.zeros_like(inside)).min(axis=1), found)


@pytest.mark.parametrize("limits", [DEFAULT_ALERT_LIMITS, STRICT])
def test_guide_limits_are_the_same_one_by_one(limits, rng):
    guide = np.column_stack([rng.uniform(-3, 3, (300, 2)), rng.uniform(0.1, 30, 300)])
    for (x, y, range_m), found in zip(guide, limits.of_guides(guide), strict=True):
        has_own = limits.applies_to_guide(x, range_m) and abs(y) < math.pi / 2
        assert_close(found, limits.of_guide(range_m) if has_own else (math.inf, math.inf))


def test_what_is_not_a_number_is_inside_no_limit():
    assert not DEFAULT_ALERT_LIMITS.of_pose(math.nan, 0.0)[0] > 0.0
    assert not DEFAULT_ALERT_LIMITS.of_pose(20.0, math.nan)[0] > 0.0


@pytest.mark.parametrize(("extent_m", "scale"), [(0.8, 0.4), (1.0, 0.5), (2.0, 1.0), (7.0, 1.0)])
def test_the_guide_of_a_small_dock_reaches_nearer(extent_m, scale):
    guide = GuideLimits().for_dock(extent_m)
    assert_close((guide.range_m, guide.from_m), (0.3 * scale, 3.0 * scale))
    assert (guide.bearing_rad, guide.range_share) == (math.radians(1.5), 0.1)


def station_with(tmp_path, scale=1.0, **more):
    content = yaml.safe_load(STATION_FILE.read_text()) | more
    for light in content["lights"]:
        light["position"] = [scale * x for x in light["position"]]
    (tmp_path / "station.yaml").write_text(yaml.safe_dump(content))
    return load_station(str(tmp_path / "station.yaml"))


def test_a_small_station_has_scaled_guide_limits_and_the_same_for_poses(tmp_path):
    station = station_with(tmp_path, scale=0.35)
    extent = max(np.linalg.norm(a - b) for a in station.p_dock[:7] for b in station.p_dock[:7])
    assert_close(station.alert_limits.guide.from_m, 3.0 * extent / 2.0)
    assert station.alert_limits.bands == DEFAULT_ALERT_LIMITS.bands


def test_a_station_file_replaces_the_limits(tmp_path):
    bands = [
        {"below_z_m": 2.0, "lateral_m": 0.05, "axial_m": 0.1, "angle_deg": math.degrees(0.02)},
        {"below_z_m": 8.0, "lateral_m": 0.2, "axial_m": 0.3, "angle_deg": math.degrees(0.05)},
    ]
    guide = {"guide": {"bearing_deg": math.degrees(0.01), "range_m": 0.1, "range_share": 0.05, "from_m": 1.0}}
    found = station_with(tmp_path, alert_limits=[*bands, guide]).alert_limits
    assert found.as_text() == STRICT.as_text()
    assert_close(found.of_poses(np.arange(30.0), np.zeros(30)), STRICT.of_poses(np.arange(30.0), np.zeros(30)))
    assert station_with(tmp_path, alert_limits=bands).alert_limits.guide == DEFAULT_ALERT_LIMITS.guide
    assert station_with(tmp_path, alert_limits=[guide]).alert_limits.bands == DEFAULT_ALERT_LIMITS.bands
    assert_close(found.of_pose(20.0, 0.0), (2.0, 2.0, math.radians(10.0)))  # beyond, 10 % of z
    assert_close(found.of_pose(1.0, 0.0), (0.05, 0.1, 0.02))


BAND = {"below_z_m": 2.0, "lateral_m": 0.05, "axial_m": 0.1, "angle_deg": 2.0}
WRONG = {
    "falling": ([BAND, BAND | {"below_z_m": 5.0, "lateral_m": 0.01}], "tighter than those nearer"),
    "out of order": ([BAND, dict(BAND)], "has to rise"),
    "two guides": ([{"guide": {}}, {"guide": {}}], "guide is given twice"),
    "no limit": ([BAND | {"lateral_m": 0.0}], "lateral_m"),
    "infinite": ([BAND | {"axial_m": math.inf}], "axial_m"),
    "unknown key": ([BAND | {"lateral": 1.0}], "lateral: unknown key"),
    "no list": (BAND, "alert_limits"),
}


@pytest.mark.parametrize(("limits", "match"), WRONG.values(), ids=WRONG)
def test_limits_that_cannot_be_are_refused(tmp_path, limits, match):
    with refused(tmp_path, match):
        station_with(tmp_path, alert_limits=limits)


def test_bands_are_checked_when_they_are_made():
    with pytest.raises(ValueError, match="at least one band"):
        replace(STRICT, bands=())
