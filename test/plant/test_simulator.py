"""The simulator: one by one or at once, conservation, noise, faults."""

from __future__ import annotations

import contextlib
import itertools
from dataclasses import replace

import mechanics
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexmanip_ros.errors import ModelError, ParameterError, SignalError
from flexmanip_ros.parameters import ArmParameters, ExcitationParameters, PlantParameters
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import CaptureEvent, EventKind

CLEAN = PlantParameters(noise='none', arm=ArmParameters(modes=2))
WAVES = excitation.sequence(ExcitationParameters(), 6000)
CAPTURE = CaptureEvent(300_000_000, EventKind.CAPTURE)
RELEASE = CaptureEvent(600_000_000, EventKind.RELEASE)


@pytest.mark.parametrize('change', [
    {'noise': 'none'}, {'noise': 'std'}, {'noise': 'none', 'model': 'linear'},
    {'noise': 'std', 'gripper_ramp': 0.1, 'payload_inertia': 2.0, 'payload_com': (0.1, 0.05)},
], ids=['clean', 'noisy', 'linear', 'soft gripper'])
def test_stepping_and_simulating_give_the_same_bits(change: dict[str, object]) -> None:
    config = replace(CLEAN, **change)
    run = simulator.simulate(config, WAVES[:900], (RELEASE, CAPTURE), start_ns=0)
    state = simulator.init(config)
    for k in range(900):
        now = simulator.stamp(config, state)
        if now == CAPTURE.stamp_ns:
            state = simulator.attach(config, state)
        if now == RELEASE.stamp_ns:
            state = simulator.release(config, state)
        state, record = simulator.step(config, state, WAVES[k])
        assert record.stamp_ns == run.stamp_ns[k]
        assert np.array_equal(record.position, run.position[k])
        assert np.array_equal(record.velocity, run.velocity[k])
        assert np.array_equal(record.effort[:2], run.effort[k])


@given(moments=st.lists(st.integers(-5, 70), max_size=4), ramp=st.sampled_from([0.0, 0.005, 0.03]),
       seed=st.integers(0, 5))
@settings(max_examples=25, deadline=None)
def test_any_sequence_of_events_gives_the_same_bits(moments: list[int], ramp: float, seed: int) -> None:
    config = replace(CLEAN, arm=ArmParameters(modes=1), noise='std', gripper_ramp=ramp, seed=seed)
    kinds = [EventKind.CAPTURE, EventKind.CAPTURE, EventKind.RELEASE, EventKind.CAPTURE]
    events = [CaptureEvent(moment * 1_000_000 - 300_000, kind)
              for moment, kind in zip(sorted(moments), kinds, strict=False)]
    run = simulator.simulate(config, WAVES[:60], events)
    state, waiting = simulator.init(config), list(events)
    for k in range(60):
        while waiting and waiting[0].stamp_ns <= simulator.stamp(config, state):
            change = simulator.attach if waiting.pop(0).kind is EventKind.CAPTURE else simulator.release
            state = change(config, state)
        state, record = simulator.step(config, state, WAVES[k])
        assert record is not None
        assert np.array_equal(record.position, run.position[k])
        assert np.array_equal(record.velocity, run.velocity[k])


def test_a_long_run_is_simulated_in_blocks_between_which_an_interrupt_ends_it(monkeypatch) -> None:
    whole = simulator.simulate(CLEAN, WAVES[:900], (CAPTURE,))
    sizes, advance = [], simulator._advance

    def counted(config, state, efforts):
        sizes.append(len(efforts))
        return advance(config, state, efforts)

    monkeypatch.setattr(simulator, '_advance', counted)
    monkeypatch.setattr(simulator, 'LONGEST_BLOCK', 70)
    in_blocks = simulator.simulate(CLEAN, WAVES[:900], (CAPTURE,))
    assert max(sizes) == 70
    np.testing.assert_array_equal(in_blocks.position, whole.position)


def test_steps_do_not_change_the_state_they_start_from() -> None:
    start = simulator.init(CLEAN)
    _, first = simulator.step(CLEAN, start, np.array([10.0, 5.0]))
    after, again = simulator.step(CLEAN, start, np.array([10.0, 5.0]))
    assert np.array_equal(first.position, again.position)
    _, later = simulator.step(CLEAN, after, np.zeros(2))
    assert not np.array_equal(later.position, first.position)


