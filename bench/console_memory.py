"""The memory of a server that three consoles look at, one of them stalled, over ten minutes."""

from __future__ import annotations

import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from bench.console import pages, simulate
from bench.console_pictures import started

_MINUTES, _SAMPLE_S = 10, 5.0
_SETTLING_S = 30.0  # until the first pass over the recording has filled every buffer


def resident_mb(pid: int) -> float:
    """Memory of a process that is in use, MB."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return int(next(line.split()[1] for line in lines if line.startswith("VmRSS"))) / 1024.0


def main() -> tuple[dict[str, object], list[str]]:
    """Serve, look on, and weigh."""
    with TemporaryDirectory() as name:
        sequence = Path(name) / "sequence"
        simulate(sequence)
        with started("serve", sequence, "--loop", "--health-port", 0) as (address, pid):
            port = int(address.partition("#")[0].rstrip("/").rpartition(":")[2])
            with pages(port):
                time.sleep(_SETTLING_S)
                began, samples = time.monotonic(), list[tuple[float, float]]()
                while (at_s := time.monotonic() - began) < 60.0 * _MINUTES:
                    samples.append((at_s, resident_mb(pid)))
                    time.sleep(_SAMPLE_S)
    minutes, used = np.array(samples).T / np.array([[60.0], [1.0]])
    first, last = used[minutes < 1].max(), used[minutes >= _MINUTES - 1].max()
    slope = np.polyfit(minutes[minutes >= 1], used[minutes >= 1], 1)[0]
    lines = [
        "| most in the first minute, MB | most in the tenth minute, MB | slope after the first minute, MB a minute |",
        "|---|---|---|",
        f"| {first:.0f} | {last:.0f} | {slope:+.2f} |",
    ]
    return {"samples": samples}, lines
