"""Columns of what the detector finds, and the numbers that it is given.

Lengths in pixels, values in 8-bit grey levels.
"""

from __future__ import annotations

(
    U,
    V,
    RADIUS,
    FLUX,
    SNR,
    ELONGATION,
    FILL,
    LEVEL,
    SATURATED,
    CUT,
    CORE,
    P_LIGHT,
    VAR_UU,
    VAR_UV,
    VAR_VU,
    VAR_VV,
    BY_LENS,
) = range(17)
COLUMNS = 17
# what may be tuned, see `DetectConfig`
(
    CONTRAST,
    MIN_SNR,
    RING_PX,
    MAX_RADIUS_PX,
    MIN_RADIUS_PX,
    SMALL_PX,
    MIN_ELONGATION,
    MIN_FILL,
    SIGNAL_NOISE,
    FLOOR_PX,
    SATURATED_PX,
    CUT_SHARE,
    GLINT_RADII,
    GLINT_RATIO,
    GLINT_TRUST,
    CLIPPED,
    MIN_NOISE,
    KIN,
    LAMPS,
    RANGE,
    PROMINENT,
    COARSE_PX,
    TEXTURE,
) = range(23)
PARAMETERS = 23
