"""Faults of a dock at point level: glints beside lamps, other arrays, lights that are not where the file says.

Shapes: N frames, G runs, M lights, K further points that shine. Faults of `PointFaults` are those of a single run.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lumidock.camera import Camera
from lumidock.datatypes import Array, Indices
from lumidock.sim.course import Course, project_each
from lumidock.sim.fault_knobs import PointFaults
from lumidock.sim.scenario import DetectionKnobs
from lumidock.station import Station

_MIRRORS = {"surface": (1, 1.0), "floor": (1, -1.0), "wall": (0, 0.0)}  # axis of `dock`, sign; a wall is on either side
_BEFORE_MIRROR_M = 0.2  # a camera nearer to the mirror, or behind it, sees no image
_MARGIN_S = 3.0  # of a run's begin and end in which nothing happens
_BOX_M = ((-1.2, 1.2), (-1.2, 1.2), (-0.5, 0.2))  # of lamps on the structure that the file does not list


@dataclass(frozen=True, slots=True, eq=False)
class Extras:
    """Points that shine beside the dock's lights.

    `p_dock` (G, K, 3) m; `on` (N, K): in which frames; `rear` (G, K): whether they look like lights of a rear layer.
    """

    p_dock: Array
    on: np.ndarray
    rear: np.ndarray

    @classmethod
    def together(cls, parts: list[Extras]) -> Extras:
        """All points of several."""
        return cls(
            *(np.concatenate([getattr(one, name) for one in parts], axis=1) for name in ("p_dock", "on", "rear"))
        )


class LampFaults(NamedTuple):
    """Which lamps are `off` (N, M), and `extras` that shine beside them."""

    off: np.ndarray
    extras: Extras


@dataclass(frozen=True, slots=True, eq=False)
class LensFaults:
    """The true lens against the calibrated one: relative `scale` (N,), `shift_px` (N, 2), and missing `distortion`."""

    scale: Array
    shift_px: Array
    distortion: float

    def distorted(self, camera: Camera, uv: Array) -> Array:
        """Pixels (N, M, 2) through the true lens, of pixels through the calibrated one."""
        r2 = (((uv - camera.center_px) / camera.focal_px) ** 2).sum(axis=2, keepdims=True)
        stretched = 1.0 + self.distortion * r2 + self.scale[:, None, None]
        return np.asarray((uv - camera.center_px) * stretched + camera.center_px + self.shift_px[:, None])


def _either(rng: np.random.Generator, bounds: tuple[float, float]) -> float:
    """A draw of either sign whose size is uniform within the bounds."""
    return float(rng.uniform(*bounds) * rng.choice([-1.0, 1.0]))


def _around(rng: np.random.Generator, bounds: tuple[float, float]) -> Array:
    """A draw (2,) in any direction of the plane whose length is uniform within the bounds."""
    angle = rng.uniform(0.0, 2.0 * np.pi)
    return np.asarray(rng.uniform(*bounds) * np.array([np.cos(angle), np.sin(angle)]))


def _directions(rng: np.random.Generator, count: int) -> Array:
    """Random unit vectors (count, 3)."""
    way = rng.normal(size=(count, 3))
    return np.asarray(way / np.linalg.norm(way, axis=1, keepdims=True))


def some_time(rng: np.random.Generator, t_s: Array, length_s: float) -> np.ndarray:
    """Which frames (N,) lie in a time of this length that begins at random, well inside the run where it fits."""
    last = max(float(t_s[-1]) - _MARGIN_S - length_s, 0.0)
    begin = rng.uniform(min(_MARGIN_S, last), last) if last else 0.0
    return np.asarray((t_s >= begin) & (t_s < begin + length_s))


def with_memory(rng: np.random.Generator, t_s: Array, memory_s: float, shape: tuple[int, ...]) -> Array:
    """A first-order Gauss-Markov process of unit variance at times (N,): (N, *shape)."""
    new = rng.normal(size=(len(t_s), *shape))
    kept = np.exp(-np.diff(t_s) / memory_s)
    for k, share in enumerate(kept, start=1):
        new[k] = share * new[k - 1] + np.sqrt(1.0 - share**2) * new[k]
    return new


def bent(knobs: DetectionKnobs, p_dock: Array, rng: np.random.Generator) -> Array:
    """Light positions (G, M, 3) m with one light of each run moved by `bent_m` in a direction of its own."""
    runs, lights, _ = p_dock.shape
    moved = p_dock.copy()
    way = _directions(rng, runs)
    moved[np.arange(runs), rng.integers(lights, size=runs)] += knobs.bent_m * way
    return moved


def missurveyed(faults: PointFaults, station: Station, p_dock: Array, rng: np.random.Generator) -> Array:
    """Light positions (G, M, 3) m with the errors of the whole survey and of its layers added."""
    rear = station.layer != station.layers.index(station.layers_front_to_rear()[0])
    moved = p_dock + rng.normal(size=p_dock.shape) * faults.off_m
    deep = rear if rear.any() else station.p_dock[:, 0] > 0.0
    shift = _around(rng, (faults.layer_shift_m, faults.layer_shift_m))
    moved[:, deep] += [*shift, -rng.uniform(*faults.layer_depth_m)]
    angle = np.deg2rad(_either(rng, faults.layer_turn_deg))
    turned = ~rear if rear.any() else ~deep
    c, s = np.cos(angle), np.sin(angle)
    moved[:, turned] = moved[:, turned] @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return moved


def glints(
    knobs: DetectionKnobs, p_dock: Array, course: Course, dead: np.ndarray, rear: np.ndarray, rng: np.random.Generator
) -> Extras:
    """The glints of each run, beside dead lamps first."""
    runs, lights, _ = p_dock.shape
    most = min(knobs.glints[1], lights)
    count = np.asarray(rng.integers(*knobs.glints, runs, endpoint=True))
    beside = np.argsort(rng.random((runs, lights)) + ~dead, axis=1)[:, :most]
    p_glint = np.take_along_axis(p_dock, beside[:, :, None], axis=1) + _beside(knobs, (runs, most), rng)
    return Extras(p_glint, (np.arange(most) < count[:, None])[course.run], rear[beside])


def _beside(knobs: DetectionKnobs, shape: tuple[int, int], rng: np.random.Generator) -> Array:
    """Offsets (G, K, 3) m of glints from their lamps, across the dock's axis."""
    away, angle = rng.uniform(*knobs.glint_m, shape), rng.uniform(0.0, 2.0 * np.pi, shape)
    return np.stack([away * np.cos(angle), away * np.sin(angle), np.zeros_like(away)], axis=2)


