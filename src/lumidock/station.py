"""A dock as its lights: any number of lights in one or more named layers, read from a station file (schema 1)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator
from typing_extensions import Self

from lumidock.alert_limits import DEFAULT_ALERT_LIMITS, AlertLimits, Band, GuideLimits
from lumidock.datatypes import Array, Indices, require_shape
from lumidock.errors import InputError
from lumidock.yamlfile import read_mapping, validate

Color = Literal["white", "blue", "cyan", "green", "red"]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,32}$")]
Vector = tuple[float, float, float]

_MIN_LIGHTS, _MAX_LIGHTS = 4, 1000
_MIN_EXTENT_M, _MAX_EXTENT_M = 0.05, 100.0
_MIN_SPACING_M = 1e-3  # closer lights are one light written twice


@dataclass(frozen=True, slots=True, eq=False)
class Station:
    """The lights of a dock, N of them, in the `dock` frame.

    `p_dock` (N, 3) m; `layer` (N,) index into `layers`; `axis` (N, 3) unit vectors out of the lamps; `beam_deg` (N,)
    full angle at half intensity; `power_w` (N,) radiant power; `docking_point` (3,) m where the camera must end.
    Sigmas are 1-sigma survey and calibration errors: `sigma_light_m` of each light's position along each axis, one
    number for all lights or one for each (N,), and `sigma_layer_m` of a rigid offset that a layer's lights share.
    `alert_limits` decide when a pose or a guide may be used. `dock_exclusive` says that no other array of lights which
    looks like this dock can come into view.
    """

    name: str
    ids: tuple[str, ...]
    layers: tuple[str, ...]
    layer: Indices
    p_dock: Array
    color: tuple[Color, ...]
    axis: Array
    beam_deg: Array
    power_w: Array
    docking_point: Array
    sigma_light_m: float | Array
    sigma_layer_m: float
    sigma_focal: float
    sigma_center_px: float
    alert_limits: AlertLimits = DEFAULT_ALERT_LIMITS
    dock_exclusive: bool = True

    def __post_init__(self) -> None:
        n = len(self.ids)
        if np.ndim(self.sigma_light_m):
            require_shape("sigma_light_m", np.asarray(self.sigma_light_m), n)
        for name, shape in {
            "p_dock": (n, 3),
            "axis": (n, 3),
            "layer": (n,),
            "beam_deg": (n,),
            "power_w": (n,),
        }.items():
            require_shape(name, getattr(self, name), *shape)

    def __len__(self) -> int:
        return len(self.ids)

    def lights_of(self, layer: str) -> Indices:
        """Indices (K,) of the lights of one layer. Raises: ValueError for a layer the station does not have."""
        return np.flatnonzero(self.layer == self.layers.index(layer)).astype(np.int64)

    def layers_front_to_rear(self) -> tuple[str, ...]:
        """Layer names by falling mean z: the one nearest to the approaching vehicle first."""
        depth = {name: float(self.p_dock[self.lights_of(name), 2].mean()) for name in self.layers}
        return tuple(sorted(self.layers, key=lambda name: -depth[name]))

    def layer_rank(self, light: int) -> int:
        """Which layer a light belongs to, counted from the front one, 0."""
        return self.layers_front_to_rear().index(self.layers[self.layer[light]])

    def front_extent_m(self) -> float:
        """Largest distance between two lights of the front layer, the size of the dock's entrance."""
        p_dock = self.p_dock[self.lights_of(self.layers_front_to_rear()[0])]
        return float(np.linalg.norm(p_dock[:, None] - p_dock[None], axis=2).max())


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)


_Sigma = Annotated[float, Field(ge=0)]
_Limit = Annotated[float, Field(gt=0)]


class _SurveySigma(_Strict):
    light_m: _Sigma = 0.002
    layer_m: _Sigma = 0.005


class _CalibrationSigma(_Strict):
    focal: _Sigma = 0.003
    center_px: _Sigma = 2.0


class _Band(_Strict):
    below_z_m: float
    lateral_m: _Limit
    axial_m: _Limit
    angle_deg: Annotated[float, Field(gt=0, le=180)]


class _GuideLimits(_Strict):
    bearing_deg: Annotated[float, Field(gt=0, le=90)] = 1.5
    range_m: _Limit = 0.3
    range_share: Annotated[float, Field(gt=0, lt=1)] = 0.10
    from_m: _Limit = 3.0


class _GuideEntry(_Strict):
    guide: _GuideLimits


class _Light(_Strict):
    id: Name
    layer: Name
    position: Vector
    color: Color = "white"
    axis: Vector = (0.0, 0.0, 1.0)
    beam_deg: Annotated[float, Field(gt=0, le=360)] = 120.0
    power_w: Annotated[float, Field(gt=0)] = 2.0
    sigma_m: _Sigma | tuple[_Sigma, _Sigma, _Sigma] | None = None

    @model_validator(mode="after")
    def _axis_has_a_direction(self) -> Self:
        if not 1e-6 < math.hypot(*self.axis) < 1e6:
            raise ValueError(f"light {self.id}: axis has no direction")
        return self


