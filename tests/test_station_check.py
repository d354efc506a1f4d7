import json
import math
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import tomllib
import yaml
from conftest import assert_close

from lumidock.camera import load_camera
from lumidock.cli.shared import shipped_or_path
from lumidock.config import Config
from lumidock.evaluation.dead_lights import NO_LEVEL, Approach, least_confusion_m
from lumidock.evaluation.station_advice import dead_light_rows, warnings
from lumidock.evaluation.station_check import Requirements, head_on, in_view, inspect_station
from lumidock.station import load_station

REQUIRED = Requirements(1.5, 4, 20.0)
CAGE = shipped_or_path("station", "cage-2x2x5")
FOUR = [[-0.5, 0.4], [0.5, 0.3], [0.4, -0.4], [-0.3, -0.45]]
LENS = load_camera(shipped_or_path("camera", "imx264-60deg"))


def dock(path, positions, layer="front", **more):
    lights = [{"id": f"L{i}", "layer": layer, "position": list(map(float, p))} | more for i, p in enumerate(positions)]
    path.write_text(yaml.safe_dump({"schema": 1, "name": "made", "lights": lights}))
    return load_station(path)


def test_lights_are_seen_inside_the_picture_and_their_beams(tmp_path):
    station = dock(tmp_path / "a.yaml", [[0, 0, 0], [1, 0, 0], [0, 1, 0], [20, 0, 0]], beam_deg=60.0)
    assert in_view(station, LENS, head_on(10.0)).lights.tolist() == [0, 1, 2]
    assert in_view(station, LENS, head_on(1.0)).lights.tolist() == [0]  # the others shine past the camera
    assert in_view(station, LENS, head_on(-1.0)).lights.tolist() == []


def test_the_shipped_cage_passes_and_its_levels_are_those_of_the_lights():
    result = inspect_station(load_station(CAGE), LENS, Config(), REQUIRED)
    assert result["failed"] == []
    assert result["layers"] == {"front": 7, "rear": 6}
    rows = {row["z_m"]: row for row in result["corridor"]}
    assert rows[18]["lights"] == {"front": 7, "rear": 6}
    assert (rows[18]["stage"], rows[-1]["stage"]) == ("transition", "rear")
    assert rows[3]["lateral_m"] < rows[10]["lateral_m"] < rows[30]["lateral_m"]
    four = next(row for row in result["confusions"] if (row["layer"], row["seen"]) == ("front", 4))
    assert_close(four["assignment_px"], four["assignment_m"] * 2087.0 / 18.0, atol=0.1)


def test_a_small_single_ring_guides_long_before_it_gives_a_pose(lumidock, tmp_path):
    p = [[0.30, 0.28, 0], [-0.03, 0.39, 0], [-0.35, 0.0, 0], [-0.24, -0.32, 0], [0.30, -0.29, 0]]
    station = dock(tmp_path / "a.yaml", p)
    rows = inspect_station(station, LENS, Config(), REQUIRED)["corridor"]
    guided, valid = ({row["z_m"] for row in rows if row[word]} for word in ("guide", "valid"))
    assert max(guided) > 10.0 > max(valid)
    own = station.alert_limits.guide
    for row in rows:
        if row["guide"] and not row["valid"]:  # by limits of its own
            assert row["bearing_deg"] < math.degrees(own.bearing_rad)
            assert row["range_m"] < max(own.range_m, own.range_share * row["z_m"])
        assert (row["bearing_deg"] is None) == (row["z_m"] - (row["range_m"] or 0.0) < own.from_m)
    _, out, _ = lumidock("station", "check", tmp_path / "a.yaml")
    assert f"guidance (bearing and range) is to be expected from z = {max(guided):g} m on" in out


def test_a_square_of_lights_fails_for_its_mirror_image(tmp_path):
    station = dock(tmp_path / "a.yaml", [[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]])
    failed = inspect_station(station, LENS, Config(), REQUIRED)["failed"]
    assert any("mirror image of L0 L1 L2 L3 taken for" in text and "fits within 0.00 px" in text for text in failed)


def test_a_ring_is_unsafe_beyond_half_the_step_of_its_lights(lumidock, tmp_path):
    angle = np.arange(8) * np.pi / 4
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(8)], axis=1)
    result = inspect_station(dock(tmp_path / "a.yaml", ring), LENS, Config(), REQUIRED)
    assert_close(result["unsafe_roll_deg"], 22.5, atol=1e-6)
    kinds = {row["kind"] for row in result["self_fits"]}
    assert kinds == {"rotation", "mirror"}
    _, out, _ = lumidock("station", "check", tmp_path / "a.yaml")
    assert "unsafe beyond 22.5 degrees of roll without an attitude sensor" in out
    assert "turned by 45.0 degrees" in out.replace("-45.0", "45.0")


