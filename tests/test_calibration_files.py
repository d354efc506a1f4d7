import pytest
from calibrations import FILES, PLUMB, STEREO, D, K, json, kalibr, metashape, opencv, ros, same, write, xml
from conftest import refused
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lumidock.camera import load_camera
from lumidock.errors import InputError, LumidockError
from lumidock.setup.calibration_files import read_calibration


@pytest.mark.parametrize(
    ("content", "wanted"), [row[2:] for row in FILES], ids=[f"{row[0]}: {row[1]}" for row in FILES]
)
def test_a_file_of_another_tool_is_read_or_refused_by_its_name(tmp_path, content, wanted):
    path = write(tmp_path / "calibration", content)
    if isinstance(wanted, tuple):
        assert same(read_calibration(path), wanted)
        return
    with pytest.raises(InputError) as caught:
        read_calibration(path)
    assert wanted in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_one_of_a_stereo_pair_is_read_by_its_name(tmp_path):
    other = STEREO.replace("700.0", "900.0", 1)
    path = write(tmp_path / "stereo.yml", "%YAML:1.0\n---\n" + other)
    assert read_calibration(path, name="1").focal_px[0] == 900.0
    assert same(read_calibration(path, name="M2"), PLUMB)


def test_text_in_utf_16_is_read(tmp_path):
    for encoding in ("utf-16", "utf-16-le", "utf-16-be"):
        mark = "" if encoding == "utf-16" else "\ufeff"
        (tmp_path / "camera.yaml").write_bytes((mark + ros()).encode(encoding))
        assert same(load_camera(tmp_path / "camera.yaml"), PLUMB)


def test_two_distortions_that_differ_are_refused(tmp_path):
    both = json.dumps({"K": K, "dist": D, "distCoeffs": [0.0] * 5, "image_size": [640, 480]})
    with refused(write(tmp_path / "a.json", both), "distortions that differ: dist, distCoeffs"):
        read_calibration(tmp_path / "a.json")


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(draw=st.data())
@pytest.mark.parametrize("content", [opencv(), xml(), ros(), kalibr(), metashape(), *(row[2] for row in FILES[-22:-4])])
def test_a_spoilt_file_is_read_or_one_line(tmp_path, content, draw):
    data = bytearray(content.encode())
    for _ in range(draw.draw(st.integers(1, 5))):
        data[draw.draw(st.integers(0, len(data) - 1))] = draw.draw(st.integers(0, 255))
    path, lines = tmp_path / "calibration", [""]
    path.write_bytes(data[: draw.draw(st.integers(0, len(data)))] if draw.draw(st.booleans()) else data)
    try:
        read_calibration(path)
    except LumidockError as error:
        lines = str(error).splitlines()
    assert len(lines) == 1
