"""Writes a Rerun blueprint: python blueprint.py lumidock.rbl; then rerun fixes.rrd lumidock.rbl."""

from __future__ import annotations

import sys

import rerun.blueprint as rrb

PICTURE, DOCK, NUMBERS, WORDS = "dock/camera/image", "dock", "plots", "log"


def blueprint() -> rrb.Blueprint:
    """Picture with lights beside the dock in space; below them numbers and reasons."""
    levels = [f"{NUMBERS}/pl_lateral_m", f"{NUMBERS}/pl_axial_m"]
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(
                rrb.Spatial2DView(origin=PICTURE, name="Picture"), rrb.Spatial3DView(origin=DOCK, name="Dock")
            ),
            rrb.Horizontal(
                rrb.TimeSeriesView(origin=NUMBERS, contents=levels, name="Protection levels, m"),
                rrb.TimeSeriesView(origin=NUMBERS, contents=[f"{NUMBERS}/latency_ms"], name="Latency, ms"),
                rrb.TextLogView(origin=WORDS, name="Reasons"),
            ),
            row_shares=[3, 1],
        ),
        collapse_panels=True,
    )


if __name__ == "__main__":
    blueprint().save("lumidock", sys.argv[1])
