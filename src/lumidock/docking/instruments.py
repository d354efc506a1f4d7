"""The vehicle's own instruments, with errors: gyro, DVL with its inertial unit, compass and tilt, acoustic homing."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lumidock.datatypes import AidingMeasurement, Array
from lumidock.docking.vehicle import R_BODY_CAM_AHEAD, Motion, Three, VehicleModel
from lumidock.geometry import so3_log

DVL_SCALE, DVL_BIAS_M_S, _DVL_NOISE_M_S = 0.01, 0.003, 0.01  # 1 sigma. Source: Water Linked A50, data sheet
_GYRO_BIAS_RAD_S, _GYRO_NOISE_RAD_S = math.radians(0.05), math.radians(0.1)  # industrial MEMS, bias in run
HEADING_SIGMA_RAD, TILT_SIGMA_RAD = math.radians(2.0), math.radians(0.3)  # compass beside steel; inclinometers
HOMING_SIGMA_M = 1.0  # of each axis at 20 m: ultra-short baseline of 3 degrees


@dataclass(frozen=True, slots=True)
class Reading:
    """One reading: velocity over ground in body m/s, yaw rate rad/s, heading, pitch and roll rad."""

    over_ground: Three
    yaw_rate: float
    heading_rad: float
    pitch_rad: float
    roll_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class Instruments:
    """The constant errors of one docking, and the draws of the others."""

    scale: float
    bias: Three
    gyro_bias: float
    heading_bias: float
    tilt_bias: tuple[float, float]
    homing: Three
    rng: np.random.Generator

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Instruments:
        """The instruments of one docking."""
        bx, by, bz, hx, hy, hz, scale, gyro, heading, pitch, roll = (float(value) for value in rng.normal(size=11))
        return cls(
            scale=1.0 + DVL_SCALE * scale,
            bias=(DVL_BIAS_M_S * bx, DVL_BIAS_M_S * by, DVL_BIAS_M_S * bz),
            gyro_bias=_GYRO_BIAS_RAD_S * gyro,
            heading_bias=HEADING_SIGMA_RAD * heading,
            tilt_bias=(TILT_SIGMA_RAD * pitch, TILT_SIGMA_RAD * roll),
            homing=(HOMING_SIGMA_M * hx, HOMING_SIGMA_M * hy, HOMING_SIGMA_M * hz),
            rng=rng,
        )

    def read(self, motion: Motion, pitch_roll: tuple[float, float]) -> Reading:
        """The reading at one time."""
        noise = self.rng.normal(size=4)
        u, v, w = (
            self.scale * true + bias + _DVL_NOISE_M_S * float(n)
            for true, bias, n in zip(motion.over_ground[:3], self.bias, noise[:3], strict=True)
        )
        return Reading(
            over_ground=(u, v, w),
            yaw_rate=motion.over_ground[3] + self.gyro_bias + _GYRO_NOISE_RAD_S * float(noise[3]),
            heading_rad=motion.heading_rad + self.heading_bias,
            pitch_rad=pitch_roll[0] + self.tilt_bias[0],
            roll_rad=pitch_roll[1] + self.tilt_bias[1],
        )

    def aiding(self, T_dock_cam: Array, T_dock_later: Array, t_ns: int, dt_s: float) -> tuple[AidingMeasurement, ...]:
        """Rotation rate and velocity in cam axes over the `dt_s` that end at `t_ns`, as the method takes them.

        The poses are those of cam at its begin and at its end; biases and scale are those of `read`.
        """
        noise = self.rng.normal(size=(2, 3))
        R_cam_body, R_dock_cam = R_BODY_CAM_AHEAD.T, T_dock_cam[:3, :3]
        rate = so3_log(R_dock_cam.T @ T_dock_later[:3, :3]) / dt_s
        rate += R_cam_body @ np.array([0.0, 0.0, self.gyro_bias]) + _GYRO_NOISE_RAD_S * noise[0]
        velocity = R_dock_cam.T @ (T_dock_later[:3, 3] - T_dock_cam[:3, 3]) / dt_s
        velocity = self.scale * velocity + R_cam_body @ np.array(self.bias) + _DVL_NOISE_M_S * noise[1]
        middle_ns = t_ns - round(0.5e9 * dt_s)
        return (
            AidingMeasurement("gyro", middle_ns, tuple(rate.tolist()), _GYRO_NOISE_RAD_S),
            AidingMeasurement("velocity", middle_ns, tuple(velocity.tolist()), _DVL_NOISE_M_S),
        )

    def homed(self, model: VehicleModel, motion: Motion) -> Three:
        """Position of the camera in `approach` by the acoustic homing that brought the vehicle here."""
        x, y, z = (true + error for true, error in zip(motion.position, self.homing, strict=True))
        return x + model.half_m[0], y, z
