"""Fixes to an autopilot by MAVLink over UDP, as ArduPilot, ArduSub and Rover take them."""

from __future__ import annotations

import hashlib
import math
import socket
import time
from dataclasses import dataclass, field
from pathlib import Path

from pymavlink.dialects.v20 import common

from lumidock.datatypes import Detections, Fix, Frame, Unusable
from lumidock.errors import InputError
from lumidock.streams.mavlink_messages import Frames, estimate, guide_values, landing_target, status_text
from lumidock.streams.vehicle import Vehicle

_HEARTBEAT_S = 1.0
_TEXT_S = 2.0  # at least, between two lines for the operator; a state that flickers is told at this rate
_VALUES_S = 0.2  # at least, between two sets of named values, which are for plots
_SIGNING_EPOCH_S = 1_420_070_400  # 2015-01-01, from which signed messages count steps of 10 us
_MEASURED = ("acquired", "tracking")
_LEAST_KEY = 8  # characters of a passphrase


@dataclass(frozen=True, slots=True)
class Identity:
    """Who speaks: `system` is the autopilot's, `key` (32 bytes) signs all that is sent, where there is one."""

    system: int = 1
    component: int = common.MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY
    heading_rad: float = 0.0
    key: bytes | None = field(default=None, repr=False)


def signing_key(path: Path) -> bytes:
    """The key of a passphrase that is the first line of a file: its SHA-256, as ground stations make it.

    Raises: InputError, which does not show the passphrase.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeError) as error:
        raise InputError(f"{path}: {getattr(error, 'strerror', None) or 'not a text'}") from None
    passphrase = text.partition("\n")[0].rstrip("\r")
    if len(passphrase) < _LEAST_KEY:
        raise InputError(f"{path}: its first line is the passphrase, of at least {_LEAST_KEY} characters")
    return hashlib.sha256(passphrase.encode()).digest()


class ResetCounter:
    """Counts acquisitions after the first pose that was sent, also those whose first frames gave no valid pose.

    It outlives a link that is opened again, since the autopilot compares it with what it had before.
    """

    def __init__(self) -> None:
        self.value, self._sent, self._anew = 0, False, False

    def see(self, fix: Fix) -> None:
        """Take notice of a fix, whether or not it is sent."""
        self._anew = self._anew or fix.status == "acquired"

    def of_pose(self) -> int:
        """The counter that goes with a pose that is sent now."""
        if self._anew and self._sent:
            self.value = (self.value + 1) % 256
        self._sent, self._anew = True, False
        return self.value


class Mavlink:
    """Sends what was measured, not predicted: poses, bearing and range; a heartbeat each second; changes of state."""

    def __init__(
        self,
        host: str,
        port: int,
        vehicle: Vehicle,
        identity: Identity | None = None,
        resets: ResetCounter | None = None,
    ) -> None:
        """Send to the UDP port `port` of `host`. Raises: OSError when there is no such host."""
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        self._socket = socket.socket(family, kind, protocol)
        self._socket.setblocking(False)
        self._socket.connect(address)
        identity = identity or Identity()
        self._link = common.MAVLink(None, srcSystem=identity.system, srcComponent=identity.component)
        if identity.key is not None:
            self._link.signing.secret_key, self._link.signing.sign_outgoing = identity.key, True
        self._frames, self._resets = Frames.of(vehicle, identity.heading_rad), resets or ResetCounter()
        self._start_s, self._beat_s, self._values_s, self._text_s = time.monotonic(), -math.inf, -math.inf, -math.inf
        self._state, self._told = "", ""

    def skip(self, fix: Fix) -> None:
        """Take notice of a fix that is too old to be sent."""
        self._resets.see(fix)

    def add(self, item: Frame | Detections | Unusable, fix: Fix, latency_us: int | None) -> None:
        """Send one fix as far as it was measured in this frame. Raises: OSError when it cannot be sent."""
        del item, latency_us
        self._resets.see(fix)
        if fix.status in _MEASURED:
            if fix.T_dock_cam is not None:
                self._send(estimate(self._link, fix, self._frames, self._resets.of_pose()))
            if fix.guide is not None:
                self._send(landing_target(self._link, fix, fix.guide, self._frames))
                self._send_values(fix)
        self._state = _state_of(fix)
        self._send_state()

    def tick(self) -> None:
        """Send what is due: a heartbeat, a state that waited for its turn."""
        if time.monotonic() - self._beat_s >= _HEARTBEAT_S:
            self._beat_s = time.monotonic()
            kind, autopilot = common.MAV_TYPE_ONBOARD_CONTROLLER, common.MAV_AUTOPILOT_INVALID
            self._send(self._link.heartbeat_encode(kind, autopilot, 0, 0, common.MAV_STATE_ACTIVE))
        self._send_state()

    def close(self) -> None:
        """Give the socket back."""
        self._socket.close()

    def _send_values(self, fix: Fix) -> None:
        now = time.monotonic()
        if fix.guide is None or now - self._values_s < _VALUES_S:
            return
        self._values_s = now
        for message in guide_values(self._link, fix.guide, round((now - self._start_s) * 1000.0)):
            self._send(message)

    def _send_state(self) -> None:
        now = time.monotonic()
        if self._state == self._told or now - self._text_s < _TEXT_S:
            return
        self._text_s, self._told = now, self._state
        self._send(status_text(self._link, f"lumidock: {self._state}", warning=self._state.startswith("no fix")))

    def _send(self, message: common.MAVLink_message) -> None:
        if self._link.signing.sign_outgoing:
            steps = int((time.time() - _SIGNING_EPOCH_S) * 1e5)
            self._link.signing.timestamp = max(self._link.signing.timestamp, steps)
        content = message.pack(self._link)
        self._link.seq = (self._link.seq + 1) % 256
        try:
            self._socket.send(content)
        except ConnectionRefusedError:  # nobody listens yet; the kernel tells it of the datagram before
            pass
        except BlockingIOError:
            pass


def _state_of(fix: Fix) -> str:
    """What there is to use, and why not more, in few words."""
    reason = fix.reason.replace("_", " ")
    if fix.T_dock_cam is not None:
        return f"pose, {fix.stage}"
    if fix.guide is not None:
        return f"bearing and range only: {reason}"
    return f"no fix: {reason}"
