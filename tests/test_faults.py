"""Adversaries of a few seconds: what breaks an assumption makes no valid pose that is off by more than its levels."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lumidock import tracking
from lumidock.camera import load_camera
from lumidock.config import Config
from lumidock.datatypes import Detections
from lumidock.digest import Digest
from lumidock.errors import InputError
from lumidock.evaluation import claims
from lumidock.localizer import Localizer
from lumidock.model import measurements
from lumidock.pose import project_lights
from lumidock.sim.detections import simulated_frames
from lumidock.sim.scenario import load_scenario
from lumidock.station import load_station
from lumidock.yamlfile import validate

ROOT = Path(__file__).parents[1]
STATION = load_station(ROOT / "src" / "lumidock" / "stations" / "cage-2x2x5.yaml")
CAMERA = load_camera(ROOT / "src" / "lumidock" / "cameras" / "imx264-60deg.yaml")
NEAR = ("path.start_z_m=14", "path.end_z_m=8", "path.frame_interval_s=0.1", "detections.survey=true")


def frames_of(*more, seed=0):
    return list(simulated_frames(load_scenario("approach", (*NEAR, *more)), STATION, CAMERA, seed))


def require_no_lie(frames, fixes):
    """Every valid pose is within its levels; how many there are."""
    for frame, fix in zip(frames, fixes, strict=True):
        if fix.valid:
            error, level = claims.pose_error(fix.T_dock_cam, frame.T_dock_cam), fix.protection
            assert np.hypot(*error[:2]) < level.lateral_m
            assert abs(error[2]) < level.axial_m
            assert np.linalg.norm(error[3:]) < level.angle_rad
    return sum(fix.valid for fix in fixes)


def play(frames, localizer=None):
    localizer = localizer or Localizer(STATION, CAMERA)
    return [localizer.process_detections(frame.detections) for frame in frames]


@pytest.mark.parametrize(
    "fault",
    [
        ("detections.glints=1", "detections.dead=3"),
        ("detections.glints=3", "detections.dead=1"),
        ("detections.front_off_s=[[2, 4]]", "detections.clutter=2"),
    ],
)
def test_a_fault_of_one_light_makes_no_pose_that_is_off_by_more_than_its_levels(fault):
    frames = frames_of(*fault, seed=7)
    assert require_no_lie(frames, play(frames)) > 10


def test_a_picture_that_repeats_but_for_its_noise_is_frozen_however_long(rng):
    frames = frames_of()[:40]
    held = frames[20].detections
    after = []
    for frame in frames[20:]:
        uv = held.uv + rng.normal(0.0, 0.02, held.uv.shape)
        after.append(replace(frame, detections=replace(held, uv=uv, t_ns=frame.detections.t_ns)))
    fixes = play([*frames[:20], *after])
    require_no_lie([*frames[:20], *after], fixes)
    assert fixes[19].valid
    assert sum(fix.reason == "frozen" for fix in fixes[20:]) >= 15


def test_a_vehicle_that_hovers_is_not_frozen(rng):
    still = frames_of()[0]
    localizer = Localizer(STATION, CAMERA)
    for k in range(20):
        uv = still.detections.uv + rng.normal(0.0, 0.05, still.detections.uv.shape)
        fix = localizer.process_detections(replace(still.detections, uv=uv, t_ns=k * 100_000_000))
        assert fix.reason != "frozen"


def test_a_focal_length_that_is_wrong_ends_the_trust_in_the_calibration():
    frames = frames_of("lens.focal_error=0.045", "path.end_z_m=3")
    reasons = [fix.reason for fix in play(frames)]
    assert "calibration" in reasons
    assert "" not in reasons[reasons.index("calibration") :]


def test_within_the_declared_sigmas_no_file_is_doubted():
    for seed in range(2):
        fixes = play(frames_of("detections.calibration=true", seed=seed))
        assert not {fix.reason for fix in fixes} & {"calibration", "survey"}


@settings(max_examples=10, deadline=None)
@given(st.lists(st.tuples(st.floats(0, 2447), st.floats(0, 2047)), min_size=1, max_size=30), st.floats(0.0, 1e-3))
def test_what_is_surely_no_lamp_changes_no_answer(places, p_light):
    """Before and after, on one acquired and some tracked frames: the same poses, levels and reasons."""
    with_glints = []
    for frame in frames_of()[:4]:
        d, n = frame.detections, len(places)
        unknown = np.full(n, np.nan)
        more = Detections(
            d.frame,
            d.t_ns,
            np.concatenate([d.uv, np.array(places)]),
            np.concatenate([d.radius_px, unknown]),
            np.concatenate([d.flux, unknown]),
            np.concatenate([d.p_light, np.full(n, p_light)]),
            np.concatenate([d.p_rear, unknown]),
        )
        with_glints.append(replace(frame, detections=more))
    for a, b in zip(play(frames_of()[:4]), play(with_glints), strict=True):
        assert (a.valid, a.reason, a.status, a.n_used) == (b.valid, b.reason, b.status, b.n_used)
        if a.valid:
            np.testing.assert_allclose(a.T_dock_cam, b.T_dock_cam, atol=1e-9)
            np.testing.assert_allclose(a.protection.lateral_m, b.protection.lateral_m, rtol=1e-9)


def test_a_frame_that_leaves_its_answer_open_lists_the_poses_that_fit(rng):
    """A regular ring of eight whose roll is not known fits in eight ways."""
    angle = np.arange(8) * np.pi / 4
    p_dock = np.stack([np.cos(angle), np.sin(angle), np.zeros(8)], axis=1)
    ring = replace(
        STATION,
        ids=tuple(f"L{k}" for k in range(8)),
        layers=("front",),
        layer=np.zeros(8, np.int64),
        p_dock=p_dock,
        color=("white",) * 8,
        axis=np.tile([0.0, 0.0, 1.0], (8, 1)),
        beam_deg=np.full(8, 120.0),
        power_w=np.full(8, 2.0),
    )
    T_dock_cam = np.eye(4)
    T_dock_cam[:3, :3], T_dock_cam[:3, 3] = np.diag([1.0, -1.0, -1.0]), [0.3, -0.2, 8.0]
    uv = project_lights(CAMERA, T_dock_cam, p_dock) + rng.normal(0, 0.3, (8, 2))
    localizer = Localizer(ring, CAMERA, Config.model_validate({"prior": {"roll_deg": 180.0}}))
    fix = localizer.process_detections(Detections.from_uv("f", 0, uv))
    assert (fix.valid, fix.reason) == (False, "ambiguous")
    assert len(fix.alternatives) >= 4
    assert abs(sum(one.probability for one in fix.alternatives) - 1.0) < 1e-9
    errors = [np.abs(claims.pose_error(one.T_dock_cam, T_dock_cam)).max() for one in fix.alternatives]
    assert min(errors) < 0.3  # the truth is among them


@pytest.mark.parametrize(
    "tree",
    [
        {"integrity": {"risk": 0.02}},
        {"integrity": {"max_age_s": 6.0}},
        {"track": {"max_gap_s": 20.0}},
        {"match": {"noise_px": 1e-3}},
        {"match": {"max_work": 10**9}},
        {"track": {"hypotheses": 10_000}},
        {"track": {"max_nodes": 10**9}},
        {"track": {"accel_m_s2": 1e-6}},
        {"track": {"start_m_s": 1e-6}},
        {"track": {"gate": 1e6}},
        {"track": {"deviate_memory": 1.0}},
        {"track": {"memory": 0.5}},
        {"match": {"margin": 0.1}},
        {"match": {"margin_gathered": 1e-3}},
        {"match": {"log_mirror": 1000.0}},
        {"match": {"least_detections": 10**9}},
        {"prior": {"roll_deg": 1e-6}},
        {"integrity": {"fault": 1e-9}},
        {"detect": {"max_lights": 10**9}},
        {"detect": {"floor_px": 1e-9}},
        {"paper": {"max_detections": 10**9}},
    ],
)
def test_settings_that_would_undo_the_protection_are_refused(tree):
    with pytest.raises(InputError, match=next(iter(next(iter(tree.values()))))):
        validate(Config, tree, "config.yaml")


def test_hypotheses_that_do_not_fit_in_memory_are_refused_with_the_bound_that_holds():
    many, n = Config.model_validate({"track": {"hypotheses": 256}}), 120
    p_dock = np.random.default_rng(0).uniform(-2.0, 2.0, (n, 3))
    large = replace(
        STATION,
        ids=tuple(f"L{k}" for k in range(n)),
        layers=("front",),
        layer=np.zeros(n, np.int64),
        p_dock=p_dock,
        color=("white",) * n,
        axis=np.tile([0.0, 0.0, 1.0], (n, 1)),
        beam_deg=np.full(n, 120.0),
        power_w=np.full(n, 2.0),
    )
    with pytest.raises(InputError, match=r"track\.hypotheses: 256 of 120 lights .* wanted at most (\d+)") as caught:
        Localizer(large, CAMERA, many)
    most = int(str(caught.value).rsplit(" ", 1)[1])
    assert 32 <= most < 256
    Localizer(STATION, CAMERA, many)


def test_a_frozen_picture_of_one_light_is_told_by_its_pixels(rng):
    """A track on one light, whose picture repeats but for a decoder's noise, while it moves."""
    frames = frames_of()[:30]
    scene = rng.integers(0, 60, (CAMERA.height, CAMERA.width)).astype(np.uint8)
    localizer = Localizer(STATION, CAMERA)
    for frame in frames[:25]:
        localizer.process_detections(frame.detections)
    used = int(localizer.state.first.last.assignment.max())
    held = frames[24].detections
    one = Detections.from_uv("held", held.t_ns, held.uv[used : used + 1], p_rear=held.p_rear[used : used + 1])
    digest = Digest.of(scene).next(np.roll(scene, 1, axis=0)).next(np.roll(scene, 2, axis=0))
    again = replace(one, t_ns=frames[25].detections.t_ns, uv=one.uv + 0.01)
    for picture, said in ((np.roll(scene, 2, axis=0), True), (np.roll(scene, 3, axis=0), False)):
        state = replace(localizer.state, last=one, digest=digest.next(picture))
        predicted = tracking.predict(state, again.t_ns, localizer.context)
        frame = measurements(again, localizer.context.model, localizer.config.match)
        last = replace(predicted.tracks[0].last, assignment=np.where(np.arange(13) == 0, 0, -1), count=(1, 0))
        first = replace(predicted.tracks[0], last=last)
        moved = replace(predicted, tracks=(first,), measurements=None)
        assert tracking.is_frozen(state, moved, frame, localizer.context) == said


