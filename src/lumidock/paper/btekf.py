"""The backtracking extended Kalman filter that identifies lights from history, paper section 3.2.3.

The state is the pose (right perturbation of T_dock_cam) and the twist in `cam`: the paper's "Gaussian motion model
constructed from previous pose estimates". The gate of eq. (12) as printed has no measurement noise; here it has, and
the search has a branch for a light that is missing, without which one missing light would void every frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lumidock.camera import Camera
from lumidock.config import BtekfConfig
from lumidock.datatypes import Array, Indices
from lumidock.geometry import se3_adjoint, se3_exp, se3_right_jacobian
from lumidock.pose import project_lights, project_lights_with_jacobian


@dataclass(frozen=True, slots=True, eq=False)
class LayerTrack:
    """Pose `T_dock_cam` (4, 4), `twist` (6,) [m/s, rad/s] in cam, and their covariance (12, 12) at `t_ns`."""

    t_ns: int
    T_dock_cam: Array
    twist: Array
    cov: Array


def start(t_ns: int, T_dock_cam: Array, camera: Camera, p_dock: Array, config: BtekfConfig) -> LayerTrack:
    """Begin a track at a pose found from the lights `p_dock` (N, 3), with an unknown velocity."""
    _, J = project_lights_with_jacobian(camera, T_dock_cam, p_dock)
    information = np.einsum("nij,nik->jk", J, J) / config.pixel_sigma**2 + 1e-3 * np.eye(6)
    cov = np.zeros((12, 12))
    cov[:6, :6] = np.linalg.inv(information)
    cov[6:9, 6:9] = np.eye(3) * config.start_speed_m_s**2
    cov[9:, 9:] = np.eye(3) * config.start_rate_rad_s**2
    return LayerTrack(t_ns, T_dock_cam, np.zeros(6), cov)


def predict(track: LayerTrack, t_ns: int, config: BtekfConfig) -> LayerTrack:
    """Carry a track to `t_ns` at constant twist, with white noise on the acceleration."""
    dt = (t_ns - track.t_ns) * 1e-9
    F = np.eye(12)
    F[:6, :6] = se3_adjoint(se3_exp(-track.twist * dt))
    F[:6, 6:] = se3_right_jacobian(track.twist * dt) * dt
    noise = np.repeat([config.accel_m_s2, config.accel_rad_s2], 3) ** 2
    Q = np.zeros((12, 12))
    Q[:6, :6] = np.diag(noise * dt**3 / 3.0)
    Q[6:, 6:] = np.diag(noise * dt)
    Q[:6, 6:] = Q[6:, :6] = np.diag(noise * dt**2 / 2.0)
    return LayerTrack(t_ns, track.T_dock_cam @ se3_exp(track.twist * dt), track.twist, F @ track.cov @ F.T + Q)


def update(track: LayerTrack, camera: Camera, p_dock: Array, uv: Array, config: BtekfConfig) -> LayerTrack:
    """Sequential update with known matches: lights `p_dock` (N, 3) seen at `uv` (N, 2)."""
    for p, pixel in zip(p_dock, uv, strict=True):
        gate = _Gate.of(track, camera, p, config)
        if gate is not None:
            track = gate.update(track, pixel)
    return track


@dataclass(frozen=True, slots=True, eq=False)
class _Gate:
    """A light under a track: predicted pixel `v` (2,), Jacobian (2, 12), covariances (2, 2) of innovation and gate."""

    v: Array
    J: Array
    S: Array
    S_gate: Array

    @classmethod
    def of(cls, track: LayerTrack, camera: Camera, p: Array, config: BtekfConfig) -> _Gate | None:
        """Predict one light (3,); None when the lens does not see it from there."""
        uv, J_uv_pose = project_lights_with_jacobian(camera, track.T_dock_cam, p[None])
        if not np.isfinite(uv).all():
            return None
        J = np.concatenate([J_uv_pose[0], np.zeros((2, 6))], axis=1)
        projected = J @ track.cov @ J.T  # Eq. (11)
        S = projected + config.pixel_sigma**2 * np.eye(2)
        return cls(uv[0], J, S, S if config.noise_in_gate else projected)

    def distance2(self, uv: Array) -> Array:
        """Squared Mahalanobis distance (N,) of pixels `uv` (N, 2): eq. (12)."""
        error = uv - self.v
        return np.asarray(np.einsum("ni,ni->n", error, np.linalg.solve(self.S_gate, error.T).T))

    def update(self, track: LayerTrack, pixel: Array) -> LayerTrack:
        """The track after this light was seen at `pixel` (2,): eq. (13)."""
        K = np.linalg.solve(self.S, self.J @ track.cov).T
        step = K @ (pixel - self.v)
        cov = track.cov - K @ self.S @ K.T
        T_dock_cam = track.T_dock_cam @ se3_exp(step[:6])
        return LayerTrack(track.t_ns, T_dock_cam, track.twist + step[6:], 0.5 * (cov + cov.T))


def correct(
    predicted: LayerTrack, camera: Camera, p_dock: Array, uv: Array, config: BtekfConfig
) -> tuple[LayerTrack, Indices] | None:
    """Associate the detections `uv` (N, 2) with the lights `p_dock` (M, 3) from a predicted track.

    Returns the updated track and the light of each detection (N,), -1 for none; None when fewer than `min_lights` are
    identified. Fewer missing lights are tried before more.
    """
    order = _gated_lights(predicted, camera, p_dock, uv, config)
    search = _Search(camera, p_dock, uv, config)
    spare = len(order) - config.min_lights
    for missing in range(spare + 1 if config.missing_branch else min(spare + 1, 1)):
        track = search.run(predicted, order, frozenset(), missing)
        if track is not None:
            return _accept(track, camera, p_dock, uv, config)
    return None


def _gated_lights(predicted: LayerTrack, camera: Camera, p_dock: Array, uv: Array, config: BtekfConfig) -> list[int]:
    """Lights with at least one detection inside their gate, in order of their smallest gating residual."""
    best: dict[int, float] = {}
    for i, p in enumerate(p_dock):
        gate = _Gate.of(predicted, camera, p, config)
        nearest = np.inf if gate is None or not len(uv) else float(gate.distance2(uv).min())
        if nearest <= config.gate:
            best[i] = nearest
    return sorted(best, key=best.__getitem__)


class _Search:
    """Depth-first search over the lights, each given a detection or, while allowed, declared missing."""

    def __init__(self, camera: Camera, p_dock: Array, uv: Array, config: BtekfConfig) -> None:
        self.camera, self.p_dock, self.uv, self.config = camera, p_dock, uv, config
        self.nodes = 0

    def run(self, track: LayerTrack, lights: list[int], used: frozenset[int], missing: int) -> LayerTrack | None:
        """The track after all `lights` are associated with at most `missing` left out; None: backtrack."""
        if not lights:
            return track
        self.nodes += 1
        if self.nodes > self.config.max_nodes:
            return None
        light, rest = lights[0], lights[1:]
        for detection, updated in self._candidates(track, light, used):
            done = self.run(updated, rest, used | {detection}, missing)
            if done is not None:
                return done
        return self.run(track, rest, used, missing - 1) if missing else None

    def _candidates(self, track: LayerTrack, light: int, used: frozenset[int]) -> list[tuple[int, LayerTrack]]:
        """Detections inside the gate of the light, nearest first, whose update leaves an acceptable residual."""
        gate = _Gate.of(track, self.camera, self.p_dock[light], self.config)
        if gate is None:
            return []
        d2 = gate.distance2(self.uv)
        accepted = []
        for detection in np.argsort(d2, kind="stable"):
            if d2[detection] > self.config.gate:
                break
            if int(detection) in used:
                continue
            updated = gate.update(track, self.uv[detection])
            residual = project_lights(self.camera, updated.T_dock_cam, self.p_dock[light][None])[0] - self.uv[detection]
            if np.hypot(*residual) < self.config.accept_px:
                accepted.append((int(detection), updated))
        return accepted


def _accept(
    track: LayerTrack, camera: Camera, p_dock: Array, uv: Array, config: BtekfConfig
) -> tuple[LayerTrack, Indices] | None:
    """Section 3.2.3 e: reproject every light, take the nearest detection within the pixel threshold."""
    light = associate(project_lights(camera, track.T_dock_cam, p_dock), uv, config.accept_px)
    return (track, light) if (light >= 0).sum() >= config.min_lights else None


def associate(projected: Array, uv: Array, max_px: float) -> Indices:
    """Light of each detection `uv` (N, 2): one to one, nearest pairs first, none farther than `max_px`; -1 for none."""
    distance = np.linalg.norm(uv[:, None] - projected[None], axis=2)
    distance[np.isnan(distance)] = np.inf
    light = np.full(len(uv), -1, np.int64)
    for flat in np.argsort(distance, axis=None, kind="stable"):
        detection, candidate = np.unravel_index(flat, distance.shape)
        if distance[detection, candidate] > max_px:
            break
        if light[detection] < 0 and candidate not in light:
            light[detection] = candidate
    return light
