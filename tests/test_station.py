import numpy as np
import pytest
import yaml
from conftest import assert_close, refused
from numpy.testing import assert_array_equal

from lumidock.station import load_station

SMALL = """\
schema: 1
name: small
lights:
  - {id: F1, layer: front, position: [-1.0, 0.5, 0.0]}
  - {id: F2, layer: front, position: [1.0, 0.5, 0.0]}
  - {id: F3, layer: front, position: [0.0, -0.5, 0.0]}
  - {id: R1, layer: rear, position: [0.0, 0.25, -5.0]}
"""
FULL = """\
schema: 1
name: full
frame: dock
docking_point: [0, 0.1, -3]
survey_sigma: {light_m: 0.004, layer_m: 0}
calibration_sigma: {focal: 0.01, center_px: 5}
lights:
  - {id: r-1, layer: rear, position: [0, 0, -5], color: blue, axis: [0, 3, 4], beam_deg: 60, power_w: 0.5}
  - {id: F_1, layer: front, position: [-1, 0, 0]}
  - {id: F_2, layer: front, position: [1, 0, 0]}
  - {id: r-2, layer: rear, position: [0, 1, -5], color: cyan}
"""


@pytest.fixture
def load(tmp_path):
    def load_text(text):
        (tmp_path / "station.yaml").write_text(text)
        return load_station(tmp_path / "station.yaml")

    return load_text


def test_defaults_are_those_of_the_contract(load):
    station = load(SMALL)
    assert (station.name, station.ids, station.layers) == (
        "small",
        ("F1", "F2", "F3", "R1"),
        ("front", "rear"),
    )
    assert_array_equal(station.p_dock, [[-1, 0.5, 0], [1, 0.5, 0], [0, -0.5, 0], [0, 0.25, -5]])
    assert_array_equal(station.layer, [0, 0, 0, 1])
    assert_array_equal(station.axis, [[0, 0, 1]] * 4)
    assert_array_equal(station.beam_deg, [120] * 4)
    assert_array_equal(station.power_w, [2] * 4)
    assert station.color == ("white",) * 4
    assert (station.sigma_light_m, station.sigma_layer_m) == (0.002, 0.005)
    assert (station.sigma_focal, station.sigma_center_px) == (0.003, 2.0)


def test_every_key_is_read(load):
    station = load(FULL)
    assert len(station) == 4
    assert_close(station.axis, [[0, 0.6, 0.8], [0, 0, 1], [0, 0, 1], [0, 0, 1]])
    assert_array_equal(station.beam_deg, [60, 120, 120, 120])
    assert_array_equal(station.power_w, [0.5, 2, 2, 2])
    assert_array_equal(station.docking_point, [0, 0.1, -3])
    assert station.color == ("blue", "white", "white", "cyan")
    assert (station.sigma_light_m, station.sigma_layer_m) == (0.004, 0.0)
    assert (station.sigma_focal, station.sigma_center_px) == (0.01, 5.0)


def test_a_light_may_have_its_own_sigma(load):
    text = FULL.replace("position: [-1, 0, 0]", "position: [-1, 0, 0], sigma_m: 0.03")
    station = load(text.replace("position: [1, 0, 0]", "position: [1, 0, 0], sigma_m: [0.01, 0.02, 0.005]"))
    assert_array_equal(station.sigma_light_m, [0.004, 0.03, 0.02, 0.004])  # of three the largest, never a smaller one


@pytest.mark.parametrize(("text", "wanted"), [("", True), ("dock_exclusive: false", False)])
def test_a_dock_is_exclusive_unless_its_file_says_otherwise(load, text, wanted):
    assert load(f"{SMALL}{text}\n").dock_exclusive is wanted


def test_layers_are_told_by_name_and_depth(load):
    station = load(FULL)
    assert station.layers == ("rear", "front")
    assert station.layers_front_to_rear() == ("front", "rear")
    assert_array_equal(station.lights_of("rear"), [0, 3])
    assert_array_equal(station.lights_of("front"), [1, 2])
    with pytest.raises(ValueError, match="not in tuple"):
        station.lights_of("middle")


@pytest.mark.parametrize("n", [4, 13, 60])
def test_any_lights_survive_their_file(n, load, rng):
    p_dock, axis = rng.uniform(-25, 25, (2, n, 3))
    layer = rng.integers(0, 3, n)
    lights = [
        {"id": f"L{i}", "layer": f"layer{layer[i]}", "position": p_dock[i].tolist(), "axis": axis[i].tolist()}
        for i in range(n)
    ]
    station = load(yaml.safe_dump({"schema": 1, "name": "any", "lights": lights}))
    assert_array_equal(station.p_dock, p_dock)
    assert_close(np.cross(station.axis, axis), 0.0, atol=1e-13)
    assert_close(np.linalg.norm(station.axis, axis=1), 1.0)
    assert [station.layers[i] for i in station.layer] == [f"layer{i}" for i in layer]
    depths = [p_dock[station.lights_of(name), 2].mean() for name in station.layers_front_to_rear()]
    assert depths == sorted(depths, reverse=True)


