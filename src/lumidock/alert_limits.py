"""Alert limits: how large the error of a pose or of a guide may be before using it would be dangerous.

A pose is valid, and a guide is given, only while its protection levels are inside these limits. A station file may
replace the defaults (`alert_limits`). Source of the defaults: docs/formats.md; `valid` and `guide` are defined on them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from lumidock.datatypes import Array

_FAR_SHARE, _FAR_RAD = 0.10, math.radians(10.0)  # beyond the last band: a share of z, and an angle
_DEFAULT_DOCK_M = 2.0  # extent of the entrance that the default guide limits were chosen for


@dataclass(frozen=True, slots=True)
class Band:
    """Limits that hold below `below_z_m`: of the lateral and the axial error in m, of the total rotation in rad."""

    below_z_m: float
    lateral_m: float
    axial_m: float
    angle_rad: float


@dataclass(frozen=True, slots=True)
class GuideLimits:
    """Limits of bearing and range; the range limit is the larger of `range_m` and `range_share` of the range.

    Nearer to the dock's origin than `from_m` a bearing to the origin does not tell whether the vehicle enters the dock;
    there the limits of the pose decide alone.
    """

    bearing_rad: float = math.radians(1.5)
    range_m: float = 0.3
    range_share: float = 0.10
    from_m: float = 3.0

    def for_dock(self, extent_m: float) -> GuideLimits:
        """The same for an entrance `extent_m` across: below 2 m both lengths shrink in proportion."""
        scale = min(1.0, extent_m / _DEFAULT_DOCK_M)
        return replace(self, range_m=self.range_m * scale, from_m=self.from_m * scale)


_DEFAULT_BANDS = (
    Band(1.5, 0.3, 0.3, math.radians(5.0)),
    Band(5.0, 0.5, 0.5, math.radians(5.0)),
    Band(12.0, 1.0, 1.0, math.radians(8.0)),
)


@dataclass(frozen=True, slots=True)
class AlertLimits:
    """The limits of one dock: `bands` by rising `below_z_m`, whose limits do not fall with z, and those of the guide.

    Beyond the last band the lateral and the axial limit are 10 % of z and the angle limit is 10 degrees, but none is
    tighter than in the last band.
    """

    bands: tuple[Band, ...] = _DEFAULT_BANDS
    guide: GuideLimits = GuideLimits()

    def __post_init__(self) -> None:
        if not self.bands:
            raise ValueError("alert limits need at least one band")
        for near, far in zip(self.bands, self.bands[1:], strict=False):
            if far.below_z_m <= near.below_z_m:
                raise ValueError("below_z_m has to rise from one band to the next")
            if far.lateral_m < near.lateral_m or far.axial_m < near.axial_m or far.angle_rad < near.angle_rad:
                raise ValueError(f"limits below z {far.below_z_m:g} m are tighter than those nearer to the dock")

    def of_pose(self, z_m: float, pl_axial_m: float) -> tuple[float, float, float]:
        """Limits (lateral m, axial m, angle rad) of one pose at the estimated `z_m`: the strictest over z +- level.

        Limits do not fall with z, so the strictest is the one at the near end.
        """
        z = z_m - pl_axial_m
        for band in self.bands:
            if z < band.below_z_m:
                return band.lateral_m, band.axial_m, band.angle_rad
        last, far_m = self.bands[-1], _FAR_SHARE * z
        return max(far_m, last.lateral_m), max(far_m, last.axial_m), max(_FAR_RAD, last.angle_rad)

    def of_poses(self, z_m: Array, pl_axial_m: Array) -> Array:
        """`of_pose` of many: (..., 3) for `z_m` and `pl_axial_m` of shape (...), which broadcast."""
        z, last = np.asarray(z_m) - np.asarray(pl_axial_m), self.bands[-1]
        far_m = _FAR_SHARE * z
        limits = np.stack(
            [
                np.maximum(far_m, last.lateral_m),
                np.maximum(far_m, last.axial_m),
                np.full_like(far_m, max(_FAR_RAD, last.angle_rad)),
            ],
            axis=-1,
        )
        for band in reversed(self.bands):
            limits = np.where((z < band.below_z_m)[..., None], [band.lateral_m, band.axial_m, band.angle_rad], limits)
        return limits

    def as_text(self) -> str:
        """The limits in one line, for people."""
        last, guide = self.bands[-1], self.guide
        parts = [
            f"z < {band.below_z_m:g} m: lateral {band.lateral_m:g} m, axial {band.axial_m:g} m, "
            f"{math.degrees(band.angle_rad):.3g} deg"
            for band in self.bands
        ]
        far_deg = math.degrees(max(_FAR_RAD, last.angle_rad))
        parts.append(f"beyond: {_FAR_SHARE:.0%} of z but not less than before, {far_deg:.3g} deg")
        near = f"guide from {guide.from_m:.3g} m on: bearing {math.degrees(guide.bearing_rad):.3g} deg"
        parts.append(f"{near}, range {guide.range_share:.0%} but not less than {guide.range_m:.3g} m")
        return "; ".join(parts)

    def applies_to_guide(self, bearing_x_rad: float, near_end_m: float) -> bool:
        """Whether a guide has limits of its own: the dock lies ahead, and even the near end of its range is far."""
        return abs(bearing_x_rad) <= math.pi / 2.0 and near_end_m >= self.guide.from_m

    def of_guide(self, near_end_m: float) -> tuple[float, float]:
        """Limits (bearing rad, range m) of a guide whose range may be as short as `near_end_m`."""
        return self.guide.bearing_rad, max(self.guide.range_m, self.guide.range_share * near_end_m)

    def of_guides(self, guide: Array) -> Array:
        """Limits (M, 2), bearing rad and range m, of guides (M, 3), both bearings rad and range m.

        Infinite nearer than `from_m`, and with the dock's origin behind the camera, where the pose decides.
        """
        range_m, ahead = guide[:, 2], (np.abs(guide[:, :2]) < np.pi / 2).all(axis=1)
        bearing = np.full_like(range_m, self.guide.bearing_rad)
        limits = np.stack([bearing, np.maximum(self.guide.range_m, self.guide.range_share * range_m)], axis=1)
        return np.where((ahead & (range_m > self.guide.from_m))[:, None], limits, np.inf)


DEFAULT_ALERT_LIMITS = AlertLimits()
