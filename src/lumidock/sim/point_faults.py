"""Faults of a dock at point level: glints that stand still beside lamps, lights that are not where the file says."""

from __future__ import annotations

import numpy as np

from lumidock.camera import Camera
from lumidock.datatypes import Array, Indices
from lumidock.sim.course import Course, project_each
from lumidock.sim.scenario import DetectionKnobs


def bent(knobs: DetectionKnobs, p_dock: Array, rng: np.random.Generator) -> Array:
    """Light positions (G, M, 3) m with one light of each run moved by `bent_m` in a direction of its own."""
    runs, lights, _ = p_dock.shape
    way = rng.normal(size=(runs, 3))
    moved = p_dock.copy()
    moved[np.arange(runs), rng.integers(lights, size=runs)] += (
        knobs.bent_m * way / np.linalg.norm(way, axis=1, keepdims=True)
    )
    return moved


def glints(
    knobs: DetectionKnobs, p_dock: Array, dead: np.ndarray, rng: np.random.Generator
) -> tuple[Array, np.ndarray]:
    """Positions (G, K, 3) m of the glints of each run, and which of them (G, K) there are: beside dead lamps first."""
    runs, lights, _ = p_dock.shape
    most = min(knobs.glints[1], lights)
    count = np.asarray(rng.integers(*knobs.glints, runs, endpoint=True))
    beside = np.argsort(rng.random((runs, lights)) + ~dead, axis=1)[:, :most]
    away, angle = rng.uniform(*knobs.glint_m, (runs, most)), rng.uniform(0.0, 2.0 * np.pi, (runs, most))
    offset = np.stack([away * np.cos(angle), away * np.sin(angle), np.zeros_like(away)], axis=2)
    return np.take_along_axis(p_dock, beside[:, :, None], axis=1) + offset, np.arange(most) < count[:, None]


def seen_glints(
    knobs: DetectionKnobs, camera: Camera, course: Course, places: tuple[Array, np.ndarray], black: np.ndarray
) -> tuple[Indices, Array]:
    """Frame (S,) and pixels (S, 2) of the glints that are in the picture and nearer than a front light is seen."""
    p_dock, there = places
    uv, p_cam = project_each(camera, course.T_dock_cam, p_dock[course.run])
    near = np.linalg.norm(p_cam, axis=2) < knobs.front_range_m[0]
    ahead = p_cam[..., 2] > 0.0
    frame, k = np.nonzero(camera.contains(uv) & near & ahead & there[course.run] & ~black[:, None])
    return frame, uv[frame, k]
