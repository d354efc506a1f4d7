"""Go or no-go: whether a vehicle may go on into the dock, as a verdict of its own with the word why.

It rests on where the vehicle is and how well that is known against the dock's opening, on the closing speed and on the
time since the last fix. A pure function of one `Situation`, for a simulated vehicle and for `serve` alike; `Watch`
keeps the last fix between frames for those who have nothing but fixes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from lumidock.datatypes import Fix
from lumidock.station import Station

Verdict = Literal["go", "hold", "abort"]
CONTRADICTED = ("survey", "calibration")  # reasons of a fix that end a docking: the files do not describe what is seen
DRIFT_M_S = 0.5  # of a vehicle that does not know its own motion, in the strongest current that is docked in
_SPEED_MEMORY_S = 0.5  # over which the closing speed between fixes is smoothed
WORDS = {
    "clear": "Position, its level and the speed leave room in the opening.",
    "approach": "Outside the gate, and the way to it is known.",
    "no_fix": "Outside the gate, and nothing tells where the dock is, or not recently enough.",
    "level": "The protection level leaves no room in the opening.",
    "off_axis": "The vehicle is beside the opening, by more than its level and its size leave room for.",
    "too_fast": "It closes in faster than it may enter.",
    "blind": "Inside the gate, and no fix for longer than may be reckoned.",
    "survey": "What is seen contradicts the station file.",
    "calibration": "What is seen contradicts the camera file.",
}


@dataclass(frozen=True, slots=True)
class Passage:
    """The dock's opening and what the vehicle needs of it.

    `opening_m`: radius of the free opening around the docking axis; `vehicle_m`: radius of a circle that holds the
    vehicle's cross-section; `gate_m`: distance before the entrance from which on the opening counts; `brake_m_s2`:
    what the vehicle can brake with; `entry_m_s`: the fastest that it may enter with; `blind_s`: how long it may go on
    without any fix.
    """

    opening_m: float
    vehicle_m: float
    gate_m: float = 3.0
    brake_m_s2: float = 0.1
    entry_m_s: float = 0.5
    blind_s: float = 20.0

    @property
    def clearance_m(self) -> float:
        """How far the vehicle's middle may be off the axis."""
        return self.opening_m - self.vehicle_m

    @classmethod
    def of(cls, station: Station, vehicle_m: float) -> Passage:
        """The passage of a dock whose front lights stand around its opening: the circle that holds none of them."""
        p_dock = station.p_dock[station.lights_of(station.layers_front_to_rear()[0])]
        return cls(float(np.hypot(p_dock[:, 0], p_dock[:, 1]).min()), vehicle_m)


@dataclass(frozen=True, slots=True)
class Situation:
    """What is known of a vehicle at one time.

    `off_m`: distance of the camera from the docking axis; `z_m` in `dock`; `level_m` and `level_z_m`: bounds of their
    errors now; infinite where unknown. `closing_m_s`: speed toward the dock; `since_fix_s`: since the last valid pose,
    `since_guide_s`: since the last bearing and range. `reason`: that of the last frame without a valid fix, or empty.
    """

    off_m: float
    z_m: float
    level_m: float
    level_z_m: float
    closing_m_s: float
    since_fix_s: float
    since_guide_s: float
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Advice:
    """The verdict and the word why; `docs/closed-loop.md` has the table."""

    verdict: Verdict
    word: str


