"""Catching and letting go: momentum, bodies, several in a row."""

from __future__ import annotations

from dataclasses import replace

import mechanics
import numpy as np
import pytest

from flexmanip_ros.arm.manipulator import payload_array
from flexmanip_ros.parameters import ArmParameters, ExcitationParameters, PlantParameters
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import Array

CONFIG = PlantParameters(noise='none', arm=ArmParameters(modes=1))
BODY = replace(CONFIG, payload_inertia=3.0, payload_com=(0.3, -0.2), object_velocity=(0.2, -0.1),
               object_spin=0.3)
WAVES = excitation.sequence(ExcitationParameters(), 400)


def moving(config: PlantParameters) -> simulator.PlantState:
    state = simulator.init(config)
    for torque in WAVES:
        state, _ = simulator.step(config, state, 5 * torque)
    return state


def momentum(state: simulator.PlantState) -> Array:
    half = state.x.size // 2
    return state.model.mass_matrix(state.x, state.payload) @ state.x[half:]


@pytest.mark.parametrize('model', ['nonlinear', 'linear'])
@pytest.mark.parametrize('config', [CONFIG, BODY], ids=['point', 'body'])
def test_momentum_is_conserved_at_the_capture(config: PlantParameters, model: str) -> None:
    config = replace(config, model=model)
    before = moving(config)
    after = simulator.attach(config, before)
    J = before.model.body_jacobian(before.x, before.payload, config.payload_com)
    own = J.T @ np.array([
        *(config.payload_mass * np.array(config.object_velocity)),
        config.payload_inertia * config.object_spin])
    assert momentum(after) == pytest.approx(momentum(before) + own, rel=1e-9, abs=1e-9)
    half = before.x.size // 2
    assert np.array_equal(after.x[:half], before.x[:half])
    assert not np.allclose(after.x[half:], before.x[half:])


