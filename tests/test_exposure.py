"""The exposure that the lights of a frame ask for, and a simulated camera that follows it."""

import math

import numpy as np
import pytest
from bench.lamp_scenes import small_camera
from hypothesis import given
from hypothesis import strategies as st

from lumidock import exposure
from lumidock.camera import load_camera
from lumidock.datatypes import Frame
from lumidock.exposure import Exposure
from lumidock.localizer import Localizer
from lumidock.sim.draws import Draw
from lumidock.sim.scenario import load_scenario, station_of
from lumidock.sim.schedule import schedule_of
from lumidock.station import load_station

LEAST_MS, MOST_MS = 0.05, 5.0


@given(
    time_ms=st.floats(LEAST_MS, MOST_MS),
    gain_db=st.floats(0.0, 24.0),
    factor=st.floats(0.05, 2.5),
)
def test_time_and_gain_have_the_product_asked_for_at_the_least_gain(time_ms, gain_db, factor):
    after = exposure.recommended(Exposure(time_ms, gain_db), factor, LEAST_MS, MOST_MS)
    wanted = time_ms * 10.0 ** (gain_db / 20.0) * factor
    assert LEAST_MS <= after.time_ms <= MOST_MS
    assert after.time_ms * 10.0 ** (after.gain_db / 20.0) == pytest.approx(max(wanted, LEAST_MS))
    assert after.gain_db == 0.0 or after.time_ms == pytest.approx(MOST_MS)


def test_an_unknown_factor_changes_nothing():
    assert exposure.recommended(Exposure(1.0, 3.0), math.nan, LEAST_MS, MOST_MS) == Exposure(1.0, 3.0)


@given(levels=st.lists(st.floats(0.01, 1.2), max_size=12), glare=st.floats(0.0, 1.0), linear=st.booleans())
def test_brighter_lights_never_ask_for_a_longer_exposure(levels, glare, linear):
    now = exposure.factor(np.array(levels), glare, linear=linear)
    brighter = exposure.factor(1.3 * np.array(levels), min(1.3 * glare, 1.0), linear=linear)
    assert math.isnan(now) or brighter <= now


def docking(tmp_path, exposure_ms, *, follow):
    """Fixes within 3 m of the dock and the exposures ms, of a camera that follows what is recommended or does not."""
    settings = (
        *("path.start_z_m=3.0", "path.end_z_m=0.5", "path.speed_m_s=1.0", "path.frame_interval_s=0.2"),
        f"sensor.exposure_ms={exposure_ms}",
    )
    scenario = load_scenario("approach", settings)
    station, camera = load_station(station_of(scenario)), load_camera(small_camera(tmp_path / "camera.yaml"))
    schedule = schedule_of(scenario, station, camera, 11)
    localizer, now, fixes, times_ms = Localizer(station, camera), Exposure(exposure_ms), [], []
    for k in range(len(schedule)):
        schedule.exposure_s[k] = 1e-3 * now.time_ms
        renderer, conditions = schedule.renderer(k), schedule.conditions(k)
        rng = np.random.Generator(np.random.SFC64([schedule.seed, Draw.SENSOR_NOISE, k]))
        picture = renderer.picture_of(renderer.expect(conditions), rng)
        fixes.append(localizer.process(Frame(f"{k:06d}", int(schedule.course.t_ns[k]), picture)))
        times_ms.append(now.time_ms)
        if follow:
            now = exposure.recommended(now, fixes[-1].exposure_factor, LEAST_MS, 100.0)
    return fixes, np.array(times_ms)


@pytest.mark.parametrize("exposure_ms", [4.0, 100.0])
def test_near_the_dock_an_overexposed_frame_is_valid_or_says_so(tmp_path, exposure_ms):
    fixes, _ = docking(tmp_path, exposure_ms, follow=False)
    assert np.mean([fix.valid or fix.reason == "saturated" for fix in fixes]) >= 0.9
    assert fixes[0].exposure_factor == exposure.SHORTEN


@pytest.mark.parametrize("exposure_ms", [4.0, 100.0])
def test_a_camera_that_follows_the_recommendation_gets_valid_frames(tmp_path, exposure_ms):
    fixes, times_ms = docking(tmp_path, exposure_ms, follow=True)
    settled = fixes[5:]  # 0.4^5 is 0.01; nearer to the dock the lights grow brighter again
    assert np.mean([fix.valid for fix in settled]) >= 0.99
    assert (times_ms[5:] < exposure_ms).all()
