"""`lumidock survey`: a user's own dock from footage of it."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import numpy as np
import typer
from typer.core import TyperCommand

from lumidock.camera import Camera, load_camera
from lumidock.cli.progress import progress_bar
from lumidock.cli.shared import (
    AsJson,
    CameraOption,
    ConfigOption,
    Force,
    Fps,
    app,
    calibration_of,
    example,
    open_any,
    require_new,
    shipped_or_path,
)
from lumidock.config import Config, load_config
from lumidock.datatypes import Detections
from lumidock.errors import InputError
from lumidock.station import Station, load_station
from lumidock.streams.folder import read_csv
from lumidock.streams.source import Reading

if TYPE_CHECKING:
    from lumidock.setup.bundle import Distance
    from lumidock.setup.observations import Labelled
    from lumidock.setup.survey import Survey

_LEAST_OF_A_COLOR = 4  # lights; of fewer the way they move together says too little
_CHECK_SIGMA_M = 0.05  # how far a light may have moved since the survey and still be found


LabelsOption = Annotated[
    Path | None,
    typer.Option(metavar="CSV", help="frame,u_px,v_px,light: detections of the first source that you identified."),
]
DistanceOption = Annotated[
    list[str] | None,
    typer.Option("--distance", metavar="A B M", help="Taped metres between two lights; may be repeated."),
]


class _SurveyCommand(TyperCommand):
    """A command whose `--distance` takes three words and may be repeated, which typer does not offer."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:  # noqa: ANN401  # typer does not export its type
        """The arguments, each `--distance A B M` made one word."""
        joined: list[str] = []
        while args:
            if args[0] == "--distance":
                joined += ["--distance", " ".join(args[1:4])]
                args = args[4:]
            else:
                joined.append(args[0])
                args = args[1:]
        return super().parse_args(ctx, joined)


