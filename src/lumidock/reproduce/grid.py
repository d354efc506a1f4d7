"""How much is computed: minutes, or hours."""

from __future__ import annotations

from dataclasses import dataclass

WATERS = ("pure-sea", "IB", "II", "III", "1C", "3C", "5C", "7C", "pool-clear", "pool-murky")  # of the simulator


@dataclass(frozen=True, slots=True)
class Grid:
    """What is computed; seeds are consecutive from `first_seed`, and the same grid gives the same numbers."""

    name: str
    trials: int  # of a row of Table 1, on the dock as given
    layout_trials: int  # the same, on the other layouts
    trials_a_job: int
    table_interval_s: float  # between the rendered frames of Table 1
    ablation_trials: int  # of each change, and of each size of the swarm
    draws: int  # poses at each distance, and of each acquisition
    compared: int  # frames of each condition that all baselines see
    tuned: int  # candidates of the race for the swarm's coefficients; a power of two
    extraction_frames: int  # at each distance, in each water
    dockings: int  # rendered approaches
    docking_interval_s: float
    search_interval_s: float
    waters: tuple[str, ...]
    exposures_ms: tuple[float, ...]
    envelope_seeds: int
    envelope_interval_s: float
    daylight_w_m2: tuple[float, ...]  # below the surface; noon under a clear sky 100, the default 60
    shipped: tuple[str, ...]  # scenarios that are rendered beside the paper's
    point_seeds: int  # of every shipped docking at point level
    rendered_seeds: int  # of every shipped docking; 0: one of those in `shipped`
    first_seed: int = 41_000


QUICK = Grid(
    name="quick",
    trials=4,
    layout_trials=2,
    trials_a_job=1,
    table_interval_s=1.0,
    ablation_trials=1,
    draws=100,
    compared=40,
    tuned=32,
    extraction_frames=1,
    dockings=1,
    docking_interval_s=0.15,
    search_interval_s=1.0,
    waters=WATERS,
    exposures_ms=(2.0, 6.0),
    envelope_seeds=1,
    envelope_interval_s=1.5,
    daylight_w_m2=(0.0, 600.0),
    shipped=("vehicle", "swapped-colors"),
    point_seeds=2,
    rendered_seeds=0,
)
FULL = Grid(
    name="full",
    trials=30,
    layout_trials=30,
    trials_a_job=2,
    table_interval_s=0.15,
    ablation_trials=30,
    draws=1000,
    compared=500,
    tuned=64,
    extraction_frames=10,
    dockings=3,
    docking_interval_s=0.15,
    search_interval_s=0.5,
    waters=WATERS,
    exposures_ms=(1.0, 2.0, 4.0, 8.0),
    envelope_seeds=2,
    envelope_interval_s=0.15,
    daylight_w_m2=(0.0, 100.0, 600.0, 2000.0),
    shipped=(),
    point_seeds=20,
    rendered_seeds=2,
)
