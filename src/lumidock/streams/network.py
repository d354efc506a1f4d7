"""Frames of RTSP and RTP streams, stamped by the time that the camera gives them (RTP and RTCP, RFC 3550)."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from ipaddress import ip_address
from pathlib import Path
from tempfile import TemporaryDirectory

import av
from av.error import FFmpegError

from lumidock.datatypes import Frame, Unusable
from lumidock.errors import FrameError, InputError
from lumidock.streams.address import Address
from lumidock.streams.clock import StreamClock, now_ns
from lumidock.streams.images import require_size
from lumidock.streams.source import Item, Size
from lumidock.streams.video import picture_of, stamp_of

_TIMEOUT_S = 5.0  # without a packet a stream is taken for lost
_LOW_DELAY = {"fflags": "nobuffer", "flags": "low_delay", "rtsp_transport": "tcp", "reorder_queue_size": "0"}
_DEFAULT_PORT = 5600  # that ArduSub and QGroundControl send video to
_WALL = struct.Struct("=qi")  # AVProducerReferenceTime: microseconds since the epoch, flags
_MOST_WAITING = 64  # packets whose arrival is remembered until they are decoded
_SDP = """\
v=0
o=- 0 0 IN IP4 {host}
s=lumidock
c=IN IP4 {host}
t=0 0
m=video {port} RTP/AVP 96
a=rtpmap:96 H264/90000
"""


def frames_of(address: Address, gray: bool, size: Size | None) -> Iterator[Item]:
    """Frames of a stream as they arrive. Raises: InputError when it is not there, or when it is lost."""
    try:
        with _opened(address) as container:
            stream = container.streams.video[0]
            stream.thread_type = "SLICE"  # threads over frames would hold some back
            number, clock, arrivals = 0, StreamClock(), dict[int | None, tuple[int, int | None]]()
            for packet in container.demux(stream):
                arrivals[packet.pts] = now_ns(), _wall_ns(packet)
                for frame in packet.decode():
                    if isinstance(frame, av.VideoFrame) and not frame.is_corrupt:
                        t_ns = _stamp(frame, clock, arrivals)
                        yield _item(f"{number:06d}", t_ns, frame, gray, size)
                    number += 1
                while len(arrivals) > _MOST_WAITING:
                    del arrivals[next(iter(arrivals))]
    except (FFmpegError, IndexError, ValueError) as error:
        why = " ".join(str(getattr(error, "strerror", None) or error).split())
        raise InputError(f"{address.shown}: {why}") from None


def _item(name: str, t_ns: int, frame: av.VideoFrame, gray: bool, size: Size | None) -> Item:
    try:
        require_size((frame.width, frame.height), size, f"frame {name}")
    except FrameError as error:
        return Unusable(name, t_ns, error.reason, str(error))
    return Frame(name, t_ns, picture_of(frame, gray))


def _stamp(frame: av.VideoFrame, clock: StreamClock, arrivals: dict[int | None, tuple[int, int | None]]) -> int:
    """The frame's time in this machine's; where the stream gives it none, when it came."""
    camera_ns, (arrival_ns, wall_ns) = stamp_of(frame), arrivals.pop(frame.pts, (now_ns(), None))
    return arrival_ns if camera_ns is None else clock.stamp(camera_ns, arrival_ns, wall_ns)


def _wall_ns(packet: av.Packet[av.VideoStream]) -> int | None:
    """The camera's wall clock at this packet, as its last RTCP sender report says, where there was one."""
    if not packet.has_sidedata("prft"):
        return None
    data = bytes(packet.get_sidedata("prft"))
    return int(_WALL.unpack_from(data)[0]) * 1000 if len(data) >= _WALL.size else None


def _opened(address: Address) -> av.container.InputContainer:
    if address.scheme == "rtp":
        return _listening(address)
    return av.open(address.url, "r", format="rtsp", options=_LOW_DELAY, timeout=_TIMEOUT_S)


def _listening(address: Address) -> av.container.InputContainer:
    """Ports for RTP and RTCP on the address that was given: what senders have to reach, and nobody else.

    FFmpeg listens for RTCP on every interface unless the name of the description ends in a local address.
    """
    options = _LOW_DELAY | {"protocol_whitelist": "file,rtp,udp"}
    where = "" if _is_multicast(address.host) else f"?localaddr={address.host}"
    with TemporaryDirectory(prefix="lumidock-") as folder:
        description = Path(folder) / f"stream.sdp{where}"
        description.write_text(_SDP.format(host=address.host, port=address.port or _DEFAULT_PORT))
        return av.open(str(description), "r", format="sdp", options=options, timeout=_TIMEOUT_S)


def _is_multicast(host: str) -> bool:
    try:
        return ip_address(host.strip("[]")).is_multicast
    except ValueError:
        return False
