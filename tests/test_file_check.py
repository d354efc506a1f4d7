"""What the lights say against the files: the right thing is named, by about its size, and nothing where files hold."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lumidock import file_check, track
from lumidock._kernels.measurements import Measurements
from lumidock._kernels.tracking.track import CALIBRATION, FilterState, PredictedMeasurements
from lumidock.camera import load_camera
from lumidock.config import Config, FilesConfig
from lumidock.file_check import NOTHING_TOLD, contradiction, displaced_layer, parameters
from lumidock.localizer import Localizer
from lumidock.model import believed, station_model
from lumidock.sim.detections import simulated_frames
from lumidock.sim.scenario import load_scenario
from lumidock.station import load_station

ROOT = Path(__file__).parents[1] / "src" / "lumidock"
STATION = load_station(ROOT / "stations" / "cage-2x2x5.yaml")
CAMERA = load_camera(ROOT / "cameras" / "imx264-60deg.yaml")
TAKEN = believed(STATION, FilesConfig())
M = len(STATION)
LENS = 3


def learned(rng, station, taken, error=None):
    """A track whose calibration states have been learned from linear measurements of survey and lens with an `error`.

    Everything is measured to 2 mm, 0.1 % and 1 px, up to the common shift of the dock, which nothing shows.
    """
    n = LENS + 3 * M
    P = track.calibration_prior(taken, None).P[CALIBRATION:, CALIBRATION:]
    declared = track.calibration_prior(station, None).P[CALIBRATION:, CALIBRATION:]
    truth = rng.multivariate_normal(np.zeros(n), declared, method="eigh") + (0.0 if error is None else error)
    H = np.eye(n)
    shifts = np.kron(np.full((M, M), 1.0 / M), np.eye(3))
    H[LENS:, LENS:] -= shifts
    R = np.diag([1e-3**2, 1.0, 1.0, *([2e-3**2] * (3 * M))])
    seen = H @ truth + rng.multivariate_normal(np.zeros(n), R, method="eigh")
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    x, posterior = np.zeros(CALIBRATION + n), np.eye(CALIBRATION + n)
    x[CALIBRATION:], posterior[CALIBRATION:, CALIBRATION:] = K @ seen, P - K @ H @ P
    model = station_model(station, CAMERA, Config().match)
    nothing = track.FrameResult.nothing(model)
    return track.Track(
        0,
        0,
        FilterState(np.eye(3), np.zeros(3), x, posterior),
        track.open_bank(model),
        track.LastSeen(0, 0, (0, 0)),
        nothing,
        estimates_calibration=True,
    )


def light_off(light, shift):
    error = np.zeros(LENS + 3 * M)
    error[LENS + 3 * light : LENS + 3 * light + 3] = shift
    return error


@pytest.mark.parametrize("taken", [STATION, TAKEN])
def test_honest_files_are_not_contradicted(rng, taken):
    found = [
        contradiction(learned(rng, STATION, taken), taken, parameters(STATION, taken), NOTHING_TOLD) for _ in range(60)
    ]
    assert found == [None] * 60


@pytest.mark.parametrize("light", [0, 4, 9])
def test_a_light_that_is_off_is_named_by_its_size(rng, light):
    one = learned(rng, STATION, TAKEN, light_off(light, [0.03, -0.02, 0.02]))
    found = contradiction(one, TAKEN, parameters(STATION, TAKEN), NOTHING_TOLD)
    assert (found.file, found.subject) == ("survey", STATION.ids[light])
    said = found.text.split()
    assert " ".join([*said[:3], *said[4:]]) == f"light {STATION.ids[light]} appears cm from its surveyed position"
    assert 3 <= int(said[3]) <= 5  # 4.1 cm, and the light's own honest error


def test_a_layer_that_is_off_is_named(rng):
    error = np.zeros((M, 3))
    error[STATION.layer == 1] = [0.2, 0.1, 0.0]
    one = learned(rng, STATION, TAKEN, np.concatenate([np.zeros(3), error.ravel()]))
    found = contradiction(one, TAKEN, parameters(STATION, TAKEN), NOTHING_TOLD)
    assert found.file == "survey"
    assert found.subject in STATION.layers
    assert "cm from where the survey puts it" in found.text


@pytest.mark.parametrize(("off", "word"), [(0.048, "4.8 % longer"), (-0.05, "5.0 % shorter")])
def test_a_focal_length_is_named_with_its_sign(rng, off, word):
    error = np.zeros(LENS + 3 * M)
    error[0] = off
    found = contradiction(learned(rng, STATION, TAKEN, error), TAKEN, parameters(STATION, TAKEN), NOTHING_TOLD)
    assert (found.file, found.subject) == ("calibration", "focal length")
    said = float(found.text.split("appears ")[1].split(" %")[0]) / 100.0
    assert abs(said - abs(off)) < 0.01
    assert word.split(" % ")[1] in found.text


def test_a_principal_point_is_named(rng):
    error = np.zeros(LENS + 3 * M)
    error[1:3] = [30.0, -40.0]
    found = contradiction(learned(rng, STATION, TAKEN, error), TAKEN, parameters(STATION, TAKEN), NOTHING_TOLD)
    assert found.subject == "principal point"
    assert 45 <= int(found.text.split("appears ")[1].split(" px")[0]) <= 55


def test_a_track_that_has_not_seen_two_layers_says_nothing(rng):
    one = replace(learned(rng, STATION, TAKEN, light_off(0, [0.1, 0.0, 0.0])), estimates_calibration=False)
    assert contradiction(one, TAKEN, parameters(STATION, TAKEN), NOTHING_TOLD) is None


def innovations(rng, k1, frames):
    """A distortion test fed with pixels of white noise and a distortion that the calibration leaves out."""
    test = NOTHING_TOLD
    for _ in range(frames):
        uv = rng.uniform([0, 0], [CAMERA.width, CAMERA.height], (M, 2))
        r2 = (((uv - CAMERA.center_px) / CAMERA.focal_px) ** 2).sum(axis=1, keepdims=True)
        S = np.kron(np.eye(M), np.eye(2)) * 0.5
        seen = uv + k1 * r2 * (uv - CAMERA.center_px) + rng.normal(0.0, np.sqrt(0.75), (M, 2))
        cov = np.tile(0.25 * np.eye(2), (M, 1, 1))
        frame = Measurements(seen, cov, np.full(M, 0.25), np.zeros((M, 2)), np.ones(M), 0.0)
        predicted = PredictedMeasurements(uv, S, np.full(M, 2.0))
        test = test.with_frame(predicted, np.arange(M), frame, CAMERA)
    return test


def test_the_distortion_test_is_chi_square_while_nothing_is_left_out(rng):
    values = np.array([innovations(rng, 0.0, 3).chi_square for _ in range(400)])
    assert abs(values.mean() - 1.0) < 0.2
    assert abs((values > 3.84).mean() - 0.05) < 0.035


@pytest.mark.parametrize(("k1", "kind"), [(-0.02, "barrel"), (0.02, "pincushion")])
def test_distortion_is_named_with_its_sign(rng, k1, kind):
    test = innovations(rng, k1, 40)
    assert test.chi_square > 24
    assert abs(test.score / test.information - k1) < 0.004
    said = contradiction(learned(rng, STATION, TAKEN), TAKEN, parameters(STATION, TAKEN), test)
    assert (said.file, said.subject) == ("calibration", "distortion")
    assert kind in said.text


def test_a_layer_seen_at_a_third_more_depth_is_a_focal_length(rng):
    """The true distance of the layers along the view is what the file says; a third longer lens shrinks it."""
    one = learned(rng, STATION, TAKEN)
    front = np.where(STATION.layer == 0, np.arange(M), -1)
    R = np.diag([1.0, -1.0, -1.0])
    one = replace(
        one, state=one.state._replace(R=R, t=np.array([0.0, 0.0, 8.0])), last=replace(one.last, assignment=front)
    )
    T_cam_dock = np.eye(4)
    T_cam_dock[:3, :3], T_cam_dock[:3, 3] = R, [0.0, 0.0, 8.0 - 5.0 * (1 - 1 / 1.333)]
    said = displaced_layer(one, STATION, 1, T_cam_dock)
    assert said.text in {f"focal length appears 33.{k} % longer than the calibration says" for k in (2, 3, 4)}
    T_cam_dock[:3, 3] = [0.5, 0.0, 8.0]
    said = displaced_layer(one, STATION, 1, T_cam_dock)
    assert said.text == "layer rear appears 50 cm from where the survey puts it against the other lights"


def test_an_air_calibration_in_water_ends_the_trust_and_is_named():
    scenario = load_scenario("faults/air-calibration", ("path.frame_interval_s=0.2", "path.start_z_m=14"))
    localizer = Localizer(STATION, CAMERA)
    fixes = [localizer.process_detections(f.detections) for f in simulated_frames(scenario, STATION, CAMERA, 5)]
    first = next(k for k, fix in enumerate(fixes) if fix.reason == "calibration")
    assert "longer than the calibration says" in fixes[first].contradiction.text
    assert not any(fix.valid or fix.guide for fix in fixes[first:])
    assert all((fix.contradiction is not None) == (fix.reason in ("survey", "calibration")) for fix in fixes)


def test_wider_sigmas_are_taken_only_where_smaller_ones_were_not_earned():
    assert (TAKEN.sigma_layer_m, TAKEN.sigma_focal) == (0.02, 0.005)
    surveyed = replace(STATION, sigma_layer_m=0.0, calibration_stated=True)
    kept = believed(surveyed, FilesConfig())
    assert (kept.sigma_layer_m, kept.sigma_focal) == (0.0, STATION.sigma_focal)
    alone = STATION.only("front")
    assert believed(alone, FilesConfig()).sigma_layer_m == STATION.sigma_layer_m
    assert len(alone) == 7
    assert (
        file_check.parameters(alone, alone).weights.shape[0] == LENS + 21
    )  # a lone layer has nothing to shift against
