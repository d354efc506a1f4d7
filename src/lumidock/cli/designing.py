"""`lumidock station design`: the lights of a dock that is not built yet."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from lumidock.camera import load_camera
from lumidock.cli.progress import progress_bar
from lumidock.cli.scratch import scratch_folder
from lumidock.cli.shared import (
    DEFAULT_CAMERA,
    DEFAULT_STATION,
    AsJson,
    CameraOption,
    Force,
    example,
    require_new,
    shipped_or_path,
)
from lumidock.cli.stations import station
from lumidock.config import Config
from lumidock.station import load_station


@station.command("design", epilog=example("lumidock station design cage.spec.yaml --out dock.yaml --page dock.html"))
def _design(
    source: Annotated[str, typer.Argument(metavar="SPEC", help="Design file, or the name of a shipped one.")],
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="Station file to write.")],
    camera: CameraOption = None,
    page: Annotated[Path | None, typer.Option(metavar="HTML", help="Write a page about the dock there.")] = None,
    seed: Annotated[int | None, typer.Option(metavar="N", min=1, help="In place of the file's seed.")] = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Place lights where the worst case along the approach, with lights dead, is best."""
    from lumidock.evaluation.dead_lights import dead_sets, least_confusion_m, strength
    from lumidock.setup.design import approach_of, design, load_spec
    from lumidock.setup.station_files import write_station_file

    for file in (out, page):
        if file is not None:
            require_new(file, force)
    spec = load_spec(shipped_or_path("stations/design", source))
    spec = spec if seed is None else spec.model_copy(update={"seed": seed})
    lens = load_camera(shipped_or_path("camera", camera or DEFAULT_CAMERA))
    with scratch_folder() as work, progress_bar("design") as progress:
        found = design(spec, lens, Config(), work / "layout.yaml", progress)
        judged = strength(
            found.station, lens, Config(), approach_of(spec, found.station), dead_sets(len(found.station), spec.dead)
        )
    confusion = least_confusion_m(found.station, np.deg2rad(spec.roll_deg))
    worst = int(judged.ratio.argmax())
    dead = [found.station.ids[i] for i in judged.dead[int(judged.worst[worst])]]
    told = (
        f"worst level over limit {judged.ratio[worst]:.2f} at z {judged.z_m[worst]:.1f} m with"
        f" {', '.join(dead) or 'none'} dead;"
        f" least confusion {', '.join(f'{k} {v:.3f} m' for k, v in confusion.items())}"
    )
    options = "" if seed is None else f" --seed {seed}"
    about = f"Made by: lumidock station design {Path(source).name} --out {out.name}{options}\n{told}"
    write_station_file(dict(found.content), out, about)
    if page is not None:
        from lumidock.report import page as pages
        from lumidock.report.design_page import DesignView, design_page

        rival = load_station(shipped_or_path("station", DEFAULT_STATION))
        reach = dict.fromkeys(rival.color, max(spec.reach_m.values())) | spec.reach_m
        rival_approach = approach_of(spec.model_copy(update={"reach_m": reach}), rival)
        rival_judged = strength(rival, lens, Config(), rival_approach, dead_sets(len(rival), min(spec.dead, 1)))
        alone = strength(
            found.station, lens, Config(), approach_of(spec, found.station), dead_sets(len(found.station), 1)
        )
        view = DesignView(found.station, rival, judged, rival_judged, alone, confusion, spec.dead, told)
        pages.write(page, design_page(view))
    figures = {"worst_ratio": float(judged.ratio[worst]), "at_z_m": float(judged.z_m[worst]), "dead": dead}
    if as_json:
        print(json.dumps(figures | {"confusion_m": confusion, "evaluations": found.evaluations}, indent=1))
    else:
        print(f"{told}; {found.evaluations} layouts tried; written to {out}")


@station.command("strength", epilog=example("lumidock station strength dock.yaml --dead 2 --speed 0.2"))
def _strength(
    source: Annotated[str, typer.Argument(metavar="FILE", help="Station file, or the name of a shipped one.")],
    camera: CameraOption = None,
    dead: Annotated[int, typer.Option(metavar="N", min=0, max=2, help="Any so many lights may be dead.")] = 2,
    speed: Annotated[float, typer.Option(metavar="M/S", min=0.02, help="Speed of the approach.")] = 0.2,
    from_z: Annotated[float, typer.Option(metavar="Z", help="Judged from here to the docking point.")] = 20.0,
    reach: Annotated[float, typer.Option(metavar="M", min=1.0, help="How far the water shows a light.")] = 27.0,
    as_json: AsJson = False,
) -> None:
    """Say what a dock still gives with lights dead; exit code 1 where the pose would not be valid."""
    from lumidock.evaluation.dead_lights import Approach, dead_sets, least_confusion_m, strength

    dock = load_station(shipped_or_path("station", source))
    lens = load_camera(shipped_or_path("camera", camera or DEFAULT_CAMERA))
    approach = Approach(from_z, min(float(dock.docking_point[2]), 0.0), speed, np.full(len(dock), reach))
    judged = strength(dock, lens, Config(), approach, dead_sets(len(dock), dead))
    rows: list[dict[str, Any]] = [
        {"z_m": z, "ratio": float(judged.ratio[k]), "dead": [dock.ids[i] for i in judged.dead[int(judged.worst[k])]]}
        for z in range(int(from_z), int(approach.to_z_m) - 1, -1)
        for k in [int(np.abs(judged.z_m - z).argmin())]
    ]
    confusion = least_confusion_m(dock)
    if as_json:
        print(json.dumps({"worst": float(judged.ratio.max()), "approach": rows, "confusion_m": confusion}, indent=1))
    else:
        print(f"{'z, m':>6}  level over limit   worst with these dead")
        for row in rows:
            verdict = "" if row["ratio"] < 1.0 else "NOT VALID"
            print(f"{row['z_m']:6}  {row['ratio']:16.2f}   {', '.join(row['dead']) or 'none':16} {verdict}")
        print(f"least confusion: {', '.join(f'{layer} {m:.3f} m' for layer, m in confusion.items())}")
    if judged.ratio.max() >= 1.0:
        raise typer.Exit(1)
