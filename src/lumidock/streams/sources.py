"""Which reader a source wants: folders of frames, videos and bags, told apart by the path."""

from __future__ import annotations

from pathlib import Path

from lumidock.errors import InputError, extra
from lumidock.streams.folder import open_folder
from lumidock.streams.source import Reading, Source

_VIDEO_SUFFIXES = (".mp4", ".avi", ".mkv", ".mov", ".m4v", ".webm", ".mpg", ".mpeg", ".ts", ".wmv", ".h264", ".h265")
BAG_SUFFIXES = (".mcap", ".db3", ".bag", ".bag.active")
_PACKED_BAGS = {".mcap.zstd": "zstd -d", ".db3.zstd": "zstd -d", ".mcap.zst": "zstd -d", ".db3.zst": "zstd -d"}
_FPS_RANGE = (1e-3, 1e6)


def open_source(path: Path, reading: Reading | None = None) -> Source:
    """Open a sequence folder, a folder of pictures, a video file or a bag of ROS 1 or ROS 2.

    Raises: InputError, one line, when there is nothing to read.
    """
    reading = reading or Reading()
    fps, name = reading.fps, path.name.lower()
    if fps is not None and not _FPS_RANGE[0] <= fps <= _FPS_RANGE[1]:
        raise InputError(f"--fps {fps:g}: wanted a frame rate from {_FPS_RANGE[0]:g} to {_FPS_RANGE[1]:g}")
    if not path.exists():
        raise InputError(f"{path}: no such file or folder")
    _refuse_packed(path)
    if (name.endswith(BAG_SUFFIXES) and not path.is_dir()) or (path.is_dir() and _holds_a_bag(path)):
        with extra("bag"):
            from lumidock.streams.bag import open_bag
        return open_bag(path, reading)
    if path.is_dir():
        return open_folder(path, reading)
    if path.suffix.lower() in _VIDEO_SUFFIXES:
        with extra("video"):
            from lumidock.streams.video import open_video
        return open_video(path, reading)
    kinds = ", ".join((*_VIDEO_SUFFIXES, *BAG_SUFFIXES))
    raise InputError(f"{path}: neither a folder nor a video or bag ({kinds})")


def _refuse_packed(path: Path) -> None:
    """Raises: InputError for a bag that its recorder compressed as a whole file, with the command that unpacks it."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    if path.is_dir() and any(file.name.lower().endswith(BAG_SUFFIXES) for file in files):
        return
    for file in files:
        for suffix, command in _PACKED_BAGS.items():
            if file.name.lower().endswith(suffix):
                raise InputError(
                    f"{file}: a bag that was compressed as a file; unpack it first: {command} {file.name} (or record "
                    "with --compression-mode message)"
                )


def _holds_a_bag(folder: Path) -> bool:
    """Whether a recorder of bags made this folder; frames of a sequence come first."""
    if (folder / "timestamps.csv").exists():
        return False
    return any(file.name.lower().endswith(BAG_SUFFIXES) and not file.name.startswith(".") for file in folder.iterdir())
