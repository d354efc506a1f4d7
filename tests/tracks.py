"""Tracks of the shipped dock for the tests of the filter: poses, pixels, hypotheses."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from lumidock import track
from lumidock._kernels.tracking import track as kernel
from lumidock.camera import load_camera
from lumidock.config import Config
from lumidock.datatypes import Detections
from lumidock.geometry import se3_exp, se3_inverse
from lumidock.match import Hypothesis
from lumidock.model import attitude_prior, measurements, station_model
from lumidock.sim.detections import simulated_frames
from lumidock.sim.scenario import load_scenario
from lumidock.station import load_station

ROOT = Path(__file__).parents[1]
STATION = load_station(ROOT / "src" / "lumidock" / "stations" / "cage-2x2x5.yaml")
CAMERA = load_camera(ROOT / "src" / "lumidock" / "cameras" / "imx264-60deg.yaml")
CONFIG = Config()
MODEL = station_model(STATION, CAMERA, CONFIG.match)
M = len(STATION)
FRONT, BOTH = np.arange(7), np.arange(M)
PRIOR = attitude_prior(None, CONFIG.prior)
STEP_NS = 66_666_700


def frames_of(scenario, *settings, seed=0):
    return list(simulated_frames(load_scenario(scenario, settings), STATION, CAMERA, seed))


def head_on(z=8.0, off=(0.2, -0.3)):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.diag([1.0, -1.0, -1.0]), [*off, z]
    return T


def assigned(lights):
    """The assignment (M,) of detections that stand in the order of `lights`."""
    assignment = np.full(M, -1, np.int64)
    assignment[lights] = np.arange(len(lights))
    return assignment


def pixels(T_cam_dock, x, lights):
    """Pixels (K, 2) of lights as the filter's state says, by the camera alone."""
    p = STATION.p_dock + x[kernel.LIGHTS :].reshape(-1, 3)
    uv = CAMERA.project(p[lights] @ T_cam_dock[:3, :3].T + T_cam_dock[:3, 3])
    focal, center = x[kernel.CALIBRATION], x[kernel.CALIBRATION + 1 : kernel.LIGHTS]
    return CAMERA.center_px + (1.0 + focal) * (uv - CAMERA.center_px) + center


def measured(uv, t_ns=0):
    return measurements(Detections.from_uv("f", t_ns, uv), MODEL, CONFIG.match)


def with_state(one, **values):
    """A track with other values in its filter's state."""
    return replace(one, state=one.state._replace(**values))


def start(T_cam_dock, assignment, frame, t_ns=0):
    """A track from one frame's measurements, linearised first at a guess of the pose."""
    guess = Hypothesis(assignment, T_cam_dock[:3, :3], T_cam_dock[:3, 3], 0.0)
    calibration = track.calibration_prior(STATION, None)
    return track.start(guess, frame, MODEL, CONFIG.track, t_ns=t_ns, prior=PRIOR, calibration=calibration)


def begun(T_dock_cam, lights, rng, *, noise_px=0.3, off=0.0):
    """A track that starts from noisy pixels of `lights`, its first guess of the pose off a little."""
    T_cam_dock = se3_inverse(T_dock_cam)
    uv = pixels(T_cam_dock, np.zeros(kernel.LIGHTS + 3 * M), lights) + rng.normal(0, noise_px, (len(lights), 2))
    guess = T_cam_dock @ se3_exp(off * rng.normal(size=6))
    begun = start(guess, assigned(lights), measured(uv))
    assert begun is not None
    return begun
