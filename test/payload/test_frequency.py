"""Payload from frequencies alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from recording import config

from flexmanip_ros import pipeline
from flexmanip_ros.arm import linearization
from flexmanip_ros.parameters import (
    ArmParameters,
    ExcitationParameters,
    IdentifierParameters,
    PlantParameters,
    configure,
)
from flexmanip_ros.payload import frequency
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import CaptureEvent, Estimate, EventKind, Mode, Status

ARM = ArmParameters(angle_convention='chord')
ANGLES = np.radians([60.0, 45.0])
NOWHERE = np.empty(0)  # the arm has not moved


def modes(payload, std=1e-3, shift=(0.0, 0.0), arm=ARM):
    found = linearization.frequencies(linearization.vibration_model(arm, ANGLES, payload)[0])[:2]
    return tuple(Mode(float(f + d), 0.0, std, 1e-3) for f, d in zip(found, shift, strict=True))


@pytest.mark.parametrize('payload', [0.0, 2.0, 20.0, 100.0])
def test_exact_frequencies_give_the_payload(payload):
    found = frequency.estimate(config(ARM), modes(payload), ANGLES, NOWHERE)
    assert found.mass == pytest.approx(payload, abs=2e-3 * (payload + 15.0))
    assert found.lower <= payload <= found.upper
    assert found.status is Status.TRACKING


@pytest.mark.parametrize('payload', [0.0, 20.0, 100.0])
def test_the_base_of_an_arm_may_float(payload):
    """Taken for a fixed one, a base of 700 kg made 18 kg of 20, TRACKING."""
    arm = replace(ARM, base_mass=700.0, base_inertia=180.0, base_joint_offset=(0.3, 0.1))
    found = frequency.estimate(config(arm), modes(payload, arm=arm), ANGLES, NOWHERE)
    assert found.mass == pytest.approx(payload, abs=2e-3 * (payload + 15.0))
    assert found.lower <= payload <= found.upper
    assert found.status is Status.TRACKING


def test_the_interval_covers_ninety_five_per_cent():
    rng = np.random.default_rng(1)
    inside = 0
    for _ in range(200):
        found = frequency.estimate(config(ARM), modes(20.0, 2e-3, 2e-3 * rng.normal(size=2)), ANGLES, NOWHERE)
        inside += found.lower <= 20.0 <= found.upper
    assert 0.90 <= inside / 200 <= 1.0


def test_a_vague_frequency_leaves_the_upper_end_open():
    found = frequency.estimate(config(ARM), modes(200.0, 0.3), ANGLES, NOWHERE)
    assert found.upper == np.inf



def test_frequencies_of_another_arm_are_found_out():
    found = frequency.estimate(config(ARM), modes(20.0, 1e-3, (0.0, 0.3)), ANGLES, NOWHERE)
    assert found.status is Status.INCONSISTENT


def test_an_estimate_is_tracking_up_to_the_consistency_that_its_consumers_trust() -> None:
    """Adapter and controller trust a consistency up to 2."""
    found = [frequency.estimate(config(ARM), modes(20.0, 1e-3, (0.0, error)), ANGLES, NOWHERE)
             for error in np.linspace(0.0, 0.01, 41)]
    assert {one.status for one in found} == {Status.TRACKING, Status.INCONSISTENT}
    assert all((one.status is Status.TRACKING) == (one.consistency <= 2.0) for one in found)


def test_no_modes_or_angles_give_a_status():
    assert frequency.estimate(config(ARM), (), ANGLES, NOWHERE).status is Status.WARMING_UP
    assert frequency.estimate(config(ARM), modes(20.0), np.empty(0), NOWHERE).status is Status.UNOBSERVABLE
    assert frequency.estimate(config(ARM), (Mode(5.0, 0.01),), ANGLES, NOWHERE).status is Status.WARMING_UP


def identified(payload: float, seed: int, model: str, **values: object) -> list[Estimate]:
    """Estimates of a simulated capture at 1.5 s, from 1.2 s after it on: with 60 kg a rate rings until then."""
    plant = configure(PlantParameters, {'payload_mass': payload, 'seed': seed, 'model': model})
    capture = CaptureEvent(1_500_000_000, EventKind.CAPTURE)
    run = simulator.simulate(plant, excitation.sequence(ExcitationParameters(), 4000), (capture,))
    settings = configure(IdentifierParameters, {'payload_method': 'frequency', 'publish_rate': 10.0, **values})
    return [one for one in pipeline.run(settings, simulator.records(run, (capture,))) if one.stamp_ns > 2.7e9]


@pytest.mark.parametrize(('payload', 'seed'), [(5.0, 1), (60.0, 1)])
def test_a_linear_arm_is_weighed_by_its_frequencies_to_one_percent(payload, seed):
    point = list(PlantParameters().initial_angles)
    found = identified(payload, seed, 'linear', **{'payload.dynamics': 'linear', 'payload.working_point': point})
    assert all(one.status is Status.TRACKING for one in found)
    assert all(one.payload.lower <= payload <= one.payload.upper for one in found)
    assert found[-1].payload.mass == pytest.approx(payload, rel=0.01)


@pytest.mark.parametrize('payload', [5.0, 60.0])
def test_on_a_moving_arm_the_interval_reckons_with_the_way_it_went(payload):
    found = identified(payload, 3, 'nonlinear')
    assert all(one.payload.lower <= payload <= one.payload.upper for one in found)
    assert all(one.payload.upper - one.payload.lower > 0.1 * payload for one in found)
