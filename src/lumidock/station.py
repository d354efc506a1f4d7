"""A dock as its lights: any number of lights in one or more named layers, read from a station file (schema 1)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from lumidock.datatypes import Array, Indices, require_shape
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
    Sigmas are 1-sigma survey and calibration errors. `dock_exclusive`: no other dock of this layout is ever in view.
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
    sigma_light_m: float
    sigma_layer_m: float
    sigma_focal: float
    sigma_center_px: float
    dock_exclusive: bool = True

    def __post_init__(self) -> None:
        n = len(self.ids)
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


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)


class _SurveySigma(_Strict):
    light_m: Annotated[float, Field(ge=0)] = 0.002
    layer_m: Annotated[float, Field(ge=0)] = 0.005


class _CalibrationSigma(_Strict):
    focal: Annotated[float, Field(ge=0)] = 0.003
    center_px: Annotated[float, Field(ge=0)] = 2.0


class _Light(_Strict):
    id: Name
    layer: Name
    position: Vector
    color: Color = "white"
    axis: Vector = (0.0, 0.0, 1.0)
    beam_deg: Annotated[float, Field(gt=0, le=360)] = 120.0
    power_w: Annotated[float, Field(gt=0)] = 2.0

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
    dock_exclusive: bool = True
    survey_sigma: _SurveySigma = _SurveySigma()
    calibration_sigma: _CalibrationSigma = _CalibrationSigma()
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
            raise ValueError(f"extent of {gaps.max():.3g} m is outside {_MIN_EXTENT_M}-{_MAX_EXTENT_M:.0f} m")
        return self


def load_station(path: Path) -> Station:
    """Read a station file.

    Raises: InputError, one line, for anything the schema refuses.
    """
    content = validate(_StationFile, read_mapping(path), str(path))
    lights = content.lights
    layers = tuple(dict.fromkeys(light.layer for light in lights))
    axis = np.array([light.axis for light in lights])
    return Station(
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
        sigma_light_m=content.survey_sigma.light_m,
        sigma_layer_m=content.survey_sigma.layer_m,
        sigma_focal=content.calibration_sigma.focal,
        sigma_center_px=content.calibration_sigma.center_px,
        dock_exclusive=content.dock_exclusive,
    )
