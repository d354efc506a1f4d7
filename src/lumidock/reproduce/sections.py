"""The page of a reproduction: a section an experiment, the paper's own figure beside both methods."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from lumidock.report import figures
from lumidock.report.moments import annotated_images
from lumidock.report.page import PageSection, Table, Tile, markdown
from lumidock.report.view import load_run
from lumidock.reproduce import plots
from lumidock.reproduce.detector import detector_table
from lumidock.reproduce.experiments import COLD, FAULTS_AT_DISTANCE, ROWS
from lumidock.reproduce.grid import Grid
from lumidock.reproduce.paper_figures import (
    AXIS_M,
    DISTANCES_M,
    DOCKING_PLANE_Z_M,
    DUAL_LAYER_MS,
    FRAME_MS,
    FRONT_Z_M,
    LAYER_OFFSET_M,
    REAR_FIRST_Z_M,
    SINGLE_LAYER_MS,
    TABLE_1,
)
from lumidock.reproduce.trials import Counts
from lumidock.reproduce.work import search_sides

Results = Mapping[str, Any]
_Claim = tuple[
    str, str, tuple[str, bool], tuple[str, bool]
]  # figure, paper, and its method's and ours with whether met
_SHOWN_PICTURES = 6
_END_M = 0.25  # a frame is so near to the docking plane when it is the last of a coarse run


def sections_of(grid: Grid, results: Results, out: Path) -> list[PageSection]:
    """All sections, in the order of the paper, and then what it left open."""
    return [
        _summary(results),
        PageSection("Table 1: names with lights missing and spurious", _TABLE_1_TEXT, items=[_table_1(results)]),
        PageSection("Figures 6, 7 and 11: the swarm and the filter", _FILTER_TEXT, items=_filter(results)),
        PageSection("Figures 9 and 10: at 9, 5 and 3 m", items=[_distances(results)]),
        PageSection("Figures 12 and 13: the rectangular search", _SEARCH_TEXT, items=_search(results, out)),
        PageSection("Figures 15 and 16: the docking", _DOCKING_TEXT, items=_docking(results, out)),
        PageSection("Cold starts that the paper leaves open", _COLD_TEXT, items=[_cold(results)]),
        PageSection("Turbidity, exposure and light from above", _ENVELOPE_TEXT, items=_envelope(grid, results)),
        PageSection("Nothing hazardously misleading", _HAZARD_TEXT, items=_hazards(results)),
    ]


_TABLE_1_TEXT = (
    "The paper's section 4.1 at point level: 0.5 px of noise, runs toward the dock at 1.5 m/s and 4 Hz; a frame counts "
    "when all seven front lights are in view, and is right when every true detection carries its own name and no "
    "spurious one carries any. The swarm and our cold figures have no history; the other two have."
)
_FILTER_TEXT = (
    "The swarm converging on the registration; and a spurious light that appears and then stays while a true one goes "
    "dark, where one-to-one assignment has to name the spurious one and the backtracking filter does not."
)
_SEARCH_TEXT = (
    "Once round a rectangle at 15 m, so that the dock is seen from below, left, above and right, and in part."
)
_DOCKING_TEXT = (
    "30 m to the docking plane at z = -3 m in rendered Jerlov III water at 2 ms; both methods on the same pictures."
)
_COLD_TEXT = (
    "Independent frames without history. The paper says that missing and spurious lights together defeat its method "
    "before its first fix; answers are frames with names, right ones have every name right, wrong ones at least one "
    "wrong."
)
_ENVELOPE_TEXT = (
    "Approaches rendered for each water and exposure: true z of the first and the last frame that could be used. Our "
    "method by bearing and range (guide) and by full pose (valid); the paper's by its pose, which it does not vouch "
    "for."
)
_HAZARD_TEXT = (
    "Every shipped docking: frames that claim to be usable while their error is over the alert limit. Point level: "
    "bare detections that are missed, err and are false as measured on rendered frames of the scenario's water and "
    "lights, drawn anew in each frame and false ones anywhere in the picture: of mirror images and glints that stand "
    "where a light might, and of errors that last, the rendered rows tell."
)


# The paper's figures, all at once


def _summary_table(results: Results) -> tuple[Table, list[_Claim]]:
    rows = [*_table_1_claims(results), *_docking_claims(results)]
    table = Table(
        "The paper's own figures and those found here; ✓: as good or better. Times are of this machine, the paper's "
        "of a Jetson.",
        ["figure", "paper", "its method here", "lumidock"],
        [[name, paper, _with_verdict(theirs), _with_verdict(ours)] for name, paper, theirs, ours in rows],
    )
    return table, rows


def summary_table(results: Results) -> str:
    """The paper's figures and those found here as Markdown, without a caption."""
    return markdown(_summary_table(results)[0]).partition("\n\n")[2].strip()


