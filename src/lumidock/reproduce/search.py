"""Figures 12 and 13: the rectangular search, seen from its four sides by every method."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lumidock.datatypes import Array, Fix
from lumidock.evaluation.metrics import read_rows, true_poses
from lumidock.report.moments import images_of
from lumidock.report.page import AnnotatedImage, PageSection, Plot, Table
from lumidock.report.plots import COLORS, plot
from lumidock.report.view import RunView, load_run
from lumidock.reproduce.jobs import Job
from lumidock.reproduce.plan import Plan, title
from lumidock.reproduce.work import Simulation, docking, docking_leaves
from lumidock.station import Station, load_station
from lumidock.streams.replay import read_fixes

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Results = Mapping[str, Any]
SIDES = ("below", "left", "above", "right")
_FOUR = 4  # front lights in view that the paper asks for
_FLIPPED_DEG = 5.0  # a rotation error beyond this is the other pose of the plane, not noise
_FRAME_S = 0.35
_TEXT = (
    "Once round a rectangle at 15 m, looking straight along the dock's axis, so that the dock is seen from below, "
    "left, above and right. The paper's figure 12 shows one picture of each side with the identities, its figure 13 a "
    "trajectory that follows the path; it gives neither the size of its rectangle nor an error. The rectangle here, "
    "15.2 x 12.4 m, keeps four front lights or more in view on every side. All frames are counted. The paper's method "
    "answers with a pose; lumidock with a pose where its protection level allows one, and else with bearing and range, "
    "which place no point."
)


def jobs(plan: Plan) -> list[Job]:
    """One rendered run."""
    folder = plan.out / "runs" / "search"
    settings = (f"path.frame_interval_s={plan.grid.search_interval_s}",)
    simulation = Simulation(plan.dock, "rectangle", settings, plan.grid.first_seed)
    arguments = (simulation, str(folder), True, plan.methods, plan.config)
    weight = 55.2 / plan.grid.search_interval_s * _FRAME_S
    return [Job("search", weight, docking, arguments, docking_leaves(folder, True, plan.methods), plan.code)]


def section(plan: Plan, results: Results) -> PageSection:
    """Pictures from each side, the trajectories, and the frames of each side."""
    folder = plan.out / "runs" / "search"
    views = [load_run(folder / name, folder / "sequence") for name in plan.methods]
    return PageSection(
        "Figures 12 and 13: the rectangular search",
        _TEXT,
        items=[*_pictures(folder, views), _figure_13(views), _table(plan, folder, results)],
    )


def side_of(t_dock_cam: Array, reach: Array) -> str:
    """From which side (below, left, above, right) the dock is seen at (3,) m of a rectangle that reaches (2,) m."""
    x, y = t_dock_cam[:2] / reach
    return ("left" if x < 0 else "right") if abs(x) > abs(y) else ("below" if y < 0 else "above")


def sides(folder: Path, method: str) -> dict[str, dict[str, float]]:
    """By side: frames, those with four front lights in view or more, poses, guides, flipped poses, rms errors m."""
    truth, sequence = true_poses(folder / "sequence"), folder / "sequence"
    station = load_station(folder / method / "station.yaml")
    reach = np.abs([T[:2, 3] for T in truth.values()]).max(axis=0)
    seen = _front_lights_in_view(sequence, station)
    found: dict[str, list[tuple[Fix, Array, int]]] = {side: [] for side in SIDES}
    for fix, _, _ in read_fixes(folder / method, station.ids):
        T = truth[fix.frame]
        found[side_of(T[:3, 3], reach)].append((fix, T, seen.get(fix.frame, 0)))
    return {side: _counts(rows) for side, rows in found.items()}


def _front_lights_in_view(sequence: Path, station: Station) -> dict[str, int]:
    front = {station.ids[i] for i in station.lights_of(station.layers_front_to_rear()[0])}
    count: dict[str, int] = {}
    for row in read_rows(sequence / "lights_truth.csv", ("frame", "light", "visible")):
        count[row["frame"]] = count.get(row["frame"], 0) + (row["visible"] == "1" and row["light"] in front)
    return count


def _counts(rows: list[tuple[Fix, Array, int]]) -> dict[str, float]:
    valid = [(fix.T_dock_cam, T) for fix, T, _ in rows if fix.T_dock_cam is not None]
    errors = np.array([one[:3, 3] - T[:3, 3] for one, T in valid]).reshape(-1, 3)
    turned = [np.arccos(np.clip(0.5 * (np.trace(one[:3, :3].T @ T[:3, :3]) - 1.0), -1.0, 1.0)) for one, T in valid]
    return {
        "frames": len(rows),
        "four": sum(seen >= _FOUR for _, _, seen in rows),
        "valid": len(valid),
        "guide": sum(fix.guide is not None for fix, _, _ in rows),
        "flipped": int((np.rad2deg(turned) > _FLIPPED_DEG).sum()) if turned else 0,
        "lateral_m": float(np.sqrt((errors[:, :2] ** 2).sum(axis=1).mean())) if len(errors) else float("nan"),
        "axial_m": float(np.sqrt((errors[:, 2] ** 2).mean())) if len(errors) else float("nan"),
    }


def _table(plan: Plan, folder: Path, results: Results) -> Table:
    by_method = {name: sides(folder, name) for name in plan.methods}
    rows = []
    for side in SIDES:
        for name in plan.methods:
            r = by_method[name][side]
            rms = f"{r['lateral_m']:.3f} / {r['axial_m']:.3f}" if r["valid"] else "-"
            guide = f"{r['guide']:.0f}" if name == "lumidock" else "gives none"
            cells = [f"{r[word]:.0f}" for word in ("frames", "four", "valid")]
            rows.append([f"{side}: {title(name)}", *cells, guide, rms, f"{r['flipped']:.0f}"])
    wrong = []
    for name in plan.methods:
        identities = results["search"][name]["identities"]
        wrong.append(f"{title(name)} {identities['wrong']} of {identities['identified']}")
    head = [
        "dock seen from",
        "frames",
        "with 4 front lights in view",
        "poses",
        "bearing and range",
        "rms lateral / axial, m",
        f"poses turned over {_FLIPPED_DEG:g} deg",
    ]
    return Table(f"All frames by side of the rectangle. Wrong identities: {'; '.join(wrong)}.", head, rows)


def _pictures(folder: Path, views: list[RunView]) -> list[AnnotatedImage]:
    """Figure 12: the middle frame of each side, by the paper's method in its recommended preset."""
    truth, view = true_poses(folder / "sequence"), views[1]
    reach = np.abs([T[:2, 3] for T in truth.values()]).max(axis=0)
    at = [side_of(truth[fix.frame][:3, 3], reach) for fix in view.fixes]
    wanted = []
    for side in SIDES:
        frames = [k for k, where in enumerate(at) if where == side]
        if frames:
            wanted.append((frames[len(frames) // 2], f"Figure 12: the dock seen from {side}"))
    return images_of(view, wanted)


def _figure_13(views: list[RunView]) -> Plot:
    caption = (
        "Figure 13: the path (line) and the poses (points) in the plane at 15 m, x to the right and y up, metres, by "
        "each method; stars are the dock's lights."
    )
    return plot("search", caption, lambda f, narrow: _draw(f, narrow, views), (3.6, 3.7 * len(views)))


def _draw(figure: Figure, narrow: bool, views: list[RunView]) -> None:
    panels = figure.subplots(*((len(views), 1) if narrow else (1, len(views))), squeeze=False).ravel()
    for axes, view in zip(panels, views, strict=True):
        axes.plot(*view.true_position[:, :2].T, color=COLORS["ink"], lw=1)
        axes.scatter(*view.position[:, :2].T, s=11, color=COLORS["rear"], lw=0)
        axes.scatter(*view.station.p_dock[:, :2].T, marker="*", s=26, color=COLORS["accent"])
        axes.set(title=title(view.folder.name), xlabel="x, m", ylabel="y, m", aspect="equal")
        axes.set(xlim=(-12, 12), ylim=(-11, 11))
