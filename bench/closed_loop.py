"""Dockings in closed loop: a vehicle that steers itself by the fixes of a method, counted against the truth.

Each row is a scenario and a vehicle with so many dockings by one method; fewer where frames cost more. A row that is
there already, of the same code, is not made again, so that the bench can be interrupted; BENCH_ROW makes one row alone.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from bench.shipped import shipped_camera, shipped_station
from lumidock.docking.campaign import HEAD, counted, row, run_campaign
from lumidock.docking.loop import Docking
from lumidock.docking.vehicle import VEHICLES
from lumidock.evaluation.campaign import source_digest
from lumidock.sim.scenario import load_scenario

SEED = 40_000
FOLDER = Path("bench-out") / "closed-loop"
ROWS = (
    ("docking", "rov", "lumidock", 20),
    ("docking", "auv", "lumidock", 20),
    ("docking", "rov", "aided", 10),
    ("docking-hard", "rov", "lumidock", 5),
    ("docking-hard", "rov", "aided", 5),
    ("docking", "rov", "raw", 10),
    ("docking-hard", "rov", "raw", 5),
    ("docking", "rov", "paper", 4),
)


def counts_of(scenario: str, vehicle: str, method: str, runs: int) -> dict[str, Any]:
    """The counts of one row, from its file where that is of the same code."""
    file, code = FOLDER / f"{scenario}-{vehicle}-{method}-{runs}.json", source_digest()
    if file.exists() and (content := json.loads(file.read_text(encoding="utf-8")))["code"] == code:
        return dict(content["counts"])
    docking = Docking(load_scenario(scenario), shipped_station(), shipped_camera(), VEHICLES[vehicle], method, SEED)
    counts = counted(run_campaign(docking, (method,), runs, 1)[method])
    FOLDER.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps({"code": code, "counts": counts}), encoding="utf-8")
    return counts


def main() -> tuple[dict[str, Any], list[str]]:
    """A line for each of `ROWS`."""
    head = ("scenario", "vehicle", *HEAD)
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    only, content = os.environ.get("BENCH_ROW"), dict[str, Any]()
    for scenario, vehicle, method, runs in ROWS if only is None else ROWS[int(only) : int(only) + 1]:
        counts = counts_of(scenario, vehicle, method, runs)
        content[f"{scenario} {vehicle} {method}"] = counts
        lines.append("| " + " | ".join((scenario, vehicle, *row(method, counts))) + " |")
    return content, lines
