"""Train the learned matcher on random layouts and poses, and measure it on layouts held out of the training."""

from __future__ import annotations

import json
from typing import Any, NamedTuple

import numpy as np

from bench.shipped import PACKAGE
from lumidock.baselines.hungarian import normalized
from lumidock.baselines.learned import MODEL, Encoded, Network, encode, network, probabilities
from lumidock.datatypes import Array, Indices

_HIDDEN, _EMBEDDING = 48, 24
_STEPS, _BATCH, _RATE = 12000, 48, 2e-3  # of Adam; the rate falls to nothing as half a cosine
_BETA1, _BETA2, _EPSILON = 0.9, 0.999, 1e-8  # Kingma and Ba, 2015
_LIGHTS, _MISSING, _SPURIOUS = (4, 9), 3, 4  # of a drawn dock; at least four of its lights stay
_APART = 0.15  # least distance of two lights, of the half width
_DISTANCE = (3.0, 19.0)  # from the dock, of its half width
_ROLL_DEG, _TILT_DEG = 10.0, 10.0  # largest, as the default prior of the localizer has them
_NOISE = 0.5 / 2100.0  # of a centroid, of the focal length: half a pixel of the shipped camera
_AROUND = 2.0  # spurious detections lie within so many half widths of the middle
_SEED, _HELD_OUT = 5, 2000


class Batch(NamedTuple):
    """B frames: `seen` (B, N, 2) and `lights` (B, M, 2) normalised, which are `there`, and the light of each (B, N).

    The light is M for a spurious detection, and -1 for padding.
    """

    seen: Array
    seen_there: Array
    lights: Array
    lights_there: Array
    light: Indices


def main() -> tuple[dict[str, Any], list[str]]:
    """Train, store the weights in the package, and the shares of right frames on drawn layouts of other seeds."""
    trained = train(np.random.default_rng(_SEED))
    stored = {name: np.round(value, 4).tolist() for name, value in trained._asdict().items()}
    (PACKAGE / "baselines" / MODEL).write_text(json.dumps(stored) + "\n", encoding="utf-8")
    network.cache_clear()
    rows = {f"{missing} missing, {spurious} spurious": held_out(missing, spurious) for missing, spurious in _CASES}
    lines = ["| drawn layouts | detections right, % |", "|---|---|"]
    return rows, lines + [f"| {case} | {100 * share:.1f} |" for case, share in rows.items()]


_CASES = ((0, 0), (1, 0), (3, 0), (0, 2), (1, 1))


def held_out(missing: int, spurious: int) -> float:
    """Share of detections whose most probable class is right, on layouts that training has not drawn."""
    rng = np.random.default_rng([_SEED, 1, missing, spurious])
    batch = batch_of([drawn(rng, missing, spurious) for _ in range(_HELD_OUT)])
    p = probabilities(network(), *encoded(network(), batch), batch.lights_there)
    counted = batch.light >= 0
    return float((p.argmax(axis=2) == batch.light)[counted].mean())


def layout(rng: np.random.Generator) -> Array:
    """Lights (M, 2) of a dock of half width 1, no two of them close together."""
    count = int(rng.integers(_LIGHTS[0], _LIGHTS[1], endpoint=True))
    while True:
        xy = rng.uniform(-1.0, 1.0, (count, 2))
        gap = np.linalg.norm(xy[:, None] - xy[None], axis=2) + np.eye(count)
        if gap.min() > _APART:
            return xy


def drawn(rng: np.random.Generator, missing: int, spurious: int) -> tuple[Array, Array, Indices]:
    """Detections (N, 2), the lights (M, 2) and the light of each detection, M where it is spurious."""
    lights = layout(rng)
    roll, pitch, yaw = np.deg2rad(rng.uniform(-1, 1, 3) * [_ROLL_DEG, _TILT_DEG, _TILT_DEG])
    depth = rng.uniform(*_DISTANCE)
    turned = lights @ np.array([[np.cos(roll), np.sin(roll)], [-np.sin(roll), np.cos(roll)]])
    z = depth + turned @ [np.tan(yaw), np.tan(pitch)]
    shown = rng.permutation(len(lights))[min(missing, len(lights) - 4) :]
    others = rng.uniform(-_AROUND, _AROUND, (spurious, 2)) / depth
    seen = np.concatenate([turned[shown] / z[shown, None], others])
    seen = seen + rng.normal(0.0, _NOISE, seen.shape)
    return seen, lights, np.concatenate([shown, np.full(spurious, len(lights))])


