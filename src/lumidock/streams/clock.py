"""Time of frames: this machine's clock, stamps in names of files, and the clock of a stream that comes in bursts."""

from __future__ import annotations

import time

_SINCE_EPOCH_NS = time.time_ns() - time.monotonic_ns()
# digits of an epoch time between 2001 and 2286 by its unit, ns
_UNIT_NS = {10: 10**9, 13: 10**6, 16: 10**3, 19: 1}
_MAX_SLEW = 0.01  # by which the clock of a stream may run fast or slow while it is corrected
_MAX_DRIFT = 2e-4  # of one quartz against another
_JUMP_NS = 2_000_000_000  # a stream whose own time is off by more was started anew
_NEWEST_WALL_NS = 1_000_000_000  # a camera's own clock is believed when a frame took at most that long to come
SIM_TIME_BELOW_NS = 10**9 * 86400 * 365  # a stamp in the first year of the epoch is the time of a simulation


def now_ns() -> int:
    """Time since the epoch, by the clock as it was at the start: setting it later does not make stamps jump."""
    return _SINCE_EPOCH_NS + time.monotonic_ns()


def stamp_in_name(stem: str) -> int | None:
    """The time since the epoch, ns, that a name without its ending says: 1403636579763555584 or 1311868164.363181."""
    whole, point, fraction = stem.partition(".")
    if not (whole.isascii() and whole.isdecimal()):
        return None
    if point:
        if len(whole) != 10 or not (fraction.isascii() and fraction.isdecimal() and len(fraction) <= 9):
            return None
        return int(whole) * 10**9 + int(fraction.ljust(9, "0"))
    unit = _UNIT_NS.get(len(whole))
    return None if unit is None else int(whole) * unit


class StreamClock:
    """Stamps, in this machine's time, of frames that carry the time of their camera and arrive in bursts.

    The camera's time says how far frames are apart. Where it stands in this machine's time is learned from the frame
    that came with the least delay, or from the camera's own wall clock (RTCP sender reports) where that agrees with
    ours to within a second. What is learned is brought in slowly, so that no interval is off by more than one per cent.
    """

    def __init__(self) -> None:
        self._offset_ns = self._target_ns = self._last_ns = 0
        self._last: int | None = None  # the camera's time of the frame before, ns

    def stamp(self, camera_ns: int, arrival_ns: int, wall_ns: int | None = None) -> int:
        """Stamp ns of a frame of `camera_ns` by its camera, `wall_ns` by its wall clock, that came at `arrival_ns`."""
        if wall_ns is not None and 0 <= arrival_ns - wall_ns <= _NEWEST_WALL_NS:
            seen_ns, best_ns = wall_ns - camera_ns, wall_ns - camera_ns
        else:
            drift_ns = 0 if self._last is None else int(_MAX_DRIFT * max(0, camera_ns - self._last))
            seen_ns = arrival_ns - camera_ns
            best_ns = min(self._target_ns + drift_ns, seen_ns)
        if (
            self._last is None
            or not 0 <= camera_ns - self._last < _JUMP_NS
            or abs(seen_ns - self._offset_ns) > _JUMP_NS
        ):
            self._offset_ns = self._target_ns = seen_ns
        else:
            self._target_ns = best_ns
            most_ns = int(_MAX_SLEW * (camera_ns - self._last))
            self._offset_ns += max(-most_ns, min(most_ns, self._target_ns - self._offset_ns))
        self._last = camera_ns
        self._last_ns = max(self._last_ns + 1, camera_ns + self._offset_ns)
        return self._last_ns
