"""Dockings in closed loop: a vehicle that steers itself by the fixes of a method, counted against the truth.

Each row is a scenario and a vehicle with so many dockings by one method. Fewer are run of the methods that
lose: their frames cost more, and what they show they show at once. BENCH_DOCKINGS sets the number of the default one.
"""

from __future__ import annotations

import os
from typing import Any

from bench.shipped import shipped_camera, shipped_station
from lumidock.docking.campaign import HEAD, counted, row, run_campaign
from lumidock.docking.loop import Docking
from lumidock.docking.vehicle import VEHICLES
from lumidock.sim.scenario import load_scenario

SEED = 40_000
DOCKINGS = int(os.environ.get("BENCH_DOCKINGS", "40"))
ROWS = (
    ("docking", "rov", "lumidock", DOCKINGS),
    ("docking", "auv", "lumidock", DOCKINGS),
    ("docking", "rov", "aided", DOCKINGS // 2),
    ("docking-hard", "rov", "lumidock", DOCKINGS // 2),
    ("docking-hard", "auv", "lumidock", DOCKINGS // 2),
    ("docking-hard", "rov", "aided", DOCKINGS // 2),
    ("docking-moved", "rov", "lumidock", DOCKINGS // 4),
    ("docking", "rov", "raw", DOCKINGS // 4),
    ("docking-hard", "rov", "raw", DOCKINGS // 4),
    ("docking", "rov", "paper", DOCKINGS // 8),
    ("docking-hard", "rov", "paper", DOCKINGS // 8),
)


def main() -> tuple[dict[str, Any], list[str]]:
    """A row for each of `ROWS`."""
    station, camera = shipped_station(), shipped_camera()
    head = ("scenario", "vehicle", *HEAD)
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    content: dict[str, Any] = {}
    for scenario, vehicle, method, runs in ROWS:
        docking = Docking(load_scenario(scenario), station, camera, VEHICLES[vehicle], method, SEED)
        counts = counted(run_campaign(docking, (method,), runs, 1)[method])
        content[f"{scenario} {vehicle} {method}"] = counts
        lines.append("| " + " | ".join((scenario, vehicle, *row(method, counts))) + " |")
        print(lines[-1], counts["why"], counts["by_current"], counts["dockings_per_s"], flush=True)
    return content, lines
