"""The paper's method as a whole, through both entries."""

import csv
from dataclasses import replace

import numpy as np
import pytest
from bench import images, table1
from bench.shipped import shipped_camera, shipped_station

from lumidock.camera import Camera
from lumidock.config import BtekfConfig, ConsistencyConfig, LayersConfig, PaperConfig
from lumidock.datatypes import Detections, Frame
from lumidock.errors import FrameError, InputError
from lumidock.evaluation.metrics import evaluate
from lumidock.geometry import se3_inverse, so3_log
from lumidock.paper import PaperLocalizer
from lumidock.pose import project_lights
from lumidock.reproduce.paper_figures import TABLE_1
from lumidock.reproduce.trials import Condition, merged
from lumidock.sim.detections import simulated_frames
from lumidock.sim.scenario import Scenario, load_scenario
from lumidock.sim.sequence import render_frame

STATION, CAMERA = shipped_station(), shipped_camera()


def head_on(z, x=0.0):
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[0, 3], T[2, 3] = x, z
    return T


def seen_from(T, t_ns=0, *, lights=slice(None), spurious=()):
    uv = project_lights(CAMERA, T, STATION.p_dock)[lights]
    rear = np.isin(np.arange(len(STATION))[lights], STATION.lights_of("rear")).astype(float)
    uv = np.concatenate([uv, np.array(spurious, float).reshape(-1, 2)])
    return Detections.from_uv(str(t_ns), t_ns, uv, p_rear=np.concatenate([rear, np.zeros(len(spurious))]))


def error(fix, T):
    delta = se3_inverse(T) @ fix.T_dock_cam
    return np.linalg.norm(delta[:3, 3]), np.linalg.norm(so3_log(delta[:3, :3]))


@pytest.mark.parametrize("z", [25.0, 9.0, 5.0, 3.0])
def test_exact_detections_give_the_exact_pose_of_each_layer(z):
    T = head_on(z, 0.3)
    fix = PaperLocalizer(STATION, CAMERA).process_detections(seen_from(T))
    assert max(error(fix, T)) < 1e-5
    assert fix.status == "acquired"
    assert [pose.layer for pose in fix.by_layer] == ["front", "rear"]
    assert fix.match.light.tolist() == list(range(13))
    for pose in fix.by_layer:
        assert max(error(replace(fix, T_dock_cam=pose.T_dock_cam), T)) < 1e-5


def test_history_makes_tracking_and_cold_never_does():
    for cold, status in ((False, "tracking"), (True, "acquired")):
        localizer = PaperLocalizer(STATION, CAMERA, cold=cold)
        for k in range(3):
            fix = localizer.process_detections(seen_from(head_on(9.0 - 0.15 * k), k * 150_000_000))
        assert fix.status == status


def test_a_missing_and_a_spurious_light_together_void_an_acquisition_but_not_a_tracked_frame():
    lights = [0, 1, 2, 4, 5, 6]
    clutter = project_lights(CAMERA, head_on(9.0), np.array([[-0.5, 0.5, 0.0]]))
    spoilt = seen_from(head_on(9.0), 450_000_000, lights=lights, spurious=clutter)
    cold = PaperLocalizer(STATION, CAMERA).process_detections(spoilt)
    assert not cold.valid
    assert cold.reason == "inconsistent"
    warm = PaperLocalizer(STATION, CAMERA)
    for k in range(3):
        warm.process_detections(seen_from(head_on(9.45 - 0.15 * k), k * 150_000_000))
    fix = warm.process_detections(spoilt)
    assert fix.match.light.tolist() == [*lights, -1]
    assert fix.by_layer[0].source == "btekf"
    assert max(error(fix, head_on(9.0))) < 1e-4


@pytest.mark.parametrize(("count", "reason"), [(0, "no_lights"), (3, "too_few")])
def test_too_few_lights_have_a_reason_and_no_pose(count, reason):
    fix = PaperLocalizer(STATION, CAMERA).process_detections(seen_from(head_on(9.0), lights=slice(count)))
    assert (fix.valid, fix.T_dock_cam, fix.reason, fix.status) == (False, None, reason, "none")


def test_three_lights_are_enough_with_history():
    localizer = PaperLocalizer(STATION, CAMERA)
    for k in range(4):
        localizer.process_detections(seen_from(head_on(9.6 - 0.15 * k), k * 150_000_000, lights=slice(7)))
    fix = localizer.process_detections(seen_from(head_on(9.0), 600_000_000, lights=[0, 3, 6]))
    assert fix.n_used == 3
    assert error(fix, head_on(9.0))[0] < 0.3


