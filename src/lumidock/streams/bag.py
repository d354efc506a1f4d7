"""ROS bags as sources: which file, which topic, and the calibration that the bag brings along."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Literal

from lumidock.camera import Camera
from lumidock.datatypes import AidingMeasurement, Frame, Image, Unusable
from lumidock.errors import FrameError, InputError, extra
from lumidock.streams import mcapbag, rosbag1, sqlitebag
from lumidock.streams.bag_info import infos_for
from lumidock.streams.camera_info import camera_of, difference, is_rectified
from lumidock.streams.clock import SIM_TIME_BELOW_NS
from lumidock.streams.ros import PICTURES, Broken, Content, Message, Topic, content_of, info_of, picture_of, size_of
from lumidock.streams.ros_sensors import SENSORS, values_of
from lumidock.streams.source import Item, Reading, Size, Source, in_natural_order

_FORMATS = {".mcap": mcapbag, ".db3": sqlitebag, ".bag": rosbag1, ".active": rosbag1}
_SUFFIXES = (".mcap", ".db3", ".bag", ".bag.active")
_NOT_PICTURES = ("/compressedDepth", "/theora")
_TRANSPORTS = re.compile(r"/(?:compressed|ffmpeg|h264|h265|video|foxglove|zstd)$")
_ENOUGH_INFOS = 5  # messages looked at for one that is calibrated
_ENOUGH_STAMPS = 5  # first messages that tell the clock of a topic
_AFTER_STAMP = 12  # bytes of a CameraInfo from where on it is the same in each message: after the stamp in its header
_FAR_OFF_NS = 60_000_000_000  # of a header's stamp from the time of recording, for one that is worth a word
# what stamps frames: the time of recording or that in headers, where 0 stands for none unless a simulation began then
_Clock = Literal["header", "simulation", "log"]
_PART = re.compile(r"(.*?)_?([0-9]+)$")
_ROSBAG1_DATE = re.compile(r"[0-9]{4}(?:-[0-9]{2}){5}")


def parts_of(path: Path) -> list[Path]:
    """The files of a bag: itself, or those of the folder that a recorder split it into; metadata.yaml is not needed.

    Raises: InputError for a folder of several bags.
    """
    if path.is_file():
        return [path]
    for suffix in _SUFFIXES:
        parts = [
            file for file in path.iterdir() if file.name.lower().endswith(suffix) and not file.name.startswith(".")
        ]
        if parts:
            _require_one_bag(path, parts)
            return sorted(parts, key=in_natural_order)
    raise InputError(f"{path}: no {', '.join(_SUFFIXES)} in it")


def _require_one_bag(path: Path, parts: list[Path]) -> None:
    """Raises: InputError where files are not the parts of one bag, which are numbered by the end of their name."""
    if len(parts) == 1 or (path / "metadata.yaml").exists():
        return
    numbered = [_PART.fullmatch(file.name.partition(".")[0]) for file in parts]
    stems = {_ROSBAG1_DATE.sub("", found[1]) for found in numbered if found}
    numbers = {found[2] for found in numbered if found}
    if not all(numbered) or len(stems) > 1 or len(numbers) < len(parts):
        names = ", ".join(sorted(file.name for file in parts)[:5])
        raise InputError(f"{path}: several bags, not the parts of one; give one of {names}")


def topics_of(path: Path) -> list[Topic]:
    """Topics of a bag by name, counted over its parts. Raises: InputError when it is none."""
    found: dict[tuple[str, str], int | None] = {}
    for part in parts_of(path):
        for topic in _FORMATS[part.suffix.lower()].topics(part):
            key = topic.name, topic.type
            before = found.get(key, 0)
            found[key] = None if before is None or topic.count is None else before + topic.count
    return [Topic(*key, count) for key, count in sorted(found.items())]


def messages_of(path: Path, *topics: str) -> Iterator[Message | Broken]:
    """All messages of some topics over the parts of a bag."""
    for part in parts_of(path):
        yield from _FORMATS[part.suffix.lower()].messages(part, topics)


def open_bag(path: Path, reading: Reading) -> Source:
    """Open a bag of ROS 1 or ROS 2; `topic` need only be given where several carry pictures.

    Raises: InputError, one line, when there is no such topic, or no telling which one.
    """
    topics = topics_of(path)
    chosen = _choose(path, topics, reading.topic)
    first = _first_pictures(path, chosen.name)
    clock, notes = _clock(chosen.name, first)
    found = _calibration(path, topics, chosen.name, first, reading)
    if reading.fps is not None:
        notes = (*notes, f"--fps {reading.fps:g} is not used: the messages have stamps")
    bag = _Bag(path, chosen.name, clock, found)
    return Source(
        path,
        "bag",
        lambda size: _items(bag, reading, size),
        chosen.count,
        inputs=tuple(parts_of(path)),
        calibration=found.camera,
        no_calibration=found.problem,
        rectified=found.rectified,
        notes=(*notes, *found.notes),
        sensors=lambda: _sensor_values(path, topics, clock),
    )


def _sensor_values(path: Path, topics: list[Topic], clock: _Clock) -> Iterator[AidingMeasurement]:
    """Values of the vehicle's sensors, by the clock of the pictures; what is damaged is left out."""
    names = [topic.name for topic in topics if topic.type in SENSORS]
    for message in messages_of(path, *names) if names else ():
        if isinstance(message, Message):
            yield from values_of(message, by_log=clock == "log")


