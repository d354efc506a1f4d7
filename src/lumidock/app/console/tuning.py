"""The settings that users touch, with their meaning, and profiles: files of settings where the user says."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel

from lumidock.app.settings_text import field_comments
from lumidock.config import Config
from lumidock.errors import InputError
from lumidock.yamlfile import read_mapping, validate

_PROFILE_SUFFIXES = (".yaml", ".yml")


@dataclass(frozen=True, slots=True)
class Setting:
    """A setting by its path in the configuration: in words, the unit, and what a larger value does."""

    path: str
    title: str
    unit: str
    effect: str


SETTINGS = (
    Setting("prior.roll_deg", "Roll expected, 1 sigma", "deg", "Larger: a vehicle that rolls more is still found."),
    Setting("prior.pitch_deg", "Pitch expected, 1 sigma", "deg", "Larger: approaches from above or below are found."),
    Setting("prior.yaw_deg", "Yaw expected, 1 sigma", "deg", "Larger: approaches from the side are found."),
    Setting("match.noise_px", "Noise of a centroid, 1 sigma", "px", "Larger: worse detections fit; slower to decide."),
    Setting("match.detect", "Chance that a light is detected", "", "Smaller: fouled or dark lamps count less against."),
    Setting("match.spurious", "False detections in a frame", "", "Larger: more clutter is borne; slower to decide."),
    Setting("match.clutter_near", "Share of clutter near the lights", "", "Larger: glints on the dock are expected."),
    Setting(
        "track.accel_m_s2", "Acceleration of the vehicle", "m/s2", "Larger: quick moves are followed; wider levels."
    ),
    Setting("track.accel_rad_s2", "Angular acceleration", "rad/s2", "Larger: quick turns are followed; wider levels."),
    Setting("integrity.risk", "Risk of a level in a frame", "", "Larger: narrower levels that fail more often."),
    Setting(
        "integrity.max_age_s", "Longest prediction without a light", "s", "Larger: longer fixes without any light."
    ),
    Setting("integrity.fault", "Chance that a light is wrong", "", "Larger: wider levels until geometry proves it."),
    Setting("detect.min_snr", "Least contrast of a light", "sigma", "Smaller: fainter lights, and more clutter."),
    Setting("detect.min_p_light", "Least probability of a lamp", "", "Larger: fewer detections that are no light."),
)


def settings_view(config: Config) -> list[dict[str, Any]]:
    """The settings for the page: value, default, unit, effect, and the comment in the source."""
    return [
        {
            "path": one.path,
            "title": one.title,
            "unit": one.unit,
            "effect": one.effect,
            "source": _comment(one.path),
            "value": _value(config, one.path),
            "default": _value(Config(), one.path),
        }
        for one in SETTINGS
    ]


def _value(config: Config, path: str) -> float:
    section, _, name = path.partition(".")
    return float(getattr(getattr(config, section), name))


def _comment(path: str) -> str:
    section, _, name = path.partition(".")
    group: type[BaseModel] = type(getattr(Config(), section))
    return field_comments(group).get(name, "")


def changed(config: Config, values: Any) -> Config:  # noqa: ANN401  # what a request holds
    """The configuration with other values of the settings above. Raises: InputError, one line, for any it refuses."""
    if not isinstance(values, dict):
        raise InputError("settings: wanted names and numbers")
    known, content = {one.path for one in SETTINGS}, config.model_dump(mode="json")
    for path, value in values.items():
        if path not in known:
            raise InputError(f"settings: {path!s} is none that the console changes")
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise InputError(f"settings: {path}: wanted a number")
        section, _, name = path.partition(".")
        content[section][name] = value
    return validate(Config, content, "settings")


def differences(settings: BaseModel, defaults: BaseModel) -> dict[str, Any]:
    """What differs from the defaults, nested as in a configuration file."""
    found: dict[str, Any] = {}
    for name in type(settings).model_fields:
        value, default = getattr(settings, name), getattr(defaults, name)
        if isinstance(value, BaseModel) and isinstance(default, BaseModel):
            inner = differences(value, default)
            found |= {name: inner} if inner else {}
        elif value != default:
            found[name] = settings.model_dump(mode="json")[name]
    return found


def profile_text(config: Config, about: str) -> str:
    """A configuration file of what differs from the defaults, under `about` as a comment of one line."""
    content = differences(config, Config())
    body = yaml.safe_dump(content, sort_keys=False) if content else "{}\n"
    return f"# lumidock profile: {' '.join(about.split())}\n{body}"


def save_profile(text: str, path: Path, *, replace: bool) -> None:
    """Write a profile where the user says. Raises: InputError for another kind of file, or one that exists."""
    require_target(path, _PROFILE_SUFFIXES, replace=replace)
    path.write_text(text, encoding="utf-8")


def require_target(path: Path, suffixes: tuple[str, ...], *, replace: bool) -> None:
    """Raises: InputError for a file that must not be written: another kind, no folder, or one that exists."""
    if path.suffix not in suffixes:
        raise InputError(f"{path}: wanted a file that ends in {' or '.join(suffixes)}")
    if not path.parent.is_dir():
        raise InputError(f"{path}: no such folder")
    if path.exists() and (not replace or not path.is_file()):
        raise InputError(f"{path}: exists; confirm that it shall be replaced")


def load_profile(path: Path) -> Config:
    """A profile, or any configuration file. Raises: InputError, one line."""
    return validate(Config, read_mapping(path, "configuration"), str(path))
