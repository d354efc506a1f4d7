import os
from threading import Thread

import pytest
from conftest import refused
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel, ConfigDict

from lumidock.camera import load_camera
from lumidock.errors import InputError
from lumidock.sim.scenario import load_scenario
from lumidock.station import load_station
from lumidock.yamlfile import MAX_BYTES, read_mapping, validate

REFUSALS = {
    "empty": (b"", "keys and values"),
    "list": (b"[1, 2]", "keys and values"),
    "scalar": (b"word", "keys and values"),
    "binary": (bytes(range(256)), "not valid YAML"),
    "control character": (b"a: \x00", "not valid YAML"),
    "open bracket": (b"a: [1,\n2", "not valid YAML"),
    "tab": (b"a:\n\t- 1", "not valid YAML"),
    "two documents": (b"a: 1\n---\nb: 2", "single document"),
    "key twice": (b"a: 1\nb: 2\na: 3", "'a' given twice"),
    "inner key twice": (b"a: {b: 1, b: 2}", "'b' given twice"),
    "list as key": (b"? [1, 2]\n: 3", "unhashable"),
    "alias": (b"a: &x [1]\nb: *x", "aliases are not allowed"),
    "merge": (b"<<: {a: 1}", "not valid YAML"),
    "python tag": (b"a: !!python/object/apply:os.getcwd []", "tags are not allowed"),
    "wrong bool tag": (b'a: !!bool "perhaps"', "tags are not allowed"),
    "empty int tag": (b'a: !!int ""', "tags are not allowed"),
    "wrong time tag": (b"a: !!timestamp noon", "tags are not allowed"),
    "no such day": (b"a: 2001-99-99", "month must be"),
    "endless integer": (b"a: " + b"1" * 5000, "digits"),
    "20,000 brackets": (b"a: " + b"[" * 20_000, "nested deeper than 20"),
    "20,000 braces": (b"{a: " * 20_000, "nested deeper than 20"),
    "20,000 dashes": (b"- " * 20_000, "nested deeper than 20"),
    "over 1 MiB": (b"# " + b"x" * MAX_BYTES, "larger than 1048576 bytes"),
}


@pytest.mark.parametrize(("content", "match"), REFUSALS.values(), ids=REFUSALS)
def test_a_bad_file_is_refused(content, match, tmp_path):
    path = tmp_path / "file.yaml"
    path.write_bytes(content)
    with refused(path, match):
        read_mapping(path)


@pytest.mark.parametrize(
    ("name", "match"), [("absent.yaml", "No such file"), (".", "Is a directory"), ("nul\0byte", "null byte")]
)
def test_what_is_no_file_is_refused(name, match, tmp_path):
    with refused(tmp_path / name, match):
        read_mapping(tmp_path / name)


def test_a_pipe_is_capped_as_well(tmp_path):
    path = tmp_path / "pipe.yaml"
    os.mkfifo(path)

    cut_off = []

    def feed():
        try:
            path.write_bytes(bytes(4 * MAX_BYTES))
        except BrokenPipeError:
            cut_off.append(True)

    writer = Thread(target=feed)
    writer.start()
    with refused(path, "larger than"):
        read_mapping(path)
    writer.join()
    assert cut_off


@given(st.one_of(st.binary(max_size=60), st.text("[]{}:,-?&*!|>%@#'\"\\ \n\tab01.~<=_", max_size=60)))
def test_any_content_gives_a_mapping_or_one_line(tmp_path_factory, content):
    path = tmp_path_factory.getbasetemp() / "any.yaml"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    mapping, refusal = {}, ""
    try:
        mapping = read_mapping(path)
    except InputError as error:
        refusal = str(error)
    assert isinstance(mapping, dict)
    assert len(refusal.splitlines()) <= 1


def test_a_mapping_is_read_as_it_stands(tmp_path):
    path = tmp_path / "file.yaml"
    path.write_text("\ufeffname: dök\nnested: {list: [1, 2.5, true, ~]}\n", encoding="utf-8")
    assert read_mapping(path) == {"name": "dök", "nested": {"list": [1, 2.5, True, None]}}


class Settings(BaseModel):
    model_config = ConfigDict(extra="forbid")
    gain: float
    inner: dict[str, int] = {}


def test_validate_returns_the_model():
    assert validate(Settings, {"gain": 2}, "here") == Settings(gain=2.0)


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ({}, "here: gain: Field required"),
        ({"gain": 1, "gian": 2}, "here: gian: unknown key"),
        ({"gain": 1, "two\nlines\x85": 2}, "here: two lines: unknown key"),
        ({"gain": 1, 5: 2}, "here: 5: Keys should be strings"),
        ({"gain": 1, "inner": {"a": "b"}}, "here: inner.a: Input should be a valid integer"),
    ],
)
def test_validate_names_the_place(content, text):
    with pytest.raises(InputError) as caught:
        validate(Settings, content, "here")
    assert str(caught.value).startswith(text)
    assert len(str(caught.value).splitlines()) == 1


OTHER_KINDS = {
    "camera": ("image_width: 5\ncamera_matrix: {}", "this is a camera file, wanted a station file"),
    "camchain": ("cam0: {intrinsics: [1, 2, 3, 4]}", "this is a Kalibr camchain file, wanted a station file"),
    "vehicle": ("schema: 1\nT_body_cam: {}", "this is a vehicle file"),
    "configuration": ("match: {noise_px: 1}\ntrack: {}", "this is a configuration file"),
    "scenario": ("name: x\npath: {}\nwater: {}", "this is a scenario file"),
}


@pytest.mark.parametrize(("text", "match"), OTHER_KINDS.values(), ids=OTHER_KINDS)
def test_a_file_of_another_kind_is_recognised(tmp_path, text, match):
    (tmp_path / "a.yaml").write_text(text)
    with refused(tmp_path / "a.yaml", match):
        load_station(tmp_path / "a.yaml")


def test_a_camchain_for_a_camera_is_told_how_to_become_one(tmp_path):
    (tmp_path / "a.yaml").write_text("cam0: {intrinsics: [1, 2, 3, 4]}")
    with refused(tmp_path / "a.yaml", "lumidock calib import"):
        load_camera(str(tmp_path / "a.yaml"))
    (tmp_path / "b.yaml").write_text("schema: 1\nlights: []")
    with refused(tmp_path / "b.yaml", "this is a station file, wanted a camera file"):
        load_camera(tmp_path / "b.yaml")


@pytest.mark.parametrize(
    ("setting", "match"),
    [
        ("path.speed_ms=1", r"path.speed_ms: unknown key, did you mean speed_m_s\? \(known here: kind, start_z_m, "),
        ("lamps.layer=all", "lamps.layer: unknown key, did you mean layers"),
        ("wter.kind=1", "wter: unknown key, did you mean water"),
        ("detections.attitude.bias=3", "detections.attitude.bias: unknown key, did you mean bias_deg"),
        ("path.zzz=1", r"path.zzz: unknown key \(known here: kind"),
    ],
)
def test_an_unknown_key_suggests_the_nearest_and_lists_its_section(setting, match):
    with refused("approach", match):
        load_scenario("approach", (setting,))
