"""Topics of ROS 2 read over DDS, without ROS."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import Any

from cyclonedds.core import DDSException, Policy, Qos, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from lumidock.streams.clock import now_ns
from lumidock.streams.ddstypes import RawSample, participant, raw_type
from lumidock.streams.ros import Message

_LOOK_NS = 100_000_000  # after which the thread looks whether it is to end
_MOST = 16  # samples that are taken at once, of which the newest counts
_CLOSING_S = 2.0


class DdsTopics:
    """Hands the newest message of some topics to `take`, in a thread of its own."""

    def __init__(
        self, domain: int, everywhere: bool, topics: Mapping[str, str], take: Callable[[Message], None]
    ) -> None:
        """Listen to `topics`, each with its type, of a domain. Raises: OSError where that cannot be."""
        self._take, self._halt, self.problem = take, threading.Event(), ""
        self._readers = list[tuple[str, str, DataReader[Any]]]()
        joined = participant(domain, everywhere)
        # best effort fits writers of either kind, and a picture that was missed is not asked for again
        encoding = Policy.DataRepresentation(use_cdrv0_representation=True)  # that of ROS, and no newer one
        qos = Qos(Policy.Reliability.BestEffort, Policy.Durability.Volatile, Policy.History.KeepLast(1), encoding)
        self._waiting = WaitSet(joined)
        try:
            for topic, kind in topics.items():
                reader = DataReader(joined, Topic(joined, f"rt{topic}", raw_type(kind)), qos)
                self._waiting.attach(ReadCondition(reader, SampleState.NotRead | ViewState.Any))
                self._readers.append((topic, kind, reader))
        except DDSException as error:
            raise OSError(f"DDS domain {domain}: {error}") from None
        self._thread = threading.Thread(target=self._run, name="dds", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop listening."""
        self._halt.set()
        self._thread.join(_CLOSING_S)
        self._readers.clear()

    def _run(self) -> None:
        while not self._halt.is_set():
            try:
                self._waiting.wait(_LOOK_NS)
            except DDSException as error:
                self.problem = " ".join(str(error).split())
                self._halt.wait(_LOOK_NS * 1e-9)
            for topic, kind, reader in self._readers:
                self._newest(topic, kind, reader)

    def _newest(self, topic: str, kind: str, reader: DataReader[Any]) -> None:
        try:
            samples = [sample for sample in reader.take(_MOST) if isinstance(sample, RawSample)]
        except DDSException as error:
            self.problem = f"{topic}: {' '.join(str(error).split())}"
            return
        if samples:
            self._take(Message(topic, kind, "cdr", now_ns(), samples[-1].data))
