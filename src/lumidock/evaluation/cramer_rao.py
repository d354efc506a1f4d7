"""The best accuracy that the lights in view allow: the filter's covariance along the true path, with true identities.

A recursive Cramer-Rao bound (P. Tichavsky, C. Muravchik, A. Nehorai, 1998) under the filter's own noise, priors and
history, with the same protection against one wrong light. Where it is inside the alert limits with a margin, a good
method gives a valid fix.
"""

from __future__ import annotations

import math

import numpy as np

from lumidock import track
from lumidock._kernels.tracking import track as kernel
from lumidock._kernels.tracking.bank import BankRules, predict_bank, update_bank
from lumidock._kernels.tracking.levels import Groups, protection_levels
from lumidock._kernels.tracking.track import FilterState
from lumidock._kernels.tracking.update import Assigned, UpdateRules, update
from lumidock.camera import Camera
from lumidock.config import Config
from lumidock.datatypes import Array, Indices
from lumidock.geometry import se3_inverse
from lumidock.integrity import fault_factors
from lumidock.light_counts import CHECKED_LIGHTS, LAYER_LIGHTS
from lumidock.model import attitude_prior, believed, station_model
from lumidock.pose import project_lights
from lumidock.station import Station

_MARGIN = 1.3  # protection levels this many times those of the bound must be inside the alert limits


class Bound:
    """Follows one run along its true path; each `step` gives the smallest protection levels (5,) that are possible."""

    def __init__(self, station: Station, camera: Camera, config: Config, *, cold: bool = False) -> None:
        self.station, self.camera, self.config, self.cold = station, camera, config, cold
        self._model = station_model(station, camera, config.match)
        self._prior = attitude_prior(None, config.prior)
        self._declared = track.calibration_prior(believed(station, config.files), None)
        self._no_planes = np.full_like(self._model.planes, np.nan)  # the true tilt is known
        self.forget()

    def forget(self) -> None:
        """Start anew, as before the first frame."""
        self._P: Array | None = None
        self._t_ns = self._lights_ns = self._agreed_ns = 0
        self._joint = False
        self._known = np.zeros(self._model.n_layers, bool)

    def step(self, t_ns: int, T_dock_cam: Array, lights: Indices) -> Array | None:
        """Levels (5,) at `t_ns` on the true pose with `lights` (K,) detected; None where there can be no pose.

        Lateral m, axial m, angle rad, bearing rad and range m.
        """
        if self.cold or (self._P is not None and t_ns - self._lights_ns > self.config.track.max_gap_s * 1e9):
            self.forget()
        T_cam_dock = se3_inverse(T_dock_cam)
        R, t = np.ascontiguousarray(T_cam_dock[:3, :3]), np.ascontiguousarray(T_cam_dock[:3, 3])
        if self._P is None:
            if len(lights) < CHECKED_LIGHTS:
                return None
            self._P = self._start(R, t)
        else:
            self._predict(R, t, (t_ns - self._t_ns) * 1e-9)
        self._t_ns = t_ns
        if len(lights):
            self._update(R, t, T_dock_cam, lights)
            self._lights_ns = t_ns
            self._agreed_ns = t_ns if len(lights) >= CHECKED_LIGHTS else self._agreed_ns
        elif t_ns - self._lights_ns > self.config.integrity.max_age_s * 1e9:
            return None
        if t_ns - self._agreed_ns > self.config.track.max_gap_s * 1e9:
            return None  # three lights fit many poses
        factors = fault_factors(int(self._bank.used.sum()), self.config.integrity)
        levels = protection_levels(
            self._at(R, t),
            track.NO_PLANE,
            self._bank,
            Groups(self._model.group, self._no_planes),
            factors,
            np.empty((9, 9)),
        )
        return np.array(levels)

    def _at(self, R: Array, t: Array) -> FilterState:
        """The filter on the true pose `R`, `t` of T_cam_dock; its covariance is shared, and changes in place."""
        assert self._P is not None
        return FilterState(R.copy(), t.copy(), np.zeros(len(self._P)), self._P)

    def allows_valid(self, t_ns: int, T_dock_cam: Array, lights: Indices) -> bool:
        """Whether a valid fix is possible in this frame with a margin: 1.3 times the bound is inside the limits."""
        pl = self.step(t_ns, T_dock_cam, lights)
        if pl is None:
            return False
        lateral, axial, angle = (_MARGIN * pl[:3]).tolist()
        lateral_m, axial_m, angle_rad = self.station.alert_limits.of_pose(float(T_dock_cam[2, 3]), axial)
        return lateral < lateral_m and axial < axial_m and angle < angle_rad and math.isfinite(lateral)

    def _start(self, R: Array, t: Array) -> Array:
        x, P = track.open_states(self._declared, self.config.track)
        state = FilterState(R.copy(), t.copy(), x, P)
        kernel.attitude_update(state, self._prior.R_dock_cam, 1.0 / self._prior.info, False)
        self._bank = track.open_bank(self._model)
        return P

    def _predict(self, R: Array, t: Array, dt: float) -> None:
        config = self.config.track
        q = config.accel_m_s2**2, config.accel_rad_s2**2
        kernel.predict(self._at(R, t), dt, *q)
        predict_bank(self._bank, self._at(R, t), dt, *q)

    def _update(self, R: Array, t: Array, T_dock_cam: Array, lights: Indices) -> None:
        """Exact pixels of the lights: the mean stays where it is, and the covariance shrinks.

        A layer counts from the first frame on that shows three lights of it, as in the filter.
        """
        count = np.bincount(self._model.layer[lights], minlength=self._model.n_layers)
        self._known |= (count >= LAYER_LIGHTS) | (count == count.max())
        lights = lights[self._known[self._model.layer[lights]]]
        assignment = np.full(len(self.station), -1, np.int64)
        assignment[lights] = np.arange(len(lights))
        uv = project_lights(self.camera, T_dock_cam, self.station.p_dock[lights])
        cov = np.tile(np.eye(2) * self.config.match.noise_px**2, (len(lights), 1, 1))
        self._joint = self._joint or track.sees_two_layers(self._model.count(assignment))
        state = self._at(R, t)
        rules = UpdateRules(
            estimated=len(state.P) if self._joint else kernel.CALIBRATION,
            steps=1,
            tracking=False,
            plane=track.NO_PLANE,
            turn_cov=np.eye(3),
        )
        seen = Assigned(assignment, uv, cov)
        before, bank = state._replace(P=state.P.copy()), track.empty_like(self._bank)
        update(self._model.lights, self._at(R, t), state, seen, rules)
        bank_rules = BankRules(
            group=self._model.group,
            layer=self._model.layer,
            planes=self._no_planes,
            estimated=rules.estimated,
            depth_known=True,
            starting=False,
            turn_cov=np.eye(3),
            proven_m=self.config.track.proven_m,
        )
        update_bank(self._model.lights, before, before, seen, bank_rules, bank=self._bank, updated=bank)
        self._bank = bank
