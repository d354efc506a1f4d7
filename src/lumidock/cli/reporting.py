"""`lumidock report` and `lumidock reproduce`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from lumidock.cli.progress import progress_bar
from lumidock.cli.shared import (
    DEFAULT_CAMERA,
    DEFAULT_STATION,
    AsJson,
    CameraOption,
    ConfigOption,
    Force,
    StationOption,
    Workers,
    app,
    example,
    require_new,
    shipped_or_path,
    told_at_interrupt,
)


@app.command(
    "report",
    epilog=example(
        "lumidock report RUN --out run.html",
        "lumidock report RUN --source SEQ --out run.html",
        "lumidock report RUN-A RUN-B --source SEQ --out both.html",
    ),
)
def _report(
    runs: Annotated[
        list[Path],
        typer.Argument(metavar="RUN...", help="Run folders, or folders with runs in them; several are compared."),
    ],
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="The page, one HTML file.")],
    sources: Annotated[
        list[Path] | None,
        typer.Option(
            "--source", metavar="SOURCE", help="What they were made from, for pictures and truth; one, or one a run."
        ),
    ] = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Write one HTML page about RUN that needs no network."""
    from lumidock.report import page, report

    require_new(out, force)
    with told_at_interrupt(f"{out} is not written"), progress_bar("report") as progress:
        text = report(runs, sources or (), progress=progress)
    page.write(out, text)
    size = len(text.encode())
    print(json.dumps({"file": str(out), "bytes": size}) if as_json else f"{out}: {size / 1e6:.1f} MB")


@app.command(
    "reproduce",
    epilog=example(
        "lumidock reproduce --quick --out REPRODUCTION",
        "lumidock reproduce --only table-1 --only docking --out REPRODUCTION",
        "lumidock reproduce --full --out REPRODUCTION",
    ),
)
def _reproduce(
    out: Annotated[
        Path,
        typer.Option(
            "--out", metavar="DIR", help="Folder to write; the same command continues an interrupted reproduction."
        ),
    ],
    full: Annotated[bool, typer.Option("--full/--quick", help="Hours, or minutes (default).")] = False,
    only: Annotated[
        list[str] | None, typer.Option("--only", metavar="SECTION", help="This section only; may be repeated.")
    ] = None,
    methods: Annotated[
        list[str] | None, typer.Option("--method", metavar="NAME", help="A further method; may be repeated.")
    ] = None,
    config: ConfigOption = None,
    workers: Workers = None,
    station: StationOption = None,
    camera: CameraOption = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Repeat the paper's experiments, as one page."""
    from lumidock.config import Config, load_config
    from lumidock.methods import METHODS, require_method
    from lumidock.reproduce import FULL, QUICK, Dock, Plan, reproduce

    for method in methods or ():
        require_method(method)
    extra = tuple(name for name in dict.fromkeys(methods or ()) if name not in METHODS)
    dock = Dock(
        str(shipped_or_path("station", station or DEFAULT_STATION)),
        str(shipped_or_path("camera", camera or DEFAULT_CAMERA)),
    )
    plan = Plan(FULL if full else QUICK, dock, out, load_config(config) if config else Config(), extra)
    left = f"{out} holds the finished parts; the same command continues with the others"
    with told_at_interrupt(left), progress_bar("reproduce, s of work") as progress:
        results = reproduce(plan, only=only or (), force=force, workers=workers, progress=progress)
    if as_json:
        print(json.dumps(results, indent=1))
        return
    print((out / "tables.md").read_text(encoding="utf-8"))
    print(f"look at {out / 'report.html'}")
