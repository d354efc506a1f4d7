"""ROS bags as sources: which file, which topic, and the calibration that the bag brings along."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path

from lumidock.camera import Camera
from lumidock.datatypes import Frame, Unusable
from lumidock.errors import FrameError, InputError
from lumidock.streams import mcapbag, rosbag1, sqlitebag
from lumidock.streams.ros import CAMERA_INFO, COMPRESSED, IMAGE, Broken, Message, Topic, camera_of, picture_of
from lumidock.streams.sources import BAG_SUFFIXES, Item, Source, in_natural_order

_FORMATS = {".mcap": mcapbag, ".db3": sqlitebag, ".bag": rosbag1}
_NOT_PICTURES = ("/compressedDepth", "/theora")
_ENOUGH_INFOS = 5  # messages looked at for one that is calibrated


def parts_of(path: Path) -> list[Path]:
    """The files of a bag: itself, or those of the folder that a recorder split it into; metadata.yaml is not needed."""
    if path.is_file():
        return [path]
    for suffix in BAG_SUFFIXES:
        parts = sorted(path.glob(f"*{suffix}"), key=in_natural_order)
        if parts:
            return parts
    raise InputError(f"{path}: no {', '.join(BAG_SUFFIXES)} in it")


def topics_of(path: Path) -> list[Topic]:
    """Topics of a bag by name, counted over its parts. Raises: InputError when it is none."""
    found: dict[tuple[str, str], int | None] = {}
    for part in parts_of(path):
        for topic in _FORMATS[part.suffix.lower()].topics(part):
            key = topic.name, topic.type
            before = found.get(key, 0)
            found[key] = None if before is None or topic.count is None else before + topic.count
    return [Topic(*key, count) for key, count in sorted(found.items())]


def messages_of(path: Path, topic: str) -> Iterator[Message | Broken]:
    """All messages of one topic over the parts of a bag."""
    for part in parts_of(path):
        yield from _FORMATS[part.suffix.lower()].messages(part, (topic,))


def open_bag(path: Path, topic: str | None, bits: int) -> Source:
    """Open a bag of ROS 1 or ROS 2; `topic` need only be given where several carry pictures.

    Raises: InputError, one line, when there is no such topic, or no telling which one.
    """
    topics = topics_of(path)
    chosen = _choose(path, topics, topic)
    return Source(
        path,
        "bag",
        lambda: _items(path, chosen.name, bits),
        chosen.count,
        inputs=tuple(parts_of(path)),
        calibration=_calibration(path, topics, chosen.name),
    )


def picture_topics(topics: list[Topic]) -> list[Topic]:
    """Those that carry pictures; a compressed copy of a raw topic is left out."""
    found = [t for t in topics if t.type in (IMAGE, COMPRESSED) and not t.name.endswith(_NOT_PICTURES)]
    raw = {t.name for t in found if t.type == IMAGE}
    return [t for t in found if not (t.type == COMPRESSED and t.name.removesuffix("/compressed") in raw)]


def _choose(path: Path, topics: list[Topic], wanted: str | None) -> Topic:
    if wanted is not None:
        chosen = [t for t in topics if t.name == wanted and t.type in (IMAGE, COMPRESSED)]
        if not chosen:
            raise InputError(f"{path}: --topic {wanted}: no pictures there; there are {_names(picture_topics(topics))}")
        return chosen[0]
    pictures = picture_topics(topics)
    if len(pictures) != 1:
        what = "several topics with pictures; choose with --topic" if pictures else "no topic with pictures"
        raise InputError(f"{path}: {what}; there are {_names(pictures or topics)}")
    return pictures[0]


def _names(topics: list[Topic]) -> str:
    return ", ".join(" ".join(t.name.split()) for t in topics) or "none"


def _calibration(path: Path, topics: list[Topic], topic: str) -> Camera | None:
    """Camera of the CameraInfo beside the pictures, or of the only one in the bag; None when none is calibrated."""
    infos = [t.name for t in topics if t.type == CAMERA_INFO]
    beside = topic.removesuffix("/compressed").rpartition("/")[0] + "/camera_info"
    name = beside if beside in infos else infos[0] if len(infos) == 1 else None
    if name is None:
        return None
    problem = None
    for message in islice(messages_of(path, name), _ENOUGH_INFOS):
        if isinstance(message, Message):
            try:
                return camera_of(message)
            except InputError as error:
                problem = error
    if problem is not None and "not calibrated" not in str(problem):
        raise problem
    return None


def _items(path: Path, topic: str, bits: int) -> Iterator[Item]:
    for number, message in enumerate(messages_of(path, topic)):
        name = f"{number:06d}"
        if isinstance(message, Broken):
            yield Unusable(name, None, "bad_frame", message.text)
            continue
        try:
            t_ns, image, encoding = picture_of(message, bits=bits)
            yield Frame(name, t_ns, image, encoding=encoding)
        except FrameError as error:
            yield Unusable(name, message.log_ns, error.reason, str(error))
