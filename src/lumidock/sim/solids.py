"""Builds the solids of a scenario (docks, walls, ropes, hull, jellyfish) and their records for the ray caster."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from lumidock._kernels.rendering.raycast import BOX, ELLIPSOID, FRUSTUM, RING, Solids
from lumidock._kernels.rendering.shading import PLAIN, SECTORS, STRIPES, TILES, Surfaces
from lumidock.datatypes import Array
from lumidock.geometry import se3_inverse
from lumidock.sim.matter import Basin, Finish, Jellyfish, Matter, Solid
from lumidock.station import Station

_PATTERN = {"plain": PLAIN, "tiles": TILES, "sectors": SECTORS, "stripes": STRIPES}
_CAGE_M = (1.0, 1.0, 5.0)  # half width, half height and depth of the cage of the paper
_BEHIND_M = 0.06  # from the lamps' plane back to the tubes of the cage
_TUBE_M, _LAMP_M, _BRACKET_M = 0.03, 0.02, 0.012  # radii of tubes, lamp housings, brackets
_THICK_M, _LARGE_M = 0.05, 30.0  # half thickness and half extent of walls
_WINDOW_OUT_M = 0.02  # by which the window stands out of the housing


def tube(start: Array, end: Array, radius_m: float, finish: str, end_radius_m: float | None = None) -> Solid:
    """A tube, or with `end_radius_m` a cone, between two points `start`, `end` (3,) in `dock`."""
    radii = (radius_m, radius_m if end_radius_m is None else end_radius_m)
    return Solid(kind="tube", center=_place(start), end=_place(end), radius_m=radii, finish=finish)


def ring(center: Array, inner_m: float, outer_m: float, finish: str, axis: Array | None = None) -> Solid:
    """A flat ring, or a disc if `inner_m` is 0, around a point (3,) in `dock`; its normal is `axis` (3,) or z."""
    across = (0.0, 0.0, 1.0) if axis is None else _place(axis)
    return Solid(kind="ring", center=_place(center), axis=across, radius_m=(inner_m, outer_m), finish=finish)


def box(center: Array, half_m: Array, finish: str) -> Solid:
    """A box with its sides along the dock's axes."""
    return Solid(kind="box", center=_place(center), half_m=_place(half_m), finish=finish)


def _place(p: Iterable[float]) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in p)
    return x, y, z


def lamp_bodies(station: Station) -> list[Solid]:
    """For each lamp a black housing with a metal front, behind the window, so that it does not block sideward light."""
    parts = []
    for p, axis in zip(station.p_dock, station.axis, strict=True):
        parts.append(tube(p - _WINDOW_OUT_M * axis, p - 0.07 * axis, _LAMP_M, "black"))
        parts.append(ring(p - _WINDOW_OUT_M * axis, 0.0, _LAMP_M, "metal", axis))
    return parts


def cage(station: Station) -> list[Solid]:
    """Tubes along the edges of the cage and around it every 1.25 m, and a bracket from each lamp to a tube."""
    w, h, d = _CAGE_M
    front, rear = -_BEHIND_M, -d - _BEHIND_M
    corners = [(-w, -h), (-w, h), (w, h), (w, -h)]
    parts = [tube(np.array([x, y, front]), np.array([x, y, rear]), _TUBE_M, "metal") for x, y in corners]
    for z in np.linspace(front, rear, 5):
        for (x0, y0), (x1, y1) in zip(corners, corners[1:] + corners[:1], strict=True):
            parts.append(tube(np.array([x0, y0, z]), np.array([x1, y1, z]), _TUBE_M, "metal"))
    for p in station.p_dock:
        back = p - [0.0, 0.0, _BEHIND_M]
        side = np.array([np.sign(p[0]) * w, p[1], back[2]])
        level = np.array([p[0], np.sign(p[1]) * h, back[2]])
        nearer = side if w - abs(p[0]) < h - abs(p[1]) else level
        if np.linalg.norm(nearer - back) > 2.0 * _BRACKET_M:
            parts.append(tube(back, nearer, _BRACKET_M, "metal"))
    return [*parts, *lamp_bodies(station)]


