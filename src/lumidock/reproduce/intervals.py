"""Shares with their 95 % intervals, and what they say of a figure of the paper."""

from __future__ import annotations

import math

_Z = 1.959964  # normal quantile of 97.5 %
LIKE, BETTER, WORSE = "≈", "✓", "✗"


def wilson(part: int, whole: int) -> tuple[float, float]:
    """95 % interval of a share, as shares; (0, 1) of nothing. Source: E. B. Wilson, 1927."""
    if not whole:
        return 0.0, 1.0
    middle = (part + 0.5 * _Z**2) / (whole + _Z**2)
    half = _Z / (whole + _Z**2) * math.sqrt(part * (whole - part) / whole + 0.25 * _Z**2)
    return max(0.0, middle - half), min(1.0, middle + half)


def share(part: int, whole: int) -> str:
    """Per cent with the interval; a dash of nothing."""
    if not whole:
        return "-"
    low, high = wilson(part, whole)
    return f"{100.0 * part / whole:.1f} ({100.0 * low:.1f}-{100.0 * high:.1f})"


def mark(part: int, whole: int, paper_percent: float, paper_whole: int) -> str:
    """Whether a share is better than the paper's, worse, or within both intervals of it."""
    low, high = wilson(part, whole)
    paper_low, paper_high = wilson(round(0.01 * paper_percent * paper_whole), paper_whole)
    if low > paper_high:
        return BETTER
    return WORSE if high < paper_low else LIKE
