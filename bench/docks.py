"""From which range docks of several sizes give guidance and poses, in several waters.

The range at which a light's matched-filter signal-to-noise ratio is 8 comes from the simulator's optics; up to that
range its lights are seen in simulated approaches of bare detections with errors of survey and calibration, which the
default method follows. The table gives the median over seeds.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

import numpy as np

from bench.shipped import shipped_camera, shipped_station
from bench.visibility import reach_m
from lumidock.localizer import Localizer
from lumidock.sim.detections import simulated_frames
from lumidock.sim.scenario import load_scenario
from lumidock.station import Station, load_station

WATERS = {"II": "clear ocean (II)", "III": "ocean (III)", "3C": "coast (3C)", "7C": "harbour (7C)"}
RINGS = {
    "0.5 m, 4 lights": (0.5, 4),
    "0.8 m, 5 lights": (0.8, 5),
    "1.2 m, 6 lights": (1.2, 6),
    "2 m, 7 lights": (2.0, 7),
}
CAGE = "2 m, 7 lights and 6 more 5 m deeper"
SEEDS = range(9500, 9505)
_FARTHEST_M = 30.0
_IN_A_ROW = 3  # valid poses: one alone is no beginning


def ring(width_m: float, lights: int) -> Station:
    """White lights around an entrance of that width, at unequal angles, so that no rotation fits another."""
    steps = 1.0 + 0.6 * np.cos(np.arange(lights) * 2.4)  # the golden angle: no two steps are alike
    angles = 2.0 * np.pi * np.cumsum(steps) / steps.sum()
    places = [(width_m / 2.0 * float(np.cos(a)), width_m / 2.0 * float(np.sin(a)), 0.0) for a in angles]
    listed = [{"id": f"L{k}", "layer": "front", "position": place} for k, place in enumerate(places, 1)]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "ring.yaml"
        file.write_text(json.dumps({"schema": 1, "name": f"ring-{lights}", "lights": listed}))
        return load_station(file)


def begins(station: Station, reach: dict[str, float], seed: int) -> tuple[float, float]:
    """Farthest z of a first guide, and of three valid poses in a row, in one approach; 0 where there is none."""
    layers = station.layers_front_to_rear()
    settings = (
        f"path.start_z_m={min(_FARTHEST_M, 1.2 * reach[layers[0]]):.2f}",
        "path.end_z_m=0.5",
        f"detections.front_range_m={reach[layers[0]]:.2f}",
        f"detections.rear_range_m={reach[layers[-1]]:.2f}",
        "detections.survey=true",
        "detections.calibration=true",
    )
    localizer = Localizer(station, shipped_camera())
    guide, valid, row = 0.0, 0.0, list[float]()
    for frame in simulated_frames(load_scenario("approach", settings), station, localizer.camera, seed):
        fix, z = localizer.process_detections(frame.detections), float(frame.T_dock_cam[2, 3])
        row = [*row, z] if fix.valid else []
        guide = max(guide, z) if fix.valid or fix.guide is not None else guide
        valid = max(valid, row[0]) if len(row) >= _IN_A_ROW else valid
    return guide, valid


def main() -> tuple[dict[str, object], list[str]]:
    """One row a dock: where guide and valid begin in each water, m."""
    docks = {name: ring(*what) for name, what in RINGS.items()} | {CAGE: shipped_station()}
    lines = ["| dock width and lights | " + " | ".join(WATERS.values()) + " |", "|---" * (len(WATERS) + 1) + "|"]
    content: dict[str, object] = {}
    for name, station in docks.items():
        cells = []
        for water in WATERS:
            optics = (f"water.kind={water}",)
            reach = {layer: reach_m(optics, station, layer) for layer in station.layers_front_to_rear()}
            ranges = np.median([begins(station, reach, seed) for seed in SEEDS], axis=0)
            cells.append(" / ".join("none" if value == 0.0 else f"{value:.0f}" for value in ranges))
            content[f"{name}, {water}"] = {"seen_m": reach, "guide_m": ranges[0], "valid_m": ranges[1]}
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return content, lines
