"""Every shipped docking, rendered in full, through the default method: where guide and pose begin, and gaps.

All frames at 6.7 a second, two seeds per docking, on the station of the scenario: an hour of one core. Finished
dockings stay in bench-out/dockings, from where the same command continues.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from bench.shipped import CAMERA_FILE
from lumidock.config import Config
from lumidock.evaluation.metrics import read_rows, true_poses
from lumidock.reproduce import Dock, work
from lumidock.reproduce.jobs import Job, run_jobs
from lumidock.sim.scenario import load_scenario, shipped_scenarios, station_of

SEEDS = (7300, 7301)
_NEAR_M = (5.0, 7.0)
_RUN_S = 60.0
_COLUMNS = (
    "first guide, z m",
    "three valid, z m",
    "last valid, z m",
    "longest gap in valid after, s (from z m)",
    "range error 5-7 m, mean / 95 %, mm",
    "wrong identities",
    "valid",
    "hazardous",
)


def docking(scenario: str, seed: int, folder: str) -> dict[str, Any]:
    """Figures of one docking: z of the first guide and of three consecutive valid poses, gaps, errors, hazards."""
    place, station_file = Path(folder), station_of(load_scenario(scenario))
    simulation = work.Simulation(Dock(str(station_file), str(CAMERA_FILE)), scenario, (), seed)
    judged = work.docking(simulation, folder, False, ("lumidock",), Config())["lumidock"]
    figures = _figures(place / "lumidock", place / "sequence")
    shutil.rmtree(place)
    hazards = judged["hazardous"]
    return figures | {
        "frames": judged["frames"],
        "valid": judged["valid"],
        "guide": judged["guide"],
        "wrong": judged["identities"]["wrong"],
        "hazardous": hazards["valid"]["any"] + hazards["guide"]["any"],
    }


def _figures(run_folder: Path, sequence: Path) -> dict[str, float]:
    at = {name: T_dock_cam[:3, 3] for name, T_dock_cam in true_poses(sequence).items()}
    fixes = read_rows(run_folder / "fixes.csv", ("frame", "t_ns", "valid", "guide", "range_m"))
    known = [row for row in fixes if row["frame"] in at]
    valid = np.array([row["valid"] == "1" for row in known])
    z = np.array([at[row["frame"]][2] for row in known])
    guides = [at[row["frame"]][2] for row in known if row["guide"] == "1"]
    three = np.flatnonzero(valid[:-2] & valid[1:-1] & valid[2:])
    held = three[0] + np.flatnonzero(valid[three[0] :]) if len(three) else three
    gaps_s = np.diff([int(known[k]["t_ns"]) * 1e-9 for k in held])
    longest = int(np.argmax(gaps_s)) if len(gaps_s) else None
    ranges = [
        float(row["range_m"]) - float(np.linalg.norm(at[row["frame"]]))
        for row in known
        if row["range_m"] and _NEAR_M[0] <= at[row["frame"]][2] <= _NEAR_M[1]
    ]
    return {
        "first_guide_m": float(max(guides, default=np.nan)),
        "first_valid_m": float(z[three[0]]) if len(three) else float("nan"),
        "last_valid_m": float(z[valid].min()) if valid.any() else float("nan"),
        "longest_gap_s": float("nan") if longest is None else float(gaps_s[longest]),
        "gap_at_m": float("nan") if longest is None else float(z[held[longest]]),
        "range_mean_mm": 1e3 * float(np.mean(ranges)) if ranges else float("nan"),
        "range_95_mm": 1e3 * float(np.percentile(np.abs(ranges), 95)) if ranges else float("nan"),
    }


def main() -> tuple[dict[str, object], list[str]]:
    """One row per docking with all seeds in each cell, and the sum over all."""
    names = [name for name in shipped_scenarios() if load_scenario(name).path.kind != "draws"]
    out = Path("bench-out/dockings")
    jobs = [
        Job(f"{name}-{seed}", _RUN_S, docking, (name, seed, str(out / "runs" / f"{name}-{seed}")))
        for name in names
        for seed in SEEDS
    ]
    results = run_jobs(jobs, out, "shipped", workers=os.cpu_count() or 1)
    lines = ["| docking | " + " | ".join(_COLUMNS) + " |", "|---" * (len(_COLUMNS) + 1) + "|"]
    lines += [_row(name, [results[f"{name}-{seed}"] for seed in SEEDS]) for name in names]
    total = {key: sum(result[key] for result in results.values()) for key in ("frames", "valid", "guide", "hazardous")}
    lines += [
        "",
        f"Seeds {SEEDS[0]} and {SEEDS[1]}, one after the other in each cell: {total['frames']:,} frames, "
        f"{total['guide']:,} guided, {total['valid']:,} valid, {total['hazardous']} hazardous.",
    ]
    return {"total": total, **results}, lines


def _row(name: str, runs: list[dict[str, Any]]) -> str:
    cells = [
        [f"{run['first_guide_m']:.1f}" for run in runs],
        [f"{run['first_valid_m']:.1f}" for run in runs],
        [f"{run['last_valid_m']:.2f}" for run in runs],
        [f"{run['longest_gap_s']:.2f} ({run['gap_at_m']:.1f})" for run in runs],
        [f"{run['range_mean_mm']:.1f} / {run['range_95_mm']:.1f}" for run in runs],
        *([str(run[key]) for run in runs] for key in ("wrong", "valid", "hazardous")),
    ]
    return f"| {name} | " + " | ".join("; ".join(cell) for cell in cells).replace("nan / nan", "-") + " |"
