"""A model is judged by what it predicts of the last samples, and by its frequencies in them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from flexmanip_ros import estimator
from flexmanip_ros.identification import prediction_check, validation
from flexmanip_ros.identification.realization import to_discrete
from flexmanip_ros.identification.uncertainty import Identified, modes
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.samples.sample_log import log_of
from flexmanip_ros.types import Array, StateSpace, Status

KNOWN = 1e-6 * np.eye(44, 1)
"""A spread in which every frequency is known well."""


def torques(steps: int = 15) -> Array:
    """(N, 2) torques that change every 100 samples."""
    return np.repeat(np.random.default_rng(0).standard_normal((steps, 2)), 100, axis=0)


def two_modes(first: float, second: float, damping: float = 0.005) -> StateSpace:
    """Two modes [Hz] that two displacements see; damping: damping ratio of the second mode."""
    A, B = np.zeros((4, 4)), np.zeros((4, 2))
    for i, (frequency, ratio) in enumerate(((first, 0.005), (second, damping))):
        at = slice(2 * i, 2 * i + 2)
        A[at, at] = [[0.0, 1.0], [-(2.0 * np.pi * frequency) ** 2, -2.0 * ratio * 2.0 * np.pi * frequency]]
        B[2 * i + 1] = [1.0, -0.7 + i]
    return StateSpace(*to_discrete(A, B, 1e-3), np.array([[1.0, 0.0, 0.6, 0.0], [-0.8, 0.0, 1.0, 0.0]]),
                      np.zeros((2, 2)), np.zeros((4, 2)), 1e-3)


def measured(model: StateSpace, u: Array) -> Array:
    """What the model does under torques (N, 2), with 2 % of noise."""
    y = validation.simulate(model, u)
    return y + 0.02 * y.std(axis=0) * np.random.default_rng(1).standard_normal(y.shape)


def tracking(model: StateSpace, samples: float, spread: Array = KNOWN) -> Identified:
    return Identified(model, spread, np.ones(4), 1.0, 1.0, 1.0, Status.TRACKING, samples=samples)


def judged(found: Identified, u: Array, y: Array, bends: int = 0, turned: float = 0.0, since: float = 0.0,
           missing: Array | None = None) -> Identified:
    rows = log_of(u, y, missing=missing).rows(0, len(u))
    return prediction_check.judged(found, rows, ('a/position', 'b/position'), bends, turned, since)


@pytest.mark.parametrize('lost', [False, True])
def test_a_frequency_that_is_three_per_cent_off_is_found_out_though_it_predicts(lost: bool) -> None:
    u = torques()
    y, every = measured(two_modes(5.6, 6.1), u), np.ones(len(u), dtype=np.bool_)
    seen = np.random.default_rng(2).random(len(u)) > 0.05 if lost else every
    for frequencies in ((5.6, 6.1), (5.6 * 1.03, 6.1), (5.6, 6.1 * 0.97)):
        model = two_modes(*frequencies)
        error, chance = prediction_check.frequency_errors(model, u, y, 250, seen)
        known = np.array([5.6, 6.1]) / frequencies - 1.0
        assert np.all(np.abs(error - known) < 0.006)
        assert np.all(chance < 0.0102)
        assert np.nanmax(prediction_check.missed(model, u, y, 250, every)) < prediction_check.MISSED
        said = judged(tracking(model, 0.0, np.zeros((44, 1))), u, y).status
        assert said is (Status.TRACKING if frequencies == (5.6, 6.1) else Status.INCONSISTENT)


def test_two_modes_that_a_fit_of_three_periods_takes_for_one_are_not_tracking() -> None:
    u, right = torques(6), two_modes(5.6, 6.1)
    for model, said in ((right, Status.TRACKING), (two_modes(5.8, 50.0), Status.WARMING_UP)):
        found = judged(tracking(model, 512.0), u, measured(right, u))
        assert found.status is said
        assert (found.spread is KNOWN) == (said is Status.TRACKING)  # white noise widens nothing


def test_a_frequency_that_is_not_known_to_one_per_cent_is_not_tracking() -> None:
    u, model = torques(), two_modes(5.6, 6.1)
    y, along = measured(model, u), np.eye(44, 1)
    largest = max(mode.frequency_std_hz / mode.frequency_hz for mode in modes(tracking(model, 1e4, along)))
    late, early = (judged(tracking(model, samples, 0.02 / largest * along), u, y) for samples in (1e4, 1000.0))
    assert late.status is Status.POORLY_EXCITED
    assert late.reason.startswith('the frequency of the mode at ')
    assert early.status is Status.WARMING_UP


def test_a_mode_that_stays_uncertain_is_said_after_as_many_seconds_at_any_sample_rate() -> None:
    for dt in (1e-4, 1e-3, 2e-2):
        found = tracking(replace(two_modes(5.6, 6.1), dt=dt), 3.9 / dt)
        assert prediction_check.is_early(found, 0.0)
        assert not prediction_check.is_early(found, 4.1 / dt)


@pytest.mark.parametrize(('deviation', 'said'), [(0.06, Status.TRACKING), (0.12, Status.POORLY_EXCITED)])
def test_a_damped_mode_is_tracking_only_if_its_damping_ratio_is_known(deviation: float, said: Status) -> None:
    u, model, along = torques(), two_modes(5.6, 6.1, damping=0.5), np.zeros((44, 1))
    y, along[15] = measured(model, u), 1.0  # the damping of the second mode
    light, damped = sorted(modes(tracking(model, 1e4, along)), key=lambda mode: mode.damping_ratio)
    assert light.frequency_std_hz < 1e-9
    late, early = (tracking(model, samples, deviation / damped.damping_ratio_std * along) for samples in (1e4, 1000.0))
    assert judged(late, u, y).status is said
    assert judged(early, u, y).status is (said if said is Status.TRACKING else Status.WARMING_UP)
    assert judged(early, u, y, since=9000.0).status is said  # it is no longer warming up: no later sample told anything


@pytest.mark.parametrize(('ratio', 'said'), [(-0.034, Status.INCONSISTENT), (-0.02, Status.TRACKING)])
def test_a_mode_that_gains_energy_beyond_four_deviations_is_none_of_an_arm(ratio: float, said: Status) -> None:
    u, model, along = torques(), two_modes(5.6, 6.1, damping=ratio), np.zeros((44, 1))
    along[15] = 1.0  # the damping of the second mode
    growing = min(modes(tracking(model, 1e4, along)), key=lambda mode: mode.damping_ratio)
    found = judged(tracking(model, 1e4, 0.006 / growing.damping_ratio_std * along), u, measured(model, u))
    assert found.status is said
    assert ('gains no energy' in found.reason) == (said is Status.INCONSISTENT)


def test_a_mode_that_the_last_samples_do_not_show_is_not_tracking() -> None:
    u, model = torques(), two_modes(5.6, 8.2, damping=0.28)
    model = replace(model, C=model.C * [1.0, 1.0, 0.002, 0.002])
    y = measured(model, u)
    error, chance = prediction_check.frequency_errors(model, u, y, 250, np.ones(len(u), dtype=np.bool_))
    assert np.all(np.abs(error) - chance < prediction_check.OFF)  # so nothing speaks against the frequencies
    assert chance[0] < 0.01
    assert chance[1] > 0.2
    for samples, said in ((1000.0, Status.WARMING_UP), (1e4, Status.POORLY_EXCITED)):
        assert judged(tracking(model, samples), u, y).status is said


def test_a_frequency_error_that_the_last_samples_show_is_within_the_band() -> None:
    u = torques()
    found = judged(tracking(two_modes(5.6, 6.1 * 1.012), 512.0), u, measured(two_modes(5.6, 6.1), u))
    assert found.status is Status.TRACKING
    for mode, known in zip(modes(found), (5.6, 6.1), strict=True):
        assert abs(mode.frequency_hz - known) < 1.96 * mode.frequency_std_hz < 0.02 * known


@pytest.mark.parametrize(('damping', 'bends', 'turned', 'said'), [
    (0.005, 2, 0.1, Status.TRACKING), (0.005, 2, 0.3, Status.POORLY_EXCITED), (0.005, 0, 0.3, Status.TRACKING),
    (0.5, 2, 0.1, Status.POORLY_EXCITED), (0.5, 0, 0.1, Status.TRACKING)])
def test_a_model_of_one_configuration_shows_each_bend_s_mode_and_holds_until_the_arm_turns(
        damping: float, bends: int, turned: float, said: Status) -> None:
    u, model = torques(), two_modes(5.6, 6.1, damping)
    assert judged(tracking(model, 1e4), u, measured(model, u), bends, turned).status is said


def test_the_bands_of_an_arm_that_turns_hold_what_the_frequencies_change_from_its_mean_configuration_on() -> None:
    """A drift of 0.05 rad changes a frequency by 0.5 % (rms); the last samples do not show so little."""
    u, model = torques(), two_modes(5.6, 6.1)
    rows = log_of(u, measured(model, u)).rows(0, len(u))
    rests, drifts = (modes(prediction_check.judged(
        tracking(model, 1e4), rows, ('a/position', 'b/position'), 2, 0.1, drift=drift)) for drift in (0.0, -0.05))
    for mode, before in zip(drifts, rests, strict=True):
        more = math.sqrt(mode.frequency_std_hz ** 2 - before.frequency_std_hz ** 2)
        assert more == pytest.approx(0.005 * mode.frequency_hz, rel=0.01)


def test_the_drift_is_the_mean_of_the_latest_angles_less_that_of_all() -> None:
    """However many rows come at once; angles that were not measured do not count."""
    config, steps = IdentifierParameters(), 1000
    angles = np.column_stack([np.ones(steps), np.random.default_rng(3).normal(0.3, 0.1, steps)])
    angles[::7] = np.nan
    rows = log_of(np.zeros((steps, 2)), np.zeros((steps, 4)), angles).rows(0, steps)
    whole = estimator.extended(config, np.empty(0), rows)
    part = estimator.extended(config, np.empty(0), rows.between(0, 123))
    np.testing.assert_array_equal(estimator.extended(config, part, rows.since(123)), whole)
    turned, drift = estimator.turning(config, whole, rows.since(900))
    assert turned == np.nanmax(angles[:, 1]) - np.nanmin(angles[:, 1])
    assert drift == pytest.approx(np.nanmean(angles[900:, 1]) - np.nanmean(angles[:, 1]), rel=1e-9)
    assert estimator.turning(config, np.empty(0), rows) == (0.0, 0.0)


def test_samples_that_show_no_frequency_leave_the_band_of_a_model_as_it_is() -> None:
    u, model = torques(), two_modes(5.6, 6.1)
    y, missing = measured(model, u), np.zeros(len(u), dtype=np.int64)
    missing[:len(u) // 2 + 250] = 1  # two stretches of 250 samples are left, and three are needed
    assert np.isnan(prediction_check.frequency_errors(model, u, y, 250, missing == 0)[0]).all()
    assert np.isfinite(judged(tracking(model, 1e4), u, y, 2, 0.1, missing=missing).spread).all()
