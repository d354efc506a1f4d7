"""A drawing of a dock: its lights from the front and from above, and the protection levels expected on an approach."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lumidock.errors import extra
from lumidock.station import Station
from lumidock.streams.colors import ON_PAPER, of_layer


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
    for layer in station.layers_front_to_rear():
        lights = station.lights_of(layer)
        x, y, z = station.p_dock[lights].T
        color = of_layer(station, int(lights[0]), ON_PAPER)
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
    _draw_levels(levels, station, result)
    figure.savefig(out, dpi=110)


def _draw_levels(axes: Any, station: Station, result: dict[str, Any]) -> None:  # noqa: ANN401  # matplotlib is optional
    rows = [row for row in result["corridor"] if row["lateral_m"] is not None]
    z = [row["z_m"] for row in rows]
    limits = np.array([station.alert_limits.of_pose(row["z_m"], row["axial_m"])[:2] for row in rows]).reshape(-1, 2)
    for k, (name, color) in enumerate((("lateral_m", ON_PAPER[0]), ("axial_m", ON_PAPER[1]))):
        word = name.removesuffix("_m")
        axes.semilogy(z, [row[name] for row in rows], color=color, marker=".", label=f"{word} level, m")
        axes.semilogy(z, limits[:, k], color=color, linestyle="--", label=f"{word} alert limit, m")
    axes.invert_xaxis()
    axes.set(xlabel="z, m", title="expected protection levels on a head-on approach")
    axes.grid(alpha=0.3)
    axes.legend(loc="best")
