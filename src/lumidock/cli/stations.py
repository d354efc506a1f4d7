"""`lumidock station`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from lumidock.camera import load_camera
from lumidock.cli.shared import DEFAULT_CAMERA, AsJson, CameraOption, app, example, shipped_or_path
from lumidock.config import Config
from lumidock.station import load_station

station = typer.Typer(help="Look at docks.", no_args_is_help=True, rich_markup_mode=None)
app.add_typer(station, name="station")


@station.command(
    "check",
    epilog=example(
        "lumidock station check dock.yaml --camera camera.yaml --picture dock.png",
        "lumidock station check cage-2x2x5 --json",
    ),
)
def _check(
    source: Annotated[str, typer.Argument(metavar="FILE", help="Station file, or the name of a shipped one.")],
    camera: CameraOption = None,
    picture: Annotated[Path | None, typer.Option(metavar="PNG", help="Draw the array there.")] = None,
    confusion_px: Annotated[
        float, typer.Option(metavar="PX", min=0.0, help="Least misfit of a wrong naming of four lights at 18 m.")
    ] = 1.5,
    lights: Annotated[int, typer.Option(metavar="N", min=1, help="Lights of a layer that have to be in view ...")] = 4,
    from_z: Annotated[float, typer.Option(metavar="Z", help="... from this many metres to the docking point.")] = 20.0,
    as_json: AsJson = False,
) -> None:
    """Say what can be seen and confused; exit code 1 when it falls short."""
    from lumidock.evaluation.station_check import Limits, inspect_station
    from lumidock.report.station_picture import draw_station

    dock = load_station(shipped_or_path("station", source))
    lens = load_camera(shipped_or_path("camera", camera or DEFAULT_CAMERA))
    result = inspect_station(dock, lens, Config(), Limits(confusion_px, lights, from_z))
    if picture is not None:
        draw_station(dock, result, picture)
    if as_json:
        print(json.dumps(result, indent=1))
    else:
        _print(result)
    if result["failed"]:
        raise typer.Exit(1)


def _print(result: dict[str, Any]) -> None:
    layers = ", ".join(f"{layer} {count}" for layer, count in result["layers"].items())
    print(f"{result['name']}: {layers} lights")
    print(f"\n{'z, m':>6}  {'stage':10}  {'lights in view':24}  expected levels: lateral m, axial m, angle deg")
    for row in result["corridor"]:
        lights = ", ".join(f"{layer} {count}" for layer, count in row["lights"].items())
        numbers = [row[name] for name in ("lateral_m", "axial_m", "angle_deg")]
        levels = "  ".join("      -" if number is None else f"{number:7.3f}" for number in numbers)
        print(f"{row['z_m']:6g}  {row['stage']:10}  {lights:24}  {levels}  {'valid' if row['valid'] else ''}")
    print(f"\n{'layer':10} {'seen':>4}   best-fitting wrong naming     best-fitting mirror image   (px at 18 m)")
    for row in result["confusions"]:
        cells = [_misfit(row[f"{kind}_m"], row[f"{kind}_px"]) for kind in ("naming", "mirror")]
        print(f"{row['layer']:10} {row['seen']:4}   {cells[0]:28}  {cells[1]}")
    print()
    for text in result["failed"] or ["all checks passed"]:
        print(text if not result["failed"] else f"FAILED: {text}")


def _misfit(metres: float | None, pixels: float | None) -> str:
    return "too many to try" if metres is None or pixels is None else f"{metres:9.3f} m {pixels:9.2f} px"
