"""Settings as commented YAML: they are the same settings again, and every comment of the source is there."""

import inspect
import re

import yaml

from lumidock.app.settings_text import as_yaml, field_comments
from lumidock.config import Config, IntegrityConfig, MatchConfig, SettingsGroup, TrackConfig
from lumidock.sim.scenario import Scenario


class Example(SettingsGroup):
    """Three settings."""

    plain: int = 3
    # first line
    # and second line of what it means
    above: float = 0.5
    beside: tuple[float, float] = (
        1.0,
        2.0,
    )  # px


def test_comments_stand_beside_or_above_their_field():
    assert field_comments(Example) == {
        "plain": "",
        "above": "first line and second line of what it means",
        "beside": "px",
    }
    assert as_yaml(Example(plain=4)).splitlines() == [
        "plain: 4",
        "above: 0.5  # first line and second line of what it means",
        "beside: [1.0, 2.0]  # px",
    ]


def test_the_text_gives_the_same_settings_again():
    for settings in (Config(), Config.model_validate({"match": {"noise_px": 0.7}}), Scenario()):
        assert yaml.safe_load(as_yaml(settings)) == yaml.safe_load(yaml.safe_dump(settings.model_dump(mode="json")))


def test_every_setting_of_the_default_method_says_what_it_is():
    for model in (MatchConfig, TrackConfig, IntegrityConfig):
        text = as_yaml(model())
        assert len(re.findall("#", text)) >= len(model.model_fields) - 2, model
        for comment in field_comments(model).values():
            assert comment in inspect.getsource(model).replace("\n    # ", " ")
            assert comment in text
