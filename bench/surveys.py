"""Surveys of docks that were not built as drawn: how far the lights then are from where they stand.

Three simulated dockings a dock, of bare detections with dead lights and clutter as in the scenario `nominal`, and a
camera whose focal length and centre are off by the sigmas of the file. Errors are those of the lights that were seen.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from bench.built_docks import BuiltDock, built_dock, shape_error, taped
from lumidock.config import Config
from lumidock.datatypes import Array
from lumidock.errors import InputError
from lumidock.setup import bundle
from lumidock.setup.bundle import CALIBRATION, Distance, Estimate, Prior
from lumidock.setup.gauge import shape_covariance
from lumidock.setup.survey import Survey, clear_poses, prior_of, survey
from lumidock.setup.unknown import first_layout
from lumidock.station import Station

DOCKS = 2
FIRST_SEED = 41_000
_SECONDS_APART = 0.2  # frames of a docking
_TAPE, _TAPE_SIGMA_M = ("F1", "R5"), 0.002
_WRONG = 0.03  # share of the identities that are exchanged within their frame
_OFF_M, _FAR_OFF_M = 0.05, 0.10
_CAMERA_S, _EVERY = 1.0 / 15.0, 3  # without a drawing lights are followed at the camera's rate
_SOLVED_M = 0.01  # rms of the shape: three times what is wanted; a layout whose lights were mixed up is centimetres off


@dataclass(frozen=True, slots=True)
class Errors:
    """Of one surveyed dock: rms error per coordinate after a rigid fit and one with scale, and NEES over its dof."""

    rigid_m: float
    similarity_m: float
    nees: float


def main() -> tuple[dict[str, object], list[str]]:
    """One row a case, over `DOCKS` docks."""
    rows: dict[str, list[Errors | str]] = {}
    seconds: list[float] = []
    for seed in range(FIRST_SEED, FIRST_SEED + DOCKS):
        for name, found in _of_one_seed(seed, seconds):
            rows.setdefault(name, []).append(found)
        print(f"{seed}", file=sys.stderr, flush=True)
    heads = "docks | solved | refused | rms, mm: median | 95 % | all | after a fit with scale: median | 95 % | all"
    lines = [f"| case | {heads} | NEES / dof |", "|---" * 11 + "|"]
    content: dict[str, object] = {"seconds": seconds}
    for name, found in rows.items():
        lines.append(f"| {name} | {_cells(found)} |")
        content[name] = [one if isinstance(one, str) else [one.rigid_m, one.similarity_m, one.nees] for one in found]
    lines += [
        "",
        f"Time of a survey of three dockings, s: median {np.median(seconds):.1f}, longest {max(seconds):.1f}.",
    ]
    return content, lines


def _of_one_seed(seed: int, seconds: list[float]) -> list[tuple[str, Errors | str]]:
    dock = built_dock(seed, off_m=_OFF_M, dockings=3, interval_s=_SECONDS_APART)
    start = time.monotonic()
    taped_one = _surveyed(dock, tape=True)
    seconds.append(time.monotonic() - start)
    far = built_dock(seed, off_m=_FAR_OFF_M, dockings=3, interval_s=_SECONDS_APART)
    rows = [
        ("5 cm off, one distance", _judged(dock, taped_one)),
        ("5 cm off, no distance", _judged(dock, _surveyed(dock, tape=False))),
        ("10 cm off, one distance", _judged(far, _surveyed(far, tape=True))),
        ("no drawing, no light dead, one distance", _unknown(seed)),
    ]
    if isinstance(taped_one, Survey):
        rows += [
            ("the identities of the first row, adjusted once", _adjusted_once(dock, taped_one, 0.0)),
            ("the same with 3 % of them wrong", _adjusted_once(dock, taped_one, _WRONG)),
        ]
    return rows


def _prior(dock: BuiltDock, drawing: Station, *, tape: bool) -> Prior:
    a, b, metres = taped(dock, *_TAPE)
    return prior_of(drawing, distances=(Distance(a, b, metres, _TAPE_SIGMA_M),) if tape else ())


def _surveyed(dock: BuiltDock, *, tape: bool) -> Survey | str:
    """The survey, or why it was refused."""
    try:
        found = survey(dock.recordings, dock.drawing, dock.camera, Config(), _prior(dock, dock.drawing, tape=tape))
    except InputError as error:
        return str(error)
    return found.refusal or found


def _judged(dock: BuiltDock, found: Survey | str) -> Errors | str:
    if isinstance(found, str):
        return found
    return _errors(found.after.p_dock, dock.built.p_dock, found.adjusted.seen, found.covariance)


def _errors(p_dock: Array, true: Array, seen: np.ndarray, covariance: Array) -> Errors:
    """Errors of positions (M, 3), with their covariance (3M, 3M) over shapes."""
    rigid, shape = (shape_error(p_dock, true, seen, scale=scale)[seen] for scale in (False, True))
    each = np.repeat(seen, 3)
    nees = float(shape.ravel() @ np.linalg.pinv(covariance[np.ix_(each, each)], rcond=1e-9) @ shape.ravel())
    return Errors(float(np.sqrt((rigid**2).mean())), float(np.sqrt((shape**2).mean())), nees / (int(each.sum()) - 7))


def _adjusted_once(dock: BuiltDock, found: Survey, wrong: float) -> Errors:
    """The adjustment alone from the drawing, a share `wrong` of the survey's identities exchanged in their frames."""
    observed = found.observed
    uv, rng = observed.uv.copy(), np.random.default_rng([len(observed.uv), 7])
    for frame in uv:
        lights = np.flatnonzero(np.isfinite(frame[:, 0]))
        for light in lights[rng.random(len(lights)) < wrong / 2.0]:  # an exchange makes two identities wrong
            other = int(rng.choice(lights[lights != light]))
            frame[[light, other]] = frame[[other, light]]
    prior = _prior(dock, dock.drawing, tape=True)
    changed = replace(observed, uv=uv)
    poses, clear = clear_poses(changed, dock.camera, prior.p_dock, prior.sigma_m)
    at = Estimate(prior.p_dock, poses[clear], np.zeros(CALIBRATION))
    adjusted = bundle.adjust(changed.take(np.flatnonzero(clear)), dock.camera, prior, at)
    covariance = shape_covariance(adjusted.covariance, adjusted.estimate.p_dock, adjusted.seen)
    return _errors(adjusted.estimate.p_dock, dock.built.p_dock, adjusted.seen, covariance)


