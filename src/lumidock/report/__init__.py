"""A run, or several, as one page for a person, made of the files of the run folders."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from lumidock.errors import InputError
from lumidock.evaluation.run_folders import find_runs
from lumidock.report import figures, page, tables
from lumidock.report.moments import pictures
from lumidock.report.page import Section
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
        raise InputError(f"{len(runs)} runs: at most {_MOST_RUNS} fit on a page that a person likes to read")
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


def sections_of(view: RunView, prefix: str, *, alone: bool, most_pictures: int | None = None) -> list[Section]:
    """What a page says of one run; `prefix` makes the names of its figures unique."""
    found = {plot.name.removeprefix(f"{prefix}-"): plot for plot in figures.of_run(view, prefix)}
    of = "" if alone else f": {view.name}"
    shown = pictures(view, (8 if alone else 2) if most_pictures is None else most_pictures)
    way = [found[name] for name in ("trajectory",) if name in found]
    errors = [found[name] for name in ("levels", "guide", "stanford") if name in found]
    worth = [table for table in (tables.by_range(view), tables.trust(view)) if table is not None]
    why = [table for table in (tables.reasons(view), tables.handover(view)) if table is not None]
    sections = [Section(f"How it went{of}", tiles=tables.tiles(view), items=way)]
    if shown:
        text = (
            "Rings are detections with the names of their lights, crosses where the pose puts each light; front lights "
            "amber, rear lights blue. A red ring with a number was turned down, and why is said below."
        )
        sections.append(Section(f"What the camera saw{of}", text, items=shown))
    if errors or worth:
        sections.append(Section(f"What it promised{of}", items=[*errors, *worth]))
    sections.append(Section(f"Lights, stages and reasons{of}", items=[found["lights"], found["states"], *why]))
    made = [found[name] for name in ("latency",) if name in found]
    sections.append(Section(f"Time and settings{of}", items=[*made, *tables.versions(view)]))
    return sections


def _in_brief(view: RunView, prefix: str) -> Section:
    """One run of many: its numbers, its way, and why it had no pose; the rest is on a page of its own."""
    way = [figures.trajectory(view, prefix, _POINTS_IN_BRIEF)] if view.valid.any() else []
    why = [table for table in (tables.reasons(view), tables.handover(view)) if table is not None]
    return Section(view.name, tiles=tables.tiles(view), items=[*way, *why])


def _together(views: Sequence[RunView]) -> Section:
    return Section("Side by side", items=[tables.comparison(views), *figures.comparison(views, "all")])


def _title(views: Sequence[RunView]) -> str:
    return f"Run {views[0].name}" if len(views) == 1 else f"{len(views)} runs"


def _lead(views: Sequence[RunView]) -> str:
    what = ", ".join(f"{view.name} ({view.described.get('method', '?')})" for view in views)
    truth = " With truth." if any(view.has_truth for view in views) else " There is no truth to hold it against."
    return f"lumidock {views[0].described.get('lumidock', '?')}: {what}.{truth}"
