"""The vehicle's own sensors in the filter: exact against independent oracles, left out when they lie."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from tracks import CAMERA, STATION, frames_of

from lumidock import AidingMeasurement, Config, DataError, Localizer, aiding, sensor_models, track
from lumidock._kernels.tracking import track as kernel
from lumidock._kernels.tracking.aiding import SensorRows, SensorRules, update_by_sensor
from lumidock._kernels.tracking.track import LIGHTS, TWIST, FilterState
from lumidock.geometry import so3_exp
from lumidock.model import station_model

CONFIG = Config()
MODEL = station_model(STATION, CAMERA, CONFIG.match)
N = LIGHTS + 3 * len(STATION)
SLOW = ("path.speed_m_s=0.35", "path.speed_spread_m_s=0", "path.start_z_m=9", "path.end_z_m=0.2")


def track_at(rng) -> track.Track:
    """A wide track of a random state, with one state of the bank begun for each of two lights and a sensor."""
    A = rng.normal(size=(N + sensor_models.ERRORS, N + sensor_models.ERRORS)) * 0.02
    R = np.diag([1.0, -1.0, -1.0]) @ so3_exp(rng.normal(size=3) * 0.1)
    state = FilterState(R, np.array([0.2, -0.1, 4.0]), rng.normal(size=N + sensor_models.ERRORS) * 0.05, A @ A.T)
    bank = track.open_bank(MODEL, N + sensor_models.ERRORS, track.SENSORS)
    for s in (0, 3, len(bank.begun) - track.SENSORS):
        B = rng.normal(size=A.shape) * 0.02
        bank.begun[s], bank.offset[s], bank.P[s] = 1, rng.normal(size=len(A)) * 0.01, B @ B.T
    seen = track.LastSeen(0, 0, (0,) * MODEL.n_layers)
    return track.Track(0, 0, state, bank, seen, track.FrameResult.nothing(MODEL), estimates_calibration=True)


def value_of(kind, rng):
    size = {"gyro": 3, "velocity": 3, "depth": 1, "tilt": 3}[kind]
    return tuple((rng.normal(size=size) * 0.1 + (np.array([0, -1, 0]) if kind == "tilt" else 0)).tolist())


def moved(state: FilterState, dx):
    """The state that lies `dx` away."""
    copy = FilterState(*(values.copy() for values in state))
    kernel.apply(copy.R, copy.t, copy.x, dx)
    return copy


@pytest.mark.parametrize("kind", aiding.PROVABLE)
@pytest.mark.parametrize("seed", range(4))
def test_rows_are_the_derivatives_of_what_a_sensor_is_expected_to_say(kind, seed):
    rng = np.random.default_rng(seed)
    one, config = (
        track_at(rng),
        CONFIG.aiding.model_copy(
            update={
                "velocity": CONFIG.aiding.velocity.model_copy(update={"position_m": (0.3, -0.2, 0.5)}),
                "depth": CONFIG.aiding.depth.model_copy(update={"position_m": (0.1, 0.4, -0.3)}),
            }
        ),
    )
    group = sensor_models.Group(kind, 50_000_000, value_of(kind, rng), 0.01)
    before = sensor_models.Before(0, value_of(kind, rng))
    model = sensor_models.model_of(one, group, before, config)
    step = 1e-6
    for c, column in enumerate(model.rows.columns):
        dx = np.zeros(len(one.state.x))
        dx[column] = step
        ends = [
            sensor_models.model_of(replace(one, state=moved(one.state, sign * dx)), group, before, config).rows.residual
            for sign in (1.0, -1.0)
        ]
        assert_allclose((ends[1] - ends[0]) / (2.0 * step), model.rows.H[:, c], atol=2e-4)


@pytest.mark.parametrize("considered", [(N, N), (kernel.CALIBRATION, N)])
def test_update_is_the_kalman_update_with_consider_states(considered):
    rng = np.random.default_rng(5)
    one = track_at(rng)
    columns = np.array([2, 5, TWIST, TWIST + 4, N + 1])
    rows = SensorRows(columns, rng.normal(size=(3, 5)), rng.normal(size=3) * 0.01, rng.uniform(0.01, 0.1, 3))
    blind = len(one.bank.begun) - track.SENSORS
    before = [values.copy() for values in one.state], one.bank.offset.copy(), one.bank.P.copy()
    update_by_sensor(one.state, one.bank, rows, SensorRules(blind, *considered))

    H = np.zeros((3, len(one.state.x)))
    H[:, columns] = rows.H
    first, last = considered
    free = np.r_[0:first, last : len(one.state.x)]

    def oracle(P, residual):
        """Successive scalar updates in Joseph's form, with the gain of the considered states zero."""
        x = np.zeros(len(P))
        for h, z, var in zip(H, residual, rows.var, strict=True):
            K = np.zeros(len(P))
            K[free] = (P @ h)[free] / (h @ P @ h + var)
            x = x + K * (z - h @ x)
            J = np.eye(len(P)) - np.outer(K, h)
            P = J @ P @ J.T + var * np.outer(K, K)
        return x, P

    x, P = oracle(before[0][3], rows.residual)
    assert_allclose(one.state.P, P, atol=1e-12)
    assert_allclose(one.state.x[6:], before[0][2][6:] + x[6:], atol=1e-12)
    for s in (0, 3):
        xs, Ps = oracle(before[2][s], rows.residual - H @ before[1][s])
        assert_allclose(one.bank.P[s], Ps, atol=1e-12)
        assert_allclose(one.bank.offset[s], before[1][s] + xs - x, atol=1e-12)
    assert_array_equal(one.bank.P[blind], before[2][blind])
    assert_allclose(one.bank.offset[blind], before[1][blind] - x, atol=1e-12)


