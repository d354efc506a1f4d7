"""The page of a survey: what it changed, how well it fits, what it leaves open and what to film next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lumidock.datatypes import Array, Indices
from lumidock.report import page
from lumidock.report.page import PageSection, Plot, Table, Tile
from lumidock.report.plots import COLORS, plot
from lumidock.station import Station

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LAYER_COLORS = ("front", "rear", "transition", "accent")
_MOST_POINTS = 1500  # of the residuals; of more, every k-th frame is drawn
_ELLIPSE_SIGMAS = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class SurveyView:
    """A survey as the page wants it: F frames, M lights.

    Stations `before` and `after`; `sigma_m` (M, 3) and the covariance of the shape (3M, 3M); residuals of the drawing
    and of the survey (F, M, 2) px, NaN where unseen; which recording each frame is of (F,); rms px of held-out frames
    with the drawing and the survey; what was not observed, why it is refused, and which views would help, in words.
    """

    before: Station
    after: Station
    sigma_m: Array
    covariance: Array
    drawn_px: Array
    surveyed_px: Array
    recording: Indices
    held_out_px: tuple[float, float]
    scale_sigma: float
    unobserved: Sequence[str]
    refusal: str
    views: Sequence[str]


def survey_page(view: SurveyView) -> str:
    """The page as HTML that needs nothing else. Raises: InputError when matplotlib or jinja2 is not installed."""
    frames = len(view.surveyed_px)
    lead = (
        f"{frames} frames of {len(np.unique(view.recording))} recordings; positions are those in which the lights that"
        " were seen fit the drawing best, so the docking point keeps its place among them."
    )
    sections = [
        PageSection(
            "Result", text=view.refusal and f"Refused: {view.refusal}.", tiles=_tiles(view), items=[_dock(view)]
        ),
        PageSection("Each light", items=[_lights(view)]),
        PageSection("Residuals", text=_RESIDUALS, items=[_residuals(view)]),
        PageSection("What the footage leaves open", items=[_listed("Not observed", view.unobserved)]),
        PageSection("What to film next", text=_NEXT, items=[_listed("Views", view.views)]),
    ]
    return page.render(f"Survey of {view.after.name}", lead, sections)


_RESIDUALS = (
    "How far each detection lies from where the survey puts its light in that frame. A light whose points stand apart "
    "from zero has moved during the recordings, or is another lamp; a frame whose points all scatter was blurred."
)
_NEXT = "Held for a second in still water, each of these views would lower the rms error of the positions to so much."


def _tiles(view: SurveyView) -> list[Tile]:
    moved = np.linalg.norm(view.after.p_dock - view.before.p_dock, axis=1)
    drawn, surveyed = view.held_out_px
    sigma = np.sqrt((view.sigma_m**2).mean())
    return [
        Tile("refused" if view.refusal else "usable", "the station file", "bad" if view.refusal else "good"),
        Tile(f"{surveyed:.2f} px", "rms residual of held-out frames", "bad" if view.refusal else "good"),
        Tile(f"{drawn:.2f} px", "the same with the drawing"),
        Tile(f"{1e3 * np.sqrt((moved**2).mean()):.0f} mm", "rms move of the lights"),
        Tile(f"{1e3 * sigma:.1f} mm", "rms sigma of a coordinate"),
        Tile(f"{100 * view.scale_sigma:.2f} %", "sigma of the size of the whole"),
    ]


def _dock(view: SurveyView) -> Plot:
    grow = _magnified(view)
    caption = (
        "The dock as the vehicle sees it, and from above; hollow: as drawn, full: as surveyed. Moves and "
        f"{_ELLIPSE_SIGMAS:g}-sigma ellipses are drawn {grow:g} times as large as they are."
    )
    return plot("dock", caption, lambda figure, narrow: _draw_dock(figure, narrow, view, grow), (5.2, 8.5))


def _magnified(view: SurveyView) -> float:
    """A round factor at which the largest move spans about a tenth of the dock."""
    extent = float(np.ptp(view.before.p_dock, axis=0).max())
    move = max(float(np.linalg.norm(view.after.p_dock - view.before.p_dock, axis=1).max()), 1e-6)
    return float(max(1.0, np.floor(0.08 * extent / move)))


def _draw_dock(figure: Figure, narrow: bool, view: SurveyView, grow: float) -> None:
    panels = figure.subplots(2, 1) if narrow else figure.subplots(1, 2)
    for axes, (across, up), labels in zip(panels, ((0, 1), (2, 0)), (("x, m", "y, m"), ("z, m", "x, m")), strict=True):
        for i in range(len(view.before)):
            _draw_light(axes, view, i, (across, up), grow)
        axes.set(xlabel=labels[0], ylabel=labels[1])
        axes.margins(0.15)
    panels[0].set_aspect("equal")


def _draw_light(axes: Axes, view: SurveyView, i: int, plane: tuple[int, int], grow: float) -> None:
    from matplotlib.patches import Ellipse

    color = COLORS[_LAYER_COLORS[int(view.before.layer[i]) % len(_LAYER_COLORS)]]
    drawn = view.before.p_dock[i, list(plane)]
    now = drawn + grow * (view.after.p_dock[i, list(plane)] - drawn)
    axes.plot(*drawn, "o", mfc="none", mec=COLORS["search"], ms=6)
    axes.plot([drawn[0], now[0]], [drawn[1], now[1]], color=COLORS["search"], lw=0.9)
    axes.plot(*now, "o", color=color, ms=4)
    block = [3 * i + plane[0], 3 * i + plane[1]]
    values, vectors = np.linalg.eigh(view.covariance[np.ix_(block, block)])
    size = 2.0 * _ELLIPSE_SIGMAS * grow * np.sqrt(np.maximum(values, 0.0))
    angle = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
    axes.add_patch(Ellipse((now[0], now[1]), size[1], size[0], angle=angle, fill=False, color=color, lw=0.9))
    if plane == (0, 1):
        axes.annotate(view.before.ids[i], (drawn[0], drawn[1]), xytext=(6, 5), textcoords="offset points", fontsize=8)


def _lights(view: SurveyView) -> Table:
    moved, rows = 1e3 * (view.after.p_dock - view.before.p_dock), []
    for i, light_id in enumerate(view.before.ids):
        seen = int(np.isfinite(view.surveyed_px[:, i, 0]).sum())
        cells = [" ".join(f"{x:+.1f}" for x in moved[i]), " ".join(f"{1e3 * s:.1f}" for s in view.sigma_m[i])]
        rows.append([light_id, *cells, str(seen), _rms(view.drawn_px[:, i]), _rms(view.surveyed_px[:, i])])
    head = ["light", "moved x y z, mm", "sigma x y z, mm", "frames", "drawing, px", "survey, px"]
    return Table("Moves from the drawing, their 1-sigma errors, and rms residuals in all frames", head, rows)


def _rms(residual_px: Array) -> str:
    squares = (residual_px**2).sum(axis=1)
    return f"{np.sqrt(np.nanmean(squares)):.2f}" if np.isfinite(squares).any() else "-"


def _residuals(view: SurveyView) -> Plot:
    caption = "Residuals across (u) and down (v) of every light, frame after frame; the recordings follow one another."
    return plot("residuals", caption, lambda figure, _narrow: _draw_residuals(figure, view), (5.5, 5.5))


def _draw_residuals(figure: Figure, view: SurveyView) -> None:
    panels = figure.subplots(2, 1, sharex=True)
    step = max(1, view.surveyed_px[..., 0].size // _MOST_POINTS)
    frames = np.arange(0, len(view.surveyed_px), step)
    for axes, column, label in zip(panels, (0, 1), ("u, px", "v, px"), strict=True):
        for i in range(len(view.before)):
            color = COLORS[_LAYER_COLORS[int(view.before.layer[i]) % len(_LAYER_COLORS)]]
            axes.plot(frames, view.surveyed_px[frames, i, column], ".", ms=2.5, color=color)
        for border in np.flatnonzero(np.diff(view.recording)):
            axes.axvline(border + 0.5, color=COLORS["line"], lw=1)
        axes.set_ylabel(label)
    panels[1].set_xlabel("frame of the survey")


def _listed(head: str, lines: Sequence[str]) -> Table:
    return Table("", [head], [[line] for line in lines] or [["nothing"]])
