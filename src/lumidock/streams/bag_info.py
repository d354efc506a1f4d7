"""Which topic of a bag has the calibration of some pictures: by the names of ROS, never another camera's."""

from __future__ import annotations

from collections.abc import Callable

from lumidock.errors import InputError
from lumidock.streams.camera_info import is_rectified
from lumidock.streams.ros import INFOS, Topic

_OPTION = "choose with --info-topic, or give --camera FILE"


def infos_for(
    pictures: str,
    topics: list[Topic],
    others: set[str],
    same_frame: Callable[[str], bool],
    wanted: str | None,
) -> str | None:
    """The topic with the calibration of the topic `pictures`; None where the bag has no calibration at all.

    `others` are topics of other cameras' pictures; `same_frame` tells whether a topic of calibrations names the frame
    of the pictures. Raises: InputError, one line, where there is no such topic, or no telling which one.
    """
    infos = sorted(topic.name for topic in topics if topic.type in INFOS)
    if wanted is not None:
        if wanted not in infos:
            raise InputError(f"--info-topic {wanted}: no calibration there; there are {', '.join(infos) or 'none'}")
        return wanted
    if not infos:
        return None
    shared = _shares_its_namespace(pictures, others)
    for name in _by_name(pictures):
        if name in infos and (not shared or name.startswith(pictures) or same_frame(name)):
            return name
    near = [name for name in infos if _may_belong(pictures, name, others)]
    if len(near) > 1:
        near = [name for name in near if same_frame(name)] or near
    if len(near) == 1:
        return near[0]
    if near:
        raise InputError(f"{pictures}: several calibrations could be its: {', '.join(near)}; {_OPTION}")
    framed = [name for name in infos if same_frame(name)]
    if len(framed) == 1:
        return framed[0]
    raise InputError(f"{pictures}: no calibration beside it, and {', '.join(infos)} may be another camera's; {_OPTION}")


def names_by_pictures(pictures: str) -> tuple[str, ...]:
    """Where the calibration of pictures may be, by their name alone: beside them only where they are an image topic."""
    names = tuple(_by_name(pictures))
    return (
        names if pictures.rpartition("/")[2].startswith("image") else tuple(n for n in names if n.startswith(pictures))
    )


def _by_name(pictures: str) -> list[str]:
    """The names that image_transport and the drivers use, the surest first."""
    space = _space(pictures)
    names = [f"{space}/camera_info", f"{pictures}/camera_info", f"{pictures}_info"]
    if is_rectified(pictures):
        names = [f"{space}/camera_info_rect", f"{pictures}/camera_info_rect", *names]
    return names


def _shares_its_namespace(pictures: str, others: set[str]) -> bool:
    """Whether pictures beside these may be another camera's, as left and right; to image_raw its namespace belongs."""
    beside = any(_space(other) == _space(pictures) for other in others)
    return beside and not pictures.rpartition("/")[2].startswith("image")


def _space(topic: str) -> str:
    return topic.rpartition("/")[0]


def _may_belong(pictures: str, info: str, others: set[str]) -> bool:
    """Whether a calibration lies in the pictures' namespace, or in one above that no other camera's pictures share."""
    space, place = _space(pictures), _space(info)
    if place == space and _shares_its_namespace(pictures, others):
        return False
    if space and info.startswith(f"{space}/"):
        deeper = (_space(other) for other in others if len(_space(other)) > len(space))
        return not any(info.startswith(f"{inner}/") for inner in deeper)
    if not f"{space}/".startswith(f"{place}/"):
        return False
    return not any(other.startswith(f"{place}/") for other in others)
