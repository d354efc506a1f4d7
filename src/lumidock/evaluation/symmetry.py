"""Under which rotations, shifts and mirror images the lights of a dock nearly fall on lights of the dock again.

Such an array fits its own picture in several ways: no estimator can tell them apart by the lights alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lumidock.datatypes import Indices
from lumidock.station import Station

Kind = Literal["rotation", "shift", "mirror"]
_Complex = NDArray[np.complex128]
_TURNED_RAD = math.radians(5.0)  # a plain fit that is turned by less is a shift
_SHARE = 0.75  # least share of the lights that fall on others: so many are seen when a quarter is hidden
_LEAST_LIGHTS = 4  # that a hypothesis must identify


@dataclass(frozen=True, slots=True, eq=False)
class SelfFit:
    """A transform of the array in the plane of its x and y axes that puts lights onto lights of their layer.

    `lights` of all are matched, with an RMS misfit of `residual_m`. The array is turned by `angle_rad` about its
    centre, after a mirroring of x where the kind is `mirror`, and its centre moved by `shift_m`.
    """

    kind: Kind
    angle_rad: float
    shift_m: float
    lights: int
    residual_m: float


def self_fits(station: Station, within_m: float) -> list[SelfFit]:
    """All transforms but the identity under which most lights lie `within_m` of others, best of each kind first.

    Depth is dropped: seen from the front, a light can only be taken for one of the same layer.
    """
    z = station.p_dock[:, 0] + 1j * station.p_dock[:, 1]
    z = z - z.mean()
    least = max(_LEAST_LIGHTS, math.ceil(_SHARE * len(z)))
    best: dict[tuple[Kind, bytes], SelfFit] = {}
    for mirrored in (False, True):
        for a, b in _bases(station, len(z) - least + 1):
            view = -z.conj() if mirrored else z
            for turn, shift in _candidates(z, view, (a, b), station.layer, within_m):
                found = _fit(z, view, turn * view + shift, station.layer, within_m)
                if found is None or len(found[0]) < least:
                    continue
                seen, taken_for = found
                if not mirrored and (seen == taken_for).all():
                    continue
                one = _refined(z, view, seen, taken_for, mirrored=mirrored)
                key = (one.kind, np.stack([seen, taken_for]).tobytes())
                best[key] = one
    return sorted(best.values(), key=lambda one: (-one.lights, one.residual_m))


def unsafe_roll_rad(fits: list[SelfFit], within_m: float) -> float | None:
    """The roll beyond which a fit `within_m` is nearer to the expected attitude than the truth; None: there is none."""
    angles = [abs(one.angle_rad) for one in fits if one.kind == "rotation" and one.residual_m < within_m]
    return min(angles) / 2.0 if angles else None


def _bases(station: Station, count: int) -> list[tuple[int, int]]:
    """Pairs of lights without a light in common, far apart in the largest layer, of which one at least must fit."""
    layer = np.bincount(station.layer).argmax()
    left = np.flatnonzero(station.layer == layer)
    pairs: list[tuple[int, int]] = []
    while len(left) >= 2 and len(pairs) < count:
        p = station.p_dock[left]
        apart = np.linalg.norm(p[:, None] - p[None], axis=2)
        i, j = np.unravel_index(apart.argmax(), apart.shape)
        pairs.append((int(left[i]), int(left[j])))
        left = np.delete(left, [i, j])
    return pairs


def _candidates(
    z: _Complex, view: _Complex, base: tuple[int, int], layer: Indices, within_m: float
) -> list[tuple[complex, complex]]:
    """Turns and shifts that put two lights of a `view` onto two lights of the array about as far apart."""
    a, b = base
    lights = np.flatnonzero(layer == layer[a])
    vector = view[b] - view[a]
    found = []
    for c in lights:
        for d in lights:
            goal = z[d] - z[c]
            if c == d or abs(abs(goal) - abs(vector)) > 2.0 * within_m:
                continue
            turn = goal / vector * (abs(vector) / abs(goal))
            found.append((complex(turn), complex(0.5 * (z[c] + z[d]) - turn * 0.5 * (view[a] + view[b]))))
    return found


def _fit(
    z: _Complex, view: _Complex, moved: _Complex, layer: Indices, within_m: float
) -> tuple[Indices, Indices] | None:
    """The lights that fall on lights of their layer, and on which; None where two fall on the same."""
    apart = np.where(layer[:, None] == layer[None], np.abs(moved[:, None] - z[None]), np.inf)
    nearest = apart.argmin(axis=1)
    seen = np.flatnonzero(apart[np.arange(len(view)), nearest] < within_m)
    return None if len(set(nearest[seen])) < len(seen) else (seen, nearest[seen])


def _refined(z: _Complex, view: _Complex, seen: Indices, taken_for: Indices, *, mirrored: bool) -> SelfFit:
    """The best rigid transform of the lights `seen` onto those they are taken for."""
    w, goal = view[seen], z[taken_for]
    cross = ((w - w.mean()).conj() * (goal - goal.mean())).sum()
    turn = cross / max(abs(cross), 1e-12)
    shift = goal.mean() - turn * w.mean()
    residual = math.sqrt(float((np.abs(turn * w + shift - goal) ** 2).mean()))
    angle = float(np.angle(turn))
    kind: Kind = "mirror" if mirrored else "rotation" if abs(angle) > _TURNED_RAD else "shift"
    return SelfFit(kind, angle, float(abs(shift)), len(seen), residual)
