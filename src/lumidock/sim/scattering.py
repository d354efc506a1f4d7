"""Scattering in water: measured phase functions, and the halo around a lamp from single and multiple scattering."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from lumidock.datatypes import Array

# T. Petzold, Volume scattering functions for selected ocean waters, SIO Ref. 72-78, 1972: 1/(m sr) at 530 nm, at 21
# angles from 0.1 to 10 degrees evenly in their logarithm, then every 5 degrees; before them the slope below 0.1 degrees
_ANGLE_DEG = np.concatenate([np.logspace(-1.0, 1.0, 21), np.arange(15.0, 181.0, 5.0)])
_PETZOLD: dict[str, tuple[float, str]] = {
    # clear: AUTEC 8, Tongue of the Ocean; coastal: HAOCE 11, Catalina Channel; harbour: NUC 2200, San Diego
    "clear": (
        -1.191,
        "53.18 40.42 30.73 23.73 18.14 13.60 9.954 7.179 5.110 3.591 2.498 1.719 1.171 .7758 .5087 .3340 .2196 "
        ".1446 .09522 .06282 .04162 .02038 .01099 .006166 .003888 .002680 .001899 .001372 .001020 .0007683 "
        ".0006028 .0004883 .0004069 .0003457 .0003019 .0002681 .0002459 .0002315 .0002239 .0002225 .0002239 "
        ".0002265 .0002339 .0002505 .0002629 .0002661 .0002749 .0002896 .0003088 .0003304 .0003627 .0004073 "
        ".0004671 .0004845 .0005019",
    ),
    "coastal": (
        -1.545,
        "653.3 457.7 320.6 225.2 157.9 110.4 77.31 53.70 36.75 24.80 16.62 11.06 7.306 4.750 3.067 1.977 1.273 "
        ".8183 .5285 .3402 .2155 .09283 .04427 .02390 .01445 .009063 .006014 .004143 .002993 .002253 .001737 "
        ".001369 .001094 .0008782 .0007238 .0006036 .0005241 .0004703 .0004363 .0004189 .0004073 .0003994 "
        ".0003972 .0003984 .0004071 .0004219 .0004458 .0004775 .0005232 .0005824 .0006665 .0007823 .0009393 "
        ".0009847 .001030",
    ),
    "harbour": (
        -1.249,
        "2690 2018 1514 1143 858.8 638.6 471.3 343.4 246.1 173.7 121.0 83.19 56.48 37.38 24.42 15.88 10.29 6.633 "
        "4.256 2.720 1.732 .7765 .3939 .2475 .1375 .09617 .06867 .04983 .03700 .02782 .02159 .01722 .01402 .01158 "
        ".009749 .008344 .007241 .006329 .005650 .005113 .004748 .004533 .004368 .004266 .004153 .003965 .003905 "
        ".003967 .004106 .004291 .004623 .005119 .005814 .006012 .006211",
    ),
}
# Grids of the Hankel transforms, even in the logarithm: products k theta, and angles at which the halo is tabulated.
_STEP, _STRIDE = 0.012, 12
_PRODUCT = np.exp(np.arange(np.log(1e-5), np.log(60.0), _STEP))
_HALO_RAD = np.exp(np.arange(96) * _STRIDE * _STEP + np.log(2e-6))
_BLUR = 0.1  # relative width of a smoothing that makes the transforms converge; its error is of the sixth order
_ANGLES_OF_ARC = 96  # scattering angles at which single scattering is integrated


def integral(values: Array, at: Array) -> Array:
    """Integral over the last axis of `values` given at the points `at`, by the trapezoidal rule.

    numpy 1 and numpy 2 have this function under different names.
    """
    return np.asarray(((values[..., 1:] + values[..., :-1]) * np.diff(at, axis=-1) / 2.0).sum(axis=-1))


@lru_cache
def phase_function(kind: str) -> tuple[Array, Array]:
    """Scattering angles (A,) rad and the phase function (A,) 1/sr there; its integral over the sphere is one.

    Source: T. Petzold, 1972 (scattering by water and particles), extended below 0.1 degrees by his slopes.
    """
    slope, text = _PETZOLD[kind]
    measured = np.array([float(value) for value in text.split()])
    angle = np.exp(np.linspace(np.log(1e-7), np.log(np.pi), 4000))
    below = measured[0] * (angle / np.deg2rad(_ANGLE_DEG[0])) ** slope
    beta = np.exp(np.interp(np.log(angle), np.log(np.deg2rad(_ANGLE_DEG)), np.log(measured)))
    beta = np.where(angle < np.deg2rad(_ANGLE_DEG[0]), below, beta)
    return angle, beta / float(integral(2.0 * np.pi * beta * np.sin(angle), angle))


def phase_at(kind: str, angle_rad: Array) -> Array:
    """The phase function 1/sr at any angles rad."""
    angle, beta = phase_function(kind)
    return np.asarray(np.exp(np.interp(np.log(np.maximum(angle_rad, angle[0])), np.log(angle), np.log(beta))))


def backscatter_share(kind: str) -> float:
    """Share of the scattered light that is deflected by more than 90 degrees."""
    angle, beta = phase_function(kind)
    back = angle > np.pi / 2.0
    return float(integral(2.0 * np.pi * (beta * np.sin(angle))[back], angle[back]))


def _bessel_j0(x: Array) -> Array:
    """Bessel function of the first kind, order 0, to 1e-7. Source: Abramowitz & Stegun 9.4.1, 9.4.3."""
    small = np.polynomial.polynomial.polyval(
        (np.minimum(x, 3.0) / 3.0) ** 2, [1.0, -2.2499997, 1.2656208, -0.3163866, 0.0444479, -0.0039444, 0.0002100]
    )
    inverse = 3.0 / np.maximum(x, 3.0)
    poly = np.polynomial.polynomial.polyval
    size = poly(inverse, [0.79788456, -7.7e-7, -0.00552740, -9.512e-5, 0.00137237, -0.00072805, 0.00014476])
    phase = poly(inverse, [-0.78539816, -0.04166397, -3.954e-5, 0.00262573, -0.00054125, -0.00029333, 0.00013558])
    return np.asarray(np.where(x <= 3.0, small, size * np.cos(x + phase) / np.sqrt(np.maximum(x, 3.0))))


@lru_cache
def _kernel() -> Array:
    """Weights of a Hankel transform at the products k theta of `_PRODUCT`."""
    y = 0.5 * (_BLUR * _PRODUCT) ** 2
    smooth = np.exp(-y) * (1.0 + y + 0.5 * y * y)
    return np.asarray(_bessel_j0(_PRODUCT) * smooth * _PRODUCT**2 * _STEP)


def _hankel(values: Array, variable: Array) -> Array:
    """Hankel transform of order zero, integral of f(x) J0(v x) x dx, at each `variable` v.

    `values` are f at the points `_hankel_grid(variable)`. On logarithmic grids the transform is a correlation.
    Source: A. Hamilton, MNRAS 312, 2000.
    """
    windows = np.lib.stride_tricks.sliding_window_view(values, len(_PRODUCT), axis=-1)[..., ::_STRIDE, :]
    return np.asarray((windows @ _kernel())[..., ::-1] / variable**2)


def _hankel_grid(variable: Array) -> Array:
    """Points at which `_hankel` needs the function to be transformed, for results at each `variable` (V,)."""
    n = len(_PRODUCT) + (len(variable) - 1) * _STRIDE
    return np.asarray(_PRODUCT[0] / variable[-1] * np.exp(np.arange(n) * _STEP))


@lru_cache
def _path_spectrum(kind: str) -> tuple[Array, Array]:
    """Angular frequencies k 1/rad, and the Hankel transform of the phase function averaged over the path, Q(k).

    Q(k) is the mean of the transform at u k over u from 0 to 1: light that is deflected by alpha at the fraction u of
    its way from lamp to camera arrives at the angle u alpha from the lamp.
    """
    k = _hankel_grid(_HALO_RAD)
    coarse = np.exp(np.arange(0, len(k) + _STRIDE, _STRIDE) * _STEP) * k[0]
    theta = _hankel_grid(coarse)
    flat = phase_at(kind, theta) * np.sinc(theta / np.pi)  # sin(theta) / theta maps the sphere to the plane
    spectrum = 2.0 * np.pi * _hankel(np.where(theta < np.pi, flat, 0.0), coarse)
    fine = np.interp(np.log(k), np.log(coarse), spectrum)
    sums = np.concatenate([[0.0], np.cumsum(0.5 * (fine[1:] + fine[:-1]) * np.diff(k))])
    return k, np.minimum((fine[0] * k[0] + sums) / k, 1.0)


@lru_cache(maxsize=4096)
def halo(a: float, b: float, kind: str, distance_m: float, blur_rad: float = 0.0) -> tuple[Array, Array]:
    """Halo of an isotropic lamp: angles (A,) rad from the lamp and the relative radiance (A,) 1/sr of its halo there.

    The radiance is relative to the irradiance that the lamp would cause at the camera without water. `a` and `b` are
    coefficients 1/m of absorption and scattering, `blur_rad` is the 1-sigma angle of the lamp's own Gaussian image. In
    the small-angle approximation the transform of all light is exp(-(a + b) R) exp(b R Q(k)); its terms of direct light
    and of light scattered once are subtracted, and single scattering is added exactly, at all angles.
    Source: W. Wells, J. Opt. Soc. Am. 59, 1969 and AGARD LS-61, 1973; C. Mobley, Light and Water, 1994.
    """
    k, path = _path_spectrum(kind)
    depth, once = b * distance_m, b * distance_m * path
    beam = np.exp(-(a + b) * distance_m)
    few, far = (
        beam * (np.expm1(np.minimum(once, 1.0)) - once),
        np.exp(once - depth - a * distance_m) - beam * (1.0 + once),
    )
    many = np.where(once < 1.0, few, far) * np.exp(-0.5 * (k * blur_rad) ** 2)
    theta = _HALO_RAD
    return theta, np.maximum(_hankel(many, theta) / (2.0 * np.pi), 0.0) + _single(a, b, kind, distance_m, blur_rad)


def _single(a: float, b: float, kind: str, distance_m: float, blur_rad: float) -> Array:
    """Light scattered once, at each angle theta of the halo: b R / sin(theta) integral beta(alpha) exp(-c way) dalpha.

    The scattering angle alpha runs from theta to pi along the line of sight; `way` is the length of the path from the
    lamp over the point of scattering to the camera, and c = a + b.
    """
    share = np.linspace(0.0, 1.0, _ANGLES_OF_ARC)[None, :]
    theta = np.minimum(np.hypot(_HALO_RAD, 0.7 * blur_rad), 1.5)[:, None]  # the blur flattens the peak at the lamp
    alpha = theta * (np.pi / theta) ** share
    sight = distance_m * (np.cos(theta) - np.sin(theta) / np.tan(np.maximum(alpha, theta)))
    rest = distance_m * np.sin(theta) / np.maximum(np.sin(alpha), 1e-12)
    way = np.clip(sight, 0.0, None) + rest
    light = phase_at(kind, alpha) * np.exp(-np.minimum((a + b) * way, 700.0))
    return np.asarray(b * distance_m / np.sin(theta[:, 0]) * integral(light, alpha))
