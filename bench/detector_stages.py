"""At which stage of the detector a light is lost: live tiles, maxima, planes, centroids, lights, `p_light`.

A light counts as kept by a stage while a blob is left within reach of it.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bench.detection import by_frame
from bench.lamp_scenes import SCENES, render
from lumidock import detect, lamp
from lumidock._kernels.detection import blobs
from lumidock._kernels.detection.blobs import CORE_BOTTOM, CORE_LEFT, CORE_RIGHT, CORE_TOP, LEFT, TOP, U0, V0
from lumidock.config import DetectConfig
from lumidock.datatypes import Array, Frame, Indices
from lumidock.picture import in_color
from lumidock.streams.sources import open_source

STAGES = ("in live tiles", "maxima", "one per plane", "centroids", "one per light", "p_light over 0.5")
LEAST_SNR = 8.0
_NEAR_PX, _NEAR_SHARE = 2.5, 0.5  # within which a blob is of a light: px, or this share of its own size


class Lost(NamedTuple):
    """Of one frame: which lights (M,) each stage of `STAGES` keeps, and detections over 0.5 that are of no light."""

    kept: list[np.ndarray]
    false: int


def stages(frame: Frame, uv: Array, config: DetectConfig) -> Lost:
    """What each stage keeps of the lights at pixels `uv` (M, 2) of a frame with square pixels."""
    image, scan = in_color(frame), detect.Scan(frame, config)
    views = detect.everywhere(image, scan)
    patches = np.concatenate([view.patches for view in views])
    rows = detect.candidates(views, patches, scan)
    alone = detect.one_per_plane(rows, image.shape, config)
    found = detect.measured(views, patches, alone, image.shape, config)
    seen = detect.seen(frame, scan)
    assert seen is not None
    lamps = seen.rows[lamp.likelihood(seen) > 0.5]
    searched = views[-1].patches[: len(views[-1].patches) - views[-1].unsearched]
    kept = [_in_cores(searched, uv)] + [near(part, uv) for part in (rows, alone, found.rows, seen.rows, lamps)]
    others = np.linalg.norm(lamps[:, None, [blobs.U, blobs.V]] - uv[None], axis=2).min(axis=1, initial=np.inf)
    return Lost(kept, int((others > np.maximum(_NEAR_PX, lamps[:, blobs.SIZE])).sum()))


def near(rows: Array, uv: Array) -> np.ndarray:
    """Whether a blob lies near each place (M, 2)."""
    away = np.linalg.norm(uv[:, None] - rows[None][:, :, [blobs.U, blobs.V]], axis=2)
    return np.asarray(np.any(away < np.maximum(_NEAR_PX, _NEAR_SHARE * rows[:, blobs.SIZE]), axis=1))


def _in_cores(fine: Indices, uv: Array) -> np.ndarray:
    """Whether a place (M, 2) lies in the core of a patch."""
    at = uv[:, None] - fine[None, :, [U0, V0]] + fine[None, :, [LEFT, TOP]]
    low, high = fine[:, [CORE_LEFT, CORE_TOP]], fine[:, [CORE_RIGHT, CORE_BOTTOM]]
    return np.asarray(((at >= low - 0.5) & (at < high)).all(axis=2).any(axis=1))


def lit(folder: Path) -> Iterator[tuple[Frame, Array]]:
    """Frames of a rendered scene with the pixels of their lights over the least SNR."""
    truth = by_frame(folder / "lights_truth.csv")
    for frame in open_source(folder).items():
        assert isinstance(frame, Frame)
        rows = [row for row in truth[frame.name] if float(row["snr"] or 0.0) > LEAST_SNR]
        yield frame, np.array([[float(row["u_px"]), float(row["v_px"])] for row in rows]).reshape(-1, 2)


def main(out: Path = Path("scenes")) -> tuple[dict[str, object], list[str]]:
    """A row a scene."""
    content: dict[str, object] = {}
    lines = ["| scene | lights | " + " | ".join(STAGES) + " | others over 0.5 a frame |", "|---" * 9 + "|"]
    for name in SCENES:
        frames = [stages(frame, uv, DetectConfig()) for frame, uv in lit(render(name, out))]
        kept = [int(sum(f.kept[k].sum() for f in frames)) for k in range(len(STAGES))]
        count, false = sum(len(f.kept[0]) for f in frames), sum(f.false for f in frames) / len(frames)
        content[name] = {"lights": count, "kept": kept, "false": false}
        lines.append(f"| {name} | {count} | " + " | ".join(f"{k}" for k in kept) + f" | {false:.2f} |")
        print(lines[-1], flush=True)
    return content, lines


if __name__ == "__main__":
    print("\n".join(main(Path(sys.argv[1]))[1]))
