"""The vehicle's own sensors: slow entries, black-outs, sensors that lie, late stamps, and a dock that rocks.

Nominal dockings at a constant speed from z = 9 m on, at point level, two runs a row. Finished runs stay in
bench-out/aiding, from where the same command continues.
"""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bench.shipped import CAMERA_FILE
from lumidock import Config, Localizer, load_camera, load_station
from lumidock.alert_limits import AlertLimits
from lumidock.datatypes import Fix
from lumidock.reproduce.jobs import Job, run_jobs
from lumidock.sim.detections import SimulatedFrame, simulated_frames
from lumidock.sim.scenario import load_scenario, station_of

SEEDS = range(41000, 41002)
_NEAR_M = 3.0  # from where on the entry is counted
_FEW = (4, 5)  # lights in a frame
_RUN_S = 15.0
_START = ("path.start_z_m=9", "path.speed_spread_m_s=0")
_DARK = "detections.black_outs={at_s: [[12, 16], [18.5, 22.5], [26, 30]]}"
_LATE = "{late_s: 0.2, mount_deg: 3}"
_ROCKS = {"aiding": {"dock_motion": {"angle_deg": 1.4, "rate_deg_s": 1.5}}}


@dataclass(frozen=True)
class Case:
    """A row: speed m/s, frames a second, the sensors, and what else differs from nominal and from the defaults.

    A sensor lies from `wrong_s` on.
    """

    name: str
    speed: float = 0.35
    rate: float = 15.0
    sensors: str = ""
    more: tuple[str, ...] = ()
    config: dict[str, Any] | None = None
    wrong_s: float = 0.0

    def settings(self) -> tuple[str, ...]:
        """For the scenario `nominal`."""
        path = (f"path.speed_m_s={self.speed}", f"path.frame_interval_s={1.0 / self.rate:.7f}")
        sensors = (f"detections.aiding={{{self.sensors}}}",) if self.sensors else ()
        return (*_START, *path, *sensors, *self.more)


CASES = (
    Case("none", 1.0),
    Case("gyro", 1.0, sensors="gyro: {}"),
    Case("none", 0.35),
    Case("none, `track.accel_rad_s2` 0.01", 0.35, config={"track": {"accel_rad_s2": 0.01}}),
    Case("gyro", 0.35, sensors="gyro: {}"),
    Case("none", 0.2),
    Case("gyro", 0.2, sensors="gyro: {}"),
    Case("gyro", 0.35, 6.0, "gyro: {}"),
    Case("all four", sensors="gyro: {}, velocity: {}, depth: {}, tilt: {}"),
    Case("none, three black-outs of 4 s", more=(_DARK,)),
    Case("gyro and DVL, three black-outs of 4 s", sensors="gyro: {}, velocity: {}", more=(_DARK,)),
    Case("gyro, its bias 3 degrees/s", sensors="gyro: {wrong_bias: [0.03, -0.03, 0.03]}"),
    Case("gyro, its bias 3 degrees/s from 15 s on", sensors="gyro: {wrong_bias: [0.03, -0.03, 0.03], wrong_from_s: 15}",
         wrong_s=15.0),
    Case("gyro and DVL, its scale 30 % off", sensors="gyro: {}, velocity: {wrong_scale: 0.3}"),
    Case("gyro and DVL, its scale 30 % off from 15 s on",
         sensors="gyro: {}, velocity: {wrong_scale: 0.3, wrong_from_s: 15}", wrong_s=15.0),
    Case("the same, dark from 18.5 to 22.5 s", sensors="gyro: {}, velocity: {wrong_scale: 0.3, wrong_from_s: 15}",
         more=("detections.black_outs={at_s: [[18.5, 22.5]]}",), wrong_s=15.0),
    Case("gyro and DVL, 0.2 s late, mounts 3 degrees off", sensors=f"gyro: {_LATE}, velocity: {_LATE}"),
    Case("gyro and DVL, a dock that rocks by 2 degrees, stated", 0.35, 15.0, "gyro: {}, velocity: {}",
         ("path.rock_deg=2",), _ROCKS),
)  # fmt: skip


def run(case: dict[str, Any], seed: int) -> dict[str, Any]:
    """Counts of one run."""
    this = Case(**{**case, "more": tuple(case["more"])})
    scenario = load_scenario("nominal", this.settings())
    station, camera = load_station(station_of(scenario)), load_camera(CAMERA_FILE)
    localizer = Localizer(station, camera, Config.model_validate({**scenario.config, **(this.config or {})}))
    frames, fixes = list(simulated_frames(scenario, station, camera, seed)), []
    for frame in frames:
        for value in frame.aiding:
            localizer.aid(value)
        fixes.append(localizer.process_detections(frame.detections))
    return _counts(frames, fixes, station.alert_limits)


