"""Worker processes that do not outlive what started them."""

from __future__ import annotations

import os
import threading
from multiprocessing import active_children, parent_process

import cv2


def start_child() -> None:
    """Begin a worker process: one thread for OpenCV, and an end when the parent process ends, however that is."""
    cv2.setNumThreads(1)
    threading.Thread(target=_end_with_parent, name="parent", daemon=True).start()


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def end_children() -> None:
    """End all worker processes of this one, whatever they are doing."""
    for child in active_children():
        child.terminate()
