"""The command line: the only place that prints, parses options and exits."""

from __future__ import annotations

import io
import json
import os
import sys
from importlib.metadata import version
from itertools import count
from pathlib import Path
from typing import Annotated, NoReturn

import cv2
import typer

from lumidock.camera import load_camera, save_camera
from lumidock.cli import calibration, doctoring, evaluation, exporting, inspection, reporting, serving, stations
from lumidock.cli.shared import (
    DEFAULT_CAMERA,
    DEFAULT_STATION,
    SCENARIOS,
    SIM,
    AsJson,
    Bits,
    CameraOption,
    ConfigOption,
    Force,
    Fps,
    Method,
    Out,
    Seed,
    SourceArgument,
    StationOption,
    Topic,
    Workers,
    app,
    calibration_of,
    copy,
    example,
    file_of,
    interrupts_held,
    open_any,
    prepare_folder,
    prepare_sequence,
    progress_bar,
    require_folder,
    shipped_or_path,
    simulated,
    warn_if_nothing_is_kept,
)
from lumidock.config import Config, load_config
from lumidock.datatypes import Fix
from lumidock.errors import InputError, LumidockError
from lumidock.methods import METHODS, localizer_of, require_method
from lumidock.station import load_station
from lumidock.streams.sources import Item, open_source

_MAX_SEED = 10**9
_COMMANDS = (
    evaluation,
    inspection,
    exporting,
    reporting,
    serving,
    calibration,
    stations,
    doctoring,
)  # importing them adds their commands


def main() -> None:
    """Entry point: every error that is the user's to mend is one line and exit code 2."""
    _keep_streams_clean()
    try:
        code = app(standalone_mode=False, prog_name="lumidock")
        print(end="", flush=True)
    except typer.TyperException as error:
        _fail(error.format_message())
    except (typer.Abort, KeyboardInterrupt):
        sys.exit(130)
    except LumidockError as error:
        _fail(str(error))
    except BrokenPipeError:  # whoever read our output has left
        _drop_output()
        sys.exit(1)
    except OSError as error:
        _drop_output()
        _fail(f"{error.filename or 'file system'}: {error.strerror or error}")
    sys.exit(code or 0)


def _keep_streams_clean() -> None:
    """Let any file name be printed, and the libraries below us not print at all."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    if hasattr(cv2, "setLogLevel"):  # OpenCV 4
        cv2.setLogLevel(0)
    else:
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)


def _drop_output() -> None:
    """Give up what cannot be written, or the interpreter would complain of it at its end."""
    try:
        print(end="", flush=True)
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _fail(text: str) -> NoReturn:
    print(f"lumidock: {' '.join(text.split())}", file=sys.stderr)
    sys.exit(2)


@app.callback(invoke_without_command=True)
def _lumidock(
    context: typer.Context,
    show_version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    """Where a vehicle is relative to its dock, from one camera and the dock's guiding lights."""
    if show_version:
        print(version("lumidock"))
        raise typer.Exit
    if context.invoked_subcommand is None:
        print(context.get_help())