def test_three_lights_long_after_a_better_fix_are_not_enough():
    localizer = PaperLocalizer(STATION, CAMERA)
    for k in range(4):
        localizer.process_detections(seen_from(head_on(9.6 - 0.15 * k), k * 150_000_000, lights=slice(7)))
    assert not localizer.process_detections(seen_from(head_on(8.3), 1_300_000_000, lights=[0, 3, 6])).valid


def test_clutter_after_a_fix_gives_no_pose_a_second_later(rng):
    for _ in range(20):
        localizer = PaperLocalizer(STATION, CAMERA)
        localizer.process_detections(seen_from(head_on(15.0), lights=slice(7)))
        uv = rng.uniform([0, 0], [2447, 2047], (80, 2))
        clutter = Detections.from_uv("1", 10**9, uv, p_rear=np.zeros(80))
        assert not localizer.process_detections(clutter).valid


def test_too_many_detections_are_refused_and_those_outside_the_picture_ignored(rng):
    localizer = PaperLocalizer(STATION, CAMERA)
    many = Detections.from_uv("0", 0, rng.uniform(0, 2000, (500, 2)), p_rear=np.zeros(500))
    assert localizer.process_detections(many).reason == "too_many"
    outside = seen_from(head_on(9.0), 10**9, lights=slice(7))
    assert not localizer.process_detections(replace(outside, uv=outside.uv + 5000.0)).valid
    with pytest.raises(ValueError, match="finite"):
        replace(outside, uv=outside.uv * np.nan)


@pytest.mark.parametrize(
    ("p_dock", "word"),
    [
        ([[0, 0, 0], [1, 0, 0], [2, 0.01, 0], [3, 0, 0]], "line"),
        ([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 1, -1]], "behind"),
        ([[np.cos(a), np.sin(a), 0] for a in np.arange(50)], "50 lights"),
    ],
)
def test_layers_that_the_method_cannot_read_are_refused(p_dock, word):
    n = len(p_dock)
    station = replace(
        STATION,
        ids=tuple(map(str, range(n))),
        layers=("front",),
        layer=np.zeros(n, np.int64),
        p_dock=np.array(p_dock, float),
        color=("white",) * n,
        axis=np.tile([0.0, 0.0, 1.0], (n, 1)),
        beam_deg=np.full(n, 120.0),
        power_w=np.ones(n),
    )
    with pytest.raises(InputError, match=word):
        PaperLocalizer(station, CAMERA)


def test_clutter_alone_never_gives_a_pose(rng):
    """Random detections in place of a dock: at the shipped tolerances nothing passes without history."""
    localizer = PaperLocalizer(STATION, CAMERA, cold=True)
    for k in range(60):
        uv = rng.uniform([0, 0], [2447, 2047], (rng.integers(4, 10), 2))
        clutter = Detections.from_uv(str(k), k, uv, p_rear=rng.integers(0, 2, len(uv)).astype(float))
        assert not localizer.process_detections(clutter).valid


def test_repeated_and_disordered_stamps_are_refused_and_the_run_recovers():
    localizer = PaperLocalizer(STATION, CAMERA)
    stamps = [0, 150, 150, 100, 300, 10**9, 450, 600]
    fixes = [localizer.process_detections(seen_from(head_on(9.0), t * 1_000_000)) for t in stamps]
    assert [fix.reason for fix in fixes] == ["", "", "bad_stamp", "bad_stamp", "", "", "bad_stamp", ""]


def test_history_older_than_the_gap_is_forgotten():
    localizer = PaperLocalizer(STATION, CAMERA)
    localizer.process_detections(seen_from(head_on(9.0)))
    assert localizer.process_detections(seen_from(head_on(9.0), 60 * 10**9)).status == "acquired"


def test_frame_of_another_size_and_station_of_three_layers_are_refused():
    with pytest.raises(FrameError, match="320x240"):
        PaperLocalizer(STATION, CAMERA).process(Frame("7", 0, np.zeros((240, 320, 3), np.uint8)))
    three = replace(STATION, layers=("a", "b", "c"), layer=np.arange(13) % 3)
    with pytest.raises(InputError, match="two"):
        PaperLocalizer(three, CAMERA)


def test_a_distorted_lens_is_undone():
    bent = Camera(CAMERA.width, CAMERA.height, CAMERA.K, "plumb_bob", np.array([-0.2, 0.05, 0.001, -0.001, 0.0]))
    T = head_on(3.0, 0.2)
    uv = project_lights(bent, T, STATION.p_dock)
    fix = PaperLocalizer(STATION, bent).process_detections(Detections.from_uv("0", 0, uv, p_rear=seen_from(T).p_rear))
    assert max(error(fix, T)) < 1e-4


