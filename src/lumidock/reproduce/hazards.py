"""Every shipped docking by our method: frames that claim to be usable while their error is over the alert limit."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from lumidock.report.page import PageSection, Table
from lumidock.reproduce.detector import detector_table
from lumidock.reproduce.jobs import Job
from lumidock.reproduce.plan import Plan
from lumidock.reproduce.work import Simulation, campaign, docking, docking_leaves
from lumidock.sim.measured import is_measured, measured_like
from lumidock.sim.scenario import load_scenario, shipped_scenarios

_METHODS = ("lumidock",)
_APPROACH_M, _FRAME_S, _ALL_INTERVAL_S = 33.0, 0.25, 0.15
_TEXT = (
    "Every shipped docking: frames that claim to be usable while their error is over the alert limit. Point level: "
    "bare detections that are missed, err and are false as measured on rendered frames of the scenario's water and "
    "lights, drawn anew in each frame and false ones anywhere in the picture; mirror images and glints that stand "
    "where a light might, and errors that last, are only in the rendered rows."
)


def jobs(plan: Plan) -> list[Job]:
    """Shipped scenarios with a path: at point level all of them, rendered all or those that the grid names."""
    return _rendered(plan) + _point_level(plan)


def _rendered(plan: Plan) -> list[Job]:
    grid = plan.grid
    names: list[str] = list(grid.shipped)
    settings: tuple[str, ...] = (f"path.frame_interval_s={grid.envelope_interval_s}",)
    interval_s = grid.envelope_interval_s
    if grid.rendered_seeds:
        names, settings = [n for n in shipped_scenarios() if load_scenario(n).path.kind != "draws"], ()
        interval_s = _ALL_INTERVAL_S
    jobs = []
    for name in names:
        for seed in range(max(grid.rendered_seeds, 1)):
            folder = plan.out / "runs" / f"{name}-{seed}"
            simulation = Simulation(plan.dock, name, settings, grid.first_seed + seed)
            arguments = (simulation, str(folder), False, _METHODS, plan.config)
            leaves, weight = docking_leaves(folder, False, _METHODS), _APPROACH_M / interval_s * _FRAME_S
            jobs.append(Job(f"shipped-{name}-{seed}", weight, docking, arguments, leaves))
    return jobs


def _point_level(plan: Plan) -> list[Job]:
    """Bare detections by a detector that errs as it does on its pictures."""
    jobs = []
    for name in shipped_scenarios():
        scenario = load_scenario(name)
        if scenario.path.kind == "draws" or not is_measured(scenario):
            continue
        settings = (f"detections.detector={measured_like(scenario)}",)
        seeds = range(plan.grid.first_seed, plan.grid.first_seed + plan.grid.point_seeds)
        jobs += [
            Job(f"point-{name}-{seed}", 2, campaign, (Simulation(plan.dock, name, settings, seed),)) for seed in seeds
        ]
    return jobs


def section(_plan: Plan, results: Mapping[str, Any]) -> PageSection:
    """Frames and hazards by scenario, and the measured detector behind the point level."""
    rows: dict[str, list[int]] = {}
    keys = ("frames", "valid", "guide", "hazardous_valid", "hazardous_guide")
    for name, result in results.items():
        if name.startswith("point-"):
            counts = [result["counts"].get(key, 0) for key in keys]
            _add(rows, f"{name.removeprefix('point-').rpartition('-')[0]}, point level", counts)
        elif name.startswith(("docking-", "search", "shipped-")):
            r = result["lumidock"]
            shown = name.removeprefix("shipped-").rpartition("-")[0] or name
            hazards = [r["hazardous"][word]["any"] for word in ("valid", "guide")]
            _add(rows, f"{shown}, rendered", [r["frames"], r["valid"], r["guide"], *hazards])
    head = ["scenario", "frames", "valid", "guide", "hazardous valid", "hazardous guide"]
    cells = [[name, *map(str, counts)] for name, counts in rows.items()]
    table = Table("Frames of our method, and those hazardously misleading.", head, cells)
    return PageSection("Hazardously misleading frames", _TEXT, items=[table, detector_table()])


def _add(rows: dict[str, list[int]], name: str, counts: list[int]) -> None:
    rows[name] = [a + b for a, b in zip(rows.get(name, [0] * len(counts)), counts, strict=True)]
