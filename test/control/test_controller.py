from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from flexmanip_ros.arm.manipulator import payload_array
from flexmanip_ros.control import controller
from flexmanip_ros.control.handover import PayloadEstimate, Verdict, judge
from flexmanip_ros.errors import ParameterError
from flexmanip_ros.parameters import ArmParameters, ControllerParameters, PlantParameters, configure
from flexmanip_ros.simulation import simulator

GOOD = PayloadEstimate(20.0, 0.1, 19.8, 20.2, 1.0)


def run(config: ControllerParameters, seconds: float, payload: float = 20.0, told: bool = True,
        move: float = 0.1, plant_modes: int = 2) -> tuple[np.ndarray, np.ndarray, controller.ControllerState]:
    """Capture at 0.3 s, estimate at 0.5 s, new setpoint at 0.8 s; return positions (N, 4), torques (N, 2)."""
    plant = PlantParameters(payload_mass=payload, noise='none', object_velocity=(0.1, 0.0),
                            arm=ArmParameters(modes=plant_modes, damping_ratio=0.003))
    arm, state, torque = simulator.init(plant), controller.init(config), np.zeros(2)
    positions, torques = [], []
    for k in range(round(seconds * 1000)):
        if k == 300:
            arm = simulator.attach(plant, arm)
        if k == 500 and told:
            state = controller.estimate(config, state, GOOD._replace(
                mass=payload, lower=payload - 0.2, upper=payload + 0.2))
        if k == 800:
            state = controller.goto(state, positions[0][:2] + np.array([move, -move]))
        arm, record = simulator.step(plant, arm, torque)
        state, torque = controller.step(
            config, state, controller.Measured(record.position, record.velocity, np.zeros(2)))
        positions.append(record.position)
        torques.append(torque)
    return np.array(positions), np.array(torques), state


CONFIG = ControllerParameters(arm=ArmParameters(modes=2))


def test_the_arm_goes_where_it_should_and_rests_with_modes_not_modelled_too() -> None:
    positions, torques, _ = run(CONFIG, 5.5, plant_modes=5)
    end = positions[-300:]
    assert np.abs(end[:, :2].mean(axis=0) - positions[0, :2] - [0.1, -0.1]).max() < 5e-3
    assert np.abs(end[:, 2:]).max() < 3e-4
    assert np.abs(torques[-300:]).max() < 5.0


def test_knowing_the_payload_brings_the_arm_there_sooner() -> None:
    def error(told: bool) -> float:
        positions, _, _ = run(CONFIG, 4.0, payload=60.0, told=told)
        return float(np.abs(positions[-500:, :2] - positions[0, :2] - [0.1, -0.1]).mean())

    assert error(told=True) < 0.5 * error(told=False)


def test_a_new_payload_moves_the_torque_without_a_step() -> None:
    _, torques, state = run(CONFIG, 0.8)
    around = np.abs(np.diff(torques[400:800], axis=0)).max()
    assert state.designs >= 1
    assert state.payload[0] == pytest.approx(20.0)
    assert around < 0.5


def test_torques_stay_within_the_limits_whatever_is_measured() -> None:
    state = controller.init(CONFIG)
    for value in (1.0, -50.0, 1e6):
        state, torque = controller.step(CONFIG, state, controller.Measured(
            np.full(4, value), np.full(4, value), np.array([1e9, -1e9])))
        assert (np.abs(torque) <= CONFIG.effort_limit).all()


def test_a_raised_limit_moves_the_torque_without_a_step_and_a_lowered_one_holds_at_once() -> None:
    state, torques = controller.init(CONFIG), []
    passive, lower = (replace(CONFIG, effort_limit=(300.0, limit)) for limit in (0.0, 20.0))
    for k, config in enumerate([passive] * 50 + [CONFIG] * 150 + [lower] * 10 + [CONFIG] * 100):
        angle = 0.3 if k else 0.0  # the first sample is held, so joint 2 is as far off as a passive joint may be
        state, torque = controller.step(config, state, controller.Measured(
            np.array([0.0, angle, 0.0, 0.0]), np.zeros(4), np.zeros(2)))
        torques.append(abs(torque[1]))
    assert torques[:50] == [0.0] * 50
    assert np.diff(torques[49:200]).max() <= 1.5 + 1e-9  # 150 N m over 100 samples
    assert torques[149:200] == pytest.approx([150.0] * 51)
    assert torques[200:210] == pytest.approx([20.0] * 10)
    assert torques[210:] == pytest.approx([min(20.0 + 1.5 * (k + 1), 150.0) for k in range(100)])


