"""Finding run folders and what they were made from, and evaluating many of them as one table."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from lumidock.errors import InputError, extra
from lumidock.evaluation.metrics import count_run, evaluate
from lumidock.evaluation.run_description import read_description
from lumidock.streams.run_folder import identities
from lumidock.streams.source import Source
from lumidock.streams.sources import open_source

_MOST_DEEP = 4  # levels of folders, below the given one, that are searched for runs


def source_of(folder: Path, description: Mapping[str, Any], given: Path | None = None) -> Source | None:
    """The source of a run, by its hashes: the one given, or a sequence folder of its name in or beside the run.

    Or beside the folder that many runs are in.

    Raises: InputError for one that is given and that the run was not made from.
    """
    if given is not None:
        opened = open_source(given)
        if not _is_source(opened, description):
            raise InputError(f"{given}: not what {folder} was made from")
        return opened
    name = Path(str(description.get("source", {}).get("name", ""))).name or "sequence"
    for place in (folder / name, folder.parent / name, folder.parent.parent / name):
        if (place / "timestamps.csv").is_file():
            opened = open_source(place)
            if _is_source(opened, description):
                return opened
    return None


def _is_source(source: Source, description: Mapping[str, Any]) -> bool:
    """Whether the files that identify a source are those of the run."""
    found = identities({path.name: path for path in source.inputs})
    return all(
        description.get(part, {}).get(name) == value for part, values in found.items() for name, value in values.items()
    )


def find_runs(folder: Path) -> list[Path]:
    """The run folder itself, or all run folders below it in the order of their names. Raises: InputError for none."""
    if (folder / "fixes.csv").is_file():
        return [folder]
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    runs = sorted(_below(folder, _MOST_DEEP))
    if not runs:
        swapped = (folder / "truth.csv").exists()
        hint = "; it is a sequence: the run comes first, `lumidock eval RUN SEQUENCE`" if swapped else ""
        raise InputError(f"{folder}: neither a run nor a folder with runs{hint}")
    return runs


def _below(folder: Path, deep: int) -> Iterator[Path]:
    for inner in folder.iterdir():
        if (inner / "fixes.csv").is_file():
            yield inner
        elif deep > 1 and inner.is_dir() and not inner.is_symlink():
            yield from _below(inner, deep - 1)


def evaluate_all(folder: Path, truth: Path | None = None) -> list[dict[str, Any]]:
    """The evaluation of every run below `folder`, with its `run` (name), `method` and `latency_us`.

    Against `truth`, or the sequence that is found in or beside each run; of several, one without truth is counted only.
    Raises: InputError for a single run without truth.
    """
    rows = []
    for run in find_runs(folder):
        description = read_description(run)
        name = str(run.relative_to(folder)) if run != folder else run.resolve().name
        about = {"run": name, "method": description.get("method"), "cold": description.get("cold")}
        latency = {"latency_us": description.get("counts", {}).get("latency_us", {})}
        known = truth or _truth_beside(run, description)
        if known is None and run == folder:
            raise InputError(f"{run}: no truth in or beside it; give TRUTH, or use `lumidock report`, which needs none")
        rows.append(about | (count_run(run) if known is None else evaluate(run, known)) | latency)
    return rows


def _truth_beside(run: Path, description: Mapping[str, Any]) -> Path | None:
    source = source_of(run, description)
    return source.path if source is not None and (source.path / "truth.csv").is_file() else None


def flat(content: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested content as one row: `error.lateral_m.median` and so on; lists are left out."""
    row: dict[str, Any] = {}
    for name, value in content.items():
        if isinstance(value, Mapping):
            row |= flat(value, f"{prefix}{name}.")
        elif not isinstance(value, list):
            row[f"{prefix}{name}"] = value
    return row


def write_table(rows: list[dict[str, Any]], path: Path) -> None:
    """Write evaluations, a row a run, as .parquet or .json by the ending. Raises: InputError for another ending."""
    if path.suffix == ".json":
        path.write_text(json.dumps(rows, indent=1), encoding="utf-8")
    elif path.suffix == ".parquet":
        with extra("parquet"):
            from lumidock.streams.parquet import write_rows
        write_rows([flat(row) for row in rows], path)
    else:
        raise InputError(f"{path}: neither .parquet nor .json")
