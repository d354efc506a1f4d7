"""`lumidock serve`."""

from __future__ import annotations

import json
import math
import re
import signal
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from lumidock import methods
from lumidock.app.serve import STALE_S, Newest, Server, SourceReader, Worker
from lumidock.app.warm import warm_up
from lumidock.camera import Camera, save_camera
from lumidock.cli.shared import (
    SIM,
    AsJson,
    AsStored,
    Bits,
    CameraName,
    CameraOption,
    ConfigOption,
    DelayMs,
    Force,
    Fps,
    InfoTopic,
    Method,
    StationOption,
    Topic,
    Trusted,
    VehicleOption,
    app,
    calibration_of,
    copy,
    example,
    file_of,
    open_any,
    prepare_folder,
    require_new,
    simulated,
    tell,
    warn_if_nothing_is_kept,
)
from lumidock.config import Config, load_config
from lumidock.errors import InputError, extra
from lumidock.go_no_go import DRIFT_M_S, Passage, Watch
from lumidock.methods import localizer_of, require_method
from lumidock.station import load_station
from lumidock.streams.healthpage import HealthPage
from lumidock.streams.sensors import AidingFeed, SensorFeed
from lumidock.streams.sinks import FILE_KINDS, Numbered, RunSink, Setting, open_rerun
from lumidock.streams.source import Reading, Source
from lumidock.streams.vehicle import load_vehicle

_LOOPBACK, _ENDPOINT = "127.0.0.1", re.compile(r"(tcp|udp|tls|quic)/[^/?#]+:[0-9]{1,5}")
_SWITCH_S = 5e-4  # a thread may hold the interpreter; the default lets the vehicle wait ten times longer
_SHORT, _LONG, _ROWS = 2, 8, 256  # that wait for a network, and with and without pictures for a disk


LiveSource = Annotated[
    str,
    typer.Argument(
        metavar="SOURCE",
        help="rtsp://..., rtp://HOST:PORT, /dev/videoN, gige:[NAME], sim:SCENARIO, or a recording at its own pace.",
    ),
]
MavlinkOption = Annotated[
    str | None,
    typer.Option("--mavlink", metavar="HOST:PORT", help="Send VISION_POSITION_ESTIMATE by UDP; needs --vehicle."),
]
GoNoGoOption = Annotated[
    str | None,
    typer.Option(
        "--go-no-go",
        metavar="M[:M/S]",
        help="Say go, hold or abort, in health and by MAVLink, to a vehicle of this cross-section radius that "
        f"may move so fast unnoticed; {DRIFT_M_S:g} m/s unless given.",
    ),
]
SensorsOption = Annotated[
    str | None,
    typer.Option(
        "--sensors", metavar="HOST:PORT", help="Listen there for ATTITUDE and VISION_POSITION_DELTA by UDP, as aiding."
    ),
]
ZenohOption = Annotated[
    str | None,
    typer.Option("--zenoh", metavar="ENDPOINT", help="Publish to ROS 2 by this zenoh router: tcp/127.0.0.1:7447."),
]
RerunOption = Annotated[
    str | None,
    typer.Option("--rerun", metavar="ADDRESS", help="Show in the viewer at rerun+http://HOST:PORT/proxy."),
]
RecordOption = Annotated[
    list[Path] | None,
    typer.Option("--record", metavar="FILE", help="Write a .mcap, .rrd or .mp4 file; may be repeated."),
]
HostOption = Annotated[
    str,
    typer.Option("--host", metavar="ADDRESS", help="Where page and Foxglove listen; with another, DDS goes out."),
]


