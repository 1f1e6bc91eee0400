"""The paper's baselines do what they claim on rigid arms, and are biased where the paper says so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from recording import ARM, config, event, record, rows_of

from flexmanip_ros.paper import baselines
from flexmanip_ros.types import EventKind, Status

STIFF = replace(ARM, bending_stiffness=(1e6, 1e6), damping_ratio=0.7, modes=1, angle_convention='chord')


def run(method, settings, samples, *events):
    return [estimate.payload for estimate in baselines.run(method, settings, baselines.Recorded(samples, events))]


def test_rigid_least_squares_finds_the_payload_of_a_rigid_arm():
    samples = record(3.0, (event(1.0),), payload=30.0, arm=STIFF, noise='none')
    found = run('rigid_rls', config(STIFF), samples, event(1.0))[-1]
    assert found.mass == pytest.approx(30.0, rel=0.02)
    assert found.lower < found.mass < found.upper


def test_rigid_least_squares_is_rough_on_a_flexible_arm_and_useless_on_its_encoders():
    chord = replace(ARM, angle_convention='chord', torque_convention='paper')
    rough = run('rigid_rls', config(chord), record(5.0, (event(1.0),), payload=50.0, arm=chord), event(1.0))[-1]
    assert rough.mass == pytest.approx(50.0, rel=0.2)
    useless = run('rigid_rls', config(), record(4.0, (event(1.0),), payload=50.0), event(1.0))[-1]
    assert useless.status in (Status.INCONSISTENT, Status.POORLY_EXCITED)


def pendulum(mass, gravity, seconds=3.0, dt=1e-3):
    """One rigid link that carries mass beside the tip mass, by Runge-Kutta; the second of two joints."""
    L, rho, tip = 3.0, 5.0, 10.0
    J = rho * L ** 3 / 3 + (tip + mass) * L ** 2
    pull = (rho * L / 2 + tip + mass) * gravity * L
    a, rate, torques, angles = 0.5, 0.0, [], []
    for k in range(round(seconds / dt)):
        torque = 200.0 if (k * dt) % 1.0 < 0.5 else -150.0
        torques.append([0.0, torque])
        angles.append([0.0, a])

        def turn(angle, torque=torque):
            return (torque - pull * np.cos(angle)) / J
        k1, k2 = turn(a), turn(a + dt / 2 * rate)
        k3, k4 = turn(a + dt / 2 * rate + dt * dt / 4 * k1), turn(a + dt * rate + dt * dt / 2 * k2)
        a, rate = a + dt * rate + dt * dt / 6 * (k1 + k2 + k3), rate + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    stamps = np.round(np.arange(len(angles)) * dt * 1e9).astype(np.int64)
    return rows_of(np.array(torques), np.zeros((len(angles), 4)), np.array(angles), stamps)


@pytest.mark.parametrize('gravity', [0.0, 9.81])
def test_the_algebraic_method_finds_the_payload_of_one_rigid_link(gravity):
    settings = config(replace(ARM, angle_convention='chord', gravity=(0.0, -gravity)))
    found = run('algebraic', settings, pendulum(20.0, gravity), event(0.0))[-1]
    assert found.mass == pytest.approx(20.0, rel=1e-3)
    assert found.lower <= 20.0 + 1e-2
    assert found.upper >= 20.0 - 1e-2


@pytest.mark.parametrize('method', baselines.BASELINES)
def test_a_status_and_never_a_nan(method):
    samples = record(0.5, scale=0.0, noise='none')
    found = run(method, config(), samples, event(0.1), event(0.45, EventKind.RELEASE))
    assert found[0].mass == found[-1].mass == 0.0
    assert found[6].status is Status.WARMING_UP
    assert found[21].status in (Status.POORLY_EXCITED, Status.WARMING_UP)
    assert not np.isnan([payload[:5] for payload in found]).any()