def play(frames, config=CONFIG, order=None):
    localizer, fixes = Localizer(STATION, CAMERA, config), []
    for frame in frames:
        values = list(frame.aiding)
        if order is not None:
            order.shuffle(values)
        for value in values:
            localizer.aid(value)
        fixes.append(localizer.process_detections(frame.detections))
    return fixes


def over_level(frames, fixes):
    """How many valid fixes are further off than their protection levels say."""
    count = 0
    for frame, fix in zip(frames, fixes, strict=True):
        if fix.valid:
            error = fix.T_dock_cam[:3, 3] - frame.T_dock_cam[:3, 3]
            D = fix.T_dock_cam[:3, :3] @ frame.T_dock_cam[:3, :3].T
            angle = np.arccos(np.clip(0.5 * (np.trace(D) - 1.0), -1.0, 1.0))
            level = fix.protection
            count += bool(
                np.hypot(*error[:2]) > level.lateral_m or abs(error[2]) > level.axial_m or angle > level.angle_rad
            )
    return count


def states(fixes, kind):
    return [next((str(use) for use in fix.aiding if use.kind == kind), "") for fix in fixes]


def test_a_gyro_holds_the_slow_entry_that_has_holes_without_one():
    frames = frames_of("nominal", *SLOW, "detections.aiding={gyro: {}}", seed=501)
    near = [k for k, frame in enumerate(frames) if frame.T_dock_cam[2, 3] < 3.0]
    aided, alone = play(frames), play([replace(frame, aiding=()) for frame in frames])
    assert np.mean([aided[k].valid for k in near]) > 0.99
    assert np.mean([alone[k].valid for k in near]) < 0.95
    assert over_level(frames, aided) == 0
    assert states(aided, "gyro")[-1] == "gyro=used"
    assert alone[-1].aiding == ()


def test_values_may_come_in_any_order():
    frames = frames_of("nominal", *SLOW, "detections.aiding={gyro: {}, velocity: {}, depth: {}, tilt: {}}", seed=7)[:60]
    plain, shuffled = play(frames), play(frames, order=np.random.default_rng(0))
    for a, b in zip(plain, shuffled, strict=True):
        assert a.valid == b.valid
        if a.valid:
            assert_array_equal(a.T_dock_cam, b.T_dock_cam)


def test_gyro_and_velocity_carry_the_pose_through_the_dark():
    dark = "detections.black_outs={at_s: [[12, 16]]}"
    frames = frames_of("nominal", *SLOW, dark, "detections.aiding={gyro: {}, velocity: {}}", seed=512)
    fixes = play(frames)
    inside = [fix for frame, fix in zip(frames, fixes, strict=True) if 12 <= frame.detections.t_ns * 1e-9 <= 16]
    assert np.mean([fix.valid for fix in inside]) >= 0.9
    assert over_level(frames, fixes) == 0
    alone = play([replace(frame, aiding=()) for frame in frames])
    assert sum(fix.valid for fix in alone) < sum(fix.valid for fix in fixes)


