"""Exhaustive P3P with a consistency vote: every triple of detections with every ordered triple of lights.

Source: M. Faessler, E. Mueggler, K. Schwabe, D. Scaramuzza, "A Monocular Pose Estimation System based on Infrared
LEDs", ICRA 2014, section III. Open in the paper, and read here: an association stands when `MIN_SHARE` of the smaller
of the two sets is found where its pose puts it.
"""

from __future__ import annotations

from itertools import combinations, permutations

import numpy as np

from lumidock.baselines import p3p
from lumidock.baselines.view import LayerView
from lumidock.datatypes import Array, Indices

REACH_PX = 5.0  # lambda_r of the paper: back-projection tolerance
MIN_SHARE = 0.75  # of the lights that must be found where the pose puts them
_MAX_DETECTIONS = 14  # more would cost seconds: the work grows with the cube of the detections


def problems(n_detections: int, n_lights: int) -> tuple[Indices, Indices]:
    """Triples of detections and ordered triples of lights, (B, 3) each: C(n, 3) x m! / (m - 3)! rows."""
    seen = np.array(list(combinations(range(n_detections), 3)), np.int64).reshape(-1, 3)
    lights = np.array(list(permutations(range(n_lights), 3)), np.int64).reshape(-1, 3)
    return np.repeat(seen, len(lights), axis=0), np.tile(lights, (len(seen), 1))


def histogram(view: LayerView) -> Array:
    """Votes (N, M): how many poses that explain at least one further light give each detection each light."""
    n, m = len(view.xy), len(view.p_dock)
    seen, lights = problems(n, m)
    poses = p3p.solve(view.ray_cam[seen], view.p_dock[lights])
    detection, _ = p3p.nearest(view, poses, REACH_PX)
    supported = (detection >= 0).sum(axis=1) > 3
    chosen = detection[supported]
    votes = np.zeros((n, m))
    pose, light = np.nonzero(chosen >= 0)
    np.add.at(votes, (chosen[pose, light], light), 1.0)
    return votes


def associate(view: LayerView, _rng: np.random.Generator) -> Indices | None:
    """Light of each detection by the highest votes, one to one; None where too few agree."""
    if len(view.xy) > _MAX_DETECTIONS:
        return None
    votes = histogram(view)
    light = np.full(len(votes), -1, np.int64)
    while votes.size and votes.max() > 0.0:
        i, j = np.unravel_index(int(votes.argmax()), votes.shape)
        light[i] = j
        votes[i], votes[:, j] = 0.0, 0.0
    return _confirmed(view, light)


def _confirmed(view: LayerView, light: Indices) -> Indices | None:
    """What of an association the best pose of its own triples confirms."""
    identified = np.flatnonzero(light >= 0)
    if len(identified) < 4:
        return None
    triples = np.array(list(combinations(identified.tolist(), 3)), np.int64)
    poses = p3p.solve(view.ray_cam[triples], view.p_dock[light[triples]])
    if not len(poses):
        return None
    detection, distance2 = p3p.nearest(view, poses, REACH_PX)
    agrees = np.zeros(detection.shape, bool)
    agrees[:, light[identified]] = detection[:, light[identified]] == identified
    cost = np.where(agrees, distance2, REACH_PX**2).sum(axis=1)
    best = int(cost.argmin())
    confirmed = np.where((light >= 0) & agrees[best][light], light, -1)
    wanted = MIN_SHARE * min(len(view.xy), len(view.p_dock))
    return confirmed if (confirmed >= 0).sum() >= max(4.0, wanted) else None
