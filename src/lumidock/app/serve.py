"""Live guidance: the newest frame goes through the localizer to the vehicle, and slower consumers skip frames.

One thread reads the camera into a slot that holds the newest frame only. The caller's thread localizes and offers the
fix to the sinks, each of which has a thread and a short queue of its own, so that none can delay the next fix.
"""

from __future__ import annotations

import gc
import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lumidock.app.run import aid, process
from lumidock.datatypes import Fix, Frame, Stage, Unusable
from lumidock.errors import LumidockError
from lumidock.go_no_go import Watch
from lumidock.methods import Method
from lumidock.streams.sensors import AidingFeed, SensorFeed
from lumidock.streams.sinks import Sink
from lumidock.streams.source import Item

_RECENT = 1000  # frames that rates and latencies are taken over
_TICK_S = 0.2  # after which a sink without frames is given a turn, for its heartbeats
_LOOK_S = 0.05  # that a recording waits at most until a frame has been localized
_RETRY_S = 1.0  # until a lost camera or a failed sink is tried again
_YIELD_S = 0.01  # that sinks which can wait leave the processor to the one that tells the vehicle
_OPENING_S = 2.0  # all sinks together may take before the first frame
_CLOSING_S = 5.0  # a sink may take to write what is left
_LOOP_PAUSE_NS = 3_000_000_000  # between two passes over a recording, longer than any track lives
STALE_S = 0.25  # older fixes are not sent: ArduPilot declares an estimate lost after 0.3 s


@dataclass(frozen=True, slots=True)
class Taken:
    """A frame and when it arrived, on the monotonic clock."""

    item: Item
    at_s: float