@app.command(
    "run",
    epilog=example(
        "lumidock run SEQ --out RUN",
        "lumidock run dive.mcap --station dock.yaml --out RUN",
        "lumidock run dive.mp4 --station dock.yaml --camera camera.yaml --out RUN",
        "lumidock run sim:approach --out RUN",
    ),
)
def _run(
    source: SourceArgument,
    out: Out,
    station: StationOption = None,
    camera: CameraOption = None,
    method: Method = "lumidock",
    cold: Annotated[bool, typer.Option("--cold", help="Forget all history before each frame.")] = False,
    topic: Topic = None,
    bits: Bits = 16,
    fps: Fps = None,
    config: ConfigOption = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Find the camera's pose in every frame of SOURCE."""
    from lumidock.app.run import Setup
    from lumidock.app.run import run as run_source
    from lumidock.streams.run_folder import RunFolder

    require_method(method)
    settings = load_config(config) if config else Config()
    if source.startswith(SIM):
        require_folder(out, force)
        source, force = str(simulated(source, out / "sequence", station, camera)), True
    opened = open_any(source, fps, topic=topic, bits=bits, station=station)
    station_file = file_of("station", station, opened.station, opened)
    described = camera is None and opened.camera is None and opened.calibration is not None
    camera_file = out / "camera.yaml" if described else file_of("camera", camera, opened.camera, opened)
    dock = load_station(station_file)
    lens = calibration_of(camera, opened)
    warn_if_nothing_is_kept()
    localizer = localizer_of(method, dock, lens, settings, cold=cold)
    if out.is_dir() and opened.path.is_dir() and out.samefile(opened.path):
        raise InputError(f"{out}: is the source; write the run elsewhere")
    prepare_folder(out, force)
    if described:
        camera_file.unlink(missing_ok=True)  # a link, not what it points to
        save_camera(lens, camera_file)
    setup = Setup(method, cold, settings, station_file, camera_file)
    with RunFolder(out, dock.ids) as folder, progress_bar("run") as progress, interrupts_held() as let_interrupt:
        copy(station_file, out / "station.yaml")
        copy(camera_file, out / "camera.yaml")
        done = count(1)

        def on_fix(_item: Item, _fix: Fix) -> None:
            progress(next(done), opened.count)
            let_interrupt()

        summary = run_source(opened, localizer, folder, setup, on_fix=on_fix)
    counts = summary.as_dict()
    if as_json:
        print(json.dumps(counts, indent=2))
        return
    none = counts["frames"] - counts["valid"] - counts["guide_only"]
    print(
        f"{counts['frames']} frames: {counts['valid']} valid, {counts['guide_only']} guide only, {none} no fix; "
        f"written to {out}"
    )
    if counts["reason"]:
        print("not valid: " + ", ".join(f"{word} {count}" for word, count in sorted(counts["reason"].items())))


@app.command(
    "sim",
    epilog=example(
        "lumidock sim approach --seed 3 --out SEQ",
        "lumidock sim trials --detections --set faults.missing=2 --out SEQ",
    ),
)
def _sim(
    scenario: Annotated[str, typer.Argument(metavar="SCENARIO", help=f"{SCENARIOS}, or a .yaml file.")],
    out: Out,
    seed: Seed = 0,
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY.SUBKEY=VALUE", help="May be repeated.")
    ] = None,
    detections: Annotated[
        bool,
        typer.Option("--detections", help="Bare detections, without rendering: path, faults and spots alone count."),
    ] = False,
    video: Annotated[bool, typer.Option("--video", help="Pictures as video.mp4 instead of frames/.")] = False,
    workers: Workers = None,
    station: StationOption = None,
    camera: CameraOption = None,
    force: Force = False,
) -> None:
    """Simulate SCENARIO into a sequence folder with truth."""
    from lumidock.sim.scenario import load_scenario
    from lumidock.sim.sequence import require_possible, write_detections, write_rendered

    if video and detections:
        raise InputError("--video: bare detections have no pictures")
    loaded = load_scenario(scenario, tuple(settings or ()))
    require_possible(loaded, detections=detections, video=video)
    station_file = shipped_or_path("station", station or DEFAULT_STATION)
    dock = load_station(station_file)
    lens = load_camera(shipped_or_path("camera", camera or DEFAULT_CAMERA))
    prepare_sequence(out, force)
    copy(station_file, out / "station.yaml")
    if detections:
        frames = write_detections(loaded, dock, lens, seed, out)
    else:
        with progress_bar("sim") as progress:
            frames = write_rendered(loaded, dock, lens, seed, out, video=video, workers=workers, progress=progress)
    print(f"{frames} frames written to {out}")