def test_the_shipped_cage_fits_itself_nowhere_else(lumidock):
    _, out, _ = lumidock("station", "check", CAGE)
    assert "nowhere else" in out
    assert "unsafe" not in out


def test_a_wide_dock_goes_dark_up_close(tmp_path):
    wide = [[3, 2.7, 0], [-3, 2.2, 0], [-2.6, -2.4, 0], [3.1, -1.9, 0], [0.7, 2.9, 0]]
    failed = inspect_station(dock(tmp_path / "a.yaml", wide), LENS, Config(), REQUIRED)["failed"]
    assert any("fewer than 4 lights" in text and " 1.5" in text for text in failed)


def test_a_warning_says_which_lights_are_missing_and_why(tmp_path):
    positions = [[0.1, 0.1, 0], [-0.2, 0.1, 0], [0.1, -0.2, 0], [4, 0, 0]]
    path = tmp_path / "a.yaml"
    lights = [{"id": f"L{i}", "layer": "front", "position": p} for i, p in enumerate(positions)]
    lights[2] |= {"axis": [0, 1, 0.1], "beam_deg": 30}
    path.write_text(yaml.safe_dump({"schema": 1, "name": "made", "docking_point": [0, 0, 2], "lights": lights}))
    failed = inspect_station(load_station(path), LENS, Config(), Requirements(0.0, 4, 5.0))["failed"]
    (text,) = [text for text in failed if "in view" in text]
    assert text.endswith("at 5 m: L0 L1 seen, L3 outside the image, L2 shining past the camera")


def test_the_approach_ends_at_the_docking_point(tmp_path):
    for end in (2.25, 0.0, -1.5):
        path = tmp_path / "a.yaml"
        lights = [{"id": f"L{i}", "layer": "only", "position": [x, y, 0]} for i, (x, y) in enumerate(FOUR)]
        path.write_text(yaml.safe_dump({"schema": 1, "name": "a", "docking_point": [0, 0, end], "lights": lights}))
        rows = inspect_station(load_station(path), LENS, Config(), REQUIRED)["corridor"]
        assert rows[-1]["z_m"] == end
        assert {row["stage"] for row in rows} <= {"front", "search"}  # a lone layer is no rear layer
        dark = [row for row in rows if not any(row["lights"].values())]
        assert bool(dark) == (end < 1.0)  # nearer than that the lights are outside the image
        assert not any(row["valid"] or row["lateral_m"] for row in dark)


def test_the_stations_own_alert_limits_decide_what_is_valid(tmp_path):
    text = CAGE.read_text() + "alert_limits: [{below_z_m: 100, lateral_m: 0.001, axial_m: 0.001, angle_deg: 0.1}]\n"
    (tmp_path / "strict.yaml").write_text(text)
    result = inspect_station(load_station(tmp_path / "strict.yaml"), LENS, Config(), REQUIRED)
    assert not any(row["valid"] for row in result["corridor"])
    assert "z < 100 m: lateral 0.001 m" in result["alert_limits"]


def test_more_dead_lights_are_never_better_and_the_warning_moves_a_light_that_helps(tmp_path):
    station = dock(tmp_path / "a.yaml", [[0.5, 0.4, 0], [-0.5, 0.3, 0], [-0.4, -0.4, 0], [0.3, -0.45, 0], [0.9, 0, 0]])
    approach = Approach(3.0, 1.6, 0.2, np.full(5, np.inf))
    rows = dead_light_rows(station, LENS, Config(), approach, 2)
    assert [len(row["lights"]) for row in rows] == [0, 1, 2]
    assert rows[0]["worst"] <= rows[1]["worst"] <= rows[2]["worst"] == NO_LEVEL  # three lights give no pose
    assert all((row["worst"] >= 1.0) == bool(row["not_valid"]) for row in rows)
    assert rows[2]["not_valid"][-1][1] == pytest.approx(1.6, abs=0.2)


def test_a_warning_moves_a_light_that_parts_what_is_confused(tmp_path):
    square = np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]], float)
    station = dock(tmp_path / "a.yaml", square)
    checked = inspect_station(station, LENS, Config(), REQUIRED)
    checked["dead_lights"] = []
    told = warnings(station, LENS, Config(), Approach(4.0, 2.0, 0.2, np.full(4, np.inf)), checked)
    assert any("in one plane" in text for text in told)
    (text,) = [text for text in told if "layer front is easily confused" in text]
    found = re.search(r"move L(\d) by 0\.1 m along ([+-])([xyz]): .* becomes (\S+) m", text)
    square[int(found[1]), "xyz".index(found[3])] += float(f"{found[2]}0.1")
    assert least_confusion_m(dock(tmp_path / "b.yaml", square))["front"] == pytest.approx(float(found[4]), abs=6e-4)
    assert float(found[4]) > 0.01


