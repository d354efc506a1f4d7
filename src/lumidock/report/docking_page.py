"""The page of dockings: the way from above and from the side, states and reasons, and the table of a campaign."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np

from lumidock.datatypes import Array
from lumidock.report import page
from lumidock.report.page import PageSection, Plot, Table, Tile
from lumidock.report.plots import COLORS, plot
from lumidock.station import Station

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STATES = {
    "search": "search",
    "approach": "front",
    "hold": "accent",
    "enter": "rear",
    "docked": "transition",
    "back_out": "bad",
    "abort": "bad",
}
_VERDICTS = {"go": "transition", "hold": "front", "abort": "bad"}


@dataclass(frozen=True, slots=True, eq=False)
class DockingView:
    """One docking of N frames: `t_s` (N,), true and reckoned places (N, 3) of the camera in `dock`, level (N,).

    `state`, `verdict` and `word` of each frame; which had a valid pose, and which only a guide. `changes` are the
    rows (time, state, reason) of the state machine. `opening_m` and `vehicle_m` are the radii of opening and vehicle.
    """

    title: str
    station: Station
    t_s: Array
    true_dock: Array
    reckoned_dock: Array
    level_m: Array
    state: Sequence[str]
    verdict: Sequence[str]
    word: Sequence[str]
    valid: np.ndarray
    guided: np.ndarray
    changes: Sequence[Sequence[str]]
    tiles: Sequence[Tile]
    opening_m: float
    vehicle_m: float


def docking_page(
    title: str, lead: str, views: Sequence[DockingView], tables: Sequence[Table], words: Mapping[str, str]
) -> str:
    """The page as HTML that needs nothing else. Raises: InputError when matplotlib or jinja2 is not installed."""
    sections = [PageSection("Dockings by method", items=list(tables))] if tables else []
    for k, view in enumerate(views):
        prefix = f"d{k + 1}"
        used = sorted({word for word in view.word if word in words})
        meaning = Table("Words of the go / no-go in this docking.", ["word", "meaning"], [[w, words[w]] for w in used])
        changes = Table("Changes of state, and why.", ["time, s", "state", "why"], list(view.changes))
        sections.append(
            PageSection(
                view.title, tiles=view.tiles, items=[_ways(view, prefix), _times(view, prefix), changes, meaning]
            )
        )
    return page.render(title, lead, sections)


def _ways(view: DockingView, prefix: str) -> Plot:
    caption = (
        "The camera's true way from above (x to the right) and from the side (y up), over the distance z before the "
        "entrance, coloured by state; metres. The dashed line is where the vehicle reckoned to be, the band around it "
        "its level. The dark lines are the opening inside the cage, the dotted ones the tube of contact: outside of it "
        "the hull would touch. Stars are lights; the ring is the docking point."
    )
    return plot(f"{prefix}-ways", caption, lambda figure, narrow: _draw_ways(figure, narrow, view), (6.2, 6.6))


def _draw_ways(figure: Figure, narrow: bool, view: DockingView) -> None:
    panels = figure.subplots(2, 1, sharex=True)
    for axes, column, label in zip(panels, (0, 1), ("x, m", "y, m"), strict=True):
        z, at = view.reckoned_dock[:, 2], view.reckoned_dock[:, column]
        shown = np.minimum(view.level_m, 5.0)
        axes.fill_between(z, at - shown, at + shown, color=COLORS["rear"], alpha=0.14, lw=0)
        axes.plot(z, at, color=COLORS["dim"], lw=0.8, ls="--")
        for state, start, stop in _runs(view.state):
            axes.plot(
                view.true_dock[start : stop + 1, 2],
                view.true_dock[start : stop + 1, column],
                color=COLORS[STATES[state]],
                lw=1.8,
            )
        _draw_cage(axes, view, column)
        axes.set_ylabel(label)
        reach = max(1.6, float(np.abs(view.true_dock[:, column]).max()) + 0.3)
        axes.set_ylim(-reach, reach)
    seen = dict.fromkeys(view.state)
    for state in seen:
        panels[0].plot([], [], color=COLORS[STATES[state]], lw=2.5, label=state)
    panels[0].legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3 if narrow else 6, borderaxespad=0.1)
    panels[1].set_xlabel("z, m")
    panels[1].invert_xaxis()


def _draw_cage(axes: Axes, view: DockingView, column: int) -> None:
    p_dock, end_m = view.station.p_dock, float(view.station.p_dock[:, 2].min())
    for sign in (-1.0, 1.0):
        axes.plot([0.0, end_m], [sign * view.opening_m] * 2, color=COLORS["ink"], lw=2.0)
        axes.plot([0.0, end_m], [sign * (view.opening_m - view.vehicle_m)] * 2, color=COLORS["bad"], lw=1.2, ls=":")
    axes.scatter(p_dock[:, 2], p_dock[:, column], marker="*", s=30, color=COLORS["accent"], zorder=4)
    x, z = view.station.docking_point[column], view.station.docking_point[2]
    axes.plot(z, x, "o", ms=9, mfc="none", color=COLORS["ink"])


def _times(view: DockingView, prefix: str) -> Plot:
    caption = (
        "Over time in seconds: the true distance z before the entrance, coloured by state; the distance from the axis, "
        "true (line) and reckoned with its level (band) against the room that the opening leaves (dotted); where there "
        "was a valid pose or only a guide; and the go / no-go."
    )
    return plot(f"{prefix}-times", caption, lambda figure, _narrow: _draw_times(figure, view), (6.4, 7.2))


def _draw_times(figure: Figure, view: DockingView) -> None:
    panels = figure.subplots(3, 1, sharex=True, height_ratios=(3, 3, 1.4))
    for state, start, stop in _runs(view.state):
        panels[0].plot(
            view.t_s[start : stop + 1], view.true_dock[start : stop + 1, 2], color=COLORS[STATES[state]], lw=1.8
        )
    panels[0].axhline(0.0, color=COLORS["line"], lw=1)
    panels[0].set_ylabel("z, m")
    off = np.hypot(view.true_dock[:, 0], view.true_dock[:, 1])
    reckoned = np.hypot(view.reckoned_dock[:, 0], view.reckoned_dock[:, 1])
    top = reckoned + view.level_m
    panels[1].fill_between(view.t_s, reckoned, np.minimum(top, 3.0), color=COLORS["rear"], alpha=0.16, lw=0)
    panels[1].plot(view.t_s, off, color=COLORS["ink"], lw=1.2)
    panels[1].axhline(view.opening_m - view.vehicle_m, color=COLORS["bad"], lw=1.2, ls=":")
    panels[1].set_ylim(0.0, 2.5)
    panels[1].set_ylabel("off the axis, m")
    _draw_bars(panels[2], view)
    panels[2].set_xlabel("time, s")


def _draw_bars(axes: Axes, view: DockingView) -> None:
    step = float(np.diff(view.t_s).mean()) if len(view.t_s) > 1 else 1.0
    kinds = ["valid" if v else "guide" if g else "none" for v, g in zip(view.valid, view.guided, strict=True)]
    colors = {"valid": "transition", "guide": "front", "none": "line"}
    for kind, start, stop in _runs(kinds):
        axes.barh(1.0, (stop - start) * step, left=view.t_s[start], height=0.7, color=COLORS[colors[kind]], lw=0)
    for verdict, start, stop in _runs(view.verdict):
        axes.barh(0.0, (stop - start) * step, left=view.t_s[start], height=0.7, color=COLORS[_VERDICTS[verdict]], lw=0)
    axes.set_yticks([0.0, 1.0], ["go / no-go", "fix"])
    axes.grid(visible=False)
    for name, color in (("valid, go", "transition"), ("guide, hold", "front"), ("abort", "bad"), ("no fix", "line")):
        axes.barh(0.0, 0.0, color=COLORS[color], label=name)
    axes.legend(loc="upper left", bbox_to_anchor=(0.0, -0.45), ncols=4, borderaxespad=0.1)


def _runs(names: Sequence[str]) -> list[tuple[str, int, int]]:
    """Each stretch of equal names with its first index and the one after its last."""
    found, start = [], 0
    for name, group in groupby(names):
        stop = start + len(list(group))
        found.append((name, start, stop))
        start = stop
    return found
