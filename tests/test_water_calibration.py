"""Calibration from boards: against the truth, against OpenCV, and whether its stated errors are those of many draws."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from lumidock.camera import Camera
from lumidock.datatypes import Array, Frame
from lumidock.errors import InputError
from lumidock.geometry import so3_exp
from lumidock.port import FlatPort
from lumidock.setup.boards import Board, Sighting, find_board
from lumidock.setup.water_calibration import PortGuess, calibrate

BOARD = Board("charuco", 9, 7, 0.04, 0.03)
SIZE = (1280, 960)
K = np.array([[1110.0, 0, 648.0], [0, 1105.0, 471.0], [0, 0, 1]])
LENS = {
    "plumb_bob": Camera(*SIZE, K, "plumb_bob", np.array([-0.21, 0.06, 8e-4, -5e-4, 0.0])),
    "equidistant": Camera(*SIZE, K, "equidistant", np.array([-0.03, 0.01, -0.004, 0.001])),
}


def _views(camera: Camera, rng: np.random.Generator, count: int, noise_px: float) -> tuple[list[Sighting], list[Array]]:
    views, poses = [], []
    corners = BOARD.corners_m()
    while len(views) < count:
        R = so3_exp(rng.uniform(-1, 1, 3) * [0.6, 0.6, 0.5])
        middle = camera.unproject(rng.uniform(0.15, 0.85, (1, 2)) * SIZE)[0] * rng.uniform(0.35, 0.8)
        p_cam = (corners - corners.mean(axis=0)) @ R.T + middle
        uv = camera.project(p_cam)
        inside = camera.contains(uv, margin_px=2.0)
        if inside.sum() >= 12:
            noisy = uv[inside] + rng.normal(size=(int(inside.sum()), 2)) * noise_px
            views.append(Sighting(str(len(views)), np.flatnonzero(inside), noisy))
            poses.append(p_cam)
    return views, poses


@pytest.mark.parametrize("model", ["plumb_bob", "equidistant"])
def test_exact_corners_give_the_exact_camera(model):
    camera = LENS[model]
    views, _ = _views(camera, np.random.default_rng(1), 16, 0.0)
    got = calibrate(BOARD, views, SIZE, model)
    np.testing.assert_allclose(got.camera.K, camera.K, atol=1e-3)
    np.testing.assert_allclose(got.camera.distortion, camera.distortion, atol=1e-5)
    assert got.held_out_px < 1e-3


@pytest.mark.parametrize(
    ("draws", "low", "high"), [(10, 0.13, 3.0), pytest.param(50, 0.45, 1.75, marks=pytest.mark.slow)]
)
def test_the_stated_errors_are_those_of_many_draws(draws, low, high):
    """Each a mean of squares of a standard normal, between its 0.05 % and 99.95 % quantiles."""
    camera, chi2 = LENS["plumb_bob"], []
    truth = np.array([1110.0, 1105.0, 648.0, 471.0, -0.21, 0.06, 8e-4, -5e-4])
    for seed in range(draws):
        views, _ = _views(camera, np.random.default_rng(seed), 12, 0.2)
        got = calibrate(BOARD, views, SIZE)
        estimate = np.concatenate([got.camera.focal_px, got.camera.center_px, got.camera.distortion[:4]])
        chi2.append(((estimate - truth) / got.sigma[:8]) ** 2)
        assert abs(got.camera.focal_px[0] / 1110.0 - 1.0) < 5.0 * got.sigma[0] / 1110.0
    assert (np.mean(chi2, axis=0) > low).all()
    assert (np.mean(chi2, axis=0) < high).all()


def test_opencv_agrees():
    camera = LENS["plumb_bob"]
    views, _ = _views(camera, np.random.default_rng(4), 15, 0.2)
    got = calibrate(BOARD, views, SIZE)
    objects = [BOARD.corners_m()[one.corner].astype(np.float32) for one in views]
    pixels = [one.uv.astype(np.float32)[:, None] for one in views]
    rms, theirs, _, _, _, deviations, _, _ = cv2.calibrateCameraExtended(
        objects, pixels, SIZE, np.eye(3), np.zeros(5), flags=cv2.CALIB_FIX_K3
    )
    assert got.rms_px == pytest.approx(rms, rel=0.1)
    assert np.abs(got.camera.focal_px / np.diagonal(theirs)[:2] - 1.0).max() < 5e-4
    np.testing.assert_allclose(got.sigma[:4], np.ravel(deviations)[:4], rtol=0.3)


def test_misread_corners_are_set_aside():
    views, _ = _views(LENS["plumb_bob"], np.random.default_rng(6), 15, 0.1)
    views[3].uv[2] += [40.0, -25.0]
    views[7].uv[5] += [-3.0, 8.0]
    got = calibrate(BOARD, views, SIZE)
    assert abs(got.camera.focal_px[0] / 1110.0 - 1.0) < 0.002
    assert got.rms_px < 0.2


@pytest.mark.parametrize("kind", ["charuco", "chessboard"])
def test_drawn_boards_give_the_camera_that_drew_them(kind):
    board = Board(kind, 9, 7, 0.04, 0.03)
    camera = Camera(*SIZE, K)
    rng, found = np.random.default_rng(2), []
    for k in range(10 if kind == "charuco" else 7):
        sighting = find_board(board, Frame(str(k), k, _picture(board, camera, rng)))
        if sighting is not None:
            found.append(sighting)
    assert len(found) >= 6
    got = calibrate(board, found, SIZE)
    assert np.abs(got.camera.focal_px / camera.focal_px - 1.0).max() < 0.002
    assert np.abs(got.camera.center_px - camera.center_px).max() < 2.0


_PRINT_PER_M = 2000.0


def _print(board: Board) -> np.ndarray:
    """The board as it is printed, with a white border of 60 pixels."""
    per_m = _PRINT_PER_M
    width, height = round(board.columns * board.square_m * per_m), round(board.rows * board.square_m * per_m)
    if board.kind == "charuco":
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
        drawn = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square_m, board.marker_m, dictionary)
        print_ = drawn.generateImage((width, height))
    else:
        cells = np.add.outer(np.arange(board.rows), np.arange(board.columns)) % 2
        print_ = np.kron(cells, np.ones((80, 80))).astype(np.uint8) * 255
    return cv2.copyMakeBorder(print_, 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=255)


def _held(board: Board, rng: np.random.Generator) -> tuple[Array, Array]:
    """How a diver holds the board: its turn, and where its corner is, before the camera."""
    R = so3_exp(rng.uniform(-1, 1, 3) * [0.5, 0.5, 0.3])
    middle = np.array([board.columns, board.rows, 0.0]) * board.square_m / 2.0
    t = np.array([*rng.uniform(-0.05, 0.05, 2), rng.uniform(0.5, 0.7)]) - R @ middle
    return R, t


def _picture(board: Board, camera: Camera, rng: np.random.Generator) -> np.ndarray:
    """A picture (H, W) of the board: a print of it, seen through a homography."""
    per_m, print_ = _PRINT_PER_M, _print(board)
    R, t = _held(board, rng)
    to_board = np.array([[1 / per_m, 0, -59.5 / per_m], [0, 1 / per_m, -59.5 / per_m], [0, 0, 1]])
    H = camera.K @ np.column_stack([R[:, 0], R[:, 1], t]) @ to_board
    big = cv2.warpPerspective(print_, np.diag([2.0, 2.0, 1.0]) @ _half(H), (2 * SIZE[0], 2 * SIZE[1]), borderValue=90)
    return cv2.resize(big, SIZE, interpolation=cv2.INTER_AREA)


def _half(H: Array) -> Array:
    """The homography to pixels of a picture twice as fine, whose first pixel's centre lies a quarter pixel off."""
    return np.array([[1, 0, 0.25], [0, 1, 0.25], [0, 0, 1]]) @ H


