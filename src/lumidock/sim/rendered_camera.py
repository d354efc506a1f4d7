"""The camera of a closed loop, rendered: the pictures that a vehicle which steers itself takes, one after the other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lumidock.camera import Camera
from lumidock.datatypes import Array, Frame
from lumidock.errors import InputError
from lumidock.sim.draws import Draw
from lumidock.sim.frames import FrameConditions, FrameRenderer
from lumidock.sim.lens import Lens
from lumidock.sim.point_camera import PointCamera, one_frame
from lumidock.sim.water import green_index


def scaled(camera: Camera, share: float) -> Camera:
    """The same lens before a sensor with pixels `1 / share` times as large."""
    K = camera.K.copy()
    K[:2] *= share
    K[:2, 2] += 0.5 * (share - 1.0)  # pixel (0, 0) is the centre of the top-left pixel
    return replace(camera, width=round(camera.width * share), height=round(camera.height * share), K=K)


class RenderedCamera:
    """Renders what the point camera `eye` would detect; its draws of dead, missing and spurious lights are the same."""

    def __init__(self, eye: PointCamera, seed: int) -> None:
        """Raises: InputError for an exposure that depends on the frames before."""
        scenario = eye.scenario
        if scenario.sensor.auto_exposure is not None:
            raise InputError(f"{scenario.name}: a closed loop is rendered at a fixed exposure")
        focal, center = float(eye.drawn.focal[0]) - scenario.lens.focal_error, eye.drawn.center_px[0]
        lens = Lens.of(scenario.lens, eye.camera, green_index(scenario.water), focal, center)
        self._eye, self._draws = eye, (seed, 0)
        self._renderer = FrameRenderer(scenario, eye.station, lens, self._draws)
        fouling = np.random.default_rng([seed, Draw.FOULING])
        self._transmission = fouling.uniform(*scenario.lamps.fouling, len(eye.station))
        self._noise = np.random.default_rng([seed, Draw.SENSOR_NOISE])

    def see(self, number: int, T_dock_cam: Array) -> Frame:
        """The picture of frame `number`, taken from the true pose `T_dock_cam` (4, 4), without motion blur."""
        eye, scenario = self._eye, self._eye.scenario
        one = one_frame(eye.course, number, T_dock_cam)
        uv, visible = eye.project(one)
        conditions = FrameConditions(
            t_s=float(eye.course.t_ns[number]) * 1e-9,
            exposure_s=scenario.sensor.exposure_ms * 1e-3,
            T_dock_cam=T_dock_cam,
            T_cam_later=np.eye(4),
            p_dock=eye.drawn.p_dock[0],
            transmission=self._transmission,
            dark=np.flatnonzero(eye.dark(number, visible)),
            spurious=eye.spurious(number, one, uv[visible]),
            surface=scenario.around.surface,
            draws=self._draws,
        )
        picture = self._renderer.picture_of(self._renderer.expect(conditions), self._noise)
        return Frame(f"{number:06d}", int(eye.course.t_ns[number]), picture)
