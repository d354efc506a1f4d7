"""Bare detections by a detector that errs as measured on rendered frames, and how that is measured."""

import numpy as np
import pytest
from bench import detector_errors as bench
from bench.shipped import shipped_camera, shipped_station

from lumidock.datatypes import Detections
from lumidock.errors import InputError
from lumidock.sim.detections import simulated_frames
from lumidock.sim.measured import KINDS, detector_errors, is_measured, measured_like, measured_table
from lumidock.sim.scenario import load_scenario, shipped_scenarios

STATION, CAMERA = shipped_station(), shipped_camera()
REAR = STATION.layer != STATION.layers.index(STATION.layers_front_to_rear()[0])
PATHS = [name for name in shipped_scenarios() if load_scenario(name).path.kind != "draws"]
MEASURED = [name for name in PATHS if is_measured(load_scenario(name))]


def frames_of(name, like, *settings, seed=5):
    scenario = load_scenario(name, (f"detections.detector={like}", *settings))
    return list(simulated_frames(scenario, STATION, CAMERA, seed))


def test_a_scenario_is_measured_if_the_table_has_pictures_like_its_own():
    """Every scenario of the table, and those that share its pictures: different paths and faults of the stream."""
    assert set(measured_table()["scenarios"]) <= set(MEASURED)
    assert {"trials", "rectangle", "stream-faults"} <= set(MEASURED)


@pytest.mark.parametrize("name", sorted(set(PATHS) - set(MEASURED)))
def test_a_shipped_docking_without_measurements_is_refused_in_one_line(name):
    with pytest.raises(InputError, match=f"^{name}: no detector errors were measured on such pictures$"):
        measured_like(load_scenario(name))


def test_the_same_pictures_on_another_station_are_not_measured():
    assert not is_measured(load_scenario("approach", ("station=plate",)))


@pytest.mark.parametrize("name", MEASURED)
def test_measured_errors_of_a_shipped_docking_are_complete(name):
    errors = detector_errors(measured_like(load_scenario(name)))
    for kind in KINDS:
        for cell in errors.cells[kind]:
            assert np.isfinite(cell.detections[:, :3]).all()
            assert cell.rate == 0.0 or len(cell.detections)
            assert kind == "false" or cell.rate <= 1.0


def test_pictures_that_were_not_measured_are_refused_in_one_line():
    with pytest.raises(InputError, match="no detector errors"):
        measured_like(load_scenario("approach", ("water.b_factor=1.7",)))
    with pytest.raises(InputError, match=r"detections\.detector: mud is not measured; there are approach"):
        frames_of("approach", "mud")


@pytest.mark.parametrize("like", ["approach", "water-5c", "occluder"])
def test_lights_are_detected_and_false_detections_occur_as_often_as_measured(like):
    """Counted from the frames alone, against the counts in the file."""
    content, edges = measured_table()["scenarios"][like], measured_table()["edges_m"]
    seen = {kind: np.zeros((len(edges), 2)) for kind in KINDS}
    for seed in range(4):
        for frame in frames_of("approach", like, seed=seed):
            c_dock = frame.T_dock_cam[:3, 3]
            far = np.searchsorted(edges, np.linalg.norm(STATION.p_dock - c_dock, axis=1), side="right") - 1
            for i in np.flatnonzero(frame.in_view):
                seen["rear" if REAR[i] else "front"][far[i]] += (1, i in frame.light)
            dock = np.searchsorted(edges, np.linalg.norm(c_dock), side="right") - 1
            seen["false"][dock] += (1, (frame.light < 0).sum())
    for kind, counts in seen.items():
        for (of, found), cell in zip(counts, content[kind], strict=True):
            rate = cell["seen"] / max(cell["of"], 1)
            sigma = np.sqrt(of * rate * ((1.0 - rate) if kind != "false" else 1.0))
            assert abs(found - of * rate) <= 5.0 * sigma + 1e-9, (kind, of, found, rate)


