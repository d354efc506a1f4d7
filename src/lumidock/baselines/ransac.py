"""RANSAC over P3P hypotheses, with unknown correspondences.

Source: M. A. Fischler, R. C. Bolles, "Random Sample Consensus", 1981: draw three, solve, count who agrees, and draw as
often as their formula asks. There the three come with their correspondence; here that is drawn too, which makes a
good draw rarer.
"""

from __future__ import annotations

import math

import numpy as np

from lumidock.baselines import p3p
from lumidock.baselines.view import LayerView
from lumidock.datatypes import Indices

REACH_PX = 4.0  # eight standard deviations of the paper's centroids, which P3P amplifies
SURE = 0.99  # probability that one draw at least was good
_MAX_DRAWS = 20_000


def draws_wanted(good: float, sure: float = SURE) -> int:
    """How many draws, of which a share `good` is good, hold one good one with probability `sure`."""
    return math.ceil(math.log(1.0 - sure) / math.log1p(-good))


def share_of_good_draws(n_detections: int, n_lights: int, spurious: int) -> float:
    """Probability that three random detections are true and are given their own lights."""
    true = math.comb(n_detections - spurious, 3) / math.comb(n_detections, 3)
    return true / (n_lights * (n_lights - 1) * (n_lights - 2))


def associate(view: LayerView, rng: np.random.Generator) -> Indices | None:
    """Light of each detection from the pose that most detections agree with; None with fewer than four."""
    n, m = len(view.xy), len(view.p_dock)
    good = share_of_good_draws(n, m, max(n - m, 0))  # at least so many detections are spurious
    count = min(draws_wanted(good), _MAX_DRAWS) if good > 0.0 else _MAX_DRAWS
    seen, lights = (rng.random((count, k)).argsort(axis=1)[:, :3] for k in (n, m))
    poses = p3p.solve(view.ray_cam[seen], view.p_dock[lights])
    if not len(poses):
        return None
    detection, distance2 = p3p.nearest(view, poses, REACH_PX)
    agreeing = (detection >= 0).sum(axis=1)
    residual = np.where(detection >= 0, distance2, 0.0).sum(axis=1) / REACH_PX**2
    best = int((agreeing - residual / (1.0 + residual)).argmax())
    light = p3p.one_to_one(detection[best], distance2[best], n)
    return light if (light >= 0).sum() >= 4 else None
