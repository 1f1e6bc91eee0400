"""Scores on the part of a recording that was not identified on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flexmanip_ros import pipeline
from flexmanip_ros.arm.capture import free_object
from flexmanip_ros.arm.linearization import vibration_model
from flexmanip_ros.errors import ModelError, ParameterError
from flexmanip_ros.parameters import ExcitationParameters, IdentifierParameters, PlantParameters, configure
from flexmanip_ros.samples.sample_log import Signals
from flexmanip_ros.samples.sampling import collect
from flexmanip_ros.samples.signals import relative_angle
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.studies.whole_recording import score, smooth, sweep
from flexmanip_ros.types import CaptureEvent, EventKind, JointRecord, StateSpace, Status

DT = 0.01


def _system() -> StateSpace:
    A = np.array([[0.9, 0.3], [-0.3, 0.9]])
    B, C = np.array([[0.5], [1.0]]), np.array([[1.0, 0.2]])
    return StateSpace(A, B, C, np.zeros((1, 1)), np.zeros((2, 1)), DT)


def _signals(noise: float = 0.0, gap_at: int | None = None, count: int = 800) -> Signals:
    rng = np.random.default_rng(2)
    model, x = _system(), np.zeros(2)
    u, y = rng.normal(size=(count, 1)), np.empty((count, 1))
    for k in range(count):
        y[k] = model.C @ x + noise * rng.normal()
        x = model.A @ x + model.B @ u[k]
    gap = np.zeros(count, dtype=np.bool_)
    if gap_at is not None:
        gap[gap_at] = True
    stamps = np.arange(count, dtype=np.int64) * 10_000_000
    return Signals(stamps, u, y, np.empty((count, 0)), gap, np.zeros(count, int), ('a/effort',), ('a/position',))


def test_the_true_model_scores_a_hundred_percent():
    found = score(_system(), _signals(), 4.0)
    assert found.simulation == pytest.approx([100.0])
    assert found.prediction == pytest.approx([100.0])
    assert found.time[0] == pytest.approx(4.0)
    assert not found.until_gap


def test_a_prediction_ahead_uses_no_output_in_between():
    signals, steps = _signals(noise=0.3), 25
    known = _signals().y[:, 0]
    found = score(_system(), signals, 4.0, horizon_s=steps * DT)
    expected = 100.0 * (1.0 - np.var(signals.y[424:, 0] - known[424:]) / np.var(signals.y[424:]))
    assert found.horizon == pytest.approx([expected], abs=0.5)


def test_one_step_ahead_is_the_prediction():
    signals, model = _signals(noise=0.3), _system()
    model = StateSpace(model.A, model.B, model.C, model.D, np.array([[0.2], [0.1]]), DT)
    found = score(model, signals, 4.0, horizon_s=DT)
    assert found.horizon == pytest.approx(found.prediction)


def test_a_horizon_beyond_the_recording_has_no_score():
    assert np.isnan(score(_system(), _signals(), 4.0, horizon_s=100.0).horizon).all()


def test_a_decimated_model_is_scored_at_its_own_rate():
    """A slow plant, excited slowly: every fifth sample tells it all, and the model steps five sample times."""
    rng = np.random.default_rng(4)
    u = np.repeat(rng.normal(size=(80, 1)), 20, axis=0)
    pole, y = 0.99, np.zeros((1600, 1))
    for k in range(1, 1600):
        y[k] = pole * y[k - 1] + u[k - 1]
    signals = Signals(np.arange(1600) * 10_000_000, u, y, np.empty((1600, 0)), np.zeros(1600, dtype=np.bool_),
                      np.zeros(1600, dtype=int), ('a/effort',), ('a/position',))
    slow = StateSpace(np.array([[pole ** 5]]), np.array([[(1.0 - pole ** 5) / (1.0 - pole)]]), np.eye(1),
                      np.zeros((1, 1)), np.zeros((1, 1)), 5 * DT)
    found = score(slow, signals, 8.0, factor=5)
    assert min(found.simulation[0], found.prediction[0], found.horizon[0]) > 98.0
    assert np.diff(found.time) == pytest.approx(5 * DT)
    assert found.time[0] == pytest.approx(8.0 - 4 * 5 * DT, abs=5 * DT)


def test_noise_costs_what_its_variance_is():
    signals = _signals(noise=0.3)
    expected = 100.0 * (1.0 - 0.09 / np.var(signals.y[400:]))
    assert score(_system(), signals, 4.0).simulation == pytest.approx([expected], abs=2.0)


def test_the_score_ends_at_a_gap_and_says_so():
    found = score(_system(), _signals(gap_at=600), 4.0)
    assert found.time.size == 200
    assert found.until_gap


def test_an_unstable_model_scores_zero():
    model = _system()
    wild = StateSpace(2.0 * model.A, model.B, model.C, model.D, model.K, DT)
    assert score(wild, _signals(), 4.0).simulation == pytest.approx([0.0])


@pytest.mark.parametrize('start', [0.0, 8.0, -1.0, 1e9, float('nan')])
def test_nothing_to_score_is_said(start):
    with pytest.raises(ParameterError, match='leaves no samples'):
        score(_system(), _signals(), start)


def test_a_missing_model_is_said():
    with pytest.raises(ModelError, match='no model'):
        score(None, _signals(), 4.0)


def test_what_never_came_is_not_scored():
    signals = _signals(noise=0.3)
    absent = np.zeros(800, dtype=np.int64)
    absent[450:780:7] = 1
    y = signals.y.copy()
    y[absent > 0] = 1e6
    plain = score(_system(), signals, 4.0).simulation
    found = score(_system(), replace(signals, y=y, missing=absent), 4.0).simulation
    assert found == pytest.approx(plain, abs=1.0)


def test_what_never_came_moves_no_fit_of_the_whole_recording():
    config = configure(IdentifierParameters, {
        'payload_method': 'none', 'inputs': ['a/effort'], 'outputs': ['a/position'], 'order': 2})
    signals = _signals(noise=0.05, count=3000)
    absent = np.zeros(3000, dtype=np.int64)
    absent[100:2900:9] = 1
    found = {}
    for wrong in (1e-3, 1.0):
        y = signals.y.copy()
        y[absent > 0] += wrong
        (found[wrong],) = smooth(config, replace(signals, y=y, missing=absent), [], DT)
    assert found[1.0].method == 'maximum likelihood'
    assert found[1.0].modes[0].frequency_hz == pytest.approx(found[1e-3].modes[0].frequency_hz, rel=1e-3)


def test_dead_sensors_of_an_arm_with_angles_give_no_model_and_no_error():
    config = configure(IdentifierParameters, {
        'payload_method': 'none', 'inputs': ['a/effort'], 'outputs': ['b/position'],
        'angles': ['a/position', 'c/position'], 'order': 2})
    signals = _signals(noise=0.05, count=1500)
    angles = np.column_stack([np.zeros(1500), np.linspace(0.0, 1.0, 1500)])
    (found,) = smooth(config, replace(signals, y=np.zeros_like(signals.y), angles=angles), [], DT)
    assert found.method == 'none'
    names = ('a', 'b', 'c')
    records = [JointRecord(int(stamp), names, np.array([one, 0.0, other]), np.empty(0), np.array([u, 0.0, 0.0]))
               for stamp, (one, other), (u,) in zip(signals.stamp_ns, angles, signals.u, strict=True)]
    *_, last = pipeline.absorb(config, records)
    assert sweep(last, angles) is None


@pytest.mark.parametrize(('faster', 'status'), [(1.0, {Status.TRACKING}),
                                                (1.5, {Status.INCONSISTENT, Status.POORLY_EXCITED})])
def test_a_stretch_in_which_the_machine_changes_is_not_smoothed_as_tracking(faster, status):
    config = configure(IdentifierParameters, {
        'payload_method': 'none', 'inputs': ['a/effort'], 'outputs': ['a/position'], 'order': 2})
    pole, signals = 0.98 * np.exp(0.15j), _signals(count=2000)
    y, x = np.empty((2000, 1)), np.zeros(2)
    for k in range(2000):
        now = pole if k < 1000 else 0.98 * (pole / abs(pole)) ** faster
        y[k] = x[0]
        x = np.array([[now.real, -now.imag], [now.imag, now.real]]) @ x + np.array([0.5, 1.0]) * signals.u[k]
    y += 0.01 * np.std(y) * np.random.default_rng(3).normal(size=y.shape)
    (found,) = smooth(config, replace(signals, y=y), [], DT)
    assert found.status in status


def test_what_a_drifting_frequency_adds_to_the_damping_of_a_stretch_is_within_its_band():
    """The links turn by 0.05 rad: as f2 drifts by 1 %, the fit reads its damping as 0.0055, where it is 0.0033."""
    config = configure(IdentifierParameters, {'arm.damping_ratio': 0.003})
    plant = configure(PlantParameters, {
        'arm.damping_ratio': 0.003, 'payload_mass': 24.0, 'payload_com': [0.12, 0.05], 'payload_inertia': 0.8,
        'seed': 1})
    events = [CaptureEvent(3_000_000_000, EventKind.CAPTURE)]
    trajectory = simulator.simulate(plant, excitation.sequence(ExcitationParameters(), 6000), events)
    signals = collect(config, list(simulator.records(trajectory, events)))
    found = smooth(config, signals, [events[0].stamp_ns], 1e-3)[1]
    assert (found.method, found.status) == ('maximum likelihood', Status.TRACKING)
    relative = float(relative_angle(config, signals.angles[3000:]).mean())
    Ac, _ = vibration_model(plant.arm, np.array([0.0, relative]), free_object(plant).payload)
    poles = np.linalg.eigvals(Ac)
    for mode, pole in zip(found.modes, sorted(poles[poles.imag > 0.0], key=np.imag), strict=False):
        assert abs(mode.frequency_hz - pole.imag / (2.0 * np.pi)) < 1.96 * mode.frequency_std_hz
        assert abs(mode.damping_ratio + pole.real / abs(pole)) < 1.96 * mode.damping_ratio_std
        assert mode.frequency_std_hz < 0.005 * mode.frequency_hz
