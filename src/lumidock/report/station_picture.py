"""A drawing of a dock: its lights from the front and from above, and the protection levels expected on an approach."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lumidock.datatypes import Array
from lumidock.errors import extra
from lumidock.evaluation.station_check import LEVELS
from lumidock.station import Station
from lumidock.streams.colors import ON_PAPER, of_layer


def draw_station(station: Station, result: dict[str, Any], out: Path) -> None:
    """A picture of the array from the front and from above, and of the expected protection levels along the approach.

    Raises: InputError when matplotlib is not installed (extra `report`).
    """
    with extra("report"):
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    figure = Figure(figsize=(11, 8.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplot_mosaic([["front", "above"], ["metres", "angles"]])
    front, above = axes["front"], axes["above"]
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
    _draw_levels(axes["metres"], axes["angles"], station, result)
    figure.savefig(out, dpi=110)


def _draw_levels(metres: Any, angles: Any, station: Station, result: dict[str, Any]) -> None:  # noqa: ANN401  # matplotlib is optional
    """The protection levels that are expected, solid, and the alert limits, dashed, of lengths and of angles."""
    rows = [row for row in result["corridor"] if row["lateral_m"] is not None]
    z = [row["z_m"] for row in rows]
    limits = _limits(station, rows)
    for k, name in enumerate(LEVELS):
        axes, (word, unit) = metres if name.endswith("_m") else angles, name.rsplit("_", 1)
        color, level = ON_PAPER[min(k, 3)], [np.nan if row[name] is None else row[name] for row in rows]
        axes.semilogy(z, level, color=color, marker=".", label=f"{word} level, {unit}")
        axes.semilogy(z, limits[:, k], color=color, linestyle="--", label=f"{word} alert limit, {unit}")
    for axes, what in ((metres, "lengths"), (angles, "angles")):
        axes.invert_xaxis()
        axes.set(xlabel="z, m", title=f"protection levels to expect head-on: {what}")
        axes.grid(alpha=0.3)
        axes.yaxis.set_major_formatter(lambda value, _at: f"{value:g}")
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=3 if axes is metres else 2, fontsize="small")


def _limits(station: Station, rows: list[dict[str, Any]]) -> Array:
    """Alert limits (N, 5) in the order and the units of `LEVELS`; NaN where guidance has none of its own."""
    limits = np.full((len(rows), len(LEVELS)), np.nan)
    for k, row in enumerate(rows):
        lateral_m, axial_m, angle_rad = station.alert_limits.of_pose(row["z_m"], row["axial_m"])
        limits[k, :3] = lateral_m, axial_m, np.rad2deg(angle_rad)
        if row["range_m"] is not None:
            bearing_rad, range_m = station.alert_limits.of_guide(row["z_m"] - row["range_m"])
            limits[k, 3:] = np.rad2deg(bearing_rad), range_m
    return limits
