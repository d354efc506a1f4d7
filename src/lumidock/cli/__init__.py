"""The command line: the only place that prints, parses options and exits."""

from __future__ import annotations

import io
import json
import os
import signal
import sys
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import cv2
import typer

from lumidock.camera import load_camera
from lumidock.cli import (
    calibration,
    console,
    demo,
    designing,
    docking,
    doctoring,
    evaluation,
    exporting,
    inspection,
    reporting,
    serving,
    setting_up,
    stations,
    water,
)
from lumidock.cli.progress import progress_bar
from lumidock.cli.shared import (
    DEFAULT_CAMERA,
    DEFAULT_STATION,
    SCENARIOS,
    SIM,
    AsJson,
    AsStored,
    Bits,
    CameraName,
    CameraOption,
    Cluster,
    ConfigOption,
    DelayMs,
    Force,
    Fps,
    InfoTopic,
    Method,
    Out,
    Seed,
    SourcesArgument,
    StationOption,
    Topic,
    Trusted,
    Workers,
    app,
    copy,
    example,
    interrupts_held,
    prepare_folder,
    prepare_sequence,
    require_folder,
    seeds_of,
    shipped_or_path,
    simulated,
    tell,
    tell_what_compiles,
    told_at_interrupt,
)
from lumidock.errors import InputError, LumidockError
from lumidock.methods import METHODS, require_method
from lumidock.station import load_station

if TYPE_CHECKING:
    from lumidock.cli.recordings import RunOptions

_COMMANDS = (
    evaluation,
    inspection,
    exporting,
    reporting,
    serving,
    console,
    calibration,
    water,
    stations,
    setting_up,
    designing,
    docking,
    demo,
    doctoring,
)  # importing them adds their commands


def main() -> None:
    """Entry point: every error that the user can correct is one line and exit code 2."""
    _keep_streams_clean()
    _clean_up_at_sigterm()
    try:
        code = app(standalone_mode=False, prog_name="lumidock")
        print(end="", flush=True)
    except typer.TyperException as error:
        _fail(error.format_message())
    except (typer.Abort, KeyboardInterrupt):
        sys.exit(130)
    except LumidockError as error:
        _fail(str(error))
    except BrokenPipeError:  # the program that read the output has ended
        _drop_output()
        sys.exit(1)
    except OSError as error:
        _drop_output()
        _fail(f"{error.filename or 'file system'}: {error.strerror or error}")
    sys.exit(code or 0)


def _clean_up_at_sigterm() -> None:
    """Let SIGTERM end the program in good order: no worker and no temporary folder is left behind."""
    if signal.getsignal(signal.SIGTERM) == signal.SIG_DFL:
        signal.signal(signal.SIGTERM, lambda number, _frame: sys.exit(128 + number))


def _keep_streams_clean() -> None:
    """Let any file name be printed, and silence the log messages of OpenCV and FFmpeg."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    if hasattr(cv2, "setLogLevel"):  # OpenCV 4
        cv2.setLogLevel(0)
    else:
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)


def _drop_output() -> None:
    """Discard output that cannot be written, or the interpreter would report it when it ends."""
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
        "lumidock run *.mcap dive.mp4 --station dock.yaml --camera camera.yaml --out RUNS --workers 4",
    ),
)
def _run(
    sources: SourcesArgument,
    out: Out,
    station: StationOption = None,
    camera: CameraOption = None,
    method: Method = "lumidock",
    cold: Annotated[bool, typer.Option("--cold", help="Forget all history before each frame.")] = False,
    topic: Topic = None,
    info_topic: InfoTopic = None,
    bits: Bits = 16,
    fps: Fps = None,
    as_stored: AsStored = False,
    delay_ms: DelayMs = 0.0,
    camera_name: CameraName = None,
    trust_calibration: Trusted = False,
    config: ConfigOption = None,
    workers: Workers = None,
    cluster: Cluster = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Find the camera's pose in every frame of SOURCE."""
    from lumidock.cli.recordings import RunOptions

    require_method(method)
    options = RunOptions(
        *(station, camera, method, cold, topic, info_topic, bits, fps, as_stored, delay_ms, camera_name),
        trusted=trust_calibration,
        config=config,
    )
    if len(sources) > 1 or workers is not None or cluster is not None:
        _run_many(sources, out, options, force=force, workers=workers, cluster=cluster, as_json=as_json)
    else:
        _run_one(sources[0], out, options, force=force, as_json=as_json)


