"""The numbers of a run's report: tiles and tables."""

from __future__ import annotations

import json
import platform
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import cv2
import numpy as np
import yaml

from lumidock.config import Config
from lumidock.evaluation import run_description
from lumidock.evaluation.claims import nees_in_words
from lumidock.report.page import Listing, Table, Tile
from lumidock.report.view import STAGES, RunView

_WHY = {
    "no_lights": "no detection in the image that could be a lamp",
    "too_few": "too few lights for a pose",
    "too_many": "more detections than the method examines",
    "ambiguous": "several associations of detections with lights fit about as well",
    "unproven": "one association fits, but its evidence does not yet meet the risk",
    "mirror": "the mirror image of the dock fits about as well",
    "inconsistent": "the detections fit no assignment to the dock's lights",
    "residual": "the identified detections do not lie where any one pose puts their lights",
    "protection": "a pose was found, but its protection level is over the alert limit",
    "saturated": "the lights show too little and are overexposed: a shorter exposure helps",
    "calibration": "the detections contradict the camera calibration",
    "survey": "the detections contradict the positions in the station file",
    "stale": "no light was detected for too long to go on predicting",
    "frozen": "the camera repeats the same image",
    "bad_frame": "the image could not be read or does not fit the calibration",
    "bad_stamp": "the time stamp is missing or is not later than the one before",
}


def tiles(view: RunView) -> list[Tile]:
    """The most important numbers of a run."""
    n, counts = len(view.fixes), [int(view.valid.sum()), int(view.guided.sum())]
    found = [
        Tile(str(n), "frames"),
        Tile(f"{100.0 * counts[0] / n:.1f} %", f"valid pose ({counts[0]} frames)"),
        Tile(f"{100.0 * counts[1] / n:.1f} %", f"bearing and range ({counts[1]} frames)"),
    ]
    if view.evaluation is not None:
        found += _tiles_of_truth(view.evaluation)
    if np.isfinite(view.latency_ms).any():
        found.append(Tile(f"{np.nanmedian(view.latency_ms):.1f} ms", "a frame, median"))
    return found


def _tiles_of_truth(evaluation: dict[str, Any]) -> list[Tile]:
    hazards = sum(evaluation["hazardous"][word]["any"] for word in ("valid", "guide"))
    found = [
        Tile(str(hazards), "hazardous: valid or guide with an error over the alert limit", "bad" if hazards else "good")
    ]
    if evaluation["error"]:
        lateral = evaluation["error"]["lateral_m"]
        found.append(Tile(f"{lateral['median']:.3f} m", f"lateral error, median (95 %: {lateral['p95']:.3f} m)"))
    if "identities" in evaluation:
        wrong, among = evaluation["identities"]["wrong"], evaluation["identities"]["identified"]
        found.append(Tile(str(wrong), f"wrong identities of {among}", "bad" if wrong else "good"))
    return found


def reasons(view: RunView) -> Table | None:
    """Why frames had no valid pose."""
    counts = Counter(fix.reason for fix in view.fixes if fix.reason)
    if not counts:
        return None
    guided = Counter(fix.reason for fix in view.fixes if fix.reason and fix.guide is not None)
    rows = [
        [word, str(count), str(guided[word]), _WHY.get(word, "-"), _longest(view, word)]
        for word, count in counts.most_common()
    ]
    head = ["reason", "frames", "with bearing and range", "what it means", "longest stretch"]
    over = run_description.over_limit_in_words(view.described)
    return Table(" ".join(["Why there was no valid pose.", *(f"Protection: {line}." for line in over)]), head, rows)


def contradictions(view: RunView) -> Table | None:
    """What was seen against the station and the camera file."""
    rows = [[text, reason, str(frames)] for text, reason, frames in run_description.contradictions(view.described)]
    if not rows:
        return None
    return Table("What the lights say against the files.", ["last seen", "reason", "frames"], rows)


