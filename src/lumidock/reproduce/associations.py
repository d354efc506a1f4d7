"""Figures 7 and 9 to 11: pictures with the associations drawn, and the filter beside the swarm."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from lumidock.config import Config
from lumidock.datatypes import Array, Fix, Frame, Image, Indices
from lumidock.geometry import so3_exp
from lumidock.methods import localizer_of
from lumidock.paper import btekf
from lumidock.paper.layer import LayerLocalizer
from lumidock.pose import project_lights
from lumidock.report.page import AnnotatedImage, Mark, PageSection, Plot, Table
from lumidock.report.plots import COLORS, plot
from lumidock.reproduce.intervals import share
from lumidock.reproduce.jobs import Job
from lumidock.reproduce.paper_figures import DISTANCES_M
from lumidock.reproduce.plan import AS_PRINTED, Dock, Plan, resolved, title
from lumidock.reproduce.trials import Condition, trials_scenario, verdict
from lumidock.reproduce.work import Simulation, acquisition_trial
from lumidock.sim.detections import SimulatedFrame, simulated_frames
from lumidock.sim.scenario import Scenario
from lumidock.sim.sequence import render_frame
from lumidock.station import Station

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Results = Mapping[str, Any]
FAULTS = ((1, 0), (2, 0), (3, 0), (0, 1), (0, 2))
_WIDTH_PX, _QUALITY = 480, 80  # of a picture on the page
_MARGIN_PX = 60  # around the lights that are shown
_TEXT = (
    "The paper's figures 9 and 10 show single frames at 9, 5 and 3 m with one to three front lights dark, and with "
    "one or two spurious ones; no numbers. Here a rendered frame of each, as its method in the recommended preset "
    "associates it without history (rings: identified lights; red rings: detections that were given no light), and "
    "below how often each method is right over many independent frames at point level."
)
_FILTER_TEXT = (
    "The paper's figure 7 draws the way through the filter for a light missing and a noisy point; its figure 11 two "
    "frames one after the other: first a spurious light appears, then a true one goes dark while it stays. The same "
    "two frames here at point level. One-to-one assignment has to give the spurious detection the place of the missing "
    "light; the filter, which knows where the lights must be, does not. Table 1 counts many such frames."
)


# Figures 9 and 10


def jobs(plan: Plan) -> list[Job]:
    """A picture and a trial for each fault and distance."""
    grid, jobs = plan.grid, []
    for z in DISTANCES_M:
        for missing, spurious in FAULTS:
            settings: tuple[str, ...] = (f"path.z_m={z}", f"path.count={grid.draws}", "detections.rear_range_m=0.01")
            settings += (f"faults.missing={missing}", f"faults.spurious={spurious}")
            simulation = Simulation(plan.dock, "missing-1", settings, grid.first_seed)
            name, arguments = f"figure-9-10-{z:g}-{missing}-{spurious}", (simulation, plan.methods, plan.config)
            jobs.append(Job(name, 0.04 * grid.draws, acquisition_trial, arguments, code=plan.code))
            shown = (plan.dock, plan.config, z, (missing, spurious), grid.first_seed)
            jobs.append(Job(f"picture-{z:g}-{missing}-{spurious}", 0.5, picture, shown))
    return jobs


def picture(dock: Dock, config: Config, z_m: float, faults: tuple[int, int], seed: int) -> dict[str, Any]:
    """A rendered frame with faults at z, and how the paper's method associates it without history."""
    station, camera = dock.load()
    rng = np.random.default_rng([seed, round(10 * z_m), *faults])
    T_dock_cam = np.diag([1.0, -1.0, -1.0, 1.0])
    T_dock_cam[:3, :3] = T_dock_cam[:3, :3] @ so3_exp(np.deg2rad(rng.uniform(-2.0, 2.0, 3)))
    T_dock_cam[:3, 3] = [*rng.uniform(-0.25, 0.25, 2), z_m]
    front = station.lights_of(station.layers_front_to_rear()[0])
    dark = rng.choice(front, faults[0], replace=False)
    uv = project_lights(camera, T_dock_cam, station.p_dock[front])
    low, high = uv.min(axis=0), uv.max(axis=0)
    spurious = rng.uniform(low, high, (faults[1], 2))
    image, _, _ = render_frame(Scenario(), station, camera, T_dock_cam, spurious, dark=dark, rng=rng)
    method, settings = resolved("paper", config)
    fix = localizer_of(method, station, camera, settings, cold=True).process(Frame("0", 0, image))
    return _drawn(image, fix, station) | {"dark": [station.ids[i] for i in sorted(dark.tolist())]}