def _summary(results: Results) -> PageSection:
    table, rows = _summary_table(results)
    met = [sum(bool(pair[k][1]) for pair in ((row[2], row[3]) for row in rows)) for k in (0, 1)]
    tiles = [
        Tile(f"{met[1]} of {len(rows)}", "figures of the paper met or beaten by lumidock", _good(met[1] == len(rows))),
        Tile(f"{met[0]} of {len(rows)}", "met by the paper's method here", _good(met[0] == len(rows))),
    ]
    return PageSection("The paper's figures", tiles=tiles, items=[table])


def _with_verdict(cell: tuple[str, bool]) -> str:
    return f"{cell[0]} {'✓' if cell[1] else '✗'}"


def _good(whether: bool) -> str:
    return "good" if whether else "bad"


def _counts_of(results: Results, missing: int, spurious: int, clean_start: bool) -> Counts:
    start = f"table-1-{missing}-{spurious}{'-warm' * clean_start}-"
    found = [value for name, value in results.items() if name.startswith(start) and name[len(start) :].isdecimal()]
    return sum((Counts(**value) for value in found), Counts())


def _table_1_claims(results: Results) -> list[_Claim]:
    claims: list[_Claim] = []
    for (missing, spurious), (swarm, whole) in TABLE_1.items():
        counts = _counts_of(results, missing, spurious, False)
        name = f"{missing} missing" if missing else f"{spurious} spurious"
        cells = (
            (counts.swarm_right, counts.ours_cold_right, swarm, "no history"),
            (counts.right, counts.ours_right, whole, "history"),
        )
        for theirs, ours, wanted, how in cells:
            shares = [_percent(right, counts.frames) for right in (theirs, ours)]
            pair = [(f"{share:.2f} %", share >= wanted) for share in shares]
            claims.append((f"right, {name}, {how}", f"{wanted:g} %", pair[0], pair[1]))
    return claims


def _percent(part: int, whole: int) -> float:
    return 100.0 * part / whole if whole else float("nan")


def _docking_claims(results: Results) -> list[_Claim]:
    result = results["docking-0"]
    rows: list[tuple[str, str, Callable[[dict[str, Any]], float | None], Callable[[float], bool]]] = [
        ("first front fix, z m", f"{FRONT_Z_M[0]:g}", lambda r: _reach(r, "front", 0), lambda z: z >= FRONT_Z_M[0]),
        ("last front fix, z m", f"{FRONT_Z_M[1]:g}", lambda r: _reach(r, "front", 1), lambda z: z <= FRONT_Z_M[1]),
        ("first rear fix, z m", f"{REAR_FIRST_Z_M:g}", lambda r: _reach(r, "rear", 0), lambda z: z >= REAR_FIRST_Z_M),
        (
            "last fix, z m",
            f"{DOCKING_PLANE_Z_M:g}",
            lambda r: _reach(r, "valid", 1),
            lambda z: z < DOCKING_PLANE_Z_M + _END_M,
        ),
        ("offset of the layers, m", f"< {LAYER_OFFSET_M:g}", _offset, lambda m: m < LAYER_OFFSET_M),
        ("farthest off the axis, m", f"< {AXIS_M:g}", _off_axis, lambda m: m < AXIS_M),
        (
            "single layer, ms a frame",
            f"{SINGLE_LAYER_MS:g}",
            lambda r: r["ms"]["single"],
            lambda ms: ms <= SINGLE_LAYER_MS,
        ),
        ("dual layer, ms a frame", f"{DUAL_LAYER_MS:g}", lambda r: r["ms"]["dual"], lambda ms: ms <= DUAL_LAYER_MS),
    ]
    return [
        (name, paper, _claim(value(result["paper"]), good), _claim(value(result["lumidock"]), good))
        for name, paper, value, good in rows
    ]


def _claim(value: float | None, good: Callable[[float], bool]) -> tuple[str, bool]:
    return ("none", False) if value is None else (f"{value:.2f}", good(value))


def _reach(result: dict[str, Any], what: str, end: int) -> float | None:
    ends = result["reach"].get(what)
    return None if ends is None else float(ends[end])


def _offset(result: dict[str, Any]) -> float | None:
    """Between the layers, where each has a pose of its own; one pose of both has its largest lateral 95 % error."""
    offset = result.get("layers", {}).get("offset_m")
    found: float | None = offset if offset is not None else result["error"].get("lateral_m", {}).get("p95")
    return found


def _off_axis(result: dict[str, Any]) -> float | None:
    return result["off_axis_m"]  # type: ignore[no-any-return]


# An experiment each