def _counts(frames: list[SimulatedFrame], fixes: list[Fix], limits: AlertLimits) -> dict[str, Any]:
    z = np.array([frame.T_dock_cam[2, 3] for frame in frames])
    t_s = np.array([frame.detections.t_ns * 1e-9 for frame in frames])
    valid, guide = np.array([fix.valid for fix in fixes]), np.array([fix.guide is not None for fix in fixes])
    few = np.isin([int((frame.light >= 0).sum()) for frame in frames], _FEW)
    dark = np.array([not len(frame.detections) for frame in frames])
    near = z <= _NEAR_M
    held = np.concatenate([t_s[near][:1], t_s[near & valid], t_s[near][-1:]])
    judged = [_judged(frame, fix, limits) for frame, fix in zip(frames, fixes, strict=True) if fix.valid]
    declined = [
        t for t, fix in zip(t_s.tolist(), fixes, strict=True) if any(use.state == "declined" for use in fix.aiding)
    ]
    return {
        "frames": len(frames),
        "near": [int(near.sum()), int((near & valid).sum())],
        "gap_s": float(np.diff(held).max()),
        "few": [int(few.sum()), int((few & guide).sum())],
        "dark": [int(dark.sum()), int((dark & valid).sum())],
        "over": sum(over for over, _, _ in judged),
        "misleading": sum(misleading for _, misleading, _ in judged),
        "nees": [len(judged), sum(nees for _, _, nees in judged)],
        "declined_s": declined[0] if declined else None,
    }


def _judged(frame: SimulatedFrame, fix: Fix, limits: AlertLimits) -> tuple[bool, bool, float]:
    """Whether a valid fix is off by more than its levels, and than the alert limits; its NEES by degrees of freedom."""
    assert fix.T_dock_cam is not None
    assert fix.protection is not None
    assert fix.covariance is not None
    D = fix.T_dock_cam[:3, :3] @ frame.T_dock_cam[:3, :3].T
    turned = 0.5 * np.array([D[2, 1] - D[1, 2], D[0, 2] - D[2, 0], D[1, 0] - D[0, 1]])
    error = np.concatenate([fix.T_dock_cam[:3, 3] - frame.T_dock_cam[:3, 3], turned])
    sizes = np.array([np.hypot(*error[:2]), abs(error[2]), np.linalg.norm(turned)])
    level = fix.protection
    alert = limits.of_pose(float(fix.T_dock_cam[2, 3]), level.axial_m)
    over = bool((sizes > (level.lateral_m, level.axial_m, level.angle_rad)).any())
    return over, bool((sizes > alert).any()), float(error @ np.linalg.solve(fix.covariance, error)) / 6.0


def main() -> tuple[dict[str, Any], list[str]]:
    """One row per case."""
    jobs = [
        Job(f"{number}-{seed}", _RUN_S, run, (asdict(case), seed))
        for number, case in enumerate(CASES)
        for seed in SEEDS
    ]
    results = run_jobs(jobs, Path("bench-out/aiding"), "aiding", workers=os.cpu_count() or 1)
    lines = [
        "| sensors | m/s | frames/s | valid, z 3 to -3 m, % | longest gap, s | guide with 4-5 lights, % "
        "| dark frames valid, % | NEES | declined after, s | over level | misleading | frames |",
        "|---" * 12 + "|",
    ]
    rows = [_row(case, [results[f"{number}-{seed}"] for seed in SEEDS]) for number, case in enumerate(CASES)]
    return {"runs": results}, lines + rows


def _row(case: Case, runs: list[dict[str, Any]]) -> str:
    def share(name: str) -> str:
        whole, part = (sum(run[name][k] for run in runs) for k in (0, 1))
        return f"{100.0 * part / whole:.1f}" if whole else ""

    frames, total = (sum(run["nees"][k] for run in runs) for k in (0, 1))
    times = sorted(run["declined_s"] - case.wrong_s for run in runs if run["declined_s"] is not None)
    said = f"{times[len(times) // 2]:.1f}, last {times[-1]:.1f}, in {len(times)} of {len(runs)}" if times else ""
    cells = [
        case.name,
        f"{case.speed:g}",
        f"{case.rate:g}",
        share("near"),
        f"{max(run['gap_s'] for run in runs):.2f}",
        share("few"),
        share("dark"),
        f"{total / frames:.2f}",
        said,
        *(str(sum(run[name] for run in runs)) for name in ("over", "misleading")),
        f"{sum(run['frames'] for run in runs):,}",
    ]
    return f"| {' | '.join(cells)} |"
