"""The centroid of a blob: the maximum of the continuous difference-of-Gaussians filter, and its covariance."""

from __future__ import annotations

import math

import numpy as np

from lumidock._kernels.compiling import entry, part
from lumidock._kernels.detection.blobs import LEVEL, PATCH, PLANE, SCALE, X, Y, limits, seen_limits
from lumidock.datatypes import Array, Indices

RATIO = math.sqrt(2.0)  # of the two standard deviations of a difference of Gaussians
Limits = tuple[tuple[int, int, int, int], tuple[int, int, int, int]]  # of a patch, and of what is in the frame
_START = 0.7  # sizes from the border, at least, where the search for a maximum begins; on the border it would end
_REACH = 3.0  # standard deviations of the wider Gaussian that are summed: 1.1 % of its mass lies beyond
_MOST = 35  # samples of a row at most: 2 * 3 * 2 * 1.27 * 2 + 1 at the widest filter, rounded up
_STEPS = 6
GRADIENT_VAR = 13.0 / 12.0  # s^2 times the variance of the response's gradient over that of the response, white noise
M_X, M_Y, M_HEIGHT, M_XX, M_XY, M_YY, M_SHIFT_X, M_SHIFT_Y, M_SHIFTS, M_OK, M_RATIO = range(11)
MEASURES = 11


@entry
def centroids(image: Array, patches: Indices, level: int, blobs: Array, out: Array) -> None:
    """Measure each blob (N, columns of `blobs`) of this `level` of the pyramid in `image` (H, W, P).

    `out` (N, MEASURES): position in level pixels, height of the response, covariance that noise of 1 in the response
    leaves, squared level pixels, and how far the maximum moves to the filters `RATIO` finer and wider.
    """
    weights = np.empty((2, 9, _MOST))
    value = np.empty(6)
    for n in range(len(blobs)):
        blob, patch = blobs[n], patches[int(blobs[n, PATCH])]
        if int(blob[LEVEL]) != level:
            continue
        pixel = 1 << level
        box = limits(patch, pixel), seen_limits(patch, pixel)
        p, s, row = int(blob[PLANE]), blob[SCALE], out[n]
        row[M_X] = _inside(blob[X], box[1][0], box[1][2], _START * s)
        row[M_Y] = _inside(blob[Y], box[1][1], box[1][3], _START * s)
        row[M_OK] = _climb(image, p, s, box, weights, value, row)
        row[M_HEIGHT] = value[0]
        _covariance_of_noise(value, s, row)
        row[M_SHIFT_X] = row[M_SHIFT_Y] = row[M_SHIFTS] = 0.0
        x, y = row[M_X], row[M_Y]
        for factor in (1.0 / RATIO, RATIO):
            if _climb(image, p, s * factor, box, weights, value, row) == 1.0:
                row[M_SHIFT_X] += (row[M_X] - x) ** 2
                row[M_SHIFT_Y] += (row[M_Y] - y) ** 2
                row[M_SHIFTS] += 1.0
            row[M_X], row[M_Y] = x, y


@part
def _covariance_of_noise(value: Array, s: float, row: Array) -> None:
    """Write H^-1 G H^-1, where G is the covariance that the gradient has for response noise of 1."""
    g = GRADIENT_VAR / (s * s)
    h_xx, h_xy, h_yy = value[3], value[4], value[5]
    det = h_xx * h_yy - h_xy * h_xy
    if det <= 0.0 or h_xx >= 0.0:
        row[M_XX] = row[M_YY] = s * s
        row[M_XY] = row[M_RATIO] = 0.0
        return
    i_xx, i_xy, i_yy = h_yy / det, -h_xy / det, h_xx / det
    row[M_XX] = g * (i_xx * i_xx + i_xy * i_xy)
    row[M_XY] = g * (i_xx * i_xy + i_xy * i_yy)
    row[M_YY] = g * (i_xy * i_xy + i_yy * i_yy)
    half_trace, root = 0.5 * (h_xx + h_yy), math.hypot(0.5 * (h_xx - h_yy), h_xy)
    row[M_RATIO] = (half_trace + root) / (half_trace - root)


@part
def _climb(
    image: Array,
    p: int,
    s: float,
    box: Limits,
    weights: Array,
    value: Array,
    row: Array,
) -> float:
    """Move `row`'s position to the maximum of the response by Newton steps; 1 if it is one within 1.5 `s`."""
    x, y = row[M_X], row[M_Y]
    start_x, start_y = x, y
    for _ in range(_STEPS):
        _respond(image, p, s, x, y, box, weights, value)
        h_xx, h_xy, h_yy = value[3], value[4], value[5]
        det = h_xx * h_yy - h_xy * h_xy
        if det <= 0.0 or h_xx >= 0.0:
            return 0.0
        dx, dy = -(h_yy * value[1] - h_xy * value[2]) / det, -(h_xx * value[2] - h_xy * value[1]) / det
        shorten = min(1.0, 0.5 * s / max(math.hypot(dx, dy), 1e-12))
        x, y = x + shorten * dx, y + shorten * dy
        if math.hypot(x - start_x, y - start_y) > 1.5 * s:
            return 0.0
        if abs(dx) + abs(dy) < 1e-3:
            break
    row[M_X], row[M_Y] = x, y
    return 1.0


