"""Sessions of zenoh that speak with one endpoint and nobody else, and topics of ROS 2 read by them.

Source: docs/design.md of ros2/rmw_zenoh.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from functools import partial

import zenoh

from lumidock.streams.clock import now_ns
from lumidock.streams.ros import Message

_RETRY_MS = 1000
_GREETING_S = 0.5  # that a session waits for its router, which takes some milliseconds where there is one
_LOOK_S = 0.02


def open_session(endpoint: str) -> zenoh.Session:
    """A session with `endpoint`, tcp/HOST:PORT, which need not be there yet. Raises: OSError for one that is none."""
    config, settings = (
        zenoh.Config(),
        {
            "mode": "peer",
            "connect/endpoints": [endpoint],
            "connect/timeout_ms": -1,  # again and again, in the background
            "connect/exit_on_failure": False,
            "connect/retry": {"period_init_ms": _RETRY_MS, "period_max_ms": _RETRY_MS},
            "listen/endpoints": [],
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
        },
    )
    try:
        for key, value in settings.items():
            config.insert_json5(key, json.dumps(value))
        return zenoh.open(config)
    except zenoh.ZError:
        raise OSError(f"{endpoint}: not an endpoint of zenoh, as tcp/127.0.0.1:7447 is one") from None


def wait_for_router(session: zenoh.Session) -> None:
    """Wait until the other side of a session answers, but not long."""
    end_s = time.monotonic() + _GREETING_S
    while not is_connected(session) and time.monotonic() < end_s:
        time.sleep(_LOOK_S)


def is_connected(session: zenoh.Session) -> bool:
    """Whether there is a router or a peer at the other side of a session."""
    info = session.info
    return bool(info.routers_zid() or info.peers_zid())


def nobody_at(endpoint: str) -> str:
    """What to say where nobody answers."""
    return f"no zenoh router or peer answers at {endpoint}; start one (ros2 run rmw_zenoh_cpp rmw_zenohd)"


class ZenohTopics:
    """Hands every message of some topics to `take`, in a thread of zenoh's."""

    def __init__(self, endpoint: str, domain: int, topics: tuple[str, ...], take: Callable[[Message], None]) -> None:
        """Listen to `topics` of a ROS domain. Raises: OSError for an endpoint that is none."""
        self._endpoint, self._session = endpoint, open_session(endpoint)
        # the type and its hash are the last two parts of a key
        self._subscribers = [
            self._session.declare_subscriber(f"{domain}{topic}/*/*", partial(_receive, topic, take)) for topic in topics
        ]

    @property
    def problem(self) -> str:
        """Why no messages come, where that is known."""
        return "" if is_connected(self._session) else nobody_at(self._endpoint)

    def close(self) -> None:
        """Part from the network."""
        self._session.close()


def _receive(topic: str, take: Callable[[Message], None], sample: zenoh.Sample) -> None:
    kind = str(sample.key_expr).split("/")[-2]  # geometry_msgs::msg::dds_::Pose_
    package, _, name = kind.partition("::msg::dds_::")
    if sample.kind == zenoh.SampleKind.PUT and name:
        take(Message(topic, f"{package}/msg/{name.rstrip('_')}", "cdr", now_ns(), sample.payload.to_bytes()))
