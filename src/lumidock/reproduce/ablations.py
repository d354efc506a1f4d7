"""What each piece of the paper's method is worth: one setting changed at a time, and the swarm's size against time."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from lumidock.config import PaperConfig
from lumidock.paper import PaperLocalizer
from lumidock.paper.layer import LayerLocalizer
from lumidock.report.page import PageSection, Plot, Table
from lumidock.report.plots import COLORS, plot
from lumidock.reproduce import layer_rules
from lumidock.reproduce.intervals import share
from lumidock.reproduce.jobs import Job
from lumidock.reproduce.plan import Dock, Plan
from lumidock.reproduce.trials import Count, trials_scenario, verdict
from lumidock.reproduce.work import machine
from lumidock.sim.detections import simulated_frames

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Results = Mapping[str, Any]
Change = dict[str, dict[str, Any]]
_NEVER = 10_000  # iterations without gain that no swarm reaches
# changes of the recommended preset
ABLATIONS: dict[str, Change] = {
    "recommended": {},
    "swarm 20 x 40": {"pso": {"particles": 20, "iterations": 40}},
    "printed bounds": {"pso": {"scale": (0.5, 8.0), "shift": (-1.0, 1.0)}},
    "no restart": {"pso": {"stagnation": _NEVER}},
    "no roll penalty, eq. (7)": {"pso": {"penalty": 0.0}},
    "no continuity, w2 = 0": {"pso": {"w2": 0.0}},
    "eq. (2) over all pairs, as printed": {"pso": {"residual": "all_pairs"}},
    "no ratio filter": {"consistency": {"ratio": 1e9, "angle_deg": 1e9}},
    "ratio filter 0.05, 3 deg": {"consistency": {"ratio": 0.05, "angle_deg": 3.0}},
    "no backtracking filter": {"btekf": {"max_gap_s": 1e-9}},
    "gate without noise": {"btekf": {"noise_in_gate": False}},
    "no branch for missing lights": {"btekf": {"missing_branch": False}},
    "pose and next frame by the filter, 3.2.3 e": {"btekf": {"pose_from_filter": True}},
}
# the deviations again, from the other end: as printed, with one of them taken
FROM_PRINTED: dict[str, Change] = {
    "as printed": {},
    "as printed, swarm 80 x 120": {"pso": {"particles": 80, "iterations": 120}},
    "as printed, wide bounds": {"pso": {"scale": (0.5, 12.0), "shift": (-2.0, 2.0)}},
    "as printed, noise in the gate": {"btekf": {"noise_in_gate": True}},
    "as printed, branch for missing lights": {"btekf": {"missing_branch": True}},
    "as printed, SQPnP in every frame": {"btekf": {"pose_from_filter": False}},
    "as printed, both repairs of the filter": {"btekf": {"noise_in_gate": True, "missing_branch": True}},
}
FAULTS = ((3, 0), (1, 0), (0, 2), (1, 1))
CLEAN_FRAMES = 4
SIZES = ((10, 20), (20, 20), (20, 40), (40, 40), (40, 80), (80, 80), (80, 120), (160, 160))
_TEXT = (
    "One setting changed at a time, on the trials of Table 1 with history; the last condition begins after four clean "
    "frames, since one-to-one assignment cannot begin with it. Per cent of the frames right with the 95 % interval, "
    "and the frames with a wrong identity. Only the front layer is in sight there; the rules that tell front from rear "
    "are measured on rendered frames of both, and the PnP solvers in the section of other people's methods."
)


def jobs(plan: Plan) -> list[Job]:
    """A job a change, one a size of the swarm, and one for the rules that tell front from rear."""
    grid, jobs = plan.grid, []
    for preset, changes in (("recommended", ABLATIONS), ("as_printed", FROM_PRINTED)):
        for number, change in enumerate(changes.values()):
            for missing, spurious in FAULTS:
                seeds = (grid.first_seed, grid.first_seed + grid.ablation_trials)
                arguments = (plan.dock, preset, change, (missing, spurious), seeds)
                jobs.append(
                    Job(
                        f"ablation-{preset}-{number}-{missing}-{spurious}",
                        1.5 * grid.ablation_trials,
                        ablated,
                        arguments,
                    )
                )
    sizes = ((plan.dock, size, (grid.first_seed, grid.first_seed + grid.ablation_trials)) for size in SIZES)
    jobs += [Job(f"swarm-size-{a[1][0]}-{a[1][1]}", 1.5 * grid.ablation_trials, swarm_size, a) for a in sizes]
    return jobs + layer_rules.jobs(plan)


def ablated(dock: Dock, preset: str, change: Change, faults: tuple[int, int], seeds: tuple[int, int]) -> dict[str, Any]:
    """The whole method with history and one change."""
    station, camera = dock.load()
    front = station.lights_of(station.layers_front_to_rear()[0])
    config, count = PaperConfig.model_validate({"preset": preset, **change}), Count()
    for seed in range(*seeds):
        localizer = PaperLocalizer(station, camera, config)
        clean = simulated_frames(trials_scenario(0, 0), station, camera, seed)
        faulty = simulated_frames(trials_scenario(*faults), station, camera, seed)
        in_view = [pair for pair in zip(clean, faulty, strict=True) if pair[1].in_view[front].all()]
        first = CLEAN_FRAMES if all(faults) else 0
        for before, _ in in_view[:first]:
            localizer.process_detections(before.detections)
        for _, frame in in_view[first:]:
            count += Count(1, *verdict(localizer.process_detections(frame.detections), frame))
    return asdict(count)


def swarm_size(dock: Dock, size: tuple[int, int], seeds: tuple[int, int]) -> dict[str, Any]:
    """The swarm alone, of a size, with three lights missing: right frames and the median time."""
    station, camera = dock.load()
    layer = station.layers_front_to_rear()[0]
    front, recommended = station.lights_of(layer), PaperConfig()
    pso = recommended.pso.model_copy(update={"particles": size[0], "iterations": size[1]})
    swarm = LayerLocalizer(station, layer, camera, recommended.model_copy(update={"pso": pso}))
    count, times = Count(), []
    for seed in range(*seeds):
        for frame in simulated_frames(trials_scenario(3, 0), station, camera, seed):
            if not frame.in_view[front].all():
                continue
            start = time.process_time()
            found = swarm.register(frame.detections.uv)
            times.append(time.process_time() - start)
            right = found is not None and np.array_equal(found.light, frame.light)
            count += Count(1, right, not right)
    return asdict(count) | {"ms": 1e3 * float(np.median(times)), "machine": machine()}


def section(_plan: Plan, results: Results) -> PageSection:
    """The changes from either preset, and the sizes."""
    tables = [
        _table(results, preset, changes)
        for preset, changes in (("recommended", ABLATIONS), ("as_printed", FROM_PRINTED))
    ]
    return PageSection(
        "Ablations and the size of the swarm",
        _TEXT,
        items=[*tables, layer_rules.table(results), _sizes(results), _sizes_plot(results)],
    )


def _table(results: Results, preset: str, changes: dict[str, Change]) -> Table:
    rows = []
    for number, name in enumerate(changes):
        counts = [Count(**results[f"ablation-{preset}-{number}-{m}-{s}"]) for m, s in FAULTS]
        rows.append(
            [name, *(share(one.right, one.frames) + f", {one.wrong} wrong" * bool(one.wrong) for one in counts)]
        )
    head = ["change", "3 missing", "1 missing", "2 spurious", "1 missing + 1 spurious, after a clean start"]
    start = "the recommended preset" if preset == "recommended" else "the preset as printed"
    return Table(f"Changes of {start}; frames right, %.", head, rows)


def _sizes(results: Results) -> Table:
    rows = []
    for particles, iterations in SIZES:
        r = results[f"swarm-size-{particles}-{iterations}"]
        rows.append([f"{particles} x {iterations}", str(r["frames"]), share(r["right"], r["frames"]), f"{r['ms']:.2f}"])
    where = results[f"swarm-size-{SIZES[0][0]}-{SIZES[0][1]}"]["machine"]
    caption = (
        "Particles x iterations of the swarm alone, wide bounds, three lights missing, for which the paper has 90.3 %; "
        f"CPU time on {where}."
    )
    return Table(caption, ["swarm", "frames", "right, %", "ms"], rows)


def _sizes_plot(results: Results) -> Plot:
    caption = (
        "Frames right over the median CPU time of the swarm, three lights missing; dotted line: the paper's 90.3 %."
    )
    return plot("swarm-sizes", caption, lambda f, _narrow: _draw(f, results), (2.6, 3.0))


def _draw(figure: Figure, results: Results) -> None:
    found = [(f"{a} x {b}", results[f"swarm-size-{a}-{b}"]) for a, b in SIZES]
    axes = figure.subplots()
    ms, right = [r["ms"] for _, r in found], [100.0 * r["right"] / r["frames"] for _, r in found]
    axes.semilogx(ms, right, marker="o", color=COLORS["rear"], lw=1.4)
    for x, y, (name, _) in zip(ms, right, found, strict=True):
        axes.annotate(name, (x, y), xytext=(4, -11), textcoords="offset points", color=COLORS["dim"], fontsize=7)
    axes.axhline(90.3, color=COLORS["front"], ls=":", lw=1)
    axes.set(xlabel="ms a frame", ylabel="right, %")
