"""Samples of a picture around a pixel, plane by plane, and how much each plane counts for a light there.

Samples come as (H, W, C) of an unsigned type, 1 or 3 channels, or one channel that is a Bayer mosaic.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from lumidock.datatypes import Array, Image

RING = 24  # samples on a ring
COS, SIN = np.cos(np.arange(RING) * 2.0 * np.pi / RING), np.sin(np.arange(RING) * 2.0 * np.pi / RING)
_ROOT_TWO = np.sqrt(2.0)
_LEAST_LOST, _SLACK = 0.4, 0.5  # share of its height that a spot loses to the ring; sigmas of noise left to it


@njit(error_model="numpy")
def sample(image: Image, planes: int, p: int, v: int, u: int) -> float:
    """One sample of plane `p` at pixel or, on a mosaic, in the 2 x 2 cell of a pixel."""
    if planes == 1:
        return float(image[v, u, 0])
    if planes == 3:
        return float(image[v, u, p])
    return float(image[min((v & -2) + (p >> 1), image.shape[0] - 1), min((u & -2) + (p & 1), image.shape[1] - 1), 0])


@njit(error_model="numpy")
def core_mean(image: Image, planes: int, scale: float, p: int, v: int, u: int) -> float:
    """Mean of a plane over 3 x 3 of its samples around a pixel."""
    pitch = 2 if planes == 4 else 1
    total, count = 0.0, 0
    for y in range(max(v - pitch, 0), min(v + pitch + 1, image.shape[0]), pitch):
        for x in range(max(u - pitch, 0), min(u + pitch + 1, image.shape[1]), pitch):
            total += sample(image, planes, p, y, x)
            count += 1
    return scale * total / count


@njit(error_model="numpy")
def ring_mean(image: Image, planes: int, scale: float, p: int, v: int, u: int, radius: float) -> float:
    """Mean of the second quarter of twelve samples of a plane on a circle around a pixel, 0 where it is outside.

    So nearly half of the circle may lie on something brighter.
    """
    ordered, count = np.empty(12), 0
    for k in range(0, RING, 2):
        x, y = int(u + radius * COS[k] + 0.5), int(v + radius * SIN[k] + 0.5)
        if 0 <= x < image.shape[1] and 0 <= y < image.shape[0]:
            count = insert(ordered, count, sample(image, planes, p, y, x))
    if count == 0:
        return 0.0
    return float(scale * ordered[count // 4 : count // 2 + 1].mean())


@njit(error_model="numpy")
def _ring_is_over(image: Image, planes: int, scale: float, p: int, v: int, u: int, radius: float, limit: float) -> bool:
    """Whether the samples of `ring_mean` say without sorting that it is over a limit: all but a quarter of them are."""
    low, count = 0, 0
    for k in range(0, RING, 2):
        x, y = int(u + radius * COS[k] + 0.5), int(v + radius * SIN[k] + 0.5)
        if 0 <= x < image.shape[1] and 0 <= y < image.shape[0]:
            low += scale * sample(image, planes, p, y, x) <= limit
            count += 1
        if low > RING // 8:
            return False
    return low <= count // 4 and count > 0


@njit(error_model="numpy")
def log_lens_over_bad_pixel(
    image: Image, planes: int, scale: float, v: int, u: int, radius: float, share: float, noise: float
) -> float:
    """Log likelihood ratio of a spot that a lens has drawn over a bad pixel, from the eight pixels around a peak.

    They hold `share` of its height on the average, or nothing, over the ring of `radius`; each counts by its own plane.
    """
    if min(u, v) < 1 or u + 1 >= image.shape[1] or v + 1 >= len(image):
        return np.inf
    ground = np.zeros(4)
    for p in range(planes):
        ground[p] = ring_mean(image, planes, scale, p, v, u, radius)
    around, height = 0.0, 0.0
    for y in range(v - 1, v + 2):
        for x in range(u - 1, u + 2):
            over = scale * image[y, x, 0] - ground[((y & 1) * 2 + (x & 1)) if planes == 4 else 0]
            if y == v and x == u:
                height = over
            else:
                around += over / 8.0
    held = share * height
    return held * (around - 0.5 * held) * 8.0 / noise**2


@njit(error_model="numpy")
def stands_out(
    image: Image,
    planes: int,
    scale: float,
    p: int,
    v: int,
    u: int,
    radius: float,
    noise: float,
    least: float,
    small: bool,
) -> bool:
    """Whether 3 x 3 samples clear a ring by `least` times the noise: cheap enough for every candidate.

    A `small` spot's ring holds nothing of it, so that its scatter counts as noise as well.
    Nothing stands out that has lost too little on the ring of what it has lost at twice the radius: the top of a halo
    falls off as the square of the distance, and a spot not larger than the ring has lost half of its height there.
    """
    level, spread, whole = _pair_level(image, planes, scale, p, v, u, radius)
    if not whole:
        return True
    core = core_mean(image, planes, scale, p, v, u)
    if core - level < least * max(noise, spread if small else 0.0):
        return False
    far, _, whole = _pair_level(image, planes, scale, p, v, u, 2.0 * radius)
    return not whole or core - level + _SLACK * noise >= _LEAST_LOST * (core - far)


@njit(error_model="numpy")
def _pair_level(
    image: Image, planes: int, scale: float, p: int, v: int, u: int, radius: float
) -> tuple[float, float, bool]:
    """Level and scatter of the means of opposite samples on a ring, which no slope moves; whether it is in view."""
    means, count = np.empty(RING // 4), 0
    for k in range(0, RING // 2, 2):
        x, y = int(np.floor(radius * COS[k] + 0.5)), int(np.floor(radius * SIN[k] + 0.5))
        if min(u - abs(x), v - abs(y)) < 0 or u + abs(x) >= image.shape[1] or v + abs(y) >= image.shape[0]:
            return 0.0, 0.0, False
        both = sample(image, planes, p, v + y, u + x) + sample(image, planes, p, v - y, u - x)
        count = insert(means, count, 0.5 * scale * both)
    return means[1:5].mean(), _ROOT_TWO * (means[4] - means[1]) / 1.35, True


@njit(error_model="numpy")
def weigh(image: Image, planes: int, scale: float, v: int, u: int, radius: float, weight: Array) -> None:
    """Write each plane's `weight` (4,), their sum 1, for a light of about `radius` px at a pixel.

    Planes count by how far they stand out of a ring, as in the best filter for equal noise.
    """
    weight[:] = 0.0
    if planes == 1:
        weight[0] = 1.0
        return
    for p in range(planes):
        dark = ring_mean(image, planes, scale, p, v, u, 3.0 * radius)
        weight[p] = max(core_mean(image, planes, scale, p, v, u) - dark, 0.0)
    total = weight.sum()
    if total <= 0.0:
        weight[:planes], total = 1.0, float(planes)
    weight /= total


@njit(error_model="numpy")
def weigh_clipped(
    image: Image, planes: int, scale: float, v: int, u: int, least: float, largest: float, weight: Array
) -> float:
    """The same for a saturated light: only the planes in which it is smallest count. Returns its radius there, or 0.

    A saturated core in its halo is small where its colour is weak: the red of a blue lamp. The radius is that of the
    first ring at half height over the ring three times as wide; a plane must stand out by `least`.
    """
    weight[:] = 0.0
    radii, most = np.full(4, np.inf), largest
    for p in range(planes - 1, -1, -1):
        top, radius = core_mean(image, planes, scale, p, v, u), 3.0
        if top < least:
            continue
        while radius < most:
            # else it is over half height whatever the background, or the background is too bright
            if not (
                _ring_is_over(image, planes, scale, p, v, u, radius, top - 0.5 * least)
                or _ring_is_over(image, planes, scale, p, v, u, 3.0 * radius, top - least)
            ):
                here = ring_mean(image, planes, scale, p, v, u, radius)
                dark = ring_mean(image, planes, scale, p, v, u, 3.0 * radius)
                if here <= top - 0.5 * least and top - dark >= least and here <= 0.5 * (top + dark):
                    radii[p], most = radius, min(1.3 * radius + 1e-6, most)
                    break
            radius *= 1.25
    smallest = radii.min()
    if not np.isfinite(smallest):
        return 0.0
    for p in range(planes):
        weight[p] = 1.0 if radii[p] <= 1.3 * smallest else 0.0
    weight /= weight.sum()
    return float(smallest)


@njit(error_model="numpy")
def square(weight: Array) -> float:
    """Sum of the squares of the planes' weights (4,)."""
    total = 0.0
    for p in range(4):
        total += weight[p] * weight[p]
    return total


@njit(error_model="numpy")
def mean_by_square(weight: Array, values: Array) -> float:
    """Mean of the planes' `values` (4,) by the squares of their weights."""
    total = 0.0
    for p in range(4):
        total += weight[p] * weight[p] * values[p]
    return total / square(weight)


@njit(error_model="numpy")
def insert(ordered: Array, count: int, value: float) -> int:
    """Insert into the first `count` of the sorted values; returns the new count."""
    k = count
    while k > 0 and ordered[k - 1] > value:
        ordered[k] = ordered[k - 1]
        k -= 1
    ordered[k] = value
    return count + 1
