"""`lumidock export`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from lumidock.cli.progress import progress_bar
from lumidock.cli.shared import (
    AsJson,
    Force,
    Fps,
    Topic,
    VehicleOption,
    app,
    example,
    interrupts_held,
    require_new,
    told_at_interrupt,
)
from lumidock.streams.source import Reading
from lumidock.streams.sources import open_source
from lumidock.streams.vehicle import load_vehicle


@app.command(
    "export",
    epilog=example(
        "lumidock export RUN fixes.mcap --source dive.mcap --vehicle vehicle.yaml",
        "lumidock export RUN fixes.rrd --source SEQ",
        "lumidock export RUN annotated.mp4 --source SEQ",
        "lumidock export RUN fixes.parquet",
    ),
)
def _export(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder.")],
    target: Annotated[Path, typer.Argument(metavar="FILE", help="File ending in .mcap, .rrd, .mp4 or .parquet.")],
    source: Annotated[
        Path | None, typer.Option("--source", metavar="SOURCE", help="What RUN was made from, for its pictures.")
    ] = None,
    vehicle: VehicleOption = None,
    topic: Topic = None,
    fps: Fps = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Turn RUN into a file for ROS 2, Rerun, video players or tables."""
    from lumidock.streams.export import export

    require_new(target, force)
    opened = open_source(source, Reading(fps, topic)) if source else None
    mounting = load_vehicle(vehicle) if vehicle else None
    left = f"{target} is not written"
    with told_at_interrupt(left), interrupts_held() as let_interrupt, progress_bar("export") as progress:

        def on_frame(done: int, total: int | None) -> None:
            progress(done, total)
            let_interrupt()

        frames = export(run, target, opened, mounting, progress=on_frame)
    print(json.dumps({"frames": frames, "file": str(target)}) if as_json else f"{frames} frames written to {target}")