@app.command("campaign", epilog=example("lumidock campaign nominal --seeds 0:100 --out CAMPAIGN"))
def _campaign(
    scenarios: Annotated[list[str], typer.Argument(metavar="SCENARIO", help=f"{SCENARIOS}, or .yaml files.")],
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder to write; the same campaign goes on where it was.")
    ],
    seeds: Annotated[str, typer.Option(metavar="A:B", help="Seeds A to B - 1, a run of each scenario each.")] = "0:10",
    methods: Annotated[
        list[str] | None, typer.Option("--method", metavar="NAME", help="lumidock (default) or paper; may be repeated.")
    ] = None,
    cold: Annotated[bool, typer.Option("--cold", help="Forget all history before each frame.")] = False,
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY.SUBKEY=VALUE", help="Of all scenarios; may be repeated.")
    ] = None,
    workers: Workers = None,
    cluster: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Run on the dask cluster there: tcp://HOST:PORT.")
    ] = None,
    bound: Annotated[
        bool, typer.Option("--bound", help="Also count where the lights in view owe a valid fix (slower).")
    ] = False,
    station: StationOption = None,
    camera: CameraOption = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Run scenarios x seeds x methods on bare detections, and count."""
    from lumidock.evaluation.campaign import plan, prepare, run_campaign, tabulate
    from lumidock.evaluation.campaign_table import markdown
    from lumidock.sim.scenario import load_scenario

    for method in methods or ():
        require_method(method)
    campaign = plan(
        [load_scenario(name, tuple(settings or ())) for name in scenarios],
        methods or METHODS[:1],
        _seeds(seeds),
        shipped_or_path("station", station or DEFAULT_STATION),
        shipped_or_path("camera", camera or DEFAULT_CAMERA),
        cold=cold,
        bound=bound,
    )
    prepare(campaign, out, force=force)
    warn_if_nothing_is_kept()
    with progress_bar("campaign") as progress:
        speed = run_campaign(campaign, out, workers=workers, cluster=cluster, progress=progress)
    table = tabulate(campaign, out)
    if as_json:
        print(json.dumps(table, indent=1))
        return
    print(markdown(table))
    ran = f"{speed:.0f} frames a second and core" if speed > 0.0 else "nothing was left to do"
    print(f"{ran}; written to {out}")


def _seeds(text: str) -> tuple[int, int]:
    """The two ends of A:B. Raises: InputError when they hold no seed."""
    first, _, stop = text.partition(":")
    if not (first.isdecimal() and stop.isdecimal() and int(first) < int(stop) <= _MAX_SEED):
        raise InputError(f"--seeds {text}: wanted A:B, whole numbers, A below B")
    return int(first), int(stop)


@app.command("warm", epilog=example("lumidock warm"))
def _warm() -> None:
    """Compile ahead, so that no run waits for it."""
    from lumidock.app.warm import compile_ahead, compiled_code, warm_up
    from lumidock.localizer import Localizer

    dock = load_station(shipped_or_path("station", DEFAULT_STATION))
    lens = load_camera(shipped_or_path("camera", DEFAULT_CAMERA))
    state = compiled_code()
    if state.mark == "bad":
        raise LumidockError(state.text)
    print("compiling detection and matching, one to two minutes ...", flush=True)
    compile_ahead(dock, lens)
    for name, _ in warm_up(Localizer(dock, lens).process, dock, lens):
        print(f"ready for {name}", flush=True)
    print(compiled_code().text)


@app.command("demo", epilog=example("lumidock demo --force"))
def _demo(
    out: Out = Path("demo-out"),
    seed: Seed = 0,
    force: Force = False,
) -> None:
    """Simulate a docking, run it, and leave files and pictures."""
    from lumidock.app.demo import Album, summary_lines
    from lumidock.app.run import Setup
    from lumidock.app.run import run as run_source
    from lumidock.evaluation.metrics import evaluate, true_poses
    from lumidock.localizer import Localizer
    from lumidock.report import page, report
    from lumidock.report.stills import contact_sheet, plot_trajectory
    from lumidock.sim.scenario import load_scenario
    from lumidock.sim.sequence import write_rendered
    from lumidock.streams.run_folder import RunFolder

    prepare_folder(out, force)
    sequence, run_folder = out / "sequence", out / "run"
    prepare_sequence(sequence, True)
    scenario = load_scenario("approach")
    station_file, camera_file = (
        shipped_or_path("station", DEFAULT_STATION),
        shipped_or_path("camera", DEFAULT_CAMERA),
    )
    dock, lens = load_station(station_file), load_camera(camera_file)
    copy(station_file, sequence / "station.yaml")
    warn_if_nothing_is_kept()
    with progress_bar("simulating") as progress:
        write_rendered(scenario, dock, lens, seed, sequence, progress=progress)
    source = open_source(sequence)
    setup = Setup("lumidock", False, Config(), station_file, camera_file)
    video = out / "annotated.mp4"
    with (
        RunFolder(run_folder, dock.ids) as folder,
        progress_bar("localizing") as progress,
        interrupts_held() as let_interrupt,
        Album(dock, lens, video, 1.0 / scenario.path.frame_interval_s) as album,
    ):

        def on_fix(item: Item, fix: Fix) -> None:
            album.add(item, fix)
            progress(len(album.fixes), source.count)
            let_interrupt()

        copy(station_file, run_folder / "station.yaml")
        copy(camera_file, run_folder / "camera.yaml")
        summary = run_source(source, Localizer(dock, lens), folder, setup, on_fix=on_fix)
    result = evaluate(run_folder, sequence)
    plot_trajectory(album.fixes, true_poses(sequence), dock, out / "trajectory.png")
    contact_sheet(album.sheet(), out / "stages.jpg")
    page.write(out / "report.html", report([run_folder], [sequence]))
    print("\n".join(summary_lines(result, summary.as_dict())))
    shown = (out / "report.html", out / "trajectory.png", out / "stages.jpg", video, run_folder / "fixes.csv")
    print(f"look at     {', '.join(map(str, shown))}")
