"""Contacts of the hull with the tubes of the cage: the distance between a box and the axes of tubes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lumidock.datatypes import Array
from lumidock.docking.vehicle import VehicleModel
from lumidock.errors import InputError
from lumidock.sim.scenario import Scenario
from lumidock.sim.solids import cage
from lumidock.station import Station

_EVERY_M = 0.02  # points on the axes; a tube of 3 cm is then found 2 mm too far at most


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """Points (K, 3) on the axes of the tubes in `dock`, and the radius (K,) of the tube around each, m."""

    p_dock: Array
    radius_m: Array

    @classmethod
    def of(cls, scenario: Scenario, station: Station) -> Frame:
        """The cage of the paper. Raises: InputError for another dock, whose body is not made of tubes."""
        if scenario.matter.dock not in ("none", "cage"):
            raise InputError(f"{scenario.name}: contacts are known for matter.dock: cage only")
        points, radii = [], []
        for solid in cage(station):
            if solid.kind != "tube":
                continue
            start, end = np.array(solid.center), np.array(solid.end)
            count = int(np.linalg.norm(end - start) / _EVERY_M) + 2
            points.append(start + np.linspace(0.0, 1.0, count)[:, None] * (end - start))
            radii.append(np.full(count, max(solid.radius_m)))
        return cls(np.concatenate(points), np.concatenate(radii))

    def room_m(self, model: VehicleModel, R_dock_body: Array, p_dock: Array) -> float:
        """Least distance between the hull, a box around the body's centre `p_dock` (3,), and a tube; < 0: contact."""
        near = np.abs(self.p_dock[:, 2] - p_dock[2]) < model.half_m[0] + 0.5
        if not near.any():
            return np.inf
        p_body = (self.p_dock[near] - p_dock) @ R_dock_body
        outside = np.maximum(np.abs(p_body) - np.array(model.half_m), 0.0)
        return float((np.sqrt((outside * outside).sum(axis=1)) - self.radius_m[near]).min())
