"""What a reproduction was asked for: how much, of which dock, with which settings and methods."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from lumidock.camera import Camera, load_camera
from lumidock.config import Config, PaperConfig
from lumidock.methods import implementation
from lumidock.reproduce.grid import Grid
from lumidock.station import Station, load_station

AS_PRINTED = "paper-as-printed"  # the paper's method in its preset `as_printed`; `paper` is as configured
TITLES = {AS_PRINTED: "paper, as printed", "paper": "paper, recommended", "lumidock": "lumidock"}


@dataclass(frozen=True, slots=True)
class Dock:
    """The files of a station and of a camera."""

    station: str
    camera: str

    def load(self) -> tuple[Station, Camera]:
        """Raises: InputError for a file that is refused."""
        return load_station(Path(self.station)), load_camera(Path(self.camera))


@dataclass(frozen=True, slots=True)
class Plan:
    """A reproduction: `extra` are methods beside the paper's two presets and lumidock's own."""

    grid: Grid
    dock: Dock
    out: Path
    config: Config = field(default_factory=Config)
    extra: tuple[str, ...] = ()

    @property
    def methods(self) -> tuple[str, ...]:
        """All that take part, in the order of the tables."""
        return (AS_PRINTED, "paper", "lumidock", *self.extra)

    @property
    def code(self) -> str:
        """Stands for the code of the methods that are not of this package."""
        return " ".join(implementation(name) for name in self.extra)


def resolved(name: str, config: Config) -> tuple[str, Config]:
    """The method behind a name of `Plan.methods`, and its configuration."""
    if name == AS_PRINTED:
        return "paper", config.model_copy(update={"paper": PaperConfig(preset="as_printed")})
    return name, config


def title(name: str) -> str:
    """A method as the heads of tables call it."""
    return TITLES.get(name, name)
