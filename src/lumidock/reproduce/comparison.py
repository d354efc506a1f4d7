"""Everyone else's methods on the same detections: right, wrong, refused, hazardous poses and time; and PnP solvers."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from lumidock.baselines import pnp
from lumidock.camera import Camera
from lumidock.config import Config
from lumidock.datatypes import Array
from lumidock.evaluation.claims import pose_error
from lumidock.methods import BASELINES, localizer_of
from lumidock.pose import project_lights, reprojection_rms_px
from lumidock.report.page import PageSection, Plot, Table
from lumidock.report.plots import COLORS, plot
from lumidock.reproduce.intervals import wilson
from lumidock.reproduce.jobs import Job
from lumidock.reproduce.layouts import LAYOUTS, SHIPPED, with_layout
from lumidock.reproduce.plan import Dock, Plan, resolved, title
from lumidock.reproduce.trials import verdict
from lumidock.reproduce.work import Methods, Simulation, machine, over_limit
from lumidock.sim.detections import simulated_frames
from lumidock.sim.scenario import poses, rotations

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Results = Mapping[str, Any]
# condition -> settings of independent frames, the front layer alone in sight
CONDITIONS = {
    "all seen": (),
    "1 missing": ("faults.missing=1",),
    "3 missing": ("faults.missing=3",),
    "2 spurious": ("faults.spurious=2",),
    "1 missing + 1 spurious": ("faults.missing=1", "faults.spurious=1"),
    "clutter, 4 more": ("detections.clutter=4",),
}
_ON_LAYOUTS = ("all seen", "1 missing", "2 spurious")
_DISTANCES_M = (18.0, 9.0, 3.0)
_NOISE_PX = 0.5  # of a centroid, as in the trials of section 4.1
_TILT_DEG = 3.0  # largest pitch, yaw and roll, as in section 4.1
_TURNED_DEG = 5.0  # a rotation error beyond this is the other pose of the plane
_TEXT = (
    "Independent frames without history, between 3 and 19 m, all methods on the same detections. Right: every "
    "detection as it should be; wrong: some identity is not its own; the rest is refused or partial. Hazardous: a "
    "pose is given whose error is over the alert limit at its distance, whatever its identities; of lumidock only "
    "valid poses count. Each baseline is written from its paper and reproduces a property that the paper states, as a "
    "test of this package. One-to-one methods have to use a spurious detection as soon as a light is missing as well, "
    "and refuse by the residual. The vote and RANSAC do not know which way a light shines: on a front layer that "
    "equals its mirror image, as both other layouts do, a pose from behind the dock fits as well as the true one."
)


def jobs(plan: Plan) -> list[Job]:
    """Every condition on the dock as given, some on the other layouts, and the PnP solvers."""
    names, jobs = (*plan.methods, *BASELINES), []
    for layout in LAYOUTS:
        for condition, faults in CONDITIONS.items():
            if layout != SHIPPED and condition not in _ON_LAYOUTS:
                continue
            settings = (f"path.count={plan.grid.compared}", "detections.rear_range_m=0.01", *faults)
            simulation = Simulation(plan.dock, "missing-1", ("faults.missing=0", *settings), plan.grid.first_seed)
            arguments = (simulation, layout, tuple(dict.fromkeys(names)), plan.config)
            jobs.append(
                Job(
                    f"comparison-{_slug(layout, condition)}",
                    0.4 * plan.grid.compared,
                    compare,
                    arguments,
                    code=plan.code,
                )
            )
    pnp_jobs = [
        Job(
            f"pnp-{z:g}-{kind}",
            1e-3 * plan.grid.draws,
            solvers,
            (plan.dock, z, kind, plan.grid.draws, plan.grid.first_seed),
        )
        for z in _DISTANCES_M
        for kind in ("front", "both")
    ]
    return jobs + pnp_jobs


def _slug(layout: str, condition: str) -> str:
    return f"{layout}-{condition}".replace(" ", "-").replace(",", "").replace("+", "and")


def compare(simulation: Simulation, layout: str, names: Methods, config: Config) -> dict[str, Any]:
    """Right, wrong, refused and hazardous frames of each method, and its median time."""
    scenario, station, camera = simulation.load()
    station = with_layout(station, layout)
    frames = list(simulated_frames(scenario, station, camera, simulation.seed))
    result: dict[str, Any] = {"frames": len(frames), "machine": machine()}
    for name in names:
        method, settings = resolved(name, config)
        localizer = localizer_of(method, station, camera, settings, cold=True)
        localizer.process_detections(frames[0].detections)  # compiles
        localizer.forget()
        counts, times = {"right": 0, "wrong": 0, "refused": 0, "hazardous": 0}, []
        for frame in frames:
            start = time.process_time()
            fix = localizer.process_detections(frame.detections)
            times.append(time.process_time() - start)
            right, wrong = verdict(fix, frame)
            counts["right"] += right
            counts["wrong"] += wrong
            counts["refused"] += fix.status == "none"
            counts["hazardous"] += fix.T_dock_cam is not None and over_limit(fix.T_dock_cam, frame.T_dock_cam)
        result[name] = counts | {"ms": 1e3 * float(np.median(times))}
    return result


@dataclass(frozen=True, slots=True, eq=False)
class _Drawn:
    """Frames for the PnP solvers: true poses and the noisy pixels (K, M, 2) of the lights `p_dock` (M, 3)."""

    camera: Camera
    p_dock: Array
    T_dock_cam: Array
    uv: Array


def solvers(dock: Dock, z_m: float, kind: str, count: int, seed: int) -> dict[str, Any]:
    """Errors of the PnP solvers on the front lights, or those of both layers, at one distance."""
    station, camera = dock.load()
    rng = np.random.default_rng([seed, round(z_m)])
    lights = station.lights_of(station.layers_front_to_rear()[0]) if kind == "front" else np.arange(len(station))
    turn = rotations(np.deg2rad(rng.uniform(-_TILT_DEG, _TILT_DEG, (count, 3))))
    t_dock_cam = np.column_stack([rng.uniform(-0.2, 0.2, (count, 2)), np.full(count, z_m)])
    T_dock_cam = poses(np.diag([1.0, -1.0, -1.0]) @ turn, t_dock_cam)
    uv = np.array([project_lights(camera, T, station.p_dock[lights]) for T in T_dock_cam])
    drawn = _Drawn(camera, station.p_dock[lights], T_dock_cam, uv + rng.normal(0.0, _NOISE_PX, uv.shape))
    return {name: _solved(name, drawn) for name in pnp.SOLVERS}


def _solved(name: str, drawn: _Drawn) -> dict[str, Any]:
    errors, rms, times, failed = [], [], [], 0
    for T, uv in zip(drawn.T_dock_cam, drawn.uv, strict=True):
        start = time.process_time()
        found = pnp.solutions(name, drawn.camera, drawn.p_dock, uv)
        times.append(time.process_time() - start)
        if not found:
            failed += 1
            continue
        errors.append(pose_error(found[0], T))
        rms.append(reprojection_rms_px(drawn.camera, found[0], drawn.p_dock, uv))
    if not errors:
        return {"failed": failed}
    e = np.array(errors)
    turned = np.rad2deg(np.linalg.norm(e[:, 3:], axis=1))
    return {
        "failed": failed,
        "turned": int((turned > _TURNED_DEG).sum()),
        "lateral_m": float(np.median(np.hypot(e[:, 0], e[:, 1]))),
        "axial_m": float(np.median(np.abs(e[:, 2]))),
        "angle_deg": float(np.median(turned)),
        "rms_px": float(np.median(rms)),
        "us": 1e6 * float(np.median(times)),
    }


def section(plan: Plan, results: Results) -> PageSection:
    """The plot, the methods by condition on the dock as given and on the other layouts, and the solvers."""
    names = tuple(dict.fromkeys((*plan.methods, *BASELINES)))
    tables = [_table(results, names, layouts) for layouts in ((SHIPPED,), LAYOUTS[1:])]
    return PageSection("Other people's methods", _TEXT, items=[_plot(results, names), *tables, _solver_table(results)])


def _compared(results: Results, layouts: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Results by the head of their column."""
    named = {
        condition if layout == SHIPPED else f"{layout}: {condition}": f"comparison-{_slug(layout, condition)}"
        for layout in layouts
        for condition in CONDITIONS
    }
    return {head: results[job] for head, job in named.items() if job in results}


