"""An autopilot's sensors by MAVLink over UDP: rates and tilt of ATTITUDE or SCALED_IMU, velocity of a DVL.

Values are in the aerospace axes of the vehicle: x forward, y right, z down. A DVL that is read for ArduSub sends
VISION_POSITION_DELTA, how far the vehicle has moved since the message before. Source: mavlink.io, common.xml and
ardupilotmega.xml.
"""

from __future__ import annotations

import math
import socket
from collections.abc import Iterator

from pymavlink.dialects.v20 import ardupilotmega as dialect

from lumidock.datatypes import AidingMeasurement, SensorKind
from lumidock.streams.clock import StreamClock, now_ns

_DATAGRAM, _MOST = 4096, 1000  # bytes; datagrams that are read for one frame
_RATE_RAD_S, _TILT_RAD, _VELOCITY_M_S = 0.002, 0.02, 0.02  # 1 sigma of noise: MEMS gyro, tilt under way, DVL of 1 MHz
_LONGEST_S = 1.0  # of a delta of position, for a velocity to be of now
Value = tuple[SensorKind, tuple[float, ...], float]


class MavlinkSensors:
    """Hands out what has come to a UDP port. Times of a sender are put into this machine's as they arrive."""

    def __init__(self, host: str, port: int) -> None:
        """Listen at `port` of the address `host`. Raises: OSError where that cannot be."""
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        self._socket = socket.socket(family, kind, protocol)
        self._socket.bind(address)
        self._socket.setblocking(False)
        self._link = dialect.MAVLink(None)
        self._link.robust_parsing = True  # what is damaged is skipped
        self._clocks: dict[str, StreamClock] = {}
        self._has_attitude = False

    @property
    def port(self) -> int:
        """Where it listens."""
        return int(self._socket.getsockname()[1])

    def until(self, t_ns: int | None) -> Iterator[AidingMeasurement]:
        """All values that have come; those that are later than a frame wait in the localizer."""
        del t_ns
        for _ in range(_MOST):
            try:
                content = self._socket.recv(_DATAGRAM)
            except (BlockingIOError, ConnectionRefusedError):
                return
            for message in self._link.parse_buffer(content) or ():
                yield from self._values(message)

    def close(self) -> None:
        """Give the socket back."""
        self._socket.close()

    def _values(self, message: dialect.MAVLink_message) -> Iterator[AidingMeasurement]:
        kind = message.get_type()
        if kind == "VISION_POSITION_DELTA":
            yield from self._stamped(kind, message.time_usec * 1000 - message.time_delta_usec * 500, _of_delta(message))
        elif kind == "ATTITUDE":
            self._has_attitude = True
            yield from self._stamped(kind, message.time_boot_ms * 1_000_000, _of_attitude(message))
        elif kind == "SCALED_IMU" and not self._has_attitude:  # its rates are those of ATTITUDE, bias included
            yield from self._stamped(kind, message.time_boot_ms * 1_000_000, _of_imu(message))

    def _stamped(self, name: str, sender_ns: int, values: list[Value]) -> Iterator[AidingMeasurement]:
        if not all(math.isfinite(number) for _, value, _ in values for number in value):
            return
        t_ns = self._clocks.setdefault(name, StreamClock()).stamp(sender_ns, now_ns())
        for kind, value, sigma in values:
            yield AidingMeasurement(kind, t_ns, value, sigma)


def _of_attitude(message: dialect.MAVLink_message) -> list[Value]:
    """Rates, and the direction upward by roll and pitch of the vehicle against north, east, down."""
    rates = float(message.rollspeed), float(message.pitchspeed), float(message.yawspeed)
    roll, pitch = float(message.roll), float(message.pitch)
    upward = math.sin(pitch), -math.sin(roll) * math.cos(pitch), -math.cos(roll) * math.cos(pitch)
    return [("gyro", rates, _RATE_RAD_S), ("tilt", upward, _TILT_RAD)]


def _of_imu(message: dialect.MAVLink_message) -> list[Value]:
    rates = message.xgyro * 1e-3, message.ygyro * 1e-3, message.zgyro * 1e-3
    return [("gyro", rates, _RATE_RAD_S)]


def _of_delta(message: dialect.MAVLink_message) -> list[Value]:
    """The mean velocity; none where the sender has no confidence, or the time is none."""
    dt_s = message.time_delta_usec * 1e-6
    if not 0.0 < dt_s <= _LONGEST_S or not message.confidence > 0.0:
        return []
    x, y, z = (float(moved) / dt_s for moved in message.position_delta)
    return [("velocity", (x, y, z), _VELOCITY_M_S)]
