"""Refraction at a flat port: a plane of glass across the optical axis, between the lens in air and the water.

A point in the water is seen at the tangent `a` of the angle in air for which the layers that the ray crosses reach the
point's distance r from the axis: r = sum_i d_i a / sqrt(n_i^2 + (n_i^2 - 1) a^2), by Snell's law, with thickness d_i
and refractive index n_i. The rays do not meet in one point, so no pinhole model is exact.
Source: A. Agrawal, S. Ramalingam, Y. Taguchi, V. Chari, "A Theory of Multi-Layer Flat Refractive Geometry", CVPR 2012.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lumidock.datatypes import Array

STEEPEST = 20.0  # tangent in air beyond which no lens behind a flat port sees, 87 degrees
_NEWTON_STEPS = 30
_TOLERANCE = 1e-13  # of the distance from the axis, relative
_Layers = tuple[tuple["float | Array", float], ...]  # thickness m, refractive index


@dataclass(frozen=True, slots=True)
class FlatPort:
    """A window `distance_m` of air in front of the entrance pupil, `glass_m` thick, before water of index `index`."""

    distance_m: float
    index: float = 1.34
    glass_m: float = 0.0
    glass_index: float = 1.5

    @property
    def layers(self) -> tuple[tuple[float, float], ...]:
        """Thickness m and refractive index of what lies before the water."""
        return (self.distance_m, 1.0), (self.glass_m, self.glass_index)

    @property
    def viewpoint_m(self) -> float:
        """How far behind the pupil the rays near the axis meet, m: the place of the pinhole that they seem to have."""
        return sum(thickness * (self.index / n - 1.0) for thickness, n in self.layers)

    def in_air(self, p_cam: Array) -> tuple[Array, Array]:
        """Coordinates (N, 2) at unit depth in air at which points `p_cam` (N, 3) m appear, and J_xy_p (N, 2, 3) 1/m.

        NaN for points that are not in the water or whose light does not pass the port. Newton's method from the
        paraxial solution: the reach grows with the angle and bends downward, so that it converges from below.
        """
        r = np.hypot(p_cam[:, 0], p_cam[:, 1])
        depth = p_cam[:, 2] - self.distance_m - self.glass_m
        water = np.where(depth > 0.0, depth, np.nan), self.index
        layers: _Layers = (*self.layers, water)
        a = r / sum(thickness / n for thickness, n in layers)
        for _ in range(_NEWTON_STEPS):
            step = (r - _reach(layers, a)) / _slope(layers, a)
            a = np.where(a < STEEPEST, a + step, np.nan)
            if not (np.abs(step) > _TOLERANCE * a).any():
                break
        slope = _slope(layers, a)
        across = np.divide(p_cam[:, :2], r[:, None], out=np.zeros((len(r), 2)), where=r[:, None] > 0.0)
        scale = np.divide(a, r, out=1.0 / slope, where=r > 0.0)
        J = np.empty((len(r), 2, 3))
        J[:, :, :2] = scale[:, None, None] * np.eye(2)
        J[:, :, :2] += (1.0 / slope - scale)[:, None, None] * across[:, :, None] * across[:, None, :]
        J[:, :, 2] = -(_bent(a, self.index) / slope)[:, None] * across
        return across * a[:, None], J

    def in_water(self, ray_air: Array) -> Array:
        """Unit directions (N, 3) in the water of rays (N, 3) that reach the lens along unit `ray_air` (N, 3)."""
        across = ray_air[:, :2] / self.index  # a plane-parallel glass does not change the angle
        return np.column_stack([across, np.sqrt(1.0 - (across * across).sum(axis=1))])


def _bent(a: Array, n: float) -> Array:
    """Tangent in a medium of index `n` of a ray whose tangent in air is `a` (N,)."""
    return np.asarray(a / np.sqrt(n * n + (n * n - 1.0) * a * a))


def _reach(layers: _Layers, a: Array) -> Array:
    return np.asarray(sum(thickness * _bent(a, n) for thickness, n in layers))


def _slope(layers: _Layers, a: Array) -> Array:
    return np.asarray(sum(thickness * n * n / (n * n + (n * n - 1.0) * a * a) ** 1.5 for thickness, n in layers))
