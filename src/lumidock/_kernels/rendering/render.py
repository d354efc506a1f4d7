"""Renders solids in water: first hit of the ray of every sample, light at as many samples as its changes need."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lumidock._kernels.compiling import entry, part
from lumidock._kernels.rendering.raycast import BOX, CELLS, FAR_M, RING, Solids, between, hit, list_blockers, may_hit
from lumidock._kernels.rendering.shading import (
    BANDS,
    DIFFUSE,
    GLOSSY,
    PARTS,
    WATER,
    LitScene,
    lobe,
    paint,
    reflected,
    through_water,
)
from lumidock.datatypes import Array, Indices

BLOCK = 16  # samples along the side of a block, the largest part whose light is interpolated
_SHARP = 30.0  # exponent of a curved surface's glossy lobe, over which parts larger than `_FINE` could miss its peak
_FINE = 4  # samples along the side of a small part
_MARGIN = 1.1  # on the angle from the middle of a block to its corner, as rays are interpolated between corners
# error that the light in the middle of an interpolated part may have: relative, and in units of `LitScene.faint`, which
# together are less than the read noise
_TOLERANCE, _FAINTS = 0.03, 4.0


class Sight(NamedTuple):
    """Rays and sensitivity of samples.

    `rays` (m, n, 3) in `cam`, and `etendue` (m, n) sr of a sample, at the corners of blocks; electrons `gain` (C, 3) of
    each channel per W/(m2 sr) and sr in each band; the angle `spread` rad between opposite corners of a block, and
    `step` rad between samples; the number `coarse` of samples between two columns of `Medium.lamp_sr`.
    """

    rays: Array
    etendue: Array
    gain: Array
    spread: float
    step: float
    coarse: float


class Scratch(NamedTuple):
    """Buffers for one block of B x B samples.

    `rays` (B, B, 3), `etendue` (B, B); `what` (B, B): four times the solid that was hit plus its face, -1 for none;
    `far` (B, B): its range m; `light` (B, B, 9): three parts in three bands. Lists of solids (S + 1,) with their count
    first: `all`, `some` that rays of the block may hit, `few` that rays of a small part may. `stack` (64, 3): parts
    that are not yet shaded.
    """

    rays: Array
    etendue: Array
    what: Indices
    far: Array
    light: Array
    all: Indices
    some: Indices
    few: Indices
    stack: Indices


class Picture(NamedTuple):
    """The rendered samples; H and W are multiples of the block.

    `electrons` (H, W, C); `range_m` (H, W) of the first hits; `cells` (h, w, C): electrons of solids without light that
    water scatters, as means over cells, which must be zero at first.
    """

    electrons: NDArray[np.float32]
    range_m: NDArray[np.float32]
    cells: NDArray[np.float32]


@part
def _aim(sight: Sight, row: int, column: int, own: Scratch) -> None:
    """Interpolate the rays and the etendue of a block's samples between its corners."""
    rays, step = sight.rays, 1.0 / BLOCK
    for i in range(BLOCK):
        fv = i * step
        x = rays[row, column, 0] * (1.0 - fv) + rays[row + 1, column, 0] * fv
        y = rays[row, column, 1] * (1.0 - fv) + rays[row + 1, column, 1] * fv
        z = rays[row, column, 2] * (1.0 - fv) + rays[row + 1, column, 2] * fv
        e = sight.etendue[row, column] * (1.0 - fv) + sight.etendue[row + 1, column] * fv
        to_x = (rays[row, column + 1, 0] * (1.0 - fv) + rays[row + 1, column + 1, 0] * fv - x) * step
        to_y = (rays[row, column + 1, 1] * (1.0 - fv) + rays[row + 1, column + 1, 1] * fv - y) * step
        to_z = (rays[row, column + 1, 2] * (1.0 - fv) + rays[row + 1, column + 1, 2] * fv - z) * step
        to_e = (sight.etendue[row, column + 1] * (1.0 - fv) + sight.etendue[row + 1, column + 1] * fv - e) * step
        for j in range(BLOCK):
            dx, dy, dz = x + to_x * j, y + to_y * j, z + to_z * j
            scale = 1.0 / math.sqrt(dx * dx + dy * dy + dz * dz)
            own.rays[i, j, 0], own.rays[i, j, 1], own.rays[i, j, 2] = dx * scale, dy * scale, dz * scale
            own.etendue[i, j] = e + to_e * j


