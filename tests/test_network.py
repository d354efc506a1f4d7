"""Frames by real RTP over loopback, sent in bursts by PyAV."""

import socket
import threading
import time
from fractions import Fraction
from itertools import islice
from pathlib import Path
from tempfile import gettempdir

import av
import numpy as np
import pytest

from lumidock.errors import InputError
from lumidock.streams.live import open_live

RATE, COUNT, WANTED = 30, 120, 60


def free_port():
    """An even UDP port with a free one behind it, for RTP and RTCP."""
    while True:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as first:
            first.bind(("127.0.0.1", 0))
            port = first.getsockname()[1]
        if port % 2 == 0:
            return port


def send(port, burst, stop):
    """Frames of 30 Hz with true RTP times, of which `burst` are held back and leave together."""
    with av.open(f"rtp://127.0.0.1:{port}", "w", format="rtp") as container:
        stream = container.add_stream("libx264", rate=RATE, options={"tune": "zerolatency", "g": "10"})
        stream.width, stream.height, stream.pix_fmt = 160, 120, "yuv420p"
        stream.codec_context.time_base = Fraction(1, 90000)
        start, held = time.monotonic(), []
        for i in range(10 * COUNT):
            if stop.wait(max(0.0, start + i / RATE - time.monotonic())):
                return
            frame = av.VideoFrame.from_ndarray(np.full((120, 160, 3), i % 200, np.uint8), "bgr24")
            frame.pts, frame.time_base = i * 90000 // RATE, Fraction(1, 90000)
            held += stream.encode(frame)
            if i % burst == 0:
                for packet in held:
                    container.mux(packet)
                held = []


def test_rtp_and_rtcp_are_listened_for_on_the_address_that_was_given_alone():
    port, before = free_port(), set(Path(gettempdir()).glob("lumidock-*"))
    reader = threading.Thread(target=take_nothing, args=(port,), daemon=True)
    reader.start()
    places = set()
    while len(places) < 2:
        lines = [line.split()[1] for line in Path("/proc/net/udp").read_text().splitlines()[1:]]
        places = {place for place in lines if int(place.rpartition(":")[2], 16) in (port, port + 1)}
        time.sleep(0.01)
    assert {place.partition(":")[0] for place in places} == {"0100007F"}
    reader.join()
    assert set(Path(gettempdir()).glob("lumidock-*")) <= before


def take_nothing(port):
    with pytest.raises(InputError):
        next(open_live(f"rtp://127.0.0.1:{port}").items())


@pytest.mark.parametrize("burst", [1, 12])
def test_bursts_of_arrival_cost_nothing(burst):
    port, stop = free_port(), threading.Event()
    sender = threading.Thread(target=send, args=(port, burst, stop), daemon=True)
    items = open_live(f"rtp://127.0.0.1:{port}").items()
    sender.start()
    try:
        seen = [(item.t_ns, time.time_ns()) for item in islice(items, WANTED)]
    finally:
        stop.set()
        sender.join()
    stamps = np.array([stamp for stamp, _ in seen])
    steps = np.diff(stamps) * 1e-9
    assert np.abs(steps - np.round(steps * RATE) / RATE).max() < 0.02 / RATE  # as they were taken, whole frames apart
    assert np.median(steps) == pytest.approx(1 / RATE, rel=0.02)
    assert abs(seen[-1][1] - seen[-1][0]) < 10**9
