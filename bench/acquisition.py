"""Acquisition counted: every frame of the campaigns without history, missing and spurious lights drawn anew."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from bench.shipped import CAMERA_FILE, STATION_FILE
from lumidock.evaluation.campaign import plan, prepare, run_campaign, tabulate
from lumidock.evaluation.campaign_table import markdown
from lumidock.sim.scenario import load_scenario

SEEDS = (100, 105)
SCENARIOS = (
    "missing-1",
    "missing-2",
    "missing-3",
    "spurious-1",
    "spurious-2",
    "missing-spurious",
    "beside",
    "joint",
    "joint-nocolor",
    "noise-2px",
    "clutter",
    "mirror-only",
)


def counted(
    name: str, scenarios: tuple[str, ...], seeds: tuple[int, int], *, cold: bool
) -> tuple[dict[str, Any], list[str]]:
    """The table of a campaign of the default method; what is done stays in bench-out, and the same call goes on."""
    campaign = plan(
        [load_scenario(one) for one in scenarios],
        ("lumidock",),
        seeds,
        STATION_FILE,
        CAMERA_FILE,
        cold=cold,
        bound=False,
    )
    out = Path("bench-out") / f"campaign-{name}"
    prepare(campaign, out, force=True)
    run_campaign(campaign, out)
    table = tabulate(campaign, out)
    return table, markdown(table).strip().splitlines()


def main() -> tuple[dict[str, Any], list[str]]:
    """One row a scenario."""
    return counted("acquisition", SCENARIOS, SEEDS, cold=True)
