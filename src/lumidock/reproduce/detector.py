"""What was measured of the detector on rendered frames, and lies behind the runs at point level, as a table."""

from __future__ import annotations

from typing import Any

import numpy as np

from lumidock.report.page import Table
from lumidock.sim.measured import measured_table

_HEAD = [
    "pictures of",
    "frames",
    "lights",
    "missed, %",
    "error over sigma",
    "wrong layer, %",
    "false detections a frame",
]
_CAPTION = (
    "The default detector on rendered frames. {about} Lights up to {reach:g} m away, false detections of all frames; "
    "error of the centroid: rms of an axis over its own sigma, 1 where the covariance is right."
)
_REACH_M = 20.0


def detector_table() -> Table:
    """A row for each scenario on whose frames it was measured."""
    content = measured_table()
    bands = sum(edge < _REACH_M for edge in content["edges_m"])
    rows = [[name, *_cells(cells, bands)] for name, cells in content["scenarios"].items()]
    return Table(_CAPTION.format(about=content["about"], reach=_REACH_M), _HEAD, rows)


def _cells(cells: dict[str, Any], bands: int) -> list[str]:
    lights = [(kind, cell) for kind in ("front", "rear") for cell in cells[kind][:bands]]
    of, seen = (sum(cell[key] for _, cell in lights) for key in ("of", "seen"))
    detections = [
        (cell["seen"] / len(cell["detections"]), kind, detection)
        for kind, cell in lights
        for detection in cell["detections"]
    ]
    square = sum(cell["seen"] * cell["mean_square"] for _, cell in lights) / max(seen, 1)
    known = [
        (weight, (detection[3] > 0.5) != (kind == "rear"))
        for weight, kind, detection in detections
        if detection[3] is not None
    ]
    wrong = sum(weight * bad for weight, bad in known) / max(sum(weight for weight, _ in known), 1e-9)
    frames, false = (sum(cell[key] for cell in cells["false"]) for key in ("of", "seen"))
    missed = f"{100.0 * (1.0 - seen / max(of, 1)):.1f}"
    return [
        str(frames),
        str(of),
        missed,
        f"{np.sqrt(0.5 * square):.2f}",
        f"{100.0 * wrong:.1f}",
        f"{false / frames:.1f}",
    ]
