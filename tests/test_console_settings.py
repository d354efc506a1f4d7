"""Settings, alert limits and profiles: tried, saved where the user says, and refused."""

import io
import zipfile

import pytest
import yaml
from asking import BEARER, client, result
from hypothesis import given
from hypothesis import strategies as st

from lumidock.app.console.tuning import SETTINGS, changed, differences, load_profile, profile_text, save_profile
from lumidock.config import Config
from lumidock.errors import InputError
from lumidock.station import load_station


@given(st.dictionaries(st.sampled_from([one.path for one in SETTINGS]), st.floats(0.051, 0.09)))
def test_a_profile_holds_what_differs_and_nothing_else(values):
    out_of_bounds = ("integrity.risk", "prior.roll_deg", "prior.pitch_deg", "prior.yaw_deg")
    config = changed(Config(), {path: value for path, value in values.items() if path not in out_of_bounds})
    text = profile_text(config, "dock x\nvehicle y")
    assert text.startswith("# lumidock profile: dock x vehicle y\n")
    assert yaml.safe_load(text) == differences(config, Config())


def test_a_profile_is_saved_where_the_user_says_and_nowhere_else(live, tmp_path):
    page, path = client(live), tmp_path / "dock.yaml"
    asked = {"path": str(path), "settings": {"match.spurious": 9}, "vehicle": "BlueROV2"}
    assert page.post("/api/profile/save", json=asked, headers=BEARER).json() == {"saved": str(path)}
    assert load_profile(path).match.spurious == 9.0
    assert "BlueROV2" in path.read_text()
    assert "exists" in page.post("/api/profile/save", json=asked, headers=BEARER).json()["error"]
    assert page.post("/api/profile/save", json=asked | {"replace": True}, headers=BEARER).status_code == 200
    loaded = page.post("/api/profile/load", json={"path": str(path)}, headers=BEARER).json()
    assert {one["path"]: one["value"] for one in loaded}["match.spurious"] == 9.0


@pytest.mark.parametrize("name", ["dock.txt", "missing/dock.yaml", "", ".bashrc", "a\0.yaml"])
def test_other_files_are_not_written(live, tmp_path, name):
    answer = client(live).post("/api/profile/save", json={"path": name and str(tmp_path / name)}, headers=BEARER)
    assert answer.status_code == 400
    assert list(tmp_path.iterdir()) == []


def test_saving_replaces_files_only(tmp_path):
    (tmp_path / "folder.yaml").mkdir()
    with pytest.raises(InputError, match="exists"):
        save_profile("{}", tmp_path / "folder.yaml", replace=True)


def test_every_setting_is_explained(live):
    for one in client(live).get("/api/settings").json():
        assert one["title"]
        assert one["effect"].endswith(".")
        assert one["value"] == one["default"]


def limits_of(page):
    return page.get("/api/about").json()["limits"]


def test_the_alert_limits_shown_are_those_of_the_station(replay):
    bands = replay.replay.recording.scene.station.alert_limits.bands
    shown = limits_of(client(replay))
    assert [entry["lateral_m"] for entry in shown[:-1]] == [band.lateral_m for band in bands]
    assert list(shown[-1]) == ["guide"]


def test_a_stretch_is_run_with_other_alert_limits_and_packed_with_them(replay):
    page, strict = client(replay), 1e-6
    limits = [entry | {"lateral_m": strict} if "lateral_m" in entry else entry for entry in limits_of(page)]
    number = result(page, page.post("/api/rerun", json={"limits": limits}, headers=BEARER))["variant"]
    before, after = (page.get("/api/recording").json()["variants"][k]["trust"] for k in (0, number))
    assert "v" in before
    assert "v" not in after
    assert replay.replay.recording.scene.station.alert_limits.bands[0].lateral_m > strict
    answer = page.post("/api/bundle", json={"variant": number, "first": 0, "last": 1}, headers=BEARER)
    result(page, answer)
    got = page.get(f"/api/jobs/{answer.json()['number']}/file", headers=BEARER)
    with zipfile.ZipFile(io.BytesIO(got.content)) as archive:
        content = yaml.safe_load(archive.read("sequence/station.yaml"))
    assert content["alert_limits"][0]["lateral_m"] == strict


def test_a_station_with_other_alert_limits_is_saved_where_the_user_says(live, folder, tmp_path):
    page, before = client(live), (folder / "station.yaml").read_bytes()
    limits = limits_of(page)
    limits[0]["axial_m"] = 0.25
    asked = {"path": str(tmp_path / "mine.yaml"), "limits": limits}
    assert page.post("/api/limits/save", json=asked, headers=BEARER).status_code == 200
    was, now = load_station(folder / "station.yaml"), load_station(tmp_path / "mine.yaml")
    assert now.alert_limits.bands[0].axial_m == 0.25
    assert now.alert_limits.bands[1:] == was.alert_limits.bands[1:]
    assert (now.ids, now.p_dock.tolist(), now.axis.tolist()) == (was.ids, was.p_dock.tolist(), was.axis.tolist())
    assert (folder / "station.yaml").read_bytes() == before
    assert "exists" in page.post("/api/limits/save", json=asked, headers=BEARER).json()["error"]


@pytest.mark.parametrize(
    ("limits", "why"),
    [
        ("wide", "wanted a list"),
        ([{"below_z_m": 1.0}], "lateral_m"),
        ([{"below_z_m": 1.0, "lateral_m": -1.0, "axial_m": 1.0, "angle_deg": 5.0}], "greater than 0"),
        (
            [
                {"below_z_m": 1.0, "lateral_m": 1.0, "axial_m": 1.0, "angle_deg": 5.0},
                {"below_z_m": 2.0, "lateral_m": 0.5, "axial_m": 1.0, "angle_deg": 5.0},
            ],
            "tighter",
        ),
    ],
)
def test_alert_limits_that_there_cannot_be_are_refused_in_a_line(live, tmp_path, limits, why):
    answer = client(live).post("/api/preview", json={"limits": limits}, headers=BEARER)
    assert answer.status_code == 400
    assert why in answer.json()["error"]
    assert list(tmp_path.glob("limits-*")) == []
