"""P3P on neighbouring detections and neighbouring lights, with a model of which lights can be seen.

The search of headset trackers: a detection and two of its nearest neighbours are tried against a light and two of its
nearest neighbours, and a pose counts by the visible lights that it explains.
Source: J. Schmidt's constellation tracker for the Oculus Rift (OpenHMD, Monado). Its thresholds are for a headset of
some forty lights; those below are for a layer of seven.
"""

from __future__ import annotations

from itertools import combinations, permutations

import numpy as np

from lumidock.baselines import p3p
from lumidock.baselines.view import LayerView
from lumidock.datatypes import Array, Indices

REACH_PX = 5.0  # from a projected light to its detection
NEAR_DETECTIONS, NEAR_LIGHTS = 3, 4  # neighbours tried; one light more, since the nearest one may be missing
_MIN_FACING = 0.0  # cosine between a light's axis and the direction to the camera; at or below, it is not visible
_MIN_SHARE = 0.5  # of the visible lights that must be explained


def _neighbours(points: Array, count: int) -> Indices:
    """The `count` nearest other points of each (N, count), nearest first."""
    distance = np.linalg.norm(points[:, None] - points[None], axis=2)
    np.fill_diagonal(distance, np.inf)
    return np.asarray(np.argsort(distance, axis=1, kind="stable")[:, : min(count, len(points) - 1)], np.int64)


def problems(view: LayerView) -> tuple[Indices, Indices]:
    """Triples of detections and of lights (B, 3) each; their number is linear in detections times lights."""
    seen = [
        (i, *pair) for i, near in enumerate(_neighbours(view.xy, NEAR_DETECTIONS)) for pair in combinations(near, 2)
    ]
    close = _neighbours(view.p_dock, NEAR_LIGHTS)
    lights = [(j, *pair) for j, near in enumerate(close) for pair in permutations(near, 2)]
    a, b = (np.array(rows, np.int64).reshape(-1, 3) for rows in (seen, lights))
    return np.repeat(a, len(b), axis=0), np.tile(b, (len(a), 1))


def visible(view: LayerView, poses: p3p.Poses) -> np.ndarray:
    """Which lights (K, M) shine toward the camera from each pose."""
    t_dock_cam = -np.einsum("kji,kj->ki", poses.R_cam_dock, poses.t_cam_dock)
    to_camera = t_dock_cam[:, None] - view.p_dock
    facing = (to_camera * view.axis).sum(axis=2) / np.linalg.norm(to_camera, axis=2)
    return np.asarray(facing > _MIN_FACING)


def associate(view: LayerView, _rng: np.random.Generator) -> Indices | None:
    """Light of each detection from the pose that explains most visible lights; None where it explains too few."""
    seen, lights = problems(view)
    poses = p3p.solve(view.ray_cam[seen], view.p_dock[lights])
    if not len(poses):
        return None
    can_be_seen = visible(view, poses)
    detection, distance2 = p3p.nearest(view, poses, REACH_PX)
    detection[~can_be_seen] = -1
    matched = (detection >= 0).sum(axis=1)
    residual = np.where(detection >= 0, distance2, 0.0).sum(axis=1) / REACH_PX**2
    best = int((matched - residual / (1.0 + residual)).argmax())
    light = p3p.one_to_one(detection[best], distance2[best], len(view.xy))
    count = int((light >= 0).sum())
    return light if count >= 4 and count > _MIN_SHARE * can_be_seen[best].sum() else None