def _longest(view: RunView, word: str) -> str:
    """The longest unbroken stretch of frames with one reason."""
    best = current = start = first = 0
    for k, fix in enumerate(view.fixes):
        current, first = (current + 1, first if current else k) if fix.reason == word else (0, k)
        if current > best:
            best, start = current, first
    t = view.t_s[start]
    return f"{best} frame{'s' * (best > 1)}" + (f" from {t:.2f} s" if np.isfinite(t) else "")


def handover(view: RunView) -> Table | None:
    """Where each stage began and ended."""
    rows = []
    for stage in STAGES:
        at = [k for k, fix in enumerate(view.fixes) if fix.stage == stage]
        posed = [k for k in at if view.valid[k]]
        if at:
            z = f"{view.position[posed[0], 2]:.2f} to {view.position[posed[-1], 2]:.2f}" if posed else "-"
            times = f"{view.t_s[at[0]]:.2f} to {view.t_s[at[-1]]:.2f}"
            rows.append([stage, str(len(at)), str(len(posed)), times, z])
    head = ["stage", "frames", "valid", "time, s", "z of valid poses, m"]
    return Table("Stages: first and last frame of each, and between which z it had poses.", head, rows)


def by_range(view: RunView) -> Table | None:
    """Availability and errors over ranges of true z."""
    if view.evaluation is None or not view.evaluation["by_true_z"]:
        return None
    rows = []
    for row in view.evaluation["by_true_z"]:
        errors = [row.get(name) for name in ("lateral_m", "axial_m", "angle_deg")]
        cells = [f"{e['median']:.3f} / {e['p95']:.3f}" if e else "-" for e in errors]
        low, high = row["z_m"]
        rows.append([f"{low:g} to {high:g}", *(str(row[word]) for word in ("frames", "valid", "guide")), *cells])
    head = ["true z, m", "frames", "valid", "guide", "lateral, m", "axial, m", "angle, deg"]
    return Table("Errors, median / 95 %, of the valid poses over true distance before the entrance plane.", head, rows)


def integrity(view: RunView) -> Table | None:
    """Whether the run's alert limits, protection levels and covariances hold against the truth."""
    if view.evaluation is None:
        return None
    e = view.evaluation
    rows = [
        [f"{word} over its alert limit", f"{e['hazardous'][word]['any']} of {e['hazardous']['frames']}"]
        for word in ("valid", "guide")
    ]
    rows += [
        [f"{kind} error over its protection level", f"{row['over']} of {row['frames']}"]
        for kind, row in e["over_level"].items()
        if row["frames"]
    ]
    if e["nees"]["frames"]:
        mean, frames = e["nees"]["mean"], e["nees"]["frames"]
        rows.append(["NEES of the covariance", "; ".join([f"{mean:.2f} over {frames} frames", *nees_in_words(mean)])])
    for word, gaps in e["continuity"].items():
        if gaps["longest_gap_s"] is not None:
            rows.append([f"longest gap in {word}", f"{gaps['longest_gap_s']:.2f} s; over 0.45 s: {gaps['long_gaps']}"])
    if e.get("identities"):
        counts = e["identities"]
        rows.append(
            ["identified detections nearer to another lit light", f"{counts['wrong']} of {counts['identified']}"]
        )
        text = f"{counts['displaced']} of {counts['identified']}"
        rows.append(["identified detections over 3 px from their light", text])
    limits = f"Alert limits of the dock: {view.station.alert_limits.as_text()}."
    return Table(f"Whether the stated errors hold against the truth. {limits}", ["what", "frames or value"], rows)