def funnel(station: Station) -> list[Solid]:
    """A white cone with dark struts and a rim inside the ring of lamps, a hub with screws, and arms to the lamps."""
    lamps_m = float(np.hypot(station.p_dock[:, 0], station.p_dock[:, 1]).min())
    rim, hub, deep = 0.91 * lamps_m, 0.2 * lamps_m, 0.55 * lamps_m
    front = np.array([0.0, 0.0, -0.03])
    bottom = front - [0.0, 0.0, deep]
    parts = [tube(front, bottom, rim, "funnel", hub)]
    face = front + np.array([0.0, 0.0, 0.012])
    parts.append(ring(face, rim, rim + 0.03, "white"))
    parts.append(tube(face, front - np.array([0.0, 0.0, 0.03]), rim + 0.03, "white"))
    parts.append(tube(face, front, rim, "white"))
    lid = bottom + np.array([0.0, 0.0, 0.05])
    parts += [tube(lid, bottom, hub, "black"), ring(lid, 0.0, hub, "black")]
    for angle in np.arange(12) * np.pi / 6.0 + 0.2:
        screw = lid + 0.85 * hub * np.array([np.cos(angle), np.sin(angle), 0.0])
        parts.append(Solid(kind="ellipsoid", center=_place(screw), half_m=(0.012, 0.012, 0.008), finish="metal"))
    for p in station.p_dock:
        out = p * [1.0, 1.0, 0.0]
        edge = out / np.linalg.norm(out) * (rim + 0.03) + [0.0, 0.0, -0.05]
        parts.append(tube(edge, p - [0.0, 0.0, 0.05], _BRACKET_M, "metal"))
    return [*parts, *lamp_bodies(station)]


def plate(station: Station) -> list[Solid]:
    """A white panel 3 cm behind the lamps with a dark entrance, a frame of tubes, and bolts along its edges."""
    low, high = station.p_dock.min(axis=0), station.p_dock.max(axis=0)
    middle, half = 0.5 * (low + high), 0.5 * (high - low) + [0.15, 0.15, 0.0]
    face = low[2] - 0.03
    parts = [box(np.array([middle[0], middle[1], face - 0.01]), np.array([half[0], half[1], 0.01]), "white")]
    parts.append(ring(np.array([middle[0], middle[1], face + 0.002]), 0.0, 0.3 * half[1], "black"))
    parts.append(ring(np.array([middle[0], middle[1], face + 0.004]), 0.3 * half[1], 0.35 * half[1], "metal"))
    x, y = middle[0] + half[0] * np.array([-1.0, 1.0]), middle[1] + half[1] * np.array([-1.0, 1.0])
    corners = [np.array([a, b, face]) for a, b in ((x[0], y[0]), (x[0], y[1]), (x[1], y[1]), (x[1], y[0]))]
    for start, end in zip(corners, corners[1:] + corners[:1], strict=True):
        parts.append(tube(start, end, 0.02, "metal"))
        for share in (np.arange(6) + 0.5) / 6.0:
            bolt = start + share * (end - start)
            bolt = middle + 0.92 * (bolt - middle) * [1.0, 1.0, 0.0] + [0.0, 0.0, face - middle[2]]
            parts.append(Solid(kind="ellipsoid", center=_place(bolt), half_m=(0.012, 0.012, 0.01), finish="metal"))
    return [*parts, *lamp_bodies(station)]


_DOCKS = {"cage": cage, "funnel": funnel, "plate": plate}


def basin(knobs: Basin) -> list[Solid]:
    """A wall behind the dock, walls left and right, and a floor."""
    parts, large = [], _LARGE_M
    if knobs.back_m:
        parts.append(
            box(np.array([0.0, 0.0, -knobs.back_m - _THICK_M]), np.array([large, large, _THICK_M]), knobs.wall)
        )
    for sign in (-1.0, 1.0) if knobs.side_m else ():
        center = np.array([sign * (knobs.side_m + _THICK_M), 0.0, 0.0])
        parts.append(box(center, np.array([_THICK_M, large, large]), knobs.wall))
    if knobs.floor_m:
        parts.append(
            box(np.array([0.0, -knobs.floor_m - _THICK_M, 0.0]), np.array([large, _THICK_M, large]), knobs.floor)
        )
    return parts


def ropes(station: Station) -> list[Solid]:
    """Two ropes that hold the dock from above, with a thin line between them."""
    half, top = 0.42 * np.ptp(station.p_dock[:, 0]), float(station.p_dock[:, 1].max())
    z = -_BEHIND_M
    sides = [
        tube(np.array([s * half, 0.75 * top, z]), np.array([s * 0.6 * half, top + 8.0, z]), 0.012, "rope")
        for s in (-1.0, 1.0)
    ]
    return [*sides, tube(np.array([0.02, top, z]), np.array([0.0, top + 8.0, z - 0.3]), 0.003, "rope")]


def hull() -> list[Solid]:
    """The nose of the own vehicle: yellow and glossy, in the lower part of the picture."""
    return [
        Solid(kind="ellipsoid", frame="cam", center=(0.0, 0.30, 0.30), half_m=(0.30, 0.14, 0.30), finish="yellow"),
        Solid(
            kind="tube", frame="cam", center=(-0.2, 0.19, 0.30), end=(0.2, 0.19, 0.30), radius_m=(0.01, 0.01),
            finish="metal",
        ),
    ]  # fmt: skip


