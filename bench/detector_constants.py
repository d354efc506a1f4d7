"""What each constant of the detector changes: every one halved and doubled, on scenes that no weight was fitted on."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from bench.detection import by_frame, matches
from bench.lamp_scenes import render
from lumidock import detect
from lumidock.config import DetectConfig
from lumidock.datatypes import Frame
from lumidock.streams.sources import open_source

_SCENES = ("funnel-3-9", "plate-4")
_LEAST_SNR = 8.0


def measure(frames: list[tuple[Frame, np.ndarray]], config: DetectConfig) -> tuple[float, float, float, float, float]:
    """Lights found %, rms px, NEES / 2, lamps over 0.5 %, others over 0.5 a frame."""
    found, wanted, lamps, false = 0, 0, 0, 0
    square, nees = [], []
    for frame, lit in frames:
        detections = detect.lights(frame, config)
        owner = matches(detections, lit)
        mine = np.flatnonzero(owner >= 0)
        assert detections.cov_px2 is not None
        error = detections.uv[mine] - lit[owner[mine]]
        square += (error**2).sum(axis=1).tolist()
        nees += (np.einsum("ni,nij,nj->n", error, np.linalg.inv(detections.cov_px2[mine]), error) / 2.0).tolist()
        wanted, found = wanted + len(lit), found + len(mine)
        lamps += int((detections.p_light[mine] > 0.5).sum())
        false += int((detections.p_light[owner < 0] > 0.5).sum())
    rms = float(np.sqrt(np.mean(square)))
    return 100.0 * found / wanted, rms, float(np.mean(nees)), 100.0 * lamps / max(found, 1), false / len(frames)


def load(out: Path) -> list[tuple[Frame, np.ndarray]]:
    """Frames and the pixels of their lights of enough SNR."""
    frames = []
    for name in _SCENES:
        folder = render(name, out)
        truth = by_frame(folder / "lights_truth.csv")
        for frame in open_source(folder).items():
            assert isinstance(frame, Frame)
            rows = [row for row in truth[frame.name] if float(row["snr"] or 0.0) > _LEAST_SNR]
            lit = np.array([[float(row["u_px"]), float(row["v_px"])] for row in rows]).reshape(-1, 2)
            frames.append((frame, lit))
    return frames


def main(out: Path = Path("scenes")) -> tuple[dict[str, object], list[str]]:
    """A row a constant."""
    frames, config = load(out), DetectConfig()
    content: dict[str, object] = {"as shipped": measure(frames, config)}
    for name in DetectConfig.model_fields:
        value = getattr(config, name)
        for factor in (0.5, 2.0):
            other = type(value)(
                min(value * factor, 1.0) if isinstance(value, float) and value <= 1.0 else value * factor
            )
            content[f"{name} {value:g} -> {other:g}"] = measure(frames, config.model_copy(update={name: other}))
    lines = [
        "| constant | found, % | rms, px | NEES / 2 | lamps over 0.5, % | others over 0.5 |",
        "|---|---|---|---|---|---|",
    ]
    for name, row in content.items():
        assert isinstance(row, tuple)
        lines.append(f"| {name} | " + " | ".join(f"{value:.2f}" for value in row) + " |")
    return content, lines


if __name__ == "__main__":
    print("\n".join(main(Path(sys.argv[1]))[1]))
