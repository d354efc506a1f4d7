"""Whole rendered dockings through the default method, one a water: from where on there is a guide and a pose, and gaps.

Every third frame of the camera's 6.7 a second, so that the table takes minutes.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from bench.detection import simulate
from bench.shipped import CAMERA_FILE, STATION_FILE, shipped_camera, shipped_station
from lumidock.config import Config
from lumidock.localizer import Localizer
from lumidock.metrics import evaluate, read_rows, true_poses
from lumidock.run import Setup, run
from lumidock.streams.runfolder import RunFolder
from lumidock.streams.sources import open_source

SEED, INTERVAL_S = 7200, 0.45
WATERS = {
    "III, 2 ms": "approach",
    "clear IB": "water-ib",
    "pool": "pool",
    "coastal 1C, 6 ms": "water-1c",
    "bright": "shallow",
    "fouled": "fouling",
    "headlamp": "headlamp",
}
_NEAR_M = (5.0, 7.0)


def docking(scenario: str, seed: int) -> dict[str, float]:
    """Figures of one run: z of the first guide and of three valid poses in a row, gaps after, errors, hazards."""
    with TemporaryDirectory() as name:
        sequence, out = Path(name) / "s", Path(name) / "run"
        simulate(scenario, seed, sequence, f"path.frame_interval_s={INTERVAL_S}")
        setup = Setup("lumidock", False, Config(), STATION_FILE, CAMERA_FILE)
        station = shipped_station()
        with RunFolder(out, station.ids) as folder:
            (out / "station.yaml").write_bytes(STATION_FILE.read_bytes())
            run(open_source(sequence), Localizer(station, shipped_camera()), folder, setup)
        return _figures(out, sequence) | _judged(evaluate(out, sequence))


def _figures(run_folder: Path, sequence: Path) -> dict[str, float]:
    at = {name: T_dock_cam[:3, 3] for name, T_dock_cam in true_poses(sequence).items()}
    fixes = read_rows(run_folder / "fixes.csv", ("frame", "valid", "guide", "range_m"))
    known = [row for row in fixes if row["frame"] in at]
    valid = np.array([row["valid"] == "1" for row in known])
    z = np.array([at[row["frame"]][2] for row in known])
    guides = [at[row["frame"]][2] for row in known if row["guide"] == "1"]
    three = np.flatnonzero(valid[:-2] & valid[1:-1] & valid[2:])
    gap = longest = 0
    for held in valid[three[0] :] if len(three) else ():
        gap = 0 if held else gap + 1
        longest = max(longest, gap)
    ranges = [
        float(row["range_m"]) - float(np.linalg.norm(at[row["frame"]]))
        for row in known
        if row["range_m"] and _NEAR_M[0] <= at[row["frame"]][2] <= _NEAR_M[1]
    ]
    return {
        "first_guide_m": float(max(guides, default=np.nan)),
        "first_valid_m": float(z[three[0]]) if len(three) else float("nan"),
        "last_valid_m": float(z[valid].min()) if valid.any() else float("nan"),
        "longest_gap": float(longest),
        "range_mean_mm": 1e3 * float(np.mean(ranges)) if ranges else float("nan"),
        "range_95_mm": 1e3 * float(np.percentile(np.abs(ranges), 95)) if ranges else float("nan"),
    }


def _judged(result: dict[str, object]) -> dict[str, float]:
    """How many fixes mislead and how many names are wrong."""
    labels = result.get("labels")
    wrong = float(labels["wrong"]) if isinstance(labels, dict) else float("nan")
    hazards = result["hazardous"]
    assert isinstance(hazards, dict)
    return {"wrong": wrong, "hazardous": float(hazards["valid"]["any"] + hazards["guide"]["any"])}


def main() -> tuple[dict[str, object], list[str]]:
    """One row a water."""
    names = ("first guide, z m", "three valid, z m", "last valid, z m", "frames missed in a row after")
    names = (*names, "range error 5-7 m, mean / 95 %, mm", "wrong names", "hazardous")
    lines = ["| water | " + " | ".join(names) + " |", "|---" * (len(names) + 1) + "|"]
    content: dict[str, object] = {}
    for water, scenario in WATERS.items():
        f = docking(scenario, SEED)
        content[water] = f
        lines.append(
            f"| {water} | {f['first_guide_m']:.1f} | {f['first_valid_m']:.1f} | {f['last_valid_m']:.2f} | "
            f"{f['longest_gap']:.0f} | {f['range_mean_mm']:.1f} / {f['range_95_mm']:.1f} | {f['wrong']:.0f} | "
            f"{f['hazardous']:.0f} |"
        )
    lines += ["", f"One run a water, seed {SEED}, a frame every {INTERVAL_S} s of the {1 / 0.15:.1f} a second."]
    return content, lines
