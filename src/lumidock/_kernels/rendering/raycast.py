"""Intersects rays with boxes, frusta, rings and ellipsoids: first hit, surface normal, and occlusion.

Each solid has its own frame `local`. Directions are unit vectors, so that the parameter of a ray is a length in m.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lumidock._kernels.compiling import part
from lumidock.datatypes import Array, Indices

BOX, FRUSTUM, RING, ELLIPSOID = range(4)
FAR_M = 100.0  # range of rays that hit nothing
_CLEAR_M = 1e-4  # hits closer than this are ignored, so that a ray does not hit the surface it starts on
_PARALLEL = 1e-12


class Solids(NamedTuple):
    """S solids in one frame, here called `world`.

    Rotation `R_world_local` (S, 3, 3), `center` (S, 3) m, radius of a bounding sphere `bound_m` (S,), and the index of
    their surface in `shading.Surfaces`, `surface` (S,). The meaning of `size` (S, 4) m depends on `kind` (S,). Box:
    three half lengths. Frustum: radius in the middle, half length along local z, change of radius per length. Ring:
    inner and outer radius, with the normal along local z. Ellipsoid: three semi-axes.
    """

    kind: Indices
    R_world_local: Array
    center: Array
    size: Array
    bound_m: Array
    surface: Indices


@part
def _slabs(ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, size: Array) -> tuple[float, int]:
    enter, leave, face, exit_face = -1e30, 1e30, 0, 0
    for axis in range(3):
        o = ox if axis == 0 else (oy if axis == 1 else oz)
        d = dx if axis == 0 else (dy if axis == 1 else dz)
        if abs(d) < _PARALLEL:
            if abs(o) > size[axis]:
                return -1.0, 0
            continue
        near, far = (-size[axis] - o) / d, (size[axis] - o) / d
        if near > far:
            near, far = far, near
        if near > enter:
            enter, face = near, axis
        if far < leave:
            leave, exit_face = far, axis
    if enter > leave or leave < _CLEAR_M:
        return -1.0, 0
    return (enter, face) if enter > _CLEAR_M else (leave, exit_face)


@part
def _frustum(ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, size: Array) -> float:
    slope = size[2]
    radius, change = size[0] + slope * oz, slope * dz
    a = dx * dx + dy * dy - change * change
    b = ox * dx + oy * dy - radius * change
    c = ox * ox + oy * oy - radius * radius
    if abs(a) < _PARALLEL:
        return -1.0
    root = b * b - a * c
    if root < 0.0:
        return -1.0
    root = math.sqrt(root)
    first, second = (-b - root) / a, (-b + root) / a
    if first > second:
        first, second = second, first
    if first > _CLEAR_M and abs(oz + first * dz) <= size[1] and radius + change * first >= 0.0:
        return first
    if second > _CLEAR_M and abs(oz + second * dz) <= size[1] and radius + change * second >= 0.0:
        return second
    return -1.0


@part
def _ring(ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, size: Array) -> float:
    if abs(dz) < _PARALLEL:
        return -1.0
    t = -oz / dz
    x, y = ox + t * dx, oy + t * dy
    r2 = x * x + y * y
    return t if t > _CLEAR_M and size[0] * size[0] <= r2 <= size[1] * size[1] else -1.0


@part
def _ellipsoid(ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, size: Array) -> float:
    ox, oy, oz, dx, dy, dz = ox / size[0], oy / size[1], oz / size[2], dx / size[0], dy / size[1], dz / size[2]
    a, b = dx * dx + dy * dy + dz * dz, ox * dx + oy * dy + oz * dz
    root = b * b - a * (ox * ox + oy * oy + oz * oz - 1.0)
    if root < 0.0:
        return -1.0
    root = math.sqrt(root)
    if -b - root > _CLEAR_M * a:
        return (-b - root) / a
    return (-b + root) / a if -b + root > _CLEAR_M * a else -1.0


@part
def hit(solids: Solids, s: int, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float) -> tuple[float, int]:
    """Length m along a ray to its first hit on solid `s`, negative if none; axis of the face for a box."""
    R, c, size = solids.R_world_local[s], solids.center[s], solids.size[s]
    qx, qy, qz = ox - c[0], oy - c[1], oz - c[2]
    lx = R[0, 0] * qx + R[1, 0] * qy + R[2, 0] * qz
    ly = R[0, 1] * qx + R[1, 1] * qy + R[2, 1] * qz
    lz = R[0, 2] * qx + R[1, 2] * qy + R[2, 2] * qz
    ex = R[0, 0] * dx + R[1, 0] * dy + R[2, 0] * dz
    ey = R[0, 1] * dx + R[1, 1] * dy + R[2, 1] * dz
    ez = R[0, 2] * dx + R[1, 2] * dy + R[2, 2] * dz
    kind = solids.kind[s]
    if kind == BOX:
        return _slabs(lx, ly, lz, ex, ey, ez, size)
    if kind == FRUSTUM:
        return _frustum(lx, ly, lz, ex, ey, ez, size), 0
    if kind == RING:
        return _ring(lx, ly, lz, ex, ey, ez, size), 0
    return _ellipsoid(lx, ly, lz, ex, ey, ez, size), 0


@part
def to_local(solids: Solids, s: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """A point given in `world`, in the frame of solid `s`."""
    R, c = solids.R_world_local[s], solids.center[s]
    qx, qy, qz = x - c[0], y - c[1], z - c[2]
    return (
        R[0, 0] * qx + R[1, 0] * qy + R[2, 0] * qz,
        R[0, 1] * qx + R[1, 1] * qy + R[2, 1] * qz,
        R[0, 2] * qx + R[1, 2] * qy + R[2, 2] * qz,
    )


@part
def normal(solids: Solids, s: int, face: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Unit normal, of either sign, of solid `s` at a point of its surface."""
    R, size = solids.R_world_local[s], solids.size[s]
    lx, ly, lz = to_local(solids, s, x, y, z)
    kind = solids.kind[s]
    if kind == BOX:
        nx, ny, nz = (1.0 if face == 0 else 0.0), (1.0 if face == 1 else 0.0), (1.0 if face == 2 else 0.0)
        if (lx if face == 0 else (ly if face == 1 else lz)) < 0.0:
            nx, ny, nz = -nx, -ny, -nz
    elif kind == FRUSTUM:
        nx, ny, nz = lx, ly, -size[2] * (size[0] + size[2] * lz)
    elif kind == RING:
        nx, ny, nz = 0.0, 0.0, 1.0
    else:
        nx, ny, nz = lx / size[0] ** 2, ly / size[1] ** 2, lz / size[2] ** 2
    scale = 1.0 / math.sqrt(nx * nx + ny * ny + nz * nz)
    return (
        (R[0, 0] * nx + R[0, 1] * ny + R[0, 2] * nz) * scale,
        (R[1, 0] * nx + R[1, 1] * ny + R[1, 2] * nz) * scale,
        (R[2, 0] * nx + R[2, 1] * ny + R[2, 2] * nz) * scale,
    )


