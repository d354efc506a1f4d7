"""A detector of your own: `process_detections` needs only the centroids of the detections.

python examples/04_own_detector.py PICTURE STATION CAMERA
"""

import sys
from pathlib import Path

import cv2
import numpy as np

from lumidock import Detections, Localizer, load_camera, load_station


def detections(image: np.ndarray) -> np.ndarray:
    """Centres (N, 2) px of what is brighter than half the brightest."""
    gray = cv2.GaussianBlur(image.max(axis=2), (0, 0), 2.0)
    _, mask = cv2.threshold(gray, 0.5 * float(gray.max()), 255, cv2.THRESH_BINARY)
    return cv2.connectedComponentsWithStats(mask)[3][1:]  # the first one is the background


if len(sys.argv) != 4:
    sys.exit(__doc__)
picture, station, camera = map(Path, sys.argv[1:4])
localizer = Localizer(load_station(station), load_camera(camera))
fix = localizer.process_detections(Detections.from_uv(picture.stem, 0, detections(cv2.imread(str(picture)))))
print(f"{fix.n_seen} detections, {fix.n_used} of them lights of the dock: {fix.reason or 'valid'}")