def _table_1(results: Results) -> Table:
    rows = []
    for missing, spurious, clean_start in ROWS:
        c = _counts_of(results, missing, spurious, clean_start)
        paper = TABLE_1.get((missing, spurious), ("-", "-")) if not clean_start else ("-", "-")
        shares = [f"{_percent(n, c.frames):.2f}" for n in (c.swarm_right, c.ours_cold_right, c.right, c.ours_right)]
        wrong = (c.wrong, c.ours_cold_wrong, c.ours_wrong)
        cold = ["-", "-", "-"] if clean_start else [str(paper[0]), *shares[:2]]
        name = f"{missing} + {spurious}{', after a clean start' * clean_start}"
        rows.append([name, str(c.frames), *cold, str(paper[1]), *shares[2:], " / ".join(map(str, wrong))])
    head = ["front lights missing + spurious", "frames", "PSO: paper, %", "PSO here, %", "ours cold, %"]
    head += ["PSO + BTEKF: paper, %", "here, %", "ours, %", "wrong names: PSO + BTEKF / ours cold / ours"]
    return Table("Frames named right.", head, rows)


def _filter(results: Results) -> list[Any]:
    swarm, back = results["figure-6"], results["figure-7-and-11"]
    rows = [
        [str(k), str(row["lights"]), str(row["spurious"]), _word(row["paper"]), _word(row["lumidock"])]
        for k, row in enumerate(back["rows"], start=1)
    ]
    head = ["frame", "true lights seen", "spurious", "paper's method", "lumidock"]
    table = Table("The frames of figure 11 one after the other, with history: whose names are right.", head, rows)
    return [plots.swarm(swarm), plots.backtracking(back), table]


def _word(verdict: Sequence[bool]) -> str:
    right, wrong = verdict
    return "right" if right else "wrong name" if wrong else "not all named"


def _distances(results: Results) -> Table:
    rows = []
    for missing, spurious in FAULTS_AT_DISTANCE:
        for z in DISTANCES_M:
            r = results[f"figure-9-10-{z:g}-{missing}-{spurious}"]
            name = f"{missing} missing" if missing else f"{spurious} spurious"
            rows.append([f"{name}, {z:g} m", str(r["frames"]), *_answers(r, "paper"), *_answers(r, "lumidock")])
    head = ["front lights, z", "frames", "paper's method: right, %", "wrong", "lumidock: right, %", "wrong"]
    return Table(
        "Independent frames without history; the paper shows one picture of each and gives no number.", head, rows
    )


def _answers(result: dict[str, Any], method: str) -> list[str]:
    return [f"{_percent(result[method]['right'], result['frames']):.2f}", str(result[method]["wrong"])]


def _search(results: Results, out: Path) -> list[Any]:
    folder, result, rows = out / "runs" / "search", results["search"], []
    sides = {m: search_sides(str(folder / m), str(folder / "sequence")) for m in ("paper", "lumidock")}
    for side, all_of in sides["lumidock"].items():
        theirs = sides["paper"][side]
        rows.append([side, str(all_of["frames"]), str(theirs["valid"]), str(all_of["used"]), str(all_of["valid"])])
    for method in ("paper", "lumidock"):
        identities = result[method]["identities"]
        cell = f"{identities['wrong']} of {identities['identified']}"
        rows.append([f"wrong identities, {method}", cell, "", "", ""])
    head = ["dock seen from", "frames", "paper's method: pose", "lumidock: bearing and range", "lumidock: pose"]
    table = Table("Frames by side of the rectangle.", head, rows)
    views = [load_run(folder / method, folder / "sequence") for method in ("lumidock", "paper")]
    return [plots.search(views), table]


def _docking(results: Results, out: Path) -> list[Any]:
    folder, result = out / "runs" / "docking-0", results["docking-0"]
    views = [load_run(folder / method, folder / "sequence") for method in ("lumidock", "paper")]
    rows = [[name, *(cell(result[method]) for method in ("paper", "lumidock"))] for name, cell in _DOCKING_ROWS.items()]
    table = Table("The docking by both methods.", ["", "paper's method", "lumidock"], rows)
    shown = annotated_images(views[0], _SHOWN_PICTURES)
    return [
        *shown,
        table,
        *figures.comparison(views, "docking"),
        figures.trajectory(views[0], "docking-lumidock"),
        figures.trajectory(views[1], "docking-paper"),
    ]


