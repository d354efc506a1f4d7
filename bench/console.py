"""What the console costs guidance: the time from a frame to its MAVLink message with three pages open and with none.

Two servers take turns over the same recording, one without a page and one that two pages draw from and one has stalled
at. Each turn gives the 99 % point over its frames; the table gives the median turn of each and their ratio.
"""

from __future__ import annotations

import json
import socket
import struct
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from bench.console_pictures import address_of

_SETTINGS = ("path.start_z_m=9", "path.end_z_m=6", "path.frame_interval_s=0.1")
_ROUNDS, _TURN_S = 3, 30.0
_BINARY, _PING, _PONG = 2, 9, 10  # kinds of frames, RFC 6455
_VEHICLE = "schema: 1\nT_body_cam: {translation: [0.8, 0, 0.1], quat_xyzw: [-0.5, 0.5, -0.5, 0.5]}\n"
_MASK = b"\x80\0\0\0\0"  # of a client's frame, whose length is added to the first byte


def open_socket(port: int) -> socket.socket:
    """A live socket of the console on this machine."""
    page = socket.create_connection(("127.0.0.1", port))
    lines = ("GET /api/live HTTP/1.1", f"Host: 127.0.0.1:{port}", "Upgrade: websocket", "Connection: Upgrade")
    key = ("Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==", "Sec-WebSocket-Version: 13")
    page.sendall("\r\n".join((*lines, *key, "", "")).encode())
    answer = b""
    while not answer.endswith(b"\r\n\r\n"):
        answer += page.recv(1)
    return page


def ask(page: socket.socket, number: int) -> None:
    """Ask for the fix after `number`."""
    text = str(number).encode()
    page.sendall(b"\x81" + bytes([_MASK[0] + len(text)]) + _MASK[1:] + text)


def answer(page: socket.socket) -> int:
    """Read one message, and answer the server's pings as a browser does; the number of its fix."""
    kind, message = _read(page)
    while kind != _BINARY:
        if kind == _PING:
            page.sendall(bytes([0x80 | _PONG, _MASK[0] + len(message)]) + _MASK[1:] + message)
        kind, message = _read(page)
    (end,) = struct.unpack_from("<I", message)
    return int(json.loads(message[4 : 4 + end])["number"])


def _read(page: socket.socket) -> tuple[int, bytes]:
    """The kind of a frame and what is in it."""
    head = _exactly(page, 2)
    length = head[1]
    if length > 125:
        length = int.from_bytes(_exactly(page, 2 if length == 126 else 8), "big")
    return head[0] & 0x0F, _exactly(page, length)


def _exactly(page: socket.socket, count: int) -> bytes:
    data = b""
    while len(data) < count:
        part = page.recv(count - len(data))
        if not part:
            raise OSError("the console closed the socket")
        data += part
    return data


@contextmanager
def pages(port: int) -> Iterator[None]:
    """Two pages that draw and one that has stalled, in a process of their own."""
    viewer = subprocess.Popen([sys.executable, "-m", "bench.console", str(port)], stdin=subprocess.PIPE)
    try:
        yield
    finally:
        viewer.terminate()
        viewer.wait(10)


def look_on(port: int) -> None:
    """Be these three pages until ended, or until whoever started them is gone."""
    stalled = open_socket(port)
    for _ in range(50):
        ask(stalled, 0)

    def draw() -> None:
        page, number = open_socket(port), 0
        while True:
            ask(page, number)
            number = answer(page)

    for _ in range(2):
        threading.Thread(target=draw, daemon=True).start()
    sys.stdin.read()


def simulate(sequence: Path) -> None:
    """Three seconds of an approach, in pictures of five megapixels."""
    command = [sys.executable, "-m", "lumidock", "sim", "approach", "--out", str(sequence)]
    command += [word for setting in _SETTINGS for word in ("--set", setting)]
    subprocess.run(command, check=True, capture_output=True)


def turn(folder: Path, *, with_pages: bool) -> float:
    """The 99 % point in ms of one server over one turn."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sink:
        sink.bind(("127.0.0.1", 0))
        words = ("--vehicle", folder / "vehicle.yaml", "--mavlink", f"127.0.0.1:{sink.getsockname()[1]}")
        with address_of("serve", folder / "sequence", "--loop", "--health-port", 0, *words) as address:
            port = int(address.partition("#")[0].rstrip("/").rpartition(":")[2])
            if with_pages:
                with pages(port):
                    time.sleep(_TURN_S)
                    return delay_ms(port)
            time.sleep(_TURN_S)
            return delay_ms(port)


def delay_ms(port: int) -> float:
    """From a frame's arrival to the end of sending its MAVLink message, 99 % point."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/health.json") as found:
        return float(json.load(found)["sinks"]["mavlink"]["frame_to_sent_ms"]["p99"])


def main() -> tuple[dict[str, object], list[str]]:
    """Simulate, take turns, and compare."""
    delays: dict[bool, list[float]] = {False: [], True: []}
    with TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "vehicle.yaml").write_text(_VEHICLE)
        simulate(folder / "sequence")
        for number in range(2 * _ROUNDS):
            with_pages = number % 4 in (1, 2)  # none, three, three, none, ...: a drift of the machine hits both
            delays[with_pages].append(turn(folder, with_pages=with_pages))
    none, three = (float(np.median(delays[which])) for which in (False, True))
    lines = [
        "| Pages open | frame to MAVLink, 99 %, ms | ratio |",
        "|---|---|---|",
        f"| none | {none:.1f} | 1 |",
        f"| three, one of them stalled | {three:.1f} | {three / none:.2f} |",
    ]
    return {"none_ms": delays[False], "three_ms": delays[True]}, lines


if __name__ == "__main__":
    look_on(int(sys.argv[1]))
