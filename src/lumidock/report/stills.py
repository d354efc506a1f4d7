"""Image files of a run: the trajectory against the truth, and a sheet of annotated frames."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from lumidock.datatypes import Array, Fix, Image
from lumidock.errors import extra
from lumidock.station import Station
from lumidock.streams.colors import ON_PAPER, STAGES_ON_PAPER

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def plot_trajectory(fixes: Sequence[Fix], truth: dict[str, Array], station: Station, out: Path) -> None:
    """Top view, side view and errors of a run against true poses `T_dock_cam` (4, 4) by frame; writes a PNG.

    Raises: InputError when matplotlib is not installed (extra `report`).
    """
    with extra("report"):
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    figure = Figure(figsize=(11, 8.5), layout="constrained")
    FigureCanvasAgg(figure)
    top, side, error = figure.subplots(3, 1, sharex=True, height_ratios=[1, 1, 1.1])
    true = np.array([T[:3, 3] for T in truth.values()])
    valid = [fix for fix in fixes if fix.T_dock_cam is not None]
    at = np.array([fix.T_dock_cam[:3, 3] for fix in valid if fix.T_dock_cam is not None]).reshape(-1, 3)
    for axes, column, label in ((top, 0, "x, m (right)"), (side, 1, "y, m (up)")):
        axes.plot(true[:, 2], true[:, column], color="black", linewidth=1, label="truth")
        axes.scatter(
            station.p_dock[:, 2], station.p_dock[:, column], marker="*", s=40, color=ON_PAPER[3], label="lights"
        )
        _scatter_by_stage(axes, valid, at[:, 2], at[:, column])
        reach = 1.3 * max(1.0, float(np.abs(true[:, column]).max()))
        axes.set_ylim(-reach, reach)
        axes.set_ylabel(label)
    error_m = at - np.array([truth[fix.frame][:3, 3] for fix in valid]).reshape(-1, 3)
    _scatter_by_stage(error, valid, at[:, 2], np.maximum(np.linalg.norm(error_m, axis=1), 1e-6))
    error.set_yscale("log")
    error.set_ylabel("position error, m")
    error.set_xlabel("z, m: distance before the entrance plane; shaded: inside the dock")
    error.set_xlim(float(true[:, 2].max()) + 1.0, float(station.p_dock[:, 2].min()) - 1.0)
    top.set_title("Camera in the dock frame: from above, from the side; and its error", loc="left")
    top.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=6, fontsize=8, frameon=False, borderaxespad=0.2)
    for axes in (top, side, error):
        axes.axvspan(0.0, float(station.p_dock[:, 2].min()), color=ON_PAPER[1], alpha=0.07)
        axes.grid(alpha=0.25)
    figure.savefig(out, dpi=110)


def _scatter_by_stage(axes: Axes, fixes: Sequence[Fix], z: Array, values: Array) -> None:
    """Points over z, coloured by the docking stage of each of the N `fixes`; `z` (N,), `values` (N,)."""
    for stage, color in STAGES_ON_PAPER.items():
        inside = np.array([fix.stage == stage for fix in fixes], bool)
        if inside.any():
            axes.scatter(z[inside], values[inside], s=9, color=color, label=f"{stage} stage")


def contact_sheet(pictures: Sequence[Image], out: Path, *, columns: int = 2, width: int = 720) -> None:
    """Write pictures (H, W, 3) of one size side by side into one JPEG, each `width` wide; nothing without pictures."""
    size = (width, round(pictures[0].shape[0] * width / pictures[0].shape[1])) if pictures else (0, 0)
    small = [np.pad(cv2.resize(p, size, interpolation=cv2.INTER_AREA), ((2, 2), (2, 2), (0, 0))) for p in pictures]
    rows = [np.hstack(small[i : i + columns]) for i in range(0, len(small) - columns + 1, columns)]
    if rows:
        cv2.imwrite(str(out), np.vstack(rows), [cv2.IMWRITE_JPEG_QUALITY, 90])
