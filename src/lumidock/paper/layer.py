"""One layer on its own through matching, filter, correction and pose, paper sections 3.2 and 3.3."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lumidock.camera import Camera
from lumidock.config import PaperConfig
from lumidock.datatypes import Array, Indices, LayerPose, MatchSource, Status
from lumidock.paper import btekf, pso
from lumidock.paper.consistency import consistent
from lumidock.pose import project_lights, reprojection_rms_px, sqpnp
from lumidock.station import Station

MIN_FOR_SWARM = 4  # lights of a layer, section 1, contribution (2)


@dataclass(frozen=True, slots=True, eq=False)
class LayerAnswer:
    """The light of each detection (N,), -1 for none, as indices into the station; and a pose or the reason against one.

    `status` is `tracking` when the layer had a track, `acquired` when the lights were identified without one.
    """

    light: Indices
    pose: LayerPose | None
    reason: str = ""
    status: Status = "none"


@dataclass(frozen=True, slots=True, eq=False)
class _Association:
    """The light of each detection (N,), index into the layer, -1 for none; who found it, and the track it belongs to.

    `track` is the filter's state after it was updated with these detections (`btekf`), or as predicted (`pso`), None
    without history.
    """

    light: Indices
    source: MatchSource
    track: btekf.LayerTrack | None


class LayerLocalizer:
    """Identifies the lights of one layer and solves its pose; remembers the last registration and the track."""

    def __init__(self, station: Station, layer: str, camera: Camera, config: PaperConfig) -> None:
        self.layer, self.camera, self.config = layer, camera, config
        self.lights = station.lights_of(layer)
        self.p_dock = station.p_dock[self.lights]
        self.registration: pso.Registration | None = None
        self.track: btekf.LayerTrack | None = None
        self._by_filter = False  # whether the filter associated the previous frame
        self._earned_t_ns: int | None = None  # last pose of four or more lights
        self._rng = np.random.default_rng(config.pso.seed)

    def locate(self, t_ns: int, uv: Array) -> LayerAnswer:
        """Answer for the detections `uv` (N, 2) px that were given to this layer."""
        predicted = self._predict(t_ns)
        after_filter, self._by_filter = self._by_filter, False
        if after_filter and predicted is not None and self.config.btekf.pose_from_filter:
            answer = self._conclude(t_ns, uv, self._by_reprojection(uv, predicted))
            if answer.pose is not None:
                self.registration = None
                return answer
        light = self._by_swarm(uv)
        if light is not None:
            return self._conclude(t_ns, uv, _Association(light, "pso", predicted))
        corrected = predicted and btekf.correct(predicted, self.camera, self.p_dock, uv, self.config.btekf)
        if corrected:
            self._by_filter = True
            return self._conclude(t_ns, uv, _Association(corrected[1], "btekf", corrected[0]))
        return self._nothing(uv, "inconsistent" if len(uv) >= MIN_FOR_SWARM else "too_few")

    def _predict(self, t_ns: int) -> btekf.LayerTrack | None:
        """The track at `t_ns`, unless it is too old or from the future."""
        if self.track is None or not 0 < t_ns - self.track.t_ns <= self.config.btekf.max_gap_s * 1e9:
            self.track = self.registration = None
            return None
        return btekf.predict(self.track, t_ns, self.config.btekf)

    def _by_reprojection(self, uv: Array, predicted: btekf.LayerTrack) -> _Association:
        """Section 3.2.3 e, the frame after the filter: the nearest detection to each light as predicted."""
        projected = project_lights(self.camera, predicted.T_dock_cam, self.p_dock)
        light = btekf.associate(projected, uv, self.config.btekf.accept_px)
        return _Association(light, "pso", predicted)

    def _by_swarm(self, uv: Array) -> Indices | None:
        """Light of each detection by registration, if it passes the ratio filter."""
        registration = self.register(uv) if len(uv) >= MIN_FOR_SWARM else None
        self.registration = None
        if registration is None or not self.passes(uv, registration.light):
            return None
        self.registration = registration
        return registration.light

    def passes(self, uv: Array, light: Indices) -> bool:
        """Whether an association of the detections `uv` (N, 2) passes the ratio filter."""
        identified = light >= 0
        lights_xy = self.p_dock[light[identified], :2]
        return consistent(lights_xy, self.plane(uv)[identified], self.config.consistency)

    def register(self, uv: Array) -> pso.Registration | None:
        """The swarm's answer alone, unfiltered; None where the lens model cannot place a detection."""
        xy = self.plane(uv)
        if not np.isfinite(xy).all():
            return None
        return pso.register(xy, self.p_dock[:, :2], self.registration, self.config.pso, self._rng)

    def plane(self, uv: Array) -> Array:
        """Undistorted image coordinates (N, 2) with y up, as the lights have it."""
        ray = self.camera.unproject(uv)
        return np.asarray(ray[:, :2] / ray[:, 2:] * [1.0, -1.0])

    def _conclude(self, t_ns: int, uv: Array, found: _Association) -> LayerAnswer:
        """Section 3.3: pose of the identified lights, and the track that the next frame starts from."""
        identified, track = found.light >= 0, found.track
        p_dock, pixels = self.p_dock[found.light[identified]], uv[identified]
        T_dock_cam = self._solve(t_ns, p_dock, pixels, found)
        if T_dock_cam is None:
            return self._nothing(uv, "residual")
        status: Status = "acquired" if track is None else "tracking"
        if found.source == "pso" and track is not None:
            track = btekf.update(track, self.camera, p_dock, pixels, self.config.btekf)
        if track is None or not self._reprojects(track.T_dock_cam, p_dock, pixels):
            track = btekf.start(t_ns, T_dock_cam, self.camera, p_dock, self.config.btekf)
        self.track = track
        if len(p_dock) >= MIN_FOR_SWARM:
            self._earned_t_ns = t_ns
        pose = LayerPose(self.layer, T_dock_cam, int(identified.sum()), found.source)
        return LayerAnswer(np.where(identified, self.lights[found.light], -1), pose, status=status)

    def _solve(self, t_ns: int, p_dock: Array, uv: Array, found: _Association) -> Array | None:
        """SQPnP; the filter's pose for three lights, which leave several solutions, or where section 3.2.3 e holds."""
        if len(uv) < self.config.btekf.min_lights:
            return None
        if found.track is not None and found.source == "btekf" and self.config.btekf.pose_from_filter:
            T_dock_cam: Array | None = found.track.T_dock_cam
        elif len(uv) >= MIN_FOR_SWARM:
            T_dock_cam = sqpnp(self.camera, p_dock, uv)
        elif found.track is not None and self._earned_within(t_ns, self.config.btekf.three_light_gap_s):
            T_dock_cam = found.track.T_dock_cam
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
