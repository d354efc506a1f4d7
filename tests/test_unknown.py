"""A dock without a drawing: a first layout from detections alone."""

from __future__ import annotations

import numpy as np
import pytest
from bench.built_docks import built_dock

from lumidock.errors import InputError
from lumidock.setup.gauge import aligned
from lumidock.setup.unknown import first_layout


@pytest.mark.parametrize("seed", [0, 2])
def test_the_layout_is_found_from_the_number_of_lights(seed):
    dock = built_dock(seed, dockings=1, interval_s=0.0667, settings=("detections.dead=[0,0]",))
    found = first_layout(dock.recordings, 7, 6, dock.camera, 0.5)
    order = _in_the_order_of(found.p_dock, dock.built.p_dock)
    e = aligned(found.p_dock, dock.built.p_dock[order], scale=True) - dock.built.p_dock[order]
    assert np.sqrt((e**2).mean()) < 0.03  # within what a survey takes as a drawing


def _in_the_order_of(found, built):
    """Which light of the dock each of the layout is: the nearest in its layer, after a fit of size and middle."""
    order = np.empty(len(found), int)
    for lights in (np.arange(7), np.arange(7, 13)):
        a, b = (p[lights, :2] - p[lights, :2].mean(axis=0) for p in (found, built))
        a = a * np.sqrt((b**2).sum() / (a**2).sum())
        order[lights] = lights[np.linalg.norm(a[:, None] - b[None], axis=2).argmin(axis=1)]
    assert len(set(order)) == len(order)
    return order


def test_another_number_of_lights_is_refused():
    dock = built_dock(0, dockings=1, interval_s=0.0667, settings=("detections.dead=[0,0]",))
    with pytest.raises(InputError, match="no stretch of frames shows 8 lights"):
        first_layout(dock.recordings, 8, 6, dock.camera, 0.5)
