"""What the commands share: the typer application, their common options, and how they open and write files."""

from __future__ import annotations

import shutil
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.resources import files
from pathlib import Path
from types import FrameType
from typing import Annotated

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
from lumidock.errors import InputError
from lumidock.station import load_station
from lumidock.streams.live import open_live
from lumidock.streams.sources import Source, open_source

app = typer.Typer(pretty_exceptions_enable=False, rich_markup_mode=None)

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
)

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
    str | None, typer.Option("--camera", metavar="FILE", help="camera_info file, or the name of a shipped one.")
]
VehicleOption = Annotated[
    Path | None, typer.Option("--vehicle", metavar="FILE", help="Vehicle file: frame names and the camera's mounting.")
]
Topic = Annotated[str | None, typer.Option("--topic", metavar="NAME", help="The pictures of a bag that has several.")]
SourceArgument = Annotated[
    str,
    typer.Argument(
        metavar="SOURCE", help="Sequence or image folder, video, bag, sim:SCENARIO[:SEED], or a camera's address."
    ),
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
Fps = Annotated[
    float | None, typer.Option("--fps", metavar="F", help="Frames per second, for sources without time stamps.")
]
Workers = Annotated[int | None, typer.Option("--workers", metavar="N", min=1, help="Processes; by default one a core.")]
Seed = Annotated[int, typer.Option("--seed", metavar="N", min=0, help="Everything random follows from it.")]


def file_of(kind: str, given: str | None, beside: Path | None, source: Source) -> Path:
    """The station or camera file: the option, or the one beside the frames."""
    if given is not None:
        return shipped_or_path(kind, given)
    if beside is None:
        raise InputError(f"{source.path}: no {kind}.yaml beside the frames; give --{kind} FILE")
    return beside


def shipped_or_path(kind: str, name: str) -> Path:
    """A file, or what the package ships under that name."""
    shipped = Path(str(files("lumidock"))) / f"{kind}s" / f"{name}.yaml"
    path = shipped if "/" not in name and shipped.exists() else Path(name)
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: not a file")  # a pipe could be read once only, and a run reads it thrice
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
    """Make a folder for a simulated sequence, or clear one; frames that were not simulated are left alone."""
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
    source: str, fps: float | None, *, topic: str | None = None, bits: int = 16, station: str | None = None
) -> Source:
    """A recording by its path or a camera by its address; no colour is read for a `station` of white lights alone."""
    gray = station is not None and set(load_station(shipped_or_path("station", station)).color) == {"white"}
    return open_live(source, gray=gray) or open_source(Path(source), fps, topic=topic, bits=bits, gray=gray)


def calibration_of(given: str | None, source: Source) -> Camera:
    """The camera by the option, beside the frames, or within the source. Raises: InputError where there is none."""
    if given is None and source.camera is None and source.calibration is not None:
        return source.calibration
    return load_camera(file_of("camera", given, source.camera, source))


def simulated(source: str, folder: Path, station: str | None, camera: str | None) -> Path:
    """The sequence folder that `sim:SCENARIO[:SEED]` stands for, simulated into `folder`. Raises: InputError."""
    from lumidock.sim.scenario import load_scenario
    from lumidock.sim.sequence import write_rendered

    name, colon, seed = source.removeprefix(SIM).rpartition(":")
    name, seed = (name, seed) if colon and seed.isdecimal() else (source.removeprefix(SIM), "0")
    scenario = load_scenario(name, ())
    station_file = shipped_or_path("station", station or DEFAULT_STATION)
    dock, lens = load_station(station_file), load_camera(shipped_or_path("camera", camera or DEFAULT_CAMERA))
    prepare_sequence(folder, True)
    copy(station_file, folder / "station.yaml")
    with progress_bar("sim") as progress:
        write_rendered(scenario, dock, lens, int(seed), folder, progress=progress)
    return folder


@contextmanager
def interrupts_held() -> Iterator[Callable[[], None]]:
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
def progress_bar(title: str) -> Iterator[Callable[[int, int | None], None]]:
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


def example(*lines: str) -> str:
    """The end of a command's help: commands to type."""
    return "\n\n".join(["Examples:", *lines])