@part
def between(
    solids: Solids, some: Indices, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, length: float
) -> bool:
    """Whether any of the solids `some[1:1 + some[0]]` is hit within the first `length` m of a ray."""
    for k in range(some[0]):
        s = some[k + 1]
        c = solids.center[s]
        qx, qy, qz = c[0] - ox, c[1] - oy, c[2] - oz
        along = min(max(qx * dx + qy * dy + qz * dz, 0.0), length)
        qx, qy, qz = qx - along * dx, qy - along * dy, qz - along * dz
        if qx * qx + qy * qy + qz * qz > solids.bound_m[s] ** 2:
            continue
        t, _ = hit(solids, s, ox, oy, oz, dx, dy, dz)
        if 0.0 < t < length:
            return True
    return False


@part
def may_hit(
    solids: Solids, s: int, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, half_angle: float
) -> bool:
    """False if no ray within `half_angle` rad of a direction can hit solid `s`; True may be wrong."""
    bound = solids.bound_m[s]
    cx, cy, cz = solids.center[s, 0] - ox, solids.center[s, 1] - oy, solids.center[s, 2] - oz
    far = math.sqrt(cx * cx + cy * cy + cz * cz)
    if far <= bound:
        return True
    reach = half_angle * (far + bound)
    along = cx * dx + cy * dy + cz * dz
    if along < -bound - reach:
        return False
    apart = math.sqrt(max(far * far - along * along, 0.0))
    if apart > bound + reach:
        return False
    if solids.kind[s] == BOX:
        return _near_box(solids, s, cx, cy, cz, dx, dy, dz, reach)
    if solids.kind[s] != FRUSTUM:
        return True
    return _axis_apart(solids, s, cx, cy, cz, dx, dy, dz) <= _widest(solids.size[s]) + reach


