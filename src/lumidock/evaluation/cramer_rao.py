"""The best accuracy that the lights in view allow: the filter's covariance along the true path, with true identities.

A recursive Cramer-Rao bound (P. Tichavsky, C. Muravchik, A. Nehorai, 1998) under the filter's own noise, priors and
history. Where it is inside the alert limits with a margin, a good method gives a valid fix.
"""

from __future__ import annotations

import math

import numpy as np

from lumidock import match, track
from lumidock._kernels.tracking import track as kernel
from lumidock._kernels.tracking.levels import levels
from lumidock._kernels.tracking.track import State
from lumidock._kernels.tracking.update import Pixels, take_in
from lumidock.camera import Camera
from lumidock.config import Config
from lumidock.datatypes import Array, Indices
from lumidock.geometry import se3_inverse
from lumidock.integrity import sigma_factors
from lumidock.pose import project_lights
from lumidock.station import Station

_MIN_START = 4
_MARGIN = 1.3  # protection levels this many times those of the bound must be inside the alert limits


class Bound:
    """Follows one run along its true path; each `step` gives the smallest protection levels (3,) that are possible."""

    def __init__(self, station: Station, camera: Camera, config: Config, *, cold: bool = False) -> None:
        self.station, self.camera, self.config, self.cold = station, camera, config, cold
        self._plan = match.plan(station, camera, config.match)
        self._prior = match.prior(None, config.prior)
        self._factors = sigma_factors(config.integrity.risk)
        self.forget()

    def forget(self) -> None:
        """Start anew, as before the first frame."""
        self._P: Array | None = None
        self._t_ns = self._lights_ns = self._agreed_ns = 0
        self._joint = False
        self._known = np.zeros(self._plan.n_layers, bool)

    def step(self, t_ns: int, T_dock_cam: Array, lights: Indices) -> Array | None:
        """Lateral m, axial m and angle rad of protection at `t_ns` on the true pose with `lights` (K,) detected."""
        if self.cold or (self._P is not None and t_ns - self._lights_ns > self.config.track.max_gap_s * 1e9):
            self.forget()
        T_cam_dock = se3_inverse(T_dock_cam)
        R, t = np.ascontiguousarray(T_cam_dock[:3, :3]), np.ascontiguousarray(T_cam_dock[:3, 3])
        if self._P is None:
            if len(lights) < _MIN_START:
                return None
            self._P = self._start(R, t)
        else:
            self._predict(R, t, (t_ns - self._t_ns) * 1e-9)
        self._t_ns = t_ns
        if len(lights):
            self._update(R, t, T_dock_cam, lights)
            self._lights_ns = t_ns
            self._agreed_ns = t_ns if len(lights) >= _MIN_START else self._agreed_ns
        elif t_ns - self._lights_ns > self.config.integrity.max_age_s * 1e9:
            return None
        if t_ns - self._agreed_ns > self.config.track.max_gap_s * 1e9:
            return None  # three lights fit many poses
        nothing = np.zeros((len(self.station), 18))
        return np.array(
            levels(R, t, self._P, nothing, track.NO_PLANE, self._factors, self._factors, False, np.empty((9, 9)))[:3]
        )

    def allows_valid(self, t_ns: int, T_dock_cam: Array, lights: Indices) -> bool:
        """Whether a valid fix is possible in this frame with a margin: 1.3 times the bound is inside the limits."""
        pl = self.step(t_ns, T_dock_cam, lights)
        if pl is None:
            return False
        lateral, axial, angle = (_MARGIN * pl).tolist()
        lateral_m, axial_m, angle_rad = self.station.alert_limits.of_pose(float(T_dock_cam[2, 3]), axial)
        return lateral < lateral_m and axial < axial_m and angle < angle_rad and math.isfinite(lateral)

    def _start(self, R: Array, t: Array) -> Array:
        x, P = track.start_states(self.station, None, self.config.track)
        kernel.attitude_update(R.copy(), t.copy(), x, P, self._prior.R_dock_cam, 1.0 / self._prior.info, False)
        return P

    def _predict(self, R: Array, t: Array, dt: float) -> None:
        config = self.config.track
        assert self._P is not None
        kernel.predict(R.copy(), t.copy(), np.zeros(6), self._P, dt, config.accel_m_s2**2, config.accel_rad_s2**2)

    def _update(self, R: Array, t: Array, T_dock_cam: Array, lights: Indices) -> None:
        """Exact pixels of the lights: the mean stays where it is, and the covariance shrinks.

        A layer counts from the first frame on that shows three lights of it, as in the filter.
        """
        assert self._P is not None
        count = np.bincount(self._plan.layer[lights], minlength=self._plan.n_layers)
        self._known |= (count >= track.LAYER_LIGHTS) | (count == count.max())
        lights = lights[self._known[self._plan.layer[lights]]]
        name = np.full(len(self.station), -1, np.int64)
        name[lights] = np.arange(len(lights))
        uv = project_lights(self.camera, T_dock_cam, self.station.p_dock[lights])
        cov = np.tile(np.eye(2) * self.config.match.noise_px**2, (len(lights), 1, 1))
        self._joint = self._joint or track.is_joint(name, self._plan, self.config.track)
        n = len(self._P) if self._joint else kernel.CALIBRATION
        take_in(
            self._plan.lens,
            self._plan.p_dock,
            R,
            t,
            State(R.copy(), t.copy(), np.zeros(len(self._P)), self._P),
            Pixels(name, uv, cov),
            n,
            1,
            track.NO_PLANE,
            np.eye(3),
            False,
            np.zeros((len(name), 18)),
        )
