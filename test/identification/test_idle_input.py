"""An input that is zero for a while is neither learned nor in the way; it is learned once it acts."""

from __future__ import annotations

import numpy as np
import pytest
from linear_arm import Run, configuration, identified, start

from flexmanip_ros.identification.realization import markov
from flexmanip_ros.identification.validation import simulate
from flexmanip_ros.types import Array, StateSpace, Status

MS = 1_000_000
COUNT, ACTS_FROM = 5000, 3000


def machine(outputs: int) -> StateSpace:
    """Two modes of 5 and 9 Hz at 1 kHz, which both inputs drive and each output sees."""
    rng = np.random.default_rng(0)
    poles = np.exp((-0.02 + 1j) * 2.0 * np.pi * np.array([5.0, 9.0]) * 1e-3)
    A = np.zeros((4, 4))
    for k, pole in enumerate(poles):
        A[2 * k:2 * k + 2, 2 * k:2 * k + 2] = [[pole.real, -pole.imag], [pole.imag, pole.real]]
    return StateSpace(A, rng.standard_normal((4, 2)), rng.standard_normal((outputs, 4)), np.zeros((outputs, 2)),
                      np.zeros((4, outputs)), 1e-3)


def errors(found: StateSpace, plant: StateSpace) -> Array:
    """Relative error of the response to each input."""
    response, known = markov(found, 150), markov(plant, 150)
    return np.linalg.norm(response - known, axis=(0, 1)) / np.linalg.norm(known, axis=(0, 1))


def fed(outputs: int, until: int) -> Run:
    rng = np.random.default_rng(1)
    u = np.repeat(rng.standard_normal((COUNT // 50, 2)), 50, axis=0)
    u[:ACTS_FROM, 1] = 0.0
    y = simulate(machine(outputs), u)
    y += 0.01 * np.std(y, axis=0) * rng.standard_normal(y.shape)
    return start(configuration(2, outputs, order=4)).feed(u[:until], y[:until], MS * np.arange(until))


@pytest.mark.parametrize('outputs', [2, 4])
@pytest.mark.parametrize('until', [1000, 2000, 3000])
def test_the_effect_of_an_idle_input_is_unknown_and_the_rest_is_right(outputs: int, until: int) -> None:
    run = fed(outputs, until)
    found = identified(run.config, run.state, 1e-3)
    assert found.refined
    assert found.status is Status.TRACKING
    assert errors(found.model, machine(outputs))[0] < 0.01
    of_idle = np.arange(16, 24).reshape(4, 2)[:, 1]  # rows of the spread: A, then B
    deviation = np.linalg.norm(found.spread[of_idle], axis=1)
    assert np.all(np.abs(found.model.B[:, 1]) < 1e-3 * deviation)
    assert np.all(errors(found.model, machine(outputs))[1] < 2.0)


@pytest.mark.parametrize('outputs', [2, 4])
def test_an_input_that_begins_to_act_is_learned(outputs: int) -> None:
    run = fed(outputs, COUNT)
    found = identified(run.config, run.state, 1e-3)
    assert found.refined
    assert np.all(errors(found.model, machine(outputs)) < 0.02)
