"""Other front layers for the dock: the paper shows its own only in a figure, and results depend on it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lumidock.errors import InputError
from lumidock.station import Station

_SIDE_M = 0.92  # from the axis to the lights on the left, the right and the bottom, as in the shipped dock
# x, y m of seven lights: left side from above, bottom from the left, right side from below
_FRONT: dict[str, list[tuple[float, float]]] = {
    "regular 2-3-2": [(-1, 0.5), (-1, -0.5), (-0.6, -1), (0, -1), (0.6, -1), (1, -0.5), (1, 0.5)],
    "mirror-symmetric 3-1-3": [(-1, 0.7), (-1, 0), (-1, -0.7), (0, -1), (1, -0.7), (1, 0), (1, 0.7)],
}
SHIPPED = "as given"
LAYOUTS = (SHIPPED, *_FRONT)


def with_layout(station: Station, layout: str) -> Station:
    """The station with its front layer laid out anew. Raises: InputError where that layer has not seven lights."""
    if layout == SHIPPED:
        return station
    lights = station.lights_of(station.layers_front_to_rear()[0])
    if len(lights) != len(_FRONT[layout]):
        raise InputError(f"{station.name}: {len(lights)} front lights; the layout {layout} is of {len(_FRONT[layout])}")
    p_dock = station.p_dock.copy()
    p_dock[lights, :2] = _SIDE_M * np.array(_FRONT[layout])
    return replace(station, p_dock=p_dock)
