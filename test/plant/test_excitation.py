"""The torque sources."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flexmanip_ros.errors import ParameterError
from flexmanip_ros.parameters import ExcitationParameters
from flexmanip_ros.simulation import excitation

SHAPES = ['square', 'multisine', 'prbs', 'chirp', 'zero']


@pytest.mark.parametrize('shape', SHAPES)
def test_one_sample_and_a_sequence_agree(shape: str) -> None:
    config = ExcitationParameters(shape=shape, offset=(1.0, -2.0))
    rows = excitation.sequence(config, 9000)
    for k in range(0, 9000, 211):
        assert np.array_equal(excitation.torque(config, k), rows[k])


@pytest.mark.parametrize('shape', SHAPES[:-1])
def test_the_peak_is_the_amplitude_and_the_joints_differ(shape: str) -> None:
    rows = excitation.sequence(ExcitationParameters(shape=shape), 4000)
    assert np.abs(rows).max(axis=0) == pytest.approx([10.0, 5.0], rel=1e-3)
    assert abs(np.corrcoef(rows.T)[0, 1]) < 0.2


def test_square_waves_are_the_papers() -> None:
    rows = excitation.sequence(ExcitationParameters(), 2000)
    expected = [[10, 5], [10, -5], [-10, 5], [-10, -5]]
    assert np.array_equal(rows[::250], expected * 2)


def test_a_multisine_has_a_flat_band_and_a_low_peak() -> None:
    rows = excitation.sequence(ExcitationParameters(shape='multisine', band=(1.0, 10.0)), 4000)
    for i in range(2):
        assert np.max(np.abs(rows[:, i])) / np.sqrt(np.mean(rows[:, i] ** 2)) < 1.6, 'crest factor'
        lines = np.abs(np.fft.rfft(rows[:, i]))
        inside = lines[4:41]
        assert np.abs(lines[41:]).max() < 1e-9 * inside.max()
        used = inside[inside > 1e-6 * inside.max()]
        assert used == pytest.approx(np.full(used.size, used.mean()), rel=1e-9)
    assert abs(rows[:, 0] @ rows[:, 1]) < 1e-6 * np.linalg.norm(rows[:, 0]) * np.linalg.norm(rows[:, 1])


def test_random_shapes_repeat_with_their_seed() -> None:
    for shape in ('multisine', 'prbs'):
        config = ExcitationParameters(shape=shape)
        rows = excitation.sequence(config, 4000)
        assert np.array_equal(rows, excitation.sequence(config, 4000))
        assert not np.array_equal(rows, excitation.sequence(replace(config, seed=2), 4000))


@pytest.mark.parametrize(('change', 'word'), [
    ({'band': (5.0, 1.0)}, 'band'), ({'shape': 'chirp', 'band': (1.0, 800.0)}, 'band'),
    ({'shape': 'multisine', 'band': (1.01, 1.02)}, 'band'), ({'shape': 'sawtooth'}, 'shape'),
    ({'period': (1.0, 1.5e-3)}, 'period'), ({'shape': 'prbs', 'bit_time': 5e-4}, 'bit_time'),
    ({'shape': 'prbs', 'bit_time': 3.0}, 'bit_time')])
def test_a_signal_that_cannot_be_made_is_refused(change: dict[str, object], word: str) -> None:
    with pytest.raises(ParameterError, match=word):
        ExcitationParameters(**change)