def dead_lamps(faults: PointFaults, rear: np.ndarray, dead: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Which lamps (G, M) are dead where only so many of the front layer work; otherwise those that were."""
    if faults.front_left is None:
        return dead
    left, front = int(rng.integers(*faults.front_left, endpoint=True)), np.flatnonzero(~rear)
    only = np.zeros_like(dead)
    only[:, rng.permutation(front)[left:]] = True
    return only


def lamp_faults(
    knobs: DetectionKnobs, rear: np.ndarray, p_dock: Array, course: Course, rng: np.random.Generator
) -> LampFaults:
    """Lamps of one run that are off although the station says that they shine, and what shines beside them."""
    faults, t_s, n, m = knobs.faults, course.t_ns * 1e-9, len(course.t_ns), len(rear)
    off, stolen = np.zeros((n, m), bool), rng.permutation(m)[: int(rng.integers(*faults.theft, endpoint=True))]
    since = rng.uniform(_MARGIN_S, max(float(t_s[-1]) - _MARGIN_S, _MARGIN_S), len(stolen))
    gone = t_s[:, None] > since
    off[:, stolen] |= gone
    thieves = Extras(p_dock[:, stolen] + _beside(knobs, (1, len(stolen)), rng), gone, rear[None, stolen])
    if faults.blink_hz[1] > 0.0:
        rate, phase = rng.uniform(*faults.blink_hz, m), rng.random(m)
        off |= (t_s[:, None] * rate + phase) % 1.0 >= faults.blink_on
    if faults.layer_off_s:
        off |= some_time(rng, t_s, faults.layer_off_s)[:, None] & ~rear
    if faults.dock_off_s:
        off |= some_time(rng, t_s, faults.dock_off_s)[:, None]
    extras = [thieves, _image(faults, rear, p_dock, course, rng), _unlisted(faults, n, rng)]
    if np.any(faults.twin_m):
        extras.append(Extras(p_dock + faults.twin_m, np.ones((n, m), bool), rear[None]))
    return LampFaults(off, Extras.together(extras))


def _image(faults: PointFaults, rear: np.ndarray, p_dock: Array, course: Course, rng: np.random.Generator) -> Extras:
    """The mirror image of all lights of a run."""
    n, m = len(course.t_ns), len(rear)
    if faults.image == "none":
        return Extras(np.empty((1, 0, 3)), np.empty((n, 0), bool), np.empty((1, 0), bool))
    axis, sign = _MIRRORS[faults.image]
    at = rng.uniform(*faults.image_m) * (sign or rng.choice([-1.0, 1.0]))
    image = p_dock.copy()
    image[:, :, axis] = 2.0 * at - image[:, :, axis]
    before = course.T_dock_cam[:, axis, 3] * np.sign(at) < abs(at) - _BEFORE_MIRROR_M
    return Extras(image, np.repeat(before[:, None], m, axis=1), rear[None])


def _unlisted(faults: PointFaults, n: int, rng: np.random.Generator) -> Extras:
    """Lamps on the structure that the station file does not list."""
    k = int(rng.integers(*faults.unlisted, endpoint=True))
    p_dock = np.stack([rng.uniform(*side, k) for side in _BOX_M], axis=1)
    return Extras(p_dock[None], np.ones((n, k), bool), rng.random((1, k)) < 0.5)


def seen_extras(
    knobs: DetectionKnobs, camera: Camera, course: Course, extras: Extras, lens: LensFaults, black: np.ndarray
) -> tuple[Indices, Array, np.ndarray]:
    """Frame (S,), pixels (S, 2) and look (S,) of those in the picture and nearer than a front light is seen."""
    uv, p_cam = project_each(camera, course.T_dock_cam, extras.p_dock[course.run])
    uv = lens.distorted(camera, uv)
    near = np.linalg.norm(p_cam, axis=2) < knobs.front_range_m[0]
    seen = camera.contains(uv) & near & (p_cam[..., 2] > 0.0) & extras.on & ~black[:, None]
    seen &= course.T_dock_cam[:, None, 2, 3] > extras.p_dock[course.run][..., 2]  # lamps and glints shine out of it
    frame, k = np.nonzero(seen)
    return frame, uv[frame, k], extras.rear[course.run[frame], k]


def lens_faults(faults: PointFaults, t_s: Array, rng: np.random.Generator) -> LensFaults:
    """The true lens in every frame of a run at times (N,)."""
    scale = np.full(len(t_s), _either(rng, faults.focal_error))
    shift_px = np.tile(_around(rng, faults.center_px), (len(t_s), 1))
    memory_s = float(np.exp(rng.uniform(*np.log(faults.memory_s))))
    if faults.scale:
        scale += faults.scale * with_memory(rng, t_s, memory_s, ())
    if faults.shift_px:
        shift_px += faults.shift_px * with_memory(rng, t_s, memory_s, (2,))
    return LensFaults(scale, shift_px, faults.distortion)


def no_lens_faults(n: int) -> LensFaults:
    """The calibrated lens in N frames."""
    return LensFaults(np.zeros(n), np.zeros((n, 2)), 0.0)


def faulty_noise(
    faults: PointFaults, noise: Array, frame: Indices, light: Indices, t_s: Array, rng: np.random.Generator
) -> Array:
    """Unit noise (S, 2) of detections with memory for those of a `light` (S,), in frames taken at times (N,)."""
    if faults.memory_share:
        memory_s = float(np.exp(rng.uniform(*np.log(faults.memory_s))))
        slow, of = with_memory(rng, t_s, memory_s, (max(int(light.max(initial=-1)) + 1, 1), 2)), light >= 0
        noise = noise.copy()
        noise[of] *= np.sqrt(1.0 - faults.memory_share)
        noise[of] += np.sqrt(faults.memory_share) * slow[frame[of], light[of]]
    return noise


def outliers(faults: PointFaults, n: int, rng: np.random.Generator) -> Array:
    """Errors (n, 2) px of the centroids that are outliers, 0 for the others."""
    way, which = rng.uniform(0.0, 2.0 * np.pi, n), rng.random(n) < faults.outliers
    away = rng.uniform(*faults.outlier_px, n) * which
    return np.stack([away * np.cos(way), away * np.sin(way)], axis=1)


def none_of(course: Course, rear: np.ndarray) -> LampFaults:
    """No fault of any lamp."""
    n, runs = len(course.t_ns), len(course.surface_m)
    return LampFaults(
        np.zeros((n, len(rear)), bool),
        Extras(np.empty((runs, 0, 3)), np.empty((n, 0), bool), np.empty((runs, 0), bool)),
    )
