"""At a few samples a second a model is judged as well: by as many samples as its order needs."""

from __future__ import annotations

import numpy as np
import pytest
from linear_arm import configuration

from flexmanip_ros import pipeline
from flexmanip_ros.identification.validation import simulate
from flexmanip_ros.types import JointRecord, StateSpace, Status

COUNT, CHANGE = 720, 640


@pytest.mark.parametrize('rate', [10.0, 20.0])
def test_a_machine_that_has_become_another_one_is_not_tracking(rate: float) -> None:
    rng = np.random.default_rng(1)
    poles = np.exp((-0.03 + 1j) * 2.0 * np.pi * np.array([1.0, 2.3]) / 40.0)  # periods of 40 and 17 samples
    A = np.zeros((4, 4))
    for k, pole in enumerate(poles):
        A[2 * k:2 * k + 2, 2 * k:2 * k + 2] = [[pole.real, -pole.imag], [pole.imag, pole.real]]
    B, C = rng.standard_normal((4, 1)), rng.standard_normal((2, 4))
    first, then = (StateSpace(A, gain * B, seen, np.zeros((2, 1)), np.zeros((4, 2)), 1.0 / rate)
                   for gain, seen in ((1.0, C), (-3.0, C[::-1])))
    u = np.repeat(rng.standard_normal((COUNT // 8, 1)), 8, axis=0)
    y = np.vstack([simulate(first, u[:CHANGE]), simulate(then, u[CHANGE:])])
    y += 0.01 * y.std(axis=0) * rng.standard_normal(y.shape)
    records = [JointRecord(round(k * 1e9 / rate), ('in0', 'out0', 'out1'), np.array([0.0, *y[k]]), np.empty(0),
                           np.array([u[k, 0], 0.0, 0.0])) for k in range(COUNT)]
    said = [(round(one.stamp_ns * 1e-9 * rate), one.model_status)
            for one in pipeline.run(configuration(1, 2, order=4), records) if one.model_is_new]
    before = {status for row, status in said if CHANGE - 100 < row < CHANGE}
    assert Status.TRACKING in before
    assert Status.INCONSISTENT not in before
    after = {status for row, status in said if row >= CHANGE + 24}
    assert after <= {Status.INCONSISTENT, Status.POORLY_EXCITED}
