"""Values of the vehicle's sensors from files: aiding.csv, topics of bags; and what a run writes of them."""

import csv

import numpy as np
import pytest
from bags import header, raw, write
from numpy.testing import assert_allclose
from tracks import CAMERA, ROOT, STATION

from lumidock import AidingMeasurement, Config, Localizer
from lumidock.app.run import Setup, run
from lumidock.errors import InputError
from lumidock.sim.aiding import measured
from lumidock.sim.scenario import load_scenario
from lumidock.sim.sequence import write_detections
from lumidock.streams.replay import read_fixes
from lumidock.streams.run_folder import FIX_COLUMNS, VELOCITY_COLUMNS, RunFolder
from lumidock.streams.sensors import AidingFeed
from lumidock.streams.sources import open_source

SETTINGS = ("path.start_z_m=6", "path.end_z_m=4", "detections.aiding={gyro: {}, velocity: {}, depth: {}, tilt: {}}")
STATION_FILE = ROOT / "src" / "lumidock" / "stations" / "cage-2x2x5.yaml"
CAMERA_FILE = ROOT / "src" / "lumidock" / "cameras" / "imx264-60deg.yaml"


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sequence")
    write_detections(load_scenario("nominal", SETTINGS), STATION, CAMERA, 3, folder)
    return folder


def test_a_sequence_gives_back_the_values_that_were_simulated(sequence):
    scenario = load_scenario("nominal", SETTINGS)
    expected = list(measured(scenario, scenario.detections.aiding, 3))
    found = list(open_source(sequence).sensors())
    assert [(one.t_ns, one.kind) for one in found] == [(one.t_ns, one.kind) for one in expected]
    for a, b in zip(found, expected, strict=True):
        assert_allclose([*a.value, a.sigma], [*b.value, b.sigma])


def test_broken_rows_are_left_out_and_a_table_of_nothing_else_is_refused(sequence, tmp_path):
    for name in ("timestamps.csv", "detections.csv"):
        (tmp_path / name).write_bytes((sequence / name).read_bytes())
    table = tmp_path / "aiding.csv"
    good = "5,depth,2.0,,,,0.1"
    bad = (
        "x,depth,2,,,,0.1",
        "5,sonar,2,,,,0.1",
        "5,gyro,1,2,,,0.1",
        "5,depth,nan,,,,0.1",
        "5,depth,2,,,,0",
        "5,depth",
    )
    table.write_text("\n".join(("t_ns,kind,v0,v1,v2,v3,sigma", *bad, good)) + "\n")
    assert open_source(tmp_path).sensors() == (AidingMeasurement("depth", 5, (2.0,), 0.1),)
    table.write_text("\n".join(("t_ns,kind,v0,v1,v2,v3,sigma", *bad)) + "\n")
    with pytest.raises(InputError, match="no usable row"):
        open_source(tmp_path)


def test_each_value_is_handed_out_once_before_its_frame():
    values = [AidingMeasurement("depth", t, (1.0,), 0.1) for t in (1, 2, 3, 5)]
    feed = AidingFeed(values)
    assert [one.t_ns for one in feed.until(2)] == [1, 2]
    assert list(feed.until(None)) == []
    assert [one.t_ns for one in feed.until(4)] == [3]
    assert [one.t_ns for one in feed.until(10)] == [5]
    assert list(AidingFeed(()).until(10)) == []


