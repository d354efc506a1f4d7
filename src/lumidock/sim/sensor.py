"""The image sensor: from expected electrons per pixel to noisy 12-bit levels and the picture that a camera delivers."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from lumidock.datatypes import Array, Indices
from lumidock.sim.knobs import Output, Sensor

LEVELS = 4095  # 12 bit
_ROWS = 16  # read out at once, so that they stay in the cache
_TO_16_BIT = 4  # bits by which the 12-bit levels are shifted up
_TO_BGR = {
    "rggb": cv2.COLOR_BayerRGGB2BGR,
    "bggr": cv2.COLOR_BayerBGGR2BGR,
    "grbg": cv2.COLOR_BayerGRBG2BGR,
    "gbrg": cv2.COLOR_BayerGBRG2BGR,
}


def electrons_per_level(sensor: Sensor) -> float:
    """Electrons per 12-bit level at the gain of the knobs."""
    return float(sensor.full_well_e / LEVELS / 10.0 ** (sensor.gain_db / 20.0))


def saturation_e(sensor: Sensor) -> float:
    """Electrons at which a pixel saturates: its full well, or full scale at the gain of the knobs."""
    return min(sensor.full_well_e, LEVELS * electrons_per_level(sensor))


def read_out(electrons: Array, sensor: Sensor, rng: np.random.Generator) -> NDArray[np.uint16]:
    """12-bit levels (H, W) of a sensor whose pixels expect `electrons` (H, W).

    Adds shot noise (as a Gaussian) and read noise, clips at the full well, applies the gain and rounds.
    Source: EMVA 1288, release 4, camera model.
    """
    raw, block = np.empty(electrons.shape, np.uint16), np.empty((2, _ROWS, electrons.shape[1]), np.float32)
    for row in range(0, len(raw), _ROWS):
        light = electrons[row : row + _ROWS]
        levels, sigma = block[:, : len(light)]
        rng.standard_normal(dtype=np.float32, out=levels)
        np.sqrt(np.add(light, np.float32(sensor.read_noise_e**2), out=sigma), out=sigma)
        levels *= sigma
        levels += light
        np.minimum(levels, np.float32(sensor.full_well_e), out=levels)
        levels *= np.float32(1.0 / electrons_per_level(sensor))
        raw[row : row + _ROWS] = np.clip(np.rint(levels, out=levels), 0, LEVELS, out=levels)
    return raw


def picture(raw: NDArray[np.uint16], sensor: Sensor, output: Output) -> np.ndarray:
    """The picture that the camera delivers from raw levels (H, W): (H, W, 3) bgr8, or (H, W) in the other formats.

    8-bit pictures are gamma-encoded except raw mosaics (bayer8); 16-bit pictures are linear.
    """
    if output.pixels == "bayer16":
        return np.left_shift(raw, _TO_16_BIT)
    if output.pixels == "bayer8":
        return np.right_shift(raw, _TO_16_BIT).astype(np.uint8)
    developed = cv2.demosaicing(raw, _TO_BGR[output.pattern]) if output.color else raw
    if output.color and output.channel_gains != (1.0, 1.0, 1.0):
        gains = np.array(output.channel_gains, np.float32)
        developed = np.minimum(np.rint(developed * gains), LEVELS).astype(np.uint16)
    if output.color and output.pixels != "bgr8":
        developed = cv2.cvtColor(developed, cv2.COLOR_BGR2GRAY)
    if output.pixels == "mono16":
        return np.left_shift(np.asarray(developed, np.uint16), _TO_16_BIT)
    return np.asarray(_gamma_table(sensor.gamma)[developed])


def hot_pixels(sensor: Sensor, shape: tuple[int, int], rng: np.random.Generator) -> tuple[Indices, Array]:
    """Rows and columns (2, K) of K pixels with a large dark current, and these currents (K,) in electrons a second."""
    at = rng.integers(0, np.array(shape)[:, None], (2, sensor.hot_pixels))
    low, high = np.log(sensor.hot_e_s).tolist()
    return at, np.exp(rng.uniform(low, high, sensor.hot_pixels))


def _gamma_table(gamma: float) -> np.ndarray:
    linear = np.arange(LEVELS + 1) / LEVELS
    return np.round(255.0 * linear ** (1.0 / gamma)).astype(np.uint8)
