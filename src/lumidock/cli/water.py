"""`lumidock calib water`: the camera in the water it works in."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, cast

import numpy as np
import typer

from lumidock.camera import load_camera, save_camera
from lumidock.cli.calibration import calib
from lumidock.cli.progress import progress_bar
from lumidock.cli.shared import AsJson, Force, Fps, example, open_any, require_new, shipped_or_path
from lumidock.config import Config
from lumidock.datatypes import Frame
from lumidock.errors import InputError
from lumidock.station import load_station
from lumidock.streams.source import Reading

if TYPE_CHECKING:
    from lumidock.setup.boards import Board, Sighting
    from lumidock.setup.water_calibration import Calibration

_MOST_VIEWS = 60  # of a video; more add little and each costs six unknowns
_OPEN_FOCAL, _OPEN_CENTER_PX = 0.1, 50.0  # 1 sigma: with --dock the lights decide, not the file


@calib.command(
    "water",
    epilog=example(
        "lumidock calib water board.mp4 --board charuco --squares 8x6 --square 0.04 --marker 0.03 --out camera.yaml",
        "lumidock calib water --dock RUN-1 --dock RUN-2 --out camera.yaml",
    ),
)
def _water(
    out: Annotated[Path, typer.Option("--out", metavar="CAMERA", help="camera_info file to write.")],
    source: Annotated[str | None, typer.Argument(metavar="VIDEO|FOLDER", help="Pictures of a board.")] = None,
    board: Annotated[str, typer.Option(metavar="KIND", help="charuco or chessboard.")] = "charuco",
    squares: Annotated[str, typer.Option(metavar="CxR", help="Squares across and down.")] = "8x6",
    square: Annotated[float, typer.Option(metavar="M", help="Side of a square.")] = 0.04,
    marker: Annotated[float, typer.Option(metavar="M", help="Side of a marker of a ChArUco board.")] = 0.03,
    dictionary: Annotated[str, typer.Option(metavar="NAME", help="OpenCV's name of its dictionary.")] = "DICT_4X4_50",
    model: Annotated[
        str, typer.Option(metavar="MODEL", help="plumb_bob, or equidistant for a wide lens.")
    ] = "plumb_bob",
    port: Annotated[
        str | None,
        typer.Option(metavar="M|estimate", help="Flat port: distance from the entrance pupil to the water, m."),
    ] = None,
    water_index: Annotated[
        str, typer.Option(metavar="N|estimate", help="Refractive index of the water, with --port.")
    ] = "1.34",
    dock: Annotated[
        list[Path] | None, typer.Option("--dock", metavar="RUN", help="Refine from a run's lights; may be repeated.")
    ] = None,
    fps: Fps = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Calibrate a camera under water, from a board or from the lights of a surveyed dock."""
    require_new(out, force)
    if (source is None) == (not dock):
        raise InputError("give either pictures of a board, or --dock RUN")
    if dock:
        _from_dock(dock, out, as_json)
        return
    if model not in ("plumb_bob", "equidistant"):
        raise InputError(f"--model {model}: wanted plumb_bob or equidistant")
    from lumidock.setup.water_calibration import PortGuess, calibrate

    behind = PortGuess(_number("--port", port), _number("--water-index", water_index)) if port is not None else None
    target = _board(board, squares, (square, marker), dictionary)
    sightings, size = _sightings(cast("str", source), target, fps)
    found = calibrate(target, sightings, size, cast("Literal['plumb_bob', 'equidistant']", model), behind)
    fitted = found.camera.port
    if fitted is not None and not (0.0 <= fitted.distance_m <= 1.0 and 1.0 <= fitted.index <= 1.5):
        raise InputError(
            f"the views fit a port {fitted.distance_m:.3f} m away in water of index {fitted.index:.3f}, which is none; "
            "give --port and --water-index as measured, or leave --port out"
        )
    save_camera(found.camera, out)
    print(json.dumps(_as_dict(found), indent=1) if as_json else _told(found, len(sightings), out))


def _number(option: str, text: str) -> float | None:
    """A number of an option, or None for what is to be estimated. Raises: InputError."""
    if text == "estimate":
        return None
    try:
        value = float(text)
    except ValueError:
        raise InputError(f"{option} {text}: wanted a number, or estimate") from None
    low, high = (0.0, 1.0) if option == "--port" else (1.0, 1.5)
    if not low <= value <= high:
        raise InputError(f"{option} {text}: wanted {low:g} to {high:g}")
    return value