@part
def _keep(solids: Solids, among: Indices, ray: Array, half_angle: float, kept: Indices) -> None:
    """Put those of the solids `among[1:1 + among[0]]` into `kept` that rays within `half_angle` of `ray` may hit."""
    count = 0
    for k in range(among[0]):
        s = among[k + 1]
        if may_hit(solids, s, 0.0, 0.0, 0.0, ray[0], ray[1], ray[2], half_angle):
            count += 1
            kept[count] = s
    kept[0] = count


@part
def _cast(solids: Solids, spread: float, own: Scratch) -> None:
    """Find the first hit of every sample of a block, after excluding solids for the block and for its small parts."""
    _keep(solids, own.all, own.rays[BLOCK // 2, BLOCK // 2], _MARGIN * 0.5 * spread, own.some)
    for top in range(0, BLOCK, _FINE):
        for left in range(0, BLOCK, _FINE):
            middle = own.rays[top + _FINE // 2, left + _FINE // 2]
            _keep(solids, own.some, middle, _MARGIN * 0.5 * spread * _FINE / BLOCK, own.few)
            for i in range(top, top + _FINE):
                for j in range(left, left + _FINE):
                    dx, dy, dz = own.rays[i, j]
                    near, what = FAR_M, -1
                    for k in range(own.few[0]):
                        s = own.few[k + 1]
                        t, face = hit(solids, s, 0.0, 0.0, 0.0, dx, dy, dz)
                        if 0.0 < t < near:
                            near, what = t, 4 * s + face
                    own.far[i, j], own.what[i, j] = near, what


@part
def _shade(scene: LitScene, sight: Sight, place: tuple[int, int], own: Scratch, i: int, j: int) -> None:
    """Compute the light of one sample."""
    what, t = own.what[i, j], own.far[i, j]
    dx, dy, dz = own.rays[i, j]
    if what < 0:
        for band in range(PARTS):
            own.light[i, j, band] = 0.0
    else:
        reflected(scene, what >> 2, what & 3, dx, dy, dz, t, own.light, i, j)
    u, v = (place[1] + j) / sight.coarse, (place[0] + i) / sight.coarse
    through_water(scene.medium, dx, dy, dz, t, u, v, own.light, i, j)


@part
def _uniform(own: Scratch, top: int, left: int, side: int) -> bool:
    """Whether all samples of a part hit the same face of the same solid."""
    what = own.what[top, left]
    for i in range(top, top + side):
        for j in range(left, left + side):
            if own.what[i, j] != what:
                return False
    return True


@part
def _blended(own: Scratch, top: int, left: int, side: int, i: int, j: int, band: int) -> float:
    """Light of sample (i, j) interpolated between the corners of a part."""
    last = side - 1
    fv, fu, light = (i - top) / last, (j - left) / last, own.light
    high = light[top, left, band] * (1.0 - fu) + light[top, left + last, band] * fu
    low = light[top + last, left, band] * (1.0 - fu) + light[top + last, left + last, band] * fu
    return high * (1.0 - fv) + low * fv


@part
def _smooth(scene: LitScene, sight: Sight, place: tuple[int, int], own: Scratch, part: tuple[int, int, int]) -> bool:
    """Shade the corners of a part; whether its light may be interpolated, as a test in its middle shows."""
    top, left, side = part
    last = side - 1
    for i in (top, top + last):
        for j in (left, left + last):
            _shade(scene, sight, place, own, i, j)
    if side == _FINE and _flat(scene.solids, own.what[top, left]):
        return True
    i, j = top + side // 2, left + side // 2
    _shade(scene, sight, place, own, i, j)
    for band in range(PARTS):
        value = own.light[i, j, band]
        if abs(_blended(own, top, left, side, i, j, band) - value) > _TOLERANCE * value + _FAINTS * scene.faint:
            return False
    return True


@part
def _fill(own: Scratch, top: int, left: int, side: int) -> None:
    """Interpolate the light of all samples of a part between its corners."""
    last = side - 1
    for band in range(PARTS):
        a, b = own.light[top, left, band], own.light[top, left + last, band]
        c, d = own.light[top + last, left, band], own.light[top + last, left + last, band]
        for i in range(side):
            fv = i / last
            value, end = a * (1.0 - fv) + c * fv, b * (1.0 - fv) + d * fv
            step = (end - value) / last
            for j in range(side):
                own.light[top + i, left + j, band] = value + step * j


@part
def _flat(solids: Solids, what: int) -> bool:
    """Whether a hit is on a plane face, or is none."""
    return what < 0 or solids.kind[what >> 2] == BOX or solids.kind[what >> 2] == RING


@part
def _shiny(scene: LitScene, what: int) -> bool:
    """Whether a hit is on a surface with a narrow glossy lobe."""
    k = scene.solids.surface[what >> 2]
    return scene.surfaces.gloss[k] > 0.0 and scene.surfaces.shininess[k] > _SHARP


@part
def _shade_edge(scene: LitScene, sight: Sight, place: tuple[int, int], own: Scratch, top: int, left: int) -> None:
    """Shade a small part with several faces: each sample on its own, on plane faces only the first one."""
    for i in range(top, top + _FINE):
        for j in range(left, left + _FINE):
            what, found = own.what[i, j], -1
            if _flat(scene.solids, what):
                for k in range((i - top) * _FINE + j - left):
                    if own.what[top + k // _FINE, left + k % _FINE] == what:
                        found = k
                        break
            if found < 0:
                _shade(scene, sight, place, own, i, j)
                continue
            for band in range(PARTS):
                own.light[i, j, band] = own.light[top + found // _FINE, left + found % _FINE, band]


@part
def _near_lamp(scene: LitScene, own: Scratch, top: int, left: int, side: int) -> bool:
    """Whether a lamp is so near that interpolation could miss its peak: within twice the diagonal of a part."""
    last = side - 1
    a, b = own.far[top, left], own.far[top + last, left + last]
    across2 = 0.0
    for axis in range(3):
        across2 += (own.rays[top, left, axis] * a - own.rays[top + last, left + last, axis] * b) ** 2
    i, j = top + side // 2, left + side // 2
    t, p = own.far[i, j], scene.lights.p_cam
    for lamp in range(len(p)):
        apart2 = 0.0
        for axis in range(3):
            apart2 += (own.rays[i, j, axis] * t - p[lamp, axis]) ** 2
        if apart2 < 4.0 * across2:
            return True
    return False


@part
def _shade_block(scene: LitScene, sight: Sight, place: tuple[int, int], own: Scratch) -> None:
    """Shade a block: interpolate in parts where the light changes evenly, divide other parts into four."""
    own.stack[0, 0], own.stack[0, 1], own.stack[0, 2] = 0, 0, BLOCK
    waiting = 1
    while waiting > 0:
        waiting -= 1
        top, left, side = own.stack[waiting, 0], own.stack[waiting, 1], own.stack[waiting, 2]
        even = _uniform(own, top, left, side)
        if side == _FINE and not even:
            _shade_edge(scene, sight, place, own, top, left)
            continue
        if side == 2:
            for i in range(top, top + side):
                for j in range(left, left + side):
                    _shade(scene, sight, place, own, i, j)
            continue
        what = own.what[top, left]
        if even and what >= 0:
            peaked = side > _FINE and _shiny(scene, what) and not _flat(scene.solids, what)
            even = not (peaked or _near_lamp(scene, own, top, left, side))
        if even and _smooth(scene, sight, place, own, (top, left, side)):
            _fill(own, top, left, side)
            continue
        half = side // 2
        for a in range(2):
            for b in range(2):
                own.stack[waiting, 0], own.stack[waiting, 1] = top + a * half, left + b * half
                own.stack[waiting, 2] = half
                waiting += 1


@part
def _expose(scene: LitScene, sight: Sight, place: tuple[int, int], own: Scratch, picture: Picture) -> None:
    """Convert the light of a block to electrons, and write them and the ranges into the picture."""
    surfaces, gain, cells = scene.surfaces, sight.gain, picture.cells
    side = len(picture.electrons) // len(cells)
    share = 1.0 / (side * side)
    for i in range(BLOCK):
        row, cell_row = place[0] + i, (place[0] + i) // side
        for j in range(BLOCK):
            what, t, scale = own.what[i, j], own.far[i, j], own.etendue[i, j]
            column = place[1] + j
            picture.range_m[row, column] = t
            light = own.light[i, j]
            for channel in range(len(gain)):
                seen = gain[channel, 0] * light[WATER] + gain[channel, 1] * light[WATER + 1]
                picture.electrons[row, column, channel] = (seen + gain[channel, 2] * light[WATER + 2]) * scale
            if what < 0:
                continue
            s, cell_column = what >> 2, column // side
            k = scene.solids.surface[s]
            dx, dy, dz = own.rays[i, j]
            other, factor = paint(scene, s, what & 3, dx * t, dy * t, dz * t, sight.step * t)
            own_part, other_part = factor * (1.0 - other), factor * other
            for band in range(BANDS):
                albedo = surfaces.albedo[k, band] * own_part + surfaces.second[k, band] * other_part
                light[GLOSSY + band] += min(albedo, 1.0) * light[DIFFUSE + band]
            for channel in range(len(gain)):
                matter = gain[channel, 0] * light[GLOSSY] + gain[channel, 1] * light[GLOSSY + 1]
                matter = (matter + gain[channel, 2] * light[GLOSSY + 2]) * scale
                picture.electrons[row, column, channel] += matter
                cells[cell_row, cell_column, channel] += matter * share


@entry
def render(scene: LitScene, sight: Sight, own: Scratch, picture: Picture) -> None:
    """Render the picture; fills `scene.blockers` first."""
    list_blockers(scene.solids, scene.lights.p_cam, scene.blockers)
    for row in range(len(picture.electrons) // BLOCK):
        for column in range(picture.electrons.shape[1] // BLOCK):
            place = (row * BLOCK, column * BLOCK)
            _aim(sight, row, column, own)
            _cast(scene.solids, sight.spread, own)
            _shade_block(scene, sight, place, own)
            _expose(scene, sight, place, own, picture)


@entry
def seen_from_origin(solids: Solids, p_cam: Array, clear_m: Array, seen: Indices) -> None:
    """Set `seen` (N,) to 1 where no solid lies between the camera and a point `clear_m` (N,) before `p_cam` (N, 3)."""
    everything = np.arange(-1, len(solids.kind))
    everything[0] = len(solids.kind)
    for k in range(len(p_cam)):
        x, y, z = p_cam[k]
        far = math.sqrt(x * x + y * y + z * z)
        seen[k] = 0 if between(solids, everything, 0.0, 0.0, 0.0, x / far, y / far, z / far, far - clear_m[k]) else 1


@entry
def first_hits(solids: Solids, rays: Array, range_m: Array, which: Indices) -> None:
    """Range m and solid (-1 for none) of the first hit of each of `rays` (N, 3) from the camera, by brute force."""
    for k in range(len(rays)):
        range_m[k], which[k] = FAR_M, -1
        for s in range(len(solids.kind)):
            t, _ = hit(solids, s, 0.0, 0.0, 0.0, rays[k, 0], rays[k, 1], rays[k, 2])
            if 0.0 < t < range_m[k]:
                range_m[k], which[k] = t, s


@entry
def lobes(shininess: Array, cosine: Array, out: Array) -> None:
    """Values `out` (N,) 1/sr of the glossy lobe for exponents (N,) and cosines (N,)."""
    for k in range(len(out)):
        out[k] = lobe(shininess[k], cosine[k])


def no_blockers(lamps: int, solids: int) -> NDArray[np.int16]:
    """Buffer for the lists of solids in each direction from each lamp."""
    return np.zeros((lamps, CELLS, solids + 1), np.int16)


def scratch(solids: int) -> Scratch:
    """Buffers for one block in a scene of so many solids."""
    return Scratch(
        rays=np.zeros((BLOCK, BLOCK, 3)),
        etendue=np.zeros((BLOCK, BLOCK)),
        what=np.zeros((BLOCK, BLOCK), np.int64),
        far=np.zeros((BLOCK, BLOCK)),
        light=np.zeros((BLOCK, BLOCK, PARTS)),
        all=np.concatenate([[solids], np.arange(solids)]),
        some=np.zeros(solids + 1, np.int64),
        few=np.zeros(solids + 1, np.int64),
        stack=np.zeros((64, 3), np.int64),
    )
