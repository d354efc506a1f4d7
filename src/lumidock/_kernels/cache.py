"""The folder in which compiled kernels are kept from one process to the next.

Numba asks only whether the file of an entry has changed; the code of other files that is compiled into the entry may
have changed too. So the folder is named after everything that the compiled code was made from: other sources, or
another numba, have another folder.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numba
import numpy as np

SOURCES = Path(__file__).parent
_PREFIX = "compiled-"


def digest(sources: Path = SOURCES) -> str:
    """A short hash of all kernel sources and of the versions that compile them."""
    total = hashlib.sha256()
    for what in (sys.version, numba.__version__, np.__version__):
        total.update(what.encode())
    for path in sorted(sources.rglob("*.py")):
        total.update(path.read_bytes())
    return total.hexdigest()[:16]


def choose(name: str) -> Path | None:
    """The folder `name` in the first place that can be written; None where there is no such place.

    Compiled code that lies in a place before it, which can be read only, is copied into it: numba uses no folder that
    it cannot write.
    """
    readable: Path | None = None
    for place in _places():
        folder = place / (_PREFIX + name)
        if not _writable(place):
            if readable is None and folder.is_dir():
                readable = folder
            continue
        if readable is not None and not folder.exists():
            _copy(readable, folder)
        return folder
    return None


def remove_outdated(folder: Path) -> None:
    """Remove the compiled code of other sources beside `folder`, where all of it belongs to this installation."""
    if folder.parent == _beside():
        for other in folder.parent.glob(f"{_PREFIX}*"):
            if other != folder:
                shutil.rmtree(other, ignore_errors=True)


def _places() -> Iterator[Path]:
    """Where NUMBA_CACHE_DIR says, beside the sources, in the user's cache folder, in the temporary folder."""
    if given := getattr(numba.config, "CACHE_DIR", ""):
        yield Path(given)
    yield _beside()
    home = os.environ.get("HOME", "")
    if base := os.environ.get("XDG_CACHE_HOME", "") or (home and f"{home}/.cache"):
        yield Path(base) / "lumidock"
    with suppress(OSError):  # where there is no temporary folder
        temporary = Path(tempfile.gettempdir()) / f"lumidock-{os.getuid()}"
        if _ours_alone(temporary):
            yield temporary


def _beside() -> Path:
    return SOURCES / "__pycache__"


def _ours_alone(folder: Path) -> bool:
    """Whether nobody else can write `folder`, which is made: loading compiled code runs it."""
    folder.mkdir(mode=0o700, exist_ok=True)
    status = folder.lstat()
    return folder.is_dir() and not folder.is_symlink() and status.st_uid == os.getuid() and not status.st_mode & 0o022


def _writable(place: Path) -> bool:
    try:
        place.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=place):
            return True
    except OSError:
        return False


def _copy(readable: Path, folder: Path) -> None:
    """Copy as a whole or not at all; another process may be doing the same. The modes stay behind: they may forbid."""
    with suppress(OSError), tempfile.TemporaryDirectory(dir=folder.parent) as made:
        copy = Path(made) / "copy"
        for path in readable.rglob("*.nb[ci]"):
            target = copy / path.relative_to(readable)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, target)
        copy.rename(folder)
