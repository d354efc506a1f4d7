"""What the commands share: the typer application, their common options, and how they open and write files."""

from __future__ import annotations

import shutil
import signal
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from types import FrameType
from typing import Annotated

import typer

from lumidock.camera import Camera, load_camera, save_camera
from lumidock.cli.progress import progress_bar
from lumidock.errors import InputError
from lumidock.station import load_station
from lumidock.streams.live import open_live
from lumidock.streams.source import Network, Reading, Source, delayed
from lumidock.streams.sources import open_source
from lumidock.yamlfile import kind_of_file

app = typer.Typer(pretty_exceptions_enable=False, rich_markup_mode=None)

_MAX_SEED = 10**9
_MAX_DELAY_MS = 10_000.0  # no camera on a vehicle is later
SIM = "sim:"
DEFAULT_STATION, DEFAULT_CAMERA = "cage-2x2x5", "imx264-60deg"
_SIMULATED = (
    "frames",
    "video.mp4",
    "detections.csv",
    "timestamps.csv",
    "lights_truth.csv",
    "spurious_truth.csv",
    "stream_truth.csv",
    "truth.tum",
)

FIRST_RUN = "the first run of an installation compiles the numerical kernels before its first frame, one to two minutes"
SCENARIOS = ", ".join(sorted(Path(entry.name).stem for entry in (files("lumidock") / "sim" / "scenarios").iterdir()))

Out = Annotated[
    Path, typer.Option("--out", metavar="DIR", help="Folder to write; refused when it exists, unless --force.")
]
Force = Annotated[bool, typer.Option("--force", help="Write into an existing folder, replacing earlier results.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print machine-readable JSON.")]
StationOption = Annotated[
    str | None, typer.Option("--station", metavar="FILE", help="Station file, or the name of a shipped one.")
]
CameraOption = Annotated[
    str | None,
    typer.Option("--camera", metavar="FILE", help="Calibration file of any kind, or the name of a shipped one."),
]
VehicleOption = Annotated[
    Path | None, typer.Option("--vehicle", metavar="FILE", help="Vehicle file: frame names and the camera's mounting.")
]
Topic = Annotated[str | None, typer.Option("--topic", metavar="NAME", help="The pictures of a bag that has several.")]
SourcesArgument = Annotated[
    list[str],
    typer.Argument(
        metavar="SOURCE...",
        help="Sequence or image folder, video, bag, sim:SCENARIO[:SEED], or a camera's address; several recordings.",
    ),
]
Cluster = Annotated[
    str | None,
    typer.Option("--cluster", metavar="ADDRESS", help="Run on the dask cluster there: tcp://HOST:PORT."),
]
Method = Annotated[
    str, typer.Option("--method", metavar="NAME", help="lumidock, paper, a baseline, or one of an installed package.")
]
ConfigOption = Annotated[
    Path | None, typer.Option("--config", metavar="FILE", help="YAML file of settings that differ from the defaults.")
]
Bits = Annotated[
    int,
    typer.Option(
        "--bits", metavar="N", min=8, max=16, help="How many bits of 16-bit pixels count: 12 of a 12-bit camera."
    ),
]
InfoTopic = Annotated[
    str | None, typer.Option("--info-topic", metavar="NAME", help="The CameraInfo of a bag where several could be it.")
]
AsStored = Annotated[
    bool, typer.Option("--as-stored", help="Do not turn pictures that EXIF or a video's header says to turn.")
]
Trusted = Annotated[bool, typer.Option("--trust-calibration", help="Accept a calibration that looks like no camera's.")]
DelayMs = Annotated[
    float,
    typer.Option("--delay-ms", metavar="MS", help="What passes between exposure and stamp; taken off every stamp."),
]
CameraName = Annotated[
    str | None,
    typer.Option("--name", "--camera-name", metavar="NAME", help="Which camera of a calibration file of several."),
]
Fps = Annotated[
    float | None,
    typer.Option(
        "--fps", metavar="F", help="Frames per second, for sources without stamps; replaces a video's own times."
    ),
]
Workers = Annotated[int | None, typer.Option("--workers", metavar="N", min=1, help="Processes; by default one a core.")]
Seed = Annotated[int, typer.Option("--seed", metavar="N", min=0, help="Everything random follows from it.")]


