"""What ROS 2 is shown of a frame: its camera, its picture and what was found in it."""

from __future__ import annotations

from typing import Any

import numpy as np

from lumidock.camera import Camera
from lumidock.datatypes import Detections, Fix, Frame
from lumidock.streams.jpeg import jpeg_of
from lumidock.streams.rostypes import header, make, time_of

_IDENTIFIED, _SPURIOUS, _CLEAR = (0.3, 1.0, 0.4, 1.0), (1.0, 0.25, 0.25, 1.0), (0.0, 0.0, 0.0, 0.0)


def camera_info(camera: Camera, t_ns: int, frame_id: str) -> Any:  # noqa: ANN401  # classes made at run time
    """A sensor_msgs/CameraInfo."""
    P = np.hstack([camera.K, np.zeros((3, 1))]).reshape(12)
    roi = make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
    matrices = {"d": np.asarray(camera.distortion, float), "k": camera.K.reshape(9), "r": np.eye(3).reshape(9), "p": P}
    return make(
        "sensor_msgs/msg/CameraInfo",
        header=header(t_ns, frame_id),
        height=camera.height,
        width=camera.width,
        distortion_model=camera.model,
        binning_x=0,
        binning_y=0,
        roi=roi,
        **matrices,
    )


def compressed(frame: Frame, t_ns: int, frame_id: str) -> Any:  # noqa: ANN401
    """A sensor_msgs/CompressedImage: the frame as JPEG."""
    data = np.frombuffer(jpeg_of(frame), np.uint8)
    return make("sensor_msgs/msg/CompressedImage", header(t_ns, frame_id), "jpeg", data)


def rings(fix: Fix, t_ns: int, light_ids: tuple[str, ...]) -> Any:  # noqa: ANN401
    """A ring around each detection, and the name of its light. Foxglove counts pixels from the corner of the first."""
    circles, texts, time = [], [], time_of(t_ns)
    green, red, clear = (make("foxglove_msgs/msg/Color", *rgba) for rgba in (_IDENTIFIED, _SPURIOUS, _CLEAR))
    detections = fix.match.detections if fix.match else Detections.from_uv(fix.frame, t_ns, np.empty((0, 2)))
    light_of = fix.match.light if fix.match else np.empty(0, np.int64)
    for (u, v), radius, light in zip(detections.uv + 0.5, detections.radius_px, light_of, strict=True):
        diameter = 2.0 * max(8.0, 1.6 * float(np.nan_to_num(radius)) + 4.0)
        color = green if light >= 0 else red
        at = make("foxglove_msgs/msg/Point2", float(u), float(v))
        ring = (time, at, diameter, 2.0, clear, color)
        circles.append(make("foxglove_msgs/msg/CircleAnnotation", *ring))
        if light >= 0:
            beside = make("foxglove_msgs/msg/Point2", float(u) + diameter / 2.0 + 2.0, float(v))
            words = (time, beside, light_ids[light], 16.0, color, clear)
            texts.append(make("foxglove_msgs/msg/TextAnnotation", *words))
    return make("foxglove_msgs/msg/ImageAnnotations", circles, [], texts)