@pytest.mark.parametrize('limits', [(300.0, 0.0), (0.0, 150.0), (1e-300, 5e-324)])
def test_an_arm_with_passive_joints_moves_with_finite_torques_and_none_there(limits: tuple[float, float]) -> None:
    config = replace(CONFIG, effort_limit=limits)
    positions, torques, state = run(config, 4.0)
    assert np.isfinite(torques).all()
    assert (np.abs(torques) <= limits).all()
    if limits[0] == 300.0:
        assert positions[-1, 0] - positions[0, 0] == pytest.approx(0.1, abs=0.05)
    assert state.way is not None
    assert state.way.ended


def test_holding_the_goal_takes_the_weight_of_the_arm_and_its_payload() -> None:
    config = replace(CONFIG, arm=replace(CONFIG.arm, gravity=(0.0, -9.81)), hold_present=False, initial_payload=2.0)
    state, _ = controller.step(config, controller.init(config), controller.Measured(*np.zeros((2, 4)), np.zeros(2)))
    assert state.way is not None
    assert controller.hold_goal(config, state) == pytest.approx(
        controller.hold(config, np.zeros(2), payload_array(2.0))[0], rel=1e-9)


@pytest.mark.parametrize(('changed', 'verdict'), [
    ({}, Verdict.TRUSTED),
    ({'mass': math.nan}, Verdict.NOT_FINITE),
    ({'std': math.inf, 'upper': math.inf}, Verdict.NOT_FINITE),
    ({'mass': 500.0, 'lower': 499.0, 'upper': 501.0}, Verdict.OUT_OF_RANGE),
    ({'mass': -3.0, 'lower': -4.0, 'upper': -2.0}, Verdict.OUT_OF_RANGE),
    ({'lower': 5.0, 'upper': 35.0}, Verdict.UNSURE),
    ({'consistency': 80.0}, Verdict.INCONSISTENT),
    ({'consistency': math.nan}, Verdict.INCONSISTENT),
])
def test_only_a_trusted_estimate_is_scheduled_on(changed: dict[str, float], verdict: Verdict) -> None:
    found = GOOD._replace(**changed)
    assert judge(CONFIG, found) is verdict
    state = controller.estimate(CONFIG, controller.init(CONFIG), found)
    assert state.trusted[0] == (20.0 if verdict is Verdict.TRUSTED else 0.0)


def test_estimates_can_be_left_out_of_the_schedule() -> None:
    blind = replace(CONFIG, use_estimate=False)
    assert controller.estimate(blind, controller.init(blind), GOOD).trusted[0] == 0.0


def test_a_sensor_at_the_end_of_a_link_is_refused() -> None:
    with pytest.raises(ParameterError, match=r"'arm.sensor_position' is 0"):
        configure(ControllerParameters, {'arm.sensor_position': [0.0, 0.5]})


@pytest.mark.parametrize('payload', [0.0, 60.0])
def test_a_move_bends_the_links_as_much_as_it_may_whatever_they_carry(payload: float) -> None:
    config = replace(CONFIG, move_bend=0.006, initial_payload=payload)
    plant = PlantParameters(payload_mass=payload, noise='none', arm=config.arm)
    arm = simulator.attach(plant, simulator.init(plant))
    state, torque, bends = controller.init(config), np.zeros(2), []
    for k in range(6000):
        arm, record = simulator.step(plant, arm, torque)
        if k == 100:
            state = controller.goto(state, record.position[:2] + np.array([0.2, -0.2]))
        state, torque = controller.step(
            config, state, controller.Measured(record.position, record.velocity, np.zeros(2)))
        bends.append(np.abs(record.position[2:]).max())
    assert 0.0045 < max(bends) < 0.0075
    assert record.position[:2] == pytest.approx(state.setpoint, abs=0.02)