def _table(results: Results, names: Sequence[str], layouts: Sequence[str]) -> Table:
    compared = _compared(results, layouts)
    rows = []
    for name in names:
        found = [r[name] for r in compared.values()]
        cells = [" / ".join(str(one[word]) for word in ("right", "wrong", "refused")) for one in found]
        slowest = max(one["ms"] for one in found)
        rows.append([title(name), *cells, str(sum(one["hazardous"] for one in found)), f"{slowest:.1f}"])
    first = next(iter(compared.values()))
    least = 100.0 * wilson(first["frames"], first["frames"])[0]
    where = "the dock as given" if layouts == (SHIPPED,) else "other front layers"
    caption = (
        f"Right / wrong / refused of {first['frames']} frames on {where}; what is missing to {first['frames']} has an "
        f"answer that leaves a light out. All right means {least:.0f} % or more (95 %, Wilson). CPU ms: the median "
        f"frame of the slowest condition, on {first['machine']}."
    )
    return Table(caption, ["method", *compared, "hazardous poses", "CPU ms"], rows)


def _plot(results: Results, names: Sequence[str]) -> Plot:
    compared = _compared(results, LAYOUTS).values()
    words = ("right", "wrong", "refused", "hazardous")
    totals = {name: [sum(r[name][word] for r in compared) for word in words] for name in names}
    frames = sum(r["frames"] for r in compared)
    caption = (
        "All conditions together, share of the frames: right (green), wrong (red) and hazardous poses (hatched over "
        "it); the rest is refused or partial."
    )
    height = 0.8 + 0.36 * len(totals)
    return plot("comparison", caption, lambda f, _narrow: _draw(f, totals, frames), (height, height))


