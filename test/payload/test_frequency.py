"""Payload from frequencies alone."""

from __future__ import annotations

import numpy as np
import pytest
from recording import config

from flexmanip_ros.arm import linearization
from flexmanip_ros.parameters import ArmParameters
from flexmanip_ros.payload import frequency
from flexmanip_ros.types import Mode, Status

ARM = ArmParameters(angle_convention='chord')
ANGLES = np.radians([60.0, 45.0])


def modes(payload, std=1e-3, shift=(0.0, 0.0), arm=ARM):
    found = linearization.frequencies(linearization.vibration_model(arm, ANGLES, payload)[0])[:2]
    return tuple(Mode(float(f + d), 0.0, std, 1e-3) for f, d in zip(found, shift, strict=True))


@pytest.mark.parametrize('payload', [0.0, 2.0, 20.0, 100.0])
def test_exact_frequencies_give_the_payload(payload):
    found = frequency.estimate(config(ARM), modes(payload), ANGLES)
    assert found.mass == pytest.approx(payload, abs=2e-3 * (payload + 15.0))
    assert found.lower <= payload <= found.upper
    assert found.status is Status.TRACKING


def test_the_interval_covers_ninety_five_per_cent():
    rng = np.random.default_rng(1)
    inside = 0
    for _ in range(200):
        found = frequency.estimate(config(ARM), modes(20.0, 2e-3, 2e-3 * rng.normal(size=2)), ANGLES)
        inside += found.lower <= 20.0 <= found.upper
    assert 0.90 <= inside / 200 <= 1.0


def test_a_vague_frequency_leaves_the_upper_end_open():
    found = frequency.estimate(config(ARM), modes(200.0, 0.3), ANGLES)
    assert found.upper == np.inf



def test_frequencies_of_another_arm_are_found_out():
    found = frequency.estimate(config(ARM), modes(20.0, 1e-3, (0.0, 0.3)), ANGLES)
    assert found.status is Status.INCONSISTENT


def test_no_modes_or_angles_give_a_status():
    assert frequency.estimate(config(ARM), (), ANGLES).status is Status.WARMING_UP
    assert frequency.estimate(config(ARM), modes(20.0), np.empty(0)).status is Status.UNOBSERVABLE
    assert frequency.estimate(config(ARM), (Mode(5.0, 0.01),), ANGLES).status is Status.WARMING_UP
