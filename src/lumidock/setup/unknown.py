"""A dock of two colours of which only the number of lights is known: a first layout from the footage alone.

Lights are followed from frame to frame within their colour; what does not move with the others is left out. A layout
is then adjusted from several guesses of the depth between the layers. Its size is arbitrary until a distance is taped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lumidock.camera import Camera
from lumidock.datatypes import Array, Detections, Indices
from lumidock.errors import InputError
from lumidock.pose import sqpnp
from lumidock.setup import bundle
from lumidock.setup.bundle import CALIBRATION, Estimate, Prior
from lumidock.setup.observations import LEAST_LIGHTS, Observations
from lumidock.station import Color, Station

_WINDOW = 12  # frames over which lights are told from what passes by
_STEP_PX = 0.012  # of the picture's width: how far a light moves from one frame to the next at most
_TOGETHER_PX = 3.0  # how far a light may be from where the motion of its layer takes it
_PERSISTENT = 0.7  # of a window's frames in which a light is detected
_DEPTHS_M = (0.5, 1.5, 3.0, 5.0, 8.0)  # between the layers, in rms radii of the front one
_GUESS_SIGMA_M = 2.0
_FRONT_COLOR: tuple[Color, ...] = ("white",)
_REAR_COLOR: tuple[Color, ...] = ("blue",)
_MOST_FRAMES = 120
_MOST_NOISE = 3.0  # times the stated error of the centres: a layout that fits no better is wrong


@dataclass(frozen=True, slots=True, eq=False)
class _Tracks:
    """Detections followed through N frames: `uv` (N, M, 2), NaN where missing; front lights first."""

    uv: Array
    first: int


def first_layout(
    recordings: Sequence[Sequence[Detections]], front: int, rear: int, camera: Camera, noise_px: float
) -> Station:
    """A station of `front` white and `rear` blue lights whose front layer has an rms radius of about one metre.

    Raises: InputError where no stretch of frames shows all lights, or no layout fits what they show.
    """
    found = [tracks for one in recordings if (tracks := _follow(one, (front, rear), camera)) is not None]
    if not found:
        raise InputError(
            f"no stretch of frames shows {front} lights of the front and {rear} of the rear colour at once"
        )
    tracks = max(found, key=lambda one: len(one.uv))
    keep = bundle.thinned(np.arange(len(tracks.uv)), _MOST_FRAMES)
    uv = tracks.uv[keep]
    n = len(uv)
    observed = Observations(
        uv, np.full(uv.shape[:2], noise_px), np.zeros(n, np.int64), np.arange(n), tuple(map(str, range(n)))
    )
    fits = [fit for depth in _DEPTHS_M if (fit := _adjusted(observed, front, depth, camera)) is not None]
    best = min(fits, key=lambda fit: float(fit.noise.mean()), default=None)
    if best is None or not float(best.noise.mean()) < _MOST_NOISE:
        raise InputError(
            "no layout fits the lights that were followed; give a drawing, or film nearer and from the side"
        )
    return _station(_upright(best.estimate.p_dock, front), front, rear)


def _classes(d: Detections) -> tuple[Array, Array]:
    """Pixels of the front's and of the rear's colour."""
    lamp = ~(d.p_light < 0.5)
    return d.uv[lamp & (d.p_rear < 0.5)], d.uv[lamp & (d.p_rear >= 0.5)]


def _follow(recording: Sequence[Detections], counts: tuple[int, int], camera: Camera) -> _Tracks | None:
    """The lights of both colours, followed from the nearest stretch that shows all of them, backward in time."""
    frames = [_classes(d) for d in recording]
    reach = _STEP_PX * camera.width
    for last in range(len(frames) - 1, _WINDOW, -_WINDOW // 2):
        seeds = [_seeds([f[k] for f in frames[last - _WINDOW + 1 : last + 1]], counts[k], reach) for k in (0, 1)]
        if seeds[0] is not None and seeds[1] is not None:
            layers = [
                _backward([f[k] for f in frames[: last + 1]], s, reach) for k, s in ((0, seeds[0]), (1, seeds[1]))
            ]
            n = min(len(layer) for layer in layers)
            if n >= 2 * _WINDOW:
                return _Tracks(np.concatenate([layer[:n] for layer in layers], axis=1), last)
    return None


def _seeds(frames: list[Array], count: int, reach: float) -> Array | None:
    """The lights (count, 2) in the last of a window's frames; None unless just so many move together through it."""
    at = frames[-1]
    if len(at) < count:
        return None
    track, hits = at.copy(), np.ones(len(at), int)
    start = at.copy()
    for points in reversed(frames[:-1]):
        nearest = _nearest(start, points, reach)
        hits += nearest >= 0
        start[nearest >= 0] = points[nearest[nearest >= 0]]
    persistent = np.flatnonzero(hits >= _PERSISTENT * len(frames))
    together = _moving_together(track[persistent], start[persistent])
    chosen = persistent[together]
    return track[chosen] if len(chosen) == count else None


