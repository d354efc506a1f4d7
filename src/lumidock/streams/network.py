"""Frames of RTSP and RTP streams; the stamp is the time of this machine when a frame was decoded."""

from __future__ import annotations

import io
from collections.abc import Iterator
from urllib.parse import urlsplit

import av
from av.error import FFmpegError

from lumidock.datatypes import Frame
from lumidock.errors import InputError
from lumidock.streams.live import now_ns
from lumidock.streams.sources import Item
from lumidock.streams.video import picture_of

_TIMEOUT_S = 5.0  # without a packet a stream is taken for lost
_LOW_DELAY = {"fflags": "nobuffer", "flags": "low_delay", "rtsp_transport": "tcp", "reorder_queue_size": "0"}
_SDP = """\
v=0
o=- 0 0 IN IP4 {host}
s=lumidock
c=IN IP4 {host}
t=0 0
m=video {port} RTP/AVP 96
a=rtpmap:96 H264/90000
"""


def without_password(address: str) -> str:
    """Host and path of an address, fit to be written down. Raises: InputError where it names no host."""
    try:
        parts = urlsplit(address)
    except ValueError:
        parts = urlsplit("")
    if not parts.hostname:
        raise InputError(
            f"{address.partition(':')[0]}: no host in the address; wanted rtsp://HOST/PATH, rtp://HOST:PORT"
        )
    return f"{parts.hostname}{parts.path}"


def frames_of(address: str, gray: bool) -> Iterator[Item]:
    """Frames of a stream as they arrive. Raises: InputError when it is not there, or when it is lost."""
    try:
        with _opened(address) as container:
            stream = container.streams.video[0]
            stream.thread_type = "SLICE"  # threads over frames would hold some back
            for number, frame in enumerate(container.decode(stream)):
                if isinstance(frame, av.VideoFrame) and not frame.is_corrupt:
                    yield Frame(f"{number:06d}", now_ns(), picture_of(frame, gray))
    except (FFmpegError, IndexError, ValueError) as error:
        why = " ".join(str(getattr(error, "strerror", None) or error).split())
        raise InputError(f"{without_password(address)}: {why}") from None


def _opened(address: str) -> av.container.InputContainer:
    parts = urlsplit(address)
    if parts.scheme == "rtp":
        sdp = io.BytesIO(_SDP.format(host=parts.hostname, port=parts.port or 5600).encode())
        options = _LOW_DELAY | {"protocol_whitelist": "rtp,udp"}
        return av.open(sdp, "r", format="sdp", options=options, timeout=_TIMEOUT_S)
    return av.open(address, "r", format="rtsp", options=_LOW_DELAY, timeout=_TIMEOUT_S)
