"""The paper's figures by `lumidock reproduce --quick`, in bench-out/reproduction."""

from __future__ import annotations

from pathlib import Path

from bench.shipped import CAMERA_FILE, STATION_FILE
from lumidock.reproduce import QUICK, Dock, Plan, reproduce
from lumidock.reproduce.summary import summary_table


def main() -> tuple[dict[str, object], list[str]]:
    """The first table of the page, without its caption."""
    dock = Dock(str(STATION_FILE), str(CAMERA_FILE))
    results = reproduce(Plan(QUICK, dock, Path("bench-out") / "reproduction"))
    return results, summary_table(results).splitlines()
