"""Has anything moved since the survey: the lights as a later recording shows them against the surveyed file."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lumidock.datatypes import Array
from lumidock.setup.gauge import aligned
from lumidock.setup.survey import Survey

_MOVED_CHI2 = 21.1  # three degrees of freedom; a light at rest exceeds it once in 10,000 checks


@dataclass(frozen=True, slots=True, eq=False)
class Moves:
    """How far each light (M, 3) m is from where the file has it, `chi2` (M,) of that, and which have `moved` (M,).

    `unseen` (M,) lights were not in view, so that nothing is known of them.
    """

    by_m: Array
    chi2: Array
    moved: np.ndarray
    unseen: np.ndarray


def moves(later: Survey, sigma_m: Array) -> Moves:
    """Compare a later survey, made with wide sigmas, with the file it started from, whose sigmas are `sigma_m` (M, 3).

    The shapes are laid over each other by the lights that stayed: the one that disagrees most is set aside and the
    fit repeated, until the others agree or only half remain.
    """
    filed, found = later.before.p_dock, later.after.p_dock
    unseen = ~later.adjusted.seen
    variance = sigma_m**2 + later.sigma_m**2
    stayed = ~unseen
    while True:
        by = _laid_over(found, filed, stayed) - filed
        chi2 = np.where(unseen, 0.0, (by**2 / variance).sum(axis=1))
        worst = int(np.argmax(np.where(stayed, chi2, -1.0)))
        if chi2[worst] < _MOVED_CHI2 or stayed.sum() <= max(4, len(filed) // 2):
            return Moves(by, chi2, chi2 >= _MOVED_CHI2, unseen)
        stayed = stayed & (np.arange(len(filed)) != worst)


def _laid_over(found: Array, filed: Array, stayed: np.ndarray) -> Array:
    """The found shape (M, 3), moved and resized so that the lights that `stayed` (M,) fit the file's.

    A change of size alone is the scale that pictures leave open, not a light that moved.
    """
    fitted = aligned(found[stayed], filed[stayed], scale=True)
    a, b = found[stayed], fitted
    size = np.linalg.norm(b - b.mean(axis=0)) / np.linalg.norm(a - a.mean(axis=0))
    U, _, Vt = np.linalg.svd((b - b.mean(axis=0)).T @ (a - a.mean(axis=0)))
    R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return np.asarray(size * (found - a.mean(axis=0)) @ R.T + b.mean(axis=0))