def versions(view: RunView) -> list[Table | Listing]:
    """What the run was made with: versions, inputs, and the settings that are not the defaults."""
    d = view.described
    source = d.get("source", {})
    rows = [
        ["lumidock", str(d.get("lumidock", "?"))],
        ["method", f"{d.get('method', '?')}{', every frame without history' * bool(d.get('cold'))}"],
        ["source", f"{source.get('kind', '?')} {source.get('name', '?')}"],
        ["station", f"{view.station.name}, {len(view.station.ids)} lights in {', '.join(view.station.layers)}"],
        ["camera", f"{view.camera.width} x {view.camera.height} px"],
        *([name, f"sha256 {digest}"] for name, digest in d.get("inputs_sha256", {}).items()),
        *([name, _sampled(seen)] for name, seen in d.get("inputs_sampled", {}).items()),
        ["alert limits", view.station.alert_limits.as_text()],
        ["settings that differ", _different(d.get("config", {}))],
        ["this page", f"Python {platform.python_version()}, OpenCV {cv2.__version__}, numpy {np.__version__}"],
    ]
    table = Table("What the run was made from and with.", ["what", "value"], [[a, str(b)] for a, b in rows])
    settings = yaml.safe_dump(d.get("config", {}), sort_keys=False, allow_unicode=True)
    counts = json.dumps(d.get("counts", {}), indent=1)
    return [table, Listing("All settings of the run", settings), Listing("Counts as run.json has them", counts)]


def _sampled(seen: Any) -> str:  # noqa: ANN401  # what a file says, which others may have written
    size, digest = (seen.get(part) for part in ("bytes", "sha256_of_samples")) if isinstance(seen, dict) else ("?", "?")
    return f"{size} bytes, sha256 {digest} of samples"


def _different(config: dict[str, Any]) -> str:
    found = _leaves(config)
    default = _leaves(Config().model_dump(mode="json"))
    return "; ".join(f"{key} = {value}" for key, value in found.items() if default.get(key) != value) or "none"


def _leaves(content: Any, path: str = "") -> dict[str, Any]:  # noqa: ANN401  # whatever a JSON file holds
    if not isinstance(content, dict):
        return {path: content}
    return {
        key: leaf
        for name, value in content.items()
        for key, leaf in _leaves(value, f"{path}.{name}" if path else str(name)).items()
    }


def comparison(views: Sequence[RunView]) -> Table:
    """The numbers of several runs, a column for each."""
    lines: dict[str, Callable[[RunView], str]] = {
        "method": lambda v: f"{v.described.get('method', '?')}{', without history' * bool(v.described.get('cold'))}",
        "frames": lambda v: str(len(v.fixes)),
        "valid": lambda v: _share(v.valid),
        "guide": lambda v: _share(v.guided),
        "first valid z, m": lambda v: _end(v, 0),
        "last valid z, m": lambda v: _end(v, -1),
        "longest gap in valid, s": lambda v: _from(v, lambda e: f"{e['continuity']['valid']['longest_gap_s']:.2f}"),
        "valid over its alert limit": lambda v: _from(v, lambda e: str(e["hazardous"]["valid"]["any"])),
        "guide over its alert limit": lambda v: _from(v, lambda e: str(e["hazardous"]["guide"]["any"])),
        "lateral error, median / 95 %, m": lambda v: _error(v, "lateral_m"),
        "axial error, m": lambda v: _error(v, "axial_m"),
        "angle error, deg": lambda v: _error(v, "angle_deg"),
        "wrong identities": lambda v: _from(
            v, lambda e: f"{e['identities']['wrong']} of {e['identities']['identified']}"
        ),
        "latency, median, ms": lambda v: (
            f"{np.nanmedian(v.latency_ms):.2f}" if np.isfinite(v.latency_ms).any() else "-"
        ),
    }
    rows = [[name, *(cell(view) for view in views)] for name, cell in lines.items()]
    return Table(
        "The runs side by side; errors against the truth where there is one.", ["", *(v.name for v in views)], rows
    )


def _share(which: np.ndarray) -> str:
    return f"{int(which.sum())} ({100.0 * float(which.mean()):.1f} %)"


def _end(view: RunView, which: int) -> str:
    z = view.position[view.valid, 2]
    return f"{z[which]:.2f}" if len(z) else "-"


def _from(view: RunView, cell: Callable[[dict[str, Any]], str]) -> str:
    try:
        return cell(view.evaluation) if view.evaluation is not None else "-"
    except (KeyError, TypeError):  # without a fix, or without true lights
        return "-"


def _error(view: RunView, name: str) -> str:
    return _from(view, lambda e: f"{e['error'][name]['median']:.3f} / {e['error'][name]['p95']:.3f}")
