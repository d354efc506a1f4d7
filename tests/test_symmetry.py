"""Arrays that fall onto themselves: built with a symmetry, turned, moved and spoiled; and the estimator before them."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import assert_close
from tracks import CAMERA, STATION

from lumidock.datatypes import Attitude, Detections
from lumidock.evaluation import claims
from lumidock.evaluation.symmetry import self_fits, unsafe_roll_rad
from lumidock.localizer import Localizer
from lumidock.pose import project_lights

WITHIN_M = 0.06


def flat(xy, layers=("front",), layer=None):
    """A dock of lights at `xy` (n, 2) in the entrance plane."""
    xy = np.asarray(xy, float)
    n = len(xy)
    return replace(
        STATION,
        ids=tuple(f"L{k}" for k in range(n)),
        layers=layers,
        layer=np.zeros(n, np.int64) if layer is None else np.asarray(layer),
        p_dock=np.column_stack([xy, np.zeros(n)]),
        color=("white",) * n,
        axis=np.tile([0.0, 0.0, 1.0], (n, 1)),
        beam_deg=np.full(n, 120.0),
        power_w=np.full(n, 2.0),
        **({} if not isinstance(STATION.sigma_light_m, np.ndarray) else {"sigma_light_m": np.full(n, 0.002)}),
    )


def ring(n, radius=1.0):
    angle = 2.0 * np.pi * np.arange(n) / n
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def angles_deg(fits, kind):
    return sorted({round(np.degrees(one.angle_rad)) % 360 for one in fits if one.kind == kind})


@pytest.mark.parametrize("n", [4, 5, 6, 8, 12])
def test_a_regular_ring_fits_itself_at_every_step_and_in_as_many_mirrors(n, rng):
    fits = self_fits(flat(ring(n) + rng.normal(0, 0.003, (n, 2))), WITHIN_M)
    steps = [round(360 * k / n) for k in range(1, n)]
    assert angles_deg(fits, "rotation") == pytest.approx(steps, abs=1.1)
    assert len(angles_deg(fits, "mirror")) == n
    assert_close(unsafe_roll_rad(fits, 0.013), np.pi / n, atol=0.02)


def test_a_row_of_equal_steps_fits_itself_moved():
    grid = np.array([[x, y] for x in range(5) for y in (0.0, 1.3)]) * 0.4
    shifts = [one for one in self_fits(flat(grid), WITHIN_M) if one.kind == "shift"]
    assert_close(min(one.shift_m for one in shifts), 0.4, atol=1e-9)


def test_each_layer_is_only_taken_for_itself():
    two = np.concatenate([ring(4), ring(4, 0.999)[[1, 2, 3, 0]] * [[1.0, 0.4]]])
    fits = self_fits(flat(two, ("front", "rear"), [0] * 4 + [1] * 4), WITHIN_M)
    assert angles_deg(fits, "rotation") == [180]  # the second layer, a narrow rhomb, has only this one


def test_an_array_without_symmetry_fits_nowhere_else(rng):
    assert self_fits(STATION, WITHIN_M) == []
    assert unsafe_roll_rad([], WITHIN_M) is None
    spoiled = ring(8) + rng.uniform(-0.25, 0.25, (8, 2))
    assert unsafe_roll_rad(self_fits(flat(spoiled), WITHIN_M), 0.013) is None


def rolled(roll_deg, z_m):
    """Pose T_dock_cam (4, 4) on the dock's axis, rolled."""
    c, s = np.cos(np.radians(roll_deg)), np.sin(np.radians(roll_deg))
    T_dock_cam = np.diag([1.0, -1.0, -1.0, 1.0]) @ np.block(
        [[np.array([[c, -s], [s, c]]), np.zeros((2, 2))], [np.zeros((2, 2)), np.eye(2)]]
    )
    T_dock_cam[:3, 3] = 0.2, -0.1, z_m
    return T_dock_cam


def approach(station, roll_deg, rng, *, z_m=9.0, frames=25, attitude=False):
    """Fixes of a slow approach and their true poses."""
    localizer, made = Localizer(station, CAMERA), []
    for k in range(frames):
        T_dock_cam = rolled(roll_deg, z_m - 0.05 * k)
        uv = project_lights(CAMERA, T_dock_cam, station.p_dock)
        detections = Detections.from_uv(str(k), k * 66_000_000, uv + rng.normal(0.0, 0.3, uv.shape))
        if attitude:
            detections = replace(detections, attitude=Attitude(T_dock_cam[:3, :3], 0.03))
        made.append((localizer.process_detections(detections), T_dock_cam))
    return made


@pytest.mark.parametrize("n", [4, 8])
@pytest.mark.parametrize("roll_deg", [0, 45, 90, 130, 180])
def test_before_a_ring_of_any_roll_no_pose_is_valid_and_it_is_ambiguous(n, roll_deg, rng):
    made = approach(flat(ring(n)), roll_deg, rng, frames=8)
    assert not any(fix.valid for fix, _ in made)
    assert made[-1][0].reason == "ambiguous"
    assert len(made[-1][0].alternatives) >= 2


def test_an_attitude_sensor_tells_the_roll_of_a_ring(rng):
    made = approach(flat(ring(8)), 130, rng, frames=8, attitude=True)
    errors = [np.abs(claims.pose_error(fix.T_dock_cam, truth)).max() for fix, truth in made if fix.valid]
    assert len(errors) >= 4
    assert max(errors) < 0.2


@pytest.mark.parametrize("roll_deg", [0, 50, 90, 180, -120])
def test_a_dock_without_symmetry_is_found_at_any_roll(roll_deg, rng):
    made = approach(STATION, roll_deg, rng)
    errors = [np.abs(claims.pose_error(fix.T_dock_cam, truth)).max() for fix, truth in made if fix.valid]
    assert len(errors) >= 20
    assert max(errors) < 0.15
