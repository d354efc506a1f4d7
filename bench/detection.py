"""Detections before any association, over rendered sequences: recall, false lamps, centres and their covariances."""

from __future__ import annotations

import csv
import subprocess
import sys
from collections import defaultdict
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from bench.shipped import shipped_camera, shipped_station
from lumidock import detect, layers
from lumidock.config import Config
from lumidock.datatypes import Array, Detections, Frame
from lumidock.localizer import Localizer
from lumidock.sim.scenario import shipped_scenarios
from lumidock.streams.sources import open_source

_SCENARIOS = ("approach", "water-1c", "shallow", "headlamp", "fouling", "pool", "snow")
_SEED, _INTERVAL_S = 7511, 0.75
_NEAR_PX, _SAME_PX = 2.5, 6.0
_SNRS = (8.0, 12.0, 50.0)
_FEW = 10  # lights of a kind that say too little
_RUNS = 6
_NEAR_SIX = ("path.start_z_m=6.6", "path.end_z_m=5.4", "path.frame_interval_s=0.15")
Rows = dict[str, list[dict[str, str]]]


def by_frame(path: Path) -> Rows:
    """Rows of a table by frame."""
    rows: Rows = defaultdict(list)
    with path.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            rows[row["frame"]].append(row)
    return rows


def matches(found: Detections, uv: Array, near_px: float = _NEAR_PX) -> np.ndarray:
    """Index (N,) of the lamp, of those at pixels `uv` (M, 2), that made each detection; -1: none. Nearest first."""
    owner = np.full(len(found), -1)
    if not len(uv) or not len(found):
        return owner
    distance = np.linalg.norm(found.uv[:, None] - uv[None], axis=2)
    reach = np.maximum(near_px, 0.5 * found.radius_px)[:, None]
    distance[distance > reach] = np.inf
    while np.isfinite(distance).any():
        i, k = np.unravel_index(distance.argmin(), distance.shape)
        owner[i], distance[i], distance[:, k] = k, np.inf, np.inf
    return owner


def measure(folder: Path) -> dict[str, float]:
    """Figures of one sequence folder with truth."""
    truth, apart = by_frame(folder / "lights_truth.csv"), by_frame(folder / "spurious_truth.csv")
    config = Config()
    seen = dict.fromkeys(_SNRS, 0)
    wanted = dict.fromkeys(_SNRS, 0)
    lamps_low, false, false_apart, frames, detections = 0, 0, 0, 0, 0
    errors: dict[str, list[float]] = defaultdict(list)
    nees: dict[str, list[float]] = defaultdict(list)
    rear: list[bool] = []
    scan: detect.Scan | None = None
    for frame in open_source(folder).items():
        if not isinstance(frame, Frame):
            continue
        scan = scan or detect.Scan(frame, config.detect)
        found = layers.label(frame, detect.lights(frame, config.detect, scan), config.label)
        lit = [row for row in truth[frame.name] if float(row["snr"] or 0) > 4.0]
        lit_uv = np.array([[float(row["u_px"]), float(row["v_px"])] for row in lit]).reshape(-1, 2)
        owner = matches(found, lit_uv)
        frames, detections = frames + 1, detections + len(found)
        snr = np.array([float(row["snr"]) for row in lit])
        for least in _SNRS:
            wanted[least] += int((snr > least).sum())
            seen[least] += int((snr[owner[owner >= 0]] > least).sum())
        others = np.array([[float(r["u_px"]), float(r["v_px"])] for r in apart[frame.name]]).reshape(-1, 2)
        for i in np.flatnonzero((owner < 0) & (found.p_light > 0.5)):
            known = len(others) and np.linalg.norm(others - found.uv[i], axis=1).min() < _SAME_PX + found.radius_px[i]
            false_apart, false = false_apart + bool(known), false + (not known)
        assert found.cov_px2 is not None
        for i in np.flatnonzero(owner >= 0):
            row = lit[owner[i]]
            lamps_low += found.p_light[i] < 0.5 and float(row["snr"]) > 12.0
            kind = ("blue" if row["light"].startswith("R") else "white") + _size_kind(
                frame, found, i, float(row["snr"])
            )
            e = found.uv[i] - (float(row["u_px"]), float(row["v_px"]))
            errors[kind].append(float(np.hypot(*e)))
            nees[kind].append(float(e @ np.linalg.solve(found.cov_px2[i], e)))
            if np.isfinite(found.p_rear[i]):
                rear.append((found.p_rear[i] > 0.5) == row["light"].startswith("R"))
    figures = {f"recall>{least:g}": 100.0 * seen[least] / max(wanted[least], 1) for least in _SNRS}
    figures |= {"false": false / frames, "apart": false_apart / frames, "detections": detections / frames}
    figures |= {"lamps with p<0.5": lamps_low / frames, "layer right": float(np.mean(rear)) if rear else float("nan")}
    for kind in sorted(errors):
        e, n = np.array(errors[kind]), np.array(nees[kind])
        figures[f"{kind}: rms"] = float(np.sqrt((e**2).mean()))
        figures[f"{kind}: median"] = float(np.median(e))
        figures[f"{kind}: 95"] = float(np.percentile(e, 95))
        figures[f"{kind}: nees/2"] = float(n.mean() / 2.0)
        figures[f"{kind}: med nees"] = float(np.median(n) / 1.386)
        figures[f"{kind}: n"] = len(e)
    return figures


