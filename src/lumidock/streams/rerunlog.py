"""Fixes into Rerun: a .rrd file, or a viewer that is open."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rerun as rr

from lumidock.camera import Camera
from lumidock.datatypes import Detections, Fix, Frame, Unusable
from lumidock.station import Station
from lumidock.streams.colors import of_layer, rgb
from lumidock.streams.jpeg import jpeg_of

_FIRST_EPOCH_NS = 10**18  # stamps from 2001 on are dates, smaller ones count from the start of something


class RerunLog:
    """Logs dock, camera, pictures, detections and the numbers of every fix on the timeline `time`."""

    def __init__(self, target: str, station: Station, camera: Camera) -> None:
        """Log to the file `target`, or to the viewer at `target` where that is rerun+http://HOST:PORT/proxy."""
        self._stream = rr.RecordingStream("lumidock")
        if target.startswith("rerun+http"):
            self._stream.connect_grpc(target)
        else:
            self._stream.save(Path(target))
        self._station = station
        colors = [rgb(of_layer(station, light)) for light in range(len(station))]
        self._stream.log("dock", rr.ViewCoordinates.RIGHT_HAND_Y_UP, static=True)
        lights = rr.Points3D(station.p_dock, colors=colors, labels=list(station.ids), radii=0.05)
        self._stream.log("dock/lights", lights, static=True)
        lens = rr.Pinhole(
            image_from_camera=camera.K, resolution=[camera.width, camera.height], camera_xyz=rr.ViewCoordinates.RDF
        )
        self._stream.log("dock/camera/image", lens, static=True)

    def add(self, item: Frame | Detections | Unusable, fix: Fix, latency_us: int | None) -> None:
        """Log one frame."""
        if item.t_ns is None:
            return
        if item.t_ns > _FIRST_EPOCH_NS:
            self._stream.set_time("time", timestamp=np.datetime64(item.t_ns, "ns"))
        else:
            self._stream.set_time("elapsed", duration=np.timedelta64(item.t_ns, "ns"))
        if isinstance(item, Frame):
            picture = rr.EncodedImage(contents=jpeg_of(item), media_type="image/jpeg")
            self._stream.log("dock/camera/image", picture)
        self._log_detections(fix)
        self._log_pose(fix)
        self._log_numbers(fix, latency_us)

    def close(self) -> None:
        """Write what is still in memory and close the file."""
        self._stream.flush()
        self._stream.disconnect()

    def _log_detections(self, fix: Fix) -> None:
        detections = fix.match
        if detections is None:
            self._stream.log("dock/camera/image/lights", rr.Clear(recursive=False))
            return
        named = [int(light) for light in detections.light]
        colors = [rgb(of_layer(self._station, int(light))) for light in named]
        labels = ["" if i < 0 else self._station.ids[i] for i in named]
        points = rr.Points2D(detections.detections.uv + 0.5, colors=colors, labels=labels, radii=4.0)
        self._stream.log("dock/camera/image/lights", points)

    def _log_pose(self, fix: Fix) -> None:
        if fix.T_dock_cam is None:
            return
        transform = rr.Transform3D(translation=fix.T_dock_cam[:3, 3], mat3x3=fix.T_dock_cam[:3, :3])
        self._stream.log("dock/camera", transform)
        self._stream.log("dock/track", rr.Points3D([fix.T_dock_cam[:3, 3]], radii=0.02))

    def _log_numbers(self, fix: Fix, latency_us: int | None) -> None:
        numbers: dict[str, float] = {"valid": float(fix.valid), "guide": float(fix.guide is not None)}
        if fix.protection is not None:
            numbers |= {"pl_lateral_m": fix.protection.lateral_m, "pl_axial_m": fix.protection.axial_m}
        if latency_us is not None:
            numbers["latency_ms"] = latency_us / 1000.0
        for name, value in numbers.items():
            self._stream.log(f"plots/{name}", rr.Scalars(value))
        if fix.reason:
            self._stream.log("log", rr.TextLog(fix.reason))
