"""Station files with new positions: everything else in the file stays as its author wrote it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from lumidock.datatypes import Array
from lumidock.station import Station
from lumidock.yamlfile import read_mapping

_DECIMALS_M = 4  # a tenth of a millimetre


def write_surveyed(source: Path, target: Path, after: Station, sigma_m: Array, *, name: str, about: str) -> None:
    """Write the station file `source` with the positions of `after` and `sigma_m` (M, 3), rounded up to 0.1 mm.

    `about` becomes a comment at the top, a line for each of its own. The sigmas hold for each light by itself, so the
    error common to a layer is set to zero, and the focal length's sigma carries that of the dock's size.
    Raises: InputError for a file that cannot be read.
    """
    content: dict[str, Any] = read_mapping(source, "station")
    content["name"] = name
    content["survey_sigma"] = {"light_m": _up(float((sigma_m**2).mean() ** 0.5)), "layer_m": 0.0}
    content["calibration_sigma"] = {
        "focal": round(after.sigma_focal, 5),
        "center_px": round(after.sigma_center_px, 3),
    }
    place = {light_id: i for i, light_id in enumerate(after.ids)}
    for light in content["lights"]:
        i = place[light["id"]]
        light["position"] = [round(float(x), _DECIMALS_M) for x in after.p_dock[i]]
        light["sigma_m"] = [_up(float(x)) for x in sigma_m[i]]
    write_station_file(content, target, about)


def write_station_file(content: dict[str, Any], target: Path, about: str) -> None:
    """Write a station file's `content`, one line a light, under `about` as a comment."""
    lights = content.pop("lights")
    head = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=118)
    rows = "".join(
        f"  - {yaml.safe_dump(light, sort_keys=False, default_flow_style=True, width=1000)}" for light in lights
    )
    comment = "".join(f"# {line}\n" for line in about.splitlines())
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_text(f"{comment}{head}lights:\n{rows}", encoding="utf-8")


def content_of(station: Station) -> dict[str, Any]:
    """The content of a station file of a station whose lights are all known alike."""
    return {
        "schema": 1,
        "name": station.name,
        "docking_point": station.docking_point.tolist(),
        "survey_sigma": {"light_m": float(np.max(station.sigma_light_m)), "layer_m": station.sigma_layer_m},
        "lights": [
            {
                "id": light_id,
                "layer": station.layers[station.layer[i]],
                "position": [round(float(x), _DECIMALS_M) for x in station.p_dock[i]],
                "color": station.color[i],
                "axis": [round(float(x), 6) for x in station.axis[i]],
                "beam_deg": float(station.beam_deg[i]),
                "power_w": float(station.power_w[i]),
            }
            for i, light_id in enumerate(station.ids)
        ],
    }


def _up(value: float) -> float:
    return float(round(math.ceil(value * 1e4 - 1e-9) / 1e4, _DECIMALS_M))
