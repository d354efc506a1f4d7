"""A baseline as a localizer: the same detections, layers and acceptance of poses for all of them; no history."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lumidock import detect, layers
from lumidock.baselines.view import Associate, view_of
from lumidock.camera import Camera
from lumidock.config import Config
from lumidock.datatypes import Array, Detections, Fix, Frame, Indices, Match, Stage
from lumidock.errors import FrameError, InputError
from lumidock.pose import reprojection_rms_px, sqpnp
from lumidock.station import Station

_MIN_LIGHTS = 4  # of a layer, for a pose of its own
_REAR = 0.5  # probability from which a detection is given to the rear layer


class BaselineLocalizer:
    """Frames or detections in, one fix each out; every frame on its own.

    Each layer is associated by `associate` and solved by SQPnP; a pose stands when its lights reproject within
    `paper.pose.max_rms_px`, as in the paper's method, and the layer with more identified lights answers.
    """

    def __init__(self, associate: Associate, station: Station, camera: Camera, config: Config) -> None:
        """Raises: InputError for a station of more than two layers."""
        if len(station.layers) > 2:
            raise InputError(f"{station.name}: {len(station.layers)} layers; the baselines know at most two")
        self.associate, self.station, self.camera, self.config = associate, station, camera, config
        self._layers = [station.lights_of(name) for name in station.layers_front_to_rear()]
        self.forget()

    def forget(self) -> None:
        """Begin anew: the random draws, the only thing that lasts from frame to frame, start over."""
        self._rng = np.random.default_rng(self.config.paper.pso.seed)

    def process(self, frame: Frame) -> Fix:
        """Fix of one frame, by the detector of the default method. Raises: FrameError for an image of another size."""
        height, width = frame.image.shape[:2]
        if (width, height) != (self.camera.width, self.camera.height):
            wanted = f"{self.camera.width}x{self.camera.height}"
            raise FrameError("bad_frame", f"frame {frame.name} is {width}x{height}, the calibration {wanted}")
        detections = detect.lights(frame, self.config.detect)
        return self.process_detections(layers.label(frame, detections, self.config.label))

    def process_detections(self, detections: Detections) -> Fix:
        """Fix of one frame's detections."""
        light = np.full(len(detections), -1, np.int64)
        poses: list[tuple[int, int, Array]] = []
        reason = "too_few" if len(detections) else "no_lights"
        for layer, members in enumerate(self._split(detections)):
            found, T_dock_cam, why = self._locate(self._layers[layer], detections.uv[members])
            light[members] = found
            if T_dock_cam is None:
                reason = why if why != "too_few" else reason
            else:
                poses.append((int((found >= 0).sum()), layer, T_dock_cam))
        match, n_seen = Match(detections, light), len(detections)
        if not poses:
            nothing = Fix(detections.frame, detections.t_ns, "none", "search", reason=reason)
            return replace(nothing, n_seen=n_seen, match=match)
        n_used, _, T_dock_cam = max(poses, key=lambda pose: pose[0])
        stage: Stage = "transition" if len(poses) > 1 else ("front", "rear")[poses[0][1]]
        answered = Fix(detections.frame, detections.t_ns, "acquired", stage, T_dock_cam=T_dock_cam)
        return replace(answered, n_seen=n_seen, n_used=n_used, match=match)

    def _split(self, detections: Detections) -> list[np.ndarray]:
        """Which detections (N,) belong to each layer, front first; without colour all count as front."""
        inside = self.camera.contains(detections.uv)
        rear = detections.p_rear > _REAR
        return [inside] if len(self._layers) == 1 else [inside & ~rear, inside & rear]

    def _locate(self, lights: Indices, uv: Array) -> tuple[Indices, Array | None, str]:
        """Light of each detection (N,) of a layer, as indices into the station, and the pose or why there is none."""
        nothing = np.full(len(uv), -1, np.int64)
        if len(uv) < _MIN_LIGHTS:
            return nothing, None, "too_few"
        view = view_of(self.camera, self.station.p_dock[lights], self.station.axis[lights], uv)
        found = self.associate(view, self._rng) if np.isfinite(view.xy).all() else None
        if found is None or (found >= 0).sum() < _MIN_LIGHTS:
            return nothing, None, "inconsistent"
        identified = found >= 0
        p_dock, pixels = view.p_dock[found[identified]], uv[identified]
        T_dock_cam = sqpnp(self.camera, p_dock, pixels)
        limit = self.config.paper.pose.max_rms_px
        if T_dock_cam is None or reprojection_rms_px(self.camera, T_dock_cam, p_dock, pixels) > limit:
            return nothing, None, "residual"
        return np.where(identified, lights[found], -1), T_dock_cam, ""
