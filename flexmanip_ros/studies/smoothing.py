"""The best model of each stretch between events, from all of its samples: only a recording has those that follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexmanip_ros.identification import decimation, model_output, rpbsid
from flexmanip_ros.identification.batch_fit import fit_stretch
from flexmanip_ros.identification.uncertainty import Identified, modes
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.samples.sample_log import Signals, log_of
from flexmanip_ros.types import Array, Mode, Status

WORK = 2e9
"""Samples x outputs x squared parameters above which an iteration of the fit takes more than about a second."""
WHOLE = 0.8
"""Share of a stretch that its longest part without a gap must hold, for a fit of that part to stand for it."""


@dataclass(frozen=True)
class Smoothed:
    """The model of a stretch of samples, times from the first stamp of the recording [s].

    method: ``maximum likelihood``, ``subspace``, or ``none`` where there is no model.
    """

    start_s: float
    end_s: float
    samples: int
    method: str
    status: Status
    modes: tuple[Mode, ...]

    def as_json(self) -> dict[str, Any]:
        """Return the values by the names that the JSON of identify_bag has."""
        return {
            'start_s': self.start_s, 'end_s': self.end_s, 'samples': self.samples, 'method': self.method,
            'status': self.status.name,
            'frequencies_hz': tuple(mode.frequency_hz for mode in self.modes),
            'frequencies_std_hz': tuple(mode.frequency_std_hz for mode in self.modes),
            'damping_ratios': tuple(mode.damping_ratio for mode in self.modes),
            'damping_ratios_std': tuple(mode.damping_ratio_std for mode in self.modes)}


def smooth(config: IdentifierParameters, signals: Signals, events_ns: Sequence[int], dt: float,
           until_s: float | None = None) -> tuple[Smoothed, ...]:
    """Fit each stretch between events with all of its samples.

    events_ns: stamps of the events; dt: sample time [s]; until_s: later samples are left out [s].
    """
    count = len(signals.stamp_ns) if until_s is None else int(np.searchsorted(signals.time, until_s))
    inside = np.searchsorted(signals.stamp_ns[:count], sorted(events_ns)).tolist()
    borders = list(dict.fromkeys([0, *inside, count]))
    return tuple(_stretch(config, signals, a, b, dt) for a, b in pairwise(borders))


def _stretch(config: IdentifierParameters, signals: Signals, a: int, b: int, dt: float) -> Smoothed:
    u, y, gap = signals.u[a:b], signals.y[a:b], signals.gap[a:b]
    noise = 'sensor' if config.refinement == 'output_error' else 'any'
    config = replace(config, estimator='factor', forgetting='innovation', forgetting_factor=(1.0,) * 3,
                     refinement='none', state_basis='fixed' if config.state_basis == 'fixed' else 'singular')
    log = log_of(u, y, stamp_ns=signals.stamp_ns[a:b], gap=gap)
    found, method = None, 'none'
    try:
        state = rpbsid.advance(config, rpbsid.init(config), log.rows(0, b - a))
        found = _fit(config, state, _longest(config, u, y, gap), noise, b - a, dt)
        method = 'maximum likelihood'
        if found is None:
            found, method = rpbsid.identified(config, state, dt), 'subspace'
    except np.linalg.LinAlgError:
        found = None
    start_s, end_s = float(signals.time[a]), float(signals.time[b - 1])
    if found is None:
        return Smoothed(start_s, end_s, b - a, 'none', Status.WARMING_UP, ())
    return Smoothed(start_s, end_s, b - a, method, found.status, modes(found))


def _longest(config: IdentifierParameters, u: Array, y: Array, gap: NDArray[np.bool_]) -> Array:
    """Return inputs and outputs (N, r + m) of the longest part without a gap, as the identifier sees them."""
    borders = [0, *(k for k in np.flatnonzero(gap).tolist() if k), len(u)]
    a, b = max(pairwise(borders), key=lambda part: part[1] - part[0])
    return decimation.whole(np.hstack([u[a:b], y[a:b]]), config.decimation)[0]


def _fit(config: IdentifierParameters, state: rpbsid.RpbsidState, samples: Array, noise: str, count: int, dt: float
         ) -> Identified | None:
    """Return the maximum-likelihood fit; None where it would take too long, or no model simulates the stretch."""
    n, r, m = config.order, len(config.inputs), len(config.outputs)
    size = n * (n + r + 2 * m + 1) + m * r
    if len(samples) * config.decimation < WHOLE * count or not 2 * size < len(samples) < WORK / (m * size ** 2):
        return None
    starts = [model_output.from_factor(config, state.memory[0], state.scale)]
    if n > m and config.past_window > config.future_window:
        longer = replace(config, future_window=config.past_window)
        starts.append(model_output.from_factor(longer, state.memory[0], state.scale))
    fit = fit_stretch(samples, [realized for realized, _, _ in starts if realized is not None], [], starts[0][2],
                      config.direct_feedthrough, noise)
    if fit is None:
        return None
    d = state.memory[4].shape[1]
    return model_output.from_fit(config, fit, state.scalars, model_output.excitation(state.memory[0][:d, :d]),
                                 dt * config.decimation)
