"""A campaign's table: a row for each scenario and method, as data and as Markdown."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from lumidock.evaluation.claims import GUIDE_ERRORS, POSE_ERRORS
from lumidock.evaluation.counts import Tally

_DEG = 180.0 / np.pi
_MOST_REASONS = 3


def row_of(tally: Tally) -> dict[str, Any]:
    """One row of the table: all counts, and what follows from them; angles in degrees, NEES with its frames."""
    errors = {}
    for name in (*POSE_ERRORS, *GUIDE_ERRORS):
        unit, scale = ("deg", _DEG) if name in ("angle", "bearing") else ("m", 1.0)
        errors[f"{name}_{unit}"] = _error_row(tally, name, scale)
    back = {
        word: {"median": tally.quantile(f"frames_back_{word}", 0.5), "max": tally.largest.get(f"frames_back_{word}")}
        for word in ("valid", "guide")
    }
    total = [sum(values) for values in zip(*tally.nees.values(), strict=True)] or [0, 0.0]
    return {
        "counts": dict(sorted(tally.counts.items())),
        "errors": errors,
        "nees": {stage: _mean(*values) for stage, values in [("all", total), *sorted(tally.nees.items())]},
        "longest_gap_s": {word: tally.largest.get(f"gap_s_{word}") for word in ("valid", "guide")},
        "frames_back": back,
    }


def _error_row(tally: Tally, name: str, scale: float) -> dict[str, float | None]:
    """Median, 95 % and largest error and the median level, by `scale`; and the level over the 95 % error."""
    p50, p95 = (tally.quantile(f"error_{name}", share) for share in (0.5, 0.95))
    level, worst = tally.quantile(f"level_{name}", 0.5), tally.largest.get(f"error_{name}")
    values = {"median": p50, "p95": p95, "max": worst, "level_median": level}
    scaled = {key: None if value is None else value * scale for key, value in values.items()}
    return scaled | {"level_over_p95": level / p95 if level and p95 else None}


def _mean(frames: float, total: float) -> dict[str, float | None]:
    return {"frames": frames, "mean": total / frames if frames else None}


def markdown(table: dict[str, Any]) -> str:
    """The table for people: availability and identities, integrity, errors, protection levels, and gaps."""
    faults = [row for row in table["rows"] if row.get("assumptions")]
    parts = [
        f"Seeds {table['seeds'][0]} to {table['seeds'][1] - 1}{', every frame without history' * table['cold']}; "
        f"lumidock {table['lumidock']}.",
        *([fault_table(faults)] if faults else []),
        *(_section(title, columns, table["rows"]) for title, columns in _SECTIONS.items()),
    ]
    return "\n\n".join(parts) + "\n"


def fault_table(rows: list[dict[str, Any]]) -> str:
    """What becomes of each fault: the table of a campaign of scenarios that say whether they keep the assumptions."""
    order = {side: k for k, side in enumerate(("inside", "edge", "outside"))}
    lines = [f"| fault | {' | '.join(_FAULTS)} |", "|---|" + "---|" * len(_FAULTS)]
    for row in sorted(rows, key=lambda row: order[row["assumptions"]]):
        name = row["scenario"].rpartition("/")[2]
        lines.append(f"| {name} | {' | '.join(column(row) for column in _FAULTS.values())} |")
    return "\n".join(lines)


def _section(title: str, columns: dict[str, Callable[[dict[str, Any]], str]], rows: list[dict[str, Any]]) -> str:
    lines = [f"**{title}**", "", f"| scenario | method | {' | '.join(columns)} |", "|---|---|" + "---|" * len(columns)]
    for row in rows:
        cells = [row["scenario"].replace("|", "/"), row["method"], *(column(row) for column in columns.values())]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _count(name: str) -> Callable[[dict[str, Any]], str]:
    return lambda row: str(row["counts"].get(name, 0))


def _percent(part: str, whole: str) -> Callable[[dict[str, Any]], str]:
    def cell(row: dict[str, Any]) -> str:
        among = row["counts"].get(whole, 0)
        return f"{100.0 * row['counts'].get(part, 0) / among:.3f}" if among else "-"

    return cell


def _of(part: str, whole: str) -> Callable[[dict[str, Any]], str]:
    return lambda row: f"{row['counts'].get(part, 0)} of {row['counts'].get(whole, 0)}"


def _number(*path: str, digits: int = 3) -> Callable[[dict[str, Any]], str]:
    def cell(row: dict[str, Any]) -> str:
        value: Any = row
        for key in path:
            value = value.get(key) if value else None
        return "-" if value is None else f"{value:.{digits}f}"

    return cell


def _error(name: str) -> Callable[[dict[str, Any]], str]:
    cells = [_number("errors", name, key) for key in ("median", "p95", "max")]
    return lambda row: " / ".join(cell(row) for cell in cells)


def _by_frame(word: str) -> Callable[[dict[str, Any]], str]:
    """Share of the sequences with a fix by each of their frames, %."""

    def cell(row: dict[str, Any]) -> str:
        counts = row["counts"]
        shares, k = [], 1
        while f"{word}_by_{k}" in counts:
            shares.append(f"{100.0 * counts[f'{word}_by_{k}'] / counts['sequences']:.2f}")
            k += 1
        return " / ".join(shares) or "-"

    return cell


def _nees(row: dict[str, Any]) -> str:
    cells = [f"{stage} {v['mean']:.2f} ({v['frames']:.0f})" for stage, v in row["nees"].items() if v["frames"]]
    return ", ".join(cells) or "-"


def _level(name: str) -> Callable[[dict[str, Any]], str]:
    cells = _number("errors", name, "level_median"), _number("errors", name, "level_over_p95", digits=1)
    return lambda row: f"{cells[0](row)} ({cells[1](row)})"


def _available(row: dict[str, Any]) -> str:
    """Share of the frames with four detected lights or more that are valid, %."""
    valid, among = (sum(row["counts"].get(f"{word}_{n}", 0) for n in ("some", "full")) for word in ("valid", "frames"))
    return f"{100.0 * valid / among:.1f}" if among else "-"


def _says(row: dict[str, Any]) -> str:
    """The commonest reasons for frames without a valid pose, with their shares of all frames, %."""
    counts, prefix = row["counts"], "reason "
    reasons = {key.removeprefix(prefix): n for key, n in counts.items() if key.startswith(prefix)}
    common = sorted(reasons, key=lambda word: -reasons[word])[:_MOST_REASONS]
    return ", ".join(f"{word} {100.0 * reasons[word] / counts['frames']:.0f}" for word in common)


def _told(row: dict[str, Any]) -> str:
    return _of("runs_over_said", "runs_over_level")(row) if row.get("says") else "-"


_FAULTS: dict[str, Callable[[dict[str, Any]], str]] = {
    "assumptions": lambda row: str(row["assumptions"]),
    "frames": _count("frames"),
    "valid": _count("valid"),
    "misleading": _count("hazardous_valid"),
    "misleading guide": _count("hazardous_guide"),
    "over level": _count("over_level"),
    "available, %": _available,
    "no valid pose because, %": _says,
    "runs over a level that name the file": _told,
}
_ERRORS = {
    "lateral, m": "lateral_m",
    "axial, m": "axial_m",
    "angle, deg": "angle_deg",
    "bearing, deg": "bearing_deg",
    "range, m": "range_m",
}
_SECTIONS: dict[str, dict[str, Callable[[dict[str, Any]], str]]] = {
    "Availability and identities": {
        "runs": _count("runs"),
        "frames": _count("frames"),
        "0-3 lights": _count("frames_few"),
        "4-5": _count("frames_some"),
        "6+": _count("frames_full"),
        "accepted, %": _percent("accepted", "frames"),
        "with 6+, %": _percent("accepted_full", "frames_full"),
        "with 4-5, %": _percent("accepted_some", "frames_some"),
        "identified": _count("identified"),
        "wrong identities: harmful coincidences": _count("wrong_coincident"),
        "others": _count("wrong_else"),
        "frames with a wrong identity": _count("frames_with_wrong"),
    },
    "Integrity": {
        "valid, %": _percent("valid", "frames"),
        "valid with 6+, %": _percent("valid_full", "frames_full"),
        "valid where the bound allows it, %": _percent("valid_eligible", "frames_eligible"),
        "guide, %": _percent("guide", "frames"),
        "guide with 6+, %": _percent("guide_full", "frames_full"),
        "guide with 4-5, %": _percent("guide_some", "frames_some"),
        "hazardous valid": _count("hazardous_valid"),
        "hazardous guide": _count("hazardous_guide"),
        **{f"{name} over level": _of(f"over_level_{name}", f"levels_{name}") for name in (*POSE_ERRORS, *GUIDE_ERRORS)},
        "NEES (frames)": _nees,
    },
    "Errors, median / 95 % / largest": {name: _error(key) for name, key in _ERRORS.items()},
    "Protection levels, median (times the 95 % error)": {name: _level(key) for name, key in _ERRORS.items()},
    "Over time": {
        "accepted by frame, %": _by_frame("accepted"),
        "guide by frame, %": _by_frame("guide"),
        "longest gap valid, s": _number("longest_gap_s", "valid", digits=2),
        "longest gap guide, s": _number("longest_gap_s", "guide", digits=2),
        "valid without light for 0.3 s": _of("stale_valid", "frames_stale"),
        "guide without light for 0.3 s": _of("stale_guide", "frames_stale"),
        "never valid again after a black-out": _of("never_back_valid", "blinded_valid"),
        "frames until valid again, median": _number("frames_back", "valid", "median", digits=0),
        "largest": _number("frames_back", "valid", "max", digits=0),
    },
}