def _run_one(source: str, out: Path, options: RunOptions, *, force: bool, as_json: bool) -> None:
    from lumidock.cli.recordings import open_recording, run_recording

    options.settings()  # before anything is simulated
    if source.startswith(SIM):
        require_folder(out, force)
        source, force = str(simulated(source, out / "sequence", options.station, options.camera)), True
    recording = open_recording(source, options)
    tell(recording.notes)
    tell_what_compiles()
    localizer = recording.localizer()
    _require_another_folder(out, recording.source.path)
    prepare_folder(out, force)
    left = f"{out} holds a complete row for every frame so far; `run` with --force begins again"
    with told_at_interrupt(left), progress_bar("run") as progress, interrupts_held() as let_interrupt:
        counts = run_recording(recording, localizer, out, progress=progress, let_interrupt=let_interrupt)
    _print_counts(counts, out, as_json)


def _run_many(
    sources: list[str],
    out: Path,
    options: RunOptions,
    *,
    force: bool,
    workers: int | None,
    cluster: str | None,
    as_json: bool,
) -> None:
    """Run each source into a folder of its own; what an earlier call finished is kept."""
    from lumidock.cli.recordings import Outcome, jobs_of, run_job
    from lumidock.evaluation.workers import results

    if simulations := [source for source in sources if source.startswith(SIM)]:
        raise InputError(
            f"{simulations[0]}: several simulations are a campaign: lumidock campaign SCENARIO --seeds A:B"
        )
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file")
    jobs, outcomes = jobs_of(sources, out, options, force=force), dict[str, Outcome]()
    for job in jobs.values():
        _require_another_folder(job.out, Path(job.source))
    tell_what_compiles()
    out.mkdir(parents=True, exist_ok=True)
    left = f"{out} holds the runs that are finished; the same command continues with the others"
    with told_at_interrupt(left), progress_bar("run") as progress:
        progress(0, len(jobs))
        for name, outcome in results(run_job, jobs, os.cpu_count() or 1 if workers is None else workers, cluster):
            outcomes[name] = outcome
            progress(len(outcomes), len(jobs))
    for name in jobs:
        tell(f"{name}: {note}" for note in outcomes[name].notes)
    if as_json:
        print(json.dumps({n: outcomes[n].counts or {"error": outcomes[n].error} for n in jobs}, indent=2))
    else:
        for name, job in jobs.items():
            if (counts := outcomes[name].counts) is not None:
                _print_counts(counts, job.out, as_json)
    failed = [f"{name}: {outcomes[name].error}" for name in jobs if outcomes[name].error]
    for line in failed[:-1]:
        print(f"lumidock: {line}", file=sys.stderr)
    if failed:
        raise InputError(failed[-1])


def _require_another_folder(out: Path, source: Path) -> None:
    """Raises: InputError where a run would be written into its own source."""
    if out.is_dir() and source.is_dir() and out.samefile(source):
        raise InputError(f"{out}: is the source; write the run elsewhere")


_WORTH_SAYING = 0.95  # factor on the exposure, above which a shorter one changes little


