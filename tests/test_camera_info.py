from types import SimpleNamespace

import bags
import cv2
import numpy as np
import pytest
from conftest import assert_close, refused
from hypothesis import given
from hypothesis import strategies as st

from lumidock.camera import Camera
from lumidock.datatypes import Frame
from lumidock.errors import InputError
from lumidock.streams.calibration_check import impossible
from lumidock.streams.camera_info import CameraInfo, camera_of, is_rectified
from lumidock.streams.source import Reading
from lumidock.streams.sources import open_source

K = np.array([[700.0, 0, 310.5], [0, 705.0, 245.0], [0, 0, 1]])
SENSOR = Camera(640, 480, K, "plumb_bob", np.array([0.3, 0.1, 0.001, -0.002, 0.0]))
TOPIC = "/front/image_raw"


def info(**changes):
    P = np.hstack([K, np.zeros((3, 1))]).reshape(-1)
    fields = {
        "origin": "/front/camera_info",
        "frame_id": "cam",
        "size": (640, 480),
        "model": "plumb_bob",
        "d": tuple(SENSOR.distortion),
        "k": tuple(K.reshape(-1)),
        "r": tuple(np.eye(3).reshape(-1)),
        "p": tuple(P),
    }
    return CameraInfo(**(fields | changes))


@given(
    binning=st.tuples(st.integers(1, 4), st.integers(1, 4)),
    corner=st.tuples(st.integers(0, 300), st.integers(0, 200)),
    point=st.tuples(st.floats(-0.4, 0.4), st.floats(-0.3, 0.3)),
)
def test_a_point_is_seen_in_the_pixel_that_its_pixel_of_the_sensor_went_into(binning, corner, point):
    """An oracle without formulas: the window is cut out of a numbered sensor and its pixels are averaged."""
    x, y = corner
    width, height = 640 - x - x % binning[0], 480 - y - y % binning[1]
    width, height = width // binning[0] * binning[0], height // binning[1] * binning[1]
    camera, _ = camera_of(info(roi=(x, y, width, height), binning=binning))
    assert (camera.width, camera.height) == (width // binning[0], height // binning[1])
    p_cam = np.array([[*point, 1.0]])
    u, v = SENSOR.project(p_cam)[0]
    u_of = np.arange(x, x + width, dtype=float).reshape(-1, binning[0]).mean(axis=1)
    v_of = np.arange(y, y + height, dtype=float).reshape(-1, binning[1]).mean(axis=1)
    seen = camera.project(p_cam)[0]
    for got, value, centres in ((seen[0], u, u_of), (seen[1], v, v_of)):
        if centres[0] <= value <= centres[-1] and len(centres) > 1:
            assert_close(got, np.interp(value, centres, np.arange(len(centres))), atol=1e-9)


def test_a_rectified_topic_is_the_projection_matrix_without_distortion():
    new, size = cv2.getOptimalNewCameraMatrix(K, SENSOR.distortion, (640, 480), 0)[0], (640, 480)
    camera, notes = camera_of(info(p=tuple(np.hstack([new, np.zeros((3, 1))]).reshape(-1))), rectified=True)
    xy = np.array([[0.1, -0.2], [-0.25, 0.15]])
    uv = SENSOR.project(np.column_stack([xy, np.ones(2)]))
    wanted = cv2.undistortPoints(uv[:, None], K, SENSOR.distortion, P=new)[:, 0]
    assert_close(camera.project(np.column_stack([xy, np.ones(2)])), wanted, atol=1e-4)
    assert "rectified" in notes[0]
    assert (camera.width, camera.height) == size
    turned, _ = cv2.Rodrigues(np.array([0.0, 0.02, 0.0]))
    assert "1.15 degrees" in camera_of(info(r=tuple(turned.reshape(-1))), rectified=True)[1][1]
    with pytest.raises(InputError, match="projection matrix P is zero"):
        camera_of(info(p=(0.0,) * 12), rectified=True)


@pytest.mark.parametrize(
    ("topic", "rectified"),
    [
        ("/cam/image_rect", True),
        ("/cam/image_rect_color", True),
        ("/cam/rect/image", True),
        ("/cam/image_rectified", True),
        ("/cam/image_undistorted", True),
        ("/cam/image_raw", False),
        ("/direct/image", False),
        ("/correct_cam/image", False),
    ],
)
def test_the_name_of_a_topic_says_whether_it_is_rectified(topic, rectified):
    assert is_rectified(topic) is rectified


IMPOSSIBLE = {
    "of half the size": ({"k": (700, 0, 159.5, 0, 705, 119.5, 0, 0, 1)}, "outside the middle half"),
    "of 0.8 of the size": ({"k": (700, 0, 255.5, 0, 705, 191.5, 0, 0, 1)}, "about 512x384 pixels"),
    "of twice the size": ({"k": (700, 0, 639.5, 0, 705, 479.5, 0, 0, 1)}, "outside the middle half"),
    "in millimetres": ({"k": (6.0, 0, 320, 0, 6.0, 240, 0, 0, 1)}, "field of view of 178"),
    "in metres": ({"k": (70000, 0, 320, 0, 70000, 240, 0, 0, 1)}, "field of view of 0.5"),
    "flat": ({"k": (700, 0, 320, 0, 200, 240, 0, 0, 1)}, "fx / fy is 3.5"),
    "folded": ({"d": (-9.0, 0, 0, 0, 0)}, "no ray"),
    "of one pixel": ({"size": (1, 1), "k": (1, 0, 0, 0, 1, 0, 0, 0, 1)}, "1x1 pixels"),
    "off the sensor": ({"roi": (600, 0, 100, 100)}, "is not on a sensor of"),
}


@pytest.mark.parametrize(("changes", "match"), IMPOSSIBLE.values(), ids=IMPOSSIBLE)
def test_what_no_camera_has_is_refused_with_its_numbers(changes, match):
    with pytest.raises(InputError, match=match) as caught:
        camera_of(info(**changes))
    assert len(str(caught.value).splitlines()) == 1
    if "roi" not in changes:
        assert "--trust-calibration" in str(caught.value)
        camera_of(info(**changes), trusted=True)


@given(st.floats(0.4, 3.0), st.floats(-0.05, 0.05), st.floats(-0.05, 0.05))
def test_cameras_that_are_made_are_taken(focal, off_x, off_y):
    matrix = np.array([[focal * 640, 0, 319.5 + off_x * 640], [0, focal * 640, 239.5 + off_y * 640], [0, 0, 1]])
    assert impossible(Camera(640, 480, matrix)) == ""


def bag(tmp_path, messages, kind="mcap"):
    return bags.write(tmp_path / kind, kind, messages)


def pictures(topic=TOPIC, count=3, size=(640, 480), start=10):
    image = np.zeros(size[::-1], np.uint8)
    return [(topic, start + i, bags.raw(start + i, image, "mono8")) for i in range(count)]


OTHER = Camera(640, 480, np.array([[500.0, 0, 320], [0, 500.0, 240], [0, 0, 1]]))
# the pictures, calibrations (ours first), other pictures, and the calibration that belongs or what is said
TOPICS = {
    "beside": (TOPIC, ["/front/camera_info", "/rear/camera_info"], [], "/front/camera_info"),
    "below": (TOPIC, ["/front/image_raw/camera_info", "/rear/camera_info"], [], "/front/image_raw/camera_info"),
    "rectified": (
        "/front/image_rect",
        ["/front/camera_info_rect", "/front/camera_info"],
        [],
        "/front/camera_info_rect",
    ),
    "in its namespace": (TOPIC, ["/front/calibration", "/rear/camera_info"], [], "/front/calibration"),
    "above": ("/front/left/image_raw", ["/front/camera_info", "/rear/camera_info"], [], "/front/camera_info"),
    "two in its namespace": (TOPIC, ["/front/a/camera_info", "/front/b/camera_info"], [], "several calibrations"),
    "another camera's": (TOPIC, ["/rear/camera_info"], ["/rear/image_raw"], "may be another camera's"),
    "another's, alone": (TOPIC, ["/rear/camera_info"], [], "may be another camera's"),
    "above two": ("/s/left/image_raw", ["/s/camera_info"], ["/s/right/image_raw"], "may be another camera's"),
    "beside two": ("/s/left_image", ["/s/camera_info"], ["/s/right_image"], "may be another camera's"),
}


@pytest.mark.parametrize(("topic", "infos", "others", "wanted"), TOPICS.values(), ids=TOPICS)
def test_the_calibration_is_never_another_cameras(tmp_path, topic, infos, others, wanted):
    messages = [
        (name, 1 + i, bags.info(1 + i, SENSOR if i == 0 else OTHER, frame_id=f"f{i}")) for i, name in enumerate(infos)
    ]
    messages += pictures(topic) + [message for name in others for message in pictures(name)]
    source = open_source(bag(tmp_path, messages), Reading(topic=topic))
    if wanted.startswith("/"):
        assert source.calibration.focal_px[0] == 700.0
        return
    assert source.calibration is None
    assert wanted in source.no_calibration
    assert all(name in source.no_calibration for name in (*infos, "--info-topic", "--camera"))
    chosen = open_source(bag(tmp_path / "chosen", messages), Reading(topic=topic, info_topic=infos[0]))
    assert chosen.calibration.focal_px[0] == 700.0


def test_the_frame_of_the_pictures_tells_their_calibration(tmp_path):
    messages = [
        ("/info/a", 1, bags.info(1, OTHER, frame_id="rear_optical")),
        ("/info/b", 2, bags.info(2, SENSOR, frame_id="cam_optical")),
        *pictures(),
    ]
    assert open_source(bag(tmp_path, messages)).calibration.focal_px[0] == 700.0


def collect(items, seen):
    for item in items:
        seen.append(item.t_ns)


@pytest.mark.parametrize("kind", bags.KINDS)
def test_a_bag_ends_where_its_calibration_changes(tmp_path, kind):
    zoomed = Camera(640, 480, K * np.array([[1.2], [1.2], [1.0]]))
    messages = []
    for i, camera in enumerate([SENSOR, SENSOR, zoomed]):
        picture = pictures(count=1, start=10 * i + 1)[0]
        messages += [picture, ("/front/camera_info", 10 * i + 2, bags.info(10 * i + 1, camera))]
    path = bag(tmp_path, messages, kind)
    items, seen = open_source(path).items(), []
    with refused(path, "changes.*fx becomes 840 from 700 px"):
        collect(items, seen)
    assert seen == [1, 11]  # the picture with the new calibration's stamp came before it, and is not among them
    assert len(list(open_source(path, Reading(follow_calibration=False)).items())) == 3


def test_a_calibration_that_falls_silent_or_is_sent_again_is_the_same(tmp_path):
    blank = SimpleNamespace(K=np.zeros((3, 3)), width=640, height=480, model="", distortion=[])
    messages = [
        ("/front/camera_info", 1, bags.info(1, SENSOR)),
        *pictures(),
        ("/front/camera_info", 20, bags.info(20, blank)),
    ]
    messages += [("/front/camera_info", 21, bags.info(21, SENSOR, frame_id="renamed")), *pictures(start=30)]
    assert sum(isinstance(item, Frame) for item in open_source(bag(tmp_path, messages)).items()) == 6


def test_a_calibration_of_another_size_than_the_pictures_is_said(tmp_path):
    messages = [("/front/camera_info", 1, bags.info(1, SENSOR)), *pictures(size=(320, 240))]
    source = open_source(bag(tmp_path, messages))
    assert "pictures of 640x480 pixels, those of /front/image_raw have 320x240" in source.no_calibration
    binned = [("/front/camera_info", 1, bags.info(1, SENSOR, binning_x=2, binning_y=2)), *pictures(size=(320, 240))]
    assert_close(open_source(bag(tmp_path / "b", binned)).calibration.focal_px, [350.0, 352.5])