def picture_topics(topics: list[Topic]) -> list[Topic]:
    """Those that carry pictures; of several forms of the same pictures the one that lost least."""
    best: dict[str, Topic] = {}
    for topic in topics:
        if topic.type in PICTURES and not topic.name.endswith(_NOT_PICTURES):
            base = base_of(topic.name)
            known = best.get(base)
            if known is None or PICTURES.index(topic.type) < PICTURES.index(known.type):
                best[base] = topic
    return [topic for topic in topics if topic in best.values()]


def base_of(topic: str) -> str:
    """The topic of the pictures that a transport carries: /cam/image_raw of /cam/image_raw/compressed."""
    return _TRANSPORTS.sub("", topic)


def _choose(path: Path, topics: list[Topic], wanted: str | None) -> Topic:
    pictures = picture_topics(topics)
    if wanted is not None:
        for topic in topics:
            if topic.name == wanted and topic.type in PICTURES:
                return topic
        other = next((f"a {topic.type}; " for topic in topics if topic.name == wanted), "")
        raise InputError(f"{path}: --topic {wanted}: no pictures there; {other}there are {_names(pictures)}")
    if len(pictures) != 1:
        what = "several topics with pictures; choose with --topic" if pictures else "no topic with pictures"
        listed = _names(pictures) if pictures else ", ".join(f"{_names([t])} ({t.type})" for t in topics[:20]) or "none"
        raise InputError(f"{path}: {what}; there are {listed}")
    return pictures[0]


def _names(topics: list[Topic]) -> str:
    return ", ".join(" ".join(t.name.split()) for t in topics) or "none"


def _first_pictures(path: Path, topic: str) -> list[tuple[Message, Content]]:
    """The first messages of a topic whose content can be read."""
    found = list[tuple[Message, Content]]()
    for message in islice(messages_of(path, topic), _ENOUGH_STAMPS):
        if isinstance(message, Message):
            try:
                found.append((message, content_of(message)))
            except FrameError:
                continue
    return found


def _clock(topic: str, first: list[tuple[Message, Content]]) -> tuple[_Clock, tuple[str, ...]]:
    """The clock of a topic, and what is to be said of it."""
    if not first:
        return "header", ()
    stamped = [(message, content) for message, content in first if content.stamp_ns]
    if not stamped:
        return "log", (f"{topic}: headers have no stamps; the times of recording are used",)
    message, content = stamped[0]
    if 0 <= content.stamp_ns < SIM_TIME_BELOW_NS:
        said = f"{topic}: stamps are those of a simulation, which began {content.stamp_ns * 1e-9:.1f} s before"
        return "simulation", (said,) if message.log_ns >= SIM_TIME_BELOW_NS else ()
    off_ns = content.stamp_ns - message.log_ns
    if abs(off_ns) > _FAR_OFF_NS and message.log_ns >= SIM_TIME_BELOW_NS:
        return "header", (
            f"{topic}: the camera's clock is {off_ns * 1e-9:+.0f} s off the recorder's; its stamps are used",
        )
    return "header", ()


