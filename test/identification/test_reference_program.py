from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from linear_arm import configuration, run, shared_data

from flexmanip_ros.identification.model_output import from_factor

SETTINGS = {'order': 3, 'past_window': 5, 'future_window': 3, 'forgetting_factor': [0.98] * 3,
            'regularization': [1e-6] * 3, 'direct_feedthrough': True, 'forgetting': 'constant'}


def pole_error(found: np.ndarray, true: np.ndarray) -> float:
    return min(float(np.abs(found - np.array(order)).mean()) for order in permutations(true))


def trajectory(reference, **choice):
    """State matrices after each sample from 400 to 1400, and the last."""
    config = configuration(2, 2, **SETTINGS, **choice)
    now = run(config, reference['u'][:400], reference['y'][:400])
    found = {}
    for k in range(400, len(reference['u'])):
        now = now.feed(reference['u'][k:k + 1], reference['y'][k:k + 1])
        state = now.state
        if config.estimator == 'paper':
            found[k] = state.memory[5][:, :3]
        elif k <= 1400 and k % 4 == 0:
            realized = from_factor(config, state.memory[0], state.scale)[0]
            assert realized is not None
            found[k] = realized.A
    return found


def mean_error(reference, found) -> float:
    return float(np.mean(
        [pole_error(np.linalg.eigvals(found[k]), reference['eig_true'][k])
         for k in range(400, 1401) if k in found]))


@pytest.mark.parametrize(('variant', 'choice'), [
    ('w0', {'weighted_observability': False}), ('w1', {'weighted_observability': True})])
def test_paper_recursion_reproduces_the_reference_program(variant, choice):
    reference = np.load(shared_data('rpbsid_reference.npz'))
    found = trajectory(reference, estimator='paper', **choice)
    assert np.abs(found[1500] - reference[f'A_{variant}']).max() < 1e-9
    theirs = np.mean([pole_error(reference[f'eig_{variant}'][k], reference['eig_true'][k])
                      for k in range(400, 1401)])
    assert mean_error(reference, found) < 1.002 * theirs  # the priors differ by their scaling


@pytest.mark.parametrize('basis', ['fixed', 'singular'])
def test_factor_tracks_the_poles_better_than_every_variant_of_the_reference_program(basis):
    reference = np.load(shared_data('rpbsid_reference.npz'))
    best = min(
        np.mean([pole_error(reference[f'eig_{v}'][k], reference['eig_true'][k]) for k in range(400, 1401)])
        for v in ('w0', 'w1', 'w1past'))
    assert mean_error(reference, trajectory(reference, state_basis=basis)) < best
