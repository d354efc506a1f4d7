"""Messages of the vehicle's own sensors in bags: gyro, tilt, depth and velocity.

Imu and FluidPressure of sensor_msgs, TwistWithCovarianceStamped and TwistStamped of geometry_msgs, and the messages of
DVLs in marine_acoustic_msgs, uuv_sensor_ros_plugins_msgs and cola2_msgs. Values are in the axes of the message.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from lumidock.datatypes import AidingMeasurement, SensorKind
from lumidock.errors import DataError
from lumidock.geometry import rotation_from_quat_xyzw
from lumidock.streams.ros import COLA_DVL, DVL, UNREADABLE, UUV_DVL, Message, deserialized, stamp_ns_of

Value = tuple[SensorKind, tuple[float, ...], float]
_IMU, _PRESSURE = "sensor_msgs/msg/Imu", "sensor_msgs/msg/FluidPressure"
_TWIST, _PLAIN_TWIST = "geometry_msgs/msg/TwistWithCovarianceStamped", "geometry_msgs/msg/TwistStamped"
_PASCAL_PER_M, _SURFACE_PA = 1025.0 * 9.80665, 101325.0  # of sea water; in fresh water a depth is 2.5 % too small
_GRAVITY_M_S2, _AT_REST_M_S2 = 9.80665, 0.5  # by which specific force may differ from gravity and still tell upward
# 1 sigma of noise where a message says nothing of it: MEMS gyro, tilt under way, DVL of 1 MHz, pressure transducer
_RATE_RAD_S, _TILT_RAD, _VELOCITY_M_S, _DEPTH_M = 0.002, 0.02, 0.02, 0.02


def values_of(message: Message, *, by_log: bool) -> Iterator[AidingMeasurement]:
    """The values in a message, stamped when they were recorded if `by_log`; none where it is damaged or has none."""
    try:
        found = deserialized(message)
        t_ns = message.log_ns if by_log else stamp_ns_of(found.header.stamp)
        for kind, value, sigma in SENSORS[message.type](found):
            yield AidingMeasurement(kind, t_ns, value, sigma)
    except (*UNREADABLE, DataError):
        return


def _sigma(covariance: Any, least: float) -> float | None:  # noqa: ANN401  # an array of the message
    """1 sigma of noise by a covariance, row by row; `least` where all is zero: unknown; None where it says invalid."""
    n = math.isqrt(len(covariance))
    diagonal = np.asarray(covariance, float).reshape(n, n).diagonal()[:3]
    if diagonal[0] < 0.0 or not np.isfinite(diagonal).all():
        return None
    return max(math.sqrt(float(diagonal.mean())), 1e-6) if diagonal.any() else least


def _vector(found: Any) -> tuple[float, float, float]:  # noqa: ANN401
    return float(found.x), float(found.y), float(found.z)


def _of_imu(found: Any) -> Iterator[Value]:  # noqa: ANN401
    """Rates; and the direction upward, by the orientation where there is one, else by the specific force at rest."""
    rate = _sigma(found.angular_velocity_covariance, _RATE_RAD_S)
    if rate is not None:
        yield "gyro", _vector(found.angular_velocity), rate
    turned, force = _sigma(found.orientation_covariance, _TILT_RAD), _vector(found.linear_acceleration)
    quat_xyzw = np.array([getattr(found.orientation, name) for name in "xyzw"], float)
    if turned is not None and abs(float(np.linalg.norm(quat_xyzw)) - 1.0) < 1e-3:  # of unit length
        yield "tilt", tuple(rotation_from_quat_xyzw(quat_xyzw)[2].tolist()), turned
    elif abs(math.hypot(*force) - _GRAVITY_M_S2) < _AT_REST_M_S2:
        yield "tilt", force, _TILT_RAD


def _of_pressure(found: Any) -> Iterator[Value]:  # noqa: ANN401
    variance = float(found.variance)
    sigma = math.sqrt(variance) / _PASCAL_PER_M if variance > 0.0 else _DEPTH_M
    yield "depth", ((float(found.fluid_pressure) - _SURFACE_PA) / _PASCAL_PER_M,), sigma


def _of_twist(found: Any) -> Iterator[Value]:  # noqa: ANN401
    sigma = _sigma(found.twist.covariance, _VELOCITY_M_S)
    if sigma is not None:
        yield "velocity", _vector(found.twist.twist.linear), sigma


def _of_plain_twist(found: Any) -> Iterator[Value]:  # noqa: ANN401
    yield "velocity", _vector(found.twist.linear), _VELOCITY_M_S


def _of_dvl(found: Any) -> Iterator[Value]:  # noqa: ANN401
    """Velocity over ground; here a covariance of -1 is one that is not known."""
    bottom = 1
    if found.velocity_mode == bottom:
        yield "velocity", _vector(found.velocity), _sigma(found.velocity_covar, _VELOCITY_M_S) or _VELOCITY_M_S


def _of_beamed_dvl(found: Any) -> Iterator[Value]:  # noqa: ANN401
    sigma = _sigma(found.velocity_covariance, _VELOCITY_M_S)
    if sigma is not None:
        yield "velocity", _vector(found.velocity), sigma


SENSORS: dict[str, Callable[[Any], Iterator[Value]]] = {
    _IMU: _of_imu,
    _PRESSURE: _of_pressure,
    _TWIST: _of_twist,
    _PLAIN_TWIST: _of_plain_twist,
    DVL: _of_dvl,
    UUV_DVL: _of_beamed_dvl,
    COLA_DVL: _of_beamed_dvl,
}
