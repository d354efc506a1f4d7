"""The jobs of a reproduction."""

from __future__ import annotations

from pathlib import Path

from lumidock.reproduce import work
from lumidock.reproduce.grid import Grid
from lumidock.reproduce.jobs import Job
from lumidock.reproduce.paper_figures import DISTANCES_M, TABLE_1
from lumidock.sim.measured import is_measured, measured_like
from lumidock.sim.scenario import load_scenario, shipped_scenarios

ROWS = (*((*faults, False) for faults in TABLE_1), (1, 1, False), (1, 1, True), (3, 2, True))
FAULTS_AT_DISTANCE = ((1, 0), (2, 0), (3, 0), (0, 1), (0, 2))
COLD = {
    "missing and spurious together": "missing-spurious",
    "all of them beside the array": "beside",
    "layer confusion: 30 % of the layer labels wrong": "joint",
    "layer confusion: no labels at all": "joint-nocolor",
    "no dock, only other lights": "clutter",
    "only the mirror image in view": "mirror-only",
}
SWARM_ITERATIONS = [0, 1, 2, 3, 5, 8, 12, 20, 30, 50, 80, 120]
_FRAME_S = {"rendered": 0.2, "paper": 0.08}  # about what a frame costs
_APPROACH_M = 33.0


def jobs_of(grid: Grid, dock: work.Dock, out: Path) -> list[Job]:
    """All jobs, in the order of the page."""
    return [
        *_table_1(grid, dock),
        *_distances(grid, dock),
        Job("figure-6", 5, work.swarm, (dock, grid.first_seed, SWARM_ITERATIONS)),
        Job("figure-7-and-11", 5, work.backtracking, (dock, grid.first_seed)),
        *_rendered(grid, dock, out),
        *_cold(grid, dock),
        *_envelope(grid, dock),
        *_point_level(grid, dock),
    ]


def _table_1(grid: Grid, dock: work.Dock) -> list[Job]:
    jobs = []
    for missing, spurious, clean_start in ROWS:
        for first in range(0, grid.trials, grid.trials_a_job):
            seeds = (grid.first_seed + first, grid.first_seed + min(first + grid.trials_a_job, grid.trials))
            name = f"table-1-{missing}-{spurious}{'-warm' * clean_start}-{seeds[0]}"
            arguments = (dock, missing, spurious, *seeds, clean_start)
            jobs.append(Job(name, 2.5 * (seeds[1] - seeds[0]), work.table_1, arguments))
    return jobs


def _distances(grid: Grid, dock: work.Dock) -> list[Job]:
    jobs = []
    for z in DISTANCES_M:
        for missing, spurious in FAULTS_AT_DISTANCE:
            settings = [f"path.z_m={z}", f"path.count={grid.draws}", "detections.rear_range_m=0.01"]
            settings += [f"faults.missing={missing}", f"faults.spurious={spurious}"]
            name = f"figure-9-10-{z:g}-{missing}-{spurious}"
            arguments = (dock, "missing-1", settings, grid.first_seed)
            jobs.append(Job(name, 0.02 * grid.draws, work.acquisition_trial, arguments))
    return jobs


def _rendered(grid: Grid, dock: work.Dock, out: Path) -> list[Job]:
    """Dockings and the search; of the first docking the pictures stay, for the page."""
    jobs = []
    for seed in range(grid.dockings):
        settings = [f"path.frame_interval_s={grid.docking_interval_s}"]
        arguments = (
            dock,
            "approach",
            settings,
            grid.first_seed + seed,
            str(out / "runs" / f"docking-{seed}"),
            seed == 0,
        )
        jobs.append(Job(f"docking-{seed}", _cost(_APPROACH_M / grid.docking_interval_s), work.docking, arguments))
    settings = [f"path.frame_interval_s={grid.search_interval_s}"]
    arguments = (dock, "rectangle", settings, grid.first_seed, str(out / "runs" / "search"), False)
    jobs.append(Job("search", _cost(63.0 / grid.search_interval_s), work.docking, arguments))
    return jobs + _shipped(grid, dock, out)


def _shipped(grid: Grid, dock: work.Dock, out: Path) -> list[Job]:
    """Shipped scenarios with a path, rendered: all of them, or on a coarser path those that the grid names."""
    names, interval = list(grid.shipped), [f"path.frame_interval_s={grid.envelope_interval_s}"]
    if grid.rendered_seeds:
        names, interval = [n for n in shipped_scenarios() if load_scenario(n).path.kind != "draws"], []
    return [
        Job(
            f"shipped-{name}-{seed}",
            _cost(_APPROACH_M / (0.15 if grid.rendered_seeds else grid.envelope_interval_s)),
            work.docking,
            (dock, name, interval, grid.first_seed + seed, str(out / "runs" / f"{name}-{seed}"), False),
        )
        for name in names
        for seed in range(max(grid.rendered_seeds, 1))
    ]


def _cost(frames: float) -> float:
    return frames * (_FRAME_S["rendered"] + _FRAME_S["paper"])


def _cold(grid: Grid, dock: work.Dock) -> list[Job]:
    settings = [f"path.count={grid.draws}"]
    return [
        Job(f"cold-{scenario}", 0.05 * grid.draws, work.acquisition_trial, (dock, scenario, settings, grid.first_seed))
        for scenario in COLD.values()
    ]


def _envelope(grid: Grid, dock: work.Dock) -> list[Job]:
    """Waters x exposures, then light from above, then other salt and heat where the simulator knows of them."""
    rows = [
        (f"water-{name}-{exposure:g}", [f"water.kind={name}", f"sensor.exposure_ms={exposure}"])
        for name in grid.waters
        for exposure in grid.exposures_ms
    ]
    rows += [(f"daylight-{light:g}", [f"daylight.surface_w_m2={light}"]) for light in grid.daylight_w_m2]
    rows.append(("salt-5-5", ["water.salinity_psu=5", "water.temperature_c=5"]))
    interval = f"path.frame_interval_s={grid.envelope_interval_s}"
    cost = _cost(_APPROACH_M / grid.envelope_interval_s)
    return [
        Job(f"envelope-{name.replace(' ', '-')}-{seed}", cost, work.envelope, (dock, [interval, *settings], seed))
        for name, settings in rows
        for seed in range(grid.first_seed, grid.first_seed + grid.envelope_seeds)
    ]


def _point_level(grid: Grid, dock: work.Dock) -> list[Job]:
    """Bare detections with the measured errors of the detector, for each shipped scenario with a path that has them."""
    jobs = []
    for name in shipped_scenarios():
        scenario = load_scenario(name)
        if scenario.path.kind == "draws" or not is_measured(scenario):
            continue
        settings = [f"detections.detector={measured_like(scenario)}"]
        jobs += [
            Job(f"point-{name}-{seed}", 2, work.campaign, (dock, name, settings, seed, seed + 1))
            for seed in range(grid.first_seed, grid.first_seed + grid.point_seeds)
        ]
    return jobs
