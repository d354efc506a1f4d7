"""Acquisition where the paper says that its method fails, or says nothing: one frame, no history."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from lumidock.report.page import PageSection, Table
from lumidock.reproduce.associations import answers
from lumidock.reproduce.intervals import share
from lumidock.reproduce.jobs import Job
from lumidock.reproduce.plan import Plan, title
from lumidock.reproduce.work import Simulation, acquisition_trial

SCENARIOS = {
    "missing and spurious together": "missing-spurious",
    "all of them beside the array": "beside",
    "layer confusion: 30 % of the layer labels wrong": "joint",
    "layer confusion: no labels at all": "joint-nocolor",
    "no dock, only foreign lights": "clutter",
    "only the mirror image in view": "mirror-only",
}
_TEXT = (
    "The paper's conclusion says that missing and spurious lights together defeat its method before its first fix. "
    "Answers are frames with identities; right ones have every identity right, wrong ones at least one wrong, and the "
    "other answers leave lights out. On the last two rows every answer would be wrong."
)


def jobs(plan: Plan) -> list[Job]:
    """A job a scenario."""
    settings = (f"path.count={plan.grid.draws}",)
    return [
        Job(
            f"acquisition-{scenario}",
            0.06 * plan.grid.draws,
            acquisition_trial,
            (Simulation(plan.dock, scenario, settings, plan.grid.first_seed), plan.methods, plan.config),
            code=plan.code,
        )
        for scenario in SCENARIOS.values()
    ]


def section(plan: Plan, results: Mapping[str, Any]) -> PageSection:
    """Answers, right and wrong ones of every method."""
    rows = []
    for name, scenario in SCENARIOS.items():
        r, cells = results[f"acquisition-{scenario}"], []
        for method in plan.methods:
            cells += [share(r[method]["answered"], r["frames"]), *answers(r, method)]
        rows.append([name, str(r["frames"]), *cells])
    head = [word for name in plan.methods for word in (f"{title(name)}: answers, %", "right, %", "wrong")]
    table = Table("One frame, no history.", ["acquisition", "frames", *head], rows)
    return PageSection("Acquisition that the paper leaves open", _TEXT, items=[table])