@app.command(
    "serve",
    epilog=example(
        "lumidock serve rtsp://192.168.2.10/front --station dock.yaml --camera camera.yaml "
        "--vehicle vehicle.yaml --mavlink 127.0.0.1:14550",
        "lumidock serve gige: --station dock.yaml --camera camera.yaml --zenoh tcp/127.0.0.1:7447 --out RUN",
        "lumidock serve sim:approach --foxglove",
    ),
)
def _serve(
    source: LiveSource,
    station: StationOption = None,
    camera: CameraOption = None,
    vehicle: VehicleOption = None,
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
    loop: Annotated[bool, typer.Option("--loop", help="Show a recording again and again.")] = False,
    mavlink: MavlinkOption = None,
    go_no_go: GoNoGoOption = None,
    sensors: SensorsOption = None,
    zenoh: ZenohOption = None,
    dds: Annotated[bool, typer.Option("--dds", help="Publish to ROS 2 by DDS.")] = False,
    domain: Annotated[int, typer.Option(metavar="N", min=0, max=232, help="ROS_DOMAIN_ID.")] = 0,
    foxglove: Annotated[bool, typer.Option("--foxglove", help="Let Foxglove connect, at --foxglove-port.")] = False,
    foxglove_port: Annotated[int, typer.Option(metavar="PORT", min=0, max=65535)] = 8765,
    rerun: RerunOption = None,
    out: Annotated[Path | None, typer.Option("--out", metavar="DIR", help="Write a run folder.")] = None,
    record: RecordOption = None,
    health_port: Annotated[int, typer.Option(metavar="PORT", min=0, max=65535, help="Of the health page.")] = 8780,
    host: HostOption = _LOOPBACK,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Localize live and send every fix to the vehicle, until stopped."""
    require_method(method)
    settings = load_config(config) if config else Config()
    with ExitStack() as stack:
        if source.startswith(SIM):
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "sequence"
            source = str(simulated(source, folder, station, camera))
        reading = Reading(fps, topic, info_topic, bits, as_stored=as_stored, trusted=trust_calibration)
        reading = replace(reading, follow_calibration=camera is None)
        opened = open_any(source, reading, delay_ms=delay_ms, station=station)
        station_file = file_of("station", station, opened.station, opened)
        calibration = calibration_of(camera, opened, name=camera_name, trusted=trust_calibration)
        tell((*opened.notes, *calibration.warnings))
        setting = Setting(load_station(station_file), calibration.camera, load_vehicle(vehicle) if vehicle else None)
        sinks = [
            *_vehicle_sinks(setting, mavlink, zenoh, domain if dds else None, domain, host),
            *_viewer_sinks(setting, foxglove_port if foxglove else None, rerun, host),
        ]
        server = _server(opened, _ready_localizer(method, setting, settings), setting.camera, sinks, loop=loop)
        server.feed = _sensor_feed(stack, opened, sensors)
        sinks += _go_no_go_sinks(server, setting, go_no_go, mavlink)
        page = stack.enter_context(closing(_health_page(host, health_port, server)))
        # last of all, so that a start that fails leaves what is on the disk alone
        sinks += _file_sinks(setting, station_file, out, record or [], force)
        print(f"health at http://{host}:{page.port}/", file=sys.stderr if as_json else sys.stdout, flush=True)
        with _stopped_by_signals(server.stop):
            server.serve()
    _print_end(server, as_json, live=opened.live)


def _ready_localizer(name: str, setting: Setting, settings: Config) -> methods.Method:
    """A localizer whose kernels are compiled."""
    warn_if_nothing_is_kept()
    dock, lens = setting.station, setting.camera
    list(warm_up(localizer_of(name, dock, lens, settings).process, dock, lens))
    return localizer_of(name, dock, lens, settings)


def _server(opened: Source, localizer: methods.Method, lens: Camera, sinks: list[Worker], *, loop: bool) -> Server:
    """A server of the newest frame of a source, which nothing has started yet."""
    sys.setswitchinterval(_SWITCH_S)
    stop, newest = threading.Event(), Newest()
    read = partial(opened.items, (lens.width, lens.height))
    reader = SourceReader(read, newest, live=opened.live, loop=loop, stop=stop)
    return Server(localizer, reader, newest, sinks, stop)


def _print_end(server: Server, as_json: bool, *, live: bool) -> None:
    """The counts of all that was served, for people or as JSON. Raises: InputError when a recording ended badly."""
    counts, dropped = server.counts, server.newest.dropped
    if as_json:
        print(json.dumps({word: counts[word] for word in ("frames", "valid", "guide")} | {"dropped": dropped}))
    else:
        print(f"{counts['frames']} frames: {counts['valid']} valid; {dropped} came too fast and were dropped")
    if server.camera.problem and not live:
        raise InputError(server.camera.problem)


def _health_page(host: str, port: int, server: Server) -> HealthPage:
    """The page, listening. Raises: InputError where that cannot be."""
    try:
        return HealthPage(host, port, server.health)
    except OSError as error:
        raise InputError(f"--health-port {port}: cannot listen on {host}: {error.strerror or error}") from None


@contextmanager
def _stopped_by_signals(stop: threading.Event) -> Iterator[None]:
    """Let SIGTERM and Ctrl-C end `serve` after the current frame, with every sink closed."""
    numbers = (signal.SIGTERM, signal.SIGINT)
    before = [signal.signal(number, lambda *_: stop.set()) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


def _vehicle_sinks(
    setting: Setting, mavlink: str | None, zenoh: str | None, dds: int | None, domain: int, host: str
) -> list[Worker]:
    workers, shared = [], (setting.camera, setting.vehicle, setting.station.ids)
    if mavlink is not None:
        if setting.vehicle is None:
            raise InputError("--mavlink needs --vehicle FILE: an autopilot wants the pose of the vehicle's body")
        with extra("mavlink"):
            from lumidock.streams.mavlink import Mavlink
        name, port = _host_and_port("--mavlink", mavlink)
        workers.append(
            Worker("mavlink", partial(Mavlink, name, port, setting.vehicle), queue=1, stale_s=STALE_S, pictures=False)
        )
    if zenoh is not None:
        if not _ENDPOINT.fullmatch(zenoh):
            raise InputError(f"--zenoh {zenoh}: wanted an endpoint, as tcp/127.0.0.1:7447 is one")
        with extra("zenoh"), extra("bag"):
            from lumidock.streams.zenohlink import ZenohLink
        workers.append(Worker("zenoh", partial(ZenohLink, zenoh, domain, *shared), queue=_SHORT))
    if dds is not None:
        with extra("dds"), extra("bag"):
            from lumidock.streams.ddslink import DdsLink
        workers.append(Worker("dds", partial(DdsLink, dds, host != _LOOPBACK, *shared), queue=_SHORT))
    return workers


def _go_no_go_sinks(server: Server, setting: Setting, given: str | None, mavlink: str | None) -> list[Worker]:
    """Let the server say go or no-go, and send it by MAVLink to where the fixes go."""
    if given is None:
        return []
    radius_m, _, drift_m_s = given.partition(":")
    try:
        size, drift = float(radius_m), float(drift_m_s or DRIFT_M_S)
    except ValueError:
        size = drift = math.nan
    if not (0.0 < size < math.inf and 0.0 <= drift < math.inf):
        raise InputError(f"--go-no-go {given}: wanted M or M:M/S, as 0.35:0.1 is one")
    server.watch = Watch(Passage.of(setting.station, size), drift)
    if mavlink is None:
        return []
    with extra("mavlink"):
        from lumidock.streams.go_no_go_link import GoNoGoLink
    name, port = _host_and_port("--mavlink", mavlink)
    link = partial(GoNoGoLink, name, port, server.watch)
    return [Worker("go-no-go", link, queue=1, stale_s=STALE_S, pictures=False)]


def _sensor_feed(stack: ExitStack, opened: Source, sensors: str | None) -> SensorFeed:
    """The sensors of an autopilot, until the stack is closed; else those of a recording."""
    if sensors is None:
        return AidingFeed(opened.sensors())
    with extra("mavlink"):
        from lumidock.streams.mavlink_sensors import MavlinkSensors
    host, port = _host_and_port("--sensors", sensors)
    try:
        feed = MavlinkSensors(host, port)
    except OSError as error:
        raise InputError(f"--sensors {sensors}: {error.strerror or error}") from None
    stack.callback(feed.close)
    return feed


def _viewer_sinks(setting: Setting, foxglove_port: int | None, rerun: str | None, host: str) -> list[Worker]:
    workers = []
    if foxglove_port is not None:
        with extra("live"), extra("bag"):
            from lumidock.streams.foxglovelive import FoxgloveLive
        shared = (setting.camera, setting.vehicle, setting.station.ids)
        server = partial(FoxgloveLive, host, foxglove_port, *shared)
        workers.append(Worker("foxglove", server, queue=_SHORT, patient=True))
    if rerun is not None:
        if not rerun.startswith("rerun+http"):
            raise InputError(f"--rerun {rerun}: wanted rerun+http://HOST:PORT/proxy")
        workers.append(Worker("rerun", partial(open_rerun, rerun, setting), queue=_SHORT, patient=True))
    return workers


def _file_sinks(
    setting: Setting, station_file: Path, out: Path | None, record: list[Path], force: bool
) -> list[Worker]:
    for path in record:
        if path.suffix not in FILE_KINDS:
            raise InputError(f"--record {path}: not one of {', '.join(FILE_KINDS)}")
        require_new(path, force)
    workers = []
    if out is not None:
        prepare_folder(out, force)
        folder = RunSink(out, setting.station.ids)
        copy(station_file, out / "station.yaml")
        save_camera(setting.camera, out / "camera.yaml")
        workers.append(Worker(out.name, lambda: folder, queue=_ROWS, pictures=False))
    workers += [Worker(path.name, Numbered(path, setting).open, queue=_LONG, patient=True) for path in record]
    return workers


def _host_and_port(option: str, text: str) -> tuple[str, int]:
    host, colon, port = text.rpartition(":")
    if not (colon and host and port.isdecimal() and 0 < int(port) < 65536):
        raise InputError(f"{option} {text}: wanted HOST:PORT")
    return host, int(port)
