"""The regressors of a record: past windows stacked as the recursion stacks them."""

from __future__ import annotations

import numpy as np

from flexmanip_ros.types import Array


def past_windows(U: Array, Y: Array, p: int) -> Array:
    """(N - p + 1, p (r + m)): row k holds [u; y] of samples k..k+p-1, oldest first (eqs. 24-25).

    The last row is the window after the last sample.
    """
    joint = np.hstack([U, Y])
    count = max(joint.shape[0] - p + 1, 0)
    columns = [joint[i:i + count] for i in range(p)]
    return np.hstack(columns) if columns else np.zeros((count, 0))
