"""Alert limits as the page changes them: as a station file has them, and written into a copy of the station in use."""

from __future__ import annotations

import math
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lumidock.alert_limits import AlertLimits
from lumidock.app.console.wizards import Files
from lumidock.config import Config
from lumidock.errors import InputError
from lumidock.setup.station_files import write_station_file
from lumidock.station import load_station
from lumidock.yamlfile import read_mapping


@dataclass(frozen=True, slots=True)
class Choice:
    """What a stretch is run with: settings, and files of which the station may have other alert limits."""

    config: Config
    files: Files


def limits_view(limits: AlertLimits) -> list[dict[str, Any]]:
    """The entries of `alert_limits` in a station file: a band each, and the guide's."""
    guide = limits.guide
    bands = [
        {
            "below_z_m": band.below_z_m,
            "lateral_m": band.lateral_m,
            "axial_m": band.axial_m,
            "angle_deg": round(math.degrees(band.angle_rad), 6),
        }
        for band in limits.bands
    ]
    of_guide = {
        "bearing_deg": round(math.degrees(guide.bearing_rad), 6),
        "range_m": guide.range_m,
        "range_share": guide.range_share,
        "from_m": guide.from_m,
    }
    return [*bands, {"guide": of_guide}]


def files_with(files: Files, limits: Any) -> Files:  # noqa: ANN401  # what a request holds
    """The same files, the station with other alert limits where `limits` are given. Raises: InputError for bad ones."""
    if limits is None:
        return files
    if not isinstance(limits, list):
        raise InputError("alert limits: wanted a list, as alert_limits of a station file is one")
    content = read_mapping(files.station, "station")
    content["alert_limits"] = limits
    with tempfile.NamedTemporaryFile(dir=files.scratch, prefix="limits-", suffix=".yaml", delete=False) as file:
        station = Path(file.name)
    about = f"The station {files.station.name} with other alert limits."
    try:
        write_station_file(content, station, about)
        load_station(station)
    except InputError as error:
        station.unlink()
        raise InputError(str(error).replace(str(station), "alert limits")) from None
    return replace(files, station=station)
