"""The shape of the bent arm in the plane, as a viewer draws it: from measured angles and bends alone."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from flexmanip_ros.parameters import ArmParameters
from flexmanip_ros.types import Array

POINTS = 13
"""Points of each link."""


class Drawing(NamedTuple):
    """The L links in the frame of the base, joint 1 at its origin."""

    links: Array
    """(L, N, 2) points of each link from root to tip [m]."""
    tip_angle: float
    """Direction of the tip of the last link [rad]: the x axis of the frame of the payload."""


def draw(arm: ArmParameters, angles: Array, bends: Array, points: int = POINTS) -> Drawing:
    """Return the arm at joint angles (L,) [rad] and deflections of the bend sensors (L,) [m].

    The deflection from the chord is that of the first shape function, w(x) = b sin(pi x / L) / sin(pi s) with the
    sensor at s L. An encoder reads the slope of the root: of link 1 from the base, of link 2 from the tip of link 1.
    """
    x = np.linspace(0.0, 1.0, points)
    links = np.empty((len(arm.link_length), points, 2))
    root = np.zeros(2)
    tip = 0.0
    for k, L in enumerate(arm.link_length):
        amplitude = float(bends[k]) / np.sin(np.pi * arm.sensor_position[k])
        slope = float(np.arctan(np.pi * amplitude / L))  # of the root from the chord; of the tip with the other sign
        chord = float(angles[k]) if arm.angle_convention == 'chord' else tip + float(angles[k]) - slope
        c, s = np.cos(chord), np.sin(chord)
        w = amplitude * np.sin(np.pi * x)
        links[k, :, 0] = root[0] + c * L * x - s * w
        links[k, :, 1] = root[1] + s * L * x + c * w
        root, tip = links[k, -1], chord - slope
    return Drawing(links, tip)
