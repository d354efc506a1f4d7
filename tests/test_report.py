"""The page of a run: complete, honest about what is missing, and no way in for what others wrote."""

import html.parser
import json
import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from bench.shipped import CAMERA_FILE, STATION_FILE, shipped_camera, shipped_station

from lumidock.app.run import Setup, run
from lumidock.config import Config
from lumidock.errors import InputError
from lumidock.localizer import Localizer
from lumidock.report import report
from lumidock.report.figures import _spans, _thinned
from lumidock.report.page import Table, markdown, render
from lumidock.report.view import load_run
from lumidock.sim.scenario import load_scenario
from lumidock.sim.sequence import write_detections, write_rendered
from lumidock.streams.run_folder import RunFolder
from lumidock.streams.sources import open_source

CHROMIUM = shutil.which("chromium")
RENDERED = ("path.start_z_m=16", "path.frame_interval_s=1.6", "faults.spurious=1")
COARSE = ("path.start_z_m=16", "path.frame_interval_s=0.6", "faults.spurious=1")


def make_run(folder, *, rendered=False, name="run"):
    station, camera = shipped_station(), shipped_camera()
    sequence, out = folder / "sequence", folder / name
    write = write_rendered if rendered else write_detections
    if not sequence.exists():
        sequence.mkdir(parents=True)
        (sequence / "station.yaml").write_bytes(STATION_FILE.read_bytes())
        write(load_scenario("approach", RENDERED if rendered else COARSE), station, camera, 7, sequence)
    with RunFolder(out, station.ids) as run_folder:
        (out / "station.yaml").write_bytes(STATION_FILE.read_bytes())
        (out / "camera.yaml").write_bytes(CAMERA_FILE.read_bytes())
        setup = Setup("lumidock", False, Config(), STATION_FILE, CAMERA_FILE)
        run(open_source(sequence), Localizer(station, camera), run_folder, setup)
    return out


@pytest.fixture(scope="module")
def docking(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("docking"))


@pytest.fixture(scope="module")
def seen_docking(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("seen"), rendered=True)


@pytest.fixture(scope="module")
def page_text(docking):
    return report([docking])


@pytest.fixture(scope="module")
def two_text(docking):
    return report([docking, docking])


@pytest.fixture(scope="module")
def seen_text(seen_docking):
    return report([seen_docking])


class Reader(html.parser.HTMLParser):
    """Every element of a page by name, and its attributes."""

    def __init__(self, text):
        super().__init__()
        self.found = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))

    def values(self, tag, name):
        return [attrs[name] for found, attrs in self.found if found == tag and name in attrs]


def test_page_has_every_figure_in_both_layouts_and_asks_nobody_for_anything(page_text):
    page = Reader(page_text)
    names = [attrs["id"] for tag, attrs in page.found if tag == "figure" and "plot" in attrs.get("class", "")]
    wanted = ("trajectory", "levels", "guide", "stanford", "lights", "states", "latency")
    assert names == [f"r1-{name}" for name in wanted]
    layouts = [value for value in page.values("svg", "class") if value.startswith("plot")]
    assert layouts == ["plot wide", "plot narrow"] * len(wanted)
    assert not [tag for tag, _ in page.found if tag in ("script", "iframe", "object", "embed")]
    for tag, attrs in page.found:
        for name, value in attrs.items():
            if name.split(":")[-1] in ("href", "src"):
                assert value.startswith(("#", "data:")), (tag, name, value)


def test_identifiers_of_a_page_are_its_own_and_every_reference_is_met(two_text):
    page = Reader(two_text)
    ids = [attrs["id"] for _, attrs in page.found if "id" in attrs]
    assert len(ids) == len(set(ids))
    references = [v[1:] for v in page.values("use", "xlink:href")]
    references += re.findall(r"url\(#([^)]*)\)", " ".join(str(attrs) for _, attrs in page.found))
    assert references
    assert set(references) <= set(ids)


def test_no_colour_of_a_plot_escapes_the_style_sheet(page_text):
    drawn = " ".join(re.findall(r'<svg class="plot.*?</svg>', page_text, re.DOTALL))
    assert set(re.findall(r"#[0-9a-f]{6}\b", drawn)) <= {"#000000"}  # what matplotlib defines and does not show


def test_same_run_gives_the_same_page(docking, page_text):
    assert report([docking]) == page_text


def test_numbers_of_the_page_are_those_of_the_run(docking, page_text):
    text, view = page_text, load_run(docking)
    valid = int(view.valid.sum())
    assert f"valid pose ({valid} frames)" in text
    assert f"{view.evaluation['error']['lateral_m']['median']:.3f} m" in text


