"""What a source holds: its frames' sizes, rates, gaps and exposure, held against a calibration."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import islice
from typing import Any

import numpy as np

from lumidock.camera import Camera
from lumidock.datatypes import Frame, Unusable
from lumidock.picture import encoding_of
from lumidock.streams.source import Source

_GAP = 1.5  # an interval of that many median ones has lost a frame
_LEAST_BITS = 9  # of pixels of 16 that are from a sensor and not from a dark picture
_SATURATED, _SPARSE = 250, 7  # of 255; every so many pixels and rows, odd to meet every colour of a mosaic


@dataclass(slots=True)
class _Seen:
    frames: int = 0
    unusable: Counter[str] = field(default_factory=Counter)
    first_problem: str = ""
    sizes: Counter[tuple[int, int, str]] = field(default_factory=Counter)
    t_ns: list[int] = field(default_factory=list)
    median_level: list[float] = field(default_factory=list)
    saturated: list[float] = field(default_factory=list)
    deep: int = 0  # every bit that any pixel of 16 bits has

    def add(self, frame: Frame) -> None:
        height, width = frame.image.shape[:2]
        self.sizes[width, height, encoding_of(frame)] += 1
        sparse = frame.image[::_SPARSE, ::_SPARSE]
        if sparse.dtype == np.uint16:
            self.deep |= int(np.bitwise_or.reduce(sparse, axis=None))
        sparse = sparse if sparse.dtype == np.uint8 else sparse >> 8
        self.median_level.append(float(np.median(sparse)))
        self.saturated.append(float((sparse >= _SATURATED).mean()))


def inspect(
    source: Source,
    camera: Camera | None,
    *,
    most: int | None = None,
    progress: Callable[[int, int | None], None] = lambda _done, _total: None,
) -> dict[str, Any]:
    """Read a source, `most` frames of it, and say what is in it; `camera` is the calibration that it should fit."""
    seen = _Seen()
    for item in islice(source.items(), most):
        seen.frames += 1
        if item.t_ns is not None:
            seen.t_ns.append(item.t_ns)
        if isinstance(item, Unusable):
            seen.unusable[item.reason] += 1
            seen.first_problem = seen.first_problem or item.text
        elif isinstance(item, Frame):
            seen.add(item)
        progress(seen.frames, source.count)
    return {
        "kind": source.kind,
        "frames": seen.frames,
        "unusable": dict(seen.unusable),
        "first_problem": seen.first_problem,
        "sizes": [
            {"width": width, "height": height, "encoding": encoding, "frames": count}
            for (width, height, encoding), count in seen.sizes.most_common()
        ],
        "bits": seen.deep.bit_length() if _LEAST_BITS <= seen.deep.bit_length() < 16 else None,
        "calibration": _fit(seen, camera),
        "time": intervals(seen.t_ns),
        "exposure": {"median_level": _middle(seen.median_level), "saturated": _middle(seen.saturated)},
    }


def intervals(t_ns: list[int]) -> dict[str, Any]:
    """Span, rate, gaps and drops of a series of stamps; the rate is that of the median interval."""
    if len(t_ns) < 2:
        return {"first_ns": t_ns[0] if t_ns else None, "rate_hz": None}
    steps = np.diff(np.array(t_ns, np.int64)).astype(float)
    forward = steps[steps > 0]
    median = float(np.median(forward)) if len(forward) else np.nan
    gaps = forward[forward > _GAP * median]
    return {
        "first_ns": t_ns[0],
        "span_s": float(t_ns[-1] - t_ns[0]) * 1e-9,
        "rate_hz": 1e9 / median if len(forward) else None,
        "jitter_ms": float(np.std(forward[forward <= _GAP * median])) * 1e-6 if len(forward) else None,
        "gaps": len(gaps),
        "longest_gap_s": float(gaps.max()) * 1e-9 if len(gaps) else 0.0,
        "drops": int(np.round(gaps / median - 1.0).sum()) if len(gaps) else 0,
        "out_of_order": int((steps <= 0).sum()),
    }


def _fit(seen: _Seen, camera: Camera | None) -> dict[str, Any] | None:
    if camera is None:
        return None
    others = sum(count for (*size, _), count in seen.sizes.items() if size != [camera.width, camera.height])
    return {"width": camera.width, "height": camera.height, "frames_of_another_size": others}


def _middle(values: list[float]) -> float | None:
    return float(np.median(values)) if values else None
