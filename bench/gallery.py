"""What the shipped docks give with lights dead: by the bound, and followed by the default method.

The bound is that of `lumidock station check` at 0.2 m/s, in the water of each dock's design file. Dockings are
simulated bare detections at 0.35 m/s in the same water, with errors of survey and calibration and as many lights dead,
drawn anew each run, as the design file says.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import groupby

import numpy as np

from bench.shipped import PACKAGE, shipped_camera
from lumidock.config import Config
from lumidock.evaluation.dead_lights import dead_sets, least_confusion_m, strength
from lumidock.localizer import Localizer
from lumidock.setup.design import Spec, approach_of, load_spec
from lumidock.sim.detections import simulated_frames
from lumidock.sim.scenario import load_scenario
from lumidock.station import Station, load_station

# the shipped cage of the paper is judged by what is asked of the designed one of as many lights
DOCKS = {
    "cage-2x2x5": "cage-13",
    "cage-13": "cage-13",
    "cage-9": "cage-9",
    "ring-8": "ring-8",
    "rov-5": "rov-5",
    "funnel-plate-10": "funnel-plate-10",
}
SEEDS = range(9800, 9802)
_STEP_HZ = 1.0  # of the bound: 0.2 m
_FARTHEST_M = 30.0
_SPEED_M_S, _FRAME_S = 0.35, 1.0 / 15.0
_IN_A_ROW = 3  # valid poses: one alone is no beginning
_HEADS = (
    "dock | lights | judged from z to z, m | worst level over limit: all lit | any one dead | any two dead |"
    " least confusion, m | dead in the dockings | first valid, m | longest gap, s"
)


def main() -> tuple[dict[str, object], list[str]]:
    """One row a dock."""
    lines = [f"| {_HEADS} |", "|---" * (_HEADS.count("|") + 1) + "|"]
    content: dict[str, object] = {}
    for name, asked in DOCKS.items():
        station = load_station(PACKAGE / "stations" / f"{name}.yaml")
        spec = load_spec(PACKAGE / "stations" / "designs" / f"{asked}.yaml")
        worst = _worst(station, spec)
        confusion = min(least_confusion_m(station, np.deg2rad(spec.roll_deg)).values())
        runs = [_docking(station, spec, seed) for seed in SEEDS]
        first, gap = float(np.median([run[0] for run in runs])), max(run[1] for run in runs)
        content[name] = {"worst": worst, "confusion_m": confusion, "dockings": runs}
        ratios = " | ".join([*(f"{ratio:.2f} at {z:.1f}" for ratio, z in worst), *[""] * (3 - len(worst))])
        between = f"{spec.from_z_m:g} to {station.docking_point[2]:g}"
        followed = f"{spec.dead} | {first:.1f} | {gap:.2f}"
        lines.append(f"| {name} | {len(station)} | {between} | {ratios} | {confusion:.3f} | {followed} |")
    return content, lines


def _worst(station: Station, spec: Spec) -> list[tuple[float, float]]:
    """The worst ratio and its z with none, any one, ... any `spec.dead` lights dead."""
    out = []
    for size in range(spec.dead + 1):
        sets = [dead for dead in dead_sets(len(station), size) if len(dead) == size]
        approach = replace(approach_of(spec, station), step_hz=_STEP_HZ)
        judged = strength(station, shipped_camera(), Config(), approach, sets)
        at = int(judged.ratio.argmax())
        out.append((float(judged.ratio[at]), float(judged.z_m[at])))
    return out


def _docking(station: Station, spec: Spec, seed: int) -> tuple[float, float]:
    """Where three valid poses in a row begin, m, and the longest time without one from there on, s; 0 for none."""
    layers = [station.lights_of(layer) for layer in station.layers_front_to_rear()]
    reach = [spec.reach_m[station.color[int(lights[0])]] for lights in (layers[0], layers[-1])]
    settings = (
        f"path.start_z_m={_FARTHEST_M}",
        f"path.end_z_m={station.docking_point[2]}",
        f"path.speed_m_s={_SPEED_M_S}",
        f"path.frame_interval_s={_FRAME_S}",
        f"detections.front_range_m={reach[0]}",
        f"detections.rear_range_m={reach[1]}",
        f"detections.dead=[{spec.dead},{spec.dead}]",
        "detections.survey=true",
        "detections.calibration=true",
    )
    localizer, valid, z = Localizer(station, shipped_camera()), list[bool](), list[float]()
    for frame in simulated_frames(load_scenario("approach", settings), station, localizer.camera, seed):
        valid.append(localizer.process_detections(frame.detections).valid)
        z.append(float(frame.T_dock_cam[2, 3]))
    first = next((k for k in range(len(valid)) if all(valid[k : k + _IN_A_ROW])), None)
    if first is None:
        return 0.0, 0.0
    longest = max((len(list(run)) for ok, run in groupby(valid[first:]) if not ok), default=0)
    return z[first], longest * _FRAME_S
