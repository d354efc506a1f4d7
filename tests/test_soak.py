"""Ten minutes of a 15 Hz camera, beside a client that does not read and a full disk; LUMIDOCK_SOAK_S shortens it."""

import base64
import json
import os
import re
import socket
import struct
import subprocess
import time
import urllib.request
from contextlib import suppress
from pathlib import Path

import pytest
from commandline import LUMIDOCK, VEHICLE, free_port, serve, wait_for

SECONDS = float(os.environ.get("LUMIDOCK_SOAK_S", "600"))
SIM = ("path.frame_interval_s=0.0667", "path.start_z_m=9", "path.end_z_m=4")


def blocked_client(port):
    """A client of Foxglove that subscribes to every channel and then reads nothing more."""
    wait_for(lambda: socket.socket().connect_ex(("127.0.0.1", port)) == 0)
    client = socket.create_connection(("127.0.0.1", port), timeout=10)
    client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    key = base64.b64encode(os.urandom(16)).decode()
    client.sendall(
        f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n"
        "Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n".encode()
    )
    told = b""
    client.settimeout(2.0)
    with suppress(TimeoutError):
        while True:
            told += client.recv(65536)
    numbers = sorted({int(number) for number in re.findall(rb'"id":\s*(\d+)', told)})
    content = json.dumps(
        {"op": "subscribe", "subscriptions": [{"id": i, "channelId": number} for i, number in enumerate(numbers)]}
    ).encode()
    head = struct.pack(">BBH", 0x81, 0x80 | 126, len(content)) + bytes(4)  # masked with zeros
    client.sendall(head + content)
    return client


def memory_mib(pid):
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


@pytest.mark.slow
def test_ten_minutes_without_growth_or_delay(tmp_path, listener):
    sim = [word for setting in SIM for word in ("--set", setting)]
    made = subprocess.run([LUMIDOCK, "sim", "approach", *sim, "--out", str(tmp_path / "seq")], capture_output=True)
    assert made.returncode == 0, made.stderr
    (tmp_path / "vehicle.yaml").write_text(VEHICLE)
    (tmp_path / "full.mcap").symlink_to("/dev/full")
    port = free_port()
    served = serve(
        *(
            tmp_path / "seq",
            "--loop",
            "--vehicle",
            tmp_path / "vehicle.yaml",
            "--mavlink",
            f"127.0.0.1:{listener.port}",
        ),
        *(
            "--foxglove",
            "--foxglove-port",
            port,
            "--record",
            tmp_path / "full.mcap",
            "--out",
            tmp_path / "live",
            "--force",
        ),
    )
    try:
        client = blocked_client(port)
        samples, worst = [], 0.0
        begin = time.monotonic()
        while time.monotonic() - begin < SECONDS:
            time.sleep(5.0)
            health = json.loads(urllib.request.urlopen(served.url + "health.json", timeout=10).read())
            listener.read()
            samples.append(memory_mib(served.pid))
            worst = max(worst, health["sinks"]["mavlink"].get("frame_to_sent_ms", {}).get("p99", 0.0))
        memory = f"memory {samples[0]:.0f} .. {samples[-1]:.0f} MiB, worst p99 {worst:.1f} ms"
        print(json.dumps(health, indent=1), memory)  # noqa: T201  # the figures, with -s
        client.close()
    finally:
        served.terminate()
        served.communicate(timeout=30)
    assert served.returncode == 0
    settled = samples[len(samples) // 4]
    assert max(samples[-3:]) < 1.05 * settled + 20.0
    assert health["sinks"]["mavlink"]["sent"] > 0.5 * health["fixes"]["valid"]
    assert health["sinks"]["full.mcap"]["errors"] > 0
    assert worst <= 20.0
