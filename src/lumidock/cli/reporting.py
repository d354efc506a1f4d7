"""`lumidock report`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lumidock.cli.shared import Force, app, example, progress_bar
from lumidock.errors import InputError


@app.command(
    "report",
    epilog=example(
        "lumidock report RUN --out run.html",
        "lumidock report RUN --source SEQ --out run.html",
        "lumidock report RUN-A RUN-B --source SEQ --out both.html",
    ),
)
def _report(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Run folders; several are compared.")],
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="The page, one HTML file.")],
    sources: Annotated[
        list[Path] | None,
        typer.Option(
            "--source", metavar="SOURCE", help="What they were made from, for pictures and truth; one, or one a run."
        ),
    ] = None,
    force: Force = False,
) -> None:
    """Show how RUN went as one page that opens without network."""
    from lumidock import page
    from lumidock.report import report

    if out.exists() and not force:
        raise InputError(f"{out}: exists; give --force to replace it")
    with progress_bar("report") as progress:
        text = report(runs, sources or (), progress=progress)
    page.write(out, text)
    print(f"{out}: {len(text.encode()) / 1e6:.1f} MB")
