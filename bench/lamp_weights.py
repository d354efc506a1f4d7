"""Fit `p_light`: a logistic model of the features in `lumidock.lamp`, on rendered scenes with and without matter.

A blob is a lamp where a light that is lit stands, and none elsewhere; mirror images and foreign lamps, which look like
lamps because they are, do not count. Every scene has the same weight. Scenes held out give the reliability table.
"""

from __future__ import annotations

import csv
import json
import sys
from collections import defaultdict
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bench.lamp_scenes import SCENES, render
from bench.shipped import PACKAGE
from lumidock import detect, lamp
from lumidock.config import DetectConfig
from lumidock.datatypes import Array, Frame, Indices
from lumidock.streams.sources import open_source

_LEAST_SNR, _NEAR_PX, _NEAR_SHARE = 4.0, 3.0, 0.6
_APART_PX = 4.0
_NOT_COUNTED = ("mirror", "injected", "beacon", "vehicle")
_FRAMES, _LAMPS = 20.0, 3.0  # of every scene; weight of a lamp over that of another blob: a false one harms less
_RIDGE, _ROUNDS = 10.0, 30  # inverse prior variance of a standardised feature's weight; Newton steps
_BINS = (0.0, 0.05, 0.2, 0.4, 0.6, 0.8, 0.95, 1.0)


class Examples(NamedTuple):
    """Blobs of one scene: features (N, F) by `names`, whether each is a lamp (N,), whether it counts, and frames."""

    names: tuple[str, ...]
    x: Array
    lamp: Array
    counts: Array
    frames: int


def _by_frame(path: Path) -> dict[str, list[dict[str, str]]]:
    rows: dict[str, list[dict[str, str]]] = defaultdict(list)
    with path.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            rows[row["frame"]].append(row)
    return rows


def _places(rows: list[dict[str, str]]) -> Array:
    return np.array([[float(row["u_px"]), float(row["v_px"])] for row in rows]).reshape(-1, 2)


def examples(folder: Path) -> Examples:
    """What the detector sees in a sequence folder with truth."""
    truth, apart = _by_frame(folder / "lights_truth.csv"), _by_frame(folder / "spurious_truth.csv")
    x, is_lamp, counts, names, frames = [], [], [], (), 0
    for frame, seen in _seen(folder):
        found = lamp.features(seen)
        uv, size = seen.rows[:, [lamp.blobs.U, lamp.blobs.V]], seen.rows[:, lamp.blobs.SIZE]
        lit = _places([row for row in truth[frame] if float(row["snr"] or 0.0) > _LEAST_SNR])
        others = _places([row for row in apart[frame] if row["kind"] in _NOT_COUNTED])
        mine = _nearest(uv, lit, np.maximum(_NEAR_PX, _NEAR_SHARE * size))
        names, frames = tuple(found), frames + 1
        x.append(np.column_stack(list(found.values())))
        is_lamp.append(mine)
        counts.append(mine | ~_close(uv, others, _APART_PX + size))
    return Examples(names, np.concatenate(x), np.concatenate(is_lamp), np.concatenate(counts), frames)


def _seen(folder: Path) -> Iterator[tuple[str, lamp.Seen]]:
    config = DetectConfig()
    for frame in open_source(folder).items():
        if isinstance(frame, Frame):
            yield frame.name, detect.seen(frame, detect.Scan(frame, config))


def _nearest(uv: Array, lit: Array, reach: Array) -> Indices:
    """Which blobs (N,) are the nearest to a light, within their reach."""
    mine = np.zeros(len(uv), np.bool_)
    for place in lit if len(uv) else ():
        away = np.linalg.norm(uv - place, axis=1)
        if away.min() < reach[away.argmin()]:
            mine[away.argmin()] = True
    return mine


def _close(uv: Array, others: Array, reach: Array) -> Array:
    if not len(others):
        return np.zeros(len(uv), np.bool_)
    return np.asarray(np.linalg.norm(uv[:, None] - others[None], axis=2).min(axis=1) < reach)


