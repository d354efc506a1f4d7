"""Temporary folders of commands, of which none outlasts the next command, even after a kill -9 or a power cut."""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_NEW, _HELD = "lumidock-new-", "lumidock-held-"


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """A folder that is removed at the end, or by the next command where this one does not live to its end."""
    _remove_abandoned(Path(tempfile.gettempdir()))
    made = Path(tempfile.mkdtemp(prefix=_NEW))
    lock = os.open(made, os.O_RDONLY)
    try:
        with suppress(OSError):  # a file system without locks: nobody else removes what cannot be locked
            fcntl.flock(lock, fcntl.LOCK_EX)
        # named only now: a folder of this name that nobody has locked is one of a process that is dead
        folder = made.rename(made.with_name(_HELD + made.name.removeprefix(_NEW)))
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)
    finally:
        os.close(lock)


def _remove_abandoned(place: Path) -> None:
    """Remove the folders of this user's processes that have died, whose locks the system has given up."""
    for folder in place.glob(f"{_HELD}*"):
        with suppress(OSError):
            status = folder.lstat()
            if folder.is_symlink() or status.st_uid != os.getuid():
                continue
            lock = os.open(folder, os.O_RDONLY | os.O_NOFOLLOW | os.O_DIRECTORY)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(folder, ignore_errors=True)
            finally:
                os.close(lock)
