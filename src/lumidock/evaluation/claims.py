"""Whether the uncertainty that a run states holds against the truth: alert limits, protection levels, NEES, gaps.

Pure functions on arrays, N poses and M guides with their true values; `metrics` reads the files.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from lumidock.alert_limits import AlertLimits
from lumidock.datatypes import Array, require_shape
from lumidock.geometry import bearing_and_range, so3_log

POSE_ERRORS, GUIDE_ERRORS = ("lateral", "axial", "angle"), ("bearing", "range")
LONG_GAP_NS = 450_000_000  # three frames of the approach
_POSE_FREEDOM = 6  # degrees of freedom of a pose
_ONE_DOCKING = (1.2, 14.4)  # the chi-squared distribution of these lies between them with 95 %
_MIN_EIGENVALUE = 1e-12  # of a correlation matrix; less is rounding of the file


@dataclass(frozen=True, slots=True, eq=False)
class PoseClaims:
    """N valid fixes: their errors against the truth, and the uncertainty that they state.

    `z_m` (N,) estimated; `errors` (N, 6) [t_est - t_true m, w rad], R_est = Exp(w) R_true, in dock axes; `levels`
    (N, 3) protection levels lateral m, axial m, total rotation rad; `covariance` (N, 6, 6) of the errors; levels and
    covariance are NaN where the method states none; `stage` (N,); `alert_limits` of the dock.
    """

    z_m: Array
    errors: Array
    levels: Array
    covariance: Array
    stage: Sequence[str]
    alert_limits: AlertLimits

    def __post_init__(self) -> None:
        n = len(self.z_m)
        require_shape("errors", self.errors, n, 6)
        require_shape("levels", self.levels, n, 3)
        require_shape("covariance", self.covariance, n, 6, 6)

    def sizes(self) -> Array:
        """Lateral m, axial m and total rotation rad of each error: (N, 3)."""
        return error_sizes(self.errors)

    def limits(self) -> Array:
        """Alert limits (N, 3) in the order of `sizes`, at the estimated z less the axial protection level, if any."""
        return self.alert_limits.of_poses(self.z_m, np.nan_to_num(self.levels[:, 1]))


@dataclass(frozen=True, slots=True, eq=False)
class GuideClaims:
    """M frames with a guide: `claimed` (M, 3) bearings rad and range m, `true` (M, 3) ones, `levels` (M, 2).

    `levels` are protection levels bearing rad and range m, NaN where the method gives none; `alert_limits` the dock's.
    """

    claimed: Array
    true: Array
    levels: Array
    alert_limits: AlertLimits

    def __post_init__(self) -> None:
        m = len(self.claimed)
        require_shape("claimed", self.claimed, m, 3)
        require_shape("true", self.true, m, 3)
        require_shape("levels", self.levels, m, 2)

    def sizes(self) -> Array:
        """Error of the bearing, both angles together, rad, and of the range m: (M, 2)."""
        off = self.claimed - self.true
        turned = (off[:, :2] + np.pi) % (2.0 * np.pi) - np.pi
        return np.stack([np.hypot(*turned.T), np.abs(off[:, 2])], axis=1)

    def limits(self) -> Array:
        """Alert limits (M, 2) at the claimed range, in the order of `sizes`; infinite where a guide has none."""
        return self.alert_limits.of_guides(self.claimed)


Claims = PoseClaims | GuideClaims


def error_sizes(errors: Array) -> Array:
    """Lateral m, axial m and total rotation rad (N, 3) of errors (N, 6) [t_est - t_true m, w rad]."""
    lateral, rotation = np.hypot(errors[:, 0], errors[:, 1]), np.linalg.norm(errors[:, 3:], axis=1)
    return np.stack([lateral, np.abs(errors[:, 2]), rotation], axis=1)


def pose_error(T_dock_cam: Array, T_dock_cam_true: Array) -> Array:
    """Error (6,) [t_est - t_true m, w rad] with R_est = Exp(w) R_true, in dock axes."""
    w = so3_log(T_dock_cam[:3, :3] @ T_dock_cam_true[:3, :3].T)
    return np.concatenate([T_dock_cam[:3, 3] - T_dock_cam_true[:3, 3], w])


def true_guide(T_dock_cam_true: Array) -> Array:
    """The true guide (3,): both bearings rad and the range m of the dock's origin."""
    return np.array(bearing_and_range(T_dock_cam_true))


def hazardous(claims: Claims) -> dict[str, int]:
    """How many frames whose fix may be used have an error over its alert limit: `any`, and by kind of error."""
    over = claims.sizes() > claims.limits()
    return {"any": int(over.any(axis=1).sum())} | _counts(_names(claims), over)