@pytest.mark.parametrize(
    ("sensor", "wrong"),
    [
        ("gyro", "wrong_bias: [0.03, -0.03, 0.03]"),
        ("velocity", "wrong_scale: 0.3"),
        ("tilt", "wrong_bias: [0.5, 0, 0]"),
    ],
)
def test_a_sensor_ten_times_as_wrong_as_declared_is_left_out(sensor, wrong):
    frames = frames_of("nominal", *SLOW, f"detections.aiding={{{sensor}: {{{wrong}}}}}", seed=31)[:120]
    fixes = play(frames)
    after_s = next(fix.t_ns for fix in fixes if any(use.state == "declined" for use in fix.aiding)) * 1e-9
    assert after_s < 4.0
    assert over_level(frames, fixes) == 0
    assert states(fixes, sensor)[-1].startswith(f"{sensor}=declined:")


def test_late_stamps_and_turned_mounts_cost_no_valid_fix():
    late = "{late_s: 0.2, mount_deg: 3}"
    frames = frames_of("nominal", *SLOW, f"detections.aiding={{gyro: {late}, velocity: {late}}}", seed=12)
    fixes = play(frames)
    assert all(fix.valid for frame, fix in zip(frames, fixes, strict=True) if frame.T_dock_cam[2, 3] < 8.0)
    assert over_level(frames, fixes) == 0
    assert not any("declined" in str(use) for use in fixes[-1].aiding)


def test_velocity_is_that_of_the_camera():
    frames = frames_of("nominal", *SLOW, "detections.aiding={gyro: {}, velocity: {}}", seed=3)
    fixes = play(frames)
    nees, errors = [], []
    for a, b, fix in zip(frames, frames[1:], fixes, strict=False):
        if fix.valid and a.T_dock_cam[2, 3] < 5.0:
            dt = (b.detections.t_ns - a.detections.t_ns) * 1e-9
            true = a.T_dock_cam[:3, :3].T @ (b.T_dock_cam[:3, 3] - a.T_dock_cam[:3, 3]) / dt
            error = fix.velocity.linear_m_s - true
            errors.append(float(error @ error) / 3.0)
            nees.append(float(error @ np.linalg.solve(fix.velocity.covariance[:3, :3], error)) / 3.0)
    assert np.mean(nees) < 1.5
    assert np.sqrt(np.mean(errors)) < 0.03  # m/s on each axis, at a speed of 0.35
    assert (fixes[-1].velocity.sigma > 0.0).all()


def test_values_of_another_clock_do_nothing():
    frames = frames_of("nominal", *SLOW, seed=3)[:40]
    plain = play(frames)
    far = AidingMeasurement("gyro", 10**18, (9.0, 9.0, 9.0), 0.01)
    old = AidingMeasurement("gyro", -(10**18), (9.0, 9.0, 9.0), 0.01)
    others = play([replace(frame, aiding=(far, old)) for frame in frames])
    for a, b in zip(plain, others, strict=True):
        assert a.valid == b.valid
        if a.valid:
            assert_array_equal(a.T_dock_cam, b.T_dock_cam)


def test_buffer_is_bounded_and_forgotten():
    localizer = Localizer(STATION, CAMERA)
    for k in range(aiding.MAX_BUFFER + 10):
        localizer.aid(AidingMeasurement("depth", k, (1.0,), 0.01))
    assert len(localizer.state.aiding.buffer) == aiding.MAX_BUFFER
    localizer.forget()
    assert localizer.state.aiding.buffer == ()


@settings(max_examples=50, deadline=None)
@given(st.text(max_size=8), st.lists(st.floats(), max_size=5), st.floats())
def test_a_measurement_is_finite_and_of_a_known_kind(kind, value, sigma):
    try:
        one = AidingMeasurement(kind, 0, tuple(value), sigma)
    except DataError:
        return
    assert one.kind in ("gyro", "velocity", "depth", "tilt", "attitude")
    assert np.isfinite([*one.value, one.sigma]).all()
    assert one.sigma > 0.0
