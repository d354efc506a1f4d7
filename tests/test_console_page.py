"""The console in a browser, as a person uses it: every part, at desktop and phone width, light and dark."""

import re
import shutil
import subprocess
from collections import Counter
from contextlib import contextmanager
from pathlib import Path

import pytest
from commandline import start
from test_run import simulate

from lumidock.station import load_station

CHROMIUM = shutil.which("chromium")
playwright = pytest.importorskip("playwright.sync_api")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium; Debian has it as a package")
SIZES = {"desktop": {"width": 1280, "height": 900}, "phone": {"width": 390, "height": 844}}
FASTER = ("path.frame_interval_s=0.1",)
SLOW_MS = 60_000  # a command that loads its kernels on a busy machine

AUDIT = (Path(__file__).parent / "audit.js").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    return simulate(tmp_path_factory.mktemp("sequence"), *FASTER)


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as driver:
        found = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield found
        found.close()


@contextmanager
def running(*words):
    """A command that serves the console, and the address with the token that it prints."""
    process = start(*map(str, words))
    try:
        yield process.stdout.readline().split()[-1]
    finally:
        process.terminate()
        process.communicate(timeout=30)


@pytest.fixture(scope="module")
def replayed(sequence):
    with running("console", sequence, "--port", 0) as address:
        yield address


@pytest.fixture(scope="module")
def served(sequence):
    with running("serve", sequence, "--loop", "--health-port", 0) as address:
        yield address


@pytest.fixture
def visit(browser, request):
    """Open an address as one visitor; at the end, nothing was said on the console and nothing asked from outside."""
    said, contexts = [], []

    def open_page(address, size="desktop", scheme="light"):
        context = browser.new_context(viewport=SIZES[size], color_scheme=scheme)
        contexts.append(context)
        page = context.new_page()
        page.set_default_timeout(SLOW_MS)
        own = re.match(r"http://[^/]+", address)[0]
        page.on("console", lambda message: said.append(f"{message.type}: {message.text}"))
        page.on("pageerror", lambda error: said.append(f"error: {error}"))
        page.on(
            "request", lambda asked: said.append(asked.url) if not asked.url.startswith((own, "blob:" + own)) else None
        )
        page.goto(address)
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert said == [], request.node.name


@pytest.fixture(scope="module")
def axe(tmp_path_factory):
    """The source of axe-core, as npm has it now."""
    folder = tmp_path_factory.mktemp("axe")
    words = ["npm", "install", "--silent", "--no-audit", "--no-fund", "--prefix", str(folder), "axe-core"]
    if shutil.which("npm") is None or subprocess.run(words, capture_output=True, timeout=120, check=False).returncode:
        pytest.skip("npm cannot fetch axe-core")
    return (folder / "node_modules" / "axe-core" / "axe.min.js").read_text(encoding="utf-8")


def faults(page, axe):
    """Serious and critical faults that axe finds in what is shown: the rule and where."""
    page.evaluate(axe)
    found = page.evaluate("axe.run()")["violations"]
    return [(one["id"], one["nodes"][0]["html"]) for one in found if one["impact"] in ("serious", "critical")]


def part(page, name):
    page.get_by_role("tab", name=name, exact=True).click()


LOOKS = [("desktop", "light"), ("desktop", "dark"), ("phone", "light"), ("phone", "dark")]


@pytest.mark.parametrize(("size", "scheme"), LOOKS)
def test_every_part_of_a_recording_can_be_read_everywhere(visit, replayed, size, scheme):
    page = visit(replayed, size, scheme)
    page.get_by_text("16 of 16").or_(page.get_by_text("1 of 16")).wait_for()
    for name in ("Replay", "Settings", "Dock check", "Calibrate", "Survey"):
        part(page, name)
        assert page.evaluate(AUDIT) == [], name


@pytest.mark.parametrize(("size", "scheme"), LOOKS[1:3])
def test_the_live_view_can_be_read_everywhere(visit, served, size, scheme):
    page = visit(served, size, scheme)
    page.locator(".trust strong").wait_for()
    for name in ("Live", "Settings", "Calibrate", "Live"):
        part(page, name)
        assert page.evaluate(AUDIT) == [], name
    assert page.evaluate("matchMedia('(prefers-color-scheme: dark)').matches") == (scheme == "dark")


