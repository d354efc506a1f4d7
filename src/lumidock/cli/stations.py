"""`lumidock station`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from lumidock.camera import load_camera
from lumidock.cli.shared import DEFAULT_CAMERA, AsJson, CameraOption, app, example, shipped_or_path
from lumidock.config import Config
from lumidock.evaluation.station_check import LEVELS, Requirements, inspect_station
from lumidock.station import load_station

station = typer.Typer(help="Check a dock's lights.", no_args_is_help=True, rich_markup_mode=None)
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
        float, typer.Option(metavar="PX", min=0.0, help="Least misfit of a wrong assignment of four lights at 18 m.")
    ] = 1.5,
    lights: Annotated[int, typer.Option(metavar="N", min=1, help="Lights of a layer that have to be in view ...")] = 4,
    from_z: Annotated[float, typer.Option(metavar="Z", help="... from this many metres to the docking point.")] = 20.0,
    dead: Annotated[int, typer.Option(metavar="N", min=0, max=2, help="Try any so many lights dead.")] = 2,
    speed: Annotated[
        float, typer.Option(metavar="M/S", min=0.02, help="Speed of the approach with lights dead.")
    ] = 0.2,
    as_json: AsJson = False,
) -> None:
    """Check what is in view, confused, measured, and left with lights dead; exit code 1 on failure."""
    from lumidock.evaluation.dead_lights import Approach
    from lumidock.evaluation.station_advice import dead_light_rows, warnings
    from lumidock.report.station_picture import draw_station

    dock = load_station(shipped_or_path("station", source))
    lens = load_camera(shipped_or_path("camera", camera or DEFAULT_CAMERA))
    result = inspect_station(dock, lens, Config(), Requirements(confusion_px, lights, from_z))
    approach = Approach(from_z, float(dock.docking_point[2]), speed, np.full(len(dock), np.inf))
    result["dead_lights"] = dead_light_rows(dock, lens, Config(), approach, dead)
    result["warnings"] = warnings(dock, lens, Config(), approach, result)
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
    print("alert limits:\n  " + result["alert_limits"].replace("; ", "\n  "))
    print("\nprotection levels to expect on a head-on approach to the docking point with all lights in view detected;")
    print("how far they are seen in your water is not considered here (`lumidock sim`):")
    print(f"{'z, m':>6}  {'stage':10}  {'lights in view':24}  lateral m  axial m  angle deg  bearing deg  range m")
    for row in result["corridor"]:
        print(_corridor_line(row))
    print(
        f"\n{'layer':10} {'seen':>4}   {'best-fitting wrong assignment':30}  best-fitting mirror image   (px at 18 m)"
    )
    for row in result["confusions"]:
        cells = [_misfit(row[f"{kind}_m"], row[f"{kind}_px"]) for kind in ("assignment", "mirror")]
        print(f"{row['layer']:10} {row['seen']:4}   {cells[0]:30}  {cells[1]}")
    _print_self_fits(result)
    _print_dead_lights(result["dead_lights"])
    print()
    print(_expected(result["corridor"]))
    for text in result["warnings"]:
        print(f"WARNING: {text}")
    for text in result["failed"]:
        print(f"FAILED: {text}")
    if not result["failed"]:
        print("all checks passed: enough lights in view, no wrong assignment or mirror image too close")


def _expected(corridor: list[dict[str, Any]]) -> str:
    """From where on the way a valid pose, and guidance, may be had."""
    lines = []
    for word, what in (("valid", "a valid pose is"), ("guide", "guidance (bearing and range) is")):
        at = [row["z_m"] for row in corridor if row[word]]
        where = f"from z = {max(at):g} m on, in {len(at)} of {len(corridor)} rows" if at else "nowhere on the way"
        lines.append(f"{what} to be expected {where}")
    return "\n".join(lines)


def _print_self_fits(result: dict[str, Any]) -> None:
    """What turns, moves or mirrors the array nearly onto itself, and from which roll on that is not safe."""
    print("\nthe array nearly fits itself when it is")
    for row in result["self_fits"]:
        turned = f"turned by {row['angle_deg']:.1f} degrees"
        what = {"rotation": turned, "mirror": f"mirrored and {turned}", "shift": f"moved by {row['shift_m']:.2f} m"}
        misfit = f"{row['misfit_m']:.3f} m, {row['misfit_px']:.2f} px at 18 m"
        print(f"  {what[row['kind']]:40} {row['lights']:3} lights within {misfit}")
    if not result["self_fits"]:
        print("  nowhere else")
    if result["unsafe_roll_deg"] is not None:
        print(f"unsafe beyond {result['unsafe_roll_deg']:.1f} degrees of roll without an attitude sensor")


def _print_dead_lights(rows: list[dict[str, Any]]) -> None:
    """The worst level over its limit on a slow approach, with more and more lights dead."""
    print("\nworst protection level over its alert limit on a slow approach; below 1 a pose is valid all the way")
    for row in rows:
        what = ("all lights lit", "any one dead", "any two dead")[row["dead"]]
        worst = f" without {' '.join(row['lights'])}" if row["lights"] else ""
        where = ", ".join(f"{a:.1f} to {b:.1f}" for a, b in row["not_valid"])
        over = f"; not valid at z {where} m" if where else ""
        print(f"  {what:14} {row['worst']:6.2f} at z {row['z_m']:.1f} m{worst}{over}")


def _corridor_line(row: dict[str, Any]) -> str:
    """One distance: what is in view, and whether a pose there can be valid."""
    if not any(row["lights"].values()):
        return f"{row['z_m']:6g}  {row['stage']:10}  no light in view"
    lights = ", ".join(f"{layer} {count}" for layer, count in row["lights"].items())
    numbers = [row[name] for name in LEVELS]
    widths = (9, 7, 9, 11, 7)
    levels = "  ".join(f"{'-':>{w}}" if n is None else f"{n:{w}.3f}" for n, w in zip(numbers, widths, strict=True))
    return f"{row['z_m']:6g}  {row['stage']:10}  {lights:24}  {levels}  {_verdict(row)}"


def _verdict(row: dict[str, Any]) -> str:
    """What is to be expected at one distance."""
    if row["lateral_m"] is None:
        return "no pose"
    words = [word for word in ("valid", "guide") if row[word]]
    return " and ".join(words) or "over the alert limits"


def _misfit(metres: float | None, pixels: float | None) -> str:
    return "too many to try" if metres is None or pixels is None else f"{metres:9.3f} m {pixels:9.2f} px"