def test_arrays_of_a_view_agree_with_the_evaluation(docking):
    view = load_run(docking)
    lateral = view.errors[np.isfinite(view.errors[:, 0]), 0]
    assert len(lateral) == view.evaluation["valid"] > 0
    assert np.median(lateral) == pytest.approx(view.evaluation["error"]["lateral_m"]["median"], abs=1e-9)
    over = (view.errors > view.limits).any(axis=1).sum()
    assert over == view.evaluation["hazardous"]["valid"]["any"]


def test_spans_cover_exactly_the_frames_that_are_meant(docking, rng):
    view = load_run(docking)
    step = view.t_s[1] - view.t_s[0]
    for _ in range(50):
        which = rng.random(len(view.t_s)) < rng.random()
        spans = _spans(view, which)
        inside = [any(a - 1e-6 <= t < a + length - 1e-6 for a, length in spans) for t in view.t_s]
        assert inside == which.tolist()
        assert sum(length for _, length in spans) == pytest.approx(which.sum() * step)


def test_pictures_say_what_was_named_and_why_the_rest_was_not(seen_text):
    text = seen_text
    assert text.count("data:image/jpeg") >= 4
    assert "from the nearest light" in text or "probably no lamp" in text
    assert len(text.encode()) < 5e6


def test_page_of_many_runs_stays_small(docking):
    text = report([docking] * 12)
    assert len(text.encode()) < 5e6
    page = Reader(text)
    assert [v for v in page.values("figure", "id") if v.endswith("-trajectory")] == [
        f"r{k}-trajectory" for k in range(1, 13)
    ]


def test_long_runs_keep_what_must_be_seen(docking):
    view = load_run(docking)
    n = len(view.fixes)
    errors = view.errors.copy()
    errors[n - 2] = 2.0 * np.nan_to_num(view.levels[n - 2], nan=1.0)  # the one frame that broke its promise
    broken = replace(view, errors=errors)
    kept = _thinned(broken, 5)
    assert kept[n - 2]
    assert kept.sum() <= 6


def test_without_its_source_a_run_has_neither_truth_nor_pictures(docking, tmp_path):
    alone = tmp_path / "elsewhere" / "run"
    shutil.copytree(docking, alone)
    text = report([alone])
    assert "There is no truth" in text
    assert 'id="r1-stanford"' not in text
    assert 'id="r1-trajectory"' in text


def test_run_without_any_fix_still_has_a_page(docking, tmp_path):
    empty = tmp_path / "run"
    shutil.copytree(docking, empty)
    head, *rows = (docking / "fixes.csv").read_text().splitlines()
    columns = head.split(",")
    kept = ("frame", "t_ns", "n_seen", "n_used")
    lost = {"valid": "0", "guide": "0", "status": "none", "stage": "search", "reason": "no_lights"}
    lines = [
        ",".join(
            lost.get(name, value if name in kept else "") for name, value in zip(columns, row.split(","), strict=True)
        )
        for row in rows
    ]
    (empty / "fixes.csv").write_text("\n".join([head, *lines]) + "\n")
    text = report([empty])
    assert "no detection in the image" in text
    assert 'id="r1-states"' in text


def test_what_others_wrote_stays_text(docking, tmp_path):
    evil = "<script>alert(1)</script>\"'&"
    run_folder = tmp_path / "<b>run&"
    shutil.copytree(docking, run_folder)
    described = json.loads((run_folder / "run.json").read_text())
    described["lumidock"] = described["method"] = described["source"]["kind"] = evil
    described["config"] = {evil: evil}
    described["inputs_sha256"][evil] = described["inputs_sampled"][evil] = evil
    (run_folder / "run.json").write_text(json.dumps(described))
    station = (run_folder / "station.yaml").read_text()
    (run_folder / "station.yaml").write_text(re.sub(r"(?m)^name: .*$", "name: '<script>alert(2)</script>'", station))
    text = report([run_folder, docking])
    assert "<script" not in text
    assert "<b>run" not in text
    assert "&lt;script&gt;" in text


def test_render_escapes_and_markdown_keeps_its_columns():
    assert "&lt;i&gt;" in render("<i>", "<i>", [])
    table = markdown(Table("c", ["a", "b"], [["x|y", "1\n2"]]))
    assert table.splitlines()[-1] == "| x\\|y | 1 2 |"