@pytest.mark.parametrize(("size", "scheme"), LOOKS)
def test_axe_finds_no_serious_fault(visit, replayed, served, axe, size, scheme):
    page = visit(replayed, size, scheme)
    page.get_by_text("16 of 16").or_(page.get_by_text("1 of 16")).wait_for()
    for name in ("Replay", "Settings", "Dock check", "Calibrate", "Survey"):
        part(page, name)
        assert faults(page, axe) == [], name
    page = visit(served, size, scheme)
    page.locator(".trust strong").wait_for()
    for name in ("Live", "Settings", "Calibrate"):
        part(page, name)
        assert faults(page, axe) == [], name


def test_the_live_view_shows_the_picture_and_why(visit, served):
    page = visit(served)
    page.get_by_text("VALID", exact=True).wait_for()
    page.locator(".picture .mark.front").first.wait_for()
    assert page.locator(".level").count() >= 3
    assert page.locator(".lights li.seen").count() >= 4
    assert page.evaluate("document.querySelector('.picture canvas').width") == 320
    page.get_by_role("button", name="Brighten").click()
    page.get_by_role("button", name="Zoom to lights").click()
    page.locator(".picture .mark.front").first.hover(force=True)
    page.get_by_text(re.compile(r"^[A-E]: identified")).wait_for()
    assert page.get_by_role("cell", name="console").is_visible()


def test_what_is_old_is_said_to_be_old(visit, sequence):
    with running("serve", sequence, "--loop", "--health-port", 0) as address:
        page = visit(address)
        page.locator(".trust strong").wait_for()
        page.context.set_offline(True)
        page.evaluate("WebSocket.prototype.send = () => {}")  # as a network does that swallows all
        page.get_by_role("alert").get_by_text("what is shown is old").wait_for()
        assert page.locator(".picture.stale").count() == 1


def test_settings_are_previewed_live_and_saved_as_a_profile(visit, served, tmp_path):
    page = visit(served)
    part(page, "Settings")
    page.get_by_label("Least contrast of a light").fill("5000")
    page.get_by_text(re.compile(r"^[1-9]\d* frames are kept")).wait_for()
    page.get_by_role("button", name="Preview on the last seconds").click()
    page.get_by_text(re.compile(r"^0 valid of \d+ frames")).wait_for()
    page.get_by_text(re.compile(r"^[1-9]\d* valid of \d+ frames")).wait_for()
    page.get_by_label("vehicle", exact=True).fill("BlueROV2")
    page.get_by_label("file", exact=True).fill(str(tmp_path / "mine.yaml"))
    page.get_by_role("button", name="Save there").click()
    page.get_by_text("saved:").wait_for()
    assert "min_snr: 5000" in (tmp_path / "mine.yaml").read_text()
    page.get_by_role("button", name="Reset").click()
    page.get_by_role("button", name="Load", exact=True).click()
    page.get_by_text("nothing is changed until you use it").wait_for()
    assert page.get_by_label("Least contrast of a light").input_value() == "5000"
    page.get_by_label("Least contrast of a light").fill("lots")
    page.get_by_text("wanted a number").wait_for()


def test_a_recording_is_stepped_by_keys_compared_and_packed(visit, replayed, tmp_path):
    page = visit(replayed)
    page.get_by_text("1 of 16").wait_for()
    for key, place in (
        ("ArrowRight", "2 of 16"),
        ("Shift+ArrowRight", "12 of 16"),
        ("End", "16 of 16"),
        ("Home", "1 of 16"),
    ):
        page.keyboard.press(key)
        page.get_by_text(re.compile(f"^{place}")).wait_for()
    for key in ("ArrowRight", "ArrowRight", "i", "b", "ArrowRight", "ArrowRight", "ArrowRight", "o", "n"):
        page.keyboard.press(key)
    page.get_by_text("stretch: frames 3 to 6").wait_for()
    page.get_by_role("button", name=re.compile("^★ 0+2$")).wait_for()
    part(page, "Settings")
    page.get_by_label("Least contrast of a light").fill("5000")
    page.get_by_role("button", name="Run the stretch").click()
    page.get_by_text("B: 0 valid of 4").wait_for()
    part(page, "Replay")
    assert page.locator(".frame").count() == 2
    page.get_by_text("NO FIX").wait_for()
    page.get_by_text("Compare with another method").click()
    page.get_by_label("method").select_option("p3p-vote")
    page.get_by_role("button", name="Run", exact=True).click()
    page.get_by_text(re.compile("^B: [1-4] valid of 4")).wait_for()
    page.get_by_label("notes").fill("no pose here")
    with page.expect_download() as download:
        page.get_by_role("button", name="Download").first.click()
    download.value.save_as(tmp_path / "bundle.zip")
    assert (tmp_path / "bundle.zip").stat().st_size > 10_000
    page.keyboard.press("Escape")
    page.get_by_label("beside B").select_option("")
    assert page.locator(".frame").count() == 1