def over_level(claims: Claims) -> dict[str, dict[str, int]]:
    """By kind of error: frames that have a protection level, and those whose error is over it."""
    known, over = np.isfinite(claims.levels), claims.sizes() > claims.levels
    frames, beyond = (_counts(_names(claims), which) for which in (known, over))
    return {name: {"frames": frames[name], "over": beyond[name]} for name in frames}


def stanford(errors: Array, levels: Array, limits: Array) -> dict[str, int]:
    """Frames (N,) in each region of the Stanford diagram, by error, protection level and alert limit.

    `unavailable`: the level is over the limit, or unknown; of the others `hazardous`: the error is over the limit;
    `misleading`: it is over the level and not over the limit; `nominal`: within both.
    """
    available, beyond = levels <= limits, errors > levels
    hazard = available & (errors > limits)
    return {
        "nominal": int((available & ~beyond).sum()),
        "misleading": int((available & beyond & ~hazard).sum()),
        "hazardous": int(hazard.sum()),
        "unavailable": int((~available).sum()),
    }


def stanford_of(poses: PoseClaims, frames: int) -> dict[str, dict[str, int]]:
    """Stanford counts over all `frames`, by kind of error; a frame without a valid pose is unavailable."""
    columns = zip(POSE_ERRORS, poses.sizes().T, poses.levels.T, poses.limits().T, strict=True)
    counts = {name: stanford(*column) for name, *column in columns}
    for regions in counts.values():
        regions["unavailable"] += frames - len(poses.z_m)
    return counts


def nees(errors: Array, covariance: Array) -> Array:
    """Normalised squared errors (N,) of `errors` (N, K) by `covariance` (N, K, K); mean K when it is honest.

    NaN where a covariance is unknown or not positive definite.
    """
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    sigma = np.sqrt(np.where(variance > 0.0, variance, np.nan))
    known = np.isfinite(covariance).all(axis=(1, 2)) & np.isfinite(sigma).all(axis=1)
    # metres and radians differ by orders of magnitude; correlations do not
    s = sigma[known]
    values, vectors = np.linalg.eigh(covariance[known] / (s[:, :, None] * s[:, None, :]))
    proper = values[:, 0] > _MIN_EIGENVALUE
    along = np.einsum("nij,ni->nj", vectors, errors[known] / s)
    squares = np.full(len(errors), np.nan)
    squares[known] = np.where(proper, (along**2 / np.where(proper[:, None], values, 1.0)).sum(axis=1), np.nan)
    return squares


def consistency(poses: PoseClaims) -> dict[str, Any]:
    """Mean NEES of all poses with a covariance, and by stage; those not positive definite are counted as `improper`."""
    squares, stage = nees(poses.errors, poses.covariance), np.array(poses.stage, str)
    given = np.isfinite(poses.covariance).all(axis=(1, 2))
    by_stage = {str(name): _mean(squares[stage == name]) for name in dict.fromkeys(poses.stage)}
    improper = int((given & np.isnan(squares)).sum())
    return _mean(squares) | {
        "improper": improper,
        "by_stage": {name: mean for name, mean in by_stage.items() if mean["frames"]},
    }


def nees_in_words(mean: float) -> list[str]:
    """What the mean NEES of the poses of one docking says: the value to expect, and what another one means."""
    low, high = _ONE_DOCKING
    shared = "whose frames share one survey and calibration"
    lines = [f"expected: 6, and of one docking, {shared}, {low:g} to {high:g} in 19 of 20"]
    if mean > high:
        lines.append("far over 6 the covariances are too small: is something wrong in the station or the camera file?")
    elif mean < _POSE_FREEDOM:
        assumed = "the settings files.layer_m and files.focal assume 2 cm and 0.5 %"
        lines.append(f"below 6: smaller errors than stated; {assumed}")
    return lines


def continuity(t_ns: Sequence[int]) -> dict[str, Any]:
    """Longest time between two usable frames in a row, of stamps `t_ns`, and how many are longer than 0.45 s."""
    gaps = [b - a for a, b in pairwise(t_ns)]
    longest = max(gaps, default=0) * 1e-9 if gaps else None
    return {"longest_gap_s": longest, "long_gaps": sum(gap > LONG_GAP_NS for gap in gaps)}


def _names(claims: Claims) -> tuple[str, ...]:
    return POSE_ERRORS if isinstance(claims, PoseClaims) else GUIDE_ERRORS


def _counts(names: tuple[str, ...], which: np.ndarray) -> dict[str, int]:
    return {name: int(column.sum()) for name, column in zip(names, which.T, strict=True)}


def _mean(squares: Array) -> dict[str, Any]:
    known = squares[np.isfinite(squares)]
    return {"frames": len(known), "mean": float(known.mean()) if len(known) else None}
