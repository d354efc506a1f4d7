"""`lumidock calib`."""

from __future__ import annotations

import json
import re
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from lumidock.camera import Camera, load_camera
from lumidock.cli.shared import AsJson, Force, app, example, file_given, open_any, require_new
from lumidock.datatypes import Frame
from lumidock.errors import InputError
from lumidock.streams.source import Reading

calib = typer.Typer(help="Read, write and check camera calibrations.", no_args_is_help=True, rich_markup_mode=None)
app.add_typer(calib, name="calib")

_ANY_FPS = 1.0  # times do not matter here

Size = Annotated[str | None, typer.Option("--size", metavar="WxH", help="Image size that it has to be for.")]


@calib.command("import", epilog=example("lumidock calib import camchain.yaml camera.yaml --name cam1"))
def _import(
    source: Annotated[Path, typer.Argument(metavar="FILE", help="Calibration file of any tool that is read.")],
    target: Annotated[Path, typer.Argument(metavar="CAMERA", help="camera_info file to write.")],
    name: Annotated[str | None, typer.Option(metavar="NAME", help="Which camera of a file of several.")] = None,
    size: Size = None,
    force: Force = False,
) -> None:
    """Turn FILE into a camera_info file."""
    from lumidock.setup.calibration_files import read_calibration, write_calibration

    camera = read_calibration(source, name=name, size=_size(size))
    require_new(target, force)
    write_calibration(camera, target, "ros")
    print(f"{camera.width} x {camera.height}, {camera.model}, written to {target}")


@calib.command("export", epilog=example("lumidock calib export camera.yaml camchain.yaml --to kalibr"))
def _export(
    source: Annotated[str, typer.Argument(metavar="CAMERA", help="camera_info file, or the name of a shipped one.")],
    target: Annotated[Path, typer.Argument(metavar="FILE", help="File to write.")],
    form: Annotated[str, typer.Option("--to", metavar="FORM", help="ros, kalibr or opencv.")],
    force: Force = False,
) -> None:
    """Turn a camera_info file into another tool's."""
    from lumidock.setup.calibration_files import write_calibration

    camera = load_camera(file_given("camera", source))
    require_new(target, force)
    write_calibration(camera, target, form)
    print(f"written to {target}")


@calib.command(
    "check",
    epilog=example(
        "lumidock calib check camera.yaml --source dive.mcap",
        "lumidock calib check camera.yaml --lens-mm 6 --pixel-um 3.45",
    ),
)
def _check(
    source: Annotated[str, typer.Argument(metavar="CAMERA", help="Calibration of any kind, or a shipped name.")],
    name: Annotated[str | None, typer.Option(metavar="NAME", help="Which camera of a file of several.")] = None,
    size: Size = None,
    frames: Annotated[
        str | None, typer.Option("--source", metavar="SOURCE", help="Frames whose size it has to be for.")
    ] = None,
    lens_mm: Annotated[float | None, typer.Option(metavar="F", min=0.1, help="The lens's focal length.")] = None,
    pixel_um: Annotated[float | None, typer.Option(metavar="P", min=0.1, help="The sensor's pixel pitch.")] = None,
    as_json: AsJson = False,
) -> None:
    """Show the field of view, and warn of what looks wrong."""
    from lumidock.setup.calibration_files import read_calibration
    from lumidock.streams.calibration_check import check

    if (lens_mm is None) != (pixel_um is None):
        raise InputError("--lens-mm and --pixel-um belong together")
    camera = read_calibration(file_given("camera", source), name=name, size=_size(size))
    if frames is not None:
        _require_size_of(frames, camera, source)
    verdict = check(camera, lens_mm=lens_mm, pixel_um=pixel_um)
    if as_json:
        print(json.dumps({"width": camera.width, "height": camera.height, "model": camera.model} | asdict(verdict)))
        return
    across, down, diagonal = verdict.field_of_view_deg
    print(f"size        {camera.width} x {camera.height}, {camera.model}")
    print(f"focal       {camera.focal_px[0]:.1f}, {camera.focal_px[1]:.1f} px")
    print(f"field       {across:.1f} x {down:.1f} degrees, {diagonal:.1f} across the corners")
    if verdict.impossible:
        print(f"IMPOSSIBLE  {verdict.impossible}; only --trust-calibration makes `run` and `serve` take it")
    for warning in verdict.warnings:
        print(f"WARNING     {warning}")


def _size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    found = re.fullmatch(r"([0-9]{1,5})x([0-9]{1,5})", text)
    if found is None:
        raise InputError(f"--size {text}: wanted WIDTHxHEIGHT")
    return int(found[1]), int(found[2])


def _require_size_of(frames: str, camera: Camera, source: str) -> None:
    """Raises: InputError when the first frame that can be read is of another size."""
    for item in open_any(
        frames, Reading(fps=_ANY_FPS if Path(frames).is_dir() else None, follow_calibration=False)
    ).items():
        if isinstance(item, Frame):
            height, width = item.image.shape[:2]
            if (width, height) != (camera.width, camera.height):
                text = f"made for {camera.width}x{camera.height} pixels, the frames of {frames} have {width}x{height}"
                raise InputError(f"{source}: {text}")
            return
    raise InputError(f"{frames}: no frame that can be read")