def range_errors_mm(folder: Path) -> list[float]:
    """Errors of the range in each frame that gives a pose without history."""
    localizer = Localizer(shipped_station(), shipped_camera(), cold=True)
    truth, errors = by_frame(folder / "truth.csv"), []
    for frame in open_source(folder).items():
        fix = localizer.process(frame) if isinstance(frame, Frame) else None
        if fix is not None and fix.T_dock_cam is not None:
            (row,) = truth[fix.frame]
            at = np.array([float(row[axis]) for axis in ("x_m", "y_m", "z_m")])
            errors.append(1e3 * float(np.linalg.norm(fix.T_dock_cam[:3, 3]) - np.linalg.norm(at)))
    return errors


def _size_kind(frame: Frame, found: Detections, i: int, snr: float) -> str:
    u, v = np.rint(found.uv[i]).astype(int)
    r = 1
    part = frame.image[max(v - r, 0) : v + r + 1, max(u - r, 0) : u + r + 1]
    if part.size and part.max() >= 0.98 * np.iinfo(frame.image.dtype).max:
        return " saturated"
    return " >50" if snr > 50.0 else " 20-50" if snr > 20.0 else " <20"


def simulate(scenario: str, seed: int, out: Path, *settings: str) -> None:
    """Render a thinned-out run of a scenario."""
    command = [sys.executable, "-m", "lumidock", "sim", scenario, "--seed", str(seed), "--out", str(out)]
    for setting in (f"path.frame_interval_s={_INTERVAL_S}", *settings):
        command += ["--set", setting]
    subprocess.run(command, check=True, capture_output=True)


def main() -> tuple[dict[str, object], list[str]]:
    """One row a scenario."""
    content: dict[str, object] = {}
    for scenario in (name for name in _SCENARIOS if name in shipped_scenarios()):
        with TemporaryDirectory() as name:
            simulate(scenario, _SEED, Path(name) / "s")
            content[scenario] = measure(Path(name) / "s")
    columns = ("recall>12", "recall>8", "false", "apart", "detections")
    names = ("found, SNR > 12, %", "> 8, %", "false", "glints, snow, ...", "all detections")
    lines = ["| scenario | " + " | ".join(names) + " |", "|---" * (len(columns) + 1) + "|"]
    for scenario, figures in content.items():
        assert isinstance(figures, dict)
        lines.append(f"| {scenario} | " + " | ".join(f"{figures[c]:.2f}" for c in columns) + " |")
    kinds = [f"{color} {kind}" for color in ("white", "blue") for kind in ("saturated", ">50", "20-50", "<20")]
    lines += ["", "| centres, px rms (NEES / 2, its median / 1.39) | " + " | ".join(kinds) + " |"]
    lines.append("|---" * (len(kinds) + 1) + "|")
    for scenario, figures in content.items():
        assert isinstance(figures, dict)
        lines.append(f"| {scenario} | " + " | ".join(_centres(figures, kind) for kind in kinds) + " |")
    errors: list[float] = []
    for seed in range(_SEED, _SEED + _RUNS):
        with TemporaryDirectory() as name:
            simulate("water-1c", seed, Path(name) / "s", *_NEAR_SIX)
            errors += range_errors_mm(Path(name) / "s")
    mean, most = float(np.mean(errors)), float(np.percentile(np.abs(errors), 95))
    content["range_mm"] = {"frames": len(errors), "mean": mean, "95": most}
    said = f"mean {mean:.1f} mm, 95 % {most:.1f} mm, of {len(errors)} frames"
    lines += ["", f"Range from 6.6 to 5.4 m in 1C water, each frame without history: error {said}."]
    return content, lines


def _centres(figures: dict[str, float], kind: str) -> str:
    if figures.get(f"{kind}: n", 0) < _FEW:
        return ""
    rms, nees, median = (figures[f"{kind}: {name}"] for name in ("rms", "nees/2", "med nees"))
    return f"{rms:.2f} ({nees:.2f}, {median:.2f})"