def test_too_few_views_and_absurd_boards_are_refused():
    views, _ = _views(LENS["plumb_bob"], np.random.default_rng(1), 3, 0.1)
    with pytest.raises(InputError, match="3 views"):
        calibrate(BOARD, views, SIZE)
    with pytest.raises(InputError, match="markers smaller"):
        Board("charuco", 8, 6, 0.04, 0.05)
    with pytest.raises(InputError, match="dictionary"):
        Board("charuco", 8, 6, 0.04, 0.03, "DICT_NONE")


def test_advice_names_the_corner_of_the_picture_that_no_board_was_in():
    views, _ = _views(LENS["plumb_bob"], np.random.default_rng(8), 20, 0.1)
    low = [
        Sighting(one.frame, one.corner[keep], one.uv[keep])
        for one in views
        if (keep := one.uv[:, 1] > 500.0).sum() >= 8
    ]
    got = calibrate(BOARD, low, SIZE)
    assert any("top left" in text for text in got.advice)
    assert (got.coverage[0] == 0).all()


PORT = FlatPort(0.08, 1.34)
IN_AIR = np.array([[830.0, 0, 648.0], [0, 826.0, 471.0], [0, 0, 1]])
BEHIND = {model: replace(LENS[model], K=IN_AIR, port=PORT) for model in LENS}