def two_squares(tmp_path):
    """A dock of four white lights in front of four blue ones: a square that is missing one is like the other."""
    front = [(-0.9, 0.9), (0.9, 0.93), (0.88, -0.9), (-0.95, -0.86)]
    rear = [(-0.6, 0.62), (0.6, 0.57), (0.63, -0.6), (-0.57, -0.6)]
    rows = [f"{{id: F{k}, layer: front, position: [{x}, {y}, 0], color: white}}" for k, (x, y) in enumerate(front)]
    rows += [f"{{id: R{k}, layer: rear, position: [{x}, {y}, -3], color: blue}}" for k, (x, y) in enumerate(rear)]
    path = tmp_path / "two-squares.yaml"
    path.write_text("schema: 1\nname: two squares\nlights:\n" + "".join(f"  - {row}\n" for row in rows))
    return load_station(path)


# Three front lights from 19 m, and a glint 8 cm beside the missing fourth: as much like the rear square from 8 m.
GLINT_FOR_A_LIGHT = np.array([[1155.0, 1014.0], [1348.0, 1019.0], [1140.0, 1204.0], [1341.0, 1208.0]])


def test_an_array_of_lights_and_a_glint_is_not_proven_by_repeating_itself(tmp_path, rng):
    localizer = Localizer(two_squares(tmp_path), CAMERA)
    for k in range(60):
        uv = GLINT_FOR_A_LIGHT + rng.normal(0.0, 0.5, (4, 2))
        fix = localizer.process_detections(Detections.from_uv(str(k), k * 66_000_000, uv, p_rear=np.full(4, 0.05)))
        assert not fix.valid


def test_a_track_is_not_given_up_for_another_array_of_one_frame(tmp_path, rng):
    localizer = Localizer(two_squares(tmp_path), CAMERA)
    front = np.vstack([GLINT_FOR_A_LIGHT[:3], GLINT_FOR_A_LIGHT[3] + [-6.0, 8.0]])
    for k in range(60):
        seen = GLINT_FOR_A_LIGHT if k % 20 == 19 else front
        uv = seen + rng.normal(0.0, 0.5, (4, 2))
        localizer.process_detections(Detections.from_uv(str(k), k * 66_000_000, uv, p_rear=np.full(4, 0.05)))
        assert np.linalg.norm(localizer.state.first.state.t) > 14.0  # the rear square would be at 8 m