def batch_of(frames: list[tuple[Array, Array, Indices]]) -> Batch:
    """Frames padded to the same numbers."""
    n, m = max(len(seen) for seen, _, _ in frames), max(len(lights) for _, lights, _ in frames)
    count = len(frames)
    batch = Batch(
        np.zeros((count, n, 2)),
        np.zeros((count, n)),
        np.zeros((count, m, 2)),
        np.zeros((count, m)),
        np.full((count, n), -1),
    )
    for b, (seen, lights, light) in enumerate(frames):
        batch.seen[b, : len(seen)], batch.seen_there[b, : len(seen)] = normalized(seen), 1.0
        batch.lights[b, : len(lights)], batch.lights_there[b, : len(lights)] = normalized(lights), 1.0
        batch.light[b, : len(seen)] = np.where(light == len(lights), m, light)
    return batch


def encoded(net: Network, batch: Batch) -> tuple[Encoded, Encoded]:
    """The embeddings of detections and lights."""
    return encode(net, batch.seen, batch.seen_there), encode(net, batch.lights, batch.lights_there)


def loss_and_gradient(net: Network, batch: Batch) -> tuple[float, Network]:
    """Mean cross entropy over the detections, and its gradient."""
    seen, lights = encoded(net, batch)
    p = probabilities(net, seen, lights, batch.lights_there)
    counted = batch.light >= 0
    right = np.eye(p.shape[2])[np.maximum(batch.light, 0)]
    loss = -float(np.log(np.maximum((p * right).sum(axis=2)[counted], 1e-12)).mean())
    d_score = (p - right) * (counted / counted.sum())[:, :, None]
    scale = 1.0 / np.sqrt(seen.out.shape[2])
    d_seen = d_score[:, :, :-1] @ lights.out * scale
    d_lights = d_score[:, :, :-1].transpose(0, 2, 1) @ seen.out * scale
    one = _encoder_gradient(net, seen, batch.seen_there, d_seen)
    other = _encoder_gradient(net, lights, batch.lights_there, d_lights)
    return loss, Network(*(a + b for a, b in zip(one, other, strict=True)), d_score[:, :, -1].sum(keepdims=True)[0])


def _encoder_gradient(net: Network, of: Encoded, there: Array, d_out: Array) -> list[Array]:
    """The gradient of the encoder's eight weights from that of its embeddings (B, N, E)."""
    d_hidden3 = (d_out @ net.w4.T) * (of.hidden3 > 0)
    d_around = (d_hidden3 @ net.w3.T)[:, :, :-2]
    share = there / np.maximum(there.sum(axis=1, keepdims=True), 1.0)
    d_hidden2 = d_around[:, :, None, :] * share[:, None, :, None] * (of.hidden2 > 0)
    d_hidden1 = (d_hidden2 @ net.w2.T) * (of.hidden1 > 0)
    layers = (
        (of.offsets, d_hidden1),
        (of.hidden1, d_hidden2),
        (of.pooled, d_hidden3),
        (of.hidden3, d_out),
    )
    gradient = []
    for inputs, outputs in layers:
        flat = outputs.reshape(-1, outputs.shape[-1])
        gradient += [inputs.reshape(-1, inputs.shape[-1]).T @ flat, flat.sum(axis=0)]
    return gradient


def begun(rng: np.random.Generator) -> Network:
    """Weights drawn by the rule of He et al., 2015."""

    def weights(rows: int, columns: int) -> Array:
        return rng.normal(0.0, np.sqrt(2.0 / rows), (rows, columns))

    h, e = _HIDDEN, _EMBEDDING
    shapes = (weights(3, h), np.zeros(h), weights(h, h), np.zeros(h), weights(h + 2, h), np.zeros(h), weights(h, e))
    return Network(*shapes, np.zeros(e), np.zeros(1))


def train(rng: np.random.Generator) -> Network:
    """Adam on new frames in every step."""
    net = begun(rng)
    mean, square = ([np.zeros_like(value) for value in net] for _ in range(2))
    for step in range(1, _STEPS + 1):
        count = rng.integers(0, [_MISSING, _SPURIOUS], (_BATCH, 2), endpoint=True)
        _, gradient = loss_and_gradient(net, batch_of([drawn(rng, *row) for row in count]))
        rate = 0.5 * _RATE * (1.0 + np.cos(np.pi * step / _STEPS))
        mean = [_BETA1 * m + (1 - _BETA1) * g for m, g in zip(mean, gradient, strict=True)]
        square = [_BETA2 * s + (1 - _BETA2) * g**2 for s, g in zip(square, gradient, strict=True)]
        steps = [
            rate * (m / (1 - _BETA1**step)) / (np.sqrt(s / (1 - _BETA2**step)) + _EPSILON)
            for m, s in zip(mean, square, strict=True)
        ]
        net = Network(*(value - change for value, change in zip(net, steps, strict=True)))
    return net