FIRST = "{id: F1, layer: front, position: [-1.0, 0.5, 0.0]}"
REFUSALS = {
    "position nan": ("[-1.0", "[.nan", "lights F1: position entry 1: .*finite"),
    "position infinite": ("[-1.0", "[.inf", "finite"),
    "position minus infinite": ("[-1.0", "[-.inf", "finite"),
    "position 1e400": ("[-1.0", "[1e400", "finite"),
    "position 1.0e+400": ("[-1.0", "[1.0e+400", "finite"),
    "position of 400 digits": ("[-1.0", "[1" + "0" * 400, "lights F1: position entry 1"),
    "position no number": ("[-1.0", "[left", "lights F1: position entry 1"),
    "position too short": ("[-1.0, ", "[", "lights F1: position entry 3: .*required"),
    "position given twice": ("[-1.0, 0.5", "[1.0, 0.5", "F1 and F2 stand at the same position"),
    "position almost given twice": ("[-1.0, 0.5", "[1.0, 0.5009", "same position"),
    "id given twice": ("id: F1", "id: F2", "light id F2 given twice"),
    "id empty": ("id: F1", "id: ''", "lights entry 1: id"),
    "id of 33 letters": ("id: F1", "id: " + "a" * 33, f"lights {'a' * 33}: id"),
    "id with a blank": ("id: F1", "id: F 1", "lights F 1: id"),
    "id beyond ASCII": ("id: F1", "id: ä", "lights ä: id"),
    "id with a newline": ("id: F1", r'id: "F1\n"', "lights F1: id"),
    "id a number": ("id: F1", "id: 1", "lights 1: id"),
    "layer with a dot": ("layer: rear", "layer: re.ar", "lights R1: layer"),
    "no id": ("id: F1, ", "", "lights entry 1: id: Field required"),
    "no layer": ("layer: rear, ", "", "lights R1: layer: Field required"),
    "no position": (", position: [-1.0, 0.5, 0.0]", "", "lights F1: position: Field required"),
    "three lights": (f"  - {FIRST}\n", "", "3 lights, wanted at least 4"),
    "no lights": (SMALL[SMALL.index("lights") :], "", "lights: Field required"),
    "too many lights": (FIRST, "\n  - ".join([FIRST] * 1000), "1003 lights, wanted at most 1000"),
    "too large": ("[-1.0", "[-100.0", "extent of 101 m"),
    "beyond all bounds": ("[-1.0", "[-1e300", "extent of inf m"),
    "unknown key": ("name: small", "name: small\nnmae: x", "nmae: unknown key"),
    "unknown key of a light": ("id: F1", "id: F1, colour: white", "lights F1: colour: unknown key"),
    "schema 2": ("schema: 1", "schema: 2", "schema"),
    "no schema": ("schema: 1\n", "", "schema: Field required"),
    "no name": ("name: small\n", "", "name: Field required"),
    "another frame": ("name: small", "name: small\nframe: world", "frame"),
    "unknown color": ("id: F1", "id: F1, color: ultraviolet", "lights F1: color"),
    "axis without direction": ("id: F1", "id: F1, axis: [0, 0, 0]", "axis has no direction"),
    "axis beyond all bounds": ("id: F1", "id: F1, axis: [1e200, 0, 0]", "axis has no direction"),
    "axis nan": ("id: F1", "id: F1, axis: [0, 0, .nan]", "lights F1: axis entry 3"),
    "beam of nothing": ("id: F1", "id: F1, beam_deg: 0", "lights F1: beam_deg"),
    "beam over a full turn": ("id: F1", "id: F1, beam_deg: 361", "lights F1: beam_deg"),
    "no power": ("id: F1", "id: F1, power_w: 0", "lights F1: power_w"),
    "sigma of a light negative": ("id: F1", "id: F1, sigma_m: -0.1", "lights F1: sigma_m"),
    "sigma of a light of two numbers": ("id: F1", "id: F1, sigma_m: [0.1, 0.1]", "lights F1: sigma_m"),
    "negative sigma": ("name: small", "name: small\nsurvey_sigma: {light_m: -1}", "survey_sigma.light_m"),
    "infinite sigma": (
        "name: small",
        "name: small\ncalibration_sigma: {focal: .inf}",
        "calibration_sigma.focal",
    ),
    "docking point nan": ("name: small", "name: small\ndocking_point: [0, 0, .nan]", "docking_point entry 3"),
}


@pytest.mark.parametrize(("old", "new", "match"), REFUSALS.values(), ids=REFUSALS)
def test_a_bad_station_is_refused(old, new, match, load, tmp_path):
    assert SMALL.count(old) == 1
    with refused(tmp_path / "station.yaml", match):
        load(SMALL.replace(old, new))


@pytest.mark.parametrize(("size_m", "fits"), [(0.049, False), (0.051, True), (99.9, True), (100.1, False)])
def test_extent_is_bounded(size_m, fits, load, tmp_path):
    corners = size_m / np.sqrt(2) * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.5, 0.5, 0]])
    lights = [{"id": f"L{i}", "layer": "a", "position": p.tolist()} for i, p in enumerate(corners)]
    text = yaml.safe_dump({"schema": 1, "name": "square", "lights": lights})
    if fits:
        assert len(load(text)) == 4
    else:
        with refused(tmp_path / "station.yaml", "extent"):
            load(text)
