from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lumidock.streams.clock import StreamClock, stamp_in_name

SECOND = 10**9


@pytest.mark.parametrize("burst_s", [0.0, 0.2, 0.5])
@pytest.mark.parametrize("drift", [0.0, 1e-4, -1e-4])
def test_frames_that_come_in_bursts_keep_the_camera_s_intervals(rng, burst_s, drift):
    """Frames of 30 Hz are held back until the end of each burst; the clock knows neither offset nor drift."""
    truth = np.arange(3600) * SECOND // 30
    camera = (truth * (1 + drift)).astype(np.int64) + 12345
    sent = truth if burst_s == 0.0 else (truth // int(burst_s * SECOND) + 1) * int(burst_s * SECOND)
    arrival = 1_700_000_000 * SECOND + sent + rng.integers(5_000_000, 25_000_000, len(truth))
    arrival = np.maximum.accumulate(arrival)
    clock = StreamClock()
    stamps = np.array([clock.stamp(int(c), int(a)) for c, a in zip(camera, arrival, strict=True)])
    steps = np.diff(stamps)
    assert np.abs(steps / (SECOND / 30) - 1.0).max() < 0.0105
    late = stamps[-900:] - (1_700_000_000 * SECOND + truth[-900:])
    assert late.min() > -5_000_000
    assert late.max() < 70_000_000  # no more than the least delay of a frame in its burst, and jitter


def test_the_camera_s_wall_clock_is_taken_where_it_agrees():
    start, clock = 1_700_000_000 * SECOND, StreamClock()
    for i in range(3000):
        taken = start + i * SECOND // 30
        stamp = clock.stamp(i * SECOND // 30, taken + 300_000_000, taken if i > 10 else None)
    assert abs(stamp - taken) < 1_000_000
    clock = StreamClock()
    stamps = [clock.stamp(i * SECOND, start + i * SECOND, start - 3600 * SECOND) for i in range(3)]
    assert stamps == [start + i * SECOND for i in range(3)]  # a camera that was never set


@given(st.lists(st.tuples(st.integers(-(10**12), 10**12), st.integers(0, 10**12)), max_size=40))
def test_stamps_rise_whatever_a_stream_says(pairs):
    clock = StreamClock()
    stamps = [clock.stamp(camera, 10**18 + arrival) for camera, arrival in pairs]
    assert all(a < b for a, b in pairwise(stamps))


@pytest.mark.parametrize(
    ("name", "stamp"),
    [
        ("1403636579763555584", 1403636579763555584),
        ("1403636579763555", 1403636579763555000),
        ("1403636579763", 1403636579763000000),
        ("1403636579", 1403636579 * SECOND),
        ("1311868164.363181", 1311868164363181000),
        ("000123", None),
        ("frame_1403636579763555584", None),
        ("131186816.363181", None),
        ("1311868164.", None),
        ("", None),
    ],
)
def test_stamps_in_names(name, stamp):
    assert stamp_in_name(name) == stamp