def seeds_of(text: str) -> tuple[int, int]:
    """The two ends of A:B. Raises: InputError when they hold no seed."""
    first, _, stop = text.partition(":")
    if not (first.isdecimal() and stop.isdecimal() and int(first) < int(stop) <= _MAX_SEED):
        raise InputError(f"--seeds {text}: wanted A:B, whole numbers, A below B")
    return int(first), int(stop)


def tell_what_compiles() -> None:
    """Say in one line that this run compiles first, or anew, or not at all, and what to do about it."""
    from lumidock.app.warm import compiled_code

    state = compiled_code()
    if state.mark == "bad":
        print(f"warning: {state.text}", file=sys.stderr)
    elif state.first:
        print(f"{FIRST_RUN}; `lumidock warm` does it ahead", file=sys.stderr)


def file_of(kind: str, given: str | None, beside: Path | None, source: Source) -> Path:
    """The station or camera file: the option, or the one beside the frames."""
    if given is not None:
        return file_given(kind, given)
    if beside is None:
        raise InputError(f"{source.path}: no {kind}.yaml beside the frames; give --{kind} FILE")
    _require_kind(kind, beside)
    return beside


def file_given(kind: str, name: str) -> Path:
    """The file that was given for a station, a camera or a vehicle. Raises: InputError when it plainly is another."""
    path = shipped_or_path(kind, name)
    _require_kind(kind, path)
    return path


def _require_kind(kind: str, path: Path) -> None:
    found = kind_of_file(path)
    if found not in ("", kind) and (found, kind) != ("Kalibr camchain", "camera"):
        raise InputError(f"{path}: a {found} file, given as the {kind}; it belongs to --{found}")


def shipped_or_path(kind: str, name: str) -> Path:
    """A file, or what the package ships under that name."""
    shipped = Path(str(files("lumidock"))) / f"{kind}s" / f"{name}.yaml"
    path = shipped if "/" not in name and shipped.exists() else Path(name)
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: not a file")  # a pipe can be read only once, and a run reads the file three times
    return path


def copy(source: Path, target: Path) -> None:
    """Copy a file, unless both are the same."""
    if source.resolve() != target.resolve():
        target.unlink(missing_ok=True)  # a link, not what it points to
        shutil.copyfile(source, target)


def require_new(file: Path, force: bool) -> None:
    """Raises: InputError for a file that exists, unless `force`."""
    if file.exists() and not force:
        raise InputError(f"{file}: exists; give --force to replace it")


def require_folder(folder: Path, force: bool) -> None:
    """Raises: InputError for a file, and for a folder that exists, unless `force`."""
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file")
    if folder.exists() and not force:
        raise InputError(f"{folder}: exists; give --force to write into it")


def prepare_folder(folder: Path, force: bool) -> None:
    """Make an output folder; an existing one only with `force`."""
    require_folder(folder, force)
    folder.mkdir(parents=True, exist_ok=True)


def prepare_sequence(folder: Path, force: bool) -> None:
    """Make a folder for a simulated sequence, or clear one; a folder of frames that were not simulated is refused."""
    truth = folder / "truth.csv"
    found = [name for name in (*_SIMULATED, "camera.yaml", "station.yaml") if (folder / name).exists()]
    if force and found and not truth.exists():
        raise InputError(f"{folder}: has {found[0]} but no truth.csv, so it was not simulated; write elsewhere")
    prepare_folder(folder, force)
    for name in _SIMULATED:
        stale = folder / name
        if stale.is_dir() and not stale.is_symlink():
            shutil.rmtree(stale)
        else:
            stale.unlink(missing_ok=True)
    truth.write_bytes(b"")  # marks the folder as simulated, also when the simulation is cut short