@app.command(
    "survey",
    cls=_SurveyCommand,
    epilog=example(
        "lumidock survey RUN-1 RUN-2 RUN-3 --station drawing.yaml --off 0.05 --distance F1 R5 5.482 --out dock.yaml",
        "lumidock survey dive.mp4 --station drawing.yaml --camera camera.yaml --out dock.yaml --page survey.html",
        "lumidock survey RUN-1 --lights 7,6 --out dock.yaml",
        "lumidock survey RUN-9 --station dock.yaml --check",
    ),
)
def _survey(
    sources: Annotated[
        list[str], typer.Argument(metavar="RUN_OR_SOURCE...", help="Run folders or recordings of approaches.")
    ],
    station: Annotated[
        str | None, typer.Option("--station", metavar="FILE", help="The drawing, or with --check the survey.")
    ] = None,
    lights: Annotated[
        str | None,
        typer.Option(metavar="F,R", help="No drawing: how many lights of the front's and of the rear's colour."),
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", metavar="FILE", help="Station file to write.")] = None,
    camera: CameraOption = None,
    off: Annotated[
        float | None,
        typer.Option(metavar="M", min=0.001, max=1.0, help="1 sigma of the drawing, each axis; else the file's own."),
    ] = None,
    distances: DistanceOption = None,
    distance_sigma: Annotated[float, typer.Option(metavar="M", min=1e-4, help="1 sigma of a taped distance.")] = 0.002,
    labels: LabelsOption = None,
    known: Annotated[
        list[str] | None, typer.Option("--known", metavar="LAYER", help="A layer that the file has right.")
    ] = None,
    page: Annotated[Path | None, typer.Option(metavar="HTML", help="Write a page about the survey there.")] = None,
    check: Annotated[bool, typer.Option("--check", help="Say which lights moved since; exit code 1 if any.")] = False,
    fps: Fps = None,
    config: ConfigOption = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Find the true positions of a dock's lights from recordings."""
    from lumidock.setup.survey import prior_of, survey

    if check == (out is not None):
        raise InputError("give either --out FILE for a survey, or --check to compare with one")
    if (station is None) == (lights is None) or (check and station is None):
        raise InputError("give --station FILE, or for a dock of two colours without a drawing --lights F,R")
    for file in filter(None, (out, page)):
        require_new(file, force)
    settings = load_config(config) if config else Config()
    path = shipped_or_path("station", station) if station is not None else cast("Path", out)
    if lights is not None:
        _write_layout(sources, camera, lights, distances or [], path)
    drawing, sigma_m = load_station(path), _CHECK_SIGMA_M if check else off
    tapes = [_distance(text, drawing, distance_sigma) for text in distances or ()]
    prior = prior_of(drawing, sigma_m=sigma_m, known=known or (), distances=tapes)
    told = _labels(labels, drawing) if labels else []
    with progress_bar("survey") as progress:
        lens, recordings = _recordings(sources, drawing, camera, (settings, fps))
        found = survey(recordings, drawing, lens, settings, prior, progress=progress, labels=told)
    if out is not None and not found.refusal:
        _write(found, path, out)
    if page is not None:
        _write_page(found, lens, page)
    if found.refusal:
        if lights is not None:
            path.unlink()
        raise InputError(f"survey refused: {found.refusal}")
    _report(found, drawing, out, as_json)


def _report(found: Survey, drawing: Station, out: Path | None, as_json: bool) -> None:
    """Print a survey that was written to `out`, or without it which lights have moved since the drawing."""
    if out is None:
        _report_moves(found, drawing, as_json)
        return
    print(json.dumps(_summary(found), indent=1) if as_json else _told(found, out))


def _write_layout(sources: list[str], camera: str | None, lights: str, distances: list[str], path: Path) -> None:
    """Write the station file of a first layout, of the size that the first taped distance says."""
    from lumidock.setup.recordings import detections_of_run, is_run
    from lumidock.setup.station_files import content_of, write_station_file
    from lumidock.setup.unknown import first_layout

    front, _, rear = lights.partition(",")
    if not (front.isdecimal() and rear.isdecimal() and min(int(front), int(rear)) >= _LEAST_OF_A_COLOR):
        raise InputError(f"--lights {lights}: wanted two numbers of at least {_LEAST_OF_A_COLOR}, as in --lights 7,6")
    recordings, lens = [], None
    for source in sources:
        folder = Path(source)
        if is_run(folder):
            lens = load_camera(shipped_or_path("camera", camera) if camera else folder / "camera.yaml")
            recordings.append(detections_of_run(folder))
            continue
        opened = open_any(source, Reading())
        if opened.kind != "detections":
            raise InputError(f"{source}: --lights wants run folders; make one with lumidock run and any station file")
        lens = calibration_of(camera, opened).camera
        recordings.append([item for item in opened.items() if isinstance(item, Detections)])
    assert lens is not None
    layout = first_layout(recordings, int(front), int(rear), lens, Config().match.noise_px)
    for text in distances[:1]:
        tape = _distance(text, layout, 1.0)
        size = tape.metres / float(np.linalg.norm(layout.p_dock[tape.a] - layout.p_dock[tape.b]))
        layout = replace(layout, p_dock=layout.p_dock * size)
    write_station_file(content_of(layout), path, "First layout, from footage alone.")


def _distance(text: str, drawing: Station, sigma_m: float) -> Distance:
    from lumidock.setup.bundle import Distance

    words = text.split()
    try:
        a, b, metres = words[0], words[1], float(words[2])
    except (IndexError, ValueError):
        raise InputError(f"--distance {text}: wanted two lights and metres, as in --distance F1 R5 5.482") from None
    for light_id in (a, b):
        if light_id not in drawing.ids:
            raise InputError(f"--distance {text}: no light {light_id} in {drawing.name}")
    if len(words) != 3 or a == b or not (math.isfinite(metres) and metres > 0.0):
        raise InputError(f"--distance {text}: wanted two lights and a positive number of metres")
    return Distance(drawing.ids.index(a), drawing.ids.index(b), metres, sigma_m)


def _labels(path: Path, drawing: Station) -> list[Labelled]:
    """The labels in a file. Raises: InputError for a light that there is not, or that a frame has twice."""
    from lumidock.setup.observations import Labelled

    found = list[Labelled]()
    for row in read_csv(path, ("frame", "u_px", "v_px", "light")):
        where = f"{path}: frame {row['frame']}"
        if row["light"] not in drawing.ids:
            raise InputError(f"{where}: no light {row['light']} in {drawing.name}")
        try:
            uv = float(row["u_px"]), float(row["v_px"])
        except ValueError as error:
            raise InputError(f"{where}: {error}") from None
        label = Labelled(row["frame"], uv, drawing.ids.index(row["light"]))
        if any((other.frame, other.light) == (label.frame, label.light) for other in found):
            raise InputError(f"{where}: light {row['light']} is given twice")
        found.append(label)
    return found


def _recordings(
    sources: list[str], drawing: Station, camera: str | None, how: tuple[Config, float | None]
) -> tuple[Camera, list[list[Detections]]]:
    """The camera and the detections of every recording. Raises: InputError where two have different cameras."""
    from lumidock.setup.recordings import detections_of_items, detections_of_run, is_run

    settings, fps = how
    lens, recordings = None, []
    for source in sources:
        folder = Path(source)
        if is_run(folder):
            own = load_camera(shipped_or_path("camera", camera) if camera else folder / "camera.yaml")
            recordings.append(detections_of_run(folder))
        else:
            opened = open_any(source, Reading(fps))
            own = calibration_of(camera, opened).camera
            recordings.append(detections_of_items(opened.items(), drawing, own, settings))
        if lens is not None and not np.array_equal(lens.lens(), own.lens()):
            raise InputError(f"{source}: its camera differs from that of {sources[0]}; survey with one camera")
        lens = own
    assert lens is not None
    return lens, recordings


def _write(found: Survey, drawing: Path, out: Path) -> None:
    from lumidock.setup.station_files import write_surveyed

    about = (
        f"Surveyed by lumidock from {len(found.observed)} frames of {len(np.unique(found.observed.recording))}"
        f" recordings; held-out frames fit to {found.held_out_px[1]:.2f} px rms, with the drawing to"
        f" {found.held_out_px[0]:.2f} px.\nsigma_m: 1 sigma along x, y, z of each light."
    )
    for text in found.unobserved:
        about += f"\nNot observed: {text}"
    write_surveyed(drawing, out, found.after, found.sigma_m, name=_name(found.before.name), about=about)


def _name(name: str) -> str:
    return f"{name[:55]}-surveyed"


def _summary(found: Survey) -> dict[str, Any]:
    moved = found.after.p_dock - found.before.p_dock
    return {
        "frames": len(found.observed),
        "rounds": found.rounds,
        "held_out_px": {"drawing": found.held_out_px[0], "survey": found.held_out_px[1]},
        "scale_sigma": found.scale_sigma,
        "calibrated": found.adjusted.calibrated,
        "calibration": dict(
            zip(("focal", "u_px", "v_px"), found.adjusted.estimate.calibration[:3].tolist(), strict=True)
        ),
        "unobserved": list(found.unobserved),
        "lights": [
            {
                "id": light_id,
                "moved_m": moved[i].tolist(),
                "sigma_m": found.sigma_m[i].tolist(),
                "frames": int(found.adjusted.used[:, i].sum()),
            }
            for i, light_id in enumerate(found.before.ids)
        ],
    }


def _told(found: Survey, out: Path) -> str:
    moved = np.linalg.norm(found.after.p_dock - found.before.p_dock, axis=1)
    lines = [
        f"{len(found.observed)} frames: held-out residual {found.held_out_px[0]:.2f} px with the drawing, "
        f"{found.held_out_px[1]:.2f} px with the survey; lights moved by up to {1e3 * moved.max():.0f} mm; "
        f"written to {out}"
    ]
    return "\n".join([*lines, *(f"not observed: {text}" for text in found.unobserved)])


def _report_moves(found: Survey, filed: Station, as_json: bool) -> None:
    from lumidock.setup.moved import moves

    sigma = np.broadcast_to(np.asarray(filed.sigma_light_m, float).reshape(-1, 1), (len(filed), 3))
    compared = moves(found, np.sqrt(sigma**2 + filed.sigma_layer_m**2))
    rows = [
        {
            "id": light_id,
            "moved": bool(compared.moved[i]),
            "seen": not compared.unseen[i],
            "by_m": compared.by_m[i].tolist(),
            "chi2": float(compared.chi2[i]),
        }
        for i, light_id in enumerate(filed.ids)
    ]
    if as_json:
        print(json.dumps({"moved": [row["id"] for row in rows if row["moved"]], "lights": rows}, indent=1))
    else:
        for row in rows:
            by = " ".join(f"{1e3 * x:+7.1f}" for x in row["by_m"])
            verdict = "not seen" if not row["seen"] else "MOVED" if row["moved"] else "as surveyed"
            print(f"{row['id']:8} {by} mm   chi2 {row['chi2']:7.1f}   {verdict}")
    if compared.moved.any():
        raise typer.Exit(1)


def _write_page(found: Survey, lens: Camera, target: Path) -> None:
    from lumidock.report import page
    from lumidock.report.survey_page import SurveyView, survey_page
    from lumidock.setup import bundle
    from lumidock.setup.advice import helpful_views

    at, observed = found.adjusted.estimate, found.observed
    drawn, _ = bundle.refine_poses(observed, lens, found.before.p_dock, at.T_dock_cam, observed.sigma_px)
    view = SurveyView(
        before=found.before,
        after=found.after,
        sigma_m=found.sigma_m,
        covariance=found.covariance,
        drawn_px=bundle.reprojection(observed, lens, found.before.p_dock, drawn),
        surveyed_px=found.adjusted.residual_px,
        recording=observed.recording,
        held_out_px=found.held_out_px,
        scale_sigma=found.scale_sigma,
        unobserved=found.unobserved,
        refusal=found.refusal,
        views=[
            f"{v.range_m:g} m away, {_side(v.right_deg, 'right', 'left')}, {_side(v.above_deg, 'above', 'below')}: "
            f"{v.lights} lights, rms error to {100 * v.share:.0f} %"
            for v in helpful_views(found, lens)
        ],
    )
    page.write(target, survey_page(view))


def _side(degrees: float, one: str, other: str) -> str:
    return (
        f"straight ahead of {one}"
        if degrees == 0.0
        else f"{abs(degrees):g} degrees to the {one if degrees > 0 else other}"
    )