def test_wizards_check_the_dock_and_say_why_a_survey_cannot_be(visit, replayed):
    page = visit(replayed)
    page.get_by_text("1 of 16").wait_for()
    part(page, "Dock check")
    page.get_by_role("button", name="Check", exact=True).click()
    page.get_by_text("Head-on approach").wait_for()
    part(page, "Calibrate")
    page.get_by_role("button", name="Solve").click()
    page.get_by_text("0 views show the board").wait_for()
    part(page, "Survey")
    page.get_by_role("button", name="Solve").click()
    page.get_by_text("confirm the frames first").wait_for()
    page.get_by_role("button", name="Show three frames").click()
    boxes = page.get_by_role("checkbox", name="every light carries its own id")
    boxes.nth(2).wait_for()
    boxes.nth(0).check()
    page.locator("#panel-survey .mark.front").first.click(force=True)
    chosen = page.locator("select:focus")
    light = chosen.input_value()
    assert re.fullmatch("[A-E]", light)
    chosen.select_option("no light")
    page.locator("#panel-survey .mark.rejected").first.wait_for()
    assert not boxes.nth(0).is_checked()  # what was confirmed has changed
    page.locator("#panel-survey .labels").first.get_by_role("combobox").nth(1).select_option(light)
    for number in range(3):
        boxes.nth(number).check()
    page.get_by_label("taped metres").fill("1.2")
    with page.expect_request("**/api/survey") as asked:
        page.get_by_role("button", name="Solve").click()
    labels = asked.value.post_data_json["labels"]
    counts = Counter(label["frame"] for label in labels)
    assert sorted(counts.values()) == [4, 5, 5]
    assert [label["light"] for label in labels if counts[label["frame"]] == 4].count(light) == 1
    page.get_by_text(re.compile("residual|frames|survey refused")).last.wait_for()


def test_alert_limits_are_tried_on_a_stretch_and_saved(visit, replayed, tmp_path):
    page = visit(replayed)
    page.get_by_text("1 of 16").wait_for()
    part(page, "Settings")
    for band in range(1, 4):
        page.get_by_label(f"band {band}: lateral, m").fill("0.000001")
    page.get_by_role("button", name="Run the stretch").click()
    page.get_by_text(re.compile("^B: 0 valid of 16")).wait_for()
    page.get_by_label("station file").fill(str(tmp_path / "strict.yaml"))
    page.get_by_role("button", name="Save the station there").click()
    page.get_by_text("saved:").wait_for()
    assert load_station(tmp_path / "strict.yaml").alert_limits.bands[0].lateral_m == 1e-6
    page.get_by_role("button", name="Reset").click()
    assert page.get_by_label("band 1: lateral, m").input_value() == "0.3"


def test_without_the_token_the_page_shows_and_changes_nothing(visit, replayed):
    page = visit(replayed.partition("#")[0])
    page.get_by_text("1 of 16").wait_for()
    part(page, "Dock check")
    assert page.get_by_role("button", name="Check", exact=True).is_disabled()
    page.get_by_text("This needs the address with #token=").first.wait_for()


def test_the_keys_are_told(visit, replayed):
    page = visit(replayed)
    page.get_by_text("1 of 16").wait_for()
    page.keyboard.press("?")
    page.get_by_role("dialog").get_by_text("play or stop").wait_for()
    page.keyboard.press("Escape")
    page.keyboard.press("2")
    assert page.get_by_role("tab", name="Settings").get_attribute("aria-selected") == "true"


def test_the_address_is_printed_with_the_token_and_health_without(sequence):
    with running("serve", sequence, "--loop", "--health-port", 0) as address:
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+/#token=[\w-]{22}", address)
