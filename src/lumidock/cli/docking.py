"""`lumidock dock`: dockings in closed loop, one with its page and film, or many counted."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from lumidock.camera import load_camera
from lumidock.cli.progress import progress_bar
from lumidock.cli.shared import (
    DEFAULT_CAMERA,
    AsJson,
    CameraOption,
    Force,
    Out,
    StationOption,
    Workers,
    app,
    example,
    prepare_folder,
    seeds_of,
    shipped_or_path,
    tell_what_compiles,
)
from lumidock.errors import InputError
from lumidock.station import load_station

if TYPE_CHECKING:
    from lumidock.docking.campaign import InFull
    from lumidock.docking.loop import Docking, DockingResult
    from lumidock.report.docking_page import DockingView
    from lumidock.report.page import Tile

_MOST_IN_FULL = 4  # methods whose first docking is shown in full


@app.command(
    "dock",
    epilog=example(
        "lumidock dock docking --out DOCKING",
        "lumidock dock docking-hard --vehicle auv --method lumidock --method raw --seeds 0:100 --out CAMPAIGN",
    ),
)
def _dock(
    scenario: Annotated[str, typer.Argument(metavar="SCENARIO", help="docking, docking-hard, ..., or a .yaml file.")],
    out: Out,
    vehicle: Annotated[str, typer.Option("--vehicle", metavar="NAME", help="rov or auv.")] = "rov",
    methods: Annotated[
        list[str] | None,
        typer.Option("--method", metavar="NAME", help="lumidock (default), raw, paper, ...; may be repeated."),
    ] = None,
    seeds: Annotated[str, typer.Option(metavar="A:B", help="Seeds A to B - 1, a docking each.")] = "0:1",
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY.SUBKEY=VALUE", help="Of the scenario; may be repeated.")
    ] = None,
    rendered: Annotated[bool, typer.Option("--rendered", help="Give the method pictures; slow.")] = False,
    video: Annotated[bool, typer.Option("--video/--no-video", help="Film the first docking of a single seed.")] = True,
    workers: Workers = None,
    station: StationOption = None,
    camera: CameraOption = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Let a simulated vehicle dock by a method's fixes, and count."""
    from lumidock.docking.campaign import HEAD, counted, in_full, row, run_campaign
    from lumidock.docking.film import film
    from lumidock.docking.loop import Docking
    from lumidock.docking.methods import require_docking_method
    from lumidock.docking.vehicle import VEHICLES
    from lumidock.sim.scenario import load_scenario, station_of

    names = methods or ["lumidock"]
    for name in names:
        require_docking_method(name)
    if vehicle not in VEHICLES:
        raise InputError(f"--vehicle {vehicle}: there are {', '.join(VEHICLES)}")
    loaded, (first, stop) = load_scenario(scenario, tuple(settings or ())), seeds_of(seeds)
    dock = load_station(shipped_or_path("station", station) if station else station_of(loaded))
    lens = load_camera(shipped_or_path("camera", camera or DEFAULT_CAMERA))
    docking = Docking(loaded, dock, lens, VEHICLES[vehicle], names[0], first, rendered)
    tell_what_compiles()
    prepare_folder(out, force)
    shown = [in_full(replace(docking, method=name)) for name in names]
    with progress_bar("dock") as progress:
        others = run_campaign(replace(docking, seed=first + 1), names, stop - first - 1, workers or 1, progress)
    blocks = {one.block.method: [one.block, *others[one.block.method]] for one in shown}
    content = {name: counted(found) for name, found in blocks.items()}
    results = {name: [v.as_dict() for block in found for v in block.results] for name, found in blocks.items()}
    described = {"scenario": loaded.model_dump(mode="json"), "vehicle": vehicle, "seeds": [first, stop]}
    (out / "docking.json").write_text(json.dumps(described | {"methods": content, "dockings": results}, indent=1))
    if find_spec("matplotlib") and find_spec("jinja2"):
        _write_page(docking, shown[:_MOST_IN_FULL], content, out / "docking.html")
    if video and stop - first == 1 and find_spec("av"):
        film(docking, shown[0].moments, out / "docking.mp4")
    if as_json:
        print(json.dumps(described | {"methods": content}, indent=1))
        return
    for name, counts in content.items():
        print(" | ".join(f"{head} {cell}" for head, cell in zip(HEAD, row(name, counts), strict=True)))
    if stop - first == 1:
        for change in shown[0].result.log:
            print(f"{change.t_s:7.1f} s  {change.state:9} {change.why}")
    print(f"written to {out}")