def test_wrong_source_no_run_and_too_many_are_refused(docking, tmp_path, lumidock):
    other = tmp_path / "other"
    write_detections(
        load_scenario("approach", (*COARSE, "path.speed_m_s=2")), shipped_station(), shipped_camera(), 1, other
    )
    with pytest.raises(InputError, match="not what"):
        report([docking], [other])
    code, _, error = lumidock("report", tmp_path, "--out", tmp_path / "page.html")
    assert code == 2
    assert len(error.strip().splitlines()) == 1
    code, _, error = lumidock("report", *[docking] * 13, "--out", tmp_path / "page.html")
    assert (code, "at most 12" in error) == (2, True)
    (tmp_path / "page.html").write_text("kept")
    code, _, error = lumidock("report", docking, "--out", tmp_path / "page.html")
    assert (code, (tmp_path / "page.html").read_text()) == (2, "kept")


def test_damaged_description_is_one_line(docking, tmp_path):
    for content in ("", "[]", "{", '{"source": 3}', '{"inputs_sha256": []}', '{"inputs_sampled": true}'):
        broken = tmp_path / f"{len(content)}" / "run"
        shutil.copytree(docking, broken)
        (broken / "run.json").write_text(content)
        with pytest.raises(InputError) as caught:
            report([broken])
        assert len(str(caught.value).splitlines()) == 1


_PROBE = """
<script>
addEventListener('error', e => document.title = 'ERROR ' + e.message);
addEventListener('load', () => {
  const bad = [];
  const width = document.documentElement.clientWidth;
  if (document.documentElement.scrollWidth > width) bad.push('page wider than the window');
  for (const f of document.querySelectorAll('figure.plot')) {
    const shown = [...f.querySelectorAll('svg.plot')].filter(s => getComputedStyle(s).display !== 'none');
    if (shown.length !== 1) { bad.push(f.id + ' layouts ' + shown.length); continue; }
    const box = shown[0].getBoundingClientRect();
    if (box.width < 250 || box.height < 80) bad.push(f.id + ' small');
    if (shown[0].querySelectorAll('path, use').length < 10) bad.push(f.id + ' empty');
    for (const t of shown[0].querySelectorAll('text')) {
      const b = t.getBoundingClientRect();
      if (b.left < box.left - 2 || b.right > box.right + 2 || b.top < box.top - 2 || b.bottom > box.bottom + 2)
        bad.push(f.id + ' cuts ' + t.textContent);
      if (b.height < 6) bad.push(f.id + ' tiny ' + t.textContent);
      if (getComputedStyle(t).fill === getComputedStyle(document.body).backgroundColor) bad.push(f.id + ' unseen');
    }
  }
  for (const i of document.querySelectorAll('svg.view image'))
    if (i.getBoundingClientRect().width < 250) bad.push('picture small');
  for (const e of document.querySelectorAll('h1, h2, h3, p, figcaption, .tile, li'))
    if (e.scrollWidth > e.clientWidth + 1 && e.clientWidth) bad.push('cut off: ' + e.textContent.slice(0, 40));
  for (const e of document.querySelectorAll('caption span'))
    if (e.getBoundingClientRect().right > width) bad.push('cut off: ' + e.textContent.slice(0, 40));
  document.title = 'PROBED ' + getComputedStyle(document.body).backgroundColor + ' ' + bad.slice(0, 8).join('; ');
});
</script>
"""


def probe(page, text, width, dark):
    """What a browser says of a page: its background and what is wrong; its policy makes room."""
    policy = re.compile(r'<meta http-equiv="Content-Security-Policy"[^>]*>')
    page.write_text(policy.sub("", text).replace("</head>", f"{_PROBE}</head>"), encoding="utf-8")
    command = [CHROMIUM, "--headless=new", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=4000", "--dump-dom"]
    command += [f"--window-size={width},900", f"--user-data-dir={page.parent / 'profile'}"]
    command += ["--blink-settings=preferredColorScheme=0"] if dark else []
    done = subprocess.run([*command, page.as_uri()], capture_output=True, text=True, timeout=120, check=True)
    return re.search(r"<title>(.*?)</title>", done.stdout, re.DOTALL)[1]


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium; Debian has it as a package")
@pytest.mark.parametrize(("width", "dark"), [(1200, False), (1200, True), (360, False), (360, True)])
def test_browser_shows_all_of_the_page(seen_text, tmp_path, width, dark):
    title = probe(tmp_path / "page.html", seen_text, width, dark)
    background = "rgb(17, 23, 29)" if dark else "rgb(255, 255, 255)"
    assert title == f"PROBED {background} "
