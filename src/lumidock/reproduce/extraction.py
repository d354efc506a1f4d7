"""The paper's extraction measured: which gray image, which shape rule for small regions, which water and light."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from lumidock import detect
from lumidock.config import Config, ExtractConfig
from lumidock.datatypes import Array, Detections, Frame
from lumidock.geometry import so3_exp
from lumidock.paper import extract
from lumidock.report.page import PageSection, Plot, Table
from lumidock.report.plots import COLORS, plot
from lumidock.reproduce.intervals import share
from lumidock.reproduce.jobs import Job
from lumidock.reproduce.plan import Dock, Plan
from lumidock.sim.detections import in_view
from lumidock.sim.scenario import load_scenario
from lumidock.sim.sequence import render_frame

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Results = Mapping[str, Any]
# gray image x whether regions below `small_area_px` skip the two shape measures
VARIANTS = {
    "largest channel": ExtractConfig(),
    "largest channel, shape of every region": ExtractConfig(small_area_px=1),
    "luma": ExtractConfig(gray="luma"),
    "luma, shape of every region": ExtractConfig(gray="luma", small_area_px=1),
}
OURS = "lumidock's detector"
DISTANCES_M = (18.0, 12.0, 8.0, 4.0)
SWEEPS = {
    "turbidity: scattering times": ("water.b_factor", (0.25, 0.5, 1.0, 2.0, 4.0)),
    "salinity, psu": ("water.salinity_psu", (0.0, 10.0, 20.0, 35.0)),
    "light from above, W/m2": ("daylight.surface_w_m2", (0.0, 60.0, 200.0, 600.0, 2000.0)),
}
_SWEPT = ("largest channel", OURS)
_FOUND_PX = 4.0  # a detection so near to a light is that light; at least, its own radius
_LIKELY = 0.5  # lamp probability below which a detection of ours is not counted as one
_TEXT = (
    "Rendered frames at 18, 12, 8 and 4 m. Found: share of the lights in view that have a detection within 4 px (or "
    "its own radius). The paper converts to gray without saying how; luma, the usual way, weighs blue by 0.114. It "
    "judges regions by roundness and compactness; of a few pixels these measures say little, so regions below 40 px "
    "skip them unless it is said. The paper leaves turbidity, salinity and illumination to future work: the curves "
    "below are of the detectors alone."
)


def jobs(plan: Plan) -> list[Job]:
    """The variants in default water, then the sweeps."""
    seeds = (plan.grid.first_seed, plan.grid.first_seed + plan.grid.extraction_frames)
    rows: list[tuple[str, tuple[str, ...]]] = [("default", ())]
    rows += [
        (f"{key.partition('.')[2]}-{value:g}", (f"{key}={value}",))
        for key, values in SWEEPS.values()
        for value in values
    ]
    return [
        Job(f"extraction-{name}", 2.0 * plan.grid.extraction_frames, measure, (plan.dock, plan.config, settings, seeds))
        for name, settings in rows
    ]


def measure(dock: Dock, config: Config, settings: tuple[str, ...], seeds: tuple[int, int]) -> dict[str, Any]:
    """Lights in view, found, false detections and the error of the centroids, by detector, layer and distance."""
    scenario, (station, camera) = load_scenario("approach", settings), dock.load()
    rear = station.layer == station.layers.index(station.layers_front_to_rear()[-1])
    found: dict[str, dict[str, list[float]]] = {}
    for z in DISTANCES_M:
        for seed in range(*seeds):
            rng = np.random.default_rng([seed, round(z)])
            T_dock_cam = np.diag([1.0, -1.0, -1.0, 1.0])
            T_dock_cam[:3, :3] = T_dock_cam[:3, :3] @ so3_exp(np.deg2rad(rng.uniform(-2.0, 2.0, 3)))
            T_dock_cam[:3, 3] = [*rng.uniform(-0.2, 0.2, 2), z]
            nothing, no_light = np.empty((0, 2)), np.empty(0, np.int64)
            image, _, _ = render_frame(scenario, station, camera, T_dock_cam, nothing, dark=no_light, rng=rng)
            uv, seen = in_view(station, camera, T_dock_cam)
            frame = Frame("0", 0, image)
            for name, detections in _detections(frame, config).items():
                for layer, of in (("front", seen & ~rear), ("rear", seen & rear)):
                    row = found.setdefault(name, {}).setdefault(f"{layer} {z:g}", [0, 0, 0, 0.0])
                    row[:] = (a + b for a, b in zip(row, _scored(detections, uv, of, seen), strict=True))
    return found


def _detections(frame: Frame, config: Config) -> dict[str, Detections]:
    found = {name: extract.lights(frame, variant) for name, variant in VARIANTS.items()}
    return found | {OURS: detect.lights(frame, config.detect)}


def _scored(detections: Detections, uv: Array, of: np.ndarray, seen: np.ndarray) -> tuple[int, int, int, float]:
    """Lights, those found, false detections in all of the frame, and the summed squared error px^2 of those found."""
    likely = detections.p_light >= _LIKELY
    at, reach = detections.uv[likely], np.maximum(_FOUND_PX, np.nan_to_num(detections.radius_px[likely]))
    if not len(at):
        return int(of.sum()), 0, 0, 0.0
    away = np.linalg.norm(at[:, None] - uv[None, seen], axis=2)
    false = int((away > reach[:, None]).all(axis=1).sum())
    near = np.linalg.norm(at[:, None] - uv[None, of], axis=2)
    best = near.min(axis=0)
    found = best <= reach[near.argmin(axis=0)] if of.any() else np.zeros(0, bool)
    return int(of.sum()), int(found.sum()), false, float((best[found] ** 2).sum())


def section(_plan: Plan, results: Results) -> PageSection:
    """The variants by layer and distance, and the sweeps as curves."""
    result, rows = results["extraction-default"], []
    for name, by_place in result.items():
        cells = []
        for layer in ("front", "rear"):
            per = [by_place[f"{layer} {z:g}"] for z in DISTANCES_M]
            cells.append(" / ".join(f"{100.0 * r[1] / r[0]:.0f}" if r[0] else "-" for r in per))
        total = np.sum([by_place[f"{layer} {z:g}"] for layer in ("front", "rear") for z in DISTANCES_M], axis=0)
        frames = sum(by_place[f"front {z:g}"][2] for z in DISTANCES_M)
        rms = np.sqrt(total[3] / max(total[1], 1))
        rows.append([name, *cells, share(int(total[1]), int(total[0])), f"{frames:.0f}", f"{rms:.2f}"])
    head = [
        "detector",
        "front found at 18 / 12 / 8 / 4 m, %",
        "rear found, %",
        "all found, %",
        "false detections",
        "rms from the light, px",
    ]
    table = Table("Detection in Jerlov III water at 2 ms.", head, rows)
    return PageSection(
        "Extraction: gray image, small regions, water and light", _TEXT, items=[table, *_curves(results)]
    )


def _curves(results: Results) -> list[Plot]:
    caption = (
        "Share of the lights in view that are found (solid, left) and rms distance of the centroid from the light "
        "(dashed, "
        "right, px) over {what}: the paper's extraction (amber) and lumidock's detector (blue), all distances together."
    )
    return [
        plot(f"detection-{k}", caption.format(what=what), partial(_draw, results, (*sweep, what)), (2.6, 3.0))
        for k, (what, sweep) in enumerate(SWEEPS.items())
    ]


def _draw(results: Results, sweep: tuple[str, tuple[float, ...], str], figure: Figure, _narrow: bool) -> None:
    key, values, what = sweep
    left = figure.subplots()
    right = left.twinx()
    for name, color in zip(_SWEPT, ("front", "rear"), strict=True):
        rows = [
            np.sum(list(results[f"extraction-{key.partition('.')[2]}-{v:g}"][name].values()), axis=0) for v in values
        ]
        left.plot(
            range(len(values)), [100.0 * r[1] / max(r[0], 1) for r in rows], color=COLORS[color], marker="o", lw=1.5
        )
        right.plot(
            range(len(values)), [np.sqrt(r[3] / max(r[1], 1)) for r in rows], color=COLORS[color], ls="--", lw=1.1
        )
    left.set_xticks(range(len(values)), [f"{v:g}" for v in values])
    left.set(xlabel=what, ylabel="found, %", ylim=(0, 104))
    right.set(ylabel="rms, px")
    right.grid(visible=False)
