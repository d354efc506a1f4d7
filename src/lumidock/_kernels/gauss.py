"""The maximum-likelihood centre of a small light: a round Gaussian on each colour's own samples."""

from __future__ import annotations

import numpy as np
from numba import njit

from lumidock.datatypes import Array, Image

_ROUNDS, _REACH = 6, 9
_PRIOR_DOF = 6.0  # how much the expected noise counts beside the residuals of a fit
_PROFILE = 0.07  # share of the signal by which a spot's profile is no Gaussian
_TELLING = 0.35  # of its height, at the samples that tell most of a spot's place
_LEFT = 0.3  # share of the degrees of freedom that a fit leaves at least
_FITTED = 2.0  # of the residuals' degrees of freedom, that the position takes up where noise is not shared


@njit(error_model="numpy")
def fit(
    image: Image,
    planes: int,
    scale: float,
    weight: Array,
    slope: tuple[float, float],
    center: Array,
    width: float,
    noise: float,
    signal_noise: float,
    shared: float,
    coarse: bool,
    clipped: float,
    cov: Array,
) -> float:
    """Move `center` (2,) to the maximum-likelihood position of a round Gaussian; its covariance goes to `cov` (3,).

    Position and width are common, amplitude and background are of each plane and eliminated (variable projection), so
    that a mosaic's coarse planes bias nothing; saturated samples are left out, which is how the wings of a small
    clipped light give its centre. The residuals scale the covariance, and so does how many samples, `shared`, have the
    same noise, where the signal is `coarse` that of the signal too. Returns the width, 0 where the fit does not settle,
    which leaves everything as it was.
    """
    reach = min(max(int(np.ceil(2.2 * width)) + 1, 3 if planes < 4 else 4), _REACH)
    u0, v0 = int(np.floor(center[0] + 0.5)), int(np.floor(center[1] + 0.5))
    left, right = max(u0 - reach, 0), min(u0 + reach + 1, image.shape[1])
    top, bottom = max(v0 - reach, 0), min(v0 + reach + 1, image.shape[0])
    parts, pitch = (4, 2) if planes == 4 else (1, 1)
    ex, ey = np.empty(right - left), np.empty(bottom - top)
    z = np.empty((bottom - top, right - left))
    room = ((bottom - top + pitch - 1) // pitch) * ((right - left + pitch - 1) // pitch)
    samples, profile = np.empty((2, parts, room)), np.empty((3, room))
    flat, used, g, a, b = samples[0], samples[1], profile[0], profile[1], profile[2]
    _read(image, planes, scale, weight, slope, left, top, u0, v0, clipped, z)
    for p in range(parts):
        _unroll(z[((p >> 1) - top) % pitch :: pitch, ((p & 1) - left) % pitch :: pitch], flat[p], used[p])
    u, v, s = center[0], center[1], width
    amplitude, ground = np.zeros(4), np.zeros(4)
    dx, dy = 1.0, 1.0
    S, right_side = np.zeros((3, 3)), np.zeros(3)
    for turn in range(_ROUNDS):
        for j in range(right - left):
            ex[j] = np.exp(-0.5 * ((left + j - u) / s) ** 2)
        for i in range(bottom - top):
            ey[i] = np.exp(-0.5 * ((top + i - v) / s) ** 2)
        S[:], right_side[:] = 0.0, 0.0
        for p in range(parts):
            i0, j0 = ((p >> 1) - top) % pitch, ((p & 1) - left) % pitch
            at = ((left + j0 - u) / s, (top + i0 - v) / s, pitch / s)
            n = _profile(ex[j0::pitch], ey[i0::pitch], at, g, a, b)
            own, valid, before = flat[p, :n], used[p, :n], amplitude[p] if turn > 0 else 0.0
            amplitude[p], ground[p] = _amplitude(own, valid, g[:n], noise, signal_noise * max(before, 0.0))
            _add_equations(
                own, valid, g[:n], a[:n], b[:n], s, noise, signal_noise, amplitude[p], ground[p], S, right_side
            )
        S[1, 0], S[2, 0], S[2, 1] = S[0, 1], S[0, 2], S[1, 2]
        step, solved = _solve(S, right_side)
        if not solved:
            return 0.0
        dx, dy = step[0], step[1]
        if np.hypot(dx, dy) > width:
            return 0.0
        u, v = u + dx, v + dy
        s = min(max(s + step[2], 0.7 * s), 1.4 * s)
        if dx * dx + dy * dy < 1e-4 and turn > 0:
            break
    if dx * dx + dy * dy > 1e-2 or np.hypot(u - center[0], v - center[1]) > width or not 0.4 < s < 2.0 * width:
        return 0.0
    inverse, solved = _top_left_of_inverse(S)
    if not solved:
        return 0.0
    center[0], center[1] = u, v
    scale_up = averaging(shared, s)
    if not coarse:  # what the signal adds is of each sample; of a coarse colour they share that as well
        scale_up = 1.0 + (scale_up - 1.0) / (1.0 + _TELLING * signal_noise * max(amplitude.max(), 0.0) / noise**2)
    fitted = _FITTED * scale_up
    place = (u - left, v - top)
    scale_up *= _misfit(z, (ex, ey), place, (left, top), s, parts, noise, signal_noise, fitted, amplitude, ground)
    cov[0], cov[1], cov[2] = inverse[0] * scale_up, inverse[1] * scale_up, inverse[2] * scale_up
    return s


@njit(error_model="numpy")
def averaging(shared: float, width: float) -> float:
    """Variance of a centre by noise that neighbours share, over that by as much noise of each sample on its own.

    Of a Gaussian spot of `width` px, 1 sigma, in noise of a Gaussian spectrum; a wide region has `shared` times it.
    """
    return float(shared / (1.0 + (shared - 1.0) / (4.0 * np.pi * width * width)) ** 2)


@njit(error_model="numpy")
def _read(
    image: Image,
    planes: int,
    scale: float,
    weight: Array,
    slope: tuple[float, float],
    left: int,
    top: int,
    u: int,
    v: int,
    clipped: float,
    z: Array,
) -> None:
    """Write the samples from `left`, `top` on to `z`, without the slope through u, v; NaN where one is saturated."""
    for i in range(len(z)):
        for j in range(z.shape[1]):
            if planes == 3:
                mixed, most = 0.0, 0.0
                for p in range(3):
                    mixed += weight[p] * image[top + i, left + j, p]
                    most = max(most, float(image[top + i, left + j, p]) if weight[p] > 0.0 else 0.0)
            else:
                mixed = most = float(image[top + i, left + j, 0])
            z[i, j] = scale * mixed - slope[0] * (left + j - u) - slope[1] * (top + i - v)
            if scale * most >= clipped:
                z[i, j] = np.nan


@njit(error_model="numpy")
def _misfit(
    z: Array,
    profile: tuple[Array, Array],
    center: tuple[float, float],
    corner: tuple[int, int],
    s: float,
    parts: int,
    noise: float,
    signal_noise: float,
    fitted: float,
    amplitude: Array,
    ground: Array,
) -> float:
    """How much larger the residuals are than noise, counted where they move the centre; `z` becomes the residuals.

    What is even about the centre displaces nothing: opposite residuals are compared, and a share of the signal is
    allowed for, as no lens draws a Gaussian and no grid holds one evenly. Where saturated samples are left out there is
    no such balance, and every residual counts.
    """
    (ex, ey), whole = profile, True
    room, a = np.empty((3, z.shape[0], z.shape[1])), np.empty(z.shape[1])
    var, info, signal = room[0], room[1], room[2]
    for j in range(len(a)):
        a[j] = ((j - center[0]) / s) ** 2
    for i in range(len(z)):
        b = ((i - center[1]) / s) ** 2
        for j in range(z.shape[1]):
            p = ((corner[1] + i) & 1) * 2 + ((corner[0] + j) & 1) if parts == 4 else 0
            g = amplitude[p] * ex[j] * ey[i]
            z[i, j] -= ground[p] + g
            var[i, j] = noise * noise + signal_noise * max(g, 0.0)
            info[i, j] = g * g * (a[j] + b) / var[i, j]
            whole &= not np.isnan(z[i, j])
            signal[i, j] = g
    middle_j, middle_i = int(np.floor(center[0] + 0.5)), int(np.floor(center[1] + 0.5))
    total, weight, square, least = 0.0, 0.0, 0.0, 0.0
    for i in range(len(z)):
        for j in range(z.shape[1]):
            k, m = 2 * middle_i - i, 2 * middle_j - j
            if whole and (not (i < k or (i == k and j < m)) or k >= len(z) or m < 0 or m >= z.shape[1]):
                continue
            odd, share, expected, profile_var = z[i, j], info[i, j], var[i, j], 0.0
            if whole:
                odd, share, expected = odd - z[k, m], share + info[k, m], expected + var[k, m]
                profile_var = (_PROFILE * signal[i, j]) ** 2 + (_PROFILE * signal[k, m]) ** 2
            if not np.isnan(odd):
                total += share * odd * odd / (expected + profile_var)
                least += share * profile_var / (expected + profile_var)
                weight += share
                square += share * share
    if weight <= 0.0:
        return 1.0
    dof, found, granted = weight * weight / square, total / weight, least / weight
    at_least = min(found + granted, 1.0)  # a spot that is a Gaussian after all has noise as well
    return max((_PRIOR_DOF + dof * found) / (_PRIOR_DOF + max(dof - fitted, _LEFT * dof)), at_least)


@njit(error_model="numpy")
def _unroll(z: Array, flat: Array, used: Array) -> None:
    """Write the samples of one plane row by row, 0 and not `used` where one is NaN."""
    k = 0
    for i in range(z.shape[0]):
        for j in range(z.shape[1]):
            bad = np.isnan(z[i, j])
            flat[k], used[k] = (0.0, 0.0) if bad else (z[i, j], 1.0)
            k += 1


@njit(error_model="numpy")
def _profile(ex: Array, ey: Array, at: tuple[float, float, float], g: Array, a: Array, b: Array) -> int:
    """Write the profile `g` of one plane's samples, row by row, and their place `a`, `b` from the centre in widths.

    `at`: the first sample's place along either axis, and the distance of two. Returns how many there are.
    """
    k, n = 0, len(ex)
    for i in range(len(ey)):
        e, y = ey[i], at[1] + at[2] * i
        for j in range(n):
            g[k + j], a[k + j], b[k + j] = ex[j] * e, at[0] + at[2] * j, y
        k += n
    return k


@njit(error_model="numpy", fastmath={"reassoc", "contract"})
def _amplitude(z: Array, used: Array, g: Array, noise: float, signal_noise: float) -> tuple[float, float]:
    """Least-squares amplitude and background of one plane under the present profile, of the samples `used`.

    `signal_noise` is the variance that the profile adds to the noise's where it is 1.
    """
    gg, g1, n, gz, z1 = 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(len(z)):
        w = used[k] / (noise * noise + signal_noise * g[k])
        gg += w * g[k] * g[k]
        g1 += w * g[k]
        n += w
        gz += w * g[k] * z[k]
        z1 += w * z[k]
    det = gg * n - g1 * g1
    if n > 0.0 and det > 1e-9 * gg * n:
        return (n * gz - g1 * z1) / det, (gg * z1 - g1 * gz) / det
    return 0.0, z1 / max(n, 1e-12)


@njit(error_model="numpy", fastmath={"reassoc", "contract"})
def _add_equations(
    z: Array,
    used: Array,
    profile: Array,
    a: Array,
    b: Array,
    s: float,
    noise: float,
    signal_noise: float,
    amplitude: float,
    ground: float,
    S: Array,
    right_side: Array,
) -> None:
    """Add one plane to the upper triangle of the Schur complement `S` (3, 3) of position and width, and to its side.

    `profile`, `a` and `b` of its samples: see `_profile`.
    """
    s00, s01, s02, s11, s12, s22 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    r0, r1, r2 = 0.0, 0.0, 0.0
    gg, g1, n = 0.0, 0.0, 0.0
    g_j0, g_j1, g_j2, j_0, j_1, j_2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    shot, per_width = signal_noise * max(amplitude, 0.0), amplitude / s
    for k in range(len(z)):
        g = profile[k]
        w = used[k] / (noise * noise + shot * g)
        d = per_width * g
        j0, j1, j2 = d * a[k], d * b[k], d * (a[k] * a[k] + b[k] * b[k])
        wr, w0, w1, w2, wg = w * (z[k] - ground - amplitude * g), w * j0, w * j1, w * j2, w * g
        s00 += w0 * j0
        s01 += w0 * j1
        s02 += w0 * j2
        s11 += w1 * j1
        s12 += w1 * j2
        s22 += w2 * j2
        r0 += wr * j0
        r1 += wr * j1
        r2 += wr * j2
        gg += wg * g
        g1 += wg
        n += w
        g_j0 += wg * j0
        g_j1 += wg * j1
        g_j2 += wg * j2
        j_0 += w0
        j_1 += w1
        j_2 += w2
    S[0, 0] += s00
    S[0, 1] += s01
    S[0, 2] += s02
    S[1, 1] += s11
    S[1, 2] += s12
    S[2, 2] += s22
    right_side[0] += r0
    right_side[1] += r1
    right_side[2] += r2
    det = gg * n - g1 * g1
    if not det > 1e-9 * gg * n:
        return
    of_g, of_1 = (g_j0, g_j1, g_j2), (j_0, j_1, j_2)
    for k in range(3):
        for m in range(k, 3):
            mixed = of_g[k] * of_1[m] + of_1[k] * of_g[m]
            S[k, m] -= (n * of_g[k] * of_g[m] - g1 * mixed + gg * of_1[k] * of_1[m]) / det


@njit(error_model="numpy")
def _solve(S: Array, b: Array) -> tuple[Array, bool]:
    """Solution (3,) of S x = b by the adjugate."""
    c0 = S[1, 1] * S[2, 2] - S[1, 2] * S[2, 1]
    c1 = S[1, 2] * S[2, 0] - S[1, 0] * S[2, 2]
    c2 = S[1, 0] * S[2, 1] - S[1, 1] * S[2, 0]
    det = S[0, 0] * c0 + S[0, 1] * c1 + S[0, 2] * c2
    x = np.zeros(3)
    if not det > 1e-12 * S[0, 0] * S[1, 1] * S[2, 2]:
        return x, False
    x[0] = (
        c0 * b[0] + (S[0, 2] * S[2, 1] - S[0, 1] * S[2, 2]) * b[1] + (S[0, 1] * S[1, 2] - S[0, 2] * S[1, 1]) * b[2]
    ) / det
    x[1] = (
        c1 * b[0] + (S[0, 0] * S[2, 2] - S[0, 2] * S[2, 0]) * b[1] + (S[0, 2] * S[1, 0] - S[0, 0] * S[1, 2]) * b[2]
    ) / det
    x[2] = (
        c2 * b[0] + (S[0, 1] * S[2, 0] - S[0, 0] * S[2, 1]) * b[1] + (S[0, 0] * S[1, 1] - S[0, 1] * S[1, 0]) * b[2]
    ) / det
    return x, True


@njit(error_model="numpy")
def _top_left_of_inverse(S: Array) -> tuple[tuple[float, float, float], bool]:
    """The entries uu, uv, vv of the inverse of S (3, 3)."""
    a = S[0, 0] - S[0, 2] ** 2 / S[2, 2]
    b = S[0, 1] - S[0, 2] * S[1, 2] / S[2, 2]
    c = S[1, 1] - S[1, 2] ** 2 / S[2, 2]
    det = a * c - b * b
    if not (det > 1e-12 * a * c and a > 0.0):
        return (0.0, 0.0, 0.0), False
    return (c / det, -b / det, a / det), True
