"""The page of a designed dock: where its lights are, what it gives with lights dead, and what each light is for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from lumidock.evaluation.dead_lights import Strength
from lumidock.report import page
from lumidock.report.page import PageSection, Plot, Table, Tile
from lumidock.report.plots import COLORS, plot
from lumidock.station import Station

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LAYER_COLORS = ("front", "rear", "transition", "accent")


@dataclass(frozen=True, slots=True, eq=False)
class DesignView:
    """A designed `station` against a shipped `rival`: their strength with up to `dead` lights dead.

    `alone` is the strength with any one light dead, `confusion_m` the least confusion of each layer, `told` the result
    in a line.
    """

    station: Station
    rival: Station
    judged: Strength
    rival_judged: Strength
    alone: Strength
    confusion_m: Mapping[str, float]
    dead: int
    told: str


def design_page(view: DesignView) -> str:
    """The page as HTML that needs nothing else. Raises: InputError when matplotlib or jinja2 is not installed."""
    worst = float(view.judged.ratio.max())
    tiles = [
        Tile(f"{worst:.2f}", f"worst level over limit, any {view.dead} dead", "good" if worst < 1.0 else "bad"),
        Tile(f"{view.alone.ratio.max():.2f}", "the same with any one dead"),
        *(Tile(f"{m:.3f} m", f"least confusion, {layer}") for layer, m in view.confusion_m.items()),
    ]
    sections = [
        PageSection("Result", text=f"{view.told}.", tiles=tiles, items=[_dock(view), _curve(view)]),
        PageSection("What each light is for", text=_WHAT_FOR, items=[_lights(view)]),
    ]
    return page.render(view.station.name, f"{len(view.station)} lights, designed", sections)


_WHAT_FOR = (
    "How bad the worst place along the approach becomes with this light dead, and where that place is. A light whose "
    "loss hardly shows is a spare for others; one whose loss brings the ratio near 1 deserves the best lamp."
)


def _dock(view: DesignView) -> Plot:
    caption = "The dock as the vehicle sees it, and from above; the vehicle comes from the right of the second picture."
    return plot("dock", caption, lambda figure, narrow: _draw_dock(figure, narrow, view.station), (4.8, 8.0))


def _draw_dock(figure: Figure, narrow: bool, station: Station) -> None:
    panels = figure.subplots(2, 1) if narrow else figure.subplots(1, 2)
    front, above = panels
    for i, light_id in enumerate(station.ids):
        x, y, z = station.p_dock[i]
        color = COLORS[_LAYER_COLORS[int(station.layer[i]) % len(_LAYER_COLORS)]]
        front.plot(x, y, "o", color=color, ms=6)
        above.plot(z, x, "o", color=color, ms=6)
        for axes, at in ((front, (x, y)), (above, (z, x))):
            axes.annotate(light_id, at, xytext=(6, 5), textcoords="offset points", fontsize=8)
    front.set(xlabel="x, m", ylabel="y, m")
    above.set(xlabel="z, m", ylabel="x, m")
    for axes in panels:
        axes.set_aspect("equal", adjustable="datalim")
        axes.margins(0.2)


def _curve(view: DesignView) -> Plot:
    caption = (
        f"Worst protection level over its alert limit along the approach, with any {view.dead} lights dead (thick) and"
        f" any one (thin), against {view.rival.name} with any one dead (dotted). Below 1 the pose is valid."
    )
    return plot("curve", caption, lambda figure, _narrow: _draw_curve(figure, view), (4.2, 4.2))


def _draw_curve(figure: Figure, view: DesignView) -> None:
    axes = figure.subplots()
    curves = (
        (view.judged, "rear", "-", 2.0, f"any {view.dead} dead"),
        (view.alone, "rear", "-", 0.9, "any one dead"),
        (view.rival_judged, "search", ":", 1.6, f"{view.rival.name}, any one dead"),
    )
    for one, color, style, width, label in curves:
        judged = one.ratio > 0.0
        axes.semilogy(one.z_m[judged], one.ratio[judged], color=COLORS[color], ls=style, lw=width, label=label)
    axes.axhline(1.0, color=COLORS["bad"], lw=1)
    axes.invert_xaxis()
    axes.set(xlabel="z, m", ylabel="level over limit")
    axes.legend(loc="best")


def _lights(view: DesignView) -> Table:
    rows = []
    for i, light_id in enumerate(view.station.ids):
        position = " ".join(f"{x:+.2f}" for x in view.station.p_dock[i])
        rows.append([light_id, position, f"{view.alone.alone[i]:.2f}", f"{view.judged.alone[i]:.2f}"])
    head = ["light", "x y z, m", "worst with it dead", f"worst with it among {view.dead} dead"]
    return Table("", head, rows)
