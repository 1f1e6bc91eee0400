"""The structured estimator's step of the motion against a fine, independent integration."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.integrate
import scipy.linalg

from flexmanip_ros.parameters import IdentifierParameters, configure
from flexmanip_ros.payload import process_model
from flexmanip_ros.payload.process_model import Kind
from flexmanip_ros.payload.structured_model import build, freeze, motion

SHORT = {
    'arm.link_length': [1.0, 0.8], 'arm.linear_density': [1.0, 0.8], 'arm.bending_stiffness': [120.0, 60.0],
    'arm.joint_mass': 1.5, 'arm.tip_mass': 0.8}
UNSURE = {'payload.length_std': 0.002, 'payload.mass_std': 0.01}
TORQUE = np.array([2.0, -0.8])


@pytest.fixture
def arm():
    found = motion(configure(IdentifierParameters, SHORT))
    found.effort[:] = TORQUE
    return found


def placed(dynamics: str, angles: np.ndarray, gravity=(0.0, 0.0)):
    """The short arm, a linear plant at these chord angles."""
    unsure = UNSURE if dynamics == 'nonlinear' else {}
    settings = configure(IdentifierParameters, {
        **SHORT, **unsure, 'payload.dynamics': dynamics, 'arm.angle_convention': 'chord', 'arm.gravity': gravity})
    model = build(settings)
    freeze(settings, model, angles)
    model.motion.effort[:] = TORQUE
    return model.motion


def bent(arm, n: int) -> np.ndarray:
    """A bent arm in motion, holding a body, with friction, rotors and sensors of their own."""
    rng = np.random.default_rng(0)
    x = np.zeros(2 * n + arm.kind.size)
    x[:2], x[n:n + 2] = (1.0, 0.6), (0.3, -0.4)
    size = np.tile([1.0, 0.1, 0.02, 0.01, 0.002], 2)
    x[2:2 + size.size] = rng.normal(size=size.size) * 5e-3 * size
    x[n + 2:n + 2 + size.size] = rng.normal(size=size.size) * 0.5 * size
    values = {Kind.MASS: 0.7, Kind.FIRST_X: 0.05, Kind.FIRST_Y: 0.02, Kind.INERTIA: 0.02, Kind.STIFFNESS: 0.02,
              Kind.DAMPING: 0.01, Kind.VISCOUS: 0.05, Kind.COULOMB: 0.02, Kind.ROTOR: 0.01, Kind.TORQUE_GAIN: 0.03,
              Kind.CONSTANT: 0.8}
    x[2 * n:] = [values.get(Kind(kind), 0.0) for kind in arm.kind]
    process_model.set_parameters(arm, x)
    return x


def linearize(arm, x: np.ndarray) -> np.ndarray:
    """The accelerations; their derivatives stand in the arm."""
    rows = np.array([[0.0, *(TORQUE / arm.gain)]])
    assert process_model.predict(arm, x, np.eye(x.size), x.size, rows, 1e-3, 0.0)
    return arm.k[0].copy()


def fine(arm, x: np.ndarray, n: int, duration: float) -> np.ndarray:
    """Integration to 1e-12, which counts as exact."""
    def slope(_, state):
        qdd = np.zeros(n)
        assert process_model.accelerate(arm, state[:n].copy(), state[n:].copy(), qdd)
        return np.concatenate([state[n:], qdd])

    found = scipy.integrate.solve_ivp(slope, (0.0, duration), x[:2 * n], method='DOP853', rtol=1e-12, atol=1e-15)
    assert found.success
    return found.y[:, -1]


def error(arm, x: np.ndarray, exact: np.ndarray, n: int, duration: float, h: float) -> float:
    state, spread = x.copy(), np.zeros((x.size, x.size))
    rows = np.array([[0.0, *(TORQUE / arm.gain)]])
    for _ in range(round(duration / h)):
        assert process_model.predict(arm, state, spread, 0, rows, h, h)
    return float(np.abs(state[:n] - exact[:n]).max())


def test_a_step_of_one_sample_is_of_fifth_order(arm):
    n = arm.arm.stiffness.size
    x = bent(arm, n)
    x[2 * n:][arm.kind == Kind.COULOMB] = 0.0  # it has no third derivative to speak of
    process_model.set_parameters(arm, x)
    exact = fine(arm, x, n, 0.02)
    coarse, halved = (error(arm, x, exact, n, 0.02, h) for h in (2e-4, 1e-4))
    assert coarse < 1e-10  # of bends of 5e-3 m
    assert halved < coarse / 25  # 2^5 as the step goes to zero


def test_samples_in_which_the_fastest_mode_turns_by_more_than_a_radian_keep_an_undamped_arm_to_a_nanometre():
    arm = motion(configure(IdentifierParameters, {}))
    n, h = arm.arm.stiffness.size, 1e-3
    assert 1.0 < process_model.STEP_ANGLE / arm.substeps * h < process_model.STEP_ANGLE
    x = bent(arm, n)
    x[2 * n:] = np.where(arm.kind == Kind.MASS, 20.0, 0.0)
    arm.effort[:] = TORQUE
    process_model.set_parameters(arm, x)
    # errors of steps add up while an arm rings: 2e-9 m here put 20 kg outside their interval after 22 s
    assert error(arm, x, fine(arm, x, n, 0.1), n, 0.1, h) < 1e-9


def carried(arm, state: np.ndarray, spread: np.ndarray, rows: np.ndarray, samples: int) -> np.ndarray:
    """q and q' so many samples of 1 ms later; spread is moved in place."""
    state = state.copy()
    for _ in range(samples):
        assert process_model.predict(arm, state, spread, spread.shape[1], rows, 1e-3, 1e-3)
    return state[:2 * arm.arm.stiffness.size]


