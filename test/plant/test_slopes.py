"""Encoder angles at few modes: the quasi-static correction, the tail, against many modes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flexmanip_ros.arm import outputs
from flexmanip_ros.parameters import ArmParameters, ExcitationParameters, PlantParameters
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import Array, CaptureEvent, EventKind

ARM = ArmParameters(damping_ratio=0.003, hub_inertia=(0.02, 0.01), joint_inertia=0.01, tip_inertia=0.005)
CONFIG = PlantParameters(noise='none', arm=ARM, payload_inertia=0.02, payload_com=(0.002, 0.0))
CAPTURE = (CaptureEvent(400_000_000, EventKind.CAPTURE),)
WAVES = excitation.sequence(ExcitationParameters(), 1000)
SMOOTH = excitation.sequence(ExcitationParameters(shape='multisine', band=(0.5, 8.0)), 1000)


def run(kappa: int, corrected: bool, tail_modes: int = 0, efforts: Array = WAVES) -> simulator.Trajectory:
    config = replace(CONFIG, tail_modes=tail_modes, substeps=2 * kappa,
                     arm=replace(ARM, modes=kappa, slope_correction=corrected))
    return simulator.simulate(config, efforts, CAPTURE)


def gap(a: Array, b: Array) -> Array:
    return np.sqrt(np.mean((a - b) ** 2, axis=0)) / b.std(axis=0)


@pytest.fixture(scope='module')
def many() -> dict[str, simulator.Trajectory]:
    return {'waves': run(8, True), 'smooth': run(8, True, efforts=SMOOTH)}


def test_a_smooth_torque_needs_the_quasi_static_correction_only(
    many: dict[str, simulator.Trajectory],
) -> None:
    plain = gap(run(3, False, efforts=SMOOTH).position, many['smooth'].position)
    corrected = gap(run(3, True, efforts=SMOOTH).position, many['smooth'].position)
    assert np.all(plain[:2] > 0.02)
    assert np.all(corrected[:2] < 0.1 * plain[:2])
    assert np.all(corrected < 0.008)


def test_square_waves_need_the_tail(many: dict[str, simulator.Trajectory]) -> None:
    plain = gap(run(3, False).position, many['waves'].position)
    corrected = gap(run(3, True).position, many['waves'].position)
    ringing = run(3, True, 5)
    assert np.all(corrected[:2] < 0.25 * plain[:2])
    assert np.all(gap(ringing.position, many['waves'].position) < 0.005)
    assert np.all(gap(ringing.velocity, many['waves'].velocity) < 0.05)
    assert np.all(gap(run(3, True).velocity, many['waves'].velocity)[:2] > 0.1)


def test_flexibility_is_that_of_the_static_beam() -> None:
    """Without retained modes: L / 3 EI and L / 6 EI at the ends of a simply supported beam."""
    arm = ArmParameters(link_length=(2.0, 3.0), bending_stiffness=(1000.0, 5000.0))
    R = outputs.flexibility(arm, 0)
    assert R[0, :2] == pytest.approx([2 / 3000, -2 / 6000], rel=1e-6)
    assert R[1, :4] == pytest.approx([2 / 6000, -2 / 3000, 3 / 15000, -3 / 30000], rel=1e-6)
    # mid-span deflection by an end moment, M L^2 / 16 EI
    assert R[2, :2] == pytest.approx([4 / 16000, -4 / 16000], rel=1e-6)
    # load linear along the beam (a turning chord): slope 7 / 360 w L^3 / EI at the far end from the peak
    assert R[0, 4] == pytest.approx(7 / 360 * 5.0 * 2.0 * 2.0**3 / 1000, rel=1e-6)
    # uniform load w = rho: slope w L^3 / 24 EI, deflection 5 w L^4 / 384 EI
    assert R[1, 6] == pytest.approx(5.0 * 27 / (24 * 5000), rel=1e-6)
    assert R[3, 6] == pytest.approx(5 * 5.0 * 81 / (384 * 5000), rel=1e-6)


def test_chord_angles_and_the_papers_torques_are_not_corrected_by_torques() -> None:
    chord = outputs.flexibility(ArmParameters(angle_convention='chord'), 2)
    assert not chord[:2].any()
    paper = outputs.slopes(ArmParameters(torque_convention='paper'), 2)
    assert not paper.moments.any()
    assert not outputs.slopes(ArmParameters(slope_correction=False), 2).active


def test_a_jump_of_the_torque_shows_one_sample_later() -> None:
    step = np.zeros((3, 2))
    step[1:] = [10.0, 5.0]
    position = simulator.simulate(CONFIG, step).position
    assert np.array_equal(position[0], position[1])
    assert abs(position[2, 0] - position[1, 0]) > 1e-5


def test_the_tail_takes_over_from_the_quasi_static_part() -> None:
    few = outputs.slopes_with_residual_modes(ARM, CONFIG.initial_angles, 3, 5, 1e-3)
    static = few.output / np.array([np.linalg.solve(np.eye(2) - s, g + h)[0] for s, g, h in zip(
        few.step, few.start, few.end, strict=True)]) ** -1 @ few.load
    total = outputs.slopes(ARM, 3).flexibility
    assert static + few.flexibility == pytest.approx(total, rel=1e-6, abs=1e-9 * np.abs(total).max())