def test_angular_momentum_about_the_base_is_that_of_arm_and_object() -> None:
    """An independent route: J' p of a rigid turn about the base is the angular momentum itself."""
    before = moving(BODY)
    after = simulator.attach(BODY, before)
    turn = np.zeros(before.x.size // 2)
    turn[:2] = 1.0
    place = position_of(before, BODY.payload_com)
    v = np.array(BODY.object_velocity)
    own = (BODY.payload_mass * (place[0] * v[1] - place[1] * v[0])
           + BODY.payload_inertia * BODY.object_spin)
    assert turn @ momentum(after) == pytest.approx(turn @ momentum(before) + own, rel=1e-9)


def position_of(state: simulator.PlantState, com: tuple[float, float]) -> Array:
    arm = state.model.arm
    k = arm.kappa
    q = state.x[:state.x.size // 2]
    bends = [q[2 + i * k:2 + (i + 1) * k] for i in range(2)]
    reach = [arm.length[i] - bends[i] @ arm.tip_shortening[i] @ bends[i] / 2 for i in range(2)]
    heading = q[1] + arm.tip_slope[1] @ q[2 + k:]
    unit = [np.array([np.cos(a), np.sin(a)]) for a in (*q[:2], heading)]
    left = np.array([-unit[2][1], unit[2][0]])
    return reach[0] * unit[0] + reach[1] * unit[1] + com[0] * unit[2] + com[1] * left


def test_the_tip_jacobian_is_the_derivative_of_the_tip() -> None:
    state = moving(CONFIG)
    com = (0.3, -0.2)
    J = state.model.body_jacobian(state.x, state.payload, com)
    half = state.x.size // 2
    for c in range(half):
        step = np.zeros(state.x.size)
        step[c] = 1e-6
        ahead, behind = (position_of(state._replace(x=state.x + s * step), com) for s in (1, -1))
        assert J[:2, c] == pytest.approx((ahead - behind) / 2e-6, abs=1e-8)


def test_energy_is_lost_unless_the_object_moves_with_the_tip() -> None:
    before = moving(CONFIG)
    half = before.x.size // 2
    arm = before.model.arm
    energy = mechanics.energy(arm, before.payload, before.x[:half], before.x[half:])
    after = simulator.attach(CONFIG, before)
    lost = energy - mechanics.energy(arm, after.payload, after.x[:half], after.x[half:])
    assert lost > 0
    vx, vy, spin = before.model.body_jacobian(before.x, before.payload, (0.0, 0.0)) @ before.x[half:]
    matched = replace(CONFIG, object_velocity=(vx, vy), object_spin=spin)
    gentle = simulator.attach(matched, before)
    assert gentle.x == pytest.approx(before.x, abs=1e-12)


def test_the_papers_capture_leaves_the_rates() -> None:
    config = replace(CONFIG, capture_impact='continuous')
    before = moving(config)
    after = simulator.attach(config, before)
    assert np.array_equal(after.x, before.x)
    assert after.payload[0] == 20.0


def test_release_keeps_the_rates_and_empties_the_hand() -> None:
    held = simulator.attach(CONFIG, moving(CONFIG))
    after = simulator.release(CONFIG, held)
    assert np.array_equal(after.x, held.x)
    assert not after.payload.any()


def test_two_captures_make_one_body() -> None:
    state = simulator.attach(CONFIG, moving(CONFIG))
    state = simulator.attach(replace(CONFIG, payload_mass=10.0, payload_com=(0.3, 0.0)), state)
    spread = 20.0 * 0.1**2 + 10.0 * 0.2**2
    assert state.payload == pytest.approx(payload_array(30.0, spread, (0.1, 0.0)))
    # the same mass matrix as two separate bodies have
    J = state.model.body_jacobian(state.x, state.payload, (0.3, 0.0))
    M = state.model.mass_matrix(state.x, payload_array(20.0)) + 10.0 * J[:2].T @ J[:2]
    assert state.model.mass_matrix(state.x, state.payload) == pytest.approx(M, rel=1e-12, abs=1e-10)


def test_a_second_object_does_not_cost_the_rest_of_the_first() -> None:
    config = replace(CONFIG, gripper_ramp=0.02)
    state = simulator.attach(config, moving(config))
    for _ in range(5):
        state, _ = simulator.step(config, state, np.zeros(2))
    state = simulator.attach(config, state)
    assert state.payload[0] == pytest.approx(20.0)
    for _ in range(25):
        state, _ = simulator.step(config, state, np.zeros(2))
    assert state.payload[0] == pytest.approx(40.0)


def test_a_soft_gripper_ends_with_the_whole_object() -> None:
    config = replace(BODY, gripper_ramp=0.05)
    state = simulator.attach(config, moving(config))
    assert state.payload[0] == 0.0
    masses = []
    for _ in range(60):
        state, _ = simulator.step(config, state, np.zeros(2))
        masses.append(state.payload[0])
    assert masses[:50] == pytest.approx(np.arange(1, 51) * 0.4)
    assert state.payload == pytest.approx(payload_array(20.0, 3.0, (0.3, -0.2)))
    assert masses[50:] == pytest.approx([20.0] * 10)


def test_a_floating_base_keeps_the_angular_momentum_when_a_spinning_body_is_caught() -> None:
    """About the centre of mass of base and arm before: J of a rigid turn is the place of the body from there."""
    arm = ArmParameters(modes=1, base_mass=500.0, base_inertia=150.0, base_joint_offset=(0.4, -0.3))
    config = replace(BODY, arm=arm)
    before = moving(config)
    after = simulator.attach(config, before)
    turn = np.zeros(before.x.size // 2)
    turn[[0, 1, -1]] = 1.0
    J = before.model.body_jacobian(before.x, before.payload, config.payload_com)
    place = np.array([(J @ turn)[1], -(J @ turn)[0]])
    m, v = config.payload_mass, np.array(config.object_velocity)
    own = m * (place[0] * v[1] - place[1] * v[0])
    together = before.model.floating_mass(before.payload) + m  # whose centre of mass is at m place / together
    expected = turn @ momentum(before) + own + config.payload_inertia * config.object_spin
    assert turn @ momentum(after) + m / together * own == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize('arm', [
    ArmParameters(modes=1, base_mass=500.0, base_inertia=150.0, base_joint_offset=(0.4, -0.3)),
    ArmParameters(modes=1, rotor_inertia=(0.5, 0.3))], ids=['floating base', 'rotors'])
def test_energy_stays_with_rotors_and_a_floating_base_and_friction_takes_it(arm: ArmParameters) -> None:
    def energies(arm: ArmParameters) -> Array:
        config = replace(CONFIG, arm=arm, substeps=20)
        state = simulator.attach(config, moving(config))
        half, found = state.x.size // 2, []
        for _ in range(300):
            state, _ = simulator.step(config, state, np.zeros(2))
            found.append(mechanics.energy(state.model.arm, state.payload, state.x[:half], state.x[half:]))
        return np.array(found)

    free = energies(arm)
    assert free == pytest.approx(np.full(300, free[0]), rel=1e-6)
    rubbed = energies(replace(arm, joint_viscous_friction=(0.5, 0.5), joint_coulomb_friction=(0.2, 0.1)))
    assert np.all(np.diff(rubbed) < 0.0)


def test_a_pendulum_under_gravity_swings_about_the_vertical() -> None:
    """The arm hangs straight down at rest; turned a little, it falls back."""
    arm = ArmParameters(modes=1, gravity=(0.0, -9.81))
    hanging = replace(CONFIG, arm=arm, initial_angles=(-np.pi / 2, -np.pi / 2))
    still = simulator.simulate(hanging, np.zeros((200, 2)))
    assert np.abs(still.velocity).max() < 1e-9
    aside = replace(hanging, initial_angles=(-np.pi / 2 + 0.1, -np.pi / 2 + 0.1))
    assert simulator.simulate(aside, np.zeros((200, 2))).velocity[-1, 0] < -0.05
