"""Vehicles in four degrees of freedom: surge, sway, heave and yaw, with roll and pitch held by their own buoyancy.

The frame `approach` is the dock's, turned to the vehicle's view: x forward into the dock (-z of `dock`), y left (-x), z
up (+y). `body` is the same on the vehicle (REP-103), turned by the heading about z. Positions are those of the body's
centre. Source of the equations: T. I. Fossen, "Handbook of Marine Craft Hydrodynamics and Motion Control", 2011,
sections 6.5 and 8.3: with respect to the water, M v' + C(v) v + D(v) v = thrust.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from lumidock.datatypes import Array

R_DOCK_APPROACH = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])
R_BODY_CAM_AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
Four = tuple[float, float, float, float]  # surge, sway, heave, yaw
Three = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class VehicleModel:
    """A vehicle's parameters; each of four numbers is for surge, sway, heave (kg, N s/m, N s2/m2, N) and yaw.

    `mass` without and `added` of the water; `linear` and `quadratic` drag; `thrust` the most that the thrusters give,
    which they follow with the time constant `thruster_lag_s`; where the same thrusters give surge, sway and yaw,
    `shared_n` is the most of |surge| + |sway| + |yaw| / `yaw_arm_m`. `half_m` is half of length, width and height of
    the hull; the camera looks ahead from the middle of the nose. `cruise_m_s` is the speed far from the dock,
    `entry_m_s` inside.
    """

    name: str
    mass: Four
    added: Four
    linear: Four
    quadratic: Four
    thrust: Four
    thruster_lag_s: float
    half_m: Three
    cruise_m_s: float
    entry_m_s: float
    shared_n: float = math.inf
    yaw_arm_m: float = 1.0

    @property
    def radius_m(self) -> float:
        """Radius of the circle around the docking axis that holds the cross-section of the hull."""
        return math.hypot(self.half_m[1], self.half_m[2])

    @property
    def inertia(self) -> Four:
        """Mass and added mass of each degree of freedom, kg and kg m2."""
        surge, sway, heave, yaw = (m + a for m, a in zip(self.mass, self.added, strict=True))
        return surge, sway, heave, yaw

    def within_limits(self, wanted: Four) -> Four:
        """The thrust that the thrusters can give of what is `wanted`."""
        surge, sway, heave, yaw = (max(-m, min(m, force)) for force, m in zip(wanted, self.thrust, strict=True))
        together = abs(surge) + abs(sway) + abs(yaw) / self.yaw_arm_m
        share = min(1.0, self.shared_n / together) if together else 1.0
        return surge * share, sway * share, heave, yaw * share


# REMUS 100 (T. Prestero, "Verification of a Six-Degree of Freedom Simulation Model for the REMUS Autonomous Underwater
# Vehicle", MIT/WHOI, 2001): 30.48 kg, 1.33 m by 0.191 m, Izz 3.45 kg m2, added mass 0.93, 35.5 and 4.88, axial drag
# 1.62. Cross-flow drag 131 N s2/m2 (its Zww); in yaw 1/2 rho c d int |x|^3 dx = 10 with rho 1030, c 1.1. Its propeller
# gives 12 N. A torpedo cannot hold or back out in a current, so it has two transverse and two vertical tunnel thrusters
# of 25 N, 0.35 m before and behind the middle, as hovering variants of such vehicles do; the fins span 0.3 m.
AUV = VehicleModel(
    name="auv",
    mass=(30.48, 30.48, 30.48, 3.45),
    added=(0.93, 35.5, 35.5, 4.88),
    linear=(0.0, 0.0, 0.0, 0.0),
    quadratic=(1.62, 131.0, 131.0, 10.0),
    thrust=(12.0, 50.0, 50.0, 17.0),
    thruster_lag_s=0.2,
    half_m=(0.665, 0.15, 0.15),
    cruise_m_s=0.8,
    entry_m_s=0.35,
)
# BlueROV2 Heavy (M. von Benzon et al., "An Open-Source Benchmark Simulator: Control of a BlueROV2 Underwater Robot", J.
# Mar. Sci. Eng. 10, 1898, 2022): 13.5 kg, 0.46 by 0.58 by 0.38 m. Thrusters T200 at 16 V give 40 N backward
# (manufacturer's data): four at 45 degrees, 0.27 m from the middle, share surge, sway and yaw.
ROV = VehicleModel(
    name="rov",
    mass=(13.5, 13.5, 13.5, 0.37),
    added=(6.36, 7.12, 18.68, 0.222),
    linear=(13.7, 0.0, 33.0, 0.0),
    quadratic=(141.0, 217.0, 190.0, 1.5),
    thrust=(113.0, 113.0, 80.0, 12.0),
    thruster_lag_s=0.15,
    half_m=(0.23, 0.29, 0.19),
    cruise_m_s=0.7,
    entry_m_s=0.35,
    shared_n=113.0,
    yaw_arm_m=0.27,
)
VEHICLES = {vehicle.name: vehicle for vehicle in (AUV, ROV)}
_ROCKING_S = (4.0, 9.0)  # shortest and longest period of roll and pitch: swell


@dataclass(slots=True)
class Motion:
    """The true state: position of the body's centre in `approach`, heading, velocity through the water in `body`."""

    model: VehicleModel
    position: Three
    heading_rad: float
    through_water: Four = (0.0, 0.0, 0.0, 0.0)
    thrust: Four = (0.0, 0.0, 0.0, 0.0)
    over_ground: Four = field(default=(0.0, 0.0, 0.0, 0.0))  # in body

    def step(self, wanted: Four, current: Three, dt_s: float) -> None:
        """Move on by `dt_s` with the `wanted` thrust, in a `current` in `approach`; semi-implicit Euler."""
        model = self.model
        share = 1.0 - math.exp(-dt_s / model.thruster_lag_s)
        limited = model.within_limits(wanted)
        surge, sway, heave, yaw = (now + share * (to - now) for now, to in zip(self.thrust, limited, strict=True))
        self.thrust = (surge, sway, heave, yaw)
        coriolis = coriolis_of(model, self.through_water)
        new = [
            # drag at the new speed: stable for any step
            (speed + dt_s * (force + turning) / inertia) / (1.0 + dt_s * (linear + quadratic * abs(speed)) / inertia)
            for speed, force, turning, inertia, linear, quadratic in zip(
                self.through_water, self.thrust, coriolis, model.inertia, model.linear, model.quadratic, strict=True
            )
        ]
        self.through_water = (new[0], new[1], new[2], new[3])
        self.heading_rad += dt_s * new[3]
        c, s = math.cos(self.heading_rad), math.sin(self.heading_rad)
        forward = current[0] + c * new[0] - s * new[1]
        left = current[1] + s * new[0] + c * new[1]
        up = current[2] + new[2]
        x, y, z = self.position
        self.position = (x + dt_s * forward, y + dt_s * left, z + dt_s * up)
        self.over_ground = (c * forward + s * left, -s * forward + c * left, up, new[3])