class Newest:
    """A slot for one frame; a newer one replaces it."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._taken: Taken | None = None
        self._idle = threading.Event()
        self.dropped = 0

    def put(self, item: Item) -> None:
        """Replace what is there."""
        with self._changed:
            self.dropped += self._taken is not None
            self._taken = Taken(item, time.monotonic())
            self._idle.clear()
            self._changed.notify()

    def get(self, timeout_s: float) -> Taken | None:
        """Take the newest frame; None when none comes in time."""
        with self._changed:
            if self._taken is None:
                self._idle.set()
                self._changed.wait(timeout_s)
            taken, self._taken = self._taken, None
            return taken

    def wait_until_idle(self, timeout_s: float) -> None:
        """Wait until the consumer has finished the last frame."""
        self._idle.wait(timeout_s)


class SourceReader(threading.Thread):
    """Reads a source into a slot, and opens it again when it is lost; a recording is read at its own pace."""

    def __init__(
        self, open_items: Callable[[], Iterator[Item]], newest: Newest, *, live: bool, loop: bool, stop: threading.Event
    ) -> None:
        super().__init__(name="camera", daemon=True)
        self._open, self._newest, self._live, self.loop, self._halt = open_items, newest, live, loop, stop
        self.frames, self.reconnects, self.problem, self.ended = 0, 0, "", False
        self._offset_ns = self._passes = 0

    def run(self) -> None:
        """Read until told to stop, or to the end of a recording."""
        while not self._halt.is_set():
            try:
                self._pass()
                self.problem = "the stream ended" if self._live and not self._halt.is_set() else ""
            except (LumidockError, OSError) as error:
                self.problem = str(error)
            except Exception as error:  # of a library's reader: told, and tried again like any other
                self.problem = f"{type(error).__name__}: {' '.join(str(error).split())}"
            if not self._live and (not self.loop or self.problem):
                break
            self._passes += 1
            if self._live:
                self.reconnects += 1
                self._halt.wait(_RETRY_S)
        self.ended = True

    def _pass(self) -> None:
        start_s, first_ns, last_ns = time.monotonic(), None, 0
        for item in self._open():
            if self._halt.is_set():
                return
            if not self._live and item.t_ns is not None:
                first_ns = item.t_ns if first_ns is None else first_ns
                self._halt.wait(max(0.0, start_s + (item.t_ns - first_ns) * 1e-9 - time.monotonic()))
                last_ns = max(last_ns, item.t_ns)
            self.frames += 1
            self.problem = ""
            self._newest.put(_of_pass(item, self._passes, self._offset_ns))
            if not self._live:  # unlike a camera, a recording would decode its next image while this one is localized
                self._newest.wait_until_idle(_LOOK_S)
                self._halt.wait(_YIELD_S)
        if self.loop and first_ns is not None:
            self._offset_ns += last_ns - first_ns + _LOOP_PAUSE_NS
            self._halt.wait(_LOOP_PAUSE_NS * 1e-9)


def _of_pass(item: Item, number: int, offset_ns: int) -> Item:
    """The same frame with a name and a stamp of its own, when a source is read once more."""
    if not number:
        return item
    t_ns = None if item.t_ns is None else item.t_ns + offset_ns
    if isinstance(item, Frame):
        return replace(item, name=f"{number}.{item.name}", t_ns=item.t_ns + offset_ns)
    if isinstance(item, Unusable):
        return replace(item, frame=f"{number}.{item.frame}", t_ns=t_ns)
    return replace(item, frame=f"{number}.{item.frame}", t_ns=item.t_ns + offset_ns)


@dataclass(frozen=True, slots=True)
class Done:
    """A localized frame on its way to a sink."""

    taken: Taken
    fix: Fix
    latency_us: int | None


def _without_picture(done: Done) -> Done:
    item = done.taken.item
    if not isinstance(item, Frame):
        return done
    return replace(done, taken=Taken(Unusable(item.name, item.t_ns, "", ""), done.taken.at_s))


class Worker(threading.Thread):
    """Feeds one sink from a queue that drops its oldest; a sink that fails is opened again."""

    def __init__(
        self,
        name: str,
        open_sink: Callable[[], Sink],
        *,
        queue: int,
        stale_s: float | None = None,
        pictures: bool = True,
        patient: bool = False,
    ) -> None:
        """Feed the sink that `open_sink` opens; without `pictures` it is given the frames' names and stamps alone.

        A `patient` sink, a display or a recording, waits with each frame until the vehicle has been sent its fix.
        """
        super().__init__(name=name, daemon=True)
        self._open, self._queue, self._stale_s = open_sink, deque[Done](maxlen=queue), stale_s
        self._pictures, self._patient = pictures, patient
        self._skipped = deque[Fix](maxlen=_RECENT)  # fixes that were not sent, of which a sink may want to know
        self._changed, self._halt = threading.Condition(), False
        self.tried = threading.Event()  # whether the sink has been opened, well or not
        self.sent, self.dropped, self.stale, self.errors, self.problem = 0, 0, 0, 0, ""
        self.delay_s = deque[float](maxlen=_RECENT)  # from the frame's arrival to the end of sending

    def offer(self, done: Done) -> None:
        """Queue a fix, in place of the oldest where the queue is full; never waits."""
        with self._changed:
            if len(self._queue) == self._queue.maxlen:
                self.dropped += 1
                self._skipped.append(self._queue[0].fix)
            self._queue.append(done if self._pictures else _without_picture(done))
            self._changed.notify()

    def finish(self) -> None:
        """Send what is queued, close the sink and end; a sink that hangs is left behind."""
        with self._changed:
            self._halt = True
            self._changed.notify()
        self.join(_CLOSING_S)

    def run(self) -> None:
        """Open, feed and close the sink, again and again if need be."""
        while not self._over():
            try:
                sink = self._open()
                self.problem = getattr(sink, "problem", self.problem)
                self.tried.set()
                try:
                    self._feed(sink)
                finally:
                    sink.close()
            except (OSError, LumidockError, RuntimeError, ValueError) as error:
                self.errors += 1
                self.problem = " ".join(str(error).split()) or type(error).__name__
                self.tried.set()
                self._pause()

    def _over(self) -> bool:
        with self._changed:
            return self._halt and not self._queue

    def _pause(self) -> None:
        """Wait before a sink that failed is opened again; its queue is dropped if the program ends meanwhile."""
        end = time.monotonic() + _RETRY_S
        with self._changed:
            while not self._halt and time.monotonic() < end:
                self._changed.wait(end - time.monotonic())
            if self._halt:
                self._queue.clear()

    def _feed(self, sink: Sink) -> None:
        tick: Callable[[], None] = getattr(sink, "tick", lambda: None)
        while True:
            with self._changed:
                if not self._queue and not self._halt:
                    self._changed.wait(_TICK_S)
                done = self._queue.popleft() if self._queue else None
                if done is None and self._halt:
                    return
            tick()
            self.problem = getattr(sink, "problem", self.problem)
            if done is not None:
                if (
                    self._patient
                ):  # a lower thread priority would not help: the holder of the interpreter lock blocks all
                    time.sleep(_YIELD_S)
                self._send(sink, done)

    def _send(self, sink: Sink, done: Done) -> None:
        age_s = time.monotonic() - done.taken.at_s
        if self._stale_s is not None and age_s > self._stale_s:
            self.stale += 1
            self._skipped.append(done.fix)
            return
        self._tell_skipped(sink)
        sink.add(done.taken.item, done.fix, done.latency_us)
        self.sent += 1
        self.problem = getattr(sink, "problem", "")
        self.delay_s.append(time.monotonic() - done.taken.at_s)

    def _tell_skipped(self, sink: Sink) -> None:
        """Let a sink that counts acquisitions take notice of fixes that it was not given."""
        skip: Callable[[Fix], None] = getattr(sink, "skip", lambda _fix: None)
        while self._skipped:
            skip(self._skipped.popleft())


@dataclass(slots=True)
class Server:
    """Source reader, localizer and sinks, and their health."""

    localizer: Method
    camera: SourceReader
    newest: Newest
    workers: list[Worker]
    stop: threading.Event
    reasons: Counter[str] = field(default_factory=Counter)
    counts: Counter[str] = field(default_factory=Counter)
    arrivals_s: deque[float] = field(default_factory=lambda: deque(maxlen=_RECENT))
    latency_us: deque[int] = field(default_factory=lambda: deque(maxlen=_RECENT))
    last: Fix | None = None
    contradiction: str = ""
    feed: SensorFeed = field(default_factory=lambda: AidingFeed(()))
    watch: Watch | None = None  # of the go / no-go
    started_s: float = field(default_factory=time.monotonic)

    def serve(self, ready: Callable[[], None] = lambda: None) -> None:
        """Localize the newest frame, over and over, until told to stop or the recording ends.

        `ready` is called once, when every sink has been opened, well or not.
        """
        stage: Stage = "search"
        gc.collect()
        gc.freeze()  # objects alive now stay alive, and scanning them would lengthen every pause of the collector
        for worker in self.workers:
            worker.start()
        ready_s = time.monotonic() + _OPENING_S
        for worker in self.workers:  # a sink that is slow to open would lag from the first frame on
            worker.tried.wait(max(0.0, ready_s - time.monotonic()))
        self.camera.start()
        told = False
        try:
            while not self.stop.is_set():
                if not told and all(worker.tried.is_set() for worker in self.workers):
                    ready()
                    told = True
                taken = self.newest.get(0.1)
                if taken is not None:
                    stage = self._localize(taken, stage)
                elif self.camera.ended:
                    break
        finally:
            self.stop.set()
            for worker in self.workers:
                worker.finish()
            self.camera.join(_CLOSING_S)
            gc.unfreeze()

    def _localize(self, taken: Taken, stage: Stage) -> Stage:
        aid(self.localizer, self.feed, taken.item)
        fix, latency_us, _ = process(self.localizer, taken.item, stage)
        for worker in self.workers:
            worker.offer(Done(taken, fix, latency_us))
        self.arrivals_s.append(taken.at_s)
        if latency_us is not None:
            self.latency_us.append(latency_us)
        self.counts.update(frames=1, valid=int(fix.valid), guide=int(fix.guide is not None))
        if fix.reason:
            self.reasons[fix.reason] += 1
        if fix.contradiction is not None:
            self.contradiction = fix.contradiction.text
        self.last = fix
        if self.watch is not None:
            self.watch = self.watch.after(fix)
        return fix.stage

    def losses(self) -> dict[str, Any]:
        """What a run folder of this server does not hold: for its run.json."""
        queues = {worker.name: {"dropped": worker.dropped, "stale": worker.stale} for worker in self.workers}
        camera = {"frames": self.camera.frames, "dropped": self.newest.dropped, "reconnects": self.camera.reconnects}
        return {"camera": camera | {"problem": self.camera.problem}, "sinks": queues}

    def health(self) -> dict[str, Any]:
        """Rates, latencies, drops and reasons, for the page and for machines."""
        now, arrivals = time.monotonic(), list(self.arrivals_s)
        age_s = now - arrivals[-1] if arrivals else None
        span_s = arrivals[-1] - arrivals[0] if len(arrivals) > 1 else 0.0
        last = self.last
        return {
            "ok": age_s is not None and age_s < 2.0 * _RETRY_S and not self.camera.problem,
            "up_s": now - self.started_s,
            "camera": {
                "frames": self.camera.frames,
                "rate_hz": (len(arrivals) - 1) / span_s if span_s else None,
                "last_frame_s_ago": age_s,
                "dropped": self.newest.dropped,
                "reconnects": self.camera.reconnects,
                "problem": self.camera.problem,
            },
            "fixes": {
                **{word: self.counts[word] for word in ("frames", "valid", "guide")},
                "reasons": dict(self.reasons),
                "last": None if last is None else {"status": last.status, "stage": last.stage, "reason": last.reason},
                "contradiction": self.contradiction,
                "exposure_factor": None if last is None or math.isnan(last.exposure_factor) else last.exposure_factor,
                "latency_ms": percentiles([us / 1000.0 for us in list(self.latency_us)]),
            },
            "go_no_go": self._advice(age_s),
            "sinks": {
                worker.name: {
                    **{word: getattr(worker, word) for word in ("sent", "dropped", "stale", "errors", "problem")},
                    "frame_to_sent_ms": percentiles([1000.0 * s for s in list(worker.delay_s)]),
                }
                for worker in self.workers
            },
        }

    def _advice(self, age_s: float | None) -> dict[str, str] | None:
        """The go / no-go as it is by now; None without the vehicle's size."""
        if self.watch is None:
            return None
        t_ns = 0 if self.last is None or age_s is None else self.last.t_ns + round(age_s * 1e9)
        advice = self.watch.advise(t_ns)
        return {"verdict": advice.verdict, "word": advice.word}


def percentiles(values: list[float]) -> dict[str, float]:
    """Median, 99 % and largest of some values; empty where there are none."""
    if not values:
        return {}
    return {name: round(float(np.percentile(values, q)), 3) for name, q in (("p50", 50), ("p99", 99), ("max", 100))}
