"""The go / no-go by MAVLink over UDP: NAMED_VALUE_INT `go_no_go`, and STATUSTEXT at changes.

`go_no_go` is 2 for go, 1 for hold, 0 for abort; the text says the word too. A state that lasts is repeated each second,
so that a receiver can tell silence from go. Source: mavlink.io, common.xml.
"""

from __future__ import annotations

import math
import socket
import time
from contextlib import suppress

from pymavlink.dialects.v20 import common

from lumidock.datatypes import Detections, Fix, Frame, Unusable
from lumidock.go_no_go import Advice, Verdict, Watch

VALUES: dict[Verdict, int] = {"go": 2, "hold": 1, "abort": 0}
_SEVERITY = {"go": common.MAV_SEVERITY_INFO, "hold": common.MAV_SEVERITY_WARNING, "abort": common.MAV_SEVERITY_CRITICAL}
_REPEAT_S = 1.0


class GoNoGoLink:
    """Sends the advice with every fix, and while none comes once a second, when it may have grown old."""

    def __init__(self, host: str, port: int, watch: Watch, system: int = 1) -> None:
        """Send to the UDP port `port` of `host`. Raises: OSError when there is no such host."""
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        self._socket = socket.socket(family, kind, protocol)
        self._socket.setblocking(False)
        self._socket.connect(address)
        component = common.MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY
        self._link = common.MAVLink(None, srcSystem=system, srcComponent=component)
        self._watch, self._told = watch, Advice("go", "")
        self._start_s, self._sent_s, self._arrived_s = time.monotonic(), -math.inf, -math.inf

    def add(self, item: Frame | Detections | Unusable, fix: Fix, latency_us: int | None) -> None:
        """Send what a new fix leads to. Raises: OSError when it cannot be sent."""
        del item, latency_us
        self._watch, self._arrived_s = self._watch.after(fix), time.monotonic()
        self._send_advice()

    def tick(self) -> None:
        """Repeat the advice, as it is by now, when nothing was sent for a second."""
        if time.monotonic() - self._sent_s >= _REPEAT_S:
            self._send_advice()

    def close(self) -> None:
        """Give the socket back."""
        self._socket.close()

    def _send_advice(self) -> None:
        now_s = time.monotonic()
        last = self._watch.fix
        t_ns = 0 if last is None else last.t_ns + round((now_s - self._arrived_s) * 1e9)
        advice, boot_ms = self._watch.advise(t_ns), round((now_s - self._start_s) * 1e3)
        self._send(self._link.named_value_int_encode(boot_ms, b"go_no_go", VALUES[advice.verdict]))
        if advice != self._told:
            text = f"dock: {advice.verdict} ({advice.word})"
            self._send(self._link.statustext_encode(_SEVERITY[advice.verdict], text.encode()))
        self._told, self._sent_s = advice, now_s

    def _send(self, message: common.MAVLink_message) -> None:
        with suppress(ConnectionRefusedError, BlockingIOError):  # nobody listens yet, or the buffer is full
            self._socket.send(message.pack(self._link))
