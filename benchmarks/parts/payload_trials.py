"""What the payload benchmarks share: signals as samples, one followed capture, error and coverage of many."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from flexmanip_ros.parameters import ArmParameters, IdentifierParameters, PayloadParameters
from flexmanip_ros.payload import structured
from flexmanip_ros.samples.sample_log import Rows, log_of
from flexmanip_ros.types import CaptureEvent, EventKind, Payload, Status

BENDS = ('link1_bend/position', 'link2_bend/position')
RATES = ('link1_bend/velocity', 'link2_bend/velocity')


class Trial(NamedTuple):
    """What was claimed at each mark of one run, and the truth."""

    truth: float
    found: tuple[Payload, ...]


def configuration(
    arm: ArmParameters, outputs: tuple[str, ...] = BENDS + RATES, **payload: Any,
) -> IdentifierParameters:
    """Identifier parameters with the payload group set."""
    return IdentifierParameters(arm=arm, outputs=outputs, order=4, payload=PayloadParameters(**payload))


def as_samples(position: np.ndarray, velocity: np.ndarray, effort: np.ndarray, dt: float,
               outputs: tuple[str, ...] = BENDS + RATES) -> Rows:
    """Rows (N, 4) of joint1, joint2, link1_bend, link2_bend as rows of a sample log with these outputs."""
    parts = [position[:, 2:]] if BENDS[0] in outputs else []
    parts += [velocity[:, 2:]] if RATES[0] in outputs else []
    Y = np.hstack(parts)
    stamps = np.round(np.arange(len(Y)) * dt * 1e9).astype(np.int64)
    return log_of(effort[:, :2], Y, position[:, :2], stamps).rows(0, len(Y))


def follow(
    config: IdentifierParameters, samples: Rows, capture: int, marks: Sequence[int], truth: float, std_s: float = 0.0,
) -> Trial:
    """Run with the capture before sample ``capture``, known to std_s [s]; estimates after ``marks`` samples from it."""
    state = structured.advance(config, structured.init(config), samples.between(0, capture))
    state = structured.event(config, state, CaptureEvent(int(samples.stamp_ns[capture]), EventKind.CAPTURE, std_s))
    found, start = [], capture
    for mark in marks:
        state = structured.advance(config, state, samples.between(start, capture + mark))
        start = capture + mark
        found.append(structured.estimate(config, state))
    return Trial(truth, tuple(found))


def trusted_and_outside(found: Sequence[Payload], truth: float) -> tuple[float, float]:
    """Return the share of payloads that are TRACKING, and of those that are TRACKING without the truth [kg] inside."""
    trusted = np.array([one.status is Status.TRACKING for one in found])
    inside = np.array([one.lower <= truth <= one.upper for one in found])
    return float(np.mean(trusted)), float(np.mean(trusted & ~inside))


def judged(found: Sequence[Payload], truth: float) -> dict[str, Any]:
    """Return what the payloads of one run say of the true mass [kg]: shares of all of them, and the last one."""
    last, (tracking, wrong) = found[-1], trusted_and_outside(found, truth)
    return {'tracking': tracking, 'wrong': wrong,
            'status': last.status.value, 'inside': last.lower <= truth <= last.upper,
            'error_percent': round(100.0 * (last.mass / truth - 1.0), 3),
            'half_width_percent': round(50.0 * min(last.upper - last.lower, 1e6) / truth, 3)}


def errors(trials: Sequence[Trial]) -> np.ndarray:
    """Relative errors in percent, (trials, marks)."""
    return np.array([[100 * (one.mass / trial.truth - 1) for one in trial.found] for trial in trials])


def coverage(trials: Sequence[Trial]) -> np.ndarray:
    """Share of runs with the truth inside the 95 % interval, (marks,)."""
    inside = [[one.lower <= trial.truth <= one.upper for one in trial.found] for trial in trials]
    return np.asarray(np.mean(inside, axis=0))


def widths(trials: Sequence[Trial]) -> np.ndarray:
    """Median half width of the interval in percent, (marks,)."""
    half = [[50 * (one.upper - one.lower) / trial.truth for one in trial.found] for trial in trials]
    return np.asarray(np.median(half, axis=0))


def rms(values: np.ndarray) -> np.ndarray:
    """Root mean square over the runs."""
    return np.asarray(np.sqrt(np.mean(values ** 2, axis=0)))


def numbers(values: Any, digits: int = 4) -> list[float]:
    """Rounded, for tables and JSON."""
    return [round(float(value), digits) for value in np.atleast_1d(values)]
