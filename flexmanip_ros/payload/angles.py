"""From measured joint angles to the chords that the block matrices are written in."""

from __future__ import annotations

import numpy as np

from flexmanip_ros.parameters import ArmParameters
from flexmanip_ros.types import Array


def chords(arm: ArmParameters, angles: Array) -> Array:
    """Return absolute chord angles (2,) [rad] of measured ones (2,).

    An encoder reads root slopes on top: some milliradians that swing about zero with the vibration, so
    they are left out at a working point (give averaged angles where that matters). ``structured`` keeps them.
    """
    if arm.angle_convention == 'chord':
        return np.asarray(angles, dtype=np.float64)
    return np.array([angles[0], angles[0] + angles[1]])
