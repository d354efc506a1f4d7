"""The paper's own figures and those found here, all in one table."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from lumidock.report.page import PageSection, Table, Tile
from lumidock.reproduce.intervals import WORSE, mark, share
from lumidock.reproduce.paper_figures import (
    AXIS_M,
    DOCKING_PLANE_Z_M,
    DUAL_LAYER_MS,
    FRONT_Z_M,
    LAYER_OFFSET_M,
    REAR_FIRST_Z_M,
    SINGLE_LAYER_MS,
    TABLE_1,
    TABLE_1_FRAMES,
)
from lumidock.reproduce.plan import AS_PRINTED, TITLES
from lumidock.reproduce.table1 import LARGE, SMALL, counted
from lumidock.reproduce.trials import ACQUISITION, Condition

Results = Mapping[str, Any]
Cell = tuple[str, str]  # text and mark
_METHODS = (AS_PRINTED, "paper", "lumidock")
_END_M = 0.25  # a frame is so near to the docking plane when it is the last of a coarse run
_START = "30 m"  # 2108 frames in 30 trials fit a start at 30 m
_NONE: Cell = ("none", WORSE)


def section(results: Results) -> PageSection:
    """Tiles and the table."""
    rows = _rows(results)
    tiles = []
    for k, name in enumerate(TITLES.values()):
        met = sum(row[2][k][1] != WORSE for row in rows)
        tiles.append(
            Tile(f"{met} of {len(rows)}", f"of the paper's figures met: {name}", "good" if met == len(rows) else "bad")
        )
    machine = results["docking-0"]["machine"] if "docking-0" in results else ""
    return PageSection("The paper's figures", _TEXT, tiles=tiles, items=[_table(rows, machine)])


_TEXT = (
    "Marks: ✓ better than the paper's figure, ≈ no difference that its number of frames or ours could show, ✗ worse. "
    "Of shares both 95 % intervals are compared; the paper's is of the 2076 to 2153 frames that it counts. Other "
    "figures of the paper are of one run, and are met (✓) or not (✗). The farthest off the axis is that of the poses, "
    "so that their error counts as well; the true path stays within the paper's 1 m."
)


def _table(rows: list[tuple[str, str, list[Cell]]], machine: str) -> Table:
    cells = [[name, paper, *(f"{text} {verdict}" for text, verdict in found)] for name, paper, found in rows]
    times = f" CPU times are of one core of {machine}, the paper's of a Jetson AGX Xavier." if machine else ""
    return Table(f"The paper's figures and those found here.{times}", ["figure", "paper", *TITLES.values()], cells)


def _rows(results: Results) -> list[tuple[str, str, list[Cell]]]:
    rows = []
    if any(name.startswith("table-1-shipped-") for name in results):
        rows += _table_1_rows(results)
    if "docking-0" in results:
        rows += _docking_rows(results["docking-0"])
    return rows


def _table_1_rows(results: Results) -> list[tuple[str, str, list[Cell]]]:
    rows = []
    for faults, (swarm, whole) in TABLE_1.items():
        by_name = counted(results, Condition(*faults))[_START]
        for names, wanted, how in (
            ((SMALL, LARGE, "lumidock" + ACQUISITION), swarm, "no history"),
            (_METHODS, whole, "history"),
        ):
            counts = [by_name[name] for name in names]
            cells = [
                (f"{share(one.right, one.frames)} %", mark(one.right, one.frames, wanted, TABLE_1_FRAMES[faults]))
                for one in counts
            ]
            rows.append((f"right, {Condition(*faults).name}, {how}", f"{wanted:g} %", cells))
    return rows


def _docking_rows(result: dict[str, Any]) -> list[tuple[str, str, list[Cell]]]:
    claims: list[tuple[str, str, Callable[[dict[str, Any]], float | None], Callable[[float], bool]]] = [
        ("first front fix, z m", f"{FRONT_Z_M[0]:g}", lambda r: _reach(r, "front", 0), lambda z: z >= FRONT_Z_M[0]),
        ("last front fix, z m", f"{FRONT_Z_M[1]:g}", lambda r: _reach(r, "front", 1), lambda z: z <= FRONT_Z_M[1]),
        ("first rear fix, z m", f"{REAR_FIRST_Z_M:g}", lambda r: _reach(r, "rear", 0), lambda z: z >= REAR_FIRST_Z_M),
        (
            "last pose, z m",
            f"{DOCKING_PLANE_Z_M:g}",
            lambda r: _reach(r, "valid", 1),
            lambda z: z < DOCKING_PLANE_Z_M + _END_M,
        ),
        ("offset of the layers, m", f"< {LAYER_OFFSET_M:g}", _offset, lambda m: m < LAYER_OFFSET_M),
        ("farthest off the axis, m", f"< {AXIS_M:g}", lambda r: r["off_axis_m"], lambda m: m < AXIS_M),
        (
            "single layer, CPU ms a frame",
            f"{SINGLE_LAYER_MS:g}",
            lambda r: r["ms"]["single"],
            lambda ms: ms <= SINGLE_LAYER_MS,
        ),
        ("dual layer, CPU ms a frame", f"{DUAL_LAYER_MS:g}", lambda r: r["ms"]["dual"], lambda ms: ms <= DUAL_LAYER_MS),
    ]
    return [(name, paper, [_claim(value(result[m]), good) for m in _METHODS]) for name, paper, value, good in claims]


def _claim(value: float | None, good: Callable[[float], bool]) -> Cell:
    return _NONE if value is None else (f"{value:.2f}", "✓" if good(value) else WORSE)


def _reach(result: dict[str, Any], what: str, end: int) -> float | None:
    ends = result["reach"].get(what)
    return None if ends is None else float(ends[end])


def _offset(result: dict[str, Any]) -> float | None:
    """Between the layers, where each has a pose of its own; one pose of both has its lateral error at 95 %."""
    offset = result.get("layers", {}).get("offset_m")
    found: float | None = offset if offset is not None else result["error"].get("lateral_m", {}).get("p95")
    return found