@dataclass(frozen=True, slots=True)
class _Calibration:
    """The camera that a bag describes, by which topic, or why there is none."""

    camera: Camera | None = None
    topic: str = ""
    rectified: bool = False
    problem: str = ""
    notes: tuple[str, ...] = ()


def _calibration(
    path: Path, topics: list[Topic], topic: str, first: list[tuple[Message, Content]], reading: Reading
) -> _Calibration:
    """Camera of the CameraInfo that belongs to the pictures; none is another camera's."""
    try:
        frame_id = first[0][1].frame_id if first else ""
        others = {base_of(other.name) for other in picture_topics(topics)} - {base_of(topic)}
        name = infos_for(base_of(topic), topics, others, _frame_ids(path, frame_id), reading.info_topic)
        if name is None:
            return _Calibration()
        rectified = is_rectified(base_of(topic))
        camera, notes = _first_calibrated(path, name, rectified=rectified, trusted=reading.trusted)
        if camera is None:
            return _Calibration(problem=f"{name}: the camera is not calibrated; give --camera FILE")
        _require_fit(name, camera, topic, first, reading)
    except InputError as error:
        return _Calibration(problem=f"{path}: {error}")
    return _Calibration(camera, name, rectified, notes=notes)


def _frame_ids(path: Path, frame_id: str) -> Callable[[str], bool]:
    """Whether a topic of calibrations names the frame of the pictures."""

    def same(topic: str) -> bool:
        if not frame_id:
            return False
        message = next((m for m in islice(messages_of(path, topic), 1) if isinstance(m, Message)), None)
        return message is not None and info_of(message).frame_id == frame_id

    return same


def _first_calibrated(
    path: Path, topic: str, *, rectified: bool, trusted: bool
) -> tuple[Camera | None, tuple[str, ...]]:
    """The camera of the first message that is calibrated, if any of the first is. Raises: InputError if absurd."""
    problem = None
    for message in islice(messages_of(path, topic), _ENOUGH_INFOS):
        if isinstance(message, Message):
            try:
                info = info_of(message)
            except InputError as error:
                problem = error
                continue
            if info.calibrated:
                return camera_of(info, rectified=rectified, trusted=trusted)
    if problem is not None:
        raise problem
    return None, ()


def _require_fit(name: str, camera: Camera, topic: str, first: list[tuple[Message, Content]], reading: Reading) -> None:
    """Raises: InputError where the first picture is of another size than the calibration says."""
    for _, content in first:
        try:
            size = size_of(content, topic, as_stored=reading.as_stored)
        except FrameError:
            continue
        if size is not None and size != (camera.width, camera.height):
            raise InputError(
                f"{name}: the calibration is for pictures of {camera.width}x{camera.height} pixels, those of {topic} "
                f"have {size[0]}x{size[1]}; give --camera FILE"
            )
        return


@dataclass(frozen=True, slots=True)
class _Bag:
    path: Path
    topic: str
    clock: _Clock
    calibration: _Calibration


def _items(bag: _Bag, reading: Reading, size: Size | None) -> Iterator[Item]:
    """Frames in the order of the bag; where its calibration changes, and is in use, they end with an InputError."""
    watched = bag.calibration.topic if reading.follow_calibration and bag.calibration.camera is not None else ""
    pictures, watch = _Pictures(bag, reading, size), _Watch(bag)
    held: list[Item] = []  # one picture waits for a calibration of the same time that may come after it
    for message in messages_of(bag.path, *filter(None, (bag.topic, watched))):
        if isinstance(message, Message) and message.topic == watched:
            watch.look(message)
            continue
        yield from held
        held = list(pictures.add(message))
        if not watched:
            yield from held
            held = []
    yield from held
    yield from pictures.rest()


