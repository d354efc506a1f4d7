"""Measures the errors of the default detector on rendered frames of every shipped docking: the table of `sim.measured`.

One run of each scenario whose images of lights differ, with a frame every 0.6 s, on the station of the scenario. Every
light counts that is in view and not dark. A light below the noise counts as missed even if a detection is near. A
detection that is of no lamp is a false one.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bench.detection import matches
from bench.shipped import PACKAGE, shipped_camera
from lumidock import detect, layers
from lumidock.config import Config
from lumidock.datatypes import Array, Detections, Frame, Indices
from lumidock.report import page
from lumidock.reproduce.detector import detector_table
from lumidock.sim.draws import Draw
from lumidock.sim.frames import ExpectedFrame
from lumidock.sim.measured import KINDS, TABLE, measured_table, same_picture
from lumidock.sim.scenario import Scenario, load_scenario, shipped_scenarios, station_of
from lumidock.sim.schedule import Schedule, schedule_of, with_auto_exposure
from lumidock.sim.sequence import encoded
from lumidock.station import load_station
from lumidock.streams.images import decode_image

SEED, INTERVAL_S = 7300, 0.6
EDGES_M = (0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0)
_NEAR_PX = 6.0  # a detection farther from its lamp is a false one; a smaller value would hide the worst errors
_ON_PX = 1.0  # a detection this near to a hot pixel, and not to its lamp, is of the hot pixel
_LEAST_SNR = 4.0
_KEPT = {"front": 150, "rear": 150, "false": 30}  # most detections of a cell in the file; of lights these are all


@dataclass
class Cell:
    """Number `of` lights (or frames) of a cell; of each detection sigma px, error over sigma, p_light and p_rear."""

    of: int = 0
    detections: list[list[float]] = field(default_factory=list)

    def as_dict(self, most: int) -> dict[str, Any]:
        """The entry of the file: at most `most` detections, evenly chosen in the order of error or p_light."""
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

    `lit` (M, 5): pixels, range m, whether of the rear layer, and SNR of the lights; `spurious` (S, 2) px: other lamps;
    `hot` (H, 2) px: hot pixels; `dock_m`: range of the dock.
    """
    visible_uv = np.where(lit[:, 4:] > _LEAST_SNR, lit[:, :2], np.inf)
    owner = matches(found, np.concatenate([visible_uv, spurious]), _NEAR_PX)
    for i in np.flatnonzero((owner >= 0) & (owner < len(lit))):
        at_light, at_hot = (np.linalg.norm(uv - found.uv[i], axis=1) for uv in (lit[owner[i], None, :2], hot))
        if at_light[0] > _NEAR_PX or at_hot.min(initial=np.inf) < _ON_PX < at_light[0]:
            owner[i] = -1
    for light in lit:
        cells["rear" if light[3] else "front"][band(light[2])].of += 1
    cells["false"][band(np.array(dock_m))].of += 1
    assert found.cov_px2 is not None
    for i, k in enumerate(owner):
        cov, labels = found.cov_px2[i], [float(found.p_light[i]), float(found.p_rear[i])]
        sigma_px = float(np.sqrt(0.5 * np.trace(cov)))
        if k < 0:
            cells["false"][band(np.array(dock_m))].detections.append([sigma_px, 0.0, *labels])
        elif k < len(lit):
            e = found.uv[i] - lit[k, :2]
            over = float(np.sqrt(e @ np.linalg.solve(cov, e)))
            along_px = float(np.linalg.norm(e)) / over if over > 0.0 else sigma_px  # in the direction of the error
            cells["rear" if lit[k, 3] else "front"][band(lit[k, 2])].detections.append([along_px, over, *labels])


def measure(scenario: Scenario) -> Cells:
    """Cells of one run on the station of the scenario."""
    station, camera, config = load_station(station_of(scenario)), shipped_camera(), Config()
    rear = station.layer != station.layers.index(station.layers_front_to_rear()[0])
    cells: Cells = {kind: [Cell() for _ in EDGES_M] for kind in KINDS}
    scan: detect.Scan | None = None
    schedule = with_auto_exposure(schedule_of(scenario, station, camera, SEED))
    hot = schedule.renderer(0).hot_at[::-1].T
    for dock_m, frame, expected, dark in _frames(schedule):
        scan = scan or detect.Scan(frame, config.detect)
        found = layers.label(frame, detect.lights(frame, config.detect, scan), config.label)
        seen, m = expected.emitters, len(station)
        lamps = seen.lit[:m] & ~np.isin(np.arange(m), dark)
        range_m = np.linalg.norm(seen.p_cam[:m], axis=1)
        lit = np.column_stack([seen.uv[:m], range_m, rear, expected.snr[:m]])[lamps]
        add(cells, found, lit, seen.uv[seen.kind == "injected"], hot, dock_m)
    return cells


def _frames(schedule: Schedule) -> Iterator[tuple[float, Frame, ExpectedFrame, Indices]]:
    """For each frame the range m of the dock, the picture, its expected electrons, and the dark lights."""
    for k, T_dock_cam in enumerate(schedule.course.T_dock_cam):
        conditions, renderer = schedule.conditions(k), schedule.renderer(k)
        expected = renderer.expect(conditions)
        image = renderer.picture_of(
            expected, np.random.Generator(np.random.SFC64([schedule.seed, Draw.SENSOR_NOISE, k]))
        )
        picture = decode_image(encoded(image, schedule.scenario.output), k)  # as the simulator's files hold it
        frame = Frame(f"{k:06d}", int(schedule.course.t_ns[k]), picture)
        yield float(np.linalg.norm(T_dock_cam[:3, 3])), frame, expected, conditions.dark


def distinct() -> dict[str, Scenario]:
    """Shipped scenarios with a path whose images of lights differ, the plain approach first."""
    chosen: dict[str, Scenario] = {}
    for name in ("approach", *shipped_scenarios()):
        scenario = load_scenario(name, (f"path.frame_interval_s={INTERVAL_S}",))
        if scenario.path.kind != "draws" and not any(same_picture(scenario, other) for other in chosen.values()):
            chosen[name] = scenario
    return chosen


def main() -> tuple[dict[str, object], list[str]]:
    """Measure all, write the table into the package, and summarize it, one row per scenario."""
    write({name: as_dict(measure(scenario)) for name, scenario in distinct().items()})
    return measured_table(), page.markdown(detector_table()).splitlines()


def as_dict(cells: Cells) -> dict[str, Any]:
    """The entry of one scenario in the file."""
    return {kind: [cell.as_dict(_KEPT[kind]) for cell in row] for kind, row in cells.items()}


def write(measured: dict[str, Any]) -> None:
    """Write the table into the package, one line per scenario."""
    about = f"Seed {SEED}, one run per scenario, a frame every {INTERVAL_S} s."
    rows = [f"{json.dumps(name)}: {json.dumps(value, separators=(',', ':'))}" for name, value in measured.items()]
    head = f'{{"about": {json.dumps(about)},\n"edges_m": {json.dumps(EDGES_M)},\n"scenarios": {{\n'
    (PACKAGE / "sim" / TABLE).write_text(head + ",\n".join(rows) + "\n}}\n", encoding="utf-8")
