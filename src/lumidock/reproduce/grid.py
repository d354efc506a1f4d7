"""How much is computed: minutes, or hours."""

from __future__ import annotations

from dataclasses import dataclass

# absorption and scattering 1/m at 455, 530, 610 nm.
# Source: Williamson & Hollins 2022; Solonenko & Mobley 2015.
WATERS = {
    "pure sea": ((0.0119, 0.0429, 0.269), (0.0043, 0.0022, 0.0012)),
    "IB": ((0.040, 0.052, 0.273), (0.134, 0.124, 0.117)),
    "II": ((0.061, 0.061, 0.277), (0.194, 0.180, 0.168)),
    "III": ((0.107, 0.081, 0.287), (0.308, 0.291, 0.277)),
    "1C": ((0.141, 0.095, 0.294), (0.454, 0.432, 0.413)),
    "3C": ((0.191, 0.128, 0.314), (0.684, 0.652, 0.624)),
    "5C": ((0.295, 0.169, 0.333), (1.27, 1.21, 1.16)),
    "7C": ((0.511, 0.225, 0.327), (3.24, 2.50, 1.97)),
}


@dataclass(frozen=True, slots=True)
class Grid:
    """What is computed; seeds are consecutive from `first_seed`, and the same grid gives the same numbers."""

    name: str
    trials: int  # of a row of Table 1
    trials_a_job: int
    draws: int  # poses at each distance, and of each cold start
    dockings: int  # rendered approaches
    docking_interval_s: float
    search_interval_s: float
    waters: tuple[str, ...]
    exposures_ms: tuple[float, ...]
    envelope_seeds: int
    envelope_interval_s: float
    daylight: tuple[float, ...]  # times the default
    point_seeds: int  # of every shipped docking at point level
    rendered_seeds: int  # of every shipped docking that is rendered
    first_seed: int = 41_000


QUICK = Grid(
    name="quick",
    trials=6,
    trials_a_job=3,
    draws=100,
    dockings=1,
    docking_interval_s=0.15,
    search_interval_s=1.0,
    waters=tuple(WATERS),
    exposures_ms=(2.0, 6.0),
    envelope_seeds=1,
    envelope_interval_s=1.5,
    daylight=(0.0, 10.0),
    point_seeds=2,
    rendered_seeds=0,
)
FULL = Grid(
    name="full",
    trials=30,
    trials_a_job=2,
    draws=1000,
    dockings=3,
    docking_interval_s=0.15,
    search_interval_s=0.5,
    waters=tuple(WATERS),
    exposures_ms=(1.0, 2.0, 4.0, 8.0),
    envelope_seeds=2,
    envelope_interval_s=0.15,
    daylight=(0.0, 3.0, 10.0, 30.0),
    point_seeds=20,
    rendered_seeds=2,
)
