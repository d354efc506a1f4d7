import json

import cv2
import numpy as np
import pytest
import yaml
from conftest import assert_close, refused
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from lumidock.camera import Camera, save_camera
from lumidock.errors import InputError, LumidockError
from lumidock.setup.calibration_files import read_calibration, write_calibration
from lumidock.streams.calibration_check import check

K = np.array([[800.0, 0, 639.5], [0, 801.0, 511.5], [0, 0, 1]])
CAMERAS = {
    "radtan": Camera(1280, 1024, K, "plumb_bob", np.array([-0.2, 0.05, 0.001, -0.002])),
    "radtan5": Camera(1280, 1024, K, "plumb_bob", np.array([-0.2, 0.05, 0.001, -0.002, 0.01])),
    "equidistant": Camera(1280, 1024, K, "equidistant", np.array([0.01, -0.002, 0.001, 0.0])),
    "rational": Camera(1280, 1024, K, "rational_polynomial", np.array([0.1, 0.02, 0, 0, 0.001, 0.2, 0.01, 0.001])),
}
KALIBR = """\
cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.2, 0.05, 0.001, -0.002]
  distortion_model: radtan
  intrinsics: [800.0, 801.0, 639.5, 511.5]
  resolution: [1280, 1024]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.1]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [0.01, -0.002, 0.001, 0.0]
  distortion_model: equi
  intrinsics: [800.0, 801.0, 639.5, 511.5]
  resolution: [1280, 1024]
"""


def same(a, b):
    assert (a.width, a.height, a.model) == (b.width, b.height, b.model)
    assert_array_equal(a.K, b.K)
    n = max(len(a.distortion), len(b.distortion))
    assert_array_equal(
        np.pad(a.distortion, (0, n - len(a.distortion))), np.pad(b.distortion, (0, n - len(b.distortion)))
    )


@pytest.mark.parametrize("form", ["ros", "kalibr", "opencv"])
@pytest.mark.parametrize("name", CAMERAS)
def test_what_is_written_is_read_again(tmp_path, form, name):
    path = tmp_path / "camera.yaml"
    if form == "kalibr" and name in ("radtan5", "rational"):
        with refused(path, "Kalibr has no distortion model"):
            write_calibration(CAMERAS[name], path, form)
        return
    write_calibration(CAMERAS[name], path, form)
    same(read_calibration(path), CAMERAS[name])


def test_a_camera_of_a_camchain_is_chosen(tmp_path):
    path = tmp_path / "camchain.yaml"
    path.write_text(KALIBR)
    same(read_calibration(path, name="cam0"), CAMERAS["radtan"])
    same(read_calibration(path, name="cam1"), CAMERAS["equidistant"])
    with refused(path, "choose with --name: cam0, cam1"):
        read_calibration(path)
    with refused(path, "no camera cam7"):
        read_calibration(path, name="cam7")


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (("pinhole", "omni"), "camera model 'omni'"),
        (("radtan", "fov"), "distortion model 'fov'"),
        (("800.0, 801.0, 639.5, 511.5", "800.0, 801.0"), "intrinsics"),
        (("800.0", ".nan"), "intrinsics"),
        (("-0.2, 0.05", "-0.2"), "takes 4 or 5 numbers"),
        (("1280, 1024", "0, 1024"), "0x1024"),
    ],
)
def test_a_camchain_that_cannot_be_used_is_refused(tmp_path, change, match):
    path = tmp_path / "camchain.yaml"
    path.write_text(KALIBR.split("cam1:")[0].replace(*change))
    with refused(path, match):
        read_calibration(path)


@pytest.mark.parametrize("suffix", ["yaml", "xml", "json"])
def test_files_of_opencv_are_read(tmp_path, suffix):
    path = tmp_path / f"camera.{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("cameraMatrix", K)
    storage.write("distCoeffs", np.array([[-0.2, 0.05, 0.001, -0.002, 0.01]]))
    storage.release()
    with refused(path, "give --size"):
        read_calibration(path)
    same(read_calibration(path, size=(1280, 1024)), CAMERAS["radtan5"])


def test_another_size_is_refused(tmp_path):
    path = tmp_path / "camera.yaml"
    save_camera(CAMERAS["radtan"], path)
    with refused(path, "made for 1280x1024 pixels, not for 640x512"):
        read_calibration(path, size=(640, 512))


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(draw=st.data())
@pytest.mark.parametrize("form", ["ros", "kalibr", "opencv"])
def test_a_spoilt_file_is_one_line_at_most(tmp_path, form, draw):
    path = tmp_path / "camera.yaml"
    write_calibration(CAMERAS["radtan"], path, form)
    data = bytearray(path.read_bytes())
    for _ in range(draw.draw(st.integers(1, 6))):
        data[draw.draw(st.integers(0, len(data) - 1))] = draw.draw(st.integers(0, 255))
    path.write_bytes(data[: draw.draw(st.integers(0, len(data)))])
    try:
        read_calibration(path)
    except LumidockError as error:
        lines = str(error).splitlines()
    else:
        lines = [""]
    assert len(lines) == 1


