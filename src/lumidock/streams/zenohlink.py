"""Fixes to ROS 2 over zenoh, in the way of rmw_zenoh, without ROS. Source: docs/design.md of ros2/rmw_zenoh."""

from __future__ import annotations

import math
import time

import zenoh
from zenoh.ext import Int64, z_serialize

from lumidock.datatypes import Detections, Fix, Frame, Unusable
from lumidock.streams import ros2, rostypes
from lumidock.streams.zenohsession import is_connected, nobody_at, open_session, wait_for_router

_NODE, _LOOK_S = "lumidock", 0.5
_QOS = "::,10:,:,:,,"  # the defaults of ROS 2: reliable, volatile, the last ten


class ZenohLink:
    """Publishes to the zenoh router or peer at `endpoint`; where there is none, messages are dropped, not kept."""

    def __init__(self, endpoint: str, domain: int, publication: ros2.Publication) -> None:
        """Connect to `endpoint`, tcp/HOST:PORT, and to nothing else; it need not be there yet.

        Raises: OSError for an endpoint that is none.
        """
        self._endpoint, self._session = endpoint, open_session(endpoint)
        self._publication = publication
        self._id = str(self._session.zid())
        self._gid = bytes.fromhex(self._id.rjust(32, "0"))
        self._publishers, self._sequence = dict[str, zenoh.Publisher](), 0
        liveliness = self._session.liveliness()
        self._tokens = [liveliness.declare_token(f"@ros2_lv/{domain}/{self._id}/0/0/NN/%/%/{_NODE}")]
        for number, (topic, kind) in enumerate(rostypes.TYPES.items(), start=1):
            name, place = rostypes.dds_name(kind), topic.replace("/", "%")
            typed = f"{name}/{rostypes.type_hash(kind)}"
            self._publishers[topic] = self._session.declare_publisher(
                f"{domain}/{topic.lstrip('/')}/{typed}", congestion_control=zenoh.CongestionControl.DROP
            )
            token = f"@ros2_lv/{domain}/{self._id}/0/{number}/MP/%/%/{_NODE}/{place}/{typed}/{_QOS}"
            self._tokens.append(liveliness.declare_token(token))
        wait_for_router(self._session)
        self.problem, self._looked_s = "", -math.inf  # why nobody receives what is published
        self.tick()

    def tick(self) -> None:
        """Look now and then whether there is a router."""
        if time.monotonic() - self._looked_s >= _LOOK_S:
            self._looked_s = time.monotonic()
            connected = is_connected(self._session)
            self.problem = "" if connected else f"{nobody_at(self._endpoint)}; messages are dropped"

    def add(self, item: Frame | Detections | Unusable, fix: Fix, latency_us: int | None) -> None:
        """Publish one frame."""
        for message in self._publication.messages(item, fix, latency_us):
            self._put(message)

    def _put(self, message: rostypes.Serialized) -> None:
        self._sequence += 1
        attachment = z_serialize((Int64(self._sequence), Int64(time.time_ns()), self._gid))
        self._publishers[message.topic].put(message.data, attachment=attachment)

    def close(self) -> None:
        """Part from the network."""
        self._session.close()