@pytest.mark.parametrize('shortening', [False, True])
@pytest.mark.parametrize(('shapes', 'substeps'), [('sines', 0), ('component_modes', 20)])
def test_energy_is_conserved_without_torque(shapes: str, substeps: int, shortening: bool) -> None:
    """Shapes of end moments ring faster, and Runge and Kutta damp what turns far in a step."""
    config = replace(CLEAN, substeps=substeps, arm=ArmParameters(
        shape_functions=shapes, modes=2, shortening=shortening))
    state = simulator.init(config)
    for k in range(500):  # bends of 15 mm and some turning
        state, _ = simulator.step(config, state, 40 * WAVES[k])
    model = state.model
    half = state.x.size // 2

    def energy(now: simulator.PlantState) -> float:
        return mechanics.energy(model.arm, now.payload, now.x[:half], now.x[half:])

    before = energy(state)
    assert before > 1.0
    for _ in range(2000):
        state, _ = simulator.step(config, state, np.zeros(2))
    assert energy(state) == pytest.approx(before, rel=1e-6)


def test_damping_only_takes_energy() -> None:
    config = replace(CLEAN, arm=ArmParameters(modes=2, damping_ratio=0.02))
    state = simulator.init(config)
    for k in range(300):
        state, _ = simulator.step(config, state, WAVES[k])
    half = state.x.size // 2
    energies = []
    for _ in range(300):
        state, _ = simulator.step(config, state, np.zeros(2))
        energies.append(mechanics.energy(state.model.arm, state.payload, state.x[:half], state.x[half:]))
    assert np.all(np.diff(energies) < 0)


def test_small_motion_is_that_of_the_linear_plant() -> None:
    small = 1e-3 * WAVES[:500]
    arm = ArmParameters(modes=2)
    nonlinear = simulator.simulate(replace(CLEAN, arm=arm, substeps=20), small)
    linear = simulator.simulate(replace(CLEAN, arm=arm, model='linear'), small)
    scale = linear.velocity.std(axis=0)
    assert np.abs(nonlinear.velocity - linear.velocity).max() < 2e-3 * scale.min()
    assert np.abs(nonlinear.position - linear.position).max() < 1e-6


def test_the_first_encoder_angles_follow_from_the_chords() -> None:
    run = simulator.simulate(CLEAN, np.zeros((1, 2)))
    assert np.degrees(run.position[0, :2]) == pytest.approx([60.0, -15.0], abs=1e-9)
    chord = replace(CLEAN, arm=ArmParameters(angle_convention='chord'))
    run = simulator.simulate(chord, np.zeros((1, 2)))
    assert np.degrees(run.position[0, :2]) == pytest.approx([60.0, 45.0], abs=1e-9)


def test_substeps_are_fine_enough() -> None:
    config = replace(CLEAN, arm=ArmParameters(shape_functions='sines', modes=3))
    run = simulator.simulate(config, WAVES[:1000], (CAPTURE,))
    fine = simulator.simulate(replace(config, substeps=40), WAVES[:1000], (CAPTURE,))
    assert np.all(np.abs(run.position - fine.position).max(0) < 1e-4 * fine.position.std(0))


@pytest.mark.parametrize('snr_db', [20.0, 40.0])
def test_noise_has_the_ratio_asked_for(snr_db: float) -> None:
    config = replace(CLEAN, noise='snr', snr_db=snr_db)
    event = (CaptureEvent(3_000_000_000, EventKind.CAPTURE),)
    clean = simulator.simulate(CLEAN, WAVES, event)
    noisy = simulator.simulate(config, WAVES, event)
    for name in ('position', 'velocity'):
        signal, error = getattr(clean, name), getattr(noisy, name) - getattr(clean, name)
        ratio = 20 * np.log10(signal.std(axis=0) / error.std(axis=0))
        assert ratio == pytest.approx(snr_db, abs=0.3)
    rehearsed = simulator.init(config).noise_std
    assert rehearsed[:4] == pytest.approx(clean.position.std(axis=0) * 10 ** (-snr_db / 20), rel=1e-12)


