from __future__ import annotations

import numpy as np
import pytest
from linear_arm import benchmark

LONG = {'forgetting_factor': [0.9995] * 3, 'regularization': [1e-6] * 3}


@pytest.mark.parametrize('convention', ['paper', 'joint'])
@pytest.mark.parametrize('degrees', [(60.0, 45.0), (0.0, 0.0), (45.0, 0.0), (-45.0, 45.0)])
@pytest.mark.parametrize('mass', [20.0, 100.0])
def test_noise_free_record_gives_the_payload(convention, degrees, mass):
    study = benchmark('identification_paper_settings')
    u, y = study.response(mass, degrees, convention, 400.0, 0, capture=1000, samples=3000)
    window = {'capture': 1000, 'begin': 2500, 'every': 250}
    ways = [({}, y)]
    if mass == 20.0:
        ways += [(LONG | {'refinement': 'none'}, y), (LONG, y[:, :2]), (LONG | {'estimator': 'paper'}, y)]
    for settings, signals in ways:
        errors = study.payload_errors(settings, u, signals, mass, degrees, convention, **window)
        assert np.abs(errors).max() < 1e-3, settings


def test_paper_settings_are_off_by_tens_of_percent_and_a_restart_by_a_few():
    study = benchmark('identification_paper_settings')
    size, case = {}, (20.0, (60.0, 45.0), 'paper')
    for name in ("paper's three least squares, beta 0.99",
                 "paper's three least squares, beta 0.9995, restart", 'one factor, beta 0.9995, restart'):
        errors = [study.payload_errors(study.SETTINGS[name], *study.response(*case, 40.0, seed), *case)
                  for seed in range(4)]
        size[name] = float(np.abs(np.concatenate(errors)).mean())
    paper, restarted, factor = size.values()
    assert 0.2 < paper < 0.5
    assert restarted < 0.05
    assert factor < 0.04
