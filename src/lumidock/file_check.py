"""Do the files hold: what the lights have taught against the station file or the camera file, and in which words."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from lumidock._kernels.tracking.track import CALIBRATION, LIGHTS
from lumidock.datatypes import Array, Contradiction
from lumidock.geometry import se3_inverse
from lumidock.station import Station
from lumidock.track import CalibrationStates, Track

_TOLD_SHARE = 0.02  # least share of a prior variance that measurements removed; below, linearisation errors dominate
_SURE_SHARE = 0.1  # least such share of an axis along which a shift is stated
_CONTRADICTION = 24.0  # chi-square, 1 dof, 1e-6
_STATES = LIGHTS - CALIBRATION  # of the lens: focal length, principal point u and v


class Parameters(NamedTuple):
    """What may be wrong in the files, K parameters as sums of the n filter states from `CALIBRATION` on.

    `sums` (K, n - 15): the lens's three, each light along three axes, and where there are several layers the mean shift
    of each along three axes. `prior_var` (K,): their variances by the files.
    """

    sums: Array
    prior_var: Array


def parameters(station: Station, declared: CalibrationStates) -> Parameters:
    """The parameters of a station whose files declare so much."""
    P, m = declared.P[CALIBRATION:, CALIBRATION:], len(station)
    sums = [np.eye(len(P))]
    if len(station.layers) > 1:
        for name in station.layers:
            lights = station.lights_of(name)
            mean = np.zeros((3, m, 3))
            mean[[0, 1, 2], :, [0, 1, 2]] = (np.bincount(lights, minlength=m) > 0) / len(lights)
            sums.append(np.concatenate([np.zeros((3, _STATES)), mean.reshape(3, -1)], axis=1))
    together = np.concatenate(sums)
    return Parameters(together, np.asarray(((together @ P) * together).sum(axis=1)))


def contradiction(track: Track, station: Station, parameters: Parameters) -> Contradiction | None:
    """What explains best that the lights do not fit the files, where they contradict them.

    Of each parameter the square over the variance that the lights have taken out of its prior is by how much the sum of
    squares falls if the files know nothing of it: chi-square of one degree of freedom while they hold (a score test).
    """
    if not track.estimates_calibration:
        return None
    x, P = track.state.x[CALIBRATION:], track.state.P[CALIBRATION:, CALIBRATION:]
    sums, prior, n = parameters.sums, parameters.prior_var, len(x)
    value = np.concatenate([x, sums[n:] @ x])
    told = prior - np.concatenate([np.diagonal(P), ((sums[n:] @ P) * sums[n:]).sum(axis=1)])
    known = told > _TOLD_SHARE * prior
    test = np.where(known, value**2 / np.maximum(told, 1e-300), 0.0)
    worst = int(test.argmax())
    if test[worst] < _CONTRADICTION:
        return None
    # what the lights alone say, without the pull of the prior toward the file
    alone = np.where(known, value * prior / np.maximum(told, 1e-300), 0.0)
    return _in_words(worst, np.where(told > _SURE_SHARE * prior, alone, 0.0), alone, station)


def _in_words(worst: int, sure: Array, alone: Array, station: Station) -> Contradiction:
    """The contradiction of the parameter `worst`; the values (K,) of all that are `sure`, and of all."""
    if worst == 0:
        return focal_length(float(alone[0]))
    if worst < _STATES:
        away = math.hypot(*alone[1:_STATES])
        text = f"principal point appears {away:.0f} px from where the calibration has it"
        return Contradiction("calibration", "principal point", text)
    light, axis = divmod(worst - _STATES, 3)
    first = worst - axis
    shift = np.where(np.arange(3) == axis, alone[first : first + 3], sure[first : first + 3])
    away = float(np.linalg.norm(shift))
    if light < len(station):
        name = station.ids[light]
        return Contradiction("survey", name, f"light {name} appears {_length(away)} from its surveyed position")
    return layer_shifted(station.layers[light - len(station)], away)


def focal_length(off: float) -> Contradiction:
    """The focal length is `off` of the calibration's, relative."""
    way = "longer" if off > 0.0 else "shorter"
    text = f"focal length appears {100.0 * abs(off):.1f} % {way} than the calibration says"
    return Contradiction("calibration", "focal length", text)


def layer_shifted(layer: str, away_m: float) -> Contradiction:
    """A layer is so far from where it should be, seen from the others."""
    text = f"layer {layer} appears {_length(away_m)} from its surveyed position against the other lights"
    return Contradiction("survey", layer, text)


def _length(metres: float) -> str:
    return f"{100.0 * metres:.0f} cm" if metres >= 0.0095 else f"{1000.0 * metres:.0f} mm"


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
