"""Light from solids to the camera: lamps and daylight reflected by diffuse and glossy surfaces, through water.

Bands are those of `sim.water`. All geometry is in the frame `cam`, so that every line of sight starts at the origin.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lumidock._kernels.compiling import part
from lumidock._kernels.rendering.raycast import BOX, Solids, between, cell_of, normal, to_local
from lumidock.datatypes import Array, Indices

PLAIN, TILES, SECTORS, STRIPES = range(4)
BANDS = 3
DIFFUSE, GLOSSY, WATER, PARTS = 0, 3, 6, 9  # index of the first of three bands of each part of a sample's light
_PER_PI = 1.0 / math.pi
_OFF_SURFACE_M = 5e-4  # distance off the surface at which a shadow ray starts
_LOBE_END = 25.0  # of n (1 - cosine), beyond which cosine^n is under 1e-10 and set to 0
_NOTHING = 0.02  # share of `LitScene.faint` below which a lamp is left out
# Irradiance of a vertical face and of a face turned down, over that from above: radiance distribution and irradiance
# reflectance of coastal water. Source: C. Mobley, Light and Water, 1994, ch. 10
_SIDE, _BELOW = 0.3, 0.05


class Lights(NamedTuple):
    """L lamps.

    Positions `p_cam` (L, 3) m, unit `axis` (L, 3), and radius of the window `radius_m` (L,). The radiant intensity in
    each band is `peak` cos^`exponent` + `even` W/sr, with `peak` and `even` (L, 3) and `exponent` (L,).
    """

    p_cam: Array
    axis: Array
    peak: Array
    even: Array
    exponent: Array
    radius_m: Array


class Surfaces(NamedTuple):
    """K surfaces.

    Diffuse reflectance `albedo` (K, 3), and `second` (K, 3) in the lines of the pattern; reflectance of the glossy
    lobe, `gloss` (K,), and its exponent, `shininess` (K,); `pattern` (K,), its `period` (K,), m or for sectors rad, and
    the `share` (K,) of its lines; relative change of albedo `mottle` (K,) by stains and their size `mottle_m` (K,).
    """

    albedo: Array
    second: Array
    gloss: Array
    shininess: Array
    pattern: Indices
    period: Array
    share: Array
    mottle: Array
    mottle_m: Array


class Medium(NamedTuple):
    """The water and what lights it.

    Beam attenuation coefficient `beam` (3,) 1/m; irradiance of daylight just below the surface, `surface` (3,) W/m2,
    its `decay` (3,) 1/m with depth, the upward direction `up` (3,) in `cam`, and the camera's `depth_m`; daylight
    scattered into the line of sight, `sideways` (N, 3) 1/(m sr), for N cosines to `up` from -1 to 1; radiance of
    headlamp light scattered before each range `edge_m` (T,), `lamp_sr` (T, h, w, 3) W/(m2 sr), on a coarse grid.
    """

    beam: Array
    surface: Array
    decay: Array
    up: Array
    depth_m: float
    sideways: Array
    lamp_sr: Array
    edge_m: Array


class LitScene(NamedTuple):
    """Solids, lights and water. Lamps that add less than the irradiance `faint` W/m2 at a point get no shadow there.

    `blockers` (L, CELLS, S + 1) lists for each lamp the solids in each direction, as `raycast.list_blockers` fills it;
    `noise` (n, n) are random values in [-1, 1) for stains, n a power of two.
    """

    solids: Solids
    surfaces: Surfaces
    lights: Lights
    medium: Medium
    faint: float
    blockers: NDArray[np.int16]
    noise: Array


@part
def lobe(shininess: float, cosine: float) -> float:
    """Normalised Blinn-Phong lobe 1/sr; `cosine` is that of the normal to the half vector, `shininess` the exponent n.

    It reflects all light that comes head-on: the integral of cos^n over the hemisphere is
    8 pi (2^(-n/2) + n) / ((n + 2) (n + 4)). Source: J. Blinn, SIGGRAPH 1977.
    """
    n = shininess
    if cosine <= 0.0 or n * (1.0 - cosine) > _LOBE_END:
        return 0.0
    edge = 2.0 ** (-0.5 * n) if n < 2.0 * _LOBE_END else 0.0
    return (n + 2.0) * (n + 4.0) / (8.0 * math.pi * (edge + n)) * cosine**n


@part
def daylight(medium: Medium, band: int, height_m: float, cosine: float) -> float:
    """Irradiance W/m2 by daylight on a face `height_m` above the camera; `cosine` of its normal to the vertical."""
    down = medium.surface[band] * math.exp(-medium.decay[band] * max(medium.depth_m - height_m, 0.0))
    return down * (_SIDE + ((1.0 - _SIDE) if cosine > 0.0 else (_SIDE - _BELOW)) * cosine)


@part
def reflected(
    scene: LitScene, s: int, face: int, dx: float, dy: float, dz: float, t: float, out: Array, i: int, j: int
) -> None:
    """Compute the light that solid `s` reflects toward the camera from the point at `t` m on the ray (dx, dy, dz).

    `out[i, j]` (9,) gets in each band the diffuse radiance over the albedo, then the glossy radiance, W/(m2 sr).
    """
    solids, lights, medium = scene.solids, scene.lights, scene.medium
    x, y, z = dx * t, dy * t, dz * t
    nx, ny, nz = normal(solids, s, face, x, y, z)
    if nx * dx + ny * dy + nz * dz > 0.0:
        nx, ny, nz = -nx, -ny, -nz
    up = medium.up
    height, rise = up[0] * x + up[1] * y + up[2] * z, up[0] * nx + up[1] * ny + up[2] * nz
    for band in range(BANDS):
        out[i, j, DIFFUSE + band] = daylight(medium, band, height, rise) * _PER_PI
        out[i, j, GLOSSY + band] = 0.0
    k = solids.surface[s]
    for lamp in range(len(lights.exponent)):
        p = lights.p_cam[lamp]
        lx, ly, lz = p[0] - x, p[1] - y, p[2] - z
        facing = lx * nx + ly * ny + lz * nz
        if facing <= 0.0:
            continue
        r2 = lx * lx + ly * ly + lz * lz
        r = math.sqrt(r2)
        lx, ly, lz, facing = lx / r, ly / r, lz / r, facing / r
        axis = lights.axis[lamp]
        ahead = -(lx * axis[0] + ly * axis[1] + lz * axis[2])
        beam = 0.0
        if ahead > 0.0:
            beam = ahead if lights.exponent[lamp] == 1.0 else ahead ** lights.exponent[lamp]
        # irradiance on the axis of a diffuse disc of radius a and intensity I = pi a^2 L: pi L a^2 / (r^2 + a^2)
        scale = facing / (r2 + lights.radius_m[lamp] ** 2)
        most = 0.0
        for band in range(BANDS):
            most = max(most, beam * lights.peak[lamp, band] + lights.even[lamp, band])
        if most * scale <= _NOTHING * scene.faint:
            continue
        if most * scale > scene.faint:
            reach = r - lights.radius_m[lamp]
            ox, oy, oz = x + nx * _OFF_SURFACE_M, y + ny * _OFF_SURFACE_M, z + nz * _OFF_SURFACE_M
            if between(solids, scene.blockers[lamp, cell_of(-lx, -ly, -lz)], ox, oy, oz, lx, ly, lz, reach):
                continue
        bright = 0.0
        if scene.surfaces.gloss[k] > 0.0:
            hx, hy, hz = lx - dx, ly - dy, lz - dz
            cosine = (hx * nx + hy * ny + hz * nz) / math.sqrt(hx * hx + hy * hy + hz * hz)
            bright = scene.surfaces.gloss[k] * lobe(scene.surfaces.shininess[k], cosine)
        for band in range(BANDS):
            power = beam * lights.peak[lamp, band] + lights.even[lamp, band]
            if power > 0.0:
                light = power * scale * math.exp(-medium.beam[band] * r)
                out[i, j, DIFFUSE + band] += light * _PER_PI
                out[i, j, GLOSSY + band] += light * bright


@part
def through_water(
    medium: Medium, dx: float, dy: float, dz: float, t: float, u: float, v: float, out: Array, i: int, j: int
) -> None:
    """Attenuate `out[i, j]` (9,) over `t` m of water, and set its last part to light that this water scatters.

    `u`, `v` are the coordinates on the grid of `lamp_sr`. Daylight is integrated in closed form, as in
    `sim.surroundings`.
    """
    rise = dx * medium.up[0] + dy * medium.up[1] + dz * medium.up[2]
    length = min(t, max(medium.depth_m, 0.01) / rise) if rise > 1e-3 else t
    place = min(max((rise + 1.0) * 0.5 * (len(medium.sideways) - 1), 0.0), len(medium.sideways) - 1.001)
    row = int(place)
    part = place - row
    for band in range(BANDS):
        kept = math.exp(-medium.beam[band] * t)
        out[i, j, DIFFUSE + band] *= kept
        out[i, j, GLOSSY + band] *= kept
        scattered = (1.0 - part) * medium.sideways[row, band] + part * medium.sideways[row + 1, band]
        day = medium.surface[band] * math.exp(-medium.decay[band] * max(medium.depth_m, 0.0))
        rate = medium.beam[band] - medium.decay[band] * rise
        if abs(rate) < 1e-6:
            rate = 1e-6
        along = -math.expm1(-min(rate * length, 50.0)) / rate
        out[i, j, WATER + band] = day * scattered * along
    if len(medium.edge_m) > 0:
        _add_lamp(medium, t, u, v, out, i, j)


@part
def _add_lamp(medium: Medium, t: float, u: float, v: float, out: Array, i: int, j: int) -> None:
    """Add scattered light of the headlamp, interpolated linearly in range and across the grid."""
    edges, lamp_sr = medium.edge_m, medium.lamp_sr
    step = 1
    while step < len(edges) - 1 and edges[step] < t:
        step += 1
    w = min(max((t - edges[step - 1]) / (edges[step] - edges[step - 1]), 0.0), 1.0)
    height, width = lamp_sr.shape[1:3]
    u, v = min(max(u, 0.0), width - 1.001), min(max(v, 0.0), height - 1.001)
    column, row = int(u), int(v)
    fu, fv = u - column, v - row
    for band in range(BANDS):
        total = 0.0
        for a in range(2):
            for b in range(2):
                near, far = lamp_sr[step - 1, row + a, column + b, band], lamp_sr[step, row + a, column + b, band]
                weight = (fv if a else 1.0 - fv) * (fu if b else 1.0 - fu)
                total += weight * (near + w * (far - near))
        out[i, j, WATER + band] += total


@part
def _stains(noise: Array, x: float, y: float) -> float:
    """Smooth noise in [-1, 1]: random values at integer points, interpolated. Source: K. Perlin, SIGGRAPH 1985."""
    ix, iy = math.floor(x), math.floor(y)
    fx, fy = x - ix, y - iy
    fx, fy = fx * fx * (3.0 - 2.0 * fx), fy * fy * (3.0 - 2.0 * fy)
    last = len(noise) - 1
    a, b, c, d = int(ix) & last, int(iy) & last, (int(ix) + 1) & last, (int(iy) + 1) & last
    top = noise[b, a] * (1.0 - fx) + noise[b, c] * fx
    low = noise[d, a] * (1.0 - fx) + noise[d, c] * fx
    return top * (1.0 - fy) + low * fy


@part
def paint(scene: LitScene, s: int, face: int, x: float, y: float, z: float, footprint_m: float) -> tuple[float, float]:
    """Share of a sample that is in lines of the pattern of solid `s`, and the factor of stains on the albedo.

    `footprint_m` is the size of the sample on the surface, over which the pattern is averaged.
    """
    surfaces, k = scene.surfaces, scene.solids.surface[s]
    if surfaces.pattern[k] == PLAIN and surfaces.mottle[k] == 0.0:
        return 0.0, 1.0
    lx, ly, lz = to_local(scene.solids, s, x, y, z)
    a, b = lx, ly
    if scene.solids.kind[s] == BOX and face == 0:
        a, b = ly, lz
    elif scene.solids.kind[s] == BOX and face == 1:
        a, b = lx, lz
    other = 0.0
    size, share = surfaces.period[k], surfaces.share[k]
    if surfaces.pattern[k] == TILES:
        other = 1.0 - (1.0 - _line(a, size, share, footprint_m)) * (1.0 - _line(b, size, share, footprint_m))
    elif surfaces.pattern[k] == SECTORS:
        radius = max(math.sqrt(lx * lx + ly * ly), 1e-6)
        other = _line(math.atan2(ly, lx) * radius, size * radius, share, footprint_m)
    elif surfaces.pattern[k] == STRIPES:
        other = _line(lz, size, share, footprint_m)
    factor = 1.0
    if surfaces.mottle[k] > 0.0:
        scale, depth = surfaces.mottle_m[k], surfaces.mottle[k]
        noise = 0.0
        for octave in range(3):
            if scale > footprint_m:
                shift = 17.3 * octave + 5.7 * s
                noise += depth * _stains(scene.noise, a / scale + shift, b / scale + shift)
            scale, depth = 0.35 * scale, 0.6 * depth
        factor = max(1.0 + noise, 0.05)
    return other, factor


@part
def _line(place: float, period: float, share: float, footprint: float) -> float:
    """Share of a `footprint` around `place` that is in lines; each line begins at a multiple of `period`."""
    if footprint >= period:
        return share
    start = (place - 0.5 * footprint) / period
    whole = math.floor(start)
    low, high = start - whole, start - whole + footprint / period
    covered = max(min(high, share) - low, 0.0)
    if high > 1.0:
        covered += min(high - 1.0, share)
    return min(covered / (footprint / period), 1.0)
