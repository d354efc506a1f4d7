"""The figures of a run's report, a function each."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import TYPE_CHECKING, Any

import numpy as np

from lumidock.datatypes import Array
from lumidock.report.page import Plot
from lumidock.report.plots import COLORS, plot
from lumidock.report.view import KINDS, STAGES, RunView

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MOST_POINTS = 700  # of a series; of longer runs every k-th frame is drawn, and all that is over its level
_ELLIPSES = 14
_SHORT_SPAN, _SOME_SPAN = 4.0, 50.0  # of a logarithmic axis: below them ticks are even, and stand at 1, 2 and 5 as well
_SHOWN = {"lateral": ("lateral, m", 1.0), "axial": ("axial, m", 1.0), "angle": ("angle, deg", 180.0 / np.pi)}
_LAYER_COLORS = ("front", "rear", "transition", "accent")  # variables of the page, in the order of streams.colors
_RUN_COLORS = ("rear", "front", "transition", "accent", "bad", "search")


def of_run(view: RunView, prefix: str) -> list[Plot]:
    """All figures of one run that its files allow; `prefix` makes their names unique on a page."""
    figures = [trajectory(view, prefix), levels(view, prefix)] if view.valid.any() else []
    if view.guided.any():
        figures.append(guide(view, prefix))
    if np.isfinite(view.errors).any() and np.isfinite(view.levels).any():
        figures.append(stanford(view, prefix))
    figures += [lights(view, prefix), states(view, prefix)]
    if np.isfinite(view.latency_ms).any():
        figures.append(latency([view], prefix))
    return figures


def _thinned(view: RunView, most: int = _MOST_POINTS) -> np.ndarray:
    """Frames (N,) to draw: all, or every k-th of a long run and all whose error is over its level."""
    n = len(view.fixes)
    keep = np.zeros(n, bool)
    keep[:: max(1, -(-n // most))] = True
    with np.errstate(invalid="ignore"):
        return keep | (view.errors > view.levels).any(axis=1)


def _stage_of(view: RunView) -> np.ndarray:
    return np.array([fix.stage for fix in view.fixes])


# Trajectory


def trajectory(view: RunView, prefix: str, most_points: int = _MOST_POINTS) -> Plot:
    """Top and side view with two-sigma ellipses, protection levels and alert limits, of so many frames at most."""
    truth = " The thin line is the truth." if view.has_truth else ""
    caption = (
        "Where the camera was in the dock frame: from above (x to the right) and from the side (y up), over the "
        "distance z before the entrance plane, all in metres; the vehicle comes from the left. Points are valid poses, "
        "coloured by docking stage; ellipses 2 sigma; the band is the lateral protection level, dotted lines the alert "
        f"limit.{truth} Stars are lights."
    )
    return plot(
        f"{prefix}-trajectory", caption, lambda f, narrow: _draw_trajectory(f, narrow, view, most_points), (6.0, 6.4)
    )


def _draw_trajectory(figure: Figure, narrow: bool, view: RunView, most_points: int) -> None:
    keep = _thinned(view, most_points)
    panels = figure.subplots(2, 1, sharex=True)
    for axes, column, label in zip(panels, (0, 1), ("x, m", "y, m"), strict=True):
        _draw_bands(axes, view, keep, column)
        axes.plot(view.true_position[keep, 2], view.true_position[keep, column], color=COLORS["ink"], lw=0.9)
        _scatter_stages(axes, view, keep, view.position[:, 2], view.position[:, column], legend=column == 0)
        _draw_ellipses(axes, view, column)
        p_dock = view.station.p_dock
        axes.scatter(p_dock[:, 2], p_dock[:, column], marker="*", s=34, color=COLORS["accent"], zorder=4)
        axes.axvline(0.0, color=COLORS["line"], lw=1)
        axes.set_ylabel(label)
        axes.set_ylim(*_reach(view, column))
    _label_stages(panels[0], narrow)
    panels[1].set_xlabel("z, m")
    panels[1].invert_xaxis()


def _reach(view: RunView, column: int) -> tuple[float, float]:
    """A range of the axis that holds the lights, the poses and the truth, but not every wild band."""
    known = np.concatenate([view.position[:, column], view.true_position[:, column], view.station.p_dock[:, column]])
    known = known[np.isfinite(known)]
    low, high = np.percentile(known, (1, 99))
    margin = 0.35 * max(high - low, 1.0)
    return float(min(low, known.min()) - margin), float(max(high, known.max()) + margin)


def _draw_bands(axes: Axes, view: RunView, keep: np.ndarray, column: int) -> None:
    which = keep & view.valid
    order = np.flatnonzero(which)[np.argsort(view.position[which, 2])]
    z, at = view.position[order, 2], view.position[order, column]
    axes.fill_between(z, at - view.levels[order, 0], at + view.levels[order, 0], color=COLORS["rear"], alpha=0.16, lw=0)
    for sign in (-1.0, 1.0):
        axes.plot(z, at + sign * view.limits[order, 0], color=COLORS["bad"], lw=1, ls=":")


def _draw_ellipses(axes: Axes, view: RunView, column: int) -> None:
    """Two-sigma ellipses of evenly chosen fixes in the plane of z and `column`."""
    from matplotlib.patches import Ellipse

    known = [k for k, fix in enumerate(view.fixes) if fix.covariance is not None]
    for k in known[:: max(1, len(known) // _ELLIPSES)]:
        covariance = view.fixes[k].covariance
        assert covariance is not None
        values, vectors = np.linalg.eigh(covariance[np.ix_((2, column), (2, column))])
        size = 4.0 * np.sqrt(np.maximum(values, 0.0))
        angle = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
        axes.add_patch(
            Ellipse(
                (view.position[k, 2], view.position[k, column]),
                size[1],
                size[0],
                angle=angle,
                fill=False,
                color=COLORS["ink"],
                lw=0.8,
                zorder=3,
            )
        )


def _scatter_stages(axes: Axes, view: RunView, keep: np.ndarray, x: Array, y: Array, *, legend: bool = False) -> None:
    stage = _stage_of(view)
    for name in STAGES:
        which = keep & (stage == name) & np.isfinite(x) & np.isfinite(y)
        if which.any():
            axes.scatter(x[which], y[which], s=7, color=COLORS[name], label=name if legend else None, lw=0)


def _label_stages(axes: Axes, narrow: bool) -> None:
    if axes.get_legend_handles_labels()[0]:
        axes.legend(
            loc="lower left",
            bbox_to_anchor=(0.0, 1.0),
            ncols=4,
            markerscale=2.2,
            borderaxespad=0.1,
            handletextpad=0.1,
            columnspacing=0.8 if narrow else 1.6,
        )


# Errors and protection levels


def levels(view: RunView, prefix: str) -> Plot:
    """Protection levels, alert limits and, where there is a truth, errors over time."""
    error = "Points are errors against the truth, coloured by stage; the" if view.has_truth else "The"
    caption = (
        f"Errors of the poses over time in seconds. {error} line is the protection level, which the error exceeds at "
        "most once in a million frames; dotted: the alert limit, over which a pose is not valid. Logarithmic."
    )
    return plot(f"{prefix}-levels", caption, lambda f, narrow: _draw_levels(f, narrow, view), (6.2, 7.0))


def _draw_levels(figure: Figure, narrow: bool, view: RunView) -> None:
    keep, panels = _thinned(view), figure.subplots(3, 1, sharex=True)
    for k, (axes, kind) in enumerate(zip(panels, KINDS, strict=True)):
        label, scale = _SHOWN[kind]
        _draw_level_and_limit(axes, view, keep, (view.levels[:, k] * scale, view.limits[:, k] * scale))
        _scatter_stages(axes, view, keep, view.t_s, np.maximum(view.errors[:, k] * scale, 1e-4), legend=k == 0)
        axes.set_ylabel(label)
        _label_plainly(axes)
    _label_stages(panels[0], narrow)
    panels[-1].set_xlabel("time, s")


def _draw_level_and_limit(axes: Axes, view: RunView, keep: np.ndarray, level_and_limit: tuple[Array, Array]) -> None:
    level, limit = level_and_limit
    axes.plot(view.t_s[keep], level[keep], color=COLORS["rear"], lw=1.2)
    axes.plot(view.t_s[keep], limit[keep], color=COLORS["bad"], lw=1.2, ls=":")
    if np.isfinite(level).any() or np.isfinite(limit).any():
        axes.set_yscale("log")


def _label_plainly(axes: Axes) -> None:
    """Numbers as people write them on a logarithmic axis of y, and as many as its span has room for."""
    from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator

    if axes.get_yscale() != "log":
        return
    low, high = axes.get_ylim()
    axes.yaxis.set_major_formatter(lambda value, _at: f"{value:g}")
    axes.yaxis.set_minor_formatter(lambda value, _at: f"{value:g}" if high < _SOME_SPAN * low else "")
    if high < _SHORT_SPAN * low:  # too short for powers of ten
        axes.yaxis.set_major_locator(MaxNLocator(4))
        axes.yaxis.set_minor_locator(NullLocator())
    elif high < _SOME_SPAN * low:
        axes.yaxis.set_minor_locator(LogLocator(subs=(2.0, 5.0)))


def guide(view: RunView, prefix: str) -> Plot:
    """Range over time, and protection levels, alert limits and errors of bearing and range."""
    error = "Points are errors against the truth; the" if view.has_truth else "The"
    caption = (
        "Bearing and range of the dock, over time in seconds: the range in metres, then the errors of bearing and "
        f"range. {error} line is the protection level, dotted the alert limit; both end "
        f"{view.station.alert_limits.guide.from_m:.3g} m before the dock, from where on the limits of the pose apply."
    )
    return plot(f"{prefix}-guide", caption, lambda f, _narrow: _draw_guide(f, view), (5.6, 6.6))


def _draw_guide(figure: Figure, view: RunView) -> None:
    keep, panels = _thinned(view), figure.subplots(3, 1, sharex=True)
    panels[0].plot(view.t_s[keep], view.guide[keep, 2], color=COLORS["transition"], lw=1.6)
    panels[0].set_ylabel("range, m")
    for axes, k, scale, label in ((panels[1], 0, 180.0 / np.pi, "bearing, deg"), (panels[2], 1, 1.0, "range error, m")):
        limit = np.where(np.isfinite(view.guide_limits[:, k]), view.guide_limits[:, k], np.nan)
        far = keep & np.isfinite(limit)
        _draw_level_and_limit(axes, view, far, (view.guide_levels[:, k] * scale, limit * scale))
        _scatter_stages(axes, view, far, view.t_s, np.maximum(view.guide_errors[:, k] * scale, 1e-4))
        axes.set_ylabel(label)
        _label_plainly(axes)
    panels[-1].set_xlabel("time, s")


def stanford(view: RunView, prefix: str) -> Plot:
    """Error against protection level, both as shares of the alert limit."""
    caption = (
        "Stanford diagram: each valid pose by its error and its protection level, both divided by its alert limit. "
        "Above the diagonal the error is within its level; below it the error is over its level (misleading); in the "
        "shaded corner it is over the alert limit as well (hazardous), where no point should be."
    )
    return plot(f"{prefix}-stanford", caption, lambda f, narrow: _draw_stanford(f, narrow, view), (3.9, 9.6))


def _draw_stanford(figure: Figure, narrow: bool, view: RunView) -> None:
    keep = _thinned(view)
    panels = figure.subplots(*((3, 1) if narrow else (1, 3)))
    for k, (axes, kind) in enumerate(zip(panels, KINDS, strict=True)):
        error, level = (np.clip(values[:, k] / view.limits[:, k], 1.1e-4, 9.0) for values in (view.errors, view.levels))
        axes.fill_between([1.0, 10.0], 1e-4, 1.0, color=COLORS["bad"], alpha=0.18, lw=0)
        axes.plot([1e-4, 10.0], [1e-4, 10.0], color=COLORS["dim"], lw=1)
        axes.axhline(1.0, color=COLORS["bad"], lw=1, ls=":")
        axes.axvline(1.0, color=COLORS["bad"], lw=1, ls=":")
        _scatter_stages(axes, view, keep, error, level)
        axes.set(xscale="log", yscale="log", xlim=(1e-4, 10.0), ylim=(1e-4, 10.0), title=kind, aspect="equal")
        axes.set_xlabel("error / alert limit")
        if narrow or k == 0:
            axes.set_ylabel("level / alert limit")


# Lights, stages and reasons


def lights(view: RunView, prefix: str) -> Plot:
    """A row for each light: when it was identified."""
    truth = " Grey: it was visible, by the truth." if view.visible is not None else ""
    caption = (
        f"When each light was identified, over time in seconds; a row for each light, coloured by layer.{truth} Below: "
        "the number of detections that were identified as no light (spurious, or not used)."
    )
    rows = len(view.station.ids)
    return plot(
        f"{prefix}-lights", caption, lambda f, _narrow: _draw_lights(f, view), (1.2 + 0.19 * rows, 1.4 + 0.21 * rows)
    )


def _draw_lights(figure: Figure, view: RunView) -> None:
    ids, layers = view.station.ids, view.station.layers_front_to_rear()
    axes, below = figure.subplots(2, 1, sharex=True, height_ratios=[len(ids), 2.6])
    order = [int(light) for layer in layers for light in view.station.lights_of(layer)]
    for row, light in enumerate(order):
        identified = np.array([fix.match is not None and bool((fix.match.light == light).any()) for fix in view.fixes])
        color = _LAYER_COLORS[layers.index(view.station.layers[view.station.layer[light]]) % len(_LAYER_COLORS)]
        if view.visible is not None:
            axes.broken_barh(_spans(view, view.visible[:, light]), (row - 0.42, 0.84), color=COLORS["line"], lw=0)
        axes.broken_barh(_spans(view, identified), (row - 0.28, 0.56), color=COLORS[color], lw=0)
    axes.set_yticks(range(len(order)), [ids[light] for light in order])
    axes.set_ylim(len(order) - 0.4, -0.6)
    axes.grid(axis="y", visible=False)
    spurious = [0 if fix.match is None else int((fix.match.light < 0).sum()) for fix in view.fixes]
    below.step(view.t_s, spurious, where="post", color=COLORS["bad"], lw=1)
    below.set(ylabel="not\nused", xlabel="time, s", ylim=(0, max(*spurious, 3) * 1.1))


def _spans(view: RunView, which: np.ndarray) -> list[tuple[float, float]]:
    """Stretches (start s, length s) of the frames (N,) that `which` marks, each up to the frame after it.

    In long runs neighbouring frames are merged, so that a single one is still wide enough to be seen.
    """
    known = np.isfinite(view.t_s)
    starts = np.arange(0, known.sum(), max(1, -(-int(known.sum()) // _MOST_POINTS)))
    t = view.t_s[known][starts]
    which = np.logical_or.reduceat(which[known], starts) if len(starts) else which[:0]
    typical = float(np.median(np.diff(t))) if len(t) > 1 else 1.0
    spans = []
    for wanted, group in groupby(range(len(t)), key=lambda k: bool(which[k])):
        frames = list(group)
        if wanted:
            spans.append((float(t[frames[0]]), float(t[frames[-1]] - t[frames[0]]) + max(typical, 1e-3)))
    return spans


def states(view: RunView, prefix: str) -> Plot:
    """Docking stages, frames with a pose or a guide, and the reasons for no pose."""
    layers = view.station.layers_front_to_rear()
    stages = (
        "the docking stage" if len(layers) > 1 else f"the docking stage (front: the dock's only layer, {layers[0]})"
    )
    caption = (
        f"Over time in seconds: {stages}, frames with a valid pose, frames with bearing and range (guide), and a row "
        "for each reason why there was no valid pose."
    )
    reasons = sorted({fix.reason for fix in view.fixes if fix.reason})
    height = 1.3 + 0.24 * (3 + len(reasons))
    return plot(f"{prefix}-states", caption, lambda f, _narrow: _draw_states(f, view, reasons), (height, height))


def _draw_states(figure: Figure, view: RunView, reasons: Sequence[str]) -> None:
    axes, stage = figure.subplots(), _stage_of(view)
    for name in STAGES:
        if (stage == name).any():
            axes.broken_barh(_spans(view, stage == name), (-0.38, 0.76), color=COLORS[name], lw=0, label=name)
    rows = [("valid", view.valid, "transition"), ("guide", view.guided, "rear")]
    rows += [(word, np.array([fix.reason == word for fix in view.fixes]), "bad") for word in reasons]
    for row, (_, which, color) in enumerate(rows, start=1):
        axes.broken_barh(_spans(view, which), (row - 0.32, 0.64), color=COLORS[color], lw=0)
    axes.set_yticks(range(len(rows) + 1), ["stage", *(name.replace("_", " ") for name, _, _ in rows)])
    axes.set_ylim(len(rows) + 0.6, -0.6)
    axes.grid(axis="y", visible=False)
    axes.set_xlabel("time, s")
    axes.legend(
        loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=4, borderaxespad=0.1, columnspacing=0.8, handlelength=1.0
    )


def latency(views: Sequence[RunView], prefix: str) -> Plot:
    """Histogram of the time that a frame took."""
    caption = "Time that a frame took in milliseconds, decoding excluded; logarithmic. Dashed: the 95th percentile."
    return plot(f"{prefix}-latency", caption, lambda f, _narrow: _draw_latency(f, views), (2.8, 2.9))


def _draw_latency(figure: Figure, views: Sequence[RunView]) -> None:
    axes = figure.subplots()
    known = [view.latency_ms[np.isfinite(view.latency_ms)] for view in views]
    everything = np.maximum(np.concatenate(known), 1e-3)
    edges = np.geomspace(0.8 * everything.min(), 1.25 * everything.max(), 48)
    for k, (view, ms) in enumerate(zip(views, known, strict=True)):
        color = COLORS[_RUN_COLORS[k % len(_RUN_COLORS)]]
        axes.hist(
            np.maximum(ms, 1e-3), edges.tolist(), color=color, alpha=0.75 if len(views) == 1 else 0.5, label=view.name
        )
        axes.axvline(float(np.percentile(ms, 95)), color=color, ls="--", lw=1)
    axes.set(xscale="log", xlabel="ms a frame", ylabel="frames")
    axes.xaxis.set_major_formatter(lambda value, _at: f"{value:g}")
    axes.xaxis.set_minor_formatter(lambda _value, _at: "")
    if len(views) > 1:
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2)  # above: bars may be high anywhere


# Several runs


def comparison(views: Sequence[RunView], prefix: str) -> list[Plot]:
    """Figures of several runs together."""
    figures = []
    if any(np.isfinite(view.errors).any() for view in views):
        caption = (
            "Errors of the valid poses over the true distance z before the entrance plane in metres; logarithmic. Each "
            "run has its colour."
        )
        figures.append(plot(f"{prefix}-errors", caption, lambda f, narrow: _draw_errors(f, narrow, views), (6.2, 7.0)))
    caption = "When each run had a valid pose (thick) and bearing and range (thin), over time in seconds."
    height = 1.0 + 0.42 * len(views)
    figures.append(plot(f"{prefix}-use", caption, lambda f, _narrow: _draw_use(f, views), (height, height)))
    timed = [view for view in views if np.isfinite(view.latency_ms).any()]
    return [*figures, latency(timed, prefix)] if timed else figures


def _draw_errors(figure: Figure, narrow: bool, views: Sequence[RunView]) -> None:
    panels = figure.subplots(3, 1, sharex=True)
    for k, (axes, kind) in enumerate(zip(panels, KINDS, strict=True)):
        label, scale = _SHOWN[kind]
        for n, view in enumerate(views):
            keep, color = _thinned(view, _MOST_POINTS // len(views)), COLORS[_RUN_COLORS[n % len(_RUN_COLORS)]]
            error = np.maximum(view.errors[keep, k] * scale, 1e-4)
            axes.scatter(
                view.true_position[keep, 2], error, s=6, color=color, lw=0, label=view.name if k == 0 else None
            )
        axes.set(yscale="log", ylabel=label)
    panels[-1].set_xlabel("true z, m")
    panels[-1].invert_xaxis()
    panels[0].legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=1 if narrow else 3, markerscale=2.2)


def _draw_use(figure: Figure, views: Sequence[RunView]) -> None:
    axes: Any = figure.subplots()
    for row, view in enumerate(views):
        color = COLORS[_RUN_COLORS[row % len(_RUN_COLORS)]]
        axes.broken_barh(_spans(view, view.valid), (row - 0.36, 0.44), color=color, lw=0)
        axes.broken_barh(_spans(view, view.guided), (row + 0.14, 0.16), color=color, lw=0)
    axes.set_yticks(range(len(views)), [view.name[:18] for view in views])
    axes.set_ylim(len(views) - 0.4, -0.6)
    axes.grid(axis="y", visible=False)
    axes.set_xlabel("time, s")
