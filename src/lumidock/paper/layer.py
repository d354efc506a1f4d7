"""One layer on its own through matching, filter, correction and pose, paper sections 3.2 and 3.3."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lumidock.camera import Camera
from lumidock.config import PaperConfig
from lumidock.datatypes import Array, Indices, LayerPose, MatchSource, Status
from lumidock.paper import btekf, pso
from lumidock.paper.consistency import consistent
from lumidock.pose import reprojection_rms_px, sqpnp
from lumidock.station import Station

MIN_FOR_SWARM = 4  # lights of a layer, section 1, contribution (2)


@dataclass(frozen=True, slots=True, eq=False)
class LayerAnswer:
    """The light of each spot (N,), -1 for none, as indices into the station; and a pose or the reason against one.

    `status` is `tracking` when the layer had a track, `acquired` when it was won without.
    """

    light: Indices
    pose: LayerPose | None
    reason: str = ""
    status: Status = "none"


class LayerLocalizer:
    """Names one layer's spots and solves its pose; remembers the last registration and the filter's track."""

    def __init__(self, station: Station, layer: str, camera: Camera, config: PaperConfig) -> None:
        self.layer, self.camera, self.config = layer, camera, config
        self.lights = station.lights_of(layer)
        self.p_dock = station.p_dock[self.lights]
        self.registration: pso.Registration | None = None
        self.track: btekf.Track | None = None
        self._earned_t_ns: int | None = None  # last pose of four or more lights
        self._rng = np.random.default_rng(config.pso.seed)

    def locate(self, t_ns: int, uv: Array) -> LayerAnswer:
        """Answer for the spots `uv` (N, 2) px that were given to this layer."""
        predicted = self._predict(t_ns)
        light = self._by_swarm(uv)
        if light is not None:
            return self._conclude(t_ns, uv, light, "pso", predicted)
        corrected = predicted and btekf.correct(predicted, self.camera, self.p_dock, uv, self.config.btekf)
        if corrected:
            return self._conclude(t_ns, uv, corrected[1], "btekf", corrected[0])
        return self._nothing(uv, "inconsistent" if len(uv) >= MIN_FOR_SWARM else "too_few")

    def _predict(self, t_ns: int) -> btekf.Track | None:
        """The track at `t_ns`, unless it is too old or from the future."""
        if self.track is None or not 0 < t_ns - self.track.t_ns <= self.config.btekf.max_gap_s * 1e9:
            self.track = self.registration = None
            return None
        return btekf.predict(self.track, t_ns, self.config.btekf)

    def _by_swarm(self, uv: Array) -> Indices | None:
        """Light of each spot by registration, if it passes the ratio filter."""
        registration = self.register(uv) if len(uv) >= MIN_FOR_SWARM else None
        self.registration = None
        if registration is None:
            return None
        named = registration.light >= 0
        lights_xy = self.p_dock[registration.light[named], :2]
        if not consistent(lights_xy, self.plane(uv)[named], self.config.consistency):
            return None
        self.registration = registration
        return registration.light

    def register(self, uv: Array) -> pso.Registration | None:
        """The swarm's answer alone, unfiltered; None where the lens model cannot place a spot."""
        xy = self.plane(uv)
        if not np.isfinite(xy).all():
            return None
        return pso.register(xy, self.p_dock[:, :2], self.registration, self.config.pso, self._rng)

    def plane(self, uv: Array) -> Array:
        """Undistorted image coordinates (N, 2) with y up, as the lights have it."""
        ray = self.camera.unproject(uv)
        return np.asarray(ray[:, :2] / ray[:, 2:] * [1.0, -1.0])

    def _conclude(
        self, t_ns: int, uv: Array, light: Indices, source: MatchSource, track: btekf.Track | None
    ) -> LayerAnswer:
        """Section 3.3: pose of the named spots, and the track that the next frame starts from."""
        named = light >= 0
        p_dock, pixels = self.p_dock[light[named]], uv[named]
        T_dock_cam = self._solve(t_ns, p_dock, pixels, track)
        if T_dock_cam is None:
            return self._nothing(uv, "residual")
        status: Status = "acquired" if track is None else "tracking"
        if source == "pso" and track is not None:
            track = btekf.update(track, self.camera, p_dock, pixels, self.config.btekf)
        if track is None or not self._reprojects(track.T_dock_cam, p_dock, pixels):
            track = btekf.start(t_ns, T_dock_cam, self.camera, p_dock, self.config.btekf)
        self.track = track
        if len(p_dock) >= MIN_FOR_SWARM:
            self._earned_t_ns = t_ns
        pose = LayerPose(self.layer, T_dock_cam, int(named.sum()), source)
        return LayerAnswer(np.where(named, self.lights[light], -1), pose, status=status)

    def _solve(self, t_ns: int, p_dock: Array, uv: Array, track: btekf.Track | None) -> Array | None:
        """SQPnP; with three lights, which leave it several solutions, the filter's pose, shortly after a better one."""
        if len(uv) >= MIN_FOR_SWARM:
            T_dock_cam = sqpnp(self.camera, p_dock, uv)
        elif track is not None and self._earned_within(t_ns, self.config.btekf.three_light_gap_s):
            T_dock_cam = track.T_dock_cam
        else:
            return None
        if T_dock_cam is None or not self._reprojects(T_dock_cam, p_dock, uv):
            return None
        return T_dock_cam

    def _earned_within(self, t_ns: int, seconds: float) -> bool:
        return self._earned_t_ns is not None and t_ns - self._earned_t_ns <= seconds * 1e9

    def _reprojects(self, T_dock_cam: Array, p_dock: Array, uv: Array) -> bool:
        return reprojection_rms_px(self.camera, T_dock_cam, p_dock, uv) <= self.config.pose.max_rms_px

    @staticmethod
    def _nothing(uv: Array, reason: str) -> LayerAnswer:
        return LayerAnswer(np.full(len(uv), -1, np.int64), None, reason)
