"""Every experiment of the paper's section 4, and what it leaves open, by several methods, as one page."""

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
from lumidock.reproduce.experiments import EXPERIMENTS, jobs_of, sections_of
from lumidock.reproduce.grid import FULL, QUICK, Grid
from lumidock.reproduce.jobs import Progress, run_jobs
from lumidock.reproduce.plan import Dock, Plan
from lumidock.reproduce.tables import write_tables

__all__ = ["EXPERIMENTS", "FULL", "QUICK", "Dock", "Grid", "Plan", "reproduce"]


def reproduce(
    plan: Plan,
    *,
    only: Sequence[str] = (),
    force: bool = False,
    workers: int | None = None,
    progress: Progress = lambda _done, _total: None,
) -> dict[str, Any]:
    """Run what is not in the folder `plan.out` yet; writes report.html, tables.md, tables/ and results.json there.

    `only` are names of `EXPERIMENTS`; by default all are run. Returns the results by job. The same plan and version
    give the same numbers, times aside. Raises: InputError for a folder that holds something else, unless `force`.
    """
    jobs = jobs_of(plan, only)
    _prepare(plan.out, force)
    files = (Path(plan.dock.station), Path(plan.dock.camera))
    digest = hashlib.sha256(b"\0".join(file.read_bytes() for file in files)).hexdigest()
    workers = os.cpu_count() or 1 if workers is None else workers
    results = run_jobs(jobs, plan.out / "results", digest, workers=workers, progress=progress)
    sections = sections_of(plan, results, only)
    lead = f"The paper's method in two presets beside lumidock, with the paper's own figures; {plan.grid.name} grid."
    text = page.render("The paper's experiments, and what it left open", lead, [section for _, section in sections])
    page.write(plan.out / "report.html", text)
    write_tables(sections, plan.out)
    write_whole(plan.out / "results.json", json.dumps(results, indent=1, sort_keys=True))
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
