"""`lumidock serve`."""

from __future__ import annotations

import json
import math
import re
import sys
import threading
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from lumidock import methods
from lumidock.app.run import LiveRecord, Record, identity_of
from lumidock.app.serve import STALE_S, Newest, Server, SourceReader, Worker
from lumidock.app.warm import warm_up
from lumidock.cli.console import ConsoleOption, LivePage, live_view, stopped_by_signals, wants_console
from lumidock.cli.recordings import Recording, RunOptions, open_recording
from lumidock.cli.scratch import scratch_folder
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
    copy,
    example,
    keep_camera,
    prepare_folder,
    require_new,
    simulated,
    tell,
    tell_what_compiles,
)
from lumidock.errors import InputError, extra
from lumidock.go_no_go import DRIFT_M_S, Passage, Watch
from lumidock.methods import localizer_of, require_method
from lumidock.station import Station
from lumidock.streams.run_folder import RunFolder
from lumidock.streams.sensors import AidingFeed, SensorFeed
from lumidock.streams.sinks import FILE_KINDS, Numbered, Setting, Sink, open_rerun
from lumidock.streams.source import Network, Source
from lumidock.streams.vehicle import load_vehicle

_LOOPBACK, _ENDPOINT = "127.0.0.1", re.compile(r"(tcp|udp|tls|quic)/[^/?#]+:[0-9]{1,5}")
_SWITCH_S = 5e-4  # a thread may hold the interpreter; the default lets the vehicle wait ten times longer
_SHORT, _LONG, _ROWS = 2, 8, 256  # that wait for a network, and with and without pictures for a disk