@part
def _near_box(
    solids: Solids, s: int, cx: float, cy: float, cz: float, dx: float, dy: float, dz: float, grown: float
) -> bool:
    """Whether a ray hits a box enlarged by `grown` m on all sides; its center is (cx, cy, cz) from the ray's start."""
    R, size = solids.R_world_local[s], solids.size[s]
    enter, leave = 0.0, 1e30
    for axis in range(3):
        o = -(R[0, axis] * cx + R[1, axis] * cy + R[2, axis] * cz)
        d = R[0, axis] * dx + R[1, axis] * dy + R[2, axis] * dz
        half = size[axis] + grown
        if abs(d) < _PARALLEL:
            if abs(o) > half:
                return False
            continue
        near, far = (-half - o) / d, (half - o) / d
        enter, leave = max(enter, min(near, far)), min(leave, max(near, far))
    return enter <= leave


@part
def _widest(size: Array) -> float:
    return size[0] + abs(size[2]) * size[1]


@part
def _axis_apart(solids: Solids, s: int, cx: float, cy: float, cz: float, dx: float, dy: float, dz: float) -> float:
    """Distance m between a ray and the axis of a frustum, whose center is (cx, cy, cz) from the ray's start."""
    R, half = solids.R_world_local[s], solids.size[s, 1]
    ax, ay, az = R[0, 2], R[1, 2], R[2, 2]
    slant, ca, cd = ax * dx + ay * dy + az * dz, cx * ax + cy * ay + cz * az, cx * dx + cy * dy + cz * dz
    across = 1.0 - slant * slant
    along = 0.0 if across < 1e-9 else (slant * cd - ca) / across
    along = min(max(along, -half), half)
    t = cd + along * slant
    if t < 0.0:
        t, along = 0.0, min(max(-ca, -half), half)
    x, y, z = cx + along * ax - t * dx, cy + along * ay - t * dy, cz + along * az - t * dz
    return math.sqrt(x * x + y * y + z * z)


SIDE = 16  # cells along each edge of the cube of directions around a light
CELLS = 6 * SIDE * SIDE
CELL_RAD = 0.5 * math.sqrt(2.0) * 2.0 / SIDE  # half the diagonal of a cell in the middle of a side, the largest


@part
def cell_of(dx: float, dy: float, dz: float) -> int:
    """Index of the cell of a cube around a point through which a direction passes."""
    ax, ay, az = abs(dx), abs(dy), abs(dz)
    if ax >= ay and ax >= az:
        side, a, b = (0 if dx > 0.0 else 1), dy / ax, dz / ax
    elif ay >= az:
        side, a, b = (2 if dy > 0.0 else 3), dx / ay, dz / ay
    else:
        side, a, b = (4 if dz > 0.0 else 5), dx / az, dy / az
    row, column = min(int((a + 1.0) * 0.5 * SIDE), SIDE - 1), min(int((b + 1.0) * 0.5 * SIDE), SIDE - 1)
    return (side * SIDE + row) * SIDE + column


@part
def _middle_of(cell: int) -> tuple[float, float, float]:
    side, row, column = cell // (SIDE * SIDE), cell // SIDE % SIDE, cell % SIDE
    a, b = (row + 0.5) * 2.0 / SIDE - 1.0, (column + 0.5) * 2.0 / SIDE - 1.0
    sign = 1.0 if side % 2 == 0 else -1.0
    scale = 1.0 / math.sqrt(1.0 + a * a + b * b)
    if side < 2:
        return sign * scale, a * scale, b * scale
    if side < 4:
        return a * scale, sign * scale, b * scale
    return a * scale, b * scale, sign * scale


@part
def list_blockers(solids: Solids, p: Array, blockers: NDArray[np.int16]) -> None:
    """List in `blockers` (L, CELLS, S + 1) for each point `p` (L, 3) and each cell of directions the solids in it.

    The number of solids comes first, then their indices.
    Source: E. Haines, D. Greenberg, The light buffer, IEEE CG&A 6(9), 1986.
    """
    for point in range(len(p)):
        for cell in range(CELLS):
            dx, dy, dz = _middle_of(cell)
            count = 0
            for s in range(len(solids.kind)):
                if may_hit(solids, s, p[point, 0], p[point, 1], p[point, 2], dx, dy, dz, CELL_RAD):
                    count += 1
                    blockers[point, cell, count] = s
            blockers[point, cell, 0] = count