_DOCKING_ROWS: dict[str, Callable[[dict[str, Any]], str]] = {
    "first and last pose, z m": lambda r: _span(r["reach"]["valid"]),
    "bearing and range, z m": lambda r: _span(r["reach"]["guide"]),
    "longest gap in poses, s": lambda r: _seconds(r, "valid"),
    "longest gap in guide, s": lambda r: _seconds(r, "guide"),
    "lateral error, median / 95 %, m": lambda r: _error(r, "lateral_m"),
    "axial error, m": lambda r: _error(r, "axial_m"),
    "angle error, deg": lambda r: _error(r, "angle_deg"),
    "hazardously misleading frames": lambda r: str(r["hazardous"]["valid"]["any"] + r["hazardous"]["guide"]["any"]),
    "wrong identities": lambda r: f"{r['identities']['wrong']} of {r['identities']['identified']}",
    f"ms a frame, single / dual layer (budget {FRAME_MS:g})": lambda r: _times(r["ms"]),
}


def _span(ends: Sequence[float] | None) -> str:
    return "-" if ends is None else f"{ends[0]:.2f} to {ends[1]:.2f}"


def _seconds(result: dict[str, Any], word: str) -> str:
    gap = result["continuity"][word]["longest_gap_s"]
    return "-" if gap is None else f"{gap:.2f}"


def _error(result: dict[str, Any], name: str) -> str:
    error = result["error"].get(name)
    return f"{error['median']:.3f} / {error['p95']:.3f}" if error else "-"


def _times(ms: dict[str, float | None]) -> str:
    return " / ".join("-" if value is None else f"{value:.1f}" for value in (ms["single"], ms["dual"]))


def _cold(results: Results) -> Table:
    rows = []
    for name, scenario in COLD.items():
        r, cells = results[f"cold-{scenario}"], []
        for method in ("paper", "lumidock"):
            cells += [f"{_percent(r[method]['answered'], r['frames']):.2f}", *_answers(r, method)]
        rows.append([name, str(r["frames"]), *cells])
    head = ["cold start", "frames", "paper's method: answers, %", "right, %", "wrong"]
    return Table("One frame, no history.", [*head, "lumidock: answers, %", "right, %", "wrong"], rows)


def _envelope(grid: Grid, results: Results) -> list[Any]:
    rows, seeds = [], range(grid.first_seed, grid.first_seed + grid.envelope_seeds)
    names = list(
        dict.fromkeys(n.removeprefix("envelope-").rpartition("-")[0] for n in results if n.startswith("envelope-"))
    )
    for name in names:
        for seed in seeds:
            r = results[f"envelope-{name}-{seed}"]
            cells = [_span(r["paper"]["valid"]), _span(r["lumidock"]["valid"]), _span(r["lumidock"]["guide"])]
            rows.append([_envelope_name(name) + f", seed {seed}" * (len(seeds) > 1), *cells])
    head = [
        "water and exposure",
        "paper's method: pose, z m",
        "lumidock: pose, z m",
        "lumidock: bearing and range, z m",
    ]
    caption = (
        f"First and last true z in m, from 30 to -3 m at 1 m/s with a frame every {grid.envelope_interval_s:g} s; "
        "coarser frames make a filter's life harder. Light from above (60 W/m2 elsewhere) and salt in type III at 2 ms."
    )
    return [plots.envelope(rows, caption), Table(caption, head, rows)]


def _envelope_name(name: str) -> str:
    kind, _, rest = name.partition("-")
    if kind == "water":
        water, _, exposure = rest.rpartition("-")
        return f"{water}, {exposure} ms"
    return f"light from above {rest} W/m2" if kind == "daylight" else "III, 5 psu, 5 deg C"


def _hazards(results: Results) -> list[Any]:
    rows: dict[str, list[int]] = {}
    for name, result in results.items():
        if name.startswith("point-"):
            counts = result["counts"]
            _add(
                rows,
                f"{name.removeprefix('point-').rpartition('-')[0]}, point level",
                [
                    counts.get("frames", 0),
                    counts.get("valid", 0),
                    counts.get("guide", 0),
                    counts.get("hazardous_valid", 0),
                    counts.get("hazardous_guide", 0),
                ],
            )
        elif name.startswith(("docking-", "search", "shipped-")):
            r = result["lumidock"]
            shown = name.removeprefix("shipped-").rpartition("-")[0] or name
            _add(
                rows,
                f"{shown}, rendered",
                [r["frames"], r["valid"], r["guide"], r["hazardous"]["valid"]["any"], r["hazardous"]["guide"]["any"]],
            )
    head = ["scenario", "frames", "valid", "guide", "hazardous valid", "hazardous guide"]
    return [
        Table(
            "Frames of our method, and those hazardously misleading.",
            head,
            [[n, *map(str, v)] for n, v in rows.items()],
        ),
        detector_table(),
    ]


def _add(rows: dict[str, list[int]], name: str, counts: list[int]) -> None:
    rows[name] = [a + b for a, b in zip(rows.get(name, [0] * len(counts)), counts, strict=True)]
