"""A small learned matcher: one network embeds detections and lights by what surrounds them; near embeddings match.

The encoder is a sum over the other points of the set, so that their order does not matter (M. Zaheer et al., "Deep
Sets", 2017); inner products of the embeddings beside a "no light" class are matched as in P.-E. Sarlin et al.,
"SuperGlue", 2020, by the Hungarian method in place of optimal transport. The weights in `learned.json` are trained by
`python -m bench learned-matcher` on random layouts, none of which is a layout that the comparison uses.
"""

from __future__ import annotations

import json
from functools import cache
from importlib.resources import files
from typing import NamedTuple

import numpy as np

from lumidock._kernels.assignment import assign
from lumidock.baselines.hungarian import normalized
from lumidock.baselines.view import LayerView
from lumidock.datatypes import Array, Indices

MODEL = "learned.json"
_LEAST = 0.5  # probability of an association; below it the detection is spurious


class Network(NamedTuple):
    """Weights: of a neighbour (3, H), (H,), (H, H), (H,); of a point (H + 2, H), (H,), (H, E), (E,); no light (1,)."""

    w1: Array
    b1: Array
    w2: Array
    b2: Array
    w3: Array
    b3: Array
    w4: Array
    b4: Array
    spurious: Array


class Encoded(NamedTuple):
    """Embeddings (B, N, E) of B sets, and what their gradient needs: the inputs and activations of each layer."""

    out: Array
    offsets: Array
    hidden1: Array
    hidden2: Array
    pooled: Array
    hidden3: Array


def encode(network: Network, xy: Array, there: Array) -> Encoded:
    """Embed B sets of points (B, N, 2); `there` (B, N) is 1 for points, 0 for padding."""
    offset = xy[:, None, :, :] - xy[:, :, None, :]
    offsets = np.concatenate([offset, np.linalg.norm(offset, axis=3, keepdims=True)], axis=3)
    hidden1 = np.maximum(offsets @ network.w1 + network.b1, 0.0)
    hidden2 = np.maximum(hidden1 @ network.w2 + network.b2, 0.0)
    share = there / np.maximum(there.sum(axis=1, keepdims=True), 1.0)
    around = np.einsum("bnkh,bk->bnh", hidden2, share)
    pooled = np.concatenate([around, xy], axis=2)
    hidden3 = np.maximum(pooled @ network.w3 + network.b3, 0.0)
    return Encoded(hidden3 @ network.w4 + network.b4, offsets, hidden1, hidden2, pooled, hidden3)


def probabilities(network: Network, detections: Encoded, lights: Encoded, lights_there: Array) -> Array:
    """Of each detection being each light, and last none (B, N, M + 1)."""
    score = detections.out @ lights.out.transpose(0, 2, 1) / np.sqrt(lights.out.shape[2])
    score = np.where(lights_there[:, None, :] > 0, score, -np.inf)
    score = np.concatenate([score, np.broadcast_to(network.spurious, (*score.shape[:2], 1))], axis=2)
    score = np.exp(score - score.max(axis=2, keepdims=True))
    return np.asarray(score / score.sum(axis=2, keepdims=True))


@cache
def network() -> Network:
    """The trained network of the package."""
    stored = json.loads((files("lumidock.baselines") / MODEL).read_text(encoding="utf-8"))
    return Network(*(np.array(stored[name]) for name in Network._fields))


def associate(view: LayerView, _rng: np.random.Generator) -> Indices | None:
    """Light of each detection by the largest product of probabilities, one to one."""
    seen, lights = normalized(view.xy_up)[None], normalized(view.p_dock[:, :2])[None]
    all_seen, all_lights = np.ones(seen.shape[:2]), np.ones(lights.shape[:2])
    trained = network()
    found = encode(trained, seen, all_seen), encode(trained, lights, all_lights)
    p = probabilities(trained, *found, all_lights)[0, :, :-1]
    light = assign(-np.log(np.maximum(p, 1e-300)))
    return np.where((light >= 0) & (p[np.arange(len(light)), light] >= _LEAST), light, -1)
