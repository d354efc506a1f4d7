"""Every shipped fault counted: what becomes of each, inside and outside the assumptions of the safety case."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from bench.shipped import CAMERA_FILE
from lumidock.evaluation.campaign import plan, prepare, run_campaign, tabulate
from lumidock.evaluation.campaign_table import fault_table
from lumidock.sim.scenario import load_scenarios

SEEDS = (600, 602)


def main() -> tuple[dict[str, Any], list[str]]:
    """One row a fault; what is done stays in bench-out, and the same call goes on."""
    campaign = plan(load_scenarios(["faults"]), ("lumidock",), SEEDS, None, CAMERA_FILE)
    out = Path("bench-out") / "campaign-faults"
    prepare(campaign, out, force=True)
    run_campaign(campaign, out)
    table = tabulate(campaign, out)
    return table, fault_table(table["rows"]).splitlines()
