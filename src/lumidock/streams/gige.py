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
_COLORS = {"RGB8": "rgb8", "RGB8Packed": "rgb8", "BGR8": "bgr8", "BGR8Packed": "bgr8"}
_SENSORS = {
    "Mono": "mono",
    "BayerRG": "bayer_rggb",
    "BayerBG": "bayer_bggr",
    "BayerGB": "bayer_gbrg",
    "BayerGR": "bayer_grbg",
}
# encoding and how many bits count; 10 and 12 lie in the lower ones of 16
_FORMATS = {name: (encoding, 8) for name, encoding in _COLORS.items()} | {
    f"{name}{bits}": (f"{encoding}{8 if bits == 8 else 16}", bits)
    for name, encoding in _SENSORS.items()
    for bits in (8, 10, 12, 14, 16)
}


def frames_of(name: str) -> Iterator[Item]:
    """Frames of the camera `name`, or of the first that answers; the newest first, those that queued behind dropped.

    The stamp is when the first packet of the frame came in. Raises: InputError when there is none, or when it is lost.
    """
    aravis, errors = _aravis()
    try:
        camera = aravis.Camera.new(name or None)
        pixels = _FORMATS.get(camera.get_pixel_format_as_string())
        if pixels is None:
            raise InputError(f"gige:{name}: pixel format {camera.get_pixel_format_as_string()} is not supported")
        stream = _stream_of(aravis, camera)
        for _ in range(_BUFFERS):
            stream.push_buffer(aravis.Buffer.new_allocate(camera.get_payload()))
        camera.start_acquisition()
        try:
            yield from _frames(aravis, stream, pixels, name)
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


def _frames(aravis: Any, stream: Any, pixels: tuple[str, int], name: str) -> Iterator[Item]:  # noqa: ANN401
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
        yield _item(aravis, buffer, pixels, f"{number:06d}")
        stream.push_buffer(buffer)
        number += 1


def _item(aravis: Any, buffer: Any, pixels: tuple[str, int], name: str) -> Item:  # noqa: ANN401
    t_ns = int(buffer.get_system_timestamp())
    if buffer.get_status() != aravis.BufferStatus.SUCCESS:
        return Unusable(name, t_ns, "bad_frame", f"frame {name}: {buffer.get_status().value_nick}")
    width, height = buffer.get_image_width(), buffer.get_image_height()
    data = np.frombuffer(buffer.get_data(), np.uint8)
    try:
        step = len(data) // max(height, 1)
        image, encoding = unpack(data, pixels[0], (width, height), step, bits=pixels[1])
        return Frame(name, t_ns, image.copy(), encoding=encoding)
    except FrameError as error:
        return Unusable(name, t_ns, error.reason, f"frame {name}: {error}")