def test_same_detections_give_the_same_answers():
    frames = list(simulated_frames(load_scenario("trials", ("faults.missing=2",)), STATION, CAMERA, 3))[20:40]

    def run():
        localizer = PaperLocalizer(STATION, CAMERA)
        return [localizer.process_detections(frame.detections).T_dock_cam for frame in frames]

    for first, second in zip(run(), run(), strict=True):
        np.testing.assert_array_equal(first, second)


def test_radius_decides_where_there_is_no_colour():
    config = PaperConfig(layers=LayersConfig(method="radius"))
    T = head_on(9.0)
    seen = seen_from(T)
    sized = replace(seen, radius_px=np.where(seen.p_rear > 0.5, 3.0, 6.0), p_rear=np.full(13, np.nan))
    assert max(error(PaperLocalizer(STATION, CAMERA, config).process_detections(sized), T)) < 1e-4


def test_process_finds_both_layers(rng):
    T = head_on(6.0, 0.2)
    image, _, _ = render_frame(Scenario(), STATION, CAMERA, T, np.empty((0, 2)), np.empty(0, np.int64), rng)
    fix = PaperLocalizer(STATION, CAMERA).process(Frame("0", 0, image))
    assert sorted(fix.match.light[fix.match.light >= 0].tolist()) == list(range(13))
    assert error(fix, T)[0] < 0.5
    mono = PaperLocalizer(STATION, CAMERA).process(Frame("0", 0, np.ascontiguousarray(image.max(axis=2))))
    assert mono.n_seen == 13


SWARM_PERCENT = {(3, 0): 90.3, (2, 0): 98.6, (1, 0): 99.9, (0, 1): 99.6, (0, 2): 99.6}


@pytest.mark.parametrize("faults", list(TABLE_1))
def test_table_1_holds_on_a_few_trials(faults):
    counts = merged(table1.trial(Condition(*faults), seed) for seed in (900, 901, 902))["30 m"]
    swarm, whole = (counts[name] for name in table1.METHODS)
    assert swarm.frames > 190
    assert 100.0 * swarm.right / swarm.frames >= SWARM_PERCENT[faults] - 0.5  # one frame in 200
    assert whole.right == whole.frames
    assert whole.wrong == 0


@pytest.mark.slow
@pytest.mark.parametrize("faults", list(TABLE_1))
def test_table_1_holds_on_thirty_trials(faults):
    counts = table1.counts_of(Condition(*faults), first_seed=40_000)
    swarm, whole = (counts[name] for name in table1.METHODS)
    assert 100.0 * swarm.right / swarm.frames >= SWARM_PERCENT[faults]
    assert 100.0 * whole.right / whole.frames >= 99.9


def check_approach(result):
    """The reach, continuity and agreement of the layers that the paper reports in section 4.2."""
    front, rear = result["layers"]["front"], result["layers"]["rear"]
    assert front["first_z_m"] > 18.6
    assert front["last_z_m"] < 1.8
    assert rear["first_z_m"] > 10.0
    assert rear["last_z_m"] == pytest.approx(-3.0, abs=0.1)
    assert result["longest_gap_s"] <= 0.45
    assert result["layers"]["offset_m"] < 0.3
    assert result["identities"]["wrong"] <= 0.002 * result["identities"]["identified"]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(31, 38))
