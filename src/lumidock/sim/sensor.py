"""The sensor: electrons on the mosaic -> an 8-bit colour picture."""

from __future__ import annotations

import cv2
import numpy as np

from lumidock.datatypes import Array, Image
from lumidock.sim.scenario import Sensor

_LEVELS = 4095  # 12 bit


def picture(electrons: Array, sensor: Sensor, rng: np.random.Generator) -> Image:
    """BGR picture (H, W, 3) of expected electrons (H, W) on an RGGB mosaic.

    Shot noise (Gaussian limit) and read noise, full well, 12 bit, demosaicing, gamma. Source: EMVA 1288 camera model.
    """
    levels = rng.standard_normal(electrons.shape, np.float32)  # in place from here on: noise, electrons, levels
    levels *= np.sqrt(electrons + np.float32(sensor.read_noise_e**2))
    levels += electrons
    levels *= np.float32(_LEVELS / sensor.full_well_e)
    raw = np.clip(np.rint(levels, out=levels), 0, _LEVELS).astype(np.uint16)
    bgr = cv2.demosaicing(raw, cv2.COLOR_BayerRGGB2BGR)
    return np.asarray(_gamma_table(sensor.gamma)[bgr])


def _gamma_table(gamma: float) -> Image:
    linear = np.arange(_LEVELS + 1) / _LEVELS
    return np.round(255.0 * linear ** (1.0 / gamma)).astype(np.uint8)
