"""Faults of the stream of frames: lost, frozen, duplicated, disordered, truncated and blank frames, and clock jumps."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lumidock.sim.knobs import StreamFaults

OVER_EXPOSED = 50.0  # factor on the exposure of a frame with the fault `over_exposed`
_SPOILT = ("half_written", "black", "white", "over_exposed")


@dataclass(frozen=True, slots=True)
class Row:
    """One row of timestamps.csv: frame `number`, its stamp `t_ns` and its `fault`, if any.

    `shows` is the number of the frame whose picture is in its file: another one while the stream is frozen.
    """

    number: int
    shows: int
    t_ns: int
    fault: str = ""

    @property
    def name(self) -> str:
        """The frame's name in all files of the sequence."""
        return f"{self.number:06d}"


def rows_of(knobs: StreamFaults, t_ns: np.ndarray, rng: np.random.Generator) -> list[Row]:
    """The rows of a sequence of N frames taken at `t_ns` (N,), with faults drawn from `rng`."""
    jumps = np.cumsum(rng.random(len(t_ns)) < knobs.clock_jumps)
    stamps = t_ns + np.round(jumps * knobs.clock_jump_s * 1e9).astype(np.int64)
    rows: list[Row] = []
    frozen_until, held = -1, 0
    for number, draw in enumerate(rng.random((len(t_ns), 8))):
        row = Row(number, number, int(stamps[number]))
        if number > frozen_until and number > 0 and draw[0] < knobs.frozen:
            frozen_until, held = number + knobs.frozen_frames - 1, number - 1
        if number <= frozen_until:
            row = replace(row, shows=held, fault="frozen")
        for kind, value in zip(_SPOILT, draw[4:], strict=True):
            if not row.fault and value < getattr(knobs, kind):
                row = replace(row, fault=kind)
        if draw[1] < knobs.dropped:
            continue
        rows.append(row)
        if draw[2] < knobs.duplicated:
            rows.append(replace(row, fault=row.fault or "duplicated"))
        if draw[3] < knobs.disordered and len(rows) > 1:
            rows[-2:] = [rows[-1], replace(rows[-2], fault=rows[-2].fault or "disordered")]
    return rows
