"""The sections of a reproduction: the jobs of each, and what its part of the page shows."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from lumidock.errors import InputError
from lumidock.report.page import PageSection
from lumidock.reproduce import (
    ablations,
    acquisition,
    associations,
    comparison,
    docking,
    envelope,
    extraction,
    hazards,
    search,
    summary,
    swarm_figure,
    table1,
    tuning,
)
from lumidock.reproduce.jobs import Job
from lumidock.reproduce.plan import Plan

Results = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Experiment:
    """A section by the name that `--only` takes; its `jobs`, and the `section` that their results make."""

    name: str
    jobs: Callable[[Plan], list[Job]]
    section: Callable[[Plan, Results], PageSection]


EXPERIMENTS = (
    Experiment("table-1", table1.jobs, table1.section),
    Experiment("figure-6", swarm_figure.jobs, swarm_figure.section),
    Experiment("figure-7-11", associations.filter_jobs, associations.filter_section),
    Experiment("figure-9-10", associations.jobs, associations.section),
    Experiment("search", search.jobs, search.section),
    Experiment("docking", docking.jobs, docking.section),
    Experiment("acquisition", acquisition.jobs, acquisition.section),
    Experiment("comparison", comparison.jobs, comparison.section),
    Experiment("ablations", ablations.jobs, ablations.section),
    Experiment("tuning", tuning.jobs, tuning.section),
    Experiment("extraction", extraction.jobs, extraction.section),
    Experiment("envelope", envelope.jobs, envelope.section),
    Experiment("hazards", hazards.jobs, hazards.section),
)


def chosen(only: Sequence[str]) -> list[Experiment]:
    """The experiments by name, in the order of the page; all without a name. Raises: InputError for an unknown one."""
    names = [experiment.name for experiment in EXPERIMENTS]
    for name in only:
        if name not in names:
            raise InputError(f"--only {name}: no such section; there are {', '.join(names)}")
    return [experiment for experiment in EXPERIMENTS if not only or experiment.name in only]


def jobs_of(plan: Plan, only: Sequence[str] = ()) -> list[Job]:
    """The jobs of the chosen sections, in the order of the page."""
    return [job for experiment in chosen(only) for job in experiment.jobs(plan)]


def sections_of(plan: Plan, results: Results, only: Sequence[str] = ()) -> list[tuple[str, PageSection]]:
    """The chosen sections by name, after a summary of what is in them."""
    experiments = chosen(only)
    sections = [(experiment.name, experiment.section(plan, results)) for experiment in experiments]
    if {"table-1", "docking"} & {experiment.name for experiment in experiments}:
        sections.insert(0, ("summary", summary.section(results)))
    return sections
