"""Captures that are announced late: with the right stamp, or with that of the moment somebody noticed."""

import numpy as np
import pytest

from flexmanip_ros import pipeline
from flexmanip_ros.parameters import ArmParameters, ExcitationParameters, IdentifierParameters, PlantParameters
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import CaptureEvent, EventKind, Status

ARM = ArmParameters(damping_ratio=0.005)


def payloads(caught_s, late_s, stamped_late, *, seed=1, until_s=3.0):
    """Payloads from the arrival of the event on; the arm catches 20 kg and holds it for ``until_s`` seconds more."""
    plant = PlantParameters(payload_mass=20.0, seed=seed, arm=ARM)
    state, items, arrives = simulator.init(plant), [], round((caught_s + late_s) * 1000)
    capture = None
    for k, torque in enumerate(excitation.sequence(ExcitationParameters(), arrives + round(until_s * 1000))):
        if k == round(caught_s * 1000):
            state = simulator.attach(plant, state)
        state, message = simulator.step(plant, state, torque)
        if k == (arrives if stamped_late else round(caught_s * 1000)):
            capture = CaptureEvent(message.stamp_ns, EventKind.CAPTURE)
        if k == arrives:
            items.append(capture)
        items.append(message)
    last_ns = items[-1].stamp_ns - round(until_s * 1e9)
    return [one.payload for one in pipeline.run(IdentifierParameters(arm=ARM), items) if one.stamp_ns > last_ns]


@pytest.mark.parametrize('stamped_late', [False, True])
@pytest.mark.parametrize('late_s', [0.4, 1.5])
def test_an_object_that_was_held_for_a_while_when_its_capture_was_announced_is_found(late_s, stamped_late):
    found = payloads(2.0, late_s, stamped_late)
    tracking = [one for one in found if one.status is Status.TRACKING]
    assert len(tracking) > 0.9 * len(found)
    assert np.mean([one.lower <= 20.0 <= one.upper for one in tracking]) > 0.9
    assert found[-1].status is Status.TRACKING
    assert found[-1].mass == pytest.approx(20.0, rel=0.003)


@pytest.mark.parametrize('seed', [1, 2])
def test_a_stamp_from_before_the_empty_arm_was_fitted_begins_the_payload_with_the_object(seed):
    found = payloads(0.3, 0.6, False, seed=seed)
    assert found[-1].status is Status.TRACKING
    assert found[-1].lower <= 20.0 <= found[-1].upper
    assert found[-1].mass == pytest.approx(20.0, rel=0.005)