def _nearest(points: Array, others: Array, reach: float) -> Indices:
    """For each point (N, 2) the nearest of `others`, -1 beyond `reach` or where another is nearer to it."""
    out = np.full(len(points), -1, np.int64)
    if not len(points) or not len(others):
        return out
    gaps = np.linalg.norm(points[:, None] - others[None], axis=2)
    for i in range(len(points)):
        j = int(gaps[i].argmin())
        if gaps[i, j] < reach and int(gaps[:, j].argmin()) == i:
            out[i] = j
    return out


def _moving_together(now: Array, before: Array) -> np.ndarray:
    """Which points (N,) moved as the largest group of them did: by one shift, turn and growth of the picture."""
    n, best = len(now), np.zeros(len(now), bool)
    z, w = now @ [1.0, 1j], before @ [1.0, 1j]
    for i in range(n):
        for j in range(i):
            if abs(z[i] - z[j]) < 1.0:
                continue
            a = (w[i] - w[j]) / (z[i] - z[j])
            group = np.abs(a * (z - z[i]) + w[i] - w) < _TOGETHER_PX
            if group.sum() > best.sum():
                best = group
    return best


def _backward(frames: list[Array], seed: Array, reach: float) -> Array:
    """The lights (N, M, 2), from the last frame back; ends where fewer than four, or half, can be followed."""
    at = seed.copy()
    out: list[Array] = []
    enough = max(LEAST_LIGHTS, (len(seed) + 1) // 2)
    for points in reversed(frames):
        nearest = _nearest(at, points, reach)
        hit = nearest >= 0
        if hit.sum() < enough:
            if out and len(points):  # a frame that was missed
                out.append(np.full_like(seed, np.nan))
                if np.isnan(np.array(out[-3:])).all():
                    break
                continue
            break
        now = np.full_like(seed, np.nan)
        now[hit] = points[nearest[hit]]
        z, w = at[hit] @ [1.0, 1j], now[hit] @ [1.0, 1j]
        a, b = np.polyfit(z, w, 1)
        moved = a * (at @ [1.0, 1j]) + b
        wrong = np.zeros(len(seed), bool)
        wrong[hit] = np.abs(moved[hit] - w) > 2.0 * _TOGETHER_PX
        now[wrong] = np.nan
        predicted = np.stack([moved.real, moved.imag], axis=1)
        at = np.where(np.isnan(now), predicted, now)
        out.append(now)
    return np.array(out).reshape(-1, len(seed), 2)


def _adjusted(observed: Observations, front: int, depth_m: float, camera: Camera) -> bundle.Adjusted | None:
    """The layout that follows from one guess of the depth; None where its poses cannot be found."""
    whole = int(np.argmax(observed.seen.sum(axis=1)))
    ray = camera.unproject(observed.uv[whole])
    lights = np.isfinite(ray).all(axis=1)
    xy = ray[:, :2] / ray[:, 2:]
    middle = np.nanmean(xy[:front], axis=0)
    distance = 1.0 / np.sqrt(np.nanmean(((xy[:front] - middle) ** 2).sum(axis=1)))
    far = np.where(np.arange(len(xy)) < front, distance, distance + depth_m)
    p = np.stack([xy[:, 0] * far, -xy[:, 1] * far, distance - far], axis=1)
    p[:, :2] -= np.array([1.0, -1.0]) * middle * distance
    p[~lights] = [0.0, 0.0, 0.0]
    poses, kept = [], []
    for k, uv in enumerate(observed.uv):
        seen = np.isfinite(uv[:, 0]) & lights
        T = sqpnp(camera, p[seen], uv[seen]) if seen.sum() >= 6 else None
        if T is not None:
            poses.append(T)
            kept.append(k)
    if len(kept) < _WINDOW:
        return None
    prior = Prior(p, np.full(p.shape, _GUESS_SIGMA_M), 0.003, 2.0)
    return bundle.adjust(
        observed.take(np.array(kept)), camera, prior, Estimate(p, np.array(poses), np.zeros(CALIBRATION))
    )


def _upright(p_dock: Array, front: int) -> Array:
    """The layout with its origin in the middle of the front lights, whose plane faces z."""
    p = p_dock - p_dock[:front].mean(axis=0)
    normal = np.linalg.svd(p[:front])[2][2]
    normal = normal if normal[2] > 0.0 else -normal
    x = np.cross([0.0, 1.0, 0.0], normal)
    x /= np.linalg.norm(x)
    return np.asarray(p @ np.stack([x, np.cross(normal, x), normal], axis=1))


def _station(p_dock: Array, front: int, rear: int) -> Station:
    n = front + rear
    return Station(
        name="found",
        ids=(*(f"F{k + 1}" for k in range(front)), *(f"R{k + 1}" for k in range(rear))),
        layers=("front", "rear"),
        layer=np.repeat([0, 1], [front, rear]).astype(np.int64),
        p_dock=p_dock,
        color=_FRONT_COLOR * front + _REAR_COLOR * rear,
        axis=np.tile([0.0, 0.0, 1.0], (n, 1)),
        beam_deg=np.full(n, 120.0),
        power_w=np.full(n, 2.0),
        docking_point=np.zeros(3),
        sigma_light_m=0.05,
        sigma_layer_m=0.0,
        sigma_focal=0.003,
        sigma_center_px=2.0,
    )
