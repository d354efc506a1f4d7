"""The methods by their names: those of this package, and those that installed packages add by an entry point."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from lumidock.camera import Camera
from lumidock.config import Config
from lumidock.datatypes import AidingMeasurement, Detections, Fix, Frame
from lumidock.errors import InputError
from lumidock.localizer import Localizer
from lumidock.paper import PaperLocalizer
from lumidock.station import Station

METHODS = ("lumidock", "paper")
BASELINES = ("hungarian", "plain-pso", "p3p-vote", "p3p-neighbours", "ransac-p3p", "cpd", "learned")
GROUP = "lumidock.methods"  # of entry points: NAME = "package.module:factory", a factory as in `Factory`


@runtime_checkable
class Method(Protocol):
    """What every method offers: one fix for each frame, or for each frame's detections."""

    def process(self, frame: Frame) -> Fix:
        """Fix of one frame. Raises: FrameError for one that does not fit the calibration."""
        ...

    def process_detections(self, detections: Detections) -> Fix:
        """Fix of one frame's detections."""
        ...

    def forget(self) -> None:
        """Begin anew, without history."""
        ...


@runtime_checkable
class Aided(Protocol):
    """What a method offers too that makes use of the vehicle's own sensors."""

    def aid(self, measurement: AidingMeasurement) -> None:
        """One value of one sensor, before the frames that it helps."""
        ...


# (station, camera, config, *, cold) -> a method; a `cold` one forgets all history before each frame
Factory = Callable[..., Method]


def method_names() -> tuple[str, ...]:
    """All methods there are, those of installed packages last."""
    own = (*METHODS, *BASELINES)
    return (*own, *sorted({point.name for point in entry_points(group=GROUP)} - set(own)))


def require_method(name: str) -> None:
    """Raises: InputError for a method that there is not, or that two packages offer."""
    if name not in (*METHODS, *BASELINES):
        _entry_point(name)


def localizer_of(method: str, station: Station, camera: Camera, config: Config, *, cold: bool = False) -> Method:
    """A localizer by the name of its method; a `cold` one forgets all history before each frame.

    Raises: InputError for a method that there is not or that does not load, or a station that it cannot tell apart.
    """
    if method == "lumidock":
        return Localizer(station, camera, config, cold=cold)
    if method == "paper":
        return PaperLocalizer(station, camera, config.paper, cold=cold)
    if method in BASELINES:
        from lumidock.baselines import ASSOCIATIONS, BaselineLocalizer

        return BaselineLocalizer(ASSOCIATIONS[method], station, camera, config)
    localizer = _load(_entry_point(method))(station, camera, config, cold=cold)
    if not isinstance(localizer, Method):
        raise InputError(f"--method {method}: its localizer lacks process, process_detections or forget")
    return localizer


def implementation(method: str) -> str:
    """What stands for the code of a method of an installed package, so that results of two versions are not mixed.

    Empty for the methods of this package, whose own version says it.
    """
    if method in (*METHODS, *BASELINES):
        return ""
    point = _entry_point(method)
    digest = hashlib.sha256()
    for path in _source_of(point):
        digest.update(path.name.encode() + path.read_bytes())
    package = f"{point.dist.name} {point.dist.version}" if point.dist else point.value
    return f"{package} {digest.hexdigest()[:16]}"


def _source_of(point: EntryPoint) -> list[Path]:
    """The Python files of the top package, or of the module, that an entry point is in."""
    spec = find_spec(point.module.partition(".")[0])
    if spec is None:
        return []
    folders = [Path(folder) for folder in spec.submodule_search_locations or ()]
    alone = [Path(spec.origin)] if spec.origin and not folders else []
    return alone + sorted(path for folder in folders for path in folder.rglob("*.py"))


def _entry_point(name: str) -> EntryPoint:
    points = list(entry_points(group=GROUP, name=name))
    if not points:
        raise InputError(f"--method {name}: no such method; there are {', '.join(method_names())}")
    if len({point.value for point in points}) > 1:
        raise InputError(f"--method {name}: offered by {' and by '.join(sorted(p.value for p in points))}")
    return points[0]


def _load(point: EntryPoint) -> Factory:
    try:
        factory: Any = point.load()
    except (ImportError, AttributeError) as error:
        raise InputError(f"--method {point.name}: {point.value} does not load: {error}") from None
    if not callable(factory):
        raise InputError(f"--method {point.name}: {point.value} is no factory of localizers")
    return factory  # type: ignore[no-any-return]