def test_a_run_writes_velocity_and_sensors_at_the_end_of_its_rows(sequence, tmp_path):
    source = open_source(sequence)
    with RunFolder(tmp_path, STATION.ids) as folder:
        run(
            source,
            Localizer(STATION, CAMERA),
            folder,
            Setup("lumidock", cold=False, config=Config(), station=STATION_FILE, camera=CAMERA_FILE),
        )
    with (tmp_path / "fixes.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == FIX_COLUMNS
    assert FIX_COLUMNS[-len(VELOCITY_COLUMNS) - 2 :] == ("latency_us", *VELOCITY_COLUMNS, "aiding")
    assert all(row[name] for row in rows if row["valid"] == "1" for name in VELOCITY_COLUMNS)
    assert {word.partition("=")[0] for word in rows[-1]["aiding"].split()} == {"gyro", "velocity", "depth", "tilt"}
    fixes = [fix for fix, _, _ in read_fixes(tmp_path, STATION.ids)]
    assert [" ".join(map(str, fix.aiding)) for fix in fixes] == [row["aiding"] for row in rows]
    last = fixes[-1]
    assert_allclose(last.velocity.linear_m_s[2], float(rows[-1]["vz_m_s"]))
    assert 0.5 < last.velocity.linear_m_s[2] < 1.5  # nominal approaches at 0.7 to 1.3 m/s, along the optical axis


def imu(t_ns, rate, quat_xyzw, force, *, oriented=0.0):
    def make(store):
        Vector3, Quaternion, Imu = (
            store.types[name]
            for name in ("geometry_msgs/msg/Vector3", "geometry_msgs/msg/Quaternion", "sensor_msgs/msg/Imu")
        )
        covariance, unknown = np.diag([1e-6] * 3).reshape(-1), np.zeros(9)
        orientation_covariance = np.full(9, oriented)
        return Imu(
            header(store, t_ns),
            Quaternion(*quat_xyzw),
            orientation_covariance,
            Vector3(*rate),
            covariance,
            Vector3(*force),
            unknown,
        )

    return make


def pressure(t_ns, pascal):
    def make(store):
        return store.types["sensor_msgs/msg/FluidPressure"](header(store, t_ns), pascal, 0.0)

    return make


def twist(t_ns, linear):
    def make(store):
        Vector3 = store.types["geometry_msgs/msg/Vector3"]
        inner = store.types["geometry_msgs/msg/Twist"](Vector3(*linear), Vector3(0.0, 0.0, 0.0))
        known = store.types["geometry_msgs/msg/TwistWithCovariance"](inner, np.eye(6).reshape(-1) * 4e-4)
        return store.types["geometry_msgs/msg/TwistWithCovarianceStamped"](header(store, t_ns), known)

    return make


@pytest.mark.parametrize("kind", ["mcap", "db3", "bag"])
def test_bags_give_rates_tilt_depth_and_velocity(tmp_path, kind):
    s, pixels = 10**9, np.zeros((6, 8), np.uint8)
    level, rolled = (0.0, 0.0, 0.0, 1.0), (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))  # by 90 degrees about x
    messages = [
        ("/camera", 2 * s, raw(2 * s, pixels, "mono8")),
        ("/imu", 2 * s, imu(2 * s + 1, (0.1, -0.2, 0.3), level, (0.0, 0.0, 9.8))),
        ("/imu", 3 * s, imu(3 * s, (0.0, 0.0, 0.0), rolled, (0.0, 0.0, 9.8))),
        ("/imu", 4 * s, imu(4 * s, (0.0, 0.0, 0.0), (0.0,) * 4, (0.0, 9.81, 0.0), oriented=-1.0)),
        ("/imu", 5 * s, imu(5 * s, (0.0, 0.0, 0.0), (0.0,) * 4, (0.0, 14.0, 0.0), oriented=-1.0)),
        ("/pressure", 6 * s, pressure(6 * s, 101325.0 + 1025.0 * 9.80665 * 7.0)),
        ("/dvl", 7 * s, twist(7 * s, (0.35, 0.01, -0.02))),
    ]
    found = list(open_source(write(tmp_path / "recording", kind, messages)).sensors())
    by_kind = {name: [one for one in found if one.kind == name] for name in ("gyro", "tilt", "depth", "velocity")}
    assert [one.t_ns for one in by_kind["gyro"]] == [2 * s + 1, 3 * s, 4 * s, 5 * s]
    assert_allclose(by_kind["gyro"][0].value, (0.1, -0.2, 0.3))
    assert_allclose(by_kind["gyro"][0].sigma, 1e-3)
    upward = [one.value / np.linalg.norm(one.value) for one in by_kind["tilt"]]
    assert_allclose(upward, [(0, 0, 1), (0, 1, 0), (0, 1, 0)], atol=1e-9)
    assert_allclose([one.value[0] for one in by_kind["depth"]], [7.0])
    assert_allclose(by_kind["velocity"][0].value, (0.35, 0.01, -0.02))
    assert_allclose(by_kind["velocity"][0].sigma, 0.02)
