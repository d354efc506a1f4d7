"""Samples of a picture around a pixel, plane by plane, and how much each plane counts for a light there."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lumidock._kernels.compiling import part
from lumidock.datatypes import Array, Frame, Image

RING = 24  # samples on a ring
COS, SIN = np.cos(np.arange(RING) * 2.0 * np.pi / RING), np.sin(np.arange(RING) * 2.0 * np.pi / RING)
_ROOT_TWO = np.sqrt(2.0)
_SIXTEEN = 255.0 / 65535.0  # 8-bit levels of a 16-bit step
_NONE, _SECOND, _LAST = 0, 1, 5
_LEAST_LOST, _SLACK = 0.4, 0.5  # share of its height that a spot loses to the ring; sigmas of noise left to it


class Picture(NamedTuple):
    """A frame as the camera gives it, of any type.

    `rows` (H, n) its bytes, `deep` of which are a sample, least byte first; `planes` 1, 3 or, for a mosaic, 4, of which
    a sample, in a mosaic a 2 x 2 cell, has one value each; `scale` makes 8-bit grey levels of them.
    """

    rows: Image
    deep: int
    planes: int
    scale: float
    height: int
    width: int


def picture(frame: Frame) -> Picture:
    """A frame as the kernels take it."""
    image, (height, width) = np.ascontiguousarray(frame.image), frame.image.shape[:2]
    planes = 4 if frame.encoding.startswith("bayer") else 3 if image.ndim == 3 else 1
    deep = image.dtype.itemsize
    rows = image.reshape(height, -1).view(np.uint8)
    rows.flags.writeable = False  # or what is read only, as messages are, would be of another type, compiled anew
    return Picture(rows, deep, planes, 1.0 if deep == 1 else _SIXTEEN, height, width)


@part
def value(picture: Picture, v: int, x: int) -> int:
    """The `x`th number of row `v`."""
    if picture.deep == 1:
        return int(picture.rows[v, x])
    return int(picture.rows[v, 2 * x]) + 256 * int(picture.rows[v, 2 * x + 1])


@part
def sample(picture: Picture, p: int, v: int, u: int) -> float:
    """One sample of plane `p`, in grey levels, at a pixel or, on a mosaic, in the 2 x 2 cell of a pixel."""
    if picture.planes == 1:
        return picture.scale * value(picture, v, u)
    if picture.planes == 3:
        return picture.scale * value(picture, v, 3 * u + p)
    v, u = min((v & -2) + (p >> 1), picture.height - 1), min((u & -2) + (p & 1), picture.width - 1)
    return picture.scale * value(picture, v, u)


@part
def core_mean(picture: Picture, p: int, v: int, u: int) -> float:
    """Mean of a plane over 3 x 3 of its samples around a pixel."""
    pitch = 2 if picture.planes == 4 else 1
    total, count = 0.0, 0
    for y in range(max(v - pitch, 0), min(v + pitch + 1, picture.height), pitch):
        for x in range(max(u - pitch, 0), min(u + pitch + 1, picture.width), pitch):
            total += sample(picture, p, y, x)
            count += 1
    return total / count


@part
def ring(picture: Picture, v: int, u: int, radius: float, values: Array) -> int:
    """Write twelve samples of each plane on a circle around a pixel to `values` (4, 12), as far as they are inside.

    Returns how many are.
    """
    count = _NONE
    for k in range(0, RING, 2):
        x, y = int(u + radius * COS[k] + 0.5), int(v + radius * SIN[k] + 0.5)
        if 0 <= x < picture.width and 0 <= y < picture.height:
            for p in range(picture.planes):
                values[p, count] = sample(picture, p, y, x)
            count += 1
    return count


@part
def is_over(values: Array, count: int, limit: float) -> bool:
    """Whether `ring_level` of a plane's samples is over a limit, without sorting: all but a quarter of them are."""
    low = 0
    for k in range(count):
        low += values[k] <= limit
    return low <= count // 4 and count > 0


