"""Tables of the paper's experiments by `lumidock reproduce --quick`, in bench-out/reproduction."""

from __future__ import annotations

from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from bench.shipped import CAMERA_FILE, STATION_FILE
from lumidock.evaluation.campaign import source_digest
from lumidock.report.page import PageSection, Table, markdown
from lumidock.reproduce import QUICK, Dock, Plan, reproduce
from lumidock.reproduce.experiments import sections_of


class Shown:
    """The tables of one section of the page, all or those of some numbers."""

    def __init__(self, section: str, *numbers: int) -> None:
        self.section, self.numbers = section, numbers

    def main(self) -> tuple[dict[str, Any], list[str]]:
        """The tables with their captions; what is done stays in the folder, and the same call goes on."""
        tables = [item for item in reproduced()[self.section].items if isinstance(item, Table)]
        chosen = [tables[number] for number in self.numbers or range(len(tables))]
        lines = [f"Seeds from {QUICK.first_seed}; lumidock {version('lumidock')}+{source_digest()}."]
        for table in chosen:
            lines += ["", *markdown(table).strip().splitlines()]
        return {table.caption: [list(table.head), *map(list, table.rows)] for table in chosen}, lines


@cache
def reproduced() -> dict[str, PageSection]:
    """The sections of the page by name."""
    plan = Plan(QUICK, Dock(str(STATION_FILE), str(CAMERA_FILE)), Path("bench-out") / "reproduction")
    return dict(sections_of(plan, reproduce(plan)))


TABLES = {
    "reproduced": Shown("summary"),
    "table-1-swarms": Shown("table-1", 0),
    "table-1-methods": Shown("table-1", 1),
    "table-1-layouts": Shown("table-1", 2, 3, 4, 5),
    "table-1-rendered": Shown("table-1", 6),
    "ablations": Shown("ablations"),
    "extraction": Shown("extraction"),
    "rectangle": Shown("search"),
    "paper-docking": Shown("docking"),
    "open-acquisition": Shown("acquisition"),
    "comparison": Shown("comparison", 0, 1),
    "solvers": Shown("comparison", 2),
    "tuning": Shown("tuning"),
    "waters": Shown("envelope"),
}
