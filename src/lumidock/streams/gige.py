"""GigE Vision cameras by Aravis, which the system packages: python3-gi and gir1.2-aravis-0.8 of Debian and Ubuntu."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from lumidock.datatypes import Frame, Unusable
from lumidock.errors import FrameError, InputError
from lumidock.streams.pixels import unpack
from lumidock.streams.sources import Item

_BUFFERS, _TIMEOUT_US, _LOST_AFTER = 4, 1_000_000, 5  # of these waits without a frame
_ENCODINGS = {
    "Mono8": "mono8",
    "Mono16": "mono16",
    "RGB8": "rgb8",
    "RGB8Packed": "rgb8",
    "BGR8": "bgr8",
    "BGR8Packed": "bgr8",
    "BayerRG8": "bayer_rggb8",
    "BayerBG8": "bayer_bggr8",
    "BayerGB8": "bayer_gbrg8",
    "BayerGR8": "bayer_grbg8",
}


def frames_of(name: str) -> Iterator[Item]:
    """Frames of the camera `name`, or of the first that answers; the newest first, those that queued behind dropped.

    The stamp is when the first packet of the frame came in. Raises: InputError when there is none, or when it is lost.
    """
    aravis, errors = _aravis()
    try:
        camera = aravis.Camera.new(name or None)
        encoding = _ENCODINGS.get(camera.get_pixel_format_as_string())
        if encoding is None:
            raise InputError(f"gige:{name}: pixel format {camera.get_pixel_format_as_string()} is not supported")
        stream = _stream_of(aravis, camera)
        for _ in range(_BUFFERS):
            stream.push_buffer(aravis.Buffer.new_allocate(camera.get_payload()))
        camera.start_acquisition()
        try:
            yield from _frames(aravis, stream, encoding, name)
        finally:
            camera.stop_acquisition()
    except errors as error:
        raise InputError(f"gige:{name}: {' '.join(str(getattr(error, 'message', error)).split())}") from None


def _stream_of(aravis: Any, camera: Any) -> Any:  # noqa: ANN401
    """A stream whose socket holds some frames: each comes as a burst, and a packet that is dropped spoils it."""
    if not camera.is_gv_device():
        return camera.create_stream(None, None)
    camera.gv_set_stream_options(aravis.GvStreamOption.PACKET_SOCKET_DISABLED)  # raw sockets want privileges
    stream = camera.create_stream(None, None)
    stream.set_property("socket-buffer", aravis.GvStreamSocketBuffer.FIXED)
    stream.set_property("socket-buffer-size", _BUFFERS * camera.get_payload())
    return stream


def _aravis() -> tuple[Any, type[Exception]]:
    """The library and the class of its errors."""
    try:
        import gi

        gi.require_version("Aravis", "0.8")
        from gi.repository import Aravis, GLib
    except (ImportError, ValueError):
        raise InputError("Aravis is not installed; apt install python3-gi gir1.2-aravis-0.8") from None
    return Aravis, GLib.Error


def _frames(aravis: Any, stream: Any, encoding: str, name: str) -> Iterator[Item]:  # noqa: ANN401
    number = waits = 0
    while True:
        buffer = stream.timeout_pop_buffer(_TIMEOUT_US)
        if buffer is None:
            waits += 1
            if waits == _LOST_AFTER:
                raise InputError(f"gige:{name}: the camera is lost")
            continue
        waits = 0
        newer = stream.try_pop_buffer()
        while newer is not None:
            stream.push_buffer(buffer)
            buffer, newer = newer, stream.try_pop_buffer()
        yield _item(aravis, buffer, encoding, f"{number:06d}")
        stream.push_buffer(buffer)
        number += 1


def _item(aravis: Any, buffer: Any, encoding: str, name: str) -> Item:  # noqa: ANN401
    t_ns = int(buffer.get_system_timestamp())
    if buffer.get_status() != aravis.BufferStatus.SUCCESS:
        return Unusable(name, t_ns, "bad_frame", f"frame {name}: {buffer.get_status().value_nick}")
    width, height = buffer.get_image_width(), buffer.get_image_height()
    data = np.frombuffer(buffer.get_data(), np.uint8)
    try:
        return Frame(name, t_ns, unpack(data, encoding, (width, height), len(data) // max(height, 1)).copy())
    except FrameError as error:
        return Unusable(name, t_ns, error.reason, f"frame {name}: {error}")