def test_a_tenth_of_a_second_later_the_spread_of_what_vibrates_is_the_derivative_of_the_motion():
    arm = motion(configure(IdentifierParameters, {}))
    n, moment = arm.arm.stiffness.size, (np.array([[0.0, *TORQUE]]), 100)
    x = bent(arm, n)
    x[2 * n:] = np.where(arm.kind == Kind.MASS, 20.0, 0.0)  # undamped: what the steps add or take stays
    size = np.repeat([1.0, 1e-3], n)
    spread, none = np.eye(x.size), np.zeros((x.size, 0))
    carried(arm, x, spread, *moment)
    for c in range(2 * n):
        found = size * spread[:2 * n, c]
        step = np.zeros(x.size)
        step[c] = 2e-7 / np.abs(found).max()
        high, low = (carried(arm, state, none, *moment) for state in (x + step, x - step))
        exact = size * (high - low) / (2.0 * step[c])
        # linearized where a sample begins, half a sample late, up to 2.4 %
        assert np.linalg.norm(found - exact) <= 0.005 * np.linalg.norm(exact), c


def test_the_linearisation_is_the_derivative_of_the_motion(arm):
    n = arm.arm.stiffness.size
    x = bent(arm, n)
    linearize(arm, x)
    F = arm.F.copy()
    for i in range(2 * n):
        up, down = x.copy(), x.copy()
        up[i] += 1e-6
        down[i] -= 1e-6
        high, low = linearize(arm, up), linearize(arm, down)
        given = F[:, i]
        np.testing.assert_allclose((high - low) / 2e-6, given, rtol=1e-4, atol=1e-6 * np.abs(given).max())