def advise(situation: Situation, passage: Passage) -> Advice:
    """Whether the vehicle may go on. Inside the gate what would mean waiting outside means leaving."""
    now = situation
    if now.reason in CONTRADICTED:
        return Advice("abort", now.reason)
    stop_m = max(now.closing_m_s, 0.0) ** 2 / (2.0 * passage.brake_m_s2)
    nearest_m = now.z_m - (now.level_z_m if math.isfinite(now.level_z_m) else 0.0)
    recent = min(now.since_fix_s, now.since_guide_s) <= passage.blind_s
    if nearest_m - stop_m > passage.gate_m or not math.isfinite(now.z_m):
        return Advice("go", "approach") if recent else Advice("hold", "no_fix")
    refuse: Verdict = "abort" if now.z_m < passage.gate_m / 2.0 else "hold"
    if now.since_fix_s > passage.blind_s:
        return Advice(refuse, "blind" if refuse == "abort" else "no_fix")
    if now.off_m > passage.clearance_m:
        return Advice(refuse, "off_axis")
    if now.off_m + now.level_m > passage.clearance_m:
        return Advice(refuse, "level")
    if now.closing_m_s > passage.entry_m_s:
        return Advice(refuse, "too_fast")
    return Advice("go", "clear")


@dataclass(frozen=True, slots=True)
class Watch:
    """The last usable fix and what followed, for those who have only fixes; `drift_m_s` is how fast a level grows."""

    passage: Passage
    drift_m_s: float = DRIFT_M_S
    fix: Fix | None = None
    pose: Fix | None = None
    guide: Fix | None = None
    closing_m_s: float = field(default=0.0)

    def after(self, fix: Fix) -> Watch:
        """The watch after one more frame."""
        closing_m_s = self.closing_m_s
        if fix.T_dock_cam is not None and self.pose is not None and self.pose.T_dock_cam is not None:
            lapse_s = (fix.t_ns - self.pose.t_ns) * 1e-9
            if lapse_s > 0.0:
                now_m_s = float(self.pose.T_dock_cam[2, 3] - fix.T_dock_cam[2, 3]) / lapse_s
                closing_m_s += min(1.0, lapse_s / _SPEED_MEMORY_S) * (now_m_s - closing_m_s)
        return replace(
            self,
            fix=fix,
            pose=fix if fix.valid else self.pose,
            guide=fix if fix.guide is not None or fix.valid else self.guide,
            closing_m_s=closing_m_s,
        )

    def advise(self, t_ns: int) -> Advice:
        """The advice at a time, which may be later than the last frame."""
        since_fix_s = (t_ns - self.pose.t_ns) * 1e-9 if self.pose else math.inf
        since_guide_s = (t_ns - self.guide.t_ns) * 1e-9 if self.guide else math.inf
        x, y, z = self._place()
        level_m, level_z_m = self._levels()
        grown_m = self.drift_m_s * since_fix_s if self.pose else 0.0
        return advise(
            Situation(
                off_m=math.hypot(x, y),
                z_m=z,
                level_m=level_m + grown_m,
                level_z_m=level_z_m + grown_m,
                closing_m_s=self.closing_m_s,
                since_fix_s=since_fix_s,
                since_guide_s=since_guide_s,
                reason=self.fix.reason if self.fix else "",
            ),
            self.passage,
        )

    @property
    def _guided(self) -> bool:
        """Whether a guide is newer than any pose."""
        return self.guide is not None and (self.pose is None or self.guide.t_ns > self.pose.t_ns)

    def _place(self) -> tuple[float, float, float]:
        """The last known position in `dock`; of a guide alone only the distance is known, and stands for z."""
        if not self._guided and self.pose is not None and self.pose.T_dock_cam is not None:
            x, y, z = (float(value) for value in self.pose.T_dock_cam[:3, 3])
            return x, y, z
        if self.guide is not None and self.guide.guide is not None:
            return 0.0, 0.0, self.guide.guide.range_m
        return 0.0, 0.0, math.inf

    def _levels(self) -> tuple[float, float]:
        """Levels across and along the axis of what `_place` gives; a method without levels is taken at its word."""
        if self._guided or self.pose is None:
            return math.inf, self.guide.guide.pl_range_m if self.guide and self.guide.guide else math.inf
        protection = self.pose.protection
        return (protection.lateral_m, protection.axial_m) if protection else (0.0, 0.0)
