"""A picture of a dock: its lights from the front and from above, and the protection levels to expect on an approach."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lumidock.errors import extra
from lumidock.integrity import alert_limit
from lumidock.station import Station

_LAYER_COLORS = ("#d9860a", "#2f6fd0", "#2a9d5c", "#8a4fbf")


def draw_station(station: Station, result: dict[str, Any], out: Path) -> None:
    """A picture of the array from the front and from above, and of the expected protection levels along the approach.

    Raises: InputError when matplotlib is not installed (extra `report`).
    """
    with extra("report"):
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    figure = Figure(figsize=(11, 8), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplot_mosaic([["front", "above"], ["levels", "levels"]])
    front, above, levels = axes["front"], axes["above"], axes["levels"]
    for number, layer in enumerate(station.layers_front_to_rear()):
        lights = station.lights_of(layer)
        x, y, z = station.p_dock[lights].T
        color = _LAYER_COLORS[number % len(_LAYER_COLORS)]
        front.scatter(x, y, color=color, label=layer, s=50)
        above.scatter(z, x, color=color, s=50)
        for light in lights:
            at = station.p_dock[light]
            front.annotate(
                station.ids[light], at[:2], xytext=(0, 7), textcoords="offset points", color=color, ha="center"
            )
    front.set(
        xlabel="x, m (right)", ylabel="y, m (up)", title=f"{station.name}: as the vehicle sees it", aspect="equal"
    )
    front.margins(0.2)
    front.legend(loc="best")
    above.set(xlabel="z, m (toward the vehicle)", ylabel="x, m", title="from above")
    above.margins(0.2)
    _draw_levels(levels, result)
    figure.savefig(out, dpi=110)


def _draw_levels(axes: Any, result: dict[str, Any]) -> None:  # noqa: ANN401  # matplotlib is optional
    rows = [row for row in result["corridor"] if row["lateral_m"] is not None]
    z = [row["z_m"] for row in rows]
    for name, color in (("lateral_m", "#c0392b"), ("axial_m", "#2f6fd0")):
        axes.semilogy(z, [row[name] for row in rows], color=color, marker=".", label=f"{name.split('_')[0]} level, m")
    limits = [alert_limit(row["z_m"], row["axial_m"])[0] for row in rows]
    axes.semilogy(z, limits, color="black", linestyle="--", label="alert limit, m")
    axes.invert_xaxis()
    axes.set(xlabel="z, m", title="expected protection levels on a head-on approach")
    axes.grid(alpha=0.3)
    axes.legend(loc="best")
