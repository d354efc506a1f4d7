"""`lumidock eval`, and an evaluation as text."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from lumidock.cli.shared import AsJson, Force, app, example, require_new
from lumidock.evaluation.claims import nees_in_words
from lumidock.evaluation.run_description import over_limit_in_words


@app.command(
    "eval",
    epilog=example("lumidock eval RUN SEQ", "lumidock eval RUNS", "lumidock eval RUNS --out runs.parquet"),
)
def _eval(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder, or a folder with runs in it.")],
    truth: Annotated[
        Path | None,
        typer.Argument(
            metavar="TRUTH", help="Simulated sequence folder, or a truth.csv; or looked for beside each run."
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="Also write a row a run as .parquet or .json.")
    ] = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Compare a run, or all in a folder, with the truth."""
    from lumidock.evaluation.metrics import evaluate
    from lumidock.evaluation.run_folders import evaluate_all, write_table

    if out is not None:
        require_new(out, force)
    one = (run / "fixes.csv").exists()
    if one and truth is not None and out is None:  # needs no run.json
        result = evaluate(run, truth)
    else:
        rows = evaluate_all(run, truth)
        result = rows[0]
        if out is not None:
            write_table(rows, out)
    if as_json:
        print(json.dumps(result if one else rows, indent=2))
    elif one:
        print_evaluation(result)
    else:
        print_table(rows)


def print_table(rows: list[dict[str, Any]]) -> None:
    """Evaluations, a line a run."""
    width = max(len(row["run"]) for row in rows)
    print(f"{'run':{width}} {'method':>9} {'frames':>7} {'valid':>7} {'guide':>7} {'hazards':>8}", end="   ")
    print("lateral m       axial m         angle deg   (median / 95 %)")
    for row in rows:
        hazardous = row.get("hazardous")  # not known without truth
        hazards = "-" if hazardous is None else sum(hazardous[word]["any"] for word in ("valid", "guide"))
        counts = f"{row['frames']:7d} {row['valid']:7d} {row['guide']:7d} {hazards:>8}"
        print(f"{row['run']:{width}} {row['method'] or '?':>9} {counts}   {_errors(row.get('error') or {})}")


def print_evaluation(result: dict[str, Any]) -> None:
    """The evaluation as text: one line a topic, one row a range."""
    print(
        f"valid {result['valid']} of {_share(result, 'valid')}, guide {result['guide']} of {_share(result, 'guide')}; "
        f"not valid: {_words(result['reasons'])}"
    )
    for line in over_limit_in_words({"counts": result}):
        print(f"protection: {line}")
    if result["finished"] is False:
        print(f"not finished: the run was interrupted or goes on, and only its {result['frames']} frames so far count")
    for word, gaps in result["continuity"].items():
        if gaps["longest_gap_s"] is not None:
            print(f"longest gap in {word} {gaps['longest_gap_s']:.2f} s; gaps over 0.45 s: {gaps['long_gaps']}")
    if result["error"]:
        _print_ranges(result)
    for layer, content in result.get("layers", {}).items():
        if isinstance(content, dict):
            print(f"{layer}: {content['fixes']} fixes, z {content['first_z_m']:.2f} to {content['last_z_m']:.2f} m")
        elif content is not None:
            print(f"largest offset between the layers {content:.3f} m")
    if counts := result.get("identities"):
        print(
            f"identities: {counts['identified']} detections identified; {counts['wrong']} wrong (another lit light is "
            f"nearer), {counts['displaced']} more than 3 px from their light"
        )
    if result.get("residual_rms_px") is not None:
        print(f"identified lights {result['residual_rms_px']:.2f} px rms from where the poses put them")
    _print_integrity(result)


def _print_ranges(result: dict[str, Any]) -> None:
    print(f"{'z, m':>12} {'frames':>7} {'valid':>6} {'guide':>6}", end="   ")
    print("lateral m       axial m         angle deg   (median / 95 %)")
    for row in [*result["by_true_z"], {"z_m": None, **result, **result["error"]}]:
        where = "all" if row["z_m"] is None else f"{row['z_m'][0]:g}..{row['z_m'][1]:g}"
        print(f"{where:>12} {row['frames']:7d} {row['valid']:6d} {row['guide']:6d}   {_errors(row)}")


def _errors(row: dict[str, Any]) -> str:
    """Median / 95 % of each error, dashes where there is none."""
    errors = (row.get(name) for name in ("lateral_m", "axial_m", "angle_deg"))
    return "  ".join(f"{e['median']:6.3f} /{e['p95']:7.3f}" if e else f"{'-':>15}" for e in errors)


def _print_integrity(result: dict[str, Any]) -> None:
    """Whether alert limits, protection levels and covariances hold against the truth."""
    hazardous = result["hazardous"]
    for word in ("valid", "guide"):
        kinds = {kind: count for kind, count in hazardous[word].items() if kind != "any"}
        print(f"{word} but over the alert limit {hazardous[word]['any']} of {hazardous['frames']} frames", end="")
        print(f": {_words(kinds)}" if any(kinds.values()) else "")
    levels = {kind: f"{row['over']} of {row['frames']}" for kind, row in result["over_level"].items() if row["frames"]}
    if levels:
        print(f"error over the protection level: {_words(levels)}")
    nees = result["nees"]
    if nees["frames"]:
        stages = {stage: f"{mean['mean']:.2f}" for stage, mean in nees["by_stage"].items()}
        print(f"NEES {nees['mean']:.2f} over {nees['frames']} frames ({_words(stages)})")
        for line in nees_in_words(nees["mean"]):
            print(f"  {line}")
    if nis := result["nis"]:
        print(f"NIS per degree of freedom {nis['mean']:.2f} over {nis['frames']} frames")
        print("  1 on average where the noise of the centroids is as stated; less: they are better than that")
    if nees["improper"]:
        print(f"covariances that are not positive definite: {nees['improper']}")


def _words(counts: dict[str, Any]) -> str:
    return ", ".join(f"{word} {count}" for word, count in counts.items()) or "none"


def _share(result: dict[str, Any], word: str) -> str:
    """The frames of an evaluation, and which share of them is meant."""
    share = result["availability"][word]
    return f"{result['frames']} frames" + (f" ({100.0 * share:.1f} %)" if share is not None else "")