@pytest.mark.parametrize('sticks', [0.0, 3000.0], ids=['vibrating', 'a joint sticks'])
def test_the_spread_moves_as_the_matrix_exponential_says(arm, sticks):
    n = arm.arm.stiffness.size
    x, fastest = bent(arm, n), process_model.STEP_ANGLE / arm.substeps
    linearize(arm, x)
    arm.F[0, n] -= sticks
    stiff = -np.trace(arm.F[:, n:])
    h = min(arm.substeps, process_model.STIFF_STEP / stiff)
    count = process_model.terms(max(fastest, stiff) * h, process_model.SPREAD_ERROR)
    rng = np.random.default_rng(3)
    scale = np.repeat([1.0, fastest, 1.0], [n, n, arm.kind.size])[:, None]
    arm.G[:] = rng.normal(size=arm.G.shape) * fastest ** 2
    # behind the state stands p s, s from -1 to 1 in the step, which the slopes multiply
    parameters = arm.kind.size
    flow = np.zeros((x.size + parameters, x.size + parameters))
    flow[:n, n:2 * n], flow[n:2 * n, :2 * n], flow[n:2 * n, 2 * n:] = np.eye(n), arm.F, arm.G
    flow[x.size:, 2 * n:x.size] = 2.0 / h * np.eye(parameters)
    S = scale * rng.normal(size=(x.size, x.size))
    moved = S.copy()
    process_model.spread(arm.F, arm.G, arm.opened, moved, x.size, arm.scratch, h, count)
    exact = (scipy.linalg.expm(h * flow) @ np.concatenate([S, -S[2 * n:]]))[:x.size]
    assert np.abs((moved - exact) / scale).max() < process_model.SPREAD_ERROR * np.abs(exact / scale).max()


@pytest.mark.parametrize(('dynamics', 'gravity'), [
    ('nonlinear', [0.0, 0.0]), ('nonlinear', [2.0, -9.81]), ('linear', [0.0, 0.0])])
def test_the_derivatives_by_what_is_learned_are_those_of_the_motion(dynamics, gravity):
    arm = placed(dynamics, np.array([1.0, 0.6]), gravity)
    assert (Kind.POINT in arm.kind) == (dynamics == 'linear')
    assert (Kind.CONSTANT in arm.kind) == (dynamics == 'nonlinear')
    n = arm.arm.stiffness.size
    x = bent(arm, n)
    low, high = np.zeros(n), np.zeros(n)
    moment = np.array([[0.0, *(TORQUE / arm.gain)]]), 1e-3, 1e-13  # over no time they are those at x
    assert process_model.predict(arm, x.copy(), np.eye(x.size), x.size, *moment)
    G = arm.G[:, :arm.kind.size].copy()
    for c in range(arm.kind.size):
        up, down = x.copy(), x.copy()
        up[2 * n + c] += 1e-5
        down[2 * n + c] -= 1e-5
        for state, acceleration in ((up, high), (down, low)):
            process_model.set_parameters(arm, state)
            arm.effort[:] = arm.gain * TORQUE / np.exp(0.03)
            process_model.accelerate(arm, x[:n].copy(), x[n:2 * n].copy(), acceleration)
        np.testing.assert_allclose((high - low) / 2e-5, G[:, c], rtol=1e-4, atol=1e-5 * np.abs(G[:, c]).max() + 1e-9)


def test_a_linear_plant_whose_links_stay_at_another_angle_moves_as_one_that_was_told_so():
    """With what it holds, to first order in the angle."""
    found, turn = [], 1e-3
    for angles, point in (((0.3, 0.9), 0.0), ((0.3, 0.9), turn), ((0.3, 0.9 + turn), 0.0)):
        arm = placed('linear', np.array(angles))
        x = bent(arm, arm.arm.stiffness.size)
        x[2 * arm.arm.stiffness.size:][arm.kind == Kind.POINT] = point
        found.append(linearize(arm, x))
    before, turned, told = found
    assert np.abs(turned - told).max() < 2.0 * turn * np.abs(told - before).max()


@pytest.mark.parametrize('base', [
    {}, {'arm.base_mass': 700.0, 'arm.base_inertia': 180.0, 'arm.base_joint_offset': [0.3, 0.1]}],
    ids=['pinned', 'floating'])
