"""A run, or several, as one HTML page, made from the files of the run folders."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from lumidock.errors import InputError
from lumidock.evaluation import run_description
from lumidock.evaluation.run_folders import find_runs
from lumidock.report import figures, page, tables
from lumidock.report.moments import annotated_images
from lumidock.report.page import PageSection, Table
from lumidock.report.view import RunView, load_run

_MOST_RUNS, _MOST_IN_FULL = 12, 3
_POINTS_IN_BRIEF = 150


def report(
    runs: Sequence[Path],
    sources: Sequence[Path] = (),
    *,
    progress: Callable[[int, int | None], None] = lambda _done, _total: None,
) -> str:
    """The page of one run or several, as HTML that needs nothing else.

    A folder with runs in it stands for all of them. `sources` holds one for all runs, or one for each, for pictures and
    truth; without it they are looked for beside the runs. Raises: InputError, one line, for a folder that is no run, or
    a source that a run was not made from.
    """
    runs = [run for folder in runs for run in find_runs(folder)]
    if len(runs) > _MOST_RUNS:
        raise InputError(f"{len(runs)} runs: at most {_MOST_RUNS} on one page")
    if len(sources) not in (0, 1, len(runs)):
        raise InputError(f"{len(sources)} sources for {len(runs)} runs: wanted one for all, or one for each")
    given = [None] * len(runs) if not sources else [*sources] * (len(runs) if len(sources) == 1 else 1)
    views = [load_run(run, source) for run, source in zip(runs, given, strict=True)]
    sections = [_together(views)] if len(views) > 1 else []
    for k, view in enumerate(views):
        progress(k, len(views))
        if len(views) > _MOST_IN_FULL:
            sections.append(_in_brief(view, f"r{k + 1}"))
        else:
            sections += sections_of(view, f"r{k + 1}", alone=len(views) == 1)
    progress(len(views), len(views))
    return page.render(_title(views), _lead(views), sections)


def sections_of(view: RunView, prefix: str, *, alone: bool, most_images: int | None = None) -> list[PageSection]:
    """The sections about one run, the images first; `prefix` makes the ids of its figures unique on the page."""
    found = {plot.name.removeprefix(f"{prefix}-"): plot for plot in figures.of_run(view, prefix)}
    of = "" if alone else f": {view.name}"
    shown = annotated_images(view, (9 if alone else 1) if most_images is None else most_images)
    path = [found[name] for name in ("trajectory",) if name in found]
    errors = [found[name] for name in ("levels", "guide", "stanford") if name in found]
    judged = [table for table in (tables.by_range(view), tables.integrity(view)) if table is not None]
    why = _why(view)
    sections = [PageSection(f"Result{of}", tiles=tables.tiles(view), items=[*shown[:1], *path])]
    if shown:
        sections[0] = replace(sections[0], text=_legend(view))
    if shown[1:]:
        sections.append(PageSection(f"Moments of the run{of}", items=shown[1:]))
    if errors or judged:
        sections.append(PageSection(f"Errors and protection levels{of}", items=[*errors, *judged]))
    sections.append(PageSection(f"Lights, stages and reasons{of}", items=[found["lights"], found["states"], *why]))
    latency = [found[name] for name in ("latency",) if name in found]
    sections.append(PageSection(f"Time and settings{of}", items=[*latency, *tables.versions(view)]))
    return sections


def _why(view: RunView) -> list[Table]:
    """Tables of what kept frames from being valid, and of the stages."""
    found = (tables.reasons(view), tables.contradictions(view), tables.handover(view))
    return [table for table in found if table is not None]


def _legend(view: RunView) -> str:
    """What the marks on the images mean, with the colours of the layers that this dock has."""
    words = ("amber", "blue", "green", "violet")
    layers = [f"{layer} {words[k % len(words)]}" for k, layer in enumerate(view.station.layers_front_to_rear())]
    return (
        f"A ring is a detection with the id of the light that it was identified as ({', '.join(layers)}); a cross is "
        "where the pose puts a light. Red rings were not used, for the reasons below the image; rings near each other "
        "share a number."
    )


def _in_brief(view: RunView, prefix: str) -> PageSection:
    """One run of many: its numbers, its trajectory and its reasons; the rest is on the page of that run alone."""
    path = [figures.trajectory(view, prefix, _POINTS_IN_BRIEF)] if view.valid.any() else []
    why = _why(view)
    return PageSection(view.name, tiles=tables.tiles(view), items=[*path, *why])


def _together(views: Sequence[RunView]) -> PageSection:
    return PageSection("Comparison", items=[tables.comparison(views), *figures.comparison(views, "all")])


def _title(views: Sequence[RunView]) -> str:
    return f"Run {views[0].name}" if len(views) == 1 else f"{len(views)} runs"


def _lead(views: Sequence[RunView]) -> str:
    what = ", ".join(f"{view.name} ({view.described.get('method', '?')})" for view in views)
    truth = " With truth." if any(view.has_truth for view in views) else " There is no truth to compare it with."
    cut = [view for view in views if run_description.finished(view.described) is False]
    unfinished = "".join(f" {view.name} is not finished: {len(view.fixes)} frames so far." for view in cut)
    return f"lumidock {views[0].described.get('lumidock', '?')}: {what}.{truth}{unfinished}"
