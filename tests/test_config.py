"""Settings: defaults load, what is unknown or absurd is refused in one line."""

import pytest
from pydantic import ValidationError

from lumidock.config import Config, load_config
from lumidock.errors import InputError


def write(tmp_path, text):
    path = tmp_path / "config.yaml"
    path.write_text(text)
    return path


def test_what_a_file_does_not_name_keeps_its_default(tmp_path):
    config = load_config(write(tmp_path, "paper: {pso: {particles: 20}}"))
    assert config.paper.pso.particles == 20
    assert config.paper.pso.iterations == Config().paper.pso.iterations
    assert config.paper.btekf == Config().paper.btekf


@pytest.mark.parametrize(
    "text",
    [
        "papers: {}",
        "paper: {pso: {particle: 20}}",
        "paper: {pso: {particles: 1000000000}}",
        "paper: {pso: {seed: -1}}",
        "paper: {pso: {scale: [8, 0.5]}}",
        "paper: {btekf: {gate: .nan}}",
        "paper: {extract: {gray: blue}}",
        "match: {noise_px: 1.0e+300}",
        "match: {far_m: 1.0e-300}",
        "track: {start_m_s: 1.0e+300}",
    ],
)
def test_refusals_are_one_line_that_names_the_file(tmp_path, text):
    with pytest.raises(InputError, match=r"config\.yaml") as caught:
        load_config(write(tmp_path, text))
    assert "\n" not in str(caught.value)


def test_settings_are_frozen():
    with pytest.raises(ValidationError):
        Config().paper.pso.particles = 3