def _unknown(seed: int) -> Errors | str:
    """A survey from nothing but the number of lights, at the camera's own rate; a wrong layout has large errors."""
    dock = built_dock(seed, off_m=_OFF_M, dockings=3, interval_s=_CAMERA_S, settings=("detections.dead=[0,0]",))
    front, rear = (len(dock.drawing.lights_of(layer)) for layer in ("front", "rear"))
    try:
        layout = first_layout(dock.recordings, front, rear, dock.camera, Config().match.noise_px)
        order = _order(layout.p_dock, dock.built)
        built = replace(dock.built, p_dock=dock.built.p_dock[order])
        a, b = (order.index(dock.built.ids.index(light)) for light in _TAPE)
        metres = float(np.linalg.norm(built.p_dock[a] - built.p_dock[b]))
        size = metres / float(np.linalg.norm(layout.p_dock[a] - layout.p_dock[b]))
        layout = replace(layout, p_dock=layout.p_dock * size)
        prior = prior_of(layout, distances=(Distance(a, b, metres, _TAPE_SIGMA_M),))
        found = survey([one[::_EVERY] for one in dock.recordings], layout, dock.camera, Config(), prior)
    except InputError as error:
        return str(error)
    return found.refusal or _errors(found.after.p_dock, built.p_dock, found.adjusted.seen, found.covariance)


def _order(p_dock: Array, built: Station) -> list[int]:
    """Which light of the dock each of a layout is: those nearest in its layer after a fit of size and middle."""
    order: list[int] = []
    for layer in ("front", "rear"):
        lights = built.lights_of(layer)
        own = np.arange(len(order), len(order) + len(lights))
        a, b = (p[:, :2] - p[:, :2].mean(axis=0) for p in (p_dock[own], built.p_dock[lights]))
        a = a * np.sqrt((b**2).sum() / (a**2).sum())
        away = np.linalg.norm(a[:, None] - b[None], axis=2)
        order += lights[linear_sum_assignment(away)[1]].tolist()
    return order


def _cells(found: list[Errors | str]) -> str:
    errors = [one for one in found if not isinstance(one, str)]
    cells = [str(len(found)), str(sum(one.similarity_m < _SOLVED_M for one in errors)), str(len(found) - len(errors))]
    for each in ([one.rigid_m for one in errors], [one.similarity_m for one in errors]):
        mm = 1000.0 * np.array(each)
        cells += [f"{value:.1f}" for value in (np.median(mm), np.quantile(mm, 0.95), np.sqrt((mm**2).mean()))]
    return " | ".join([*cells, f"{np.mean([one.nees for one in errors]):.2f}"])