class _StationFile(_Strict):
    schema_: Annotated[Literal[1], Field(alias="schema")]
    name: Annotated[str, Field(min_length=1, max_length=64)]
    frame: Literal["dock"] = "dock"
    docking_point: Vector = (0.0, 0.0, 0.0)
    survey_sigma: _SurveySigma = _SurveySigma()
    calibration_sigma: _CalibrationSigma = _CalibrationSigma()
    dock_exclusive: bool = True
    alert_limits: list[_Band | _GuideEntry] = []
    lights: list[_Light]

    @model_validator(mode="after")
    def _lights_make_an_array(self) -> Self:
        if len(self.lights) < _MIN_LIGHTS:
            raise ValueError(f"{len(self.lights)} lights, wanted at least {_MIN_LIGHTS}")
        if len(self.lights) > _MAX_LIGHTS:
            raise ValueError(f"{len(self.lights)} lights, wanted at most {_MAX_LIGHTS}")
        ids = [light.id for light in self.lights]
        for light_id in ids:
            if ids.count(light_id) > 1:
                raise ValueError(f"light id {light_id} given twice")
        p = np.array([light.position for light in self.lights])
        with np.errstate(over="ignore"):  # an infinite gap is refused below
            gaps = np.linalg.norm(p[:, None] - p[None], axis=2)
        for i, j in np.argwhere(np.triu(gaps < _MIN_SPACING_M, k=1))[:1]:
            raise ValueError(f"lights {ids[i]} and {ids[j]} stand at the same position")
        if not _MIN_EXTENT_M <= gaps.max() <= _MAX_EXTENT_M:
            extent = f"extent of {gaps.max():.3g} m is outside {_MIN_EXTENT_M}-{_MAX_EXTENT_M:.0f} m"
            raise ValueError(extent + "; positions are in metres" * bool(gaps.max() > _MAX_EXTENT_M))
        return self


def load_station(path: Path | str) -> Station:
    """Read a station file.

    Raises: InputError, one line, for anything the schema refuses, and for a file of another kind.
    """
    content = validate(_StationFile, read_mapping(Path(path), "station"), str(path))
    lights = content.lights
    layers = tuple(dict.fromkeys(light.layer for light in lights))
    axis = np.array([light.axis for light in lights])
    station = Station(
        name=content.name,
        ids=tuple(light.id for light in lights),
        layers=layers,
        layer=np.array([layers.index(light.layer) for light in lights], np.int64),
        p_dock=np.array([light.position for light in lights]),
        color=tuple(light.color for light in lights),
        axis=axis / np.linalg.norm(axis, axis=1, keepdims=True),
        beam_deg=np.array([light.beam_deg for light in lights]),
        power_w=np.array([light.power_w for light in lights]),
        docking_point=np.array(content.docking_point),
        sigma_light_m=_light_sigmas(content),
        sigma_layer_m=content.survey_sigma.layer_m,
        sigma_focal=content.calibration_sigma.focal,
        sigma_center_px=content.calibration_sigma.center_px,
        dock_exclusive=content.dock_exclusive,
    )
    try:
        return replace(station, alert_limits=_alert_limits(content, station.front_extent_m()))
    except ValueError as error:
        raise InputError(f"{path}: alert_limits: {error}") from None


def _light_sigmas(content: _StationFile) -> float | Array:
    """One sigma for all lights, or one for each (N,) where any light has its own.

    Of three numbers the largest holds for all axes: the estimator's survey states are the same along each of them.
    """
    common = content.survey_sigma.light_m
    if all(light.sigma_m is None for light in content.lights):
        return common
    return np.array([common if light.sigma_m is None else np.max(light.sigma_m) for light in content.lights])


def _alert_limits(content: _StationFile, extent_m: float) -> AlertLimits:
    """The file's limits, and the defaults of a dock so large for what it does not give. Raises: ValueError."""
    bands = tuple(
        Band(entry.below_z_m, entry.lateral_m, entry.axial_m, math.radians(entry.angle_deg))
        for entry in content.alert_limits
        if isinstance(entry, _Band)
    )
    guides = [entry.guide for entry in content.alert_limits if isinstance(entry, _GuideEntry)]
    if len(guides) > 1:
        raise ValueError("guide is given twice")
    guide = GuideLimits().for_dock(extent_m)
    if guides:
        given = guides[0]
        guide = GuideLimits(math.radians(given.bearing_deg), given.range_m, given.range_share, given.from_m)
    return AlertLimits(bands or DEFAULT_ALERT_LIMITS.bands, guide)