class _Watch:
    """Holds each calibration of a bag against the first; what is the same byte by byte is not decoded."""

    def __init__(self, bag: _Bag) -> None:
        self._bag, self._same = bag, set[bytes]()

    def look(self, message: Message) -> None:
        """Raises: InputError, one line, where the calibration is another one."""
        content = message.data[_AFTER_STAMP:] if message.encoding != "protobuf" else message.data
        known = self._bag.calibration
        if content in self._same or known.camera is None:
            return
        try:
            info = info_of(message)
        except InputError:  # a damaged message says nothing
            return
        if info.calibrated:
            camera, _ = camera_of(info, rectified=known.rectified, trusted=True)
            what = difference(known.camera, camera)
            if what:
                raise InputError(
                    f"{self._bag.path}: the calibration on {known.topic} changes {message.log_ns} ns into the epoch: "
                    f"{what}; the run ends there. Give --camera FILE for all of it, or cut the recording there"
                )
        if len(self._same) < _ENOUGH_INFOS:
            self._same.add(content)


class _Pictures:
    """Makes items of messages, numbered as they come; video goes through one decoder."""

    def __init__(self, bag: _Bag, reading: Reading, size: Size | None) -> None:
        self._bag, self._reading, self._size = bag, reading, size
        self._number = 0
        self._decoder: Any = None  # made when the first frame of video comes: PyAV is an extra
        self._codec = ""
        self._stamps = dict[int, int | None]()

    def add(self, message: Message | Broken) -> Iterator[Item]:
        """The items that are done with this message: its own, or those that a decoder held back."""
        number, name = self._number, f"{self._number:06d}"
        self._number += 1
        if isinstance(message, Broken):
            yield Unusable(name, None, "bad_frame", message.text)
            return
        try:
            content = content_of(message)
        except FrameError as error:
            yield Unusable(name, message.log_ns, error.reason, str(error))
            return
        t_ns: int | None = message.log_ns if self._bag.clock == "log" else content.stamp_ns
        if t_ns == 0 and self._bag.clock == "header":
            t_ns = None
        if content.kind == "video":
            yield from self._video(number, t_ns, content)
        elif t_ns is None:
            yield self._without_stamp(name)
        else:
            yield self._still(name, t_ns, content)

    def _still(self, name: str, t_ns: int, content: Content) -> Item:
        try:
            image, encoding = picture_of(content, self._bag.topic, self._reading, self._size)
            return Frame(name, t_ns, image, encoding=encoding)
        except FrameError as error:
            return Unusable(name, t_ns, error.reason, str(error))

    def _video(self, number: int, t_ns: int | None, content: Content) -> Iterator[Item]:
        if self._decoder is None or content.form != self._codec:
            yield from self.rest()
            with extra("video"):
                from lumidock.streams.packets import Packets
            self._decoder, self._codec = Packets(content.form, self._reading.gray, self._size), content.form
        self._stamps[number] = t_ns
        for done, picture in self._decoder.feed(number, content.data.tobytes()):
            yield self._decoded(done, picture)

    def rest(self) -> Iterator[Item]:
        """What a decoder still holds."""
        if self._decoder is not None:
            for done, picture in self._decoder.flush():
                yield self._decoded(done, picture)
            self._decoder = None

    def _decoded(self, number: int, picture: Image | str) -> Item:
        name, t_ns = f"{number:06d}", self._stamps.pop(number, None)
        if isinstance(picture, str):
            return Unusable(name, t_ns, "bad_frame", f"{self._bag.topic}: frame {name}: {picture}")
        return self._without_stamp(name) if t_ns is None else Frame(name, t_ns, picture)

    def _without_stamp(self, name: str) -> Unusable:
        return Unusable(
            name, None, "bad_stamp", f"{self._bag.topic}: frame {name}: its header has no stamp, as others have"
        )
