"""The go / no-go: what it must never allow, whatever the numbers, and what it says of plain cases."""

import math
import socket
from dataclasses import replace

import numpy as np
import pytest
from bench.shipped import shipped_station
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common

from lumidock.datatypes import Fix, Guide, Protection, Unusable
from lumidock.go_no_go import WORDS, Passage, Situation, Watch, advise
from lumidock.streams.go_no_go_link import VALUES, GoNoGoLink

PASSAGE = Passage(opening_m=0.94, vehicle_m=0.35)
NUMBERS = st.floats(0.0, 40.0)
SITUATIONS = st.builds(
    Situation,
    off_m=st.floats(0.0, 3.0),
    z_m=st.floats(-4.0, 30.0),
    level_m=st.one_of(st.floats(0.0, 3.0), st.just(math.inf)),
    level_z_m=st.one_of(st.floats(0.0, 3.0), st.just(math.inf)),
    closing_m_s=st.floats(-1.0, 2.0),
    since_fix_s=st.one_of(NUMBERS, st.just(math.inf)),
    since_guide_s=st.one_of(NUMBERS, st.just(math.inf)),
    reason=st.sampled_from(("", "protection", "survey", "calibration", "no_lights")),
)
CLEAR = Situation(0.05, 1.0, 0.1, 0.1, closing_m_s=0.3, since_fix_s=0.1, since_guide_s=0.1)


@given(SITUATIONS)
def test_inside_the_gate_go_means_room_knowledge_and_a_speed_that_is_allowed(situation):
    advice = advise(situation, PASSAGE)
    assert advice.word in WORDS
    if advice.verdict == "go" and situation.z_m <= PASSAGE.gate_m:
        assert situation.off_m + situation.level_m <= PASSAGE.clearance_m
        assert situation.since_fix_s <= PASSAGE.blind_s
        assert situation.closing_m_s <= PASSAGE.entry_m_s
        assert situation.reason not in ("survey", "calibration")


@given(SITUATIONS, st.floats(0.0, 2.0))
def test_knowing_less_never_turns_no_into_go(situation, more):
    worse = replace(situation, level_m=situation.level_m + more, since_fix_s=situation.since_fix_s + more)
    order = {"go": 2, "hold": 1, "abort": 0}
    assert order[advise(worse, PASSAGE).verdict] <= order[advise(situation, PASSAGE).verdict]


@pytest.mark.parametrize(
    ("change", "verdict", "word"),
    [
        ({}, "go", "clear"),
        ({"z_m": 15.0}, "go", "approach"),
        ({"z_m": 15.0, "since_fix_s": math.inf, "since_guide_s": 30.0}, "hold", "no_fix"),
        ({"off_m": 0.7}, "abort", "off_axis"),
        ({"off_m": 0.7, "z_m": 2.5}, "hold", "off_axis"),
        ({"level_m": 0.6}, "abort", "level"),
        ({"level_m": 0.6, "z_m": 2.5}, "hold", "level"),
        ({"since_fix_s": 25.0}, "abort", "blind"),
        ({"closing_m_s": 0.9}, "abort", "too_fast"),
        ({"reason": "survey"}, "abort", "survey"),
        ({"reason": "calibration", "z_m": 15.0}, "abort", "calibration"),
    ],
)
def test_plain_cases(change, verdict, word):
    advice = advise(replace(CLEAR, **change), PASSAGE)
    assert (advice.verdict, advice.word) == (verdict, word)


def test_the_opening_is_the_circle_that_holds_no_front_light():
    station = shipped_station()
    passage = Passage.of(station, 0.3)
    off = np.hypot(*station.p_dock[station.lights_of("front"), :2].T)
    assert passage.opening_m == pytest.approx(off.min())
    assert 0.9 < passage.opening_m < 1.0  # the cage is 2 m wide


def pose_fix(t_s, z):
    T_dock_cam = np.diag([1.0, -1.0, -1.0, 1.0])
    T_dock_cam[2, 3] = z
    level = Protection(0.05, 0.05, 0.02)
    return Fix(
        "a", round(t_s * 1e9), "tracking", "front", T_dock_cam=T_dock_cam, protection=level, covariance=np.eye(6)
    )


def test_a_watch_says_no_when_the_fixes_stop():
    watch = Watch(PASSAGE)
    assert watch.advise(0).word == "no_fix"
    for k in range(30):
        watch = watch.after(pose_fix(0.1 * k, 2.6 - 0.03 * k))
    assert watch.closing_m_s == pytest.approx(0.3, abs=0.01)
    assert watch.advise(round(2.9e9)).verdict == "go"
    later = [watch.advise(round((2.9 + lapse) * 1e9)) for lapse in (0.5, 3.0)]
    assert [advice.word for advice in later] == ["clear", "level"]  # it may have drifted by now
    assert Watch(PASSAGE, drift_m_s=0.0, pose=watch.pose, fix=watch.fix).advise(round(40e9)).word == "no_fix"


def test_a_guide_alone_brings_the_vehicle_to_the_gate_and_no_further():
    def guided(range_m):
        fix = Fix("a", 0, "tracking", "front", reason="protection", guide=Guide(0.0, 0.0, range_m, 0.01, 0.1))
        return Watch(PASSAGE).after(fix).advise(0)

    assert (guided(12.0).verdict, guided(12.0).word) == ("go", "approach")
    assert guided(2.0).verdict == "hold"


def received(receiver):
    """All messages that wait on a socket."""
    parser, found = common.MAVLink(None), []
    while True:
        try:
            found += parser.parse_buffer(receiver.recv(2048)) or []
        except BlockingIOError:
            return found


def test_mavlink_carries_the_value_with_every_fix_and_the_word_when_it_changes():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.setblocking(False)
        link = GoNoGoLink("127.0.0.1", receiver.getsockname()[1], Watch(PASSAGE))
        link.tick()
        for k in range(3):
            fix = pose_fix(0.1 * k, 2.0 - 0.03 * k)
            link.add(Unusable(fix.frame, fix.t_ns, "", ""), fix, 100)
        messages = received(receiver)
        link.close()
    values = [m.value for m in messages if m.get_type() == "NAMED_VALUE_INT"]
    assert values == [VALUES["hold"], *[VALUES["go"]] * 3]
    assert {m.name for m in messages if m.get_type() == "NAMED_VALUE_INT"} == {"go_no_go"}
    texts = [m.text for m in messages if m.get_type() == "STATUSTEXT"]
    assert texts == ["dock: hold (no_fix)", "dock: go (clear)"]
