"""Docks that were not built as drawn, and dockings that show them as they are."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lumidock.camera import Camera, load_camera
from lumidock.cli.shared import shipped_or_path
from lumidock.datatypes import Array, Detections
from lumidock.sim.detections import simulated_frames
from lumidock.sim.scenario import load_scenario
from lumidock.station import Station, load_station


@dataclass(frozen=True)
class BuiltDock:
    """A drawing, the dock as it stands, the camera as its file has it, and recordings by the camera as it is."""

    drawing: Station
    built: Station
    camera: Camera
    recordings: list[list[Detections]]
    lights: list[list[Array]]  # of each detection, -1 for a spurious one


def built_dock(
    seed: int, *, off_m: float = 0.05, dockings: int = 2, interval_s: float = 0.2, settings: tuple[str, ...] = ()
) -> BuiltDock:
    """The paper's cage each light off by 1 sigma `off_m` per axis, and dockings with `interval_s` between frames."""
    rng = np.random.default_rng([seed, 99])
    drawing = load_station(shipped_or_path("station", "cage-2x2x5"))
    camera = load_camera(shipped_or_path("camera", "imx264-60deg"))
    built = replace(drawing, p_dock=drawing.p_dock + rng.normal(size=drawing.p_dock.shape) * off_m)
    K = camera.K.copy()
    K[[0, 1], [0, 1]] *= 1.0 + rng.normal() * drawing.sigma_focal
    K[:2, 2] += rng.normal(size=2) * drawing.sigma_center_px
    as_it_is = Camera(camera.width, camera.height, K)
    own = ("detections.survey=0", "detections.calibration=0", f"path.frame_interval_s={interval_s}")
    scenario = load_scenario("nominal", (*own, *settings))
    frames = [list(simulated_frames(scenario, built, as_it_is, 1000 * seed + k)) for k in range(dockings)]
    return BuiltDock(
        replace(drawing, sigma_light_m=off_m, sigma_layer_m=0.0),
        built,
        camera,
        [[frame.detections for frame in recording] for recording in frames],
        [[frame.light for frame in recording] for recording in frames],
    )


def taped(dock: BuiltDock, a: str, b: str) -> tuple[int, int, float]:
    """The indices of two lights, and how far apart they stand."""
    i, j = dock.drawing.ids.index(a), dock.drawing.ids.index(b)
    return i, j, float(np.linalg.norm(dock.built.p_dock[i] - dock.built.p_dock[j]))


def shape_error(found: Array, true: Array, seen: np.ndarray, *, scale: bool) -> Array:
    """Errors (M, 3) after the best rigid or similarity fit over the lights seen, by Kabsch's method."""
    a, b = true[seen] - true[seen].mean(axis=0), found[seen] - found[seen].mean(axis=0)
    U, _, Vt = np.linalg.svd(b.T @ a)
    R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    k = float((b * (a @ R.T)).sum() / (a**2).sum()) if scale else 1.0
    return found - (k * (true - true[seen].mean(axis=0)) @ R.T + found[seen].mean(axis=0))