@part
def ring_level(values: Array, count: int) -> float:
    """Mean of the second quarter of a plane's samples on a circle, which are sorted; 0 if there are none.

    So nearly half of the circle may lie on something brighter.
    """
    if count == 0:
        return 0.0
    for k in range(1, count):
        insert(values, k, values[k])
    return mean(values, count // 4, count // 2 + 1)


@part
def mean(values: Array, first: int, last: int) -> float:
    """Mean of some of the values."""
    total = 0.0
    for k in range(first, last):
        total += values[k]
    return total / (last - first)


@part
def log_lens_over_bad_pixel(
    picture: Picture, v: int, u: int, radius: float, share: float, noise: float, values: Array
) -> float:
    """Log likelihood ratio of a spot that a lens has drawn over a bad pixel, from the eight pixels around a peak.

    They hold `share` of its height on the average, or nothing, over the ring of `radius`; each counts by its own plane.
    """
    if min(u, v) < 1 or u + 1 >= picture.width or v + 1 >= picture.height:
        return np.inf
    count = ring(picture, v, u, radius, values)
    for p in range(picture.planes):
        values[p, 0] = ring_level(values[p], count)
    around, height = 0.0, 0.0
    for y in range(v - 1, v + 2):
        for x in range(u - 1, u + 2):
            p = ((y & 1) * 2 + (x & 1)) if picture.planes == 4 else 0
            over = picture.scale * value(picture, y, x) - values[p, 0]
            if y == v and x == u:
                height = over
            else:
                around += over / 8.0
    held = share * height
    return held * (around - 0.5 * held) * 8.0 / noise**2


@part
def stands_out(
    picture: Picture, p: int, v: int, u: int, radius: float, noise: float, least: float, small: bool, values: Array
) -> bool:
    """Whether 3 x 3 samples clear a ring by `least` times the noise: cheap enough for every candidate.

    A `small` spot's ring holds nothing of it, so that its scatter counts as noise as well.
    Nothing stands out that has lost too little on the ring of what it has lost at twice the radius: the top of a halo
    falls off as the square of the distance, and a spot not larger than the ring has lost half of its height there.
    """
    level, spread, whole = _pair_level(picture, p, v, u, radius, values)
    if not whole:
        return True
    core = core_mean(picture, p, v, u)
    if core - level < least * max(noise, spread if small else 0.0):
        return False
    far, _, whole = _pair_level(picture, p, v, u, 2.0 * radius, values)
    return not whole or core - level + _SLACK * noise >= _LEAST_LOST * (core - far)


@part
def _pair_level(picture: Picture, p: int, v: int, u: int, radius: float, means: Array) -> tuple[float, float, bool]:
    """Level and scatter of the means of opposite samples on a ring, which no slope moves; whether it is in view."""
    reach = int(radius + 0.5)
    if min(u, v) < reach or u + reach >= picture.width or v + reach >= picture.height:
        return 0.0, 0.0, False
    for k in range(RING // 4):
        x, y = int(np.floor(radius * COS[2 * k] + 0.5)), int(np.floor(radius * SIN[2 * k] + 0.5))
        both = sample(picture, p, v + y, u + x) + sample(picture, p, v - y, u - x)
        insert(means, k, 0.5 * both)
    return mean(means, _SECOND, _LAST), _ROOT_TWO * (means[4] - means[1]) / 1.35, True


@part
def weigh(picture: Picture, v: int, u: int, radius: float, weight: Array, values: Array) -> None:
    """Write each plane's `weight` (4,), their sum 1, for a light of about `radius` px at a pixel.

    Planes count by how far they stand out of a ring, as in the best filter for equal noise.
    """
    weight[:] = 0.0
    if picture.planes == 1:
        weight[0] = 1.0
        return
    count, total = ring(picture, v, u, 3.0 * radius, values), 0.0
    for p in range(picture.planes):
        weight[p] = max(core_mean(picture, p, v, u) - ring_level(values[p], count), 0.0)
        total += weight[p]
    for p in range(picture.planes):
        weight[p] = weight[p] / total if total > 0.0 else 1.0 / picture.planes


@part
def weigh_clipped(
    picture: Picture, v: int, u: int, least: float, largest: float, weight: Array, values: Array
) -> float:
    """The same for a saturated light: only the planes in which it is smallest count. Returns its radius there, or 0.

    A saturated core in its halo is small where its colour is weak: the red of a blue lamp. The radius is that of the
    first ring at half height over the ring three times as wide; a plane must stand out by `least`. `values` (8, 24):
    scratch.
    """
    near, far, tops = values[:4], values[4:8], values[:, 12]
    for p in range(picture.planes):
        tops[p] = core_mean(picture, p, v, u)
    weight[:] = 0.0
    radius, smallest, most, alike = 3.0, 0.0, largest, 0
    while radius < most:
        count, beyond = ring(picture, v, u, radius, near), -1
        for p in range(picture.planes):
            top = tops[p]
            if weight[p] > 0.0 or top < least or is_over(near[p], count, top - 0.5 * least):
                continue
            if beyond < 0:
                beyond = ring(picture, v, u, 3.0 * radius, far)
            if is_over(far[p], beyond, top - least):  # the background is too bright, or a part of the light
                continue
            here, dark = ring_level(near[p], count), ring_level(far[p], beyond)
            if here <= top - 0.5 * least and top - dark >= least and here <= 0.5 * (top + dark):
                weight[p] = 1.0
                if alike == 0:
                    smallest, most = radius, min(1.3 * radius + 1e-6, most)
                alike += 1
        radius *= 1.25
    for p in range(picture.planes):
        weight[p] /= max(alike, 1)
    return smallest


@part
def square(weight: Array) -> float:
    """Sum of the squares of the planes' weights (4,)."""
    return weight[0] ** 2 + weight[1] ** 2 + weight[2] ** 2 + weight[3] ** 2


@part
def mean_by_square(weight: Array, values: Array, power: int) -> float:
    """Mean of a power of the planes' `values` (4,) by the squares of their weights."""
    total = 0.0
    for p in range(4):
        total += weight[p] * weight[p] * values[p] ** power
    return total / square(weight)


@part
def insert(ordered: Array, count: int, new: float) -> int:
    """Insert into the first `count` of the sorted values; returns the new count."""
    k = count
    while k > 0 and ordered[k - 1] > new:
        ordered[k] = ordered[k - 1]
        k -= 1
    ordered[k] = new
    return count + 1


@part
def largest(values: Array) -> float:
    """The largest of the planes' `values` (4,)."""
    return max(max(values[0], values[1]), max(values[2], values[3]))