def _print_counts(counts: dict[str, Any], out: Path, as_json: bool) -> None:
    """The counts of a run, for people or as JSON; what contradicts the files in words, beside them."""
    from lumidock.app.run import contradictions_in_words
    from lumidock.evaluation.run_description import over_limit_in_words

    tell(contradictions_in_words(counts))
    if as_json:
        print(json.dumps(counts, indent=2))
        return
    none = counts["frames"] - counts["valid"] - counts["guide_only"]
    print(
        f"{counts['frames']} frames: {counts['valid']} valid, {counts['guide_only']} guide only, {none} no fix; "
        f"written to {out}"
    )
    for line in over_limit_in_words({"counts": counts}):
        print(f"protection: {line}")
    if counts["reason"]:
        print("not valid: " + ", ".join(f"{word} {count}" for word, count in sorted(counts["reason"].items())))
    asked = counts["exposure"]
    if asked and asked["factor"] < _WORTH_SAYING:
        print(
            f"lights overexposed in {asked['too_bright']} of {asked['frames']} frames: "
            f"shorten the exposure to about x{asked['factor']:.2g}"
        )


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
        typer.Option(
            "--detections", help="Bare detections, without rendering: only path, faults and detections count."
        ),
    ] = False,
    video: Annotated[bool, typer.Option("--video", help="Pictures as video.mp4 instead of frames/.")] = False,
    workers: Workers = None,
    station: StationOption = None,
    camera: CameraOption = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Simulate SCENARIO into a sequence folder with truth."""
    from lumidock.sim.scenario import load_scenario, station_of
    from lumidock.sim.sequence import require_possible, write_detections, write_rendered

    if video and detections:
        raise InputError("--video: bare detections have no pictures")
    loaded = load_scenario(scenario, tuple(settings or ()))
    require_possible(loaded, detections=detections, video=video)
    station_file = shipped_or_path("station", station) if station else station_of(loaded)
    dock = load_station(station_file)
    lens = load_camera(shipped_or_path("camera", camera or DEFAULT_CAMERA))
    prepare_sequence(out, force)
    copy(station_file, out / "station.yaml")
    if detections:
        frames = write_detections(loaded, dock, lens, seed, out)
    else:
        left = f"{out} holds an incomplete sequence, which `run` refuses; the same command with --force begins again"
        with told_at_interrupt(left), progress_bar("sim") as progress:
            frames = write_rendered(loaded, dock, lens, seed, out, video=video, workers=workers, progress=progress)
    print(json.dumps({"frames": frames, "folder": str(out)}) if as_json else f"{frames} frames written to {out}")


@app.command(
    "campaign",
    epilog=example("lumidock campaign nominal --seeds 0:100 --out CAMPAIGN", "lumidock campaign faults --out FAULTS"),
)
def _campaign(
    scenarios: Annotated[list[str], typer.Argument(metavar="SCENARIO", help=f"{SCENARIOS}, faults, or .yaml files.")],
    out: Annotated[
        Path,
        typer.Option(
            "--out", metavar="DIR", help="Folder to write; the same command continues an interrupted campaign."
        ),
    ],
    seeds: Annotated[str, typer.Option(metavar="A:B", help="Seeds A to B - 1, a run of each scenario each.")] = "0:10",
    methods: Annotated[
        list[str] | None,
        typer.Option("--method", metavar="NAME", help="lumidock (default), paper, ...; may be repeated."),
    ] = None,
    cold: Annotated[bool, typer.Option("--cold", help="Forget all history before each frame.")] = False,
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY.SUBKEY=VALUE", help="Of all scenarios; may be repeated.")
    ] = None,
    workers: Workers = None,
    cluster: Cluster = None,
    bound: Annotated[
        bool, typer.Option("--bound", help="Also count in which frames the lights in view allow a valid fix (slower).")
    ] = False,
    station: StationOption = None,
    camera: CameraOption = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Run scenarios x seeds x methods on bare detections.

    `faults` stands for every shipped scenario of a fault.
    """
    from lumidock.evaluation.campaign import plan, prepare, run_campaign, tabulate
    from lumidock.evaluation.campaign_table import markdown
    from lumidock.sim.scenario import load_scenarios

    for method in methods or ():
        require_method(method)
    campaign = plan(
        load_scenarios(scenarios, tuple(settings or ())),
        methods or METHODS[:1],
        seeds_of(seeds),
        shipped_or_path("station", station) if station else None,
        shipped_or_path("camera", camera or DEFAULT_CAMERA),
        cold=cold,
        bound=bound,
    )
    prepare(campaign, out, force=force)
    left = f"{out} holds the finished shards; the same command continues with the others"
    tell_what_compiles()
    with told_at_interrupt(left), progress_bar("campaign") as progress:
        speed = run_campaign(campaign, out, workers=workers, cluster=cluster, progress=progress)
    table = tabulate(campaign, out)
    if as_json:
        print(json.dumps(table, indent=1))
        return
    print(markdown(table))
    ran = f"{speed:.0f} frames a second and core" if speed > 0.0 else "nothing was left to do"
    print(f"{ran}; written to {out}")


@app.command("warm", epilog=example("lumidock warm"))
def _warm() -> None:
    """Compile ahead, so that no run waits for it."""
    from lumidock.app.warm import compile_all, compiled_code

    dock = load_station(shipped_or_path("station", DEFAULT_STATION))
    lens = load_camera(shipped_or_path("camera", DEFAULT_CAMERA))
    state = compiled_code()
    if state.mark == "bad":
        raise LumidockError(state.text)
    print("compiling detection and matching, one to two minutes ...", flush=True)
    for name in compile_all(dock, lens):
        print(f"ready for {name}", flush=True)
    print(compiled_code().text)
