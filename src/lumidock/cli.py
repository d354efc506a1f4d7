"""The command line: the only place that prints, parses options and exits."""

from __future__ import annotations

import io
import json
import os
import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from importlib.resources import files
from itertools import count
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import cv2
import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from lumidock.camera import Camera, load_camera
from lumidock.config import Config, load_config
from lumidock.datatypes import Fix
from lumidock.errors import InputError, LumidockError
from lumidock.station import Station, load_station
from lumidock.streams.sources import Item, Source, open_source

if TYPE_CHECKING:
    from lumidock.run import TwoDoors

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)

_MAX_SEED = 10**9
_DEFAULT_STATION, _DEFAULT_CAMERA = "cage-2x2x5", "imx264-60deg"
_SIMULATED = ("frames", "detections.csv", "timestamps.csv", "lights_truth.csv", "spurious_truth.csv")

_SCENARIOS = ", ".join(sorted(Path(entry.name).stem for entry in (files("lumidock") / "sim" / "scenarios").iterdir()))

Out = Annotated[
    Path, typer.Option("--out", metavar="DIR", help="Folder to write; refused when it exists, unless --force.")
]
Force = Annotated[bool, typer.Option("--force", help="Write into an existing folder, replacing earlier results.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print machine-readable JSON.")]
StationOption = Annotated[
    str | None, typer.Option("--station", metavar="FILE", help="Station file, or the name of a shipped one.")
]
CameraOption = Annotated[
    str | None, typer.Option("--camera", metavar="FILE", help="camera_info file, or the name of a shipped one.")
]
Seed = Annotated[int, typer.Option("--seed", metavar="N", min=0, help="Everything random follows from it.")]


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


@app.command("run")
def _run(
    source: Annotated[
        Path, typer.Argument(metavar="SOURCE", help="Sequence folder, image folder (with --fps) or video file.")
    ],
    out: Out,
    station: StationOption = None,
    camera: CameraOption = None,
    method: Annotated[str, typer.Option(metavar="NAME", help="lumidock, or paper.")] = "lumidock",
    cold: Annotated[bool, typer.Option("--cold", help="Forget all history before each frame.")] = False,
    fps: Annotated[
        float | None, typer.Option(metavar="F", help="Frames per second, for sources without time stamps.")
    ] = None,
    config: Annotated[
        Path | None, typer.Option(metavar="FILE", help="YAML file of settings that differ from the defaults.")
    ] = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Find the camera's pose in every frame of SOURCE."""
    from lumidock.run import Setup
    from lumidock.run import run as run_source
    from lumidock.streams.runfolder import RunFolder

    opened = open_source(source, fps)
    station_file = _file("station", station, opened.station, opened)
    camera_file = _file("camera", camera, opened.camera, opened)
    settings = load_config(config) if config else Config()
    dock = load_station(station_file)
    localizer = _localizer(method, dock, load_camera(camera_file), settings, cold)
    if out.is_dir() and source.is_dir() and out.samefile(source):
        raise InputError(f"{out}: is the source; write the run elsewhere")
    _prepare(out, force)
    setup = Setup(method, cold, settings, station_file, camera_file)
    with RunFolder(out, dock.ids) as folder, _progress("run") as progress, _interrupts_held() as let_interrupt:
        _copy(station_file, out / "station.yaml")
        _copy(camera_file, out / "camera.yaml")
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


def _localizer(method: str, station: Station, camera: Camera, config: Config, cold: bool) -> TwoDoors:
    """The method of that name. Raises: InputError for one that there is not, or a station that it cannot tell apart."""
    if method == "lumidock":
        from lumidock.localizer import Localizer

        return Localizer(station, camera, config, cold=cold)
    if method == "paper":
        from lumidock.paper import PaperLocalizer

        return PaperLocalizer(station, camera, config.paper, cold=cold)
    raise InputError(f"--method {method}: no such method; there are lumidock and paper")


@app.command("sim")
def _sim(
    scenario: Annotated[str, typer.Argument(metavar="SCENARIO", help=f"{_SCENARIOS}, or a .yaml file.")],
    out: Out,
    seed: Seed = 0,
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY.SUBKEY=VALUE", help="May be repeated.")
    ] = None,
    detections: Annotated[bool, typer.Option("--detections", help="Bare detections, without rendering.")] = False,
    station: StationOption = None,
    camera: CameraOption = None,
    force: Force = False,
) -> None:
    """Simulate SCENARIO into a sequence folder with truth."""
    from lumidock.sim.scenario import load_scenario
    from lumidock.sim.sequence import write_detections, write_rendered

    loaded = load_scenario(scenario, tuple(settings or ()))
    station_file = _shipped_or_path("station", station or _DEFAULT_STATION)
    dock = load_station(station_file)
    lens = load_camera(_shipped_or_path("camera", camera or _DEFAULT_CAMERA))
    _prepare_sequence(out, force)
    _copy(station_file, out / "station.yaml")
    if detections:
        frames = write_detections(loaded, dock, lens, seed, out)
    else:
        with _progress("sim") as progress:
            frames = write_rendered(loaded, dock, lens, seed, out, progress=progress)
    print(f"{frames} frames written to {out}")


