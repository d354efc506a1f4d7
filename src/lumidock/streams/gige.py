"""GigE Vision cameras by Aravis, which the system packages: python3-gi and gir1.2-aravis-0.8 of Debian and Ubuntu."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from lumidock.datatypes import Frame, Unusable
from lumidock.errors import FrameError, InputError
from lumidock.streams.pixels import READ, supported, unpack
from lumidock.streams.source import Item, Size

_BUFFERS, _TIMEOUT_US, _LOST_AFTER = 4, 1_000_000, 5  # of these waits without a frame


def frames_of(name: str, size: Size | None = None) -> Iterator[Item]:
    """Frames of the camera `name`, or of the first that answers; the newest first, those that queued behind dropped.

    The stamp is when the first packet of the frame came in. Raises: InputError when there is none, or when it is lost.
    """
    aravis, errors = _aravis()
    try:
        camera = aravis.Camera.new(name or None)
        pixels = str(camera.get_pixel_format_as_string())
        if not supported(pixels):
            raise InputError(f"gige:{name}: pixel format {pixels} is not supported; read are {READ}")
        stream = _stream_of(aravis, camera)
        for _ in range(_BUFFERS):
            stream.push_buffer(aravis.Buffer.new_allocate(camera.get_payload()))
        camera.start_acquisition()
        try:
            yield from _frames(aravis, stream, pixels, name, size)
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


def _frames(aravis: Any, stream: Any, pixels: str, name: str, size: Size | None) -> Iterator[Item]:  # noqa: ANN401
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
        yield _item(aravis, buffer, pixels, f"{number:06d}", size)
        stream.push_buffer(buffer)
        number += 1


def _item(aravis: Any, buffer: Any, pixels: str, name: str, size: Size | None) -> Item:  # noqa: ANN401
    t_ns = int(buffer.get_system_timestamp())
    if buffer.get_status() != aravis.BufferStatus.SUCCESS:
        return Unusable(name, t_ns, "bad_frame", f"frame {name}: {buffer.get_status().value_nick}")
    width, height = buffer.get_image_width(), buffer.get_image_height()
    data = np.frombuffer(buffer.get_data(), np.uint8)
    try:
        step = len(data) // max(height, 1)
        image, encoding = unpack(data, pixels, (width, height), step, wanted=size)
        return Frame(name, t_ns, image.copy(), encoding=encoding)
    except FrameError as error:
        return Unusable(name, t_ns, error.reason, f"frame {name}: {error}")
