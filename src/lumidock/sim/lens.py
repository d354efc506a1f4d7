"""The true lens: projection, refraction at a flat port, solid angle of a pixel, and loss of light off the axis."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from lumidock.camera import Camera
from lumidock.datatypes import Array
from lumidock.sim.knobs import LensKnobs, Port

_NEWTON_STEPS = 30  # bisection alone would leave 1e-9
_FIT_GRID, _FIT_STEPS = 15, 8  # points along each side of the picture, Gauss-Newton steps


@dataclass(frozen=True, eq=False)
class Lens:
    """The true lens, which need not project as camera.yaml says.

    `camera` is how it projects without a port, `index` the refractive index of the water. Behind a port rays do not
    meet in one point; the origin of `cam` is then the point that a calibration in water finds, `viewpoint_m` in front
    of the entrance pupil.
    """

    knobs: LensKnobs
    camera: Camera
    index: float
    viewpoint_m: float = 0.0

    @classmethod
    def of(
        cls, knobs: LensKnobs, camera: Camera, index: float, focal: float = 0.0, center_px: Array | None = None
    ) -> Lens:
        """The lens of a `camera` that was calibrated in water, with calibration errors.

        `focal` is a relative error of the focal length in addition to that of the knobs, `center_px` (2,) the error of
        the principal point. A lens behind a port gets the focal length in air that gives the calibrated one in water.
        """
        K = camera.K.copy()
        K[[0, 1], [0, 1]] *= (1.0 + knobs.focal_error + focal) / (index if knobs.port else 1.0)
        K[:2, 2] += np.zeros(2) if center_px is None else center_px
        lens = cls(knobs, replace(camera, K=K), index)
        return lens if knobs.port is None else replace(lens, viewpoint_m=_fit_in_water(lens, knobs.port)[0])

    def project(self, p_cam: Array) -> Array:
        """Pixels (N, 2) of points `p_cam` (N, 3) m in the water; NaN where a point has no image."""
        if self.knobs.port is None:
            return self.camera.project(p_cam)
        return self.camera.project(
            _refracted_by_port(self.knobs.port, self.index, p_cam + np.array([0.0, 0.0, self.viewpoint_m]))
        )

    def rays(self, uv: Array) -> Array:
        """Unit directions `ray_cam` (N, 3) in the water from which light reaches pixels `uv` (N, 2)."""
        ray = self.camera.unproject(uv)
        if self.knobs.port is None:
            return ray
        across = ray[:, :2] / self.index  # Snell's law; a plane-parallel glass does not change the angle
        return np.column_stack([across, np.sqrt(1.0 - (across * across).sum(axis=1))])

    def tangents(self, uv: Array) -> Array:
        """Jacobian J_ray_uv (N, 3, 2) 1/px of the rays with respect to pixels `uv` (N, 2)."""
        step = 0.5 * np.eye(2)
        return np.stack([self.rays(uv + move) - self.rays(uv - move) for move in step], axis=2)

    def solid_angle(self, uv: Array) -> Array:
        """Solid angle (N,) sr in the water from which each of the pixels `uv` (N, 2) gets light."""
        J = self.tangents(uv)
        return np.asarray(np.linalg.norm(np.cross(J[:, :, 0], J[:, :, 1]), axis=1))

    def throughput(self, uv: Array) -> Array:
        """Transmission (N,) toward pixels `uv` (N, 2) relative to the axis: foreshortened aperture and vignetting."""
        across = np.linalg.norm(uv - self.camera.center_px, axis=1) / self._corner_px
        return np.asarray(self.camera.unproject(uv)[:, 2] * (1.0 - self.knobs.falloff * np.minimum(across, 1.2) ** 2))

    @cached_property
    def _corner_px(self) -> float:
        return float(np.hypot(self.camera.width, self.camera.height)) / 2.0

    @cached_property
    def aperture_m2(self) -> float:
        """Area m2 of the entrance pupil."""
        return float(np.pi * (self.knobs.focal_m / self.knobs.f_number / 2.0) ** 2)


def _refracted_by_port(port: Port, index: float, p_cam: Array) -> Array:
    """Unit directions (N, 3) in air at which the lens receives light from points `p_cam` (N, 3) m in the water.

    Each layer i between the entrance pupil and the point has thickness d_i and refractive index n_i. With s the sine of
    the angle in air, Snell's law makes s / n_i the sine in layer i, so that sum_i d_i s / sqrt(n_i^2 - s^2) = r, the
    distance of the point from the axis. Newton's method with bisection as safeguard solves it for s.
    Source: A. Agrawal et al., CVPR 2012, for a port across the axis.
    """
    r, rest = np.hypot(p_cam[:, 0], p_cam[:, 1]), p_cam[:, 2] - port.gap_m - port.glass_m
    layers = ((port.gap_m, 1.0), (port.glass_m, port.glass_index), (rest, index))
    s = np.clip(index * r / np.hypot(r, np.maximum(p_cam[:, 2], 1e-9)), 0.0, 0.999)
    low, high = np.zeros_like(s), np.ones_like(s)
    for _ in range(_NEWTON_STEPS):
        reach = sum(d * s / np.sqrt(n * n - s * s) for d, n in layers)
        slope = sum(d * n * n / (n * n - s * s) ** 1.5 for d, n in layers)
        low, high = np.where(reach < r, s, low), np.where(reach < r, high, s)
        step = s - (reach - r) / slope
        s = np.where((step >= low) & (step <= high), step, 0.5 * (low + high))
    direction = p_cam[:, :2] / np.maximum(r, 1e-12)[:, None]
    ray_air = np.column_stack([direction * s[:, None], np.sqrt(1.0 - s * s)])
    ray_air[~(rest > 0.0)] = np.nan
    return ray_air


def calibrated_in_water(lens: Lens, camera: Camera) -> Camera:
    """The content of camera.yaml: `camera`, or behind a port the plumb_bob model that a calibration in water gives."""
    if lens.knobs.port is None:
        return camera
    _, f, k1, k2, k3 = _fit_in_water(lens, lens.knobs.port)
    K = lens.camera.K.copy()
    K[0, 0] = K[1, 1] = f
    return Camera(camera.width, camera.height, K, "plumb_bob", np.array([k1, k2, 0.0, 0.0, k3]))


def _fit_in_water(lens: Lens, port: Port) -> Array:
    """Viewpoint m, focal length px and k1, k2, k3 (5,) that describe the lens behind its port best.

    Least squares by Gauss-Newton over the picture and over targets at the distances `calibrated_at_m`. Residuals remain
    because light through a flat port does not meet in a single viewpoint.
    """
    camera = lens.camera
    u, v = (np.linspace(0.0, size - 1.0, _FIT_GRID) for size in (camera.width, camera.height))
    rays = lens.rays(np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2))
    p = np.concatenate([rays * (z / rays[:, 2:]) for z in np.linspace(*port.calibrated_at_m, 5)])
    uv = camera.project(_refracted_by_port(port, lens.index, p)) - camera.center_px
    viewpoint = 0.0
    for _ in range(_FIT_STEPS):
        xy = p[:, :2] / (p[:, 2:] - viewpoint)
        r2 = (xy * xy).sum(axis=1, keepdims=True)
        columns = np.stack([(xy * r2**power).ravel() for power in range(4)], axis=1)
        terms = np.linalg.lstsq(columns, uv.ravel(), rcond=None)[0]
        slope = sum((2 * power + 1) * terms[power] * r2**power for power in range(4)) * xy / (p[:, 2:] - viewpoint)
        terms = np.linalg.lstsq(np.column_stack([columns, slope.ravel()]), uv.ravel(), rcond=None)[0]
        viewpoint += terms[4]
    return np.array([viewpoint, terms[0], *(terms[1:4] / terms[0])])
