"""Cameras by their address: RTSP and RTP streams, V4L2 devices and GigE Vision."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from lumidock.datatypes import Frame, Unusable
from lumidock.errors import FrameError, InputError, extra
from lumidock.streams.address import SCHEMES, address_of
from lumidock.streams.clock import now_ns
from lumidock.streams.images import mono_if_gray, require_size
from lumidock.streams.source import Item, Network, Reading, Size, Source

_DEVICE = re.compile(r"/dev/video[0-9]{1,3}")


def open_live(
    address: str, *, gray: bool = False, reading: Reading | None = None, network: Network | None = None
) -> Source | None:
    """A camera by its address: rtsp://..., rtp://HOST:PORT (H.264), /dev/videoN, gige:[NAME], or a topic of ROS 2.

    None for none of these. It is not opened yet: a camera that is lost, or not there yet, is an InputError of its
    `items`; only the calibration beside a topic is waited for.
    """
    if address.startswith(("zenoh:", "dds:")):
        with extra("bag"):
            from lumidock.streams.topics import open_topic
        return open_topic(address, reading or Reading(), network or Network())
    if address.startswith("gige:"):
        from lumidock.streams import gige

        name = address.removeprefix("gige:")
        return Source(Path(name or "gige"), "gige", lambda size: gige.frames_of(name, size), live=True)
    if _DEVICE.fullmatch(address):
        return Source(Path(address), "v4l2", lambda size: _device(address, size), live=True)
    if address.startswith(tuple(f"{scheme}://" for scheme in SCHEMES)):
        camera = address_of(address)
        with extra("video"):
            from lumidock.streams.network import frames_of
        return Source(Path(camera.shown), "stream", lambda size: frames_of(camera, gray, size), live=True)
    return None


def _device(path: str, size: Size | None) -> Iterator[Item]:
    """Frames of a V4L2 device; the stamp is when the driver handed one over."""
    capture = cv2.VideoCapture(path, cv2.CAP_V4L2)
    try:
        if not capture.isOpened():
            raise InputError(f"{path}: no camera there")
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        number = 0
        while capture.grab():
            t_ns = now_ns()
            decoded, image = capture.retrieve()
            name = f"{number:06d}"
            if decoded:
                try:
                    require_size((image.shape[1], image.shape[0]), size, f"frame {name}")
                    yield Frame(name, t_ns, mono_if_gray(np.asarray(image, np.uint8)))
                except FrameError as error:
                    yield Unusable(name, t_ns, error.reason, str(error))
            number += 1
    finally:
        capture.release()
