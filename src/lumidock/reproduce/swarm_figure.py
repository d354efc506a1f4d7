"""Figure 6: the swarm of both presets on one frame, from its first iteration to its last."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from lumidock.config import Config, PaperConfig
from lumidock.paper.layer import LayerLocalizer
from lumidock.paper.normalize import normalize
from lumidock.paper.pso import register
from lumidock.report.page import PageSection, Plot
from lumidock.report.plots import COLORS, plot
from lumidock.reproduce.jobs import Job
from lumidock.reproduce.plan import Dock, Plan
from lumidock.reproduce.trials import trials_scenario
from lumidock.sim.detections import simulated_frames

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_NEAR_M = 9.0  # the first frame nearer than this is shown
_SHARES = (0.0, 0.1, 0.3, 1.0)  # of the iterations
_TEXT = (
    "The paper's figure 6 shows its particles in tx, ty and theta, coloured by scale, gathering over the iterations, "
    "with the registered points beside. The same here, on a frame with one front light missing. The paper does not "
    "say how many particles or iterations it drew."
)


def jobs(plan: Plan) -> list[Job]:
    """One job."""
    return [Job("figure-6", 3.0, trace, (plan.dock, plan.config, plan.grid.first_seed))]


def trace(dock: Dock, config: Config, seed: int) -> dict[str, Any]:
    """Places and fitness of all particles at a few iterations, the fitness over all, and the registration."""
    station, camera = dock.load()
    layer = station.layers_front_to_rear()[0]
    frame = next(
        f for f in simulated_frames(trials_scenario(1, 0), station, camera, seed) if f.T_dock_cam[2, 3] < _NEAR_M
    )
    result: dict[str, Any] = {"z_m": float(frame.T_dock_cam[2, 3]), "detections": len(frame.light)}
    for name, paper in (("as printed", PaperConfig(preset="as_printed")), ("recommended", config.paper)):
        localizer = LayerLocalizer(station, layer, camera, paper)
        steps = np.zeros((paper.pso.iterations, paper.pso.particles, 5))
        lights_xy, rng = localizer.p_dock[:, :2], np.random.default_rng(paper.pso.seed)
        found = register(localizer.plane(frame.detections.uv), lights_xy, None, paper.pso, rng, steps)
        shown = sorted({round(share * (len(steps) - 1)) for share in _SHARES})
        result[name] = {
            "iterations": shown,
            "particles": steps[shown].round(4).tolist(),
            "reach": paper.pso.shift[1],
            "best": np.minimum.accumulate(steps[:, :, 4].min(axis=1)).tolist(),
            "mean": steps[:, :, 4].mean(axis=1).tolist(),
            "lights": normalize(lights_xy).points.tolist(),
            "placed": np.nan_to_num(found.placed, nan=99.0).tolist(),
            "right": int((found.light == frame.light).sum()),
        }
    return result


def section(_plan: Plan, results: Mapping[str, Any]) -> PageSection:
    """The particles of both presets, and their fitness."""
    result = results["figure-6"]
    plots = [_particles(result, name) for name in ("as printed", "recommended")]
    return PageSection("Figure 6: the swarm", _TEXT, items=[*plots, _fitness(result)])


def _particles(result: dict[str, Any], name: str) -> Plot:
    one = result[name]
    count = len(one["particles"][0])
    caption = (
        f"{count} particles, {len(one['best'])} iterations ({name}), {result['detections']} detections from z = "
        f"{result['z_m']:.1f} m: tx, ty and theta (degrees), coloured by scale from cyan (small) to pink. Last panel: "
        f"the lights (rings) and where the best transform puts the detections (crosses); {one['right']} of "
        f"{result['detections']} identities are right."
    )
    return plot(f"swarm-{name.replace(' ', '-')}", caption, lambda f, narrow: _draw(f, narrow, one), (3.1, 9.0))


def _draw(figure: Figure, narrow: bool, one: dict[str, Any]) -> None:
    panels = len(one["particles"]) + 1
    rows, columns = (-(-panels // 2), 2) if narrow else (1, panels)
    scales, reach = np.array(one["particles"])[..., 1], (-one["reach"], one["reach"])
    for k, (iteration, particles) in enumerate(zip(one["iterations"], one["particles"], strict=True)):
        axes: Any = figure.add_subplot(rows, columns, k + 1, projection="3d")
        theta, s, tx, ty, _ = np.array(particles).T
        axes.scatter(tx, ty, np.rad2deg(theta), c=s, s=9, cmap="cool", vmin=0.0, vmax=scales.max(), depthshade=False)
        axes.set(title=f"iteration {iteration + 1}", xlabel="tx", ylabel="ty", zlim=(-10, 10), xlim=reach, ylim=reach)
        axes.tick_params(labelsize=6, pad=-2)
        for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
            axis.set_pane_color((0.5, 0.5, 0.5, 0.06))
            axis.labelpad = -4
    _draw_registration(figure.add_subplot(rows, columns, panels), one)


def _draw_registration(axes: Axes, one: dict[str, Any]) -> None:
    lights, placed = np.array(one["lights"]), np.array(one["placed"])
    placed = placed[np.abs(placed[:, 0]) < 50.0]
    axes.scatter(lights[:, 0], lights[:, 1], s=60, facecolors="none", edgecolors=COLORS["front"], lw=1.4)
    axes.scatter(placed[:, 0], placed[:, 1], s=28, marker="x", color=COLORS["rear"], lw=1.3)
    axes.set(title="registered", aspect="equal", xlim=(-1.3, 1.3), ylim=(-1.3, 1.3))


def _fitness(result: dict[str, Any]) -> Plot:
    caption = (
        "Fitness (sum of the distances, normalised) over the iterations: best so far (lines) and mean of the particles "
        "(dashed); recommended (blue), as printed (amber). Restarts keep the mean up."
    )
    return plot("swarm-fitness", caption, lambda f, _narrow: _draw_fitness(f, result), (2.6, 3.0))


def _draw_fitness(figure: Figure, result: dict[str, Any]) -> None:
    axes = figure.subplots()
    for name, color in (("as printed", "front"), ("recommended", "rear")):
        axes.semilogy(result[name]["best"], color=COLORS[color], lw=1.6)
        axes.semilogy(result[name]["mean"], color=COLORS[color], lw=1.0, ls="--")
    axes.set(xlabel="iteration", ylabel="fitness")
