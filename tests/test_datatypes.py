from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lumidock.datatypes import Attitude, Detections, Fix, Frame, Guide, Match, Protection, require_shape
from lumidock.errors import DataError

THREE = Detections.from_uv("a.png", 5, np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]))
T = np.eye(4)


@given(
    st.lists(st.integers(0, 3), max_size=4).map(tuple),
    st.lists(st.one_of(st.none(), st.integers(0, 3)), max_size=4).map(tuple),
)
def test_require_shape_takes_what_fits_and_nothing_else(shape, wanted):
    array = np.zeros(shape)
    if len(shape) == len(wanted) and all(w in (None, s) for s, w in zip(shape, wanted, strict=True)):
        require_shape("it", array, *wanted)
    else:
        with pytest.raises(ValueError, match="it has shape"):
            require_shape("it", array, *wanted)


@pytest.mark.parametrize("shape", [(4, 6), (4, 6, 3)])
def test_a_frame_is_grey_or_color(shape):
    assert Frame("a.png", 0, np.zeros(shape, np.uint8)).image.shape == shape


@pytest.mark.parametrize(
    ("shape", "dtype", "encoding"),
    [
        ((4, 6, 3), np.uint8, "bayer_rggb8"),
        ((4, 6), np.uint8, "bayer_rggb16"),
        ((4, 6), np.uint16, "mono8"),
        ((4, 6), np.uint8, "bgr8"),
        ((4, 6), np.uint8, "bayer_rgbg8"),
    ],
)
def test_an_encoding_that_does_not_fit_is_refused(shape, dtype, encoding):
    with pytest.raises(ValueError, match="does not fit"):
        Frame("a.png", 0, np.zeros(shape, dtype), encoding=encoding)


@pytest.mark.parametrize(
    ("image", "match"),
    [
        (np.zeros((4, 6), np.int16), "wanted uint8 or uint16"),
        (np.zeros((4, 6)), "wanted uint8 or uint16"),
        (np.zeros(4, np.uint8), "image has shape"),
        (np.zeros((4, 6, 1), np.uint8), "image has shape"),
        (np.zeros((4, 6, 4), np.uint8), "image has shape"),
        (np.zeros((0, 6), np.uint8), "image has shape"),
        (None, "image is None, wanted an array .*was the file read"),
        ([[1, 2], [3, 4]], "image is of type list"),
    ],
)
def test_another_image_is_refused(image, match):
    with pytest.raises(DataError, match=match):
        Frame("a.png", 0, image)


@pytest.mark.parametrize("t_ns", [1.5, 1.7e9, None, "5", True, np.float64(3)])
def test_a_stamp_that_is_no_integer_is_refused(t_ns):
    with pytest.raises(DataError, match="wanted an integer of nanoseconds"):
        Frame("a.png", t_ns, np.zeros((4, 6), np.uint8))
    with pytest.raises(DataError, match="wanted an integer of nanoseconds"):
        Detections.from_uv("a.png", t_ns, THREE.uv)


@pytest.mark.parametrize(
    "uv", [None, np.zeros(4), np.zeros((3, 3)), np.zeros((2, 3, 2)), [["a", "b"]], [[1.0, np.nan]], [[1.0], [1.0, 2.0]]]
)
def test_centroids_of_another_shape_are_refused_not_reshaped(uv):
    with pytest.raises(DataError, match="uv"):
        Detections.from_uv("a.png", 5, uv)


def test_detections_from_uv_know_only_their_places():
    assert len(THREE) == 3
    assert (THREE.p_light == 1).all()
    assert np.isnan([THREE.radius_px, THREE.flux, THREE.p_rear]).all()
    assert (Detections.from_uv("a.png", 5, THREE.uv, p_rear=np.full(3, 0.5)).p_rear == 0.5).all()
    assert Detections.from_uv("a.png", 5, []).uv.shape == (0, 2)


@pytest.mark.parametrize("name", ["uv", "radius_px", "flux", "p_light", "p_rear"])
def test_detections_of_unequal_length_are_refused(name):
    with pytest.raises(ValueError, match="has shape"):
        replace(THREE, **{name: getattr(THREE, name)[:2]})


def test_a_centres_covariance_is_a_matrix_each():
    assert replace(THREE, cov_px2=np.ones((3, 2, 2))).cov_px2.shape == (3, 2, 2)
    with pytest.raises(ValueError, match="cov_px2 has shape"):
        replace(THREE, cov_px2=np.ones((2, 2, 2)))


@pytest.mark.parametrize(
    ("R", "sigma_rad", "match"),
    [
        (np.eye(4), 0.1, "R_dock_cam has shape"),
        (np.diag([1.0, np.nan, 1.0]), 0.1, "finite rotation"),
        (np.eye(3), 0.0, "positive sigma"),
        (np.eye(3), -0.1, "positive sigma"),
        (np.eye(3), np.nan, "positive sigma"),
        (np.eye(3), np.inf, "positive sigma"),
    ],
)
def test_an_attitude_is_a_rotation_with_an_error(R, sigma_rad, match):
    assert Attitude(np.eye(3), 0.1).sigma_rad == 0.1
    with pytest.raises(ValueError, match=match):
        Attitude(R, sigma_rad)


@pytest.mark.parametrize("light", [[0, 1, 2], [7, -1, -1], [-1, -1, -1]])
def test_a_match_identifies_each_light_once(light):
    assert Match(THREE, np.array(light)).light.tolist() == light


@pytest.mark.parametrize(("light", "match"), [([0, 1, 0], "assigned to the same light"), ([0, 1], "has shape")])
def test_another_match_is_refused(light, match):
    with pytest.raises(ValueError, match=match):
        Match(THREE, np.array(light))


def test_a_fix_is_valid_when_it_has_a_pose():
    assert Fix("a.png", 5, "acquired", "front", T_dock_cam=T).valid
    assert not Fix("a.png", 5, "none", "search", reason="no_lights").valid


def test_a_guide_may_come_with_a_pose_or_without():
    guide = Guide(0.1, -0.1, 20.0, 0.01, 0.5)
    assert not Fix("a.png", 5, "tracking", "front", reason="protection", guide=guide).valid
    whole = Fix("a.png", 5, "tracking", "front", 0, 0, T, "", None, (), np.eye(6), Protection(0.1, 0.2, 0.03), guide)
    assert (whole.valid, whole.protection.axial_m, whole.guide.range_m) == (True, 0.2, 20.0)


@pytest.mark.parametrize(
    ("fields", "match"),
    [
        ({}, "either a pose or the reason"),
        ({"T_dock_cam": T, "reason": "mirror"}, "either a pose or the reason"),
        ({"T_dock_cam": T[:3]}, "has shape"),
        ({"T_dock_cam": T * np.nan}, "not finite"),
        ({"T_dock_cam": T, "covariance": np.eye(3)}, "covariance has shape"),
        ({"reason": "mirror", "covariance": np.eye(6)}, "neither a covariance"),
        ({"reason": "mirror", "protection": Protection(1.0, 1.0, 0.1)}, "neither a covariance"),
        ({"T_dock_cam": T + np.diag([np.inf, 0, 0, 0])}, "not finite"),
    ],
)
def test_another_fix_is_refused(fields, match):
    with pytest.raises(ValueError, match=match):
        Fix("a.png", 5, "tracking", "front", **fields)


def test_nothing_changes_once_made():
    with pytest.raises(FrozenInstanceError):
        THREE.t_ns = 6
