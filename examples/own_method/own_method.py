"""A matcher of one's own: detections and lights of the front layer, each in their order around the centre.

pip install examples/own_method, and then: lumidock run SOURCE --method polar-order --out RUN
"""

from dataclasses import replace

import numpy as np

from lumidock import Camera, Config, Detections, Fix, Frame, Station, solve_pose
from lumidock.datatypes import Match
from lumidock.detect import lights


class PolarOrder:
    """As many detections as the front layer has lights, matched in their order around the centre."""

    def __init__(self, station: Station, camera: Camera, config: Config, *, cold: bool = False) -> None:  # noqa: ARG002
        self.station, self.camera, self.config = station, camera, config
        front = station.lights_of(station.layers_front_to_rear()[0])
        self.lights = front[np.argsort(angle(station.p_dock[front, :2] * [1, -1]))]  # pixels have y down

    def process(self, frame: Frame) -> Fix:
        """Fix of one frame, by the detector of lumidock."""
        return self.process_detections(lights(frame, self.config.detect))

    def process_detections(self, detections: Detections) -> Fix:
        """Fix of one frame's detections."""
        front = np.flatnonzero((detections.p_light > 0.5) & ~(detections.p_rear > 0.5))
        order = front[np.argsort(angle(detections.uv[front]))]
        turns = [np.roll(self.lights, k) for k in range(len(order)) if len(order) == len(self.lights)]
        solved = [(solve_pose(self.station, self.camera, turn, detections.uv[order]), turn) for turn in turns]
        fits = [(poses[0], turn) for poses, turn in solved if poses and poses[0].chi2 < 40.0]  # of 14 coordinates
        if not fits:
            return Fix(detections.frame, detections.t_ns, "none", "search", reason="inconsistent")
        best, turn = min(fits, key=lambda fit: fit[0].chi2)
        light = np.full(len(detections), -1)
        light[order] = turn
        fix = Fix(detections.frame, detections.t_ns, "acquired", "front", T_dock_cam=best.T_dock_cam)
        return replace(fix, n_seen=len(light), n_used=len(turn), match=Match(detections, light))

    def forget(self) -> None:
        """Nothing is remembered."""


def angle(xy: np.ndarray) -> np.ndarray:
    """Angle (N,) of points (N, 2) around their mean."""
    return np.arctan2(*(xy - xy.mean(axis=0)).T[::-1])
