"""Turbidity, salinity and illumination: where every method can first and last be used, and what its detector finds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from lumidock.config import Config
from lumidock.methods import localizer_of
from lumidock.report.page import PageSection, Plot, Table
from lumidock.report.plots import COLORS, plot
from lumidock.reproduce.docking import span
from lumidock.reproduce.jobs import Job
from lumidock.reproduce.plan import Plan
from lumidock.reproduce.work import Simulation, first_and_last, rendered_frames

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Results = Mapping[str, Any]
METHODS = ("paper", "lumidock")
_APPROACH_M, _FRAME_S = 33.0, 0.3
_TEXT = (
    "The paper leaves turbidity, salinity and illumination to future work. Approaches rendered for each water and "
    "exposure: true z of the first and the last frame that could be used. Our method by bearing and range (guide) and "
    "by full pose (valid); the paper's by its pose, which comes without a protection level."
)


_COARSE = (
    "Frames so far apart break lumidock's track where the front layer leaves the view, and it then waits for more than "
    "the rear layer alone; how far it gets with a frame every 0.15 s is in the section of the docking. "
)


def jobs(plan: Plan) -> list[Job]:
    """Waters x exposures, then light from above, then other salt and heat."""
    grid = plan.grid
    rows: list[tuple[str, tuple[str, ...]]] = [
        (f"water-{name}-{exposure:g}", (f"water.kind={name}", f"sensor.exposure_ms={exposure}"))
        for name in grid.waters
        for exposure in grid.exposures_ms
    ]
    rows += [(f"daylight-{light:g}", (f"daylight.surface_w_m2={light}",)) for light in grid.daylight_w_m2]
    rows.append(("salt-5-5", ("water.salinity_psu=5", "water.temperature_c=5")))
    interval = f"path.frame_interval_s={grid.envelope_interval_s}"
    weight = _APPROACH_M / grid.envelope_interval_s * _FRAME_S
    return [
        Job(
            f"envelope-{name.replace(' ', '-')}-{seed}",
            weight,
            envelope,
            (Simulation(plan.dock, "approach", (interval, *settings), seed), plan.config),
        )
        for name, settings in rows
        for seed in range(grid.first_seed, grid.first_seed + grid.envelope_seeds)
    ]


def envelope(simulation: Simulation, config: Config) -> dict[str, Any]:
    """First and last use of each method on an approach that is rendered in memory, every frame by both."""
    _, station, camera = simulation.load()
    localizers = {method: localizer_of(method, station, camera, config) for method in METHODS}
    seen: dict[str, list[tuple[float, bool, bool]]] = {method: [] for method in METHODS}
    for T_dock_cam, frame in rendered_frames(simulation):
        for method, localizer in localizers.items():
            fix = localizer.process(frame)
            seen[method].append((float(T_dock_cam[2, 3]), fix.valid, fix.guide is not None))
    return {method: _used(rows) for method, rows in seen.items()}


def _used(rows: list[tuple[float, bool, bool]]) -> dict[str, Any]:
    z, valid, guide = (np.array(column) for column in zip(*rows, strict=True))
    ends = {"valid": first_and_last(z, valid), "guide": first_and_last(z, guide)}
    return {"frames": len(rows), **ends, "valid_frames": int(valid.sum())}


def section(plan: Plan, results: Results) -> PageSection:
    """Bars and the table."""
    grid, rows = plan.grid, []
    seeds = range(grid.first_seed, grid.first_seed + grid.envelope_seeds)
    found = (n.removeprefix("envelope-").rpartition("-")[0] for n in results if n.startswith("envelope-"))
    for name in dict.fromkeys(found):
        for seed in seeds:
            r = results[f"envelope-{name}-{seed}"]
            cells = [span(r["paper"]["valid"]), span(r["lumidock"]["valid"]), span(r["lumidock"]["guide"])]
            rows.append([_row_name(name) + f", seed {seed}" * (len(seeds) > 1), *cells])
    head = [
        "water and exposure",
        "paper, recommended: pose, z m",
        "lumidock: pose, z m",
        "lumidock: bearing and range, z m",
    ]
    caption = (
        f"First and last true z in m, from 30 to -3 m at 1 m/s with a frame every {grid.envelope_interval_s:g} s. "
        f"{_COARSE if grid.envelope_interval_s > grid.docking_interval_s else ''}"
        "Light from above (60 W/m2 elsewhere) and salt in type III at 2 ms."
    )
    return PageSection(
        "Turbidity, exposure and light from above", _TEXT, items=[_plot(rows, caption), Table(caption, head, rows)]
    )


def _row_name(name: str) -> str:
    kind, _, rest = name.partition("-")
    if kind == "water":
        water, _, exposure = rest.rpartition("-")
        return f"{water}, {exposure} ms"
    return f"light from above {rest} W/m2" if kind == "daylight" else "III, 5 psu, 5 deg C"


def _plot(rows: Sequence[Sequence[str]], caption: str) -> Plot:
    """A bar for each water and method from the first to the last use."""
    height = 1.2 + 0.34 * len(rows)
    bars = f"{caption} Bars, from the top: the paper's pose (amber), our pose (green), our bearing and range (blue)."
    return plot("envelope", bars, lambda f, _narrow: _draw(f, rows), (height, height))


def _draw(figure: Figure, rows: Sequence[Sequence[str]]) -> None:
    axes = figure.subplots()
    for k, (_, *cells) in enumerate(rows):
        for at, (cell, color) in enumerate(zip(cells, ("front", "transition", "rear"), strict=True)):
            if cell != "-":
                first, last = map(float, cell.split(" to "))
                axes.barh(k - 0.27 + 0.27 * at, first - last, 0.22, left=last, color=COLORS[color])
    axes.set_yticks(range(len(rows)), [row[0] for row in rows])
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.set_xlim(30.5, -3.5)
    axes.grid(axis="y", visible=False)
    axes.set_xlabel("true z, m")
