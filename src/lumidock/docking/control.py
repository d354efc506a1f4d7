"""From a wanted velocity and heading to thrust: speed loops with drag and turning forces fed forward.

All gains follow from the vehicle.

The speed loop has a quarter of the bandwidth of the thrusters, the loop of position or heading around it a quarter of
that: each is then critically damped (a cascade of first-order lags 1/T and gain 1/(4 T) has a double pole at -1/(2 T)).
Its integral carries what the model does not know, with a quarter of the square of its gain.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from lumidock.docking.instruments import Reading
from lumidock.docking.vehicle import Four, Three, VehicleModel, body_drag, coriolis_of

_CURRENT_MEMORY_S = 3.0  # over which the estimate of the current is smoothed: that of turbulence


@dataclass(frozen=True, slots=True)
class Wanted:
    """Velocity over ground in `approach`, m/s, and heading, rad."""

    velocity: Three
    heading_rad: float


@dataclass(slots=True)
class Controller:
    """The loops of one vehicle; `current` is its estimate of the water's velocity in `approach`."""

    model: VehicleModel
    integral: Four = (0.0, 0.0, 0.0, 0.0)
    thrust: Four = (0.0, 0.0, 0.0, 0.0)
    through_water: Four = (0.0, 0.0, 0.0, 0.0)  # as the model has it under the thrust given
    current: Three = (0.0, 0.0, 0.0)

    @property
    def speed_gain(self) -> float:
        """Of the speed loops, 1/s."""
        return 1.0 / (4.0 * self.model.thruster_lag_s)

    @property
    def position_gain(self) -> float:
        """Of the loops of position and heading, 1/s."""
        return self.speed_gain / 4.0

    def step(self, wanted: Wanted, reading: Reading, heading_rad: float, dt_s: float) -> Four:
        """Thrust for the next `dt_s`."""
        c, s = math.cos(heading_rad), math.sin(heading_rad)
        x, y, z = wanted.velocity
        turn = self.position_gain * math.remainder(wanted.heading_rad - heading_rad, 2.0 * math.pi)
        targets = (c * x + s * y, -s * x + c * y, z, turn)
        fx, fy, fz = (want - flow for want, flow in zip(wanted.velocity, self.current, strict=True))
        through = (c * fx + s * fy, -s * fx + c * fy, fz, turn)
        measured = (*reading.over_ground, reading.yaw_rate)
        water = (c * self.current[0] + s * self.current[1], -s * self.current[0] + c * self.current[1])
        flow = (measured[0] - water[0], measured[1] - water[1], 0.0, measured[3])
        coriolis = coriolis_of(self.model, flow)
        forces, sums = [], []
        for axis in range(4):
            miss = targets[axis] - measured[axis]
            inertia, most = self.model.inertia[axis], self.model.thrust[axis]
            push = inertia * self.speed_gain * miss + body_drag(self.model, axis, through[axis]) - coriolis[axis]
            total = push + self.integral[axis]
            grows = 0.25 * inertia * self.speed_gain**2 * miss * dt_s
            saturated = abs(total) > most and total * miss > 0.0
            sums.append(self.integral[axis] + (0.0 if saturated else grows))
            forces.append(max(-most, min(most, total)))
        self.integral = (sums[0], sums[1], sums[2], sums[3])
        self.thrust = self.model.within_limits((forces[0], forces[1], forces[2], forces[3]))
        self._estimate_current(reading, heading_rad, dt_s)
        return self.thrust

    def _estimate_current(self, reading: Reading, heading_rad: float, dt_s: float) -> None:
        """The water moves as the vehicle does over ground less what its thrust moves it through the water."""
        model = self.model
        self.through_water = tuple(  # type: ignore[assignment]
            (speed + dt_s * force / inertia) / (1.0 + dt_s * (linear + quadratic * abs(speed)) / inertia)
            for speed, force, inertia, linear, quadratic in zip(
                self.through_water, self.thrust, model.inertia, model.linear, model.quadratic, strict=True
            )
        )
        u, v, w = (ground - water for ground, water in zip(reading.over_ground, self.through_water[:3], strict=True))
        c, s = math.cos(heading_rad), math.sin(heading_rad)
        share = 1.0 - math.exp(-dt_s / _CURRENT_MEMORY_S)
        now, old = (c * u - s * v, s * u + c * v, w), self.current
        self.current = (
            old[0] + share * (now[0] - old[0]),
            old[1] + share * (now[1] - old[1]),
            old[2] + share * (now[2] - old[2]),
        )