def _drawn(image: Image, fix: Fix, station: Station) -> dict[str, Any]:
    """The part of the picture around its detections, and their marks, as JSON."""
    detections, light = (fix.match.detections, fix.match.light) if fix.match else (None, np.empty(0, np.int64))
    uv = np.empty((0, 2)) if detections is None else detections.uv
    low, high = _window(uv, image)
    part = image[low[1] : high[1], low[0] : high[0]]
    scale = _WIDTH_PX / part.shape[1]
    small = cv2.resize(part, (_WIDTH_PX, max(1, round(part.shape[0] * scale))), interpolation=cv2.INTER_AREA)
    _, jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    marks = [
        [*((at - low) * scale).round(1).tolist(), station.ids[i] if i >= 0 else ""]
        for at, i in zip(uv, light, strict=True)
    ]
    z = None if fix.T_dock_cam is None else float(fix.T_dock_cam[2, 3])
    shape = [_WIDTH_PX, int(small.shape[0])]
    return {
        "jpeg": base64.b64encode(jpeg.tobytes()).decode(),
        "size": shape,
        "marks": marks,
        "z_m": z,
        "reason": fix.reason,
    }


def _window(uv: Array, image: Image) -> tuple[Indices, Indices]:
    """Corners of the part of a picture that holds all detections, with a margin."""
    size = np.array(image.shape[1::-1])
    if not len(uv):
        return np.zeros(2, np.int64), size
    low = np.maximum(uv.min(axis=0) - _MARGIN_PX, 0).astype(np.int64)
    return low, np.minimum(uv.max(axis=0) + _MARGIN_PX, size).astype(np.int64)


def section(plan: Plan, results: Results) -> PageSection:
    """The pictures, and the table below them."""
    pictures = [_picture(results, z, faults) for faults in FAULTS for z in DISTANCES_M]
    rows = []
    for missing, spurious in FAULTS:
        for z in DISTANCES_M:
            r = results[f"figure-9-10-{z:g}-{missing}-{spurious}"]
            cells = [cell for name in plan.methods for cell in answers(r, name)]
            rows.append([f"{Condition(missing, spurious).name}, {z:g} m", str(r["frames"]), *cells])
    head = [word for name in plan.methods for word in (f"{title(name)}: right, %", "wrong")]
    table = Table("Independent frames without history.", ["front lights, z", "frames", *head], rows)
    return PageSection("Figures 9 and 10: at 9, 5 and 3 m", _TEXT, items=[*pictures, table])


def answers(result: dict[str, Any], method: str) -> list[str]:
    """Share of right frames, and the number of wrong ones."""
    return [share(result[method]["right"], result["frames"]), str(result[method]["wrong"])]


def _picture(results: Results, z: float, faults: tuple[int, int]) -> AnnotatedImage:
    r = results[f"picture-{z:g}-{faults[0]}-{faults[1]}"]
    marks = [
        Mark(x, y, 9.0, name or "?", "#ffc24a" if name.startswith("F") else "#62b5ff" if name else "#ff5a5f")
        for x, y, name in r["marks"]
    ]
    said = f"pose at z = {r['z_m']:.2f} m" if r["z_m"] is not None else f"no pose: {r['reason']}"
    dark = f"; dark: {', '.join(r['dark'])}" if r["dark"] else ""
    return AnnotatedImage(
        f"{Condition(*faults).name}, {z:g} m", f"{said}{dark}.", r["jpeg"], r["size"][0], r["size"][1], marks
    )


# Figures 7 and 11


def filter_jobs(plan: Plan) -> list[Job]:
    """One job."""
    return [
        Job(
            "figure-7-and-11",
            5.0,
            frames_of_figure_11,
            (plan.dock, plan.config, plan.methods, plan.grid.first_seed),
            code=plan.code,
        )
    ]


def frames_of_figure_11(dock: Dock, config: Config, methods: tuple[str, ...], seed: int) -> dict[str, Any]:
    """Two clean frames, two with a spurious light, one with a light missing as well; what everyone makes of them."""
    station, camera = dock.load()
    frames = _frames(dock, seed)
    localizers = {}
    for name in methods:
        method, settings = resolved(name, config)
        localizers[name] = localizer_of(method, station, camera, settings)
    rows: list[dict[str, Any]] = []
    for frame in frames:
        fixes = {name: localizer.process_detections(frame.detections) for name, localizer in localizers.items()}
        row: dict[str, Any] = {"lights": int((frame.light >= 0).sum()), "spurious": int((frame.light < 0).sum())}
        row["verdicts"] = {name: verdict(fix, frame) for name, fix in fixes.items()}
        row["light"] = {name: fix.match.light.tolist() if fix.match else [] for name, fix in fixes.items()}
        rows.append(row | {"uv": frame.detections.uv.tolist(), "true": frame.light.tolist()})
    return {"rows": rows, "ids": list(station.ids)} | _by_filter(dock, config, frames)


