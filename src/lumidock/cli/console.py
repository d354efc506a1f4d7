"""`lumidock console`, and the console of `lumidock serve`."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lumidock.camera import Camera, load_camera, save_camera
from lumidock.cli.scratch import scratch_folder
from lumidock.cli.shared import (
    SIM,
    AsStored,
    Bits,
    CameraName,
    CameraOption,
    ConfigOption,
    DelayMs,
    Fps,
    InfoTopic,
    Method,
    StationOption,
    Topic,
    Trusted,
    app,
    calibration_of,
    example,
    file_of,
    open_any,
    simulated,
    tell,
    tell_what_compiles,
)
from lumidock.config import Config, load_config
from lumidock.errors import InputError, extra
from lumidock.methods import localizer_of, require_method
from lumidock.station import Station, load_station
from lumidock.streams.healthpage import HealthPage
from lumidock.streams.localweb import is_loopback
from lumidock.streams.source import Reading
from lumidock.yamlfile import validate

if TYPE_CHECKING:
    from lumidock.app.console.live import LiveView
    from lumidock.app.console.replay import Recording
    from lumidock.app.console.routes import Console
    from lumidock.app.console.server import ConsoleServer

_PORT, _LOOPBACK = 8780, "127.0.0.1"
_LIBRARIES = ("starlette", "uvicorn", "wsproto")

ConsoleOption = Annotated[
    bool | None,
    typer.Option("--console/--no-console", help="The console; on by default where only this machine can reach it."),
]


def wants_console(asked: bool | None, host: str) -> bool:
    """Whether `serve` opens the console. Raises: InputError where it is asked for and not installed."""
    if asked:
        with extra("console"):
            from lumidock.app.console import server  # noqa: F401  # only whether it can be imported
        return True
    return asked is None and is_loopback(host) and _installed()


def _installed() -> bool:
    return all(find_spec(name) is not None for name in _LIBRARIES)


def live_view(station: Station, camera: Camera) -> LiveView:
    """What the console shows of a live camera, as a sink."""
    from lumidock.app.console.frame_view import Scene
    from lumidock.app.console.live import LiveView

    return LiveView(Scene(station, camera))


@dataclass(frozen=True, slots=True)
class LivePage:
    """The console of a running server, or where there is no `shown` its health as JSON alone."""

    shown: LiveView | None
    health: Callable[[], dict[str, Any]]
    station_file: Path
    method: str
    settings: Config
    vehicle: Path | None

    @contextmanager
    def opened(self, host: str, port: int) -> Iterator[str]:
        """Answer within this; yields the line that says where. Raises: InputError where the port cannot be had."""
        with ExitStack() as stack:
            if self.shown is None:
                with _listening_on("--health-port", host, port):
                    page = HealthPage(host, port, self.health)
                stack.callback(page.close)
                hint = "" if _installed() else "no console without lumidock[console]; "
                yield f"{hint}health at http://{host}:{page.port}/"
                return
            self.shown.health = self.health
            scratch = stack.enter_context(scratch_folder())
            server = _open(stack, self._console(scratch), host, ("--health-port", port))
            yield f"console at http://{host}:{server.port}/#token={server.token}"

    def _console(self, scratch: Path) -> Console:
        from lumidock.app.console.routes import Console
        from lumidock.app.console.wizards import Files

        assert self.shown is not None
        station, camera = self.shown.scene.station, self.shown.scene.camera
        save_camera(camera, scratch / "camera.yaml")
        files = Files(self.station_file, scratch / "camera.yaml", scratch)
        vehicle = f", vehicle file {self.vehicle.name}" if self.vehicle else ""
        about = f"dock {station.name}{vehicle}"
        return Console(files, self.method, self.settings, about, live=self.shown, health=self.health)


def _open(stack: ExitStack, console: Console, host: str, port: tuple[str, int]) -> ConsoleServer:
    from lumidock.app.console.server import ConsoleServer

    with _listening_on(port[0], host, port[1]):
        server = ConsoleServer(console, host, port[1])
    stack.callback(server.close)
    return server


@contextmanager
def _listening_on(option: str, host: str, port: int) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise InputError(f"{option} {port}: cannot listen on {host}: {error.strerror or error}") from None


@contextmanager
def stopped_by_signals(stop: threading.Event) -> Iterator[None]:
    """Let SIGTERM and Ctrl-C end a server in good order."""
    numbers = (signal.SIGTERM, signal.SIGINT)
    before = [signal.signal(number, lambda *_: stop.set()) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


@app.command(
    "console",
    epilog=example(
        "lumidock console RUN",
        "lumidock console RUN --source dive.mcap",
        "lumidock console dive.mp4 --station dock.yaml --camera camera.yaml",
    ),
)
def _console(
    target: Annotated[str, typer.Argument(metavar="RUN|SOURCE", help="A run folder, or what `lumidock run` takes.")],
    source: Annotated[
        Path | None, typer.Option("--source", metavar="SOURCE", help="What RUN was made from, for its pictures.")
    ] = None,
    station: StationOption = None,
    camera: CameraOption = None,
    method: Method = "lumidock",
    topic: Topic = None,
    info_topic: InfoTopic = None,
    bits: Bits = 16,
    fps: Fps = None,
    as_stored: AsStored = False,
    delay_ms: DelayMs = 0.0,
    camera_name: CameraName = None,
    trust_calibration: Trusted = False,
    config: ConfigOption = None,
    host: Annotated[str, typer.Option("--host", metavar="ADDRESS", help="Where the console listens.")] = _LOOPBACK,
    port: Annotated[int, typer.Option(metavar="PORT", min=0, max=65535)] = _PORT,
) -> None:
    """Replay a recording in the browser: step, compare and tune."""
    with extra("console"):
        from lumidock.app.console import server  # noqa: F401  # only whether it can be imported
    from lumidock.app.console.frame_view import Scene
    from lumidock.app.console.replay import Recording
    from lumidock.setup.recordings import is_run

    reading = Reading(
        fps, topic, info_topic, bits, as_stored=as_stored, trusted=trust_calibration, follow_calibration=camera is None
    )
    with ExitStack() as stack:
        scratch = stack.enter_context(scratch_folder())
        if is_run(Path(target)):
            recording = _of_run(Path(target), source, scratch)
        else:
            require_method(method)
            settings = load_config(config) if config else Config()
            if target.startswith(SIM):
                target = str(simulated(target, scratch / "sequence", station, camera))
            opened = open_any(target, reading, delay_ms=delay_ms, station=station)
            if opened.live:
                raise InputError(f"{target}: a live camera; lumidock serve shows it in the console")
            station_file = file_of("station", station, opened.station, opened)
            calibration = calibration_of(camera, opened, name=camera_name, trusted=trust_calibration)
            tell((*opened.notes, *calibration.warnings))
            scene = Scene(load_station(station_file), calibration.camera)
            save_camera(calibration.camera, scratch / "camera.yaml")
            recording = Recording(
                scene=scene,
                station=station_file,
                camera=scratch / "camera.yaml",
                method=method,
                config=settings,
                source=opened,
                run=None,
                options=_words(reading, delay_ms),
            )
        _serve_recording(stack, recording, scratch, (host, port))


def _of_run(folder: Path, source: Path | None, scratch: Path) -> Recording:
    """A run that there is, with its pictures where they are found. Raises: InputError for one that is damaged."""
    from lumidock.app.console.frame_view import Scene
    from lumidock.app.console.replay import Recording
    from lumidock.evaluation.run_description import read_description
    from lumidock.evaluation.run_folders import source_of

    described = read_description(folder)
    scene = Scene(load_station(folder / "station.yaml"), load_camera(folder / "camera.yaml"))
    save_camera(scene.camera, scratch / "camera.yaml")
    return Recording(
        scene=scene,
        station=folder / "station.yaml",
        camera=scratch / "camera.yaml",
        method=str(described.get("method", "lumidock")),
        config=validate(Config, described.get("config", {}), str(folder / "run.json")),
        source=source_of(folder, described, source),
        run=folder,
        options=_words(Reading(trusted=True), 0.0),
    )


def _serve_recording(stack: ExitStack, recording: Recording, scratch: Path, at: tuple[str, int]) -> None:
    """Open the console on a recording until a signal ends it."""
    from lumidock.app.console.replay import Replay
    from lumidock.app.console.routes import Console
    from lumidock.app.console.wizards import Files

    scene, localizer = recording.scene, None
    if recording.run is None:
        tell_what_compiles()
        localizer = localizer_of(recording.method, scene.station, scene.camera, recording.config)
    files = Files(recording.station, recording.camera, scratch)
    console = Console(files, recording.method, recording.config, f"dock {scene.station.name}")
    console.replay = Replay(recording, console.jobs, scratch, localizer)
    stop = threading.Event()
    server = _open(stack, console, at[0], ("--port", at[1]))
    console.replay.start()
    print(f"console at http://{at[0]}:{server.port}/#token={server.token}", flush=True)
    with stopped_by_signals(stop):
        stop.wait()


def _words(reading: Reading, delay_ms: float) -> tuple[str, ...]:
    """The options with which `lumidock run` reads a source in the same way."""
    words = {
        "--topic": reading.topic,
        "--info-topic": reading.info_topic,
        "--bits": None if reading.bits == Reading().bits else reading.bits,
        "--fps": reading.fps,
        "--delay-ms": delay_ms or None,
    }
    given = [word for name, value in words.items() if value is not None for word in (name, str(value))]
    return (*given, *(["--as-stored"] if reading.as_stored else []), "--trust-calibration")
