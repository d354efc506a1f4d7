"""What of a machine lumidock can use, and what is in its way."""

from __future__ import annotations

import importlib.util
import platform
import socket
import sys
import time
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Literal

import cv2
import numba
import numpy as np

EXTRAS = {
    "bag": ("rosbags", "mcap", "lz4", "zstandard"),
    "video": ("av",),
    "mavlink": ("pymavlink",),
    "zenoh": ("zenoh",),
    "dds": ("cyclonedds",),
    "live": ("foxglove",),
    "console": ("starlette", "uvicorn", "wsproto"),
    "rerun": ("rerun",),
    "parquet": ("pyarrow",),
    "report": ("matplotlib", "jinja2"),
    "cluster": ("distributed",),
    "setup": ("scipy", "cma"),
}
PORTS = {"console": 8780, "Foxglove": 8765}
_FIRST_S = 1_700_000_000.0  # no clock that was ever set shows less
_SYNCHRONIZED = Path("/run/systemd/timesync/synchronized")
_GIGE_BUFFER = 8 << 20  # bytes; a frame of 5 megapixels comes as a burst

Mark = Literal["ok", "note", "bad"]


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was looked at: ok, worth a note, or in the way."""

    mark: Mark
    what: str
    text: str


def examine() -> list[Finding]:
    """Look at Python, libraries, compiled caches, cameras, clock and ports."""
    return [
        _python(),
        Finding("ok", "lumidock", version("lumidock")),
        Finding("ok", "OpenCV", f"{cv2.__version__}, {cv2.getNumThreads()} threads"),
        Finding("ok", "numpy", f"{np.__version__}, numba {numba.__version__}"),
        _caches(),
        *(_extra(name, modules) for name, modules in EXTRAS.items()),
        _aravis(),
        _cameras(),
        _clock(),
        *(_port(what, port) for what, port in PORTS.items()),
        _receive_buffer(),
    ]


def _python() -> Finding:
    fits = (3, 10) <= sys.version_info < (3, 14)
    return Finding("ok" if fits else "bad", "Python", f"{platform.python_version()}, {platform.machine()}")


def _caches() -> Finding:
    """The compiled kernels of the default method."""
    from lumidock.app.warm import compiled_code

    state = compiled_code()
    return Finding(state.mark, "caches", state.text)


def _extra(name: str, modules: tuple[str, ...]) -> Finding:
    missing = [module for module in modules if importlib.util.find_spec(module) is None]
    if missing:
        return Finding("note", f"[{name}]", f"not installed; pip install 'lumidock[{name}]'")
    return Finding("ok", f"[{name}]", ", ".join(modules))


def _aravis() -> Finding:
    if importlib.util.find_spec("gi") is None:
        return Finding("note", "GigE", "no Aravis; apt install python3-gi gir1.2-aravis-0.8 for GigE Vision cameras")
    return Finding("ok", "GigE", "python3-gi is there")


def _cameras() -> Finding:
    devices = sorted(str(path) for path in Path("/dev").glob("video*"))
    return Finding("ok", "cameras", ", ".join(devices)) if devices else Finding("note", "cameras", "no /dev/video*")


def _clock() -> Finding:
    if time.time() < _FIRST_S:
        return Finding("bad", "clock", f"shows {time.ctime()}; stamps will jump when it is set")
    if not _SYNCHRONIZED.exists():
        return Finding("note", "clock", "not known to be synchronized (systemd-timesyncd); chrony or PTP will do")
    return Finding("ok", "clock", "synchronized")


def _port(what: str, port: int) -> Finding:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except OSError as error:
            return Finding("note", what, f"port {port}: {error.strerror}; choose another with an option of `serve`")
    return Finding("ok", what, f"port {port} is free")


def _receive_buffer() -> Finding:
    try:
        size = int(Path("/proc/sys/net/core/rmem_max").read_text())
    except (OSError, ValueError):
        return Finding("note", "network", "cannot tell how large receive buffers may be")
    if size < _GIGE_BUFFER:
        return Finding("note", "network", f"net.core.rmem_max is {size}; GigE cameras want {_GIGE_BUFFER} or more")
    return Finding("ok", "network", f"receive buffers up to {size} bytes")