def _frames(dock: Dock, seed: int) -> list[SimulatedFrame]:
    station, camera = dock.load()
    front = station.lights_of(station.layers_front_to_rear()[0])
    runs = [list(simulated_frames(trials_scenario(*f), station, camera, seed)) for f in ((0, 0), (0, 1), (1, 1))]
    near = [k for k, frame in enumerate(runs[0]) if frame.T_dock_cam[2, 3] < 9.0 and frame.in_view[front].all()]
    return [runs[0][near[0]], runs[0][near[1]], runs[1][near[2]], runs[1][near[3]], runs[2][near[4]]]


def _by_filter(dock: Dock, config: Config, frames: list[SimulatedFrame]) -> dict[str, Any]:
    """Figure 7: where the filter expects the lights of the last frame, and whom the swarm and the filter identify."""
    station, camera = dock.load()
    filtered = LayerLocalizer(station, station.layers_front_to_rear()[0], camera, config.paper)
    for frame in frames[:-1]:
        filtered.locate(frame.detections.t_ns, frame.detections.uv)
    d = frames[-1].detections
    alone = LayerLocalizer(station, filtered.layer, camera, config.paper).register(d.uv)
    expected: Array = np.empty((0, 2))
    if filtered.track is not None:
        track = btekf.predict(filtered.track, d.t_ns, config.paper.btekf)
        expected = project_lights(camera, track.T_dock_cam, filtered.p_dock)
    swarm = [] if alone is None else np.where(alone.light >= 0, filtered.lights[alone.light], -1).tolist()
    return {"expected": expected.tolist(), "swarm": swarm, "filter": filtered.locate(d.t_ns, d.uv).light.tolist()}


def filter_section(plan: Plan, results: Results) -> PageSection:
    """The filter beside the swarm, the two frames of figure 11 by three methods, and all frames as a table."""
    result = results["figure-7-and-11"]
    rows = [
        [str(k), str(row["lights"]), str(row["spurious"]), *(_word(row["verdicts"][name]) for name in plan.methods)]
        for k, row in enumerate(result["rows"], start=1)
    ]
    head = ["frame", "true lights seen", "spurious", *map(title, plan.methods)]
    table = Table("The frames of figure 11 one after the other, with history.", head, rows)
    return PageSection(
        "Figures 7 and 11: the backtracking filter", _FILTER_TEXT, items=[_figure_7(result), _figure_11(result), table]
    )


def _word(found: list[bool]) -> str:
    right, wrong = found
    return "right" if right else "wrong identity" if wrong else "not all identified"


def _figure_7(result: dict[str, Any]) -> Plot:
    caption = (
        "Figure 7, pixels: one front light is dark and one detection is spurious (red). Crosses: where the filter "
        "expects the lights. Left the association by the swarm alone, right that of the filter; amber where it is "
        "wrong."
    )
    last = result["rows"][-1]
    shown = [("swarm alone", result["swarm"]), ("backtracking filter", result["filter"])]
    return plot(
        "backtracking",
        caption,
        lambda f, narrow: _draw(f, narrow, [(t, last, w, result) for t, w in shown]),
        (2.9, 5.0),
    )


def _figure_11(result: dict[str, Any]) -> Plot:
    caption = (
        "Figure 11: above, a spurious light appears (red); below, a true one goes dark and it stays. As printed, "
        "recommended and lumidock, each with the frames before; amber where an identity is wrong or missing. Crosses: "
        "where the filter of the recommended preset expects the lights of the second frame."
    )
    rows = result["rows"][-2:]
    shown = [
        (title(name), row, row["light"][name], result) for row in rows for name in (AS_PRINTED, "paper", "lumidock")
    ]
    return plot("figure-11", caption, lambda f, narrow: _draw(f, narrow, shown), (5.2, 13.0))


def _draw(figure: Figure, narrow: bool, shown: list[tuple[str, dict[str, Any], list[int], dict[str, Any]]]) -> None:
    columns = 1 if narrow else min(len(shown), 3)
    panels = figure.subplots(-(-len(shown) // columns), columns, squeeze=False).ravel()
    for axes, (name, row, light, result) in zip(panels, shown, strict=True):
        if row is result["rows"][-1] and result["expected"]:
            axes.scatter(*np.array(result["expected"]).T, marker="x", s=36, color=COLORS["dim"], lw=1.2)
        for detection, maker, given in zip(row["uv"], row["true"], light or [-1] * len(row["uv"]), strict=True):
            color = COLORS["bad" if maker < 0 else "transition" if maker == given else "front"]
            axes.scatter(*detection, s=52, facecolors="none", edgecolors=color, lw=1.6)
            label = result["ids"][given] if given >= 0 else "none"
            axes.annotate(label, detection, xytext=(7, 4), textcoords="offset points", color=color)
        axes.set(title=name, aspect="equal", xlabel="u, px", ylabel="v, px")
        axes.margins(0.15)
        axes.invert_yaxis()