def test_rendered_approach(tmp_path, seed):
    sequence, out = images.simulate_and_run("approach", seed, tmp_path)
    check_approach(evaluate(out, sequence))
    with (out / "fixes.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 221
    stages = [row["stage"] for row in rows if row["valid"] == "1"]
    assert list(dict.fromkeys(stages))[-2:] == ["transition", "rear"]


def test_rectangular_search_is_identified_right(tmp_path):
    eligible, right = images.search_identities(*images.simulate_and_run("rectangle", 30, tmp_path))
    assert eligible > 40
    assert right == eligible


def test_loose_filter_is_what_lets_wrong_matches_pass():
    """The shipped tolerance refuses a match that a loose one accepts: one light off by a hand's breadth."""
    from lumidock.paper.consistency import consistent

    xy = STATION.p_dock[:7, :2]
    moved = xy.copy()
    moved[1] += [0.0, 0.08]
    assert not consistent(xy, moved, ConsistencyConfig())
    assert consistent(xy, moved, ConsistencyConfig(ratio=0.4, angle_deg=25.0))


# As printed


PRINTED = PaperConfig(preset="as_printed")


def test_preset_fills_in_what_is_not_given_and_the_resolved_values_are_saved():
    assert (PRINTED.pso.particles, PRINTED.pso.iterations, PRINTED.pso.scale, PRINTED.pso.shift) == (
        20,
        40,
        (0.5, 8.0),
        (-1.0, 1.0),
    )
    assert (PRINTED.btekf.noise_in_gate, PRINTED.btekf.missing_branch) == (False, False)
    own = PaperConfig.model_validate({"preset": "as_printed", "pso": {"particles": 33}, "btekf": {"gate": 9.2}})
    assert (own.pso.particles, own.pso.iterations, own.btekf.gate, own.btekf.noise_in_gate) == (33, 40, 9.2, False)
    assert PaperConfig.model_validate(own.model_dump(mode="json")) == own
    assert PaperConfig(preset="recommended") == PaperConfig()


def test_after_the_filter_its_pose_answers_and_reprojection_associates_the_next_frame():
    config = PRINTED.model_copy(update={"btekf": PRINTED.btekf.model_copy(update={"noise_in_gate": True})})
    lights = [0, 1, 2, 4, 5, 6]
    localizer = PaperLocalizer(STATION, CAMERA, config)
    for k in range(4):
        localizer.process_detections(seen_from(head_on(9.6 - 0.15 * k), k * 150_000_000, lights=slice(7)))
    decoy = project_lights(CAMERA, head_on(9.0), np.array([[-0.5, 0.5, 0.0]]))
    spurious_and_all = seen_from(head_on(9.0), 600_000_000, lights=slice(7), spurious=[*decoy, [1240.0, 1030.0]])
    fix = localizer.process_detections(spurious_and_all)
    assert fix.match.light.tolist() == [*range(7), -1, -1]
    missing = PaperLocalizer(STATION, CAMERA, config)
    both = PaperLocalizer(STATION, CAMERA, PaperConfig(btekf=BtekfConfig(pose_from_filter=True)))
    for k in range(4):
        for one in (missing, both):
            one.process_detections(seen_from(head_on(9.6 - 0.15 * k), k * 150_000_000, lights=slice(7)))
    spoilt = seen_from(head_on(9.0), 600_000_000, lights=lights, spurious=decoy)
    fixes = {name: one.process_detections(spoilt) for name, one in (("printed", missing), ("branch", both))}
    assert fixes["branch"].by_layer[0].source == "btekf"
    assert fixes["branch"].match.light.tolist() == [*lights, -1]
    after = both.process_detections(seen_from(head_on(8.85), 750_000_000, lights=lights, spurious=decoy))
    assert after.match.light.tolist() == [*lights, -1]  # where the swarm would have to use the decoy
    assert after.by_layer[0].source == "pso"
    assert max(error(after, head_on(8.85))) < 1e-3


def test_without_a_branch_for_missing_lights_every_gated_light_must_find_its_detection():
    """A decoy inside the gate of a missing light is taken or the frame is lost; the branch leaves it alone."""
    for branch, wanted in ((False, False), (True, True)):
        config = PaperConfig(btekf=BtekfConfig(missing_branch=branch))
        localizer = PaperLocalizer(STATION, CAMERA, config)
        for k in range(4):
            localizer.process_detections(seen_from(head_on(9.6 - 0.15 * k), k * 150_000_000, lights=slice(7)))
        near = project_lights(CAMERA, head_on(9.0), STATION.p_dock[3:4]) + 9.0
        lights = [0, 1, 2, 4, 5, 6]
        fix = localizer.process_detections(seen_from(head_on(9.0), 600_000_000, lights=lights, spurious=near))
        right = fix.match is not None and fix.match.light.tolist() == [*lights, -1]
        assert right == wanted


def test_radius_decides_where_nothing_is_blue_as_in_figure_5():
    config = PaperConfig(layers=LayersConfig(method="color_or_radius"))
    T = head_on(9.0)
    seen = seen_from(T)
    radius = np.where(seen.p_rear > 0.5, 3.0, 6.0)
    colorless = replace(seen, radius_px=radius, p_rear=np.zeros(13))
    assert max(error(PaperLocalizer(STATION, CAMERA, config).process_detections(colorless), T)) < 1e-4
    colored = replace(seen, radius_px=np.full(13, 6.0))
    assert max(error(PaperLocalizer(STATION, CAMERA, config).process_detections(colored), T)) < 1e-4