def test_depth_counts_where_lights_are_confused(tmp_path):
    flat = [[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]]
    deep = [[1, 1, 0], [-1, 1, -3], [-1, -1, 0], [1, -1, 0]]
    row = [
        inspect_station(dock(tmp_path / "a.yaml", p), LENS, Config(), REQUIRED)["confusions"][0]["assignment_m"]
        for p in (flat, deep)
    ]
    # from 18 m a light 3 m deeper seems 1 / 7 nearer to the axis; a quarter turn is no roll, so that nothing else fits
    assert row[1] != pytest.approx(row[0], abs=0.01)


def test_many_lights_are_looked_at_in_bounded_time(tmp_path):
    rng = np.random.default_rng(4)
    station = dock(tmp_path / "a.yaml", np.column_stack([rng.uniform(-1, 1, (30, 2)), np.zeros(30)]))
    rows = inspect_station(station, LENS, Config(), REQUIRED)["confusions"]
    assert rows[-1]["assignment_m"] is None


def test_the_command_draws_and_its_exit_code_serves_a_build(lumidock, tmp_path):
    code, out, err = lumidock("station", "check", CAGE, "--picture", tmp_path / "dock.png")
    assert (code, err) == (0, "")
    assert "all checks passed" in out
    assert cv2.imread(str(tmp_path / "dock.png")).shape[0] > 400
    dock(tmp_path / "a.yaml", [[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]])
    code, out, err = lumidock("station", "check", tmp_path / "a.yaml", "--json")
    assert (code, err) == (1, "")
    assert json.loads(out)["failed"]


# The machine and the settings


def test_doctor_names_every_extra(lumidock):
    code, out, err = lumidock("doctor", "--json")
    assert (code, err) == (0, "")
    found = {finding["what"]: finding for finding in json.loads(out)}
    assert all(found[f"[{name}]"]["mark"] == "ok" for name in ("bag", "video", "mavlink", "zenoh", "live", "rerun"))
    extras = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    assert {what for what in found if what.startswith("[")} == {f"[{name}]" for name in extras if name != "all"}
    assert found["Python"]["mark"] == "ok"


def test_doctor_says_what_is_in_the_way(monkeypatch, tmp_path):
    import socket

    from lumidock.app import doctor

    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        assert doctor._port("page", taken.getsockname()[1]).mark == "note"
    monkeypatch.setattr("lumidock._kernels.compiling.FOLDER", tmp_path)
    assert doctor._caches().mark == "note"
    monkeypatch.setattr("lumidock._kernels.compiling.FOLDER", None)
    assert doctor._caches().mark == "bad"
    monkeypatch.setattr("time.time", lambda: 5.0)
    assert doctor._clock().mark == "bad"
    assert "lumidock[none]" in doctor._extra("none", ("no_such_module",)).text


def test_what_config_dumps_is_a_config(lumidock, tmp_path):
    code, out, err = lumidock("config", "dump")
    assert (code, err) == (0, "")
    (tmp_path / "all.yaml").write_text(out)
    assert lumidock("config", "dump", "--config", tmp_path / "all.yaml") == (0, out, "")
    (tmp_path / "one.yaml").write_text("match: {noise_px: 0.75}\n")
    changed = yaml.safe_load(lumidock("config", "dump", "--config", tmp_path / "one.yaml")[1])
    assert changed["match"]["noise_px"] == 0.75
    schema = json.loads(lumidock("config", "schema")[1])
    assert "match" in schema["properties"]


COMMANDS = (
    *(("run",), ("sim",), ("eval",), ("campaign",), ("demo",), ("inspect",), ("export",), ("serve",), ("doctor",)),
    *(("calib", "import"), ("calib", "export"), ("calib", "check"), ("station", "check")),
    *(("config", "dump"), ("config", "schema")),
)


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_help_has_examples_that_name_the_command(lumidock, command):
    code, out, err = lumidock(*command, "--help")
    assert (code, err) == (0, "")
    assert f"lumidock {' '.join(command)}" in out.split("Examples:")[1]


def test_the_shell_completes_commands(lumidock, monkeypatch):
    monkeypatch.setenv("_LUMIDOCK_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", "lumidock ins")
    monkeypatch.setenv("COMP_CWORD", "1")
    assert lumidock()[1].split() == ["inspect"]