def _write_page(docking: Docking, shown: Sequence[InFull], content: Mapping[str, Any], path: Path) -> None:
    """The page of a campaign and of the first docking of each method."""
    from lumidock.docking.campaign import HEAD, row
    from lumidock.go_no_go import WORDS
    from lumidock.report import page
    from lumidock.report.docking_page import docking_page

    runs = max(counts["runs"] for counts in content.values())
    tables = []
    if runs > 1 or len(content) > 1:
        rows = [row(name, counts) for name, counts in content.items()]
        tables.append(page.Table("Dockings counted against the truth.", HEAD, rows))
        bins = list(next(iter(content.values()))["by_current"])
        currents = [[name, *(f"{a} of {b}" for a, b in c["by_current"].values())] for name, c in content.items()]
        tables.append(page.Table("Docked, by the speed of the current in m/s.", ["method", *bins], currents))
        why = [[name, ", ".join(f"{word} {n}" for word, n in c["why"].items()) or "-"] for name, c in content.items()]
        tables.append(page.Table("Why the others did not dock.", ["method", "words"], why))
    lead = f"{docking.scenario.about}. Vehicle: {docking.vehicle.name}."
    views = [_view(docking, one) for one in shown]
    page.write(path, docking_page(f"Docking: {docking.scenario.name}", lead, views, tables, WORDS))


def _view(docking: Docking, one: InFull) -> DockingView:
    """One docking as the page wants it."""
    from lumidock.docking.vehicle import R_DOCK_APPROACH
    from lumidock.go_no_go import Passage
    from lumidock.report.docking_page import DockingView

    moments, result = one.moments, one.result
    passage = Passage.of(docking.station, docking.vehicle.radius_m)
    return DockingView(
        title=f"{one.block.method}, seed {result.seed}",
        station=docking.station,
        t_s=np.array([m.t_s for m in moments]),
        true_dock=np.array([m.T_dock_cam[:3, 3] for m in moments]),
        reckoned_dock=np.array([m.reckoned for m in moments]) @ R_DOCK_APPROACH.T,
        level_m=np.array([m.level_m for m in moments]),
        state=[m.step.state for m in moments],
        verdict=[m.step.advice.verdict for m in moments],
        word=[m.step.advice.word for m in moments],
        valid=np.array([m.fix is not None and m.fix.valid for m in moments]),
        guided=np.array([m.fix is not None and m.fix.guide is not None for m in moments]),
        changes=[[f"{c.t_s:.1f}", c.state, c.why] for c in result.log],
        tiles=_tiles(result),
        opening_m=passage.opening_m,
        vehicle_m=passage.vehicle_m,
    )


def _tiles(result: DockingResult) -> list[Tile]:
    from lumidock.report.page import Tile

    return [
        Tile(result.outcome, result.word, "good" if result.docked else "bad"),
        Tile(f"{result.time_s:.0f} s", "from the start"),
        Tile(f"{100.0 * result.miss_m:.0f} cm", "camera from the docking point at the end"),
        Tile(f"{result.room_m:.2f} m", "least room between hull and frame", "bad" if result.contact else "good"),
        Tile(f"{result.worst_fix_m:.2f} m", "largest error of a pose that was followed"),
        Tile(f"{result.current_m_s:.2f} m/s", "current"),
        Tile(str(result.tries), "times backed out"),
    ]