def seen_through_a_port(lens_px, angles, n=1.333):
    """Pixels off the axis of rays at `angles` in water, behind a flat port, by Snell's law and a perfect lens."""
    return lens_px * np.tan(np.arcsin(n * np.sin(angles)))


def test_a_flat_port_is_told_from_air_by_its_curvature():
    angles = np.linspace(0.0, 0.45, 200)
    x, r = np.tan(angles), seen_through_a_port(1500.0, angles)
    radial = np.linalg.lstsq(np.stack([x, x**3, x**5, x**7], 1), r, rcond=None)[0]
    K_wet = np.array([[radial[0], 0, 1223.5], [0, radial[0], 1023.5], [0, 0, 1]])
    k1, k2, k3 = radial[1:] / radial[0]
    wet = Camera(2448, 2048, K_wet, "plumb_bob", np.array([k1, k2, 0, 0, k3]))
    assert_close(radial[0] / 1500.0, 1.333, atol=2e-3)
    assert not check(wet).warnings
    assert not check(wet, lens_mm=1500 * 3.45e-3, pixel_um=3.45).warnings
    assert_close(check(wet).curvature, 0.388, atol=0.03)
    K_air = np.array([[1500.0, 0, 1223.5], [0, 1500.0, 1023.5], [0, 0, 1]])
    dry = Camera(2448, 2048, K_air, "plumb_bob", np.array([-0.1, 0.01, 0, 0, 0]))
    assert "made in air" in check(dry).warnings[0]
    assert "25 % short" in check(dry, lens_mm=1500 * 3.45e-3, pixel_um=3.45).warnings[0]


def test_oddities_are_named():
    camera = Camera(
        1000, 1000, np.array([[500.0, 0, 700], [0, 600.0, 499.5], [0, 0, 1]]), distortion=np.array([-0.6, 0, 0, 0, 0])
    )
    text = " | ".join(check(camera).warnings)
    assert "principal point is 20 %" in text
    assert "fx / fy is 0.833" in text
    assert "folds over" in text


def test_the_field_of_view_is_that_of_the_rays():
    camera = Camera(1000, 500, np.array([[500.0, 0, 499.5], [0, 500.0, 249.5], [0, 0, 1]]))
    across, down, diagonal = check(camera).field_of_view_deg
    assert_close([across, down], np.rad2deg([2 * np.arctan(499.5 / 500), 2 * np.arctan(249.5 / 500)]), atol=1e-9)
    assert_close(diagonal, np.rad2deg(2 * np.arctan(np.hypot(499.5, 249.5) / 500)), atol=1e-9)


def test_the_commands(lumidock, tmp_path):
    (tmp_path / "camchain.yaml").write_text(KALIBR)
    camera = tmp_path / "camera.yaml"
    assert lumidock("calib", "import", tmp_path / "camchain.yaml", camera, "--name", "cam0")[0] == 0
    same(read_calibration(camera), CAMERAS["radtan"])
    code, _, err = lumidock("calib", "import", tmp_path / "camchain.yaml", camera, "--name", "cam1")
    assert (code, "give --force" in err) == (2, True)
    assert lumidock("calib", "export", camera, tmp_path / "cv.yaml", "--to", "opencv")[0] == 0
    same(read_calibration(tmp_path / "cv.yaml"), CAMERAS["radtan"])
    code, out, err = lumidock("calib", "check", camera, "--json")
    assert (code, err, json.loads(out)["width"]) == (0, "", 1280)
    (tmp_path / "frames").mkdir()
    cv2.imwrite(str(tmp_path / "frames" / "a.png"), np.zeros((512, 640), np.uint8))
    code, out, err = lumidock("calib", "check", camera, "--source", tmp_path / "frames")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "have 640x512" in err


def test_entities_in_xml_are_refused(tmp_path):
    path = tmp_path / "camera.xml"
    path.write_text('<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b "bbbb">]><opencv_storage><K>&b;</K></opencv_storage>')
    with refused(path, "entities"):
        read_calibration(path)


def test_an_alias_bomb_is_refused(tmp_path):
    bomb = "a: &a [x, x]\n" + "".join(
        f"{chr(98 + i)}: &{chr(98 + i)} [*{chr(97 + i)}, *{chr(97 + i)}]\n" for i in range(20)
    )
    (tmp_path / "bomb.yaml").write_text(bomb)
    with pytest.raises(InputError, match="aliases"):
        read_calibration(tmp_path / "bomb.yaml")
    (tmp_path / "deep.yaml").write_text(yaml.safe_dump({"a": 1}) + "b: " + "[" * 20_000)
    with pytest.raises(InputError, match="nested deeper"):
        read_calibration(tmp_path / "deep.yaml")
