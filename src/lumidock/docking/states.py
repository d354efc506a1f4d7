"""The state machine of a docking: search, approach, hold, enter, docked, back out, abort; each change has a reason."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal

from lumidock.docking.guidance import Course, speed_known
from lumidock.docking.navigation import Navigator
from lumidock.docking.vehicle import VehicleModel
from lumidock.go_no_go import Advice, Passage, advise

State = Literal["search", "approach", "hold", "enter", "docked", "back_out", "abort"]
DOCKED_M = 0.15  # the camera has to be so near to the docking point
_STOPPED_M, _STILL_M_S = 0.10, 0.10  # where the vehicle says that it is docked: two thirds of that, and how slow
_SURE_M = 0.3  # level within which it may say so: an error over DOCKED_M is then rarer than 1 in 80
_BLIND_STOP_M = 10.0  # before the entrance, beyond which the search does not go without a guide
_SEARCH_S, _HOLD_S, _DOCKING_S = 60.0, 25.0, 25.0  # longest times of search, hold, and of the end at the docking point
_BACK_TO_M, _BACK_M_S = 6.0, 0.3  # where the vehicle backs out to, and how fast
_RETRIES = 2
_GONE_M = 4.0  # an aborted docking is over when the vehicle is so far before the entrance
_WORST_OUT_S = 40.0  # or after this time


@dataclass(frozen=True, slots=True)
class Transition:
    """A change of state: at `t_s`, into `state`, and the word why."""

    t_s: float
    state: State
    why: str


@dataclass(frozen=True, slots=True)
class Step:
    """One decision: the state, the go / no-go, where to go, and whether the docking is over."""

    state: State
    advice: Advice
    course: Course
    over: bool = False


@dataclass(frozen=True, slots=True)
class Machine:
    """The state, since when, and how often it tried; a step gives the next machine and never changes this one."""

    passage: Passage
    model: VehicleModel
    docking_ahead_m: float
    state: State = "search"
    since_s: float = 0.0
    tries: int = 0
    log: tuple[Transition, ...] = field(default=(Transition(0.0, "search", "start"),))

    def step(self, navigator: Navigator, t_s: float) -> tuple[Machine, Step]:
        """The decision of one time."""
        advice = advise(navigator.situation(), self.passage)
        state, why = self._next(navigator, advice, t_s)
        machine = self if state == self.state else self._into(state, why, t_s)
        over = machine.state == "docked" or (machine.state == "abort" and machine._is_out(navigator, t_s))
        return machine, Step(machine.state, advice, machine._course(navigator), over)

    def _into(self, state: State, why: str, t_s: float) -> Machine:
        tries = self.tries + (state == "back_out")
        return replace(self, state=state, since_s=t_s, tries=tries, log=(*self.log, Transition(t_s, state, why)))

    def _next(self, navigator: Navigator, advice: Advice, t_s: float) -> tuple[State, str]:
        lapse_s, before_m = t_s - self.since_s, -navigator.position[0]
        known = min(navigator.since_fix_s, navigator.since_guide_s) <= self.passage.blind_s
        if self.state == "search":
            if known:
                return "approach", "seen"
            return ("abort", "no_dock") if lapse_s > _SEARCH_S else ("search", "")
        if self.state in ("approach", "hold") and advice.verdict == "abort":
            return "abort", advice.word
        if self.state == "approach":
            return self._from_approach(advice, before_m)
        if self.state == "hold":
            return self._from_hold(advice, known, lapse_s, before_m)
        if self.state == "enter":
            return self._from_enter(navigator, advice, lapse_s)
        if self.state == "back_out" and (before_m >= _BACK_TO_M - 0.5 or lapse_s > _WORST_OUT_S):
            return ("abort", self.log[-1].why) if self.tries > _RETRIES else ("approach", "retry")
        return self.state, ""

    def _from_approach(self, advice: Advice, before_m: float) -> tuple[State, str]:
        if advice.verdict == "hold":
            return "hold", advice.word
        return (
            ("enter", "clear") if advice.word == "clear" and before_m < self.passage.gate_m + 1.0 else ("approach", "")
        )

    def _from_hold(self, advice: Advice, known: bool, lapse_s: float, before_m: float) -> tuple[State, str]:
        if advice.verdict == "go":
            return "approach", advice.word
        if lapse_s <= _HOLD_S:
            return "hold", ""
        if not known and before_m > _BACK_TO_M:
            return "search", advice.word
        return "back_out", advice.word

    def _from_enter(self, navigator: Navigator, advice: Advice, lapse_s: float) -> tuple[State, str]:
        if advice.verdict == "abort":
            return "back_out", advice.word
        if advice.verdict == "hold" and advice.word != "too_fast":
            return "hold", advice.word
        x, left, up = navigator.position
        miss = math.hypot(x - self.docking_ahead_m, left, up)
        still = math.hypot(*navigator.velocity) < _STILL_M_S
        if miss < _STOPPED_M and still and max(navigator.level_m, navigator.level_z_m) < _SURE_M:
            return "docked", "at_the_point"
        way_s = (self.docking_ahead_m + self.passage.gate_m) / self.model.entry_m_s
        return ("back_out", "slow") if lapse_s > 2.0 * way_s + _DOCKING_S else ("enter", "")

    def _course(self, navigator: Navigator) -> Course:
        """Where the state wants the vehicle."""
        before_m, gate_m = -navigator.position[0], self.passage.gate_m
        fast = speed_known(navigator, self.model)
        # half of the braking that the go / no-go reckons with, so that it is not too fast at the gate
        brake = math.sqrt(self.model.entry_m_s**2 + self.passage.brake_m_s2 * max(before_m - gate_m, 0.0))
        if self.state == "search":
            return Course(-_BLIND_STOP_M, min(fast, brake))
        if self.state == "approach":
            return Course(0.5 - gate_m, min(fast, brake))
        if self.state == "hold":
            return Course(min(navigator.position[0], -gate_m), self.model.entry_m_s)
        if self.state in ("enter", "docked"):
            return Course(self.docking_ahead_m, min(fast, self.model.entry_m_s) if self.state == "enter" else 0.0)
        return Course(-_BACK_TO_M - 1.0, _BACK_M_S)

    def _is_out(self, navigator: Navigator, t_s: float) -> bool:
        return -navigator.position[0] > _GONE_M or t_s - self.since_s > _WORST_OUT_S
