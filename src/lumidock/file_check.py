"""Do the files hold: what the lights have taught against the station file or the camera file, and in which words."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from lumidock._kernels.measurements import Measurements
from lumidock._kernels.tracking.track import CALIBRATION, LIGHTS, PredictedMeasurements
from lumidock.camera import Camera
from lumidock.datatypes import Array, Contradiction, Indices
from lumidock.geometry import se3_inverse
from lumidock.light_counts import CHECKED_LIGHTS
from lumidock.station import Station
from lumidock.track import Track, calibration_prior

_TOLD_SHARE = (
    0.02  # least share of what perfect images would tell, that they told; below, linearisation errors dominate
)
_SURE_SHARE = 0.1  # of the best known direction of a shift, that another needs to be stated too
_CONTRADICTION = 24.0  # chi-square, 1 dof, 1e-6
_CONTRADICTION_OF_FOCAL = 10.8  # the same, 1e-3, of a focal length that is taken to be wider than declared
_RELEASED = 0.5  # of the limit of a test: a contradiction that comes and goes with the noise would help nobody
# of the best explanation; a wrong focal length and a layer that lies deeper explain the same, and a few per cent of a
# focal length are likelier than some 20 cm of a dock
_LENS_FIRST = 0.7
_LENS = LIGHTS - CALIBRATION  # states of the lens: focal length, principal point u and v


class Parameters(NamedTuple):
    """What may be wrong in the files: K single errors, over the n filter states from `CALIBRATION` on.

    The lens's three states, each light along three axes, and, where there are several layers, each along three axes.
    `weights` (K, n): an error's direction times the inverse of the covariance that the files declare. `declared`
    (n, n): this covariance. `most` (K,): the information on each that perfect images would give. `limit` (K,): of the
    test.
    """

    weights: Array
    declared: Array
    most: Array
    limit: Array


def parameters(station: Station, taken: Station) -> Parameters:
    """The parameters of a station; `taken` has the sigmas that the filter assumes instead of the file's."""
    P = calibration_prior(taken, None).P[CALIBRATION:, CALIBRATION:]
    errors = [np.eye(len(P))]
    if len(station.layers) > 1:
        for k in range(len(station.layers)):
            shifted = np.kron((station.layer == k).astype(float), np.eye(3))
            errors.append(np.concatenate([np.zeros((3, _LENS)), shifted], axis=1))
    directions = np.concatenate(errors)
    weights = directions @ np.linalg.pinv(P, hermitian=True)  # what is declared exact is not tested
    limit = np.full(len(directions), _CONTRADICTION)
    if taken.sigma_focal > station.sigma_focal:
        limit[0] = _CONTRADICTION_OF_FOCAL
    return Parameters(weights, P, np.asarray((weights * directions).sum(axis=1)), limit)


class DistortionTest(NamedTuple):
    """What the innovations of a track say of a radial distortion k1 that the calibration leaves out.

    `score` and `information` of all frames: score^2 / information is chi-square of one degree of freedom while nothing
    is left out, since innovations are white then.
    """

    score: float = 0.0
    information: float = 0.0

    def with_frame(
        self, predicted: PredictedMeasurements, assignment: Indices, frame: Measurements, camera: Camera
    ) -> DistortionTest:
        """With the innovation of one more frame, of the detections in an `assignment` (M,)."""
        lights = np.flatnonzero((assignment >= 0) & np.isfinite(predicted.uv[:, 0]))
        if len(lights) < CHECKED_LIGHTS:
            return self
        off = predicted.uv[lights] - camera.center_px
        signature = (off * ((off / camera.focal_px) ** 2).sum(axis=1, keepdims=True)).ravel()
        n, m, detections = len(lights), len(assignment), assignment[lights]
        blocks = predicted.S.reshape(m, 2, m, 2)[lights][:, :, lights]  # (n, 2, n, 2)
        blocks[np.arange(n), :, np.arange(n)] += frame.cov[detections]
        weighed = np.linalg.solve(blocks.reshape(2 * n, 2 * n), signature)
        innovation = (frame.uv[detections] - predicted.uv[lights]).ravel()
        return DistortionTest(self.score + float(weighed @ innovation), self.information + float(weighed @ signature))

    @property
    def chi_square(self) -> float:
        """The test's value."""
        return self.score**2 / self.information if self.information else 0.0

    def in_words(self) -> Contradiction:
        """What is left out; the score tells its sign, but not its size, of which the filter has learned a part."""
        kind = "barrel" if self.score < 0.0 else "pincushion"
        return Contradiction(
            "calibration", "distortion", f"lens shows {kind} distortion that the calibration leaves out"
        )