def fit(sets: list[Examples]) -> tuple[Array, float]:
    """Weights and constant by Newton's method, with a ridge on standardised features."""
    x = np.concatenate([s.x[s.counts] for s in sets])
    y = np.concatenate([s.lamp[s.counts] for s in sets]).astype(float)
    w = np.concatenate([np.full(int(s.counts.sum()), _FRAMES / s.frames) for s in sets]) * np.where(
        y > 0.0, _LAMPS, 1.0
    )
    middle = np.average(x, axis=0, weights=w)
    spread = np.sqrt(np.average((x - middle) ** 2, axis=0, weights=w)) + 1e-6
    z = np.column_stack([(x - middle) / spread, np.ones(len(x))])
    ridge = np.diag([_RIDGE] * x.shape[1] + [0.0])
    b = np.zeros(z.shape[1])
    for _ in range(_ROUNDS):
        p = 1.0 / (1.0 + np.exp(-z @ b))
        hessian = (z * (w * p * (1.0 - p))[:, None]).T @ z + ridge
        b += np.linalg.solve(hessian, z.T @ (w * (y - p)) - ridge @ b)
    weights = b[:-1] / spread
    return weights, float(b[-1] - middle @ weights)


def score(s: Examples, weights: Array, constant: float) -> tuple[float, float]:
    """Share of the lamps with a probability over one half, and others of a frame that have one too."""
    p = 1.0 / (1.0 + np.exp(-(s.x @ weights + constant)))
    return float((p[s.lamp] > 0.5).mean()), float(((p > 0.5) & ~s.lamp & s.counts).sum()) / s.frames


def reliability(sets: list[Examples], weights: Array, constant: float) -> list[tuple[float, float, int]]:
    """Mean probability, share of lamps and number of blobs in each bin of probability."""
    p = np.concatenate([1.0 / (1.0 + np.exp(-(s.x[s.counts] @ weights + constant))) for s in sets])
    y = np.concatenate([s.lamp[s.counts] for s in sets])
    rows = []
    for low, high in pairwise(_BINS):
        inside = (p >= low) & ((p < high) | (high == 1.0))
        if inside.any():
            rows.append((float(p[inside].mean()), float(y[inside].mean()), int(inside.sum())))
    return rows


def main(out: Path = Path("scenes"), most: int | None = None) -> tuple[dict[str, object], list[str]]:
    """Fit, write the weights into the package, and report every scene and the reliability of those held out."""
    sets = {name: examples(render(name, out)) for name in list(SCENES)[:most]}
    fitted = [s for name, s in sets.items() if not SCENES[name].held_out]
    held = [s for name, s in sets.items() if SCENES[name].held_out]
    weights, constant = fit(fitted)
    write(fitted[0].names, weights, constant)
    lines = ["| scene | lamps over 0.5, % | others over 0.5 a frame |", "|---|---|---|"]
    for name, s in sets.items():
        lamps, others = score(s, weights, constant)
        lines.append(f"| {name}{' (held out)' if SCENES[name].held_out else ''} | {100 * lamps:.1f} | {others:.2f} |")
    lines += ["", "| mean p_light, held out | lamps, share | blobs |", "|---|---|---|"]
    table = reliability(held, weights, constant)
    lines += [f"| {p:.3f} | {share:.3f} | {count} |" for p, share, count in table]
    return {"reliability": table}, lines


def write(names: tuple[str, ...], weights: Array, constant: float) -> None:
    """Put the model into the package."""
    model = {
        "about": "Logistic model of p_light; made by bench.lamp_weights",
        "constant": round(constant, 4),
        "weights": {name: round(float(weight), 4) for name, weight in zip(names, weights, strict=True)},
    }
    (PACKAGE / lamp.MODEL).write_text(json.dumps(model, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    print("\n".join(main(Path(sys.argv[1]))[1]))
