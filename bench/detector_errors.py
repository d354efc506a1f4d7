"""What the default detector does to lights, on rendered frames of every shipped docking: the table of `sim.measured`.

A run of each scenario whose lights look different, a frame every 0.6 s. Every light counts that shines into the picture
and is no fault of the scenario; one that does not stand out of the noise is missed, whatever detection is near. A
detection that belongs to no light is a false one.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bench.detection import matches
from bench.shipped import PACKAGE, shipped_camera, shipped_station
from lumidock import detect, layers
from lumidock.config import Config
from lumidock.datatypes import Array, Detections, Frame, Indices
from lumidock.report import page
from lumidock.reproduce.detector import detector_table
from lumidock.sim.frames import Shot
from lumidock.sim.measured import KINDS, TABLE, measured_table, same_picture
from lumidock.sim.scenario import Scenario, load_scenario, shipped_scenarios
from lumidock.sim.schedule import Schedule, exposed, schedule_of
from lumidock.sim.sequence import encoded
from lumidock.streams.images import decode_image

SEED, INTERVAL_S = 7300, 0.6
EDGES_M = (0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0)
_NEAR_PX = 6.0  # farther from its lamp a detection is a false one; less would hide the worst errors
_ON_PX = 1.0  # so near to a hot pixel, and not to its lamp, it is the hot pixel that is seen
_LEAST_SNR = 4.0
_KEPT = {"front": 150, "rear": 150, "false": 30}  # detections of a cell that are written down: of lights all, here


@dataclass
class Cell:
    """Lights of a kind in a band, or frames, those seen, and rows of sigma px, error over it, p_light and p_rear."""

    of: int = 0
    detections: list[list[float]] = field(default_factory=list)

    def as_dict(self, most: int) -> dict[str, Any]:
        """For the file: detections by rising error, false ones by p_light, thinned out evenly to `most`."""
        rows = sorted(self.detections, key=lambda row: row[1:3])
        if len(rows) > most:
            rows = [rows[i] for i in np.linspace(0, len(rows) - 1, most).round().astype(int)]
        kept = [[None if np.isnan(value) else float(f"{value:.3g}") for value in row] for row in rows]
        square = float(np.mean([row[1] ** 2 for row in self.detections])) if self.detections else 0.0
        return {"of": self.of, "seen": len(self.detections), "mean_square": float(f"{square:.3g}"), "detections": kept}


Cells = dict[str, list[Cell]]


def band(range_m: Array) -> np.ndarray:
    """The band of each range, of any shape."""
    return np.asarray(np.searchsorted(EDGES_M, range_m, side="right") - 1)


def add(cells: Cells, found: Detections, lit: Array, spurious: Array, hot: Array, dock_m: float) -> None:
    """Count one frame.

    `lit` (M, 5) are the lights' pixels, range m, whether rear and SNR; `spurious` (S, 2) px are other lamps, and `hot`
    (H, 2) px bad pixels.
    """
    shows = np.where(lit[:, 4:] > _LEAST_SNR, lit[:, :2], np.inf)
    owner = matches(found, np.concatenate([shows, spurious]), _NEAR_PX)
    for i in np.flatnonzero((owner >= 0) & (owner < len(lit))):
        at_light, at_hot = (np.linalg.norm(uv - found.uv[i], axis=1) for uv in (lit[owner[i], None, :2], hot))
        if at_light[0] > _NEAR_PX or at_hot.min(initial=np.inf) < _ON_PX < at_light[0]:
            owner[i] = -1
    for light in lit:
        cells["rear" if light[3] else "front"][band(light[2])].of += 1
    cells["false"][band(np.array(dock_m))].of += 1
    assert found.cov_px2 is not None
    for i, k in enumerate(owner):
        cov, says = found.cov_px2[i], [float(found.p_light[i]), float(found.p_rear[i])]
        sigma_px = float(np.sqrt(0.5 * np.trace(cov)))
        if k < 0:
            cells["false"][band(np.array(dock_m))].detections.append([sigma_px, 0.0, *says])
        elif k < len(lit):
            e = found.uv[i] - lit[k, :2]
            over = float(np.sqrt(e @ np.linalg.solve(cov, e)))
            along_px = float(np.linalg.norm(e)) / over if over > 0.0 else sigma_px  # of a covariance that is no circle
            cells["rear" if lit[k, 3] else "front"][band(lit[k, 2])].detections.append([along_px, over, *says])


def measure(scenario: Scenario) -> Cells:
    """Cells of one run."""
    station, camera, config = shipped_station(), shipped_camera(), Config()
    rear = station.layer != station.layers.index(station.layers_front_to_rear()[0])
    cells: Cells = {kind: [Cell() for _ in EDGES_M] for kind in KINDS}
    scan: detect.Scan | None = None
    plan = exposed(schedule_of(scenario, station, camera, SEED))
    hot = plan.studio(0).hot_at[::-1].T
    for dock_m, frame, shot, dark in _frames(plan):
        scan = scan or detect.Scan(frame, config.detect)
        found = layers.label(frame, detect.lights(frame, config.detect, scan), config.label)
        seen, m = shot.seen, len(station)
        lamps = seen.lit[:m] & ~np.isin(np.arange(m), dark)
        range_m = np.linalg.norm(seen.p_cam[:m], axis=1)
        lit = np.column_stack([seen.uv[:m], range_m, rear, shot.snr[:m]])[lamps]
        add(cells, found, lit, seen.uv[seen.kind == "injected"], hot, dock_m)
    return cells


def _frames(plan: Schedule) -> Iterator[tuple[float, Frame, Shot, Indices]]:
    """Range of the dock m, picture, what was exposed and the dark lights of each frame."""
    for k, T_dock_cam in enumerate(plan.course.T_dock_cam):
        moment, studio = plan.moment(k), plan.studio(k)
        shot = studio.shoot(moment)
        image = studio.develop(shot, np.random.Generator(np.random.SFC64([plan.seed, 9, k])))
        picture = decode_image(encoded(image, plan.scenario.output), k)  # as the simulator's files hold it
        frame = Frame(f"{k:06d}", int(plan.course.t_ns[k]), picture)
        yield float(np.linalg.norm(T_dock_cam[:3, 3])), frame, shot, moment.dark


def distinct() -> dict[str, Scenario]:
    """Shipped scenarios with a path whose lights look different, the plain approach first."""
    chosen: dict[str, Scenario] = {}
    for name in ("approach", *shipped_scenarios()):
        scenario = load_scenario(name, (f"path.frame_interval_s={INTERVAL_S}",))
        if scenario.path.kind != "draws" and not any(same_picture(scenario, other) for other in chosen.values()):
            chosen[name] = scenario
    return chosen


def main() -> tuple[dict[str, object], list[str]]:
    """Measure all, write the table into the package, and sum it up: a row a scenario."""
    write({name: as_dict(measure(scenario)) for name, scenario in distinct().items()})
    return measured_table(), page.markdown(detector_table()).splitlines()


def as_dict(cells: Cells) -> dict[str, Any]:
    """For the file."""
    return {kind: [cell.as_dict(_KEPT[kind]) for cell in row] for kind, row in cells.items()}


def write(measured: dict[str, Any]) -> None:
    """Put the table into the package, a line a scenario."""
    about = f"Seed {SEED}, one run a scenario, a frame every {INTERVAL_S} s."
    rows = [f"{json.dumps(name)}: {json.dumps(value, separators=(',', ':'))}" for name, value in measured.items()]
    head = f'{{"about": {json.dumps(about)},\n"edges_m": {json.dumps(EDGES_M)},\n"scenarios": {{\n'
    (PACKAGE / "sim" / TABLE).write_text(head + ",\n".join(rows) + "\n}}\n", encoding="utf-8")
