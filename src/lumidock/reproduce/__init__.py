"""Every experiment of the paper's section 4 by both methods, and what the paper leaves open, as one page."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lumidock.errors import InputError
from lumidock.evaluation.campaign import read_json, write_whole
from lumidock.report import page
from lumidock.report.page import PageSection, Table
from lumidock.reproduce.experiments import jobs_of
from lumidock.reproduce.grid import FULL, QUICK, Grid
from lumidock.reproduce.jobs import Progress, run_jobs
from lumidock.reproduce.sections import sections_of

__all__ = ["FULL", "QUICK", "Grid", "reproduce"]


def reproduce(
    grid: Grid,
    station_file: Path,
    camera_file: Path,
    out: Path,
    *,
    force: bool = False,
    workers: int | None = None,
    progress: Progress = lambda _done, _total: None,
) -> dict[str, Any]:
    """Run what is not in the folder `out` yet; writes report.html, tables.md and results.json there.

    Returns the results by job. The same grid, dock and version give the same numbers, times aside. Raises: InputError
    for a folder that holds something else, unless `force`.
    """
    _prepare(out, force)
    dock = (str(station_file), str(camera_file))
    digest = hashlib.sha256(station_file.read_bytes() + b"\0" + camera_file.read_bytes()).hexdigest()
    workers = os.cpu_count() or 1 if workers is None else workers
    jobs = jobs_of(grid, dock, out)
    results = run_jobs(jobs, out / "results", digest, workers=workers, progress=progress)
    sections = sections_of(grid, results, out)
    lead = f"Both methods side by side on the {grid.name} grid, with the paper's own figures beside them."
    page.write(out / "report.html", page.render("The paper's experiments, and what it left open", lead, sections))
    write_whole(out / "tables.md", _tables(sections))
    write_whole(out / "results.json", json.dumps(results, indent=1, sort_keys=True))
    return results


def _prepare(out: Path, force: bool) -> None:
    """Make the folder, or take up an earlier reproduction."""
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file")
    mark = out / "reproduction.json"
    if out.exists() and any(out.iterdir()) and read_json(mark) is None and not force:
        raise InputError(f"{out}: exists and is no reproduction; give --force to write into it")
    out.mkdir(parents=True, exist_ok=True)
    write_whole(mark, json.dumps({"what": "lumidock reproduce"}))


def _tables(sections: Sequence[PageSection]) -> str:
    """All tables of the page as Markdown, under the titles of their sections."""
    parts = []
    for section in sections:
        tables = [page.markdown(item) for item in section.items if isinstance(item, Table)]
        if tables:
            parts += [f"## {section.title}\n", *tables]
    return "\n".join(parts)