def _board(kind: str, squares: str, sides_m: tuple[float, float], dictionary: str) -> Board:
    from lumidock.setup.boards import Board

    if kind not in ("charuco", "chessboard"):
        raise InputError(f"--board {kind}: wanted charuco or chessboard")
    columns, _, rows = squares.partition("x")
    if not (columns.isdecimal() and rows.isdecimal()):
        raise InputError(f"--squares {squares}: wanted COLUMNSxROWS")
    chosen = cast("Literal['charuco', 'chessboard']", kind)
    return Board(chosen, int(columns), int(rows), *sides_m, dictionary)


def _sightings(source: str, board: Board, fps: float | None) -> tuple[list[Sighting], tuple[int, int]]:
    """Views of the board, evenly chosen, and the size of the pictures. Raises: InputError where that changes."""
    from lumidock.setup.boards import find_board

    opened = open_any(source, Reading(fps if fps is not None or not Path(source).is_dir() else 1.0))
    found, size = [], None
    with progress_bar("boards") as progress:
        for done, item in enumerate(opened.items(), start=1):
            progress(done, opened.count)
            if not isinstance(item, Frame):
                continue
            height, width = item.image.shape[:2]
            if size not in (None, (width, height)):
                raise InputError(f"frame {item.name} is {width}x{height}, those before are {size}")
            size, sighting = (width, height), find_board(board, item)
            if sighting is not None:
                found.append(sighting)
    if size is None:
        raise InputError(f"{source}: no frame that can be read")
    chosen = np.linspace(0, len(found) - 1, min(len(found), _MOST_VIEWS)).round().astype(int)
    return [found[k] for k in chosen], size


def _as_dict(found: Calibration) -> dict[str, object]:
    return {
        "rms_px": found.rms_px,
        "held_out_px": found.held_out_px,
        "focal_px": found.camera.focal_px.tolist(),
        "center_px": found.camera.center_px.tolist(),
        "sigma": found.sigma.tolist(),
        "port": asdict(found.camera.port) if found.camera.port else None,
        "calibration_sigma": {"focal": found.sigma_focal, "center_px": found.sigma_center_px},
        "coverage": found.coverage.tolist(),
        "advice": list(found.advice),
    }


def _told(found: Calibration, views: int, out: Path) -> str:
    fx, fy, cx, cy = found.sigma[:4]
    camera = found.camera
    port = camera.port
    lines = [
        f"views       {views}",
        f"residual    {found.rms_px:.3f} px rms, {found.held_out_px:.3f} px in views that were held out",
        f"focal       {camera.focal_px[0]:.2f} +- {fx:.2f}, {camera.focal_px[1]:.2f} +- {fy:.2f} px",
        f"centre      {camera.center_px[0]:.2f} +- {cx:.2f}, {camera.center_px[1]:.2f} +- {cy:.2f} px",
        *([f"port        {port.distance_m:.4f} +- {found.sigma[8]:.4f} m, index {port.index:.4f}"] if port else []),
        "coverage    " + "\n            ".join(" ".join(f"{n:5d}" for n in row) for row in found.coverage),
        f"station     calibration_sigma: {{focal: {found.sigma_focal:.5f}, center_px: {found.sigma_center_px:.2f}}}",
        *(f"ADD         {text}" for text in found.advice),
        f"written to {out}",
    ]
    return "\n".join(lines)


def _from_dock(runs: list[Path], out: Path, as_json: bool) -> None:
    """Focal length and principal point by the lights of a surveyed dock; the distortion stays as in the file."""
    from lumidock.setup.recordings import detections_of_run, is_run
    from lumidock.setup.survey import prior_of, survey

    for run in runs:
        if not is_run(run):
            raise InputError(f"{run}: not a run folder")
    dock = load_station(shipped_or_path("station", str(runs[0] / "station.yaml")))
    camera = load_camera(runs[0] / "camera.yaml")
    prior = replace(prior_of(dock), sigma_focal=_OPEN_FOCAL, sigma_center_px=_OPEN_CENTER_PX)
    with progress_bar("dock") as progress:
        found = survey([detections_of_run(run) for run in runs], dock, camera, Config(), prior, progress=progress)
    focal, du, dv = found.adjusted.estimate.calibration[:3]
    sigma = np.sqrt(np.diagonal(found.adjusted.covariance)[-5:-2])
    K = camera.K.copy()
    K[[0, 1], [0, 1]] *= 1.0 + focal
    K[:2, 2] += du, dv
    save_camera(replace(camera, K=K), out)
    told = {"focal": float(focal), "center_px": [float(du), float(dv)], "sigma": sigma.tolist()}
    if as_json:
        print(json.dumps(told, indent=1))
    else:
        print(
            f"focal length {100 * focal:+.3f} +- {100 * sigma[0]:.3f} %, centre {du:+.2f} {dv:+.2f}"
            f" +- {sigma[1]:.2f} px against the file; written to {out}"
        )
