"""A small sample of every picture, which tells one that a camera, a decoder or a network repeats."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from typing_extensions import Self

from lumidock.datatypes import Array, Image

_SIDE = 32  # samples along each side: a thousand of them give the mean difference of pure noise to 3 %
_REPEATED = 0.25  # of the usual mean difference from picture to picture; a decoder changes a repeated one by less
_MEMORY = 0.9  # of the usual difference, from picture to picture


@dataclass(frozen=True, slots=True, eq=False)
class Digest:
    """`samples` (K,) of a picture, grey levels, and whether it `repeats` the one before.

    `usual`: the mean difference between the samples of successive pictures so far; NaN before there were two. A picture
    without noise or motion, as a dark one of few bits, has none and repeats nothing.
    """

    samples: Array
    usual: float
    repeats: bool

    @classmethod
    def of(cls, image: Image) -> Self:
        """The digest of a first picture."""
        return cls(_samples(image), np.nan, False)

    def next(self, image: Image) -> Digest:
        """The digest of the picture that follows."""
        samples = _samples(image)
        if samples.shape != self.samples.shape:
            return Digest(samples, np.nan, False)
        apart = float(np.abs(samples - self.samples).mean())
        if apart < _REPEATED * self.usual:
            return Digest(samples, self.usual, True)
        usual = apart if np.isnan(self.usual) else _MEMORY * self.usual + (1.0 - _MEMORY) * apart
        return Digest(samples, usual, False)


def _samples(image: Image) -> Array:
    """Pixels of a regular grid, of all channels."""
    rows, columns = (max(side // _SIDE, 1) for side in image.shape[:2])
    return image[rows // 2 :: rows, columns // 2 :: columns].astype(np.float64).ravel()
