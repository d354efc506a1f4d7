"""The paper's method, figure 8: from a frame, or from its detections, to a fix."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lumidock.camera import Camera
from lumidock.config import PaperConfig
from lumidock.datatypes import Detections, Fix, Frame, Match
from lumidock.errors import FrameError, InputError
from lumidock.paper import extract
from lumidock.paper.guidance import Guidance
from lumidock.paper.layer import MIN_FOR_SWARM, LayerAnswer, LayerLocalizer
from lumidock.paper.layers import LayerDiscriminator, label_by_color
from lumidock.picture import developed
from lumidock.station import Station

_MIN_SPREAD = 0.05  # of a layer's lights across their line, as a share of along it


class PaperLocalizer:
    """Frames or detections in, one fix each out; remembers the frames before unless `cold`."""

    def __init__(
        self, station: Station, camera: Camera, config: PaperConfig | None = None, *, cold: bool = False
    ) -> None:
        """Raises: InputError for a station that the method cannot tell apart."""
        self.station, self.camera, self.cold = station, camera, cold
        self.config = config or PaperConfig()
        _check(station, self.config)
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
        """Fix of one frame, reduced to 8 bits. Raises: FrameError when the image is not of the camera's size."""
        height, width = frame.image.shape[:2]
        if (width, height) != (self.camera.width, self.camera.height):
            wanted = f"{self.camera.width}x{self.camera.height}"
            raise FrameError("bad_frame", f"frame {frame.name} is {width}x{height}, the calibration {wanted}")
        frame = replace(frame, image=developed(frame), encoding="")
        detections = extract.lights(frame, self.config.extract)
        return self.process_detections(label_by_color(frame, detections, self.config.layers))

    def process_detections(self, detections: Detections) -> Fix:
        """Fix of one frame's detections, from another detector or from `process`.

        A stamp that does not follow the one before gives no fix; the stamp after it is measured against it, so that a
        clock that was set back costs one frame and the history.
        """
        if self.cold:
            self.forget()
        last, self._last_t_ns = self._last_t_ns, detections.t_ns
        if last is not None and detections.t_ns <= last:
            return self._no_fix(detections, "bad_stamp")
        if len(detections) > self.config.max_detections:
            return self._no_fix(detections, "too_many")
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
        """Light of each detection (N,) and the answer of each layer."""
        light = np.full(len(detections), -1, np.int64)
        answers = []
        for layer, members in zip(self._layers, self._split(detections), strict=True):
            answer = layer.locate(detections.t_ns, detections.uv[members])
            light[members] = answer.light
            answers.append(answer)
        return light, answers

    def _split(self, detections: Detections) -> list[np.ndarray]:
        """Which detections (N,) belong to each layer, front first."""
        inside = self.camera.contains(detections.uv)
        if len(self._layers) == 1:
            return [inside]
        rear = self._discriminator.rear(detections)
        return [inside & ~rear, inside & rear]

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


def _check(station: Station, config: PaperConfig) -> None:
    """Refuse what the method was not made for. Raises: InputError."""
    if len(station.layers) > 2:
        raise InputError(f"{station.name}: {len(station.layers)} layers; the paper's method knows at most two")
    for layer in station.layers:
        xy = station.p_dock[station.lights_of(layer), :2]
        if not MIN_FOR_SWARM <= len(xy) <= config.max_lights:
            raise InputError(f"{station.name}: layer {layer} has {len(xy)} lights; wanted 4 to {config.max_lights}")
        spread = np.linalg.svd(xy - xy.mean(axis=0), compute_uv=False)
        if spread[1] < _MIN_SPREAD * spread[0]:
            raise InputError(f"{station.name}: the lights of layer {layer} lie in a line as seen from the front")
        if len(np.unique(np.round(xy, 3), axis=0)) < len(xy):
            raise InputError(f"{station.name}: two lights of layer {layer} stand one behind the other")


def _reason(detections: Detections, answers: list[LayerAnswer]) -> str:
    """The word for a frame without a pose: what the layer that came farthest said."""
    if not len(detections):
        return "no_lights"
    reasons = {answer.reason for answer in answers}
    return next(word for word in ("residual", "inconsistent", "too_few") if word in reasons)