def open_any(
    source: str,
    reading: Reading,
    *,
    delay_ms: float = 0.0,
    station: str | None = None,
    network: Network | None = None,
) -> Source:
    """A recording by its path or a camera by its address; no colour is read for a `station` of white lights alone."""
    if not -_MAX_DELAY_MS <= delay_ms <= _MAX_DELAY_MS:
        raise InputError(f"--delay-ms {delay_ms:g}: wanted a time within {_MAX_DELAY_MS:g} ms")
    gray = station is not None and set(load_station(file_given("station", station)).color) == {"white"}
    reading = replace(reading, gray=gray)
    live = open_live(source, gray=gray, reading=reading, network=network)
    return delayed(live or open_source(Path(source), reading), delay_ms)


@dataclass(frozen=True, slots=True)
class Calibration:
    """A camera, the ROS camera_info file that it is from, if it is from one, and what is odd about it."""

    camera: Camera
    file: Path | None
    warnings: tuple[str, ...]


def calibration_of(given: str | None, source: Source, *, name: str | None = None, trusted: bool = False) -> Calibration:
    """The camera by the option, beside the frames, or within the source, checked as `calib check` does.

    Raises: InputError where there is none, or one that no camera has, unless it is `trusted`.
    """
    from lumidock.setup.calibration_files import read_with_dialect
    from lumidock.streams.calibration_check import check, require_possible

    if given is None and source.camera is None:
        if source.calibration is not None:
            return Calibration(source.calibration, None, check(source.calibration, rectified=source.rectified).warnings)
        if source.no_calibration:
            raise InputError(source.no_calibration)
    path = file_of("camera", given, source.camera, source)
    dialect, lens = read_with_dialect(path, name=name)
    require_possible(lens, str(path), trusted=trusted)
    # what the simulator wrote beside its frames needs no comment
    simulated_one = given is None and (path.parent / "truth.csv").exists()
    return Calibration(lens, path if dialect == "ros" else None, () if simulated_one else check(lens).warnings)


def keep_camera(calibration: Calibration, target: Path) -> Path:
    """Write the camera of a run into it; returns the file that identifies it, `target` where it was in none."""
    if calibration.file is not None:
        copy(calibration.file, target)
        return calibration.file
    target.unlink(missing_ok=True)  # a link, not what it points to
    save_camera(calibration.camera, target)
    return target


def tell(lines: Iterable[str]) -> None:
    """Print what a person should know, a line each, to standard error."""
    for line in lines:
        print(f"lumidock: warning: {' '.join(line.split())}", file=sys.stderr)


def simulated(source: str, folder: Path, station: str | None, camera: str | None) -> Path:
    """The sequence folder that `sim:SCENARIO[:SEED]` stands for, simulated into `folder`. Raises: InputError."""
    from lumidock.sim.scenario import load_scenario, station_of
    from lumidock.sim.sequence import write_rendered

    name, colon, seed = source.removeprefix(SIM).rpartition(":")
    name, seed = (name, seed) if colon and seed.isdecimal() else (source.removeprefix(SIM), "0")
    scenario = load_scenario(name, ())
    station_file = shipped_or_path("station", station) if station else station_of(scenario)
    dock, lens = load_station(station_file), load_camera(shipped_or_path("camera", camera or DEFAULT_CAMERA))
    prepare_sequence(folder, True)
    copy(station_file, folder / "station.yaml")
    with progress_bar("sim") as progress:
        write_rendered(scenario, dock, lens, int(seed), folder, progress=progress)
    return folder


@contextmanager
def interrupts_held() -> Iterator[Callable[[], None]]:
    """Delay Ctrl-C until the callback that this yields is called, since compiled code cannot be interrupted safely.

    A second Ctrl-C is not delayed.
    """
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
def told_at_interrupt(left: str) -> Iterator[None]:
    """Say at Ctrl-C what is `left` where, in one line on standard error."""
    try:
        yield
    except KeyboardInterrupt:
        print(f"lumidock: interrupted; {left}", file=sys.stderr)
        raise


def example(*lines: str) -> str:
    """The examples at the end of a command's help."""
    return "\n\n".join(["Examples:", *lines])
