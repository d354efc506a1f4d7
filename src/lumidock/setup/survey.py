"""Where the lights of a dock really are, from recordings of ordinary approaches and a drawing that is a little off.

Associate with the sigmas that the drawing deserves, adjust positions, poses and camera together, associate again with
what was learned, until nothing changes. F frames, M lights.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lumidock.camera import Camera
from lumidock.config import Config
from lumidock.datatypes import Array, Detections
from lumidock.errors import InputError
from lumidock.pose import sqpnp
from lumidock.setup import bundle
from lumidock.setup.bundle import CALIBRATION, Adjusted, Distance, Estimate, Prior
from lumidock.setup.gauge import scale_sigma, shape_covariance
from lumidock.setup.observations import LEAST_LIGHTS, Labelled, Observations, Progress, identify, labelled
from lumidock.station import Station

_ROUNDS = 5  # of association and adjustment; a drawing 10 cm off settles in three
_MOST_FRAMES = 150  # of one recording; more lengthen a survey and add little, as the camera's errors are shared
_LEAST_FRAMES = 12  # six unknowns a frame: fewer frames leave the lights little more than the drawing says
_LEAST_SHARE = 0.5  # of the frames; a drawing 10 cm off, stated as such, is followed in nine of ten
_LEAST_LIT = 0.6  # of the lights; five lights of another dock can pass for five of this one
_LEAST_SEEN = 10  # frames; a light identified in fewer may be another lamp or a glint, and stays as drawn
_MOST_TILT_RAD = 0.02  # 1 sigma of a frame's tilt; beyond, its flip fits as well and pulls the lights out of plane
_DECIDED = 9.0  # cost by which the flip of a plane must fit worse: 3 sigmas
_LEAST_SIGMA_M = 0.0005  # a lamp's optical centre is not known better than this
_SETTLED = 0.2  # of a light's sigma: smaller moves change nothing
_WEAK = 0.7  # of the sigma before: what remains of it after the survey was not observed
_MOST_NOISE_PX = 1.5  # three times the detector's usual error: more, and the dock is another or the lights are mixed up
_MOST_MOVED = 4.0  # rms move in sigmas of the drawing beyond which its sigmas are not honest


@dataclass(frozen=True, slots=True, eq=False)
class Survey:
    """What a survey found.

    `after` is the drawing with the new positions; `sigma_m` (M, 3) the 1-sigma error of each in the dock's axes and
    `covariance` (3M, 3M) of all, the dock's frame taken as the one in which the lights that were seen fit the true
    ones best. `scale_sigma` is the relative error of the size of the whole, which is not in `sigma_m`: it acts as an
    error of the focal length does, and `after` counts it there. `held_out_px` are the rms residuals of frames that had
    no part in the adjustment: with the drawing, and with the positions from the other frames. `unobserved` says in
    words what the footage left open. `refusal` is empty where the result may be used.
    """

    before: Station
    after: Station
    sigma_m: Array
    scale_sigma: float
    covariance: Array
    observed: Observations
    adjusted: Adjusted
    held_out_px: tuple[float, float]
    unobserved: tuple[str, ...]
    refusal: str
    rounds: int


def survey(
    recordings: Sequence[Iterable[Detections]],
    drawing: Station,
    camera: Camera,
    config: Config,
    prior: Prior,
    *,
    progress: Progress | None = None,
    labels: Sequence[Labelled] = (),
) -> Survey:
    """Survey a dock from the detections of `recordings`, which are gone through several times.

    `labels` are detections that a person has identified: the frames that they tell of are taken as they say, and what
    these frames alone say of the lights is where the association of the others begins.
    Raises: InputError where hardly any frame has lights that can be associated, and for labels of what is not there.
    """
    estimate, rounds = None, 0
    lists = [list(recording) for recording in recordings]
    station, sigma = _told(labelled(lists, drawing, labels, config.match.noise_px), drawing, camera, prior)
    while True:
        observed = identify(lists, _declared(station, sigma), camera, config, progress, labels=labels)
        observed, poses = _usable(observed, camera, station.p_dock, sigma)
        calibration = estimate.calibration if estimate else np.zeros(CALIBRATION)
        adjusted = bundle.adjust(observed, camera, prior, Estimate(station.p_dock, poses, calibration))
        moved = np.abs(adjusted.estimate.p_dock - station.p_dock)
        estimate = adjusted.estimate
        station, sigma = replace(station, p_dock=estimate.p_dock), _sigma_of(adjusted)
        rounds += 1
        if rounds == _ROUNDS or (moved < _SETTLED * sigma + 1e-4).all():
            return _conclude(drawing, camera, prior, observed, adjusted, rounds)


def prior_of(
    drawing: Station, *, sigma_m: float | None = None, known: Sequence[str] = (), distances: Sequence[Distance] = ()
) -> Prior:
    """What a drawing says before the survey: `sigma_m` replaces its own survey sigma, except in the layers `known`.

    Raises: InputError for a layer that the station does not have.
    """
    missing = [layer for layer in known if layer not in drawing.layers]
    if missing:
        raise InputError(f"{drawing.name}: no layer {missing[0]}; there are {', '.join(drawing.layers)}")
    declared = np.broadcast_to(np.asarray(drawing.sigma_light_m, float).reshape(-1, 1) ** 2, (len(drawing), 1))
    own = np.sqrt(declared + drawing.sigma_layer_m**2)
    sigma = np.repeat(own if sigma_m is None else np.full_like(own, sigma_m), 3, axis=1)
    for layer in known:
        lights = drawing.lights_of(layer)
        sigma[lights] = own[lights]
    return Prior(
        drawing.p_dock,
        np.maximum(sigma, _LEAST_SIGMA_M),
        drawing.sigma_focal,
        drawing.sigma_center_px,
        distances=tuple(distances),
    )


def _told(observed: Observations, drawing: Station, camera: Camera, prior: Prior) -> tuple[Station, Array]:
    """The drawing and its sigmas (M, 3) after the frames that a person has labelled, where there are any."""
    poses, found = clear_poses(observed, camera, prior.p_dock, prior.sigma_m)
    if not found.any():
        return drawing, prior.sigma_m
    at = Estimate(prior.p_dock, poses[found], np.zeros(CALIBRATION))
    adjusted = bundle.adjust(observed.take(np.flatnonzero(found)), camera, prior, at)
    return replace(drawing, p_dock=adjusted.estimate.p_dock), _sigma_of(adjusted)


def _sigma_of(adjusted: Adjusted) -> Array:
    """The 1-sigma error (M, 3) of each light."""
    covariance = shape_covariance(adjusted.covariance, adjusted.estimate.p_dock, adjusted.seen)
    return np.maximum(np.sqrt(np.diagonal(covariance)).reshape(-1, 3), _LEAST_SIGMA_M)


def _declared(station: Station, sigma_m: Array) -> Station:
    """The station as the localizer is to take it: the errors of its lights are those of the survey so far."""
    return replace(station, sigma_light_m=np.sqrt((sigma_m**2).mean(axis=1)), sigma_layer_m=0.0)


def _usable(observed: Observations, camera: Camera, p_dock: Array, sigma_m: Array) -> tuple[Observations, Array]:
    """The frames whose pose is clear, thinned, with these poses (F, 4, 4). Raises: InputError for too few."""
    if observed.share < _LEAST_SHARE:
        raise InputError(
            f"lights were identified in only {100 * observed.share:.0f} % of the frames that show them: this is another"
            " dock, or the drawing is further off than stated; state how far off it may be with --off"
        )
    frames = [
        bundle.thinned(np.flatnonzero(observed.recording == number), 2 * _MOST_FRAMES)
        for number in np.unique(observed.recording)
    ]
    observed = observed.take(np.concatenate(frames) if frames else np.empty(0, np.int64))
    poses, clear = clear_poses(observed, camera, p_dock, sigma_m)
    kept = np.concatenate(
        [
            bundle.thinned(np.flatnonzero(clear & (observed.recording == number)), _MOST_FRAMES)
            for number in np.unique(observed.recording)
        ]
        or [np.empty(0, np.int64)]
    )
    if len(kept) < _LEAST_FRAMES:
        raise InputError(
            f"{len(kept)} frames with four or more identified lights and a clear pose, wanted at least {_LEAST_FRAMES}:"
            " give nearer frames, or frames that show both layers, and state how far off the drawing may be"
        )
    observed = observed.take(kept)
    rare = observed.seen.sum(axis=0) < _LEAST_SEEN
    return observed.without(np.broadcast_to(rare, observed.seen.shape)), poses[kept]


def clear_poses(observed: Observations, camera: Camera, p_dock: Array, sigma_m: Array) -> tuple[Array, np.ndarray]:
    """The pose of each frame (F, 4, 4), and whether it is clear (F,): its tilt is known and its flip does not fit."""
    first = [_first_pose(camera, p_dock, uv) for uv in observed.uv]
    found = np.array([T is not None for T in first], bool)
    poses = np.array([np.eye(4) if T is None else T for T in first]).reshape(-1, 4, 4)
    if not found.any():
        return poses, found
    distance = np.linalg.norm(poses[:, :3, 3] - p_dock.mean(axis=0), axis=1)
    survey_px = camera.focal_px.mean() * np.sqrt((sigma_m**2).mean(axis=1)) / np.maximum(distance, 0.5)[:, None]
    sigma = np.hypot(observed.sigma_px, survey_px)
    poses, cost = bundle.refine_poses(observed, camera, p_dock, poses, sigma)
    flips, flip_cost = bundle.refine_poses(observed, camera, p_dock, _flipped(poses, p_dock, observed.seen), sigma)
    apart = np.linalg.norm(flips[:, :3, 2] - poses[:, :3, 2], axis=1) > _MOST_TILT_RAD
    better = apart & (flip_cost < cost)
    poses[better] = flips[better]
    decided = ~apart | (np.abs(flip_cost - cost) > _DECIDED)
    tilt = bundle.tilt_sigma(observed, camera, Estimate(p_dock, poses, np.zeros(CALIBRATION)))
    return poses, found & decided & (tilt < _MOST_TILT_RAD)


def _first_pose(camera: Camera, p_dock: Array, uv: Array) -> Array | None:
    seen = np.isfinite(uv[:, 0])
    return sqpnp(camera, p_dock[seen], uv[seen]) if seen.sum() >= LEAST_LIGHTS else None


def _flipped(T_dock_cam: Array, p_dock: Array, seen: np.ndarray) -> Array:
    """Poses (F, 4, 4) from which the plane of the seen lights looks nearly the same: its normal mirrored in the view.

    Source: D. Oberkampf, D. DeMenthon, L. Davis, 1996.
    """
    out = T_dock_cam.copy()
    for i, (T, lights) in enumerate(zip(T_dock_cam, seen, strict=True)):
        p = p_dock[lights]
        middle = p.mean(axis=0)
        normal = np.linalg.svd(p - middle)[2][2]
        view = T[:3, 3] - middle
        view /= np.linalg.norm(view)
        mirrored = 2.0 * (normal @ view) * view - normal
        turn = _rotation_between(mirrored, normal)
        out[i, :3, :3] = turn @ T[:3, :3]
        out[i, :3, 3] = middle + turn @ (T[:3, 3] - middle)
    return out


def _rotation_between(a: Array, b: Array) -> Array:
    """The smallest rotation (3, 3) that takes the unit vector `a` to `b`; of opposite ones, none."""
    cosine = float(a @ b)
    if cosine < -1.0 + 1e-9:
        return np.eye(3)
    x, y, z = np.cross(a, b)
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + K + K @ K / (1.0 + cosine))


def _conclude(
    drawing: Station, camera: Camera, prior: Prior, observed: Observations, adjusted: Adjusted, rounds: int
) -> Survey:
    estimate = adjusted.estimate
    covariance = shape_covariance(adjusted.covariance, estimate.p_dock, adjusted.seen)
    sigma, seen = _sigma_of(adjusted), adjusted.seen
    scale = scale_sigma(adjusted.covariance, estimate.p_dock, seen)
    scale_before = scale_sigma(np.diag(prior.sigma_m.ravel() ** 2), prior.p_dock, seen)
    held_out = _held_out(observed, camera, prior, adjusted)
    return Survey(
        before=drawing,
        after=replace(drawing, p_dock=estimate.p_dock, sigma_focal=math.hypot(drawing.sigma_focal, scale)),
        sigma_m=sigma,
        scale_sigma=scale,
        covariance=covariance,
        observed=observed,
        adjusted=adjusted,
        held_out_px=held_out,
        unobserved=_unobserved(drawing, prior, adjusted, sigma, (scale, scale_before)),
        refusal=_refusal(prior, adjusted, held_out, observed),
        rounds=rounds,
    )


def _held_out(observed: Observations, camera: Camera, prior: Prior, adjusted: Adjusted) -> tuple[float, float]:
    """Rms px of the odd frames: with the drawing, and with positions adjusted to the even frames alone."""
    even, odd = np.arange(0, len(observed), 2), np.arange(1, len(observed), 2)
    agreeing = observed.without(~adjusted.used)
    at = adjusted.estimate
    trained = bundle.adjust(agreeing.take(even), camera, prior, replace(at, T_dock_cam=at.T_dock_cam[even]))
    test, poses = agreeing.take(odd), at.T_dock_cam[odd]
    sigma = np.ones(test.sigma_px.shape)
    out = []
    for p_dock in (prior.p_dock, trained.estimate.p_dock):
        fitted, _ = bundle.refine_poses(test, camera, p_dock, poses, sigma)
        residual = bundle.reprojection(test, camera, p_dock, fitted)
        out.append(float(np.sqrt(np.nanmean((residual**2).sum(axis=2)))))
    return out[0], out[1]


def _unobserved(
    drawing: Station, prior: Prior, adjusted: Adjusted, sigma_m: Array, scale: tuple[float, float]
) -> tuple[str, ...]:
    """What the footage left as it was, in words, with what would settle it."""
    said = []
    unseen = [drawing.ids[i] for i in np.flatnonzero(~adjusted.seen)]
    if unseen:
        said.append(f"never seen, as drawn: {', '.join(unseen)}; bring them into view, or check that they are lit")
    weak = [
        drawing.ids[i]
        for i in range(len(drawing))
        if drawing.ids[i] not in unseen and (sigma_m[i] > _WEAK * prior.sigma_m[i]).any()
    ]
    if weak:
        said.append(f"seen too little to improve on the drawing: {', '.join(weak)}; come nearer to them")
    if scale[0] > _WEAK * scale[1] and not prior.distances:
        said.append(
            f"the size of the whole: {100 * scale[0]:.2f} % (1 sigma), from the drawing alone; "
            "tape one distance between two lights far apart and give it with --distance"
        )
    if not adjusted.calibrated:
        said.append(
            "the camera: the frames ask for a calibration more than four sigmas from the file's, so the file's was"
            " kept; calibrate anew in water (lumidock calib water), then survey again"
        )
    focal = float(np.sqrt(adjusted.covariance[-CALIBRATION, -CALIBRATION]))
    if adjusted.calibrated and focal > _WEAK * prior.sigma_focal:
        said.append(
            f"the focal length: {100 * focal:.2f} % (1 sigma) as before; it trades with the distance between layers"
        )
    return tuple(said)


def _refusal(prior: Prior, adjusted: Adjusted, held_out_px: tuple[float, float], observed: Observations) -> str:
    """Why the result must not be used; empty where it may."""
    per_axis = held_out_px[1] / math.sqrt(2.0)
    if not per_axis < _MOST_NOISE_PX:
        return f"residual of {per_axis:.2f} px an axis on held-out frames, wanted below {_MOST_NOISE_PX} px"
    agree = adjusted.used.sum() / max(observed.seen.sum(), 1)
    if agree < 0.8:
        return f"only {100 * agree:.0f} % of the identified detections agree with the result"
    seen = adjusted.seen
    if seen.mean() < _LEAST_LIT:
        return f"only {seen.sum()} of {len(seen)} lights were identified: this is another dock, or most of it is dark"
    moved = (adjusted.estimate.p_dock - prior.p_dock) / prior.sigma_m
    rms = float(np.sqrt((moved**2).mean()))
    if rms > _MOST_MOVED:
        return f"the lights moved by {rms:.1f} times the drawing's sigma; state how far off it may be with --off"
    return ""