def test_what_is_learned_moves_a_vibration_that_turns_by_a_radian_in_a_sample_as_far_as_the_motion_does(base):
    arm = motion(configure(IdentifierParameters, {**base, **UNSURE}))
    n = arm.arm.stiffness.size
    assert 1e-3 / arm.substeps > 0.5  # a step is at most two radians of the fastest mode
    x = bent(arm, n)
    x[n] -= 0.3  # so that no joint reverses: a jump of the friction is no line over a sample
    moment = np.array([[0.0, *(TORQUE / arm.gain)]]), 20
    spread, none = np.eye(x.size), np.zeros((x.size, 0))
    carried(arm, x, spread, *moment)
    size = np.abs(spread[:2 * n, :2 * n]).max(axis=1)  # of what each state can become
    for c in range(arm.kind.size):
        if arm.kind[c] in (Kind.BEND_GAIN, Kind.BEND_OFFSET):  # of the sensors
            continue
        step = np.zeros(x.size)
        step[2 * n + c] = 1e-4
        high, low = (carried(arm, state, none, *moment) for state in (x + step, x - step))
        exact = (high - low) / 2e-4 / size
        found = spread[:2 * n, 2 * n + c] / size
        # held over a sample, a rotor is 3 % off, a first moment 1 %
        assert np.linalg.norm(found - exact) <= 0.003 * np.linalg.norm(exact), Kind(arm.kind[c]).name


@pytest.mark.parametrize('gravity', [[0.0, 0.0], [2.0, -9.81]])
def test_an_arm_with_other_lengths_and_masses_moves_as_the_given_one_with_errors_of_its_constants(gravity):
    """To first order: a link that is longer by e has displacements that are larger by 1 + e."""
    # of sines no mode has a mass added
    sines = {**SHORT, **UNSURE, 'arm.gravity': gravity, 'arm.shape_functions': 'sines', 'arm.modes': 5}
    longer, denser, heavier = np.array([[1.0, -2.0], [3.0, 2.0], [-1.5, 2.5]]) * 1e-4
    given = motion(configure(IdentifierParameters, sines))
    true = motion(configure(IdentifierParameters, {
        **sines, 'arm.link_length': np.array(SHORT['arm.link_length']) * (1.0 + longer),
        'arm.linear_density': np.array(SHORT['arm.linear_density']) * (1.0 + denser),
        'arm.joint_mass': 1.5 * (1.0 + heavier[0]), 'arm.tip_mass': 0.8 * (1.0 + heavier[1])}))
    n, modes = given.arm.stiffness.size, given.arm.kappa
    size = np.concatenate([np.ones(2), np.repeat(1.0 + longer, modes)])

    def accelerations(arm, mass, factor, stiffness, constants):
        x = np.zeros(2 * n + arm.kind.size)
        x[:2 * n] = bent(given, n)[:2 * n] * np.tile(factor, 2)
        p = x[2 * n:]
        p[arm.kind == Kind.MASS], p[arm.kind == Kind.STIFFNESS], p[arm.kind == Kind.CONSTANT] = (
            mass, stiffness, constants)
        arm.effort[:] = TORQUE
        process_model.set_parameters(arm, x)
        return linearize(arm, x)

    felt = -longer if any(gravity) else np.zeros(2)
    errors = np.array([
        [3.0 * longer[0] + denser[0], 1.5 * (2.0 * longer[0] + heavier[0]), longer[0] - longer[1], felt[0]],
        [3.0 * longer[1] + denser[1], 0.8 * (2.0 * longer[1] + heavier[1]), 0.0, felt[1]]]).ravel()
    axes = given.constants.reshape(-1, errors.size).T
    along = np.linalg.lstsq(axes, errors, rcond=None)[0]
    np.testing.assert_allclose(axes @ along, errors, atol=1e-12)
    exact = accelerations(true, 0.7, size, 0.0, 0.0) / size
    without = accelerations(given, 0.7, np.ones(n), 0.0, np.zeros(along.size))
    found = accelerations(given, 0.7 * (1.0 + 2.0 * longer[1]), np.ones(n), -longer, along)
    assert np.linalg.norm(found - exact) < 0.01 * np.linalg.norm(exact - without)


