"""The best model of each stretch between events, from all of its samples: only a recording has those that follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexmanip_ros.identification import decimation, model_output, rpbsid, validation
from flexmanip_ros.identification.batch_fit import fit_stretch
from flexmanip_ros.identification.uncertainty import Identified, modes
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.samples.sample_log import Signals, log_of
from flexmanip_ros.studies.holdout import HORIZON_S
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
    config = replace(config, estimator='factor', forgetting='innovation', forgetting_factor=(1.0,) * 3,
                     refinement='none', state_basis='fixed' if config.state_basis == 'fixed' else 'singular')
    log = log_of(u, y, stamp_ns=signals.stamp_ns[a:b], gap=gap)
    start_s, end_s = float(signals.time[a]), float(signals.time[b - 1])
    best, method, parts = None, 'none', _parts(config, u, y, gap)
    try:
        state = rpbsid.advance(config, rpbsid.init(config), log.rows(0, b - a))
        best = rpbsid.identified(config, state, dt)
        if best is not None:
            method, fitted = 'subspace', _fit(config, state, parts, b - a, dt)
            if fitted is not None and _left(fitted, parts) < _left(best, parts):
                best, method = fitted, 'maximum likelihood'
    except np.linalg.LinAlgError:
        best, method = None, 'none'
    if best is None:
        return Smoothed(start_s, end_s, b - a, method, Status.WARMING_UP, ())
    return Smoothed(start_s, end_s, b - a, method, best.status, modes(best))


def _parts(config: IdentifierParameters, u: Array, y: Array, gap: NDArray[np.bool_]) -> list[tuple[Array, Array]]:
    """Return inputs and outputs between gaps as the identifier sees them, the longest part first."""
    borders = [0, *(k for k in np.flatnonzero(gap).tolist() if k), len(u)]
    kept = [decimation.whole(np.hstack([u[a:b], y[a:b]]), config.decimation)[0] for a, b in pairwise(borders)]
    r = u.shape[1]
    return sorted(((part[:, :r], part[:, r:]) for part in kept), key=lambda part: -len(part[0]))


def _fit(config: IdentifierParameters, state: rpbsid.RpbsidState, parts: list[tuple[Array, Array]], count: int,
         dt: float) -> Identified | None:
    """Return the maximum-likelihood fit; None where it is too large, or no model simulates the stretch."""
    n, r, m = config.order, len(config.inputs), len(config.outputs)
    size = n * (n + r + 2 * m + 1) + m * r
    samples = np.hstack(parts[0])
    if len(samples) * config.decimation < WHOLE * count or len(samples) * m * size ** 2 > WORK:
        return None
    if len(samples) < 2 * size:
        return None
    realized, R, scale = model_output.from_factor(config, state.memory[0], state.scale)
    if realized is None:
        return None
    found = fit_stretch(samples, [realized], [], scale, config.direct_feedthrough, 'any')
    if found is None:
        return None
    d = R.shape[1] - r - m
    return model_output.from_fit(config, found, state.scalars, model_output.excitation(R[:d, :d]),
                                 dt * config.decimation)


def _left(found: Identified, parts: list[tuple[Array, Array]]) -> float:
    """Return the share of the outputs that a prediction ahead leaves unexplained in the longest part."""
    U, Y = parts[0]
    steps = max(1, round(HORIZON_S / found.model.dt))
    with np.errstate(all='ignore'):
        ahead = validation.predict_ahead(found.model, U, Y, steps)
    if len(ahead) < 2:
        return np.inf
    return 1.0 - float(np.nanmean(validation.vaf(Y[steps - 1:], ahead))) / 100.0
