"""A fix as the page shows it."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from asking import at, detected

from lumidock.app.console.frame_view import frame_view, trust
from lumidock.app.reasons import REASONS, explain
from lumidock.datatypes import Alternative, Fix, Guide, Protection


def test_every_reason_of_the_documentation_is_explained_alike():
    text = (Path(__file__).parents[1] / "docs" / "reasons.md").read_text(encoding="utf-8")
    rows = {
        row[0].strip("` "): row[1:3]
        for line in text.splitlines()
        if (row := line.strip("| ").split(" | ")) and row[0].startswith("`")
    }
    assert {word: [reason.meaning, reason.remedy] for word, reason in REASONS.items()} == rows


def test_trust_has_three_colours_with_a_sentence():
    guide = Guide(0.0, 0.0, 9.0, 0.01, 0.2)
    fixes = {
        "valid": Fix("a", 5, "tracking", "front", T_dock_cam=at()),
        "guide": Fix("a", 5, "tracking", "front", reason="protection", guide=guide),
        "none": Fix("a", 5, "none", "search", reason="no_lights"),
    }
    for word, fix in fixes.items():
        assert trust(fix) == word
        assert explain(fix).meaning.endswith(".")
    assert explain(fixes["guide"]).meaning.startswith("Bearing and range may be used")


def test_levels_stand_beside_the_limits_of_the_dock(scene):
    fix = Fix("a", 5, "tracking", "front", T_dock_cam=at(), protection=Protection(0.1, 0.2, 0.01))
    levels = {row["name"]: row for row in frame_view(fix, scene, 1500)["levels"]}
    lateral_m, axial_m, angle_rad = scene.station.alert_limits.of_pose(4.0, 0.2)
    assert [levels[name]["limit"] for name in ("lateral", "axial")] == [lateral_m, axial_m]
    assert levels["angle"]["limit"] == pytest.approx(np.rad2deg(angle_rad), abs=1e-4)
    assert frame_view(fix, scene, 1500)["latency_ms"] == 1.5


def test_a_rejected_detection_says_why(scene):
    fix = Fix("a", 5, "tracking", "front", T_dock_cam=at(), match=detected([[50, 60], [10, 10]], [0, -1], 0.9))
    found = frame_view(fix, scene, None)["detections"]
    assert (found[0]["light"], found[0]["why"]) == ("A", "")
    assert re.fullmatch(r"Where no light is predicted: [\d.]+ px from [A-E], .+\.", found[1]["why"])
    unlike = Fix("a", 5, "none", "front", reason="too_few", match=detected([[10, 10]], [-1], 0.02))
    assert "probability that it is one is 2.0 %" in frame_view(unlike, scene, None)["detections"][0]["why"]
    alone = Fix("a", 5, "none", "front", reason="too_few", match=detected([[10, 10]], [-1]))
    assert "too_few" in frame_view(alone, scene, None)["detections"][0]["why"]


def test_alternatives_are_predicted_and_never_a_pose(scene):
    fix = Fix(
        "a", 5, "none", "front", reason="ambiguous", alternatives=(Alternative(0.6, at()), Alternative(0.4, at(5.0)))
    )
    view = frame_view(fix, scene, None)
    assert (view["trust"], view["pose"]) == ("none", None)
    assert [one["position"][2] for one in view["alternatives"]] == [4.0, 5.0]
    assert len(view["predicted"]) == len(scene.station)


def test_a_view_is_json_whatever_is_not_finite(scene):
    fix = Fix("a", 2**62, "tracking", "front", T_dock_cam=at(-1e-9), match=detected([[1, 2]], [-1], np.nan))
    assert json.loads(json.dumps(frame_view(fix, scene, None), allow_nan=False))["t_ns"] == str(2**62)