@pytest.mark.parametrize("model", ["plumb_bob", "equidistant"])
@pytest.mark.parametrize("guess", [PortGuess(0.08), PortGuess()], ids=["known distance", "estimated distance"])
def test_exact_corners_behind_a_port_give_the_lens_and_the_port(model, guess):
    views, _ = _views(BEHIND[model], np.random.default_rng(1), 16, 0.0)
    got = calibrate(BOARD, views, SIZE, model, guess)
    np.testing.assert_allclose(got.camera.K, IN_AIR, atol=2e-2)
    np.testing.assert_allclose(got.camera.distortion, BEHIND[model].distortion, atol=1e-4)
    assert got.camera.port.distance_m == pytest.approx(0.08, abs=1e-4)
    assert got.held_out_px < 1e-3


@pytest.mark.parametrize(
    ("draws", "low", "high"), [(10, 0.13, 3.0), pytest.param(50, 0.45, 1.75, marks=pytest.mark.slow)]
)
def test_the_stated_errors_behind_a_port_are_those_of_many_draws(draws, low, high):
    """The same bounds as without a port."""
    camera, chi2 = BEHIND["plumb_bob"], []
    truth = np.array([830.0, 826.0, 648.0, 471.0, -0.21, 0.06, 8e-4, -5e-4, 0.08])
    for seed in range(draws):
        views, _ = _views(camera, np.random.default_rng(seed), 12, 0.2)
        got = calibrate(BOARD, views, SIZE, port=PortGuess())
        lens = [got.camera.focal_px, got.camera.center_px, got.camera.distortion[:4], [got.camera.port.distance_m]]
        chi2.append(((np.concatenate(lens) - truth) / got.sigma[:9]) ** 2)
    assert (np.mean(chi2, axis=0) > low).all()
    assert (np.mean(chi2, axis=0) < high).all()


def test_a_pinhole_cannot_say_what_a_port_does():
    """The residual tells them apart: with the port it is the noise, without it is more."""
    views, _ = _views(BEHIND["plumb_bob"], np.random.default_rng(3), 20, 0.1)
    port, pinhole = (calibrate(BOARD, views, SIZE, port=guess) for guess in (PortGuess(), None))
    assert port.rms_px == pytest.approx(0.1 * np.sqrt(2.0), rel=0.1)
    assert pinhole.rms_px > 1.5 * port.rms_px


def _refracted(board: Board, camera: Camera, rng: np.random.Generator) -> np.ndarray:
    """A picture (H, W) of the board, each ray traced from the lens through the port by Snell's law."""
    R, t = _held(board, rng)
    u, v = np.meshgrid(np.arange(2 * SIZE[0]) * 0.5 - 0.25, np.arange(2 * SIZE[1]) * 0.5 - 0.25)
    air = np.stack([(u - camera.K[0, 2]) / camera.K[0, 0], (v - camera.K[1, 2]) / camera.K[1, 1]], axis=-1)
    sine = air / np.sqrt(1.0 + (air**2).sum(axis=-1, keepdims=True)) / camera.port.index
    water = np.concatenate([sine, np.sqrt(1.0 - (sine**2).sum(axis=-1, keepdims=True))], axis=-1)
    window = np.concatenate([air, np.ones((*u.shape, 1))], axis=-1) * camera.port.distance_m
    far = ((t - window) @ R[:, 2]) / (water @ R[:, 2])
    on_board = (window + far[..., None] * water - t) @ R[:, :2]
    at = (on_board * _PRINT_PER_M + 59.5).astype(np.float32)
    big = cv2.remap(_print(board), at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderValue=90)
    return cv2.resize(big, SIZE, interpolation=cv2.INTER_AREA)


@pytest.mark.parametrize(
    "guess", [PortGuess(PORT.distance_m), PortGuess()], ids=["known distance", "estimated distance"]
)
def test_boards_rendered_through_a_port_give_the_lens_as_well_as_opencv_fits_them(guess):
    camera, rng = Camera(*SIZE, IN_AIR, port=PORT), np.random.default_rng(3)
    pictures = [_refracted(BOARD, camera, rng) for _ in range(14)]
    found = [one for k, picture in enumerate(pictures) if (one := find_board(BOARD, Frame(str(k), k, picture)))]
    assert len(found) >= 12
    got = calibrate(BOARD, found, SIZE, port=guess)
    objects = [BOARD.corners_m()[one.corner].astype(np.float32) for one in found]
    pixels = [one.uv.astype(np.float32)[:, None] for one in found]
    theirs = cv2.calibrateCamera(objects, pixels, SIZE, np.eye(3), np.zeros(5))[0]
    assert np.abs(got.camera.focal_px / camera.focal_px - 1.0).max() < 0.002
    assert got.rms_px < 1.1 * theirs