def test_detections_err_as_measured_over_their_own_covariance():
    rows = measured_table()["scenarios"]["pool"]
    wanted = {
        (detection[0], detection[1])
        for kind in ("front", "rear")
        for cell in rows[kind]
        for detection in cell["detections"]
    }
    got = []
    for frame in frames_of("approach", "pool"):
        d, lights = frame.detections, np.flatnonzero(frame.light >= 0)
        sigma = np.sqrt(d.cov_px2[lights, 0, 0])
        error = np.linalg.norm(d.uv[lights] - frame.uv[frame.light[lights]], axis=1)
        got += zip(sigma, error / sigma, strict=True)
    distance = np.abs(np.array(got)[:, None] - np.array(sorted(wanted))[None]).max(axis=2)
    assert distance.min(axis=1).max() < 1e-6
    assert len(set(distance.argmin(axis=1))) > 0.5 * len(wanted)


def test_faults_of_the_scenario_stay_beside_the_detectors():
    settings = ("faults.spurious=2", "detections.noise_px=0.25")
    for frame in frames_of("approach", "approach", *settings):
        d = frame.detections
        spurious = np.isclose(d.cov_px2[:, 0, 0], 0.0625) & (frame.light < 0) & (d.p_light == 1.0)
        assert spurious.sum() == 2
    blind = frames_of("approach", "pool", "detections.black_outs.at_s=[[3.0, 4.0]]")
    assert [len(f.detections) for f in blind if 3_000_000_000 <= f.detections.t_ns <= 4_000_000_000] == [0] * 7
    dead = frames_of("approach", "water-ib", "lamps.failures={F1: 0.0}")
    assert not any(STATION.ids.index("F1") in frame.light for frame in dead)


def test_each_light_and_detection_of_a_frame_is_counted():
    cells = {kind: [bench.Cell() for _ in bench.EDGES_M] for kind in KINDS}
    lit = np.array(  # u, v, range, whether rear, SNR
        [
            [100.0, 100.0, 7.0, 0, 9.0],
            [640.0, 481.0, 7.0, 0, 3.0],  # below the noise: the detection beside it is another's
            [200.0, 200.0, 12.0, 1, 50.0],
            [402.0, 400.0, 12.0, 1, 50.0],  # not found, but a hot pixel is
        ]
    )
    uv = np.array([[103.0, 104.0], [200.0, 200.5], [500.0, 500.0], [640.0, 480.0], [400.0, 400.0]])
    injected, hot = np.array([[500.0, 501.0]]), np.array([[200.0, 200.6], [400.0, 400.0]])
    p_light, p_rear = np.array([0.9, 0.8, 1.0, 0.1, 0.2]), np.array([0.1, 0.2, 0.1, np.nan, 0.3])
    cov = np.tile(np.diag([0.25, 0.25]), (5, 1, 1))
    cov[1] = np.diag([0.01, 1.0])  # its error is along v
    found = Detections("0", 0, uv, np.ones(5), np.ones(5), p_light=p_light, p_rear=p_rear, cov_px2=cov)
    bench.add(cells, found, lit, injected, hot, 7.0)
    front, rear, false = cells["front"][1], cells["rear"][2], cells["false"][1]
    assert (front.of, rear.of, false.of) == (2, 2, 1)
    np.testing.assert_allclose(front.detections, [[0.5, 10.0, 0.9, 0.1]])
    np.testing.assert_allclose(rear.detections, [[1.0, 0.5, 0.8, 0.2]])
    np.testing.assert_allclose(false.detections, [[0.5, 0.0, 0.1, np.nan], [0.5, 0.0, 0.2, 0.3]])
    assert false.as_dict(20)["detections"] == [[0.5, 0.0, 0.1, None], [0.5, 0.0, 0.2, 0.3]]


def test_a_sample_of_many_detections_has_the_worst():
    cell = bench.Cell(of=500, detections=[[0.3, float(k), 1.0, 0.1] for k in np.random.default_rng(1).permutation(400)])
    kept = cell.as_dict(20)
    assert (kept["of"], kept["seen"]) == (500, 400)
    assert [kept["detections"][0][1], kept["detections"][-1][1]] == [0.0, 399.0]
    assert len(kept["detections"]) == 20
