"""Dockings with history counted: lights dead and dropping out, clutter, errors of survey and calibration."""

from __future__ import annotations

from typing import Any

from bench.acquisition import counted

SEEDS = (22000, 22060)


def main() -> tuple[dict[str, Any], list[str]]:
    """One row."""
    return counted("nominal", ("nominal",), SEEDS, cold=False)