def jellyfish(knobs: Jellyfish, T_dock_cam: Array, t_s: float, rng: np.random.Generator) -> list[Solid]:
    """Jellyfish that drift across the picture; each keeps its distance to the camera."""
    parts = []
    for _ in range(int(rng.integers(*knobs.count, endpoint=True))):
        r, far, speed = (rng.uniform(*reach) for reach in (knobs.radius_m, knobs.distance_m, knobs.speed_m_s))
        start, heading = rng.uniform(-0.6, 0.6, 2), rng.uniform(0.0, 2.0 * np.pi)
        way = np.array([np.cos(heading), np.sin(heading)]) * speed * t_s / far
        across = (start + way + 0.6) % 1.2 - 0.6
        p_cam = far * np.array([across[0], across[1], 1.0])
        p_dock = T_dock_cam[:3, :3] @ p_cam + T_dock_cam[:3, 3]
        parts.append(Solid(kind="ellipsoid", center=_place(p_dock), half_m=(r, 0.7 * r, r), finish="jelly"))
    return parts


def still_solids(matter: Matter, station: Station) -> list[Solid]:
    """All solids that are at rest in `dock` or in `cam`."""
    parts = list(matter.solids)
    if matter.dock != "none":
        parts += _DOCKS[matter.dock](station)
    if matter.basin is not None:
        parts += basin(matter.basin)
    if matter.ropes:
        parts += ropes(station)
    if matter.hull:
        parts += hull()
    return parts


@dataclass(frozen=True, slots=True, eq=False)
class SolidScene:
    """S solids with their poses `T_dock_local` (S, 4, 4) in `cam` where `in_cam` (S,), else in `dock`.

    `kind`, `size`, `bound_m` and `surface` (S,) are as in `raycast.Solids`; `surface` is an index of `finishes`.
    """

    T_dock_local: Array
    in_cam: np.ndarray
    kind: np.ndarray
    size: Array
    bound_m: Array
    surface: np.ndarray
    finishes: tuple[Finish, ...]

    @classmethod
    def of(cls, parts: list[Solid], matter: Matter) -> SolidScene:
        """The scene made of the solids `parts`; `matter` has their finishes."""
        names = list(dict.fromkeys(part.finish for part in parts))
        T, kind, size, bound = zip(*(_record(part) for part in parts), strict=True)
        return cls(
            T_dock_local=np.array(T),
            in_cam=np.array([part.frame == "cam" for part in parts]),
            kind=np.array(kind, np.int64),
            size=np.array(size),
            bound_m=np.array(bound),
            surface=np.array([names.index(part.finish) for part in parts], np.int64),
            finishes=tuple(matter.finish(name) for name in names),
        )

    def solids(self, T_dock_cam: Array) -> Solids:
        """The solids in `cam`, for the ray caster."""
        T_cam_dock = se3_inverse(T_dock_cam)
        T = np.where(self.in_cam[:, None, None], self.T_dock_local, T_cam_dock @ self.T_dock_local)
        R = np.ascontiguousarray(T[:, :3, :3])
        return Solids(self.kind, R, np.ascontiguousarray(T[:, :3, 3]), self.size, self.bound_m, self.surface)

    def surfaces(self) -> Surfaces:
        """The reflectances of `finishes`, for the kernels."""

        def column(name: str) -> Array:
            return np.array([getattr(finish, name) for finish in self.finishes], float)

        return Surfaces(
            albedo=column("albedo"),
            second=column("second"),
            gloss=column("gloss"),
            shininess=column("shininess"),
            pattern=np.array([_PATTERN[finish.pattern] for finish in self.finishes], np.int64),
            period=column("period"),
            share=column("share"),
            mottle=column("mottle"),
            mottle_m=column("mottle_m"),
        )


def _record(part: Solid) -> tuple[Array, int, Array, float]:
    """Pose `T_dock_local` (4, 4), kind, size (4,) and bounding radius m of one solid."""
    T, size, center = np.eye(4), np.zeros(4), np.array(part.center)
    if part.kind == "tube":
        way = np.array(part.end) - center
        length, (start_m, end_m) = float(np.linalg.norm(way)), part.radius_m
        T[:3, :3], T[:3, 3] = _rotation_to_axis(way), 0.5 * (center + part.end)
        size[:3] = 0.5 * (start_m + end_m), 0.5 * length, (end_m - start_m) / length
        return T, FRUSTUM, size, float(np.hypot(0.5 * length, max(start_m, end_m)))
    T[:3, :3], T[:3, 3] = _rotation_to_axis(np.array(part.axis)), center
    if part.kind == "ring":
        size[:2] = part.radius_m
        return T, RING, size, part.radius_m[1]
    size[:3] = part.half_m
    if part.kind == "box":
        return T, BOX, size, float(np.linalg.norm(size))
    return T, ELLIPSOID, size, float(size.max())


def _rotation_to_axis(axis: Array) -> Array:
    """A rotation R_frame_local (3, 3) that turns the local z axis to `axis` (3,); the identity if that is z."""
    z = axis / np.linalg.norm(axis)
    other = np.eye(3)[int(np.argmin(np.abs(z)))] if abs(z[2]) < 1.0 - 1e-12 else np.array([1.0, 0.0, 0.0])
    x = other - z * (other @ z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)
