"""The paper's method, figure 8: from a frame, or from its detections, to a fix."""

from __future__ import annotations

import numpy as np

from lumidock.camera import Camera
from lumidock.config import PaperConfig
from lumidock.datatypes import Detections, Fix, Frame, Match
from lumidock.errors import FrameError, InputError
from lumidock.paper import extract
from lumidock.paper.guidance import Guidance
from lumidock.paper.layer import LayerAnswer, LayerLocalizer
from lumidock.paper.layers import LayerDiscriminator, label_by_color
from lumidock.station import Station


class PaperLocalizer:
    """Frames or detections in, one fix each out; remembers the frames before unless `cold`."""

    def __init__(
        self, station: Station, camera: Camera, config: PaperConfig | None = None, *, cold: bool = False
    ) -> None:
        """Raises: InputError for a station of more than two layers, which the method cannot tell apart."""
        if len(station.layers) > 2:
            raise InputError(f"{station.name}: {len(station.layers)} layers; the paper's method knows at most two")
        self.station, self.camera, self.cold = station, camera, cold
        self.config = config or PaperConfig()
        self.forget()

    def forget(self) -> None:
        """Drop all history, as before the first frame."""
        self._layers = [
            LayerLocalizer(self.station, name, self.camera, self.config) for name in self.station.layers_front_to_rear()
        ]
        self._discriminator = LayerDiscriminator(self.config.layers)
        self._guidance = Guidance([(layer.layer, len(layer.lights)) for layer in self._layers])
        self._last_t_ns: int | None = None

    def process(self, frame: Frame) -> Fix:
        """Image door. Raises: FrameError when the image is not of the camera's size."""
        height, width = frame.image.shape[:2]
        if (width, height) != (self.camera.width, self.camera.height):
            wanted = f"{self.camera.width}x{self.camera.height}"
            raise FrameError("bad_frame", f"frame {frame.name} is {width}x{height}, the calibration {wanted}")
        detections = extract.lights(frame, self.config.extract)
        return self.process_detections(label_by_color(frame, detections, self.config.layers))

    def process_detections(self, detections: Detections) -> Fix:
        """Light door: detections from another detector, or from `process`."""
        if self.cold:
            self.forget()
        last, self._last_t_ns = self._last_t_ns, detections.t_ns
        if last is not None and detections.t_ns <= last:
            return self._no_fix(detections, "bad_stamp")
        light, answers = self._locate(detections)
        poses = {answer.pose.layer: answer.pose for answer in answers if answer.pose is not None}
        guide = self._guidance.choose(poses)
        if guide is None:
            return self._no_fix(detections, _reason(detections, answers))
        return Fix(
            detections.frame,
            detections.t_ns,
            next(answer.status for answer in answers if answer.pose is guide),
            self._guidance.stage,
            n_seen=len(detections),
            n_used=guide.n_used,
            T_dock_cam=guide.T_dock_cam,
            match=Match(detections, light),
            by_layer=tuple(poses.values()),
        )

    def _locate(self, detections: Detections) -> tuple[np.ndarray, list[LayerAnswer]]:
        """Light of each spot (N,) and what each layer answered."""
        light = np.full(len(detections), -1, np.int64)
        answers = []
        for layer, spots in zip(self._layers, self._split(detections), strict=True):
            answer = layer.locate(detections.t_ns, detections.uv[spots])
            light[spots] = answer.light
            answers.append(answer)
        return light, answers

    def _split(self, detections: Detections) -> list[np.ndarray]:
        """Which spots (N,) belong to each layer, front first."""
        if len(self._layers) == 1:
            return [np.ones(len(detections), bool)]
        rear = self._discriminator.rear(detections)
        return [~rear, rear]

    def _no_fix(self, detections: Detections, reason: str) -> Fix:
        return Fix(
            detections.frame,
            detections.t_ns,
            "none",
            self._guidance.stage,
            n_seen=len(detections),
            reason=reason,
            match=Match(detections, np.full(len(detections), -1, np.int64)),
        )


def _reason(detections: Detections, answers: list[LayerAnswer]) -> str:
    """The word for a frame without a pose: what the layer that came farthest said."""
    if not len(detections):
        return "no_lights"
    reasons = {answer.reason for answer in answers}
    return next(word for word in ("residual", "inconsistent", "too_few") if word in reasons)