def contradiction(
    track: Track, station: Station, parameters: Parameters, distortion: DistortionTest, *, before: bool = False
) -> Contradiction | None:
    """The single error that explains best why the lights do not fit the files, where they contradict them.

    A score test: by how much the sum of squares falls if an error of any size is allowed beside what the files
    declare. With their covariance P0 and what the track has, x and P, the score of an error along e is e' P0^-1 x and
    its information e' P0^-1 (P0 - P) P0^-1 e; their quotient score^2 / information is chi-square of one degree of
    freedom while the files hold. What was contradicted `before` is so until the test falls to half its limit.
    """
    if not track.estimates_calibration:
        return None
    own = slice(CALIBRATION, CALIBRATION + len(parameters.declared))
    x, P = track.state.x[own], track.state.P[own, own]
    weights = parameters.weights
    score, spread = weights @ x, weights @ (parameters.declared - P)
    information = (spread * weights).sum(axis=1)
    known = information > _TOLD_SHARE * parameters.most
    test = np.where(known, score**2 / np.maximum(information, 1e-300), 0.0)
    excess, of_distortion = float((test / parameters.limit).max()), distortion.chi_square / _CONTRADICTION
    if not max(excess, of_distortion) > (_RELEASED if before else 1.0):
        return None
    if of_distortion > excess:
        return distortion.in_words()
    worst = int(test.argmax())
    if worst == 0 or test[0] > _LENS_FIRST * test[worst]:
        return focal_length(float(score[0] / information[0]))
    first = 1 if worst < _LENS else worst - (worst - _LENS) % 3
    group = np.arange(first, _LENS if worst < _LENS else first + 3)
    away = _size(score[group], spread[group] @ weights[group].T)
    if worst < _LENS:
        text = f"principal point appears {away:.0f} px from where the calibration has it"
        return Contradiction("calibration", "principal point", text)
    light = (first - _LENS) // 3
    if light >= len(station):
        return layer_shifted(station.layers[light - len(station)], away)
    name = station.ids[light]
    return Contradiction("survey", name, f"light {name} appears {_length(away)} from its surveyed position")


def _size(score: Array, information: Array) -> float:
    """Length of the shift of this score (k,) and information (k, k), along the directions in which it is known."""
    known, directions = np.linalg.eigh(information)
    sure = known > _SURE_SHARE * known[-1]
    return float(np.linalg.norm((directions[:, sure].T @ score) / known[sure]))


NOTHING_TOLD = DistortionTest()


def focal_length(off: float) -> Contradiction:
    """The focal length is `off` of the calibration's, relative."""
    way = "longer" if off > 0.0 else "shorter"
    text = f"focal length appears {100.0 * abs(off):.1f} % {way} than the calibration says"
    return Contradiction("calibration", "focal length", text)


def layer_shifted(layer: str, away_m: float) -> Contradiction:
    """A layer is so far from where it should be, seen from the others."""
    text = f"layer {layer} appears {_length(away_m)} from where the survey puts it against the other lights"
    return Contradiction("survey", layer, text)


def _length(metres: float) -> str:
    return f"{metres:.1f} m" if metres >= 0.95 else f"{100.0 * metres:.0f} cm"


def displaced_layer(track: Track, station: Station, layer: int, T_cam_dock: Array) -> Contradiction:
    """What a layer says that was identified by itself, at the pose `T_cam_dock` (4, 4), where the track's has it not.

    A wrong focal length scales the distance between two layers, along the view. Across it, and where it would have to
    be more than doubled or halved, nothing but the survey can be wrong.
    """
    middle = np.append(station.p_dock[station.lights_of(station.layers[layer])].mean(axis=0), 1.0)
    used = np.append(station.p_dock[track.last.assignment >= 0].mean(axis=0), 1.0)
    seen, expected, near = T_cam_dock @ middle, track.T_cam_dock @ middle, track.T_cam_dock @ used
    along = (expected - near)[:3] / np.linalg.norm((expected - near)[:3])
    off = (seen - expected)[:3]
    axial = float(off @ along)
    depth = float(np.linalg.norm((expected - near)[:3]))
    across = math.sqrt(max(float(off @ off) - axial**2, 0.0))
    scale = depth / (depth + axial) if depth + axial > 0.0 else math.inf
    if across < abs(axial) and 0.5 < scale < 2.0:
        return focal_length(scale - 1.0)
    dock = se3_inverse(track.T_cam_dock)
    return layer_shifted(station.layers[layer], float(np.linalg.norm((dock @ seen - dock @ expected)[:3])))