@part
def _respond(
    image: Array,
    p: int,
    s: float,
    x: float,
    y: float,
    box: Limits,
    weights: Array,
    value: Array,
) -> None:
    """Write the response, its gradient (x, y) and Hessian (xx, xy, yy) at a place.

    Beyond the frame a light goes on as it is on the other side of the place, and beyond the patch it is mirrored.
    """
    reach = min(math.ceil(_REACH * RATIO * s), _MOST // 2)
    left, top = round(x) - reach, round(y) - reach
    side = 2 * reach + 1
    for axis in range(2):
        origin = (left - x) if axis == 0 else (top - y)
        for k in range(2):
            sigma = s if k == 0 else RATIO * s
            total = 0.0
            for i in range(side):
                t = (origin + i) / sigma
                g = math.exp(-0.5 * t * t)
                total += g
                weights[axis, 3 * k, i] = g
            for i in range(side):
                t = (origin + i) / sigma
                g = weights[axis, 3 * k, i] / total
                weights[axis, 3 * k, i] = g
                weights[axis, 3 * k + 1, i] = g * t / sigma
                weights[axis, 3 * k + 2, i] = g * (t * t - 1.0) / (sigma * sigma)
        _find_samples(left if axis == 0 else top, side, x if axis == 0 else y, axis, box, weights[axis])
    value[:] = 0.0
    for j in range(side):
        v0, v1, dv = int(weights[1, 6, j]), int(weights[1, 7, j]), weights[1, 8, j]
        a0 = a1 = a2 = b0 = b1 = b2 = 0.0
        for i in range(side):
            u0, du = int(weights[0, 6, i]), weights[0, 8, i]
            sample = plane_value(image, p, v0, u0)
            if du > 0.0 or dv > 0.0:
                u1 = int(weights[0, 7, i])
                upper = (1.0 - du) * sample + du * plane_value(image, p, v0, u1)
                lower = (1.0 - du) * plane_value(image, p, v1, u0) + du * plane_value(image, p, v1, u1)
                sample = (1.0 - dv) * upper + dv * lower
            a0 += weights[0, 0, i] * sample
            a1 += weights[0, 1, i] * sample
            a2 += weights[0, 2, i] * sample
            b0 += weights[0, 3, i] * sample
            b1 += weights[0, 4, i] * sample
            b2 += weights[0, 5, i] * sample
        w = weights[1]
        value[0] += w[0, j] * a0 - w[3, j] * b0
        value[1] += w[0, j] * a1 - w[3, j] * b1
        value[2] += w[1, j] * a0 - w[4, j] * b0
        value[3] += w[0, j] * a2 - w[3, j] * b2
        value[4] += w[1, j] * a1 - w[4, j] * b1
        value[5] += w[2, j] * a0 - w[5, j] * b0


@part
def plane_value(image: Array, p: int, v: int, u: int) -> float:
    """A sample of a plane, or of the mean of all where there is no such plane."""
    if p < image.shape[2]:
        return image[v, u, p]
    return (image[v, u, 0] + image[v, u, 1] + image[v, u, 2]) * np.float32(1.0 / 3.0)


@part
def _inside(x: float, low: int, high: int, margin: float) -> float:
    """A coordinate at least so far from the limits, or in their middle."""
    middle = 0.5 * (low + high)
    return min(max(x, min(low - 0.5 + margin, middle)), max(high + 0.5 - margin, middle))


@part
def _find_samples(first: int, side: int, center: float, axis: int, box: Limits, weights: Array) -> None:
    """Write which two columns or rows each sample lies between, and how far from the first, to rows 6 to 8.

    One beyond the frame is taken from the other side of the centre, if that is in the frame.
    """
    patch, seen = box
    for i in range(side):
        at = float(first + i)
        if not seen[axis] <= at <= seen[axis + 2] and seen[axis] <= 2.0 * center - at <= seen[axis + 2]:
            at = 2.0 * center - at
        whole = math.floor(at)
        weights[6, i] = mirrored(whole, patch[axis], patch[axis + 2])
        weights[7, i] = mirrored(whole + 1, patch[axis], patch[axis + 2])
        weights[8, i] = at - whole


@part
def mirrored(i: int, low: int, high: int) -> int:
    """An index reflected into low..high, the edge sample twice."""
    if i < low:
        i = 2 * low - 1 - i
    elif i > high:
        i = 2 * high + 1 - i
    return min(max(i, low), high)