def test_noise_is_white_independent_and_repeats_with_the_seed() -> None:
    config = replace(CLEAN, noise='std', noise_std=(1.0,) * 8)
    still = np.zeros((6000, 2))
    run = simulator.simulate(config, still)
    x = np.hstack([run.position, run.velocity])
    x = (x - x.mean(0)) / x.std(0)
    correlation = np.hstack([x[1:], x[:-1]]).T @ np.hstack([x[1:], x[:-1]]) / len(x)
    assert np.abs(correlation - np.eye(16)).max() < 0.06
    assert np.array_equal(run.position, simulator.simulate(config, still).position)
    other = simulator.simulate(replace(config, seed=2), still)
    assert not np.array_equal(run.position, other.position)


def test_a_diverging_simulation_stops_with_a_name() -> None:
    with pytest.raises(ModelError, match='diverged'):
        simulator.simulate(CLEAN, np.full((2000, 2), 1e9))
    with pytest.raises(ModelError, match='diverged'):
        simulator.simulate(replace(CLEAN, model='linear'), np.full((20000, 2), 1e9))


@pytest.mark.parametrize('efforts', [np.zeros((5, 3)), np.zeros(5), np.array([[0.0, np.nan]])])
def test_efforts_that_make_no_sense_are_refused(efforts: np.ndarray) -> None:
    with pytest.raises(SignalError, match='effort'):
        simulator.simulate(CLEAN, efforts)


def test_an_unstable_step_is_refused_by_name() -> None:
    with pytest.raises(ParameterError, match='substeps'):
        simulator.init(replace(CLEAN, rate=200.0, arm=ArmParameters(modes=8), substeps=1))
    with pytest.raises(ParameterError, match='rate'):
        simulator.init(replace(CLEAN, rate=1.0, arm=ArmParameters(modes=12)))


@pytest.mark.parametrize('field', ['link_length', 'linear_density', 'bending_stiffness'])
def test_a_length_density_or_stiffness_of_zero_is_refused_by_name(field: str) -> None:
    with pytest.raises(ParameterError, match=field):
        ArmParameters(**{field: (1.0, 0.0)})
    for name in ('joint_mass', 'tip_mass'):
        with pytest.raises(ParameterError, match=name):
            ArmParameters(**{name: 0.0})
    with pytest.raises(ParameterError, match='modes'):
        ArmParameters(modes=0)
    with pytest.raises(ParameterError, match='sensor_position'):
        ArmParameters(sensor_position=(0.5, 1.2))


@pytest.mark.parametrize('model', ['nonlinear', 'linear'])
def test_an_object_of_any_allowed_size_and_speed_gives_numbers_or_an_error_of_the_package(model: str) -> None:
    start = simulator.init(replace(CLEAN, model=model))
    for mass, inertia, com, velocity in itertools.product(
            (0.0, 1e-300, 1e9), (0.0, 1e12), ((0.0, 0.0), (1e3, -1e3)), ((0.0, 0.0), (1e6, -1e6))):
        config = replace(CLEAN, model=model, payload_mass=mass, payload_inertia=inertia, payload_com=com,
                         object_velocity=velocity, object_spin=-1e6)
        with contextlib.suppress(ModelError):
            _, record = simulator.step(config, simulator.attach(config, start), np.ones(2))
            assert record is not None
            assert np.isfinite([*record.position, *record.velocity]).all()


@pytest.mark.parametrize('change', [
    {'payload_mass': 1e308}, {'payload_inertia': 1e308}, {'payload_com': (1e160, 0.0)},
    {'object_velocity': (1e308, 0.0)}, {'object_spin': -1e308}])
def test_an_object_whose_moments_overflow_is_rejected(change: dict[str, object]) -> None:
    with pytest.raises(ParameterError, match=next(iter(change))):
        replace(CLEAN, **change)


def test_a_torque_whose_offset_and_amplitude_add_up_to_infinity_is_rejected() -> None:
    with pytest.raises(ParameterError, match='amplitude'):
        ExcitationParameters(amplitude=(1.7e308, 0.0), offset=(1.7e308, 0.0))
