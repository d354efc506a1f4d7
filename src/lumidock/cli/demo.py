"""`lumidock demo`."""

from __future__ import annotations

import json
import sys
from collections import deque
from pathlib import Path
from typing import Any

from lumidock.camera import load_camera
from lumidock.cli.progress import progress_bar
from lumidock.cli.shared import (
    DEFAULT_CAMERA,
    DEFAULT_STATION,
    AsJson,
    Force,
    Out,
    Seed,
    app,
    copy,
    example,
    interrupts_held,
    prepare_folder,
    prepare_sequence,
    shipped_or_path,
    tell_what_compiles,
    told_at_interrupt,
)
from lumidock.config import Config
from lumidock.datatypes import Fix
from lumidock.station import load_station
from lumidock.streams.source import Item
from lumidock.streams.sources import open_source


@app.command("demo", epilog=example("lumidock demo --force"))
def _demo(
    out: Out = Path("demo-out"),
    seed: Seed = 0,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Simulate a docking, run it, and leave files and pictures."""
    from lumidock.app.demo import missing_extras, summary_lines
    from lumidock.evaluation.metrics import evaluate

    prepare_folder(out, force)
    with told_at_interrupt(f"{out} holds what was written so far; `lumidock demo --out {out} --force` begins again"):
        _compile()
        _simulate(out / "sequence", seed)
        counts, shown = _run(out)
        result = evaluate(out / "run", out / "sequence")
        shown += _pages(out)
    if as_json:
        files = [str(path) for path in shown]
        print(json.dumps({"counts": counts, "evaluation": result, "files": files}, indent=1))
        return
    print("\n".join(summary_lines(result, counts)))
    print(f"look at     {', '.join(map(str, shown))}")
    for name, gives in missing_extras().items():
        print(f"not made    {gives}: {install_hint(name)}")


def install_hint(extra: str) -> str:
    """How to add an extra, to an installed package and to a checkout."""
    return f"pip install 'lumidock[{extra}]', or in a checkout pip install -e '.[{extra}]'"


def _compile() -> None:
    """Compile what is not compiled yet, so that the progress of what follows tells how long it takes."""
    from lumidock.app.warm import compile_all, compiled_code

    if compiled_code().mark != "note":
        tell_what_compiles()
        return
    print(
        "compiling the numerical kernels, once for each installation: one to two minutes", file=sys.stderr, flush=True
    )
    dock, lens = (
        shipped_or_path(kind, name) for kind, name in (("station", DEFAULT_STATION), ("camera", DEFAULT_CAMERA))
    )
    deque(compile_all(load_station(dock), load_camera(lens)), maxlen=0)


def _simulate(sequence: Path, seed: int) -> None:
    """Render the docking into a sequence folder."""
    from lumidock.app.demo import SCENARIO, SETTINGS
    from lumidock.sim.scenario import load_scenario
    from lumidock.sim.sequence import write_rendered

    prepare_sequence(sequence, True)
    station_file = shipped_or_path("station", DEFAULT_STATION)
    dock, lens = load_station(station_file), load_camera(shipped_or_path("camera", DEFAULT_CAMERA))
    copy(station_file, sequence / "station.yaml")
    with progress_bar("simulating") as progress:
        write_rendered(load_scenario(SCENARIO, SETTINGS), dock, lens, seed, sequence, progress=progress)


def _run(out: Path) -> tuple[dict[str, Any], list[Path]]:
    """Localize the sequence; returns the counts of the run, and the files to look at."""
    from lumidock.app.demo import Album
    from lumidock.app.run import Setup
    from lumidock.app.run import run as run_source
    from lumidock.localizer import Localizer
    from lumidock.report.stills import contact_sheet
    from lumidock.streams.run_folder import RunFolder

    sequence, run_folder, video = out / "sequence", out / "run", out / "annotated.mp4"
    station_file, camera_file = sequence / "station.yaml", sequence / "camera.yaml"
    dock, lens, source = load_station(station_file), load_camera(camera_file), open_source(sequence)
    video.unlink(missing_ok=True)
    with (
        RunFolder(run_folder, dock.ids) as folder,
        progress_bar("localizing") as progress,
        interrupts_held() as let_interrupt,
        Album(dock, lens, video) as album,
    ):

        def on_fix(item: Item, fix: Fix) -> None:
            album.add(item, fix)
            progress(len(album.fixes), source.count)
            let_interrupt()

        progress(0, source.count)
        copy(station_file, run_folder / "station.yaml")
        copy(camera_file, run_folder / "camera.yaml")
        setup = Setup("lumidock", False, Config(), station_file, camera_file)
        summary = run_source(source, Localizer(dock, lens), folder, setup, on_fix=on_fix)
    contact_sheet(album.sheet(), out / "stages.jpg")
    shown = [out / "stages.jpg", *([video] if video.exists() else []), run_folder / "fixes.csv"]
    return summary.as_dict(), shown


def _pages(out: Path) -> list[Path]:
    """Write the report and the trajectory, where the extra `report` is installed; returns their paths."""
    from lumidock.app.demo import missing_extras
    from lumidock.evaluation.metrics import true_poses
    from lumidock.report import page, report
    from lumidock.report.stills import plot_trajectory
    from lumidock.streams.replay import read_fixes

    if "report" in missing_extras():
        return []
    dock = load_station(out / "run" / "station.yaml")
    fixes = [fix for fix, _, _ in read_fixes(out / "run", dock.ids)]
    plot_trajectory(fixes, true_poses(out / "sequence"), dock, out / "trajectory.png")
    page.write(out / "report.html", report([out / "run"], [out / "sequence"]))
    return [out / "report.html", out / "trajectory.png"]
