"""Figures of a reproduction that no single run has."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from lumidock.report.page import Plot
from lumidock.report.plots import COLORS, plot
from lumidock.report.view import RunView

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def swarm(result: dict[str, Any]) -> Plot:
    """Figure 6: the best particle over the iterations."""
    caption = (
        f"The swarm converging (the paper's figure 6) on {result['detections']} of the front lights from z = "
        f"{result['z_m']:.1f} m: roll in degrees, scale and shift of the best particle, and how many names are right, "
        "over its iterations."
    )
    return plot("swarm", caption, lambda f, narrow: _draw_swarm(f, narrow, result), (4.2, 7.5))


def _draw_swarm(figure: Figure, narrow: bool, result: dict[str, Any]) -> None:
    rows = np.array(result["rows"])
    panels = figure.subplots(*((4, 1) if narrow else (2, 2)), sharex=True).ravel()
    shown = (
        (rows[:, 1:2] * 180.0 / np.pi, "roll, deg"),
        (rows[:, 2:3], "scale"),
        (rows[:, 3:5], "shift x, y"),
        (rows[:, 6:7], "names right"),
    )
    for axes, (values, label) in zip(panels, shown, strict=True):
        for column, color in zip(values.T, ("rear", "front"), strict=False):
            axes.plot(rows[:, 0], column, color=COLORS[color], marker="o", ms=3, lw=1.2)
        axes.set_ylabel(label)
        axes.set_xscale("symlog", linthresh=1)
        axes.xaxis.set_major_formatter(lambda value, _at: f"{value:g}")
    for axes in panels[-1:] if narrow else panels[2:]:
        axes.set_xlabel("iterations")


def backtracking(result: dict[str, Any]) -> Plot:
    """Figure 7: one light missing and one spurious spot, as the swarm and as the filter name them."""
    caption = (
        "The backtracking filter at work (figure 7), pixels: one front light is dark and one spot is spurious (red). "
        "Crosses: where the filter expects the lights. Left the names that the swarm alone gives, right those of the "
        "filter."
    )
    return plot("backtracking", caption, lambda f, narrow: _draw_backtracking(f, narrow, result), (2.9, 5.0))


def _draw_backtracking(figure: Figure, narrow: bool, result: dict[str, Any]) -> None:
    uv, true, expected = np.array(result["uv"]), result["true"], np.array(result["expected"]).reshape(-1, 2)
    panels = figure.subplots(*((2, 1) if narrow else (1, 2)))
    for axes, who, title in zip(panels, ("swarm", "filter"), ("swarm alone", "backtracking filter"), strict=True):
        axes.scatter(*expected.T, marker="x", s=36, color=COLORS["dim"], lw=1.2)
        for detection, maker, light in zip(uv, true, result[who] or [-1] * len(uv), strict=True):
            color = COLORS["bad" if maker < 0 else "transition" if maker == light else "front"]
            axes.scatter(*detection, s=52, facecolors="none", edgecolors=color, lw=1.6)
            name = result["ids"][light] if light >= 0 else "none"
            axes.annotate(name, detection, xytext=(7, 4), textcoords="offset points", color=color)
        axes.set(title=title, aspect="equal", xlabel="u, px", ylabel="v, px")
        axes.margins(0.15)
        axes.invert_yaxis()


def search(views: Sequence[RunView]) -> Plot:
    """Figure 13: path and estimates in the plane of the search."""
    caption = (
        "The search (figure 13): the path (line) and the estimates (points) in the plane at 15 m, x to the right and y "
        "up, metres; first lumidock, where bearing and range alone place no point, then the paper's method."
    )
    return plot("search", caption, lambda f, narrow: _draw_search(f, narrow, views), (4.6, 7.6))


def _draw_search(figure: Figure, narrow: bool, views: Sequence[RunView]) -> None:
    panels = figure.subplots(*((2, 1) if narrow else (1, 2)))
    for axes, view in zip(panels, views, strict=True):
        axes.plot(*view.true_position[:, :2].T, color=COLORS["ink"], lw=1)
        axes.scatter(*view.position[:, :2].T, s=11, color=COLORS["rear"], lw=0)
        axes.scatter(*view.station.p_dock[:, :2].T, marker="*", s=26, color=COLORS["accent"])
        axes.set(title=str(view.described.get("method")), xlabel="x, m", ylabel="y, m", aspect="equal")
        axes.set(xlim=(-13, 13), ylim=(-12, 12))


def envelope(rows: Sequence[Sequence[str]], caption: str) -> Plot:
    """A bar for each water and method from the first to the last use."""
    height = 1.2 + 0.34 * len(rows)
    bars = f"{caption} Bars, from the top: the paper's pose (amber), our pose (green), our bearing and range (blue)."
    return plot("envelope", bars, lambda f, _narrow: _draw_envelope(f, rows), (height, height))


def _draw_envelope(figure: Figure, rows: Sequence[Sequence[str]]) -> None:
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