@pytest.mark.parametrize(('begin', 'end'), [
    (0.3, 0.3), (-0.7, -0.7001), (-1.0, 2.0), (40.0, -25.0), (-300.0, 500.0), (600.0, 610.0)])
def test_the_friction_over_a_sample_is_the_mean_over_rates_on_a_line(begin, end):
    exact, _ = scipy.integrate.quad(lambda u: np.tanh(begin + u * (end - begin)), 0.0, 1.0, points=[0.4, 0.375, 1 / 3],
                                    epsabs=1e-10, limit=400)
    assert process_model.mean_share(begin, end) == pytest.approx(exact, abs=1e-8)


def test_where_the_rate_of_a_joint_was_measured_its_coulomb_friction_does_not_depend_on_the_state(arm):
    n = arm.arm.stiffness.size
    x, coulomb = bent(arm, n), np.flatnonzero(arm.kind == Kind.COULOMB)
    shares = np.array([-0.4, 0.9])
    rates = process_model.STICTION_RATE * np.arctanh(shares)
    free = x.copy()
    free[2 * n + coulomb] = 0.0
    process_model.set_parameters(arm, free)
    rows = np.array([[0.0, *((TORQUE - x[2 * n + coulomb] * shares) / arm.gain), np.nan, np.nan, np.nan, np.nan]])
    for state, row in ((free, rows), (x, np.array([[0.0, *(TORQUE / arm.gain), *rates, *rates]]))):
        assert process_model.predict(arm, state, np.eye(x.size), x.size, row, 1e-3, 1e-3)
    np.testing.assert_allclose(x[:2 * n], free[:2 * n], rtol=1e-12)


def test_steps_are_counted_and_an_arm_too_stiff_to_be_one_is_refused(arm):
    n = arm.arm.stiffness.size
    x, rows = bent(arm, n), np.zeros((1, 3))
    viscous = np.flatnonzero(arm.kind == Kind.VISCOUS)
    spread = np.zeros((x.size, x.size))
    steps = []
    for friction in (0.0, 100.0, 1e4):  # [N m s/rad]
        state = x.copy()
        state[2 * n + viscous] = friction
        steps.append(process_model.predict(arm, state, spread, 0, rows, 1e-3, 1e-3))
    assert 1 <= steps[0] < steps[1]
    assert steps[2] == 0


@pytest.mark.parametrize('learn', [['mode_stiffness'], ['mode_stiffness', 'stiffness'], ['stiffness', 'mode_stiffness'],
                                   ['stiffness', 'mode_stiffness', 'stiffness']])
def test_the_stiffness_of_a_mode_is_a_factor_on_that_of_its_link_whatever_is_learned_in_whatever_order(learn):
    arm = motion(configure(IdentifierParameters, {'arm.shape_functions': 'sines', 'payload.learn': learn}))
    x = np.zeros(2 * arm.arm.stiffness.size + arm.kind.size)
    p = x[2 * arm.arm.stiffness.size:]
    p[arm.kind == Kind.MODE] = 0.01
    p[(arm.kind == Kind.STIFFNESS) & (arm.prior > 0.0)] = 0.1
    links = np.exp(0.1 if 'stiffness' in learn else 0.0)
    for _ in range(2):
        process_model.set_parameters(arm, x)
        np.testing.assert_allclose(arm.arm.stiffness[2:] / arm.stiffness[2:],
                                   np.tile(links * np.exp([0.0, 0.01, 0.01]), 2), rtol=1e-12)
    assert np.count_nonzero(arm.kind == Kind.STIFFNESS) == 2
