"""Range at which the matched-filter SNR of each layer is 8, by water and exposure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bench.shipped import shipped_camera, shipped_station
from lumidock.sim.scenario import R_DOCK_CAM_HEAD_ON, load_scenario
from lumidock.sim.schedule import schedule_of
from lumidock.station import Station

WATERS = ("IB", "II", "III", "1C", "3C", "5C", "7C", "pool-clear", "pool-murky")
EXPOSURES_MS = (0.5, 2.0, 6.0)
_SNR, _REACH_M = 8.0, (0.5, 120.0)


def snr(settings: tuple[str, ...], station: Station, layer: str, range_m: float) -> float:
    """Median matched-filter SNR of a layer's lights; the camera is head-on, `range_m` from the layer's middle."""
    lights = station.lights_of(layer)
    schedule = schedule_of(load_scenario("approach", settings), station, shipped_camera(), 0)
    T_dock_cam = np.eye(4)
    T_dock_cam[:3, :3], T_dock_cam[2, 3] = R_DOCK_CAM_HEAD_ON, range_m + float(station.p_dock[lights, 2].mean())
    conditions = replace(schedule.conditions(0), T_dock_cam=T_dock_cam, T_cam_later=np.eye(4))
    expected = schedule.renderer(0).expect(conditions)
    inside = lights[expected.emitters.lit[lights]]
    return float(np.median(expected.snr[inside])) if len(inside) else np.inf


def reach_m(settings: tuple[str, ...], station: Station, layer: str) -> float:
    """The range at which the median SNR has fallen to 8, by bisection."""
    low, high = _REACH_M
    while high - low > 0.02 * low:
        middle = float(np.sqrt(low * high))
        low, high = (middle, high) if snr(settings, station, layer, middle) > _SNR else (low, middle)
    return low


def main() -> tuple[dict[str, object], list[str]]:
    """One row per water."""
    heads = [f"{layer}, {ms:g} ms" for layer in ("front", "rear") for ms in EXPOSURES_MS]
    lines = [f"| water | {' | '.join(heads)} |", "|---" * (len(heads) + 1) + "|"]
    content: dict[str, object] = {}
    for water in WATERS:
        fresh = ("water.salinity_psu=0",) if water.startswith("pool") else ()
        reach = [
            reach_m((f"water.kind={water}", f"sensor.exposure_ms={ms}", *fresh), shipped_station(), layer)
            for layer in ("front", "rear")
            for ms in EXPOSURES_MS
        ]
        lines.append(f"| {water} | " + " | ".join(f"{value:.1f}" for value in reach) + " |")
        content[water] = dict(zip(heads, reach, strict=True))
    return content, lines