LiveSource = Annotated[
    str,
    typer.Argument(
        metavar="SOURCE",
        help="rtsp://..., rtp://HOST:PORT, /dev/videoN, gige:[NAME], zenoh:/TOPIC, dds:/TOPIC, sim:SCENARIO, or a "
        "recording at its own pace.",
    ),
]
MavlinkOption = Annotated[
    str | None,
    typer.Option("--mavlink", metavar="HOST:PORT", help="Send poses, bearing and range by UDP; needs --vehicle."),
]
MavlinkId = Annotated[
    str,
    typer.Option("--mavlink-id", metavar="SYSTEM[:COMPONENT]", help="Who speaks; the system is the autopilot's."),
]
MavlinkKey = Annotated[
    Path | None,
    typer.Option("--mavlink-key", metavar="FILE", help="Sign with the passphrase in the first line of FILE."),
]
MavlinkHeading = Annotated[
    float | None,
    typer.Option(
        "--mavlink-heading",
        metavar="DEG",
        min=-180.0,
        max=360.0,
        help="Compass heading of a vehicle that faces the dock head-on: the local frame is then north, east, down.",
    ),
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
    mavlink_id: MavlinkId = "1:197",
    mavlink_key: MavlinkKey = None,
    mavlink_heading: MavlinkHeading = None,
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
    health_port: Annotated[int, typer.Option(metavar="PORT", min=0, max=65535, help="Of console and health.")] = 8780,
    host: HostOption = _LOOPBACK,
    console: ConsoleOption = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Localize live and send every fix to the vehicle, until stopped."""
    require_method(method)
    read_as = (topic, info_topic, bits, fps, as_stored, delay_ms, camera_name)
    options = RunOptions(station, camera, method, False, *read_as, trusted=trust_calibration, config=config)
    options.settings()  # before anything is simulated
    network = Network(domain, host != _LOOPBACK)
    with ExitStack() as stack:
        recording = _opened(stack, source, options, network)
        setting = _setting(recording, vehicle, go_no_go)
        shown = live_view(setting.station, setting.camera) if wants_console(console, host) else None
        sinks = [
            *_mavlink_sinks(setting, mavlink, mavlink_id, mavlink_key, mavlink_heading),
            *_go_no_go_sinks(setting.watch, mavlink),
            *_ros_sinks(setting, zenoh, network if dds else None, domain),
            *_viewer_sinks(setting, foxglove_port if foxglove else None, rerun, host, shown),
        ]
        server = _server(recording, _ready_localizer(setting, recording), sinks, loop=loop)
        server.feed, server.watch = _sensor_feed(stack, recording.source, sensors), setting.watch
        page = LivePage(shown, server.health, recording.station_file, method, recording.config, vehicle)
        line = stack.enter_context(page.opened(host, health_port))
        sinks += [*_record_sinks(setting, record or [], force), *_folder_sinks(out, recording, setting, server, force)]
        print(line, file=sys.stderr if as_json else sys.stdout, flush=True)
        _serve_until_stopped(server)
    _print_end(server, as_json, live=recording.source.live)


def _opened(stack: ExitStack, source: str, options: RunOptions, network: Network) -> Recording:
    """The source, with what a person should know of it said; a scenario is rendered for as long as the stack lasts."""
    if source.startswith(SIM):
        folder = stack.enter_context(scratch_folder())
        source = str(simulated(source, folder / "sequence", options.station, options.camera))
    recording = open_recording(source, options, network)
    tell(recording.notes)
    return recording


def _ready_localizer(setting: Setting, recording: Recording) -> methods.Method:
    """A localizer whose kernels are compiled."""
    tell_what_compiles()
    dock, lens, name = setting.station, setting.camera, recording.options.method
    list(warm_up(localizer_of(name, dock, lens, recording.config).process, dock, lens))
    return localizer_of(name, dock, lens, recording.config)


def _server(recording: Recording, localizer: methods.Method, sinks: list[Worker], *, loop: bool) -> Server:
    """A server of the newest frame of a source, which nothing has started yet."""
    sys.setswitchinterval(_SWITCH_S)
    stop, newest, opened, lens = threading.Event(), Newest(), recording.source, recording.calibration.camera
    read = partial(opened.items, (lens.width, lens.height))
    reader = SourceReader(read, newest, live=opened.live, loop=loop, stop=stop)
    return Server(localizer, reader, newest, sinks, stop)


def _serve_until_stopped(server: Server) -> None:
    """Serve, and say which sinks have nobody to send to."""
    with stopped_by_signals(server.stop):
        server.serve(lambda: tell(f"{sink.name}: {sink.problem}" for sink in server.workers if sink.problem))


def _print_end(server: Server, as_json: bool, *, live: bool) -> None:
    """The counts of all that was served, for people or as JSON. Raises: InputError for a recording that broke off."""
    counts, dropped = server.counts, server.newest.dropped
    if as_json:
        print(json.dumps({word: counts[word] for word in ("frames", "valid", "guide")} | {"dropped": dropped}))
    else:
        usable = f"{counts['valid']} valid, {counts['guide']} with a guide"
        print(f"{counts['frames']} frames: {usable}; dropped because they came too fast: {dropped}")
    if server.camera.problem and not live:
        raise InputError(server.camera.problem)


def _mavlink_sinks(
    setting: Setting, mavlink: str | None, who: str, key: Path | None, heading_deg: float | None
) -> list[Worker]:
    if mavlink is None:
        return []
    if setting.vehicle is None:
        raise InputError("--mavlink needs --vehicle FILE: an autopilot wants the pose of the vehicle's body")
    with extra("mavlink"):
        from lumidock.streams.mavlink import Identity, Mavlink, ResetCounter, signing_key
    name, port = _host_and_port("--mavlink", mavlink)
    system, _, component = who.partition(":")
    if not all(word.isdecimal() and 0 < int(word) < 256 for word in (system, component or "197")):
        raise InputError(f"--mavlink-id {who}: wanted SYSTEM or SYSTEM:COMPONENT, each from 1 to 255")
    identity = Identity(
        int(system),
        int(component or "197"),
        math.radians(heading_deg or 0.0),
        signing_key(key) if key is not None else None,
    )
    link = partial(Mavlink, name, port, setting.vehicle, identity, ResetCounter())
    return [Worker("mavlink", link, queue=1, stale_s=STALE_S, pictures=False)]


def _ros_sinks(setting: Setting, zenoh: str | None, dds: Network | None, domain: int) -> list[Worker]:
    workers = []
    if zenoh is not None:
        if not _ENDPOINT.fullmatch(zenoh):
            raise InputError(f"--zenoh {zenoh}: wanted an endpoint, as tcp/127.0.0.1:7447 is one")
        with extra("zenoh"), extra("bag"):
            from lumidock.streams.zenohlink import ZenohLink
        workers.append(Worker("zenoh", partial(ZenohLink, zenoh, domain, setting.publication()), queue=_SHORT))
    if dds is not None:
        with extra("dds"), extra("bag"):
            from lumidock.streams.ddslink import DdsLink
        workers.append(Worker("dds", partial(DdsLink, dds.domain, dds.everywhere, setting.publication()), queue=_SHORT))
    return workers


def _setting(recording: Recording, vehicle: Path | None, go_no_go: str | None) -> Setting:
    """What the sinks need: dock, camera, its mounting, and by what go or no-go is said."""
    mounting = load_vehicle(vehicle) if vehicle else None
    watch = _watch(go_no_go, recording.station)
    return Setting(recording.station, recording.calibration.camera, mounting, watch)


def _watch(given: str | None, station: Station) -> Watch | None:
    """What go or no-go is said by, where `--go-no-go` asks for it."""
    if given is None:
        return None
    radius_m, _, drift_m_s = given.partition(":")
    try:
        size, drift = float(radius_m), float(drift_m_s or DRIFT_M_S)
    except ValueError:
        size = drift = math.nan
    if not (0.0 < size < math.inf and 0.0 <= drift < math.inf):
        raise InputError(f"--go-no-go {given}: wanted M or M:M/S, as 0.35:0.1 is one")
    return Watch(Passage.of(station, size), drift)


def _go_no_go_sinks(watch: Watch | None, mavlink: str | None) -> list[Worker]:
    """Go or no-go by MAVLink to where the fixes go."""
    if watch is None or mavlink is None:
        return []
    with extra("mavlink"):
        from lumidock.streams.go_no_go_link import GoNoGoLink
    name, port = _host_and_port("--mavlink", mavlink)
    link = partial(GoNoGoLink, name, port, watch)
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


def _viewer_sinks(
    setting: Setting, foxglove_port: int | None, rerun: str | None, host: str, console: Sink | None
) -> list[Worker]:
    workers = [] if console is None else [Worker("console", lambda: console, queue=1, patient=True)]
    if foxglove_port is not None:
        with extra("live"), extra("bag"):
            from lumidock.streams.foxglovelive import FoxgloveLive
        server = partial(FoxgloveLive, host, foxglove_port, setting.publication())
        workers.append(Worker("foxglove", server, queue=_SHORT, patient=True))
    if rerun is not None:
        if not rerun.startswith("rerun+http"):
            raise InputError(f"--rerun {rerun}: wanted rerun+http://HOST:PORT/proxy")
        workers.append(Worker("rerun", partial(open_rerun, rerun, setting), queue=_SHORT, patient=True))
    return workers


def _folder_sinks(
    out: Path | None, recording: Recording, setting: Setting, server: Server, force: bool
) -> list[Worker]:
    """A run folder, locked and described; made last, so that a start that fails leaves the disk alone.

    Raises: InputError where another process is writing a run there.
    """
    if out is None:
        return []
    prepare_folder(out, force)
    folder = RunFolder(out, setting.station.ids)
    copy(recording.station_file, out / "station.yaml")
    camera_file = keep_camera(recording.calibration, out / "camera.yaml")
    identity = identity_of(recording.source, recording.setup(camera_file)) | {"live": True, "loop": server.camera.loop}
    live = LiveRecord(Record(folder, identity, server.losses))
    return [Worker(out.name, lambda: live, queue=_ROWS, pictures=False)]


def _record_sinks(setting: Setting, record: list[Path], force: bool) -> list[Worker]:
    for path in record:
        if path.suffix not in FILE_KINDS:
            raise InputError(f"--record {path}: not one of {', '.join(FILE_KINDS)}")
        require_new(path, force)
    return [Worker(path.name, Numbered(path, setting).open, queue=_LONG, patient=True) for path in record]


def _host_and_port(option: str, text: str) -> tuple[str, int]:
    host, colon, port = text.rpartition(":")
    if not (colon and host and port.isdecimal() and 0 < int(port) < 65536):
        raise InputError(f"{option} {text}: wanted HOST:PORT")
    return host, int(port)