@app.command("eval")
def _eval(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder.")],
    truth: Annotated[Path, typer.Argument(metavar="TRUTH", help="Simulated sequence folder, or a truth.csv.")],
    as_json: AsJson = False,
) -> None:
    """Compare a run with the truth."""
    from lumidock.metrics import evaluate

    result = evaluate(run, truth)
    if as_json:
        print(json.dumps(result, indent=2))
    else:
        _print_evaluation(result)


@app.command("campaign")
def _campaign(
    scenarios: Annotated[list[str], typer.Argument(metavar="SCENARIO", help=f"{_SCENARIOS}, or .yaml files.")],
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
    workers: Annotated[
        int | None, typer.Option(metavar="N", min=1, help="Processes; without it one for each core.")
    ] = None,
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
    from lumidock.campaign import METHODS, plan, prepare, run_campaign, tabulate
    from lumidock.campaign_table import markdown
    from lumidock.sim.scenario import load_scenario

    for method in methods or ():
        if method not in METHODS:
            raise InputError(f"--method {method}: no such method; there are {' and '.join(METHODS)}")
    campaign = plan(
        [load_scenario(name, tuple(settings or ())) for name in scenarios],
        methods or METHODS[:1],
        _seeds(seeds),
        _shipped_or_path("station", station or _DEFAULT_STATION),
        _shipped_or_path("camera", camera or _DEFAULT_CAMERA),
        cold=cold,
        bound=bound,
    )
    prepare(campaign, out, force=force)
    with _progress("campaign") as progress:
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


@app.command("demo")
def _demo(
    out: Out = Path("demo-out"),
    seed: Seed = 0,
    force: Force = False,
) -> None:
    """Simulate a docking, run it, and leave files and pictures."""
    from lumidock.demo import Album, summary_lines
    from lumidock.localizer import Localizer
    from lumidock.metrics import evaluate, true_poses
    from lumidock.report import contact_sheet, plot_trajectory
    from lumidock.run import Setup
    from lumidock.run import run as run_source
    from lumidock.sim.scenario import load_scenario
    from lumidock.sim.sequence import write_rendered
    from lumidock.streams.runfolder import RunFolder

    _prepare(out, force)
    sequence, run_folder = out / "sequence", out / "run"
    _prepare_sequence(sequence, True)
    scenario = load_scenario("approach")
    station_file, camera_file = (
        _shipped_or_path("station", _DEFAULT_STATION),
        _shipped_or_path("camera", _DEFAULT_CAMERA),
    )
    dock, lens = load_station(station_file), load_camera(camera_file)
    _copy(station_file, sequence / "station.yaml")
    with _progress("simulating") as progress:
        write_rendered(scenario, dock, lens, seed, sequence, progress=progress)
    source = open_source(sequence)
    setup = Setup("lumidock", False, Config(), station_file, camera_file)
    video = out / "annotated.mp4"
    with (
        RunFolder(run_folder, dock.ids) as folder,
        _progress("localizing") as progress,
        _interrupts_held() as let_interrupt,
        Album(dock, lens, video, 1.0 / scenario.path.frame_interval_s) as album,
    ):

        def on_fix(item: Item, fix: Fix) -> None:
            album.add(item, fix)
            progress(len(album.fixes), source.count)
            let_interrupt()

        _copy(station_file, run_folder / "station.yaml")
        _copy(camera_file, run_folder / "camera.yaml")
        summary = run_source(source, Localizer(dock, lens), folder, setup, on_fix=on_fix)
    result = evaluate(run_folder, sequence)
    plot_trajectory(album.fixes, true_poses(sequence), dock, out / "trajectory.png")
    contact_sheet(album.sheet(), out / "stages.jpg")
    print("\n".join(summary_lines(result, summary.as_dict())))
    print(f"look at     {out / 'trajectory.png'}, {out / 'stages.jpg'}, {video}, {run_folder / 'fixes.csv'}")


def _file(kind: str, given: str | None, beside: Path | None, source: Source) -> Path:
    """The station or camera file: the option, or the one beside the frames."""
    if given is not None:
        return _shipped_or_path(kind, given)
    if beside is None:
        raise InputError(f"{source.path}: no {kind}.yaml beside the frames; give --{kind} FILE")
    return beside


def _shipped_or_path(kind: str, name: str) -> Path:
    """A file, or what the package ships under that name."""
    shipped = Path(str(files("lumidock"))) / f"{kind}s" / f"{name}.yaml"
    path = shipped if "/" not in name and shipped.exists() else Path(name)
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: not a file")  # a pipe could be read once only, and a run reads it thrice
    return path


def _copy(source: Path, target: Path) -> None:
    if source.resolve() != target.resolve():
        target.unlink(missing_ok=True)  # a link, not what it points to
        shutil.copyfile(source, target)


def _prepare(folder: Path, force: bool) -> None:
    """Make an output folder; an existing one only with `force`."""
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file")
    if folder.exists() and not force:
        raise InputError(f"{folder}: exists; give --force to write into it")
    folder.mkdir(parents=True, exist_ok=True)


def _prepare_sequence(folder: Path, force: bool) -> None:
    """Make a folder for a simulated sequence, or clear one; frames that were not simulated are left alone."""
    truth = folder / "truth.csv"
    found = [name for name in (*_SIMULATED, "camera.yaml", "station.yaml") if (folder / name).exists()]
    if force and found and not truth.exists():
        raise InputError(f"{folder}: has {found[0]} but no truth.csv, so it was not simulated; write elsewhere")
    _prepare(folder, force)
    for name in _SIMULATED:
        stale = folder / name
        if stale.is_dir() and not stale.is_symlink():
            shutil.rmtree(stale)
        else:
            stale.unlink(missing_ok=True)
    truth.write_bytes(b"")  # marks the folder as simulated, also when the simulation is cut short


@contextmanager
def _interrupts_held() -> Iterator[Callable[[], None]]:
    """Hold Ctrl-C, but not a second one, until the callback that this yields: compiled code cannot be left half-way."""
    before = signal.getsignal(signal.SIGINT)
    held: list[int] = []

    def hold(number: int, _frame: FrameType | None) -> None:
        signal.signal(signal.SIGINT, before)
        held.append(number)

    def let_interrupt() -> None:
        if held:
            raise KeyboardInterrupt

    if before is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, hold)
    try:
        yield let_interrupt
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def _progress(title: str) -> Iterator[Callable[[int, int | None], None]]:
    """A bar with ETA on standard error, for a person only; yields a callback (done, total)."""
    columns = (
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    console = Console(stderr=True)
    with Progress(TextColumn("{task.description}"), *columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task(title, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def _print_evaluation(result: dict[str, Any]) -> None:
    """The evaluation as text: one line a topic, one row a range."""
    print(
        f"valid {result['valid']} of {_share(result, 'valid')}, guide {result['guide']} of {_share(result, 'guide')}; "
        f"not valid: {_words(result['reasons'])}"
    )
    for word, gaps in result["continuity"].items():
        if gaps["longest_gap_s"] is not None:
            print(f"longest gap in {word} {gaps['longest_gap_s']:.2f} s; gaps over 0.45 s: {gaps['long_gaps']}")
    if result["error"]:
        _print_ranges(result)
    for layer, content in result.get("layers", {}).items():
        if isinstance(content, dict):
            print(f"{layer}: {content['fixes']} fixes, z {content['first_z_m']:.2f} to {content['last_z_m']:.2f} m")
        elif content is not None:
            print(f"largest offset between the layers {content:.3f} m")
    if "labels" in result:
        print(f"names: {result['labels']['named']} given, {result['labels']['wrong']} wrong")
    if result.get("residual_rms_px") is not None:
        print(f"named lights {result['residual_rms_px']:.2f} px rms from where the poses put them")
    _print_trust(result)


def _print_ranges(result: dict[str, Any]) -> None:
    print(f"{'z, m':>12} {'frames':>7} {'valid':>6} {'guide':>6}", end="   ")
    print("lateral m       axial m         angle deg   (median / 95 %)")
    for row in [*result["by_true_z"], {"z_m": None, **result, **result["error"]}]:
        where = "all" if row["z_m"] is None else f"{row['z_m'][0]:g}..{row['z_m'][1]:g}"
        errors = (row.get(name) for name in ("lateral_m", "axial_m", "angle_deg"))
        cells = "  ".join(f"{e['median']:6.3f} /{e['p95']:7.3f}" if e else f"{'-':>15}" for e in errors)
        print(f"{where:>12} {row['frames']:7d} {row['valid']:6d} {row['guide']:6d}   {cells}")


def _print_trust(result: dict[str, Any]) -> None:
    """What the run's own claims are worth."""
    hazardous = result["hazardous"]
    for word in ("valid", "guide"):
        kinds = {kind: count for kind, count in hazardous[word].items() if kind != "any"}
        print(f"{word} but over the alert limit {hazardous[word]['any']} of {hazardous['frames']} frames", end="")
        print(f": {_words(kinds)}" if any(kinds.values()) else "")
    levels = {kind: f"{row['over']} of {row['frames']}" for kind, row in result["over_level"].items() if row["frames"]}
    if levels:
        print(f"error over the protection level: {_words(levels)}")
    nees = result["nees"]
    if nees["frames"]:
        stages = {stage: f"{mean['mean']:.2f}" for stage, mean in nees["by_stage"].items()}
        print(f"NEES {nees['mean']:.2f} over {nees['frames']} frames, honest is 6: {_words(stages)}")
    if result["nis"]:
        print(
            f"NIS {result['nis']['mean']:.2f} per degree of freedom over {result['nis']['frames']} frames, honest is 1"
        )
    if nees["improper"]:
        print(f"covariances that are none {nees['improper']}")


def _words(counts: dict[str, Any]) -> str:
    return ", ".join(f"{word} {count}" for word, count in counts.items()) or "none"


def _share(result: dict[str, Any], word: str) -> str:
    """The frames of an evaluation, and which share of them is meant."""
    share = result["availability"][word]
    return f"{result['frames']} frames" + (f" ({100.0 * share:.1f} %)" if share is not None else "")