def _draw(figure: Figure, totals: Mapping[str, list[int]], frames: int) -> None:
    axes = figure.subplots()
    for k, (right, wrong, _, hazardous) in enumerate(totals.values()):
        axes.barh(k, 100.0 * right / frames, 0.62, color=COLORS["transition"])
        axes.barh(k, 100.0 * wrong / frames, 0.62, left=100.0 * right / frames, color=COLORS["bad"])
        if hazardous:
            _hatch(axes, k, 100.0 * right / frames, 100.0 * hazardous / frames)
    axes.set_yticks(range(len(totals)), [title(name) for name in totals])
    axes.set(ylim=(len(totals) - 0.4, -0.6), xlim=(0, 105), xlabel="frames, %")
    axes.grid(axis="y", visible=False)


def _hatch(axes: Axes, row: int, left: float, width: float) -> None:
    axes.barh(row, width, 0.2, left=left, facecolor="none", edgecolor=COLORS["ink"], hatch="////", lw=0.5)


def _solver_table(results: Results) -> Table:
    rows = []
    for kind, name in (("front", "front layer, a plane"), ("both", "both layers")):
        for z in _DISTANCES_M:
            for solver, r in results[f"pnp-{z:g}-{kind}"].items():
                if "lateral_m" in r:
                    cells = [
                        f"{1e3 * r['lateral_m']:.0f} / {1e3 * r['axial_m']:.0f}",
                        f"{r['angle_deg']:.2f}",
                        str(r["turned"]),
                        f"{r['rms_px']:.2f}",
                        f"{r['us']:.0f}",
                    ]
                else:
                    cells = ["-", "-", "-", "-", "-"]
                rows.append([f"{solver}, {name}, {z:g} m", str(r["failed"]), *cells])
    head = [
        "solver",
        "failed",
        "median error lateral / axial, mm",
        "angle, deg",
        f"turned over {_TURNED_DEG:g} deg",
        "rms, px",
        "us",
    ]
    caption = (
        f"PnP solvers with identified lights and {_NOISE_PX:g} px of noise. IPPE is for planes only. OpenCV's EPnP has "
        "no case for planes and returns the other pose of the plane in part of the frames."
    )
    return Table(caption, head, rows)
