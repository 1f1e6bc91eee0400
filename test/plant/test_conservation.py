"""A floating arm catches a spinning body: momentum and energy, summed over every point mass from positions alone.

The package eliminates the translation of the base and never forms these sums: this is another way to each number.
"""

from __future__ import annotations

import mechanics
import numpy as np
import pytest

from flexmanip_ros.arm.manipulator import count, modal, shape_functions
from flexmanip_ros.parameters import ArmParameters, ExcitationParameters, PlantParameters
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import Array

ARM = ArmParameters(modes=1, base_mass=500.0, base_inertia=150.0, base_joint_offset=(0.4, -0.3), tip_inertia=0.2)
CONFIG = PlantParameters(noise='none', arm=ARM, payload_mass=20.0, payload_inertia=3.0, payload_com=(0.3, -0.2),
                         object_velocity=(0.2, -0.1), object_spin=0.3, substeps=60)
MASS, INERTIA, SPIN, V = 20.0, 3.0, 0.3, np.array([0.2, -0.1])


def unit(angle: complex) -> Array:
    return np.array([np.cos(angle), np.sin(angle)])


def left(angle: complex) -> Array:
    return np.array([-np.sin(angle), np.cos(angle)])


def cross(a: Array, b: Array) -> Array:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def bodies(arm: simulator.PlantState, q: Array, holds: bool) -> list[tuple[float, float, Array, complex]]:
    """Return mass, inertia about its centre, place (2,) and angle of every part, the base's centre at the origin."""
    made, k, base = arm.model.arm, arm.model.arm.kappa, ARM.base_joint_offset
    found = [(ARM.base_mass, ARM.base_inertia, np.zeros(2, dtype=q.dtype), q[-1])]
    root = base[0] * unit(q[-1]) + base[1] * left(q[-1])
    for i in range(2):
        bend = q[2 + i * k:2 + (i + 1) * k]
        for p, mass in enumerate(made.mass[i]):
            along = made.place[i, p] - bend @ made.G[i, :, p] @ bend / 2.0
            place = root + along * unit(q[i]) + (made.phi[i, p] @ bend) * left(q[i])
            found.append((float(mass), 0.0, place, q[i]))
        root = found[-1][2]
    heading = q[1] + made.tip_slope[1] @ q[2 + k:2 + 2 * k]
    found.append((0.0, ARM.tip_inertia, root, heading))
    if holds:
        found.append((MASS, INERTIA, root + 0.3 * unit(heading) - 0.2 * left(heading), heading))
    return found


class Sums:
    """Momentum by every coordinate, angular momentum about the origin and kinetic energy, of parts that moved by q, q'
    while the centre of mass of all has the velocity ``drift``."""

    def __init__(self, state: simulator.PlantState, drift: Array, holds: bool) -> None:
        n = state.x.size // 2
        q, qd = state.x[:n], state.x[n:]
        parts = bodies(state, q.astype(complex), holds)
        mass, inertia = np.array([part[0] for part in parts]), np.array([part[1] for part in parts])
        place = np.array([part[2] for part in parts]).real

        def derivative(direction: Array) -> tuple[Array, Array]:
            moved = bodies(state, q + 1e-30j * direction, holds)  # exact to round-off: no difference is taken
            return (np.array([part[2] for part in moved]).imag / 1e-30,
                    np.array([part[3] for part in moved]).imag / 1e-30)

        added = np.zeros(n)  # what slows the last modes is no part of the arm: it keeps its own momentum and energy
        for i, (rho, length) in enumerate(zip(ARM.linear_density, ARM.link_length, strict=True)):
            added[modal(2, count(ARM), i)] = rho * length * (shape_functions(ARM.modes, True).inertia - 0.5)
        velocity, spin = derivative(qd)
        velocity = velocity + drift - mass @ velocity / mass.sum()
        self.linear = mass @ velocity
        self.angular = float(mass @ cross(place, velocity) + inertia @ spin)
        self.energy = float((mass * (velocity ** 2).sum(axis=1)).sum() + inertia @ spin ** 2 + added @ qd ** 2) / 2.0
        self.added, self.qd = added, qd
        self.mass, self.inertia, self.velocity, self.spin, self.last = mass, inertia, velocity, spin, place[-1]
        rows = self.rows = [derivative(row) for row in np.eye(n)]
        self.by_coordinate = np.array([(mass * (velocity * v).sum(axis=1)).sum() + inertia @ (spin * w)
                                       for v, w in rows]) + added * qd


def moving() -> simulator.PlantState:
    state = simulator.init(CONFIG)
    for torque in excitation.sequence(ExcitationParameters(), 300):
        state, _ = simulator.step(CONFIG, state, 5 * torque)
    return state


@pytest.fixture(scope='module')
def capture() -> tuple[simulator.PlantState, simulator.PlantState]:
    before = moving()
    return before, simulator.attach(CONFIG, before)


def test_momentum_by_every_coordinate_and_linear_and_angular_is_conserved_at_the_capture(
        capture: tuple[simulator.PlantState, simulator.PlantState]) -> None:
    state, caught = capture
    before, after = Sums(state, np.zeros(2), holds=False), Sums(caught, np.zeros(2), holds=True)
    after = Sums(caught, MASS * V / after.mass.sum(), holds=True)
    free = np.array([MASS * v[-1] @ V + INERTIA * w[-1] * SPIN for v, w in after.rows])
    assert np.abs(free).min() > 0.0
    assert after.linear == pytest.approx(before.linear + MASS * V, rel=1e-9, abs=1e-9)
    assert after.angular == pytest.approx(before.angular + MASS * cross(after.last, V) + INERTIA * SPIN, rel=1e-9)
    assert after.by_coordinate == pytest.approx(before.by_coordinate + free, rel=1e-9, abs=1e-9)


def test_the_energy_lost_at_the_capture_is_that_of_the_lost_velocities(
        capture: tuple[simulator.PlantState, simulator.PlantState]) -> None:
    """The theorem of Carnot on inelastic impacts, over all parts of arm, base and object."""
    state, caught = capture
    before, after = Sums(state, np.zeros(2), holds=False), Sums(caught, np.zeros(2), holds=True)
    after = Sums(caught, MASS * V / after.mass.sum(), holds=True)
    velocity = after.velocity - np.vstack([before.velocity, V])
    spin = after.spin - np.append(before.spin, SPIN)
    lost = float((after.mass * (velocity ** 2).sum(axis=1)).sum() + after.inertia @ spin ** 2
                 + after.added @ (after.qd - before.qd) ** 2) / 2.0
    assert lost > 0.0
    free = (MASS * V @ V + INERTIA * SPIN ** 2) / 2.0
    assert before.energy + free - after.energy == pytest.approx(lost, rel=1e-9)


def test_energy_and_angular_momentum_stay_after_the_capture(
        capture: tuple[simulator.PlantState, simulator.PlantState]) -> None:
    state = capture[1]
    n, found = state.x.size // 2, []
    for _ in range(4):
        for _ in range(50):
            state, _ = simulator.step(CONFIG, state, np.zeros(2))
        q, qd = state.x[:n], state.x[n:]
        sums = Sums(state, np.zeros(2), holds=True)
        elastic = mechanics.energy(state.model.arm, state.payload, q, np.zeros(n))
        found.append((sums.energy + elastic, sums.angular))
        assert mechanics.energy(state.model.arm, state.payload, q, qd) == pytest.approx(found[-1][0], rel=1e-9)
    assert np.array(found) == pytest.approx(np.tile(found[0], (4, 1)), rel=1e-9)
