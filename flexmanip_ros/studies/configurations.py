"""Frequencies over configurations: what a model of every configuration says of those ahead of a move."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from flexmanip_ros import pipeline
from flexmanip_ros.identification import rpbsid
from flexmanip_ros.identification.uncertainty import modes
from flexmanip_ros.identification.varying_model import Configurations
from flexmanip_ros.samples.signals import relative_angle
from flexmanip_ros.types import Array

STEP_DEG = 2.5
"""Between two configurations [degrees]."""


class Sweep(NamedTuple):
    """Modes at each angle between the links, NaN where one is not there. They are the same to either side.

    relative: (N,) [rad]; frequency, std: (N, k) [Hz]; damping: (N, k); seen: (2,) smallest and largest angle between
    the links since the last event [rad].
    """

    relative: Array
    frequency: Array
    std: Array
    damping: Array
    seen: Array

    def rows(self) -> list[dict[str, Any]]:
        """Return one row a configuration, as a table has them."""
        found = []
        for k, angle in enumerate(self.relative):
            row: dict[str, Any] = {'relative_angle_deg': float(np.degrees(angle)),
                                   'seen': int(self.seen[0] <= angle <= self.seen[1])}
            for i in range(self.frequency.shape[1]):
                for name, table in ((f'frequency{i + 1}_hz', self.frequency), (f'frequency{i + 1}_std_hz', self.std),
                                    (f'damping{i + 1}_ratio', self.damping)):
                    row[name] = float(table[k, i]) if np.isfinite(table[k, i]) else None
            found.append(row)
        return found


def sweep(state: pipeline.State, angles: Array) -> Sweep | None:
    """Ask the model for every angle between the links; None where it holds at one configuration only.

    state: at the end of a recording; angles: (N, 2) measured ones since the last event [rad].
    """
    config, identifier = state.config, state.identifier
    if config is None or identifier is None or not len(angles):
        return None
    last = rpbsid.finish(config, identifier.estimator.rpbsid)
    found = rpbsid.identified(config, last, state.clock.dt)
    if found is None or not isinstance(found.configurations, Configurations):
        return None
    relative = np.radians(np.arange(0.0, 180.0 + STEP_DEG, STEP_DEG))
    count = config.order // 2
    table = np.full((len(relative), count, 3), np.nan)
    for k, angle in enumerate(relative):
        for i, mode in enumerate(modes(found.configurations.with_relative(float(angle)))[:count]):
            table[k, i] = mode.frequency_hz, mode.frequency_std_hz, mode.damping_ratio
    seen = np.arccos(np.cos(relative_angle(config, angles)))
    return Sweep(relative, table[:, :, 0], table[:, :, 1], table[:, :, 2], np.array([seen.min(), seen.max()]))