def coriolis_of(model: VehicleModel, through_water: Four) -> Four:
    """Forces of turning, and the moment that turns a long hull across the flow, by mass and added mass."""
    u, v, _, r = through_water
    return (
        model.inertia[1] * v * r,
        -model.inertia[0] * u * r,
        0.0,
        (model.added[0] - model.added[1]) * u * v,
    )


def body_drag(model: VehicleModel, axis: int, speed: float) -> float:
    """Drag force of one degree of freedom at a speed through the water, N or N m."""
    return speed * (model.linear[axis] + model.quadratic[axis] * abs(speed))


def T_dock_cam_of(model: VehicleModel, position: Three, yaw_pitch_roll: Three) -> Array:
    """Pose of cam in dock (4, 4), of a body at `position` in `approach` that is turned by these angles, rad."""
    yaw, pitch, roll = yaw_pitch_roll
    cy, sy, cp, sp, cr, sr = (f(a) for a in (yaw, pitch, roll) for f in (math.cos, math.sin))
    R_approach_body = np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
    T_dock_cam = np.eye(4)
    T_dock_cam[:3, :3] = R_DOCK_APPROACH @ R_approach_body @ R_BODY_CAM_AHEAD
    T_dock_cam[:3, 3] = R_DOCK_APPROACH @ (np.array(position) + R_approach_body[:, 0] * model.half_m[0])
    return T_dock_cam


@dataclass(frozen=True, slots=True)
class Rocking:
    """Roll and pitch of a vehicle that its buoyancy holds upright: two sines each."""

    periods_s: Array
    phases: Array
    most_rad: float

    @classmethod
    def drawn(cls, most_rad: float, rng: np.random.Generator) -> Rocking:
        """Periods and phases of one docking."""
        return cls(rng.uniform(*_ROCKING_S, (2, 2)), rng.uniform(0.0, 2.0 * math.pi, (2, 2)), most_rad)

    def at(self, t_s: float) -> tuple[float, float]:
        """Pitch and roll, rad."""
        pitch, roll = (0.5 * self.most_rad * np.sin(2.0 * math.pi * t_s / self.periods_s + self.phases)).sum(axis=1)
        return float(pitch), float(roll)


@dataclass(slots=True)
class Current:
    """A horizontal current of constant mean, in `approach`, with turbulence that forgets itself in `memory_s`."""

    mean: Three
    sigma_m_s: float
    rng: np.random.Generator
    memory_s: float = 3.0  # eddies of a metre, carried by at 0.3 m/s
    eddy: Three = (0.0, 0.0, 0.0)

    def step(self, dt_s: float) -> Three:
        """The current `dt_s` later. Source: Ornstein-Uhlenbeck process, exact in time."""
        kept = math.exp(-dt_s / self.memory_s)
        new = self.sigma_m_s * math.sqrt(1.0 - kept * kept)
        x, y, z = (kept * old + new * float(self.rng.normal()) for old in self.eddy)
        self.eddy = (x, y, z)
        return self.mean[0] + x, self.mean[1] + y, self.mean[2] + z
