"""The program reproduce_paper."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from flexmanip_ros import paper
from flexmanip_ros.cli.reproduce_paper import main
from flexmanip_ros.paper_response import identified_response, true_response
from flexmanip_ros.plant.linearization import discretize, vibration_model
from flexmanip_ros.types import StateSpace


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding='utf-8') as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope='module')
def output(tmp_path_factory):
    folder = tmp_path_factory.mktemp('paper')
    assert main(['--runs', '1', '--case', 'payload_20', '--workers', '0', '--output', str(folder)]) == 0
    return folder


def test_every_method_has_its_row_and_nothing_failed(output):
    rows = _rows(output / 'runs.csv')
    assert [row['method'] for row in rows] == [method.name for method in paper.METHODS]
    assert all(row['error'] == '' for row in rows)
    errors = {row['method']: float(row['error_percent']) for row in rows}
    assert errors['structured'] < 0.5
    assert errors['restart'] < errors['paper']


def test_the_summary_has_error_coverage_and_cost(output):
    for line in _rows(output / 'summary.csv'):
        assert line['case'] == '20 kg at 60/45 deg'
        assert 0.0 <= float(line['95 % interval holds [%]']) <= 100.0
        assert float(line['time per sample [us]']) > 0.0


def test_the_page_has_every_figure_and_needs_nothing_else(output):
    text = (output / 'report.html').read_text(encoding='utf-8')
    for number in (2, 3, 6, 7, 8, 9, 13, 14, 15, 16, 19):
        assert f'Fig. {number}:' in text
    for title in ('Figs. 4, 5:', 'Figs. 11, 12:', 'Figs. 17, 18:', 'Table 2:', 'Deviations'):
        assert title in text
    assert 'http' not in text


def test_the_exact_model_answers_the_test_input_as_the_arm_does():
    case = paper.PAYLOADS[0]
    from flexmanip_ros.paper_response import RATE, arm

    A, B = discretize(*vibration_model(arm(), np.radians(case.angles_deg), case.payload), 1.0 / RATE)
    exact = StateSpace(A, B, np.eye(4), np.zeros((4, 2)), np.zeros((4, 4)), 1.0 / RATE)
    mass = np.array([case.payload])
    track = paper.Track(mass, mass, mass, mass, np.empty((1, 2)), exact)
    found, true = identified_response(case, track), true_response(case)
    np.testing.assert_allclose(found.angles, true.angles, atol=1e-12)
    np.testing.assert_allclose(found.bends, true.bends, atol=1e-12)
    assert np.abs(true.angles).max() > 1e-4


def test_a_run_without_a_model_has_no_test_response():
    empty = np.empty(0)
    track = paper.Track(empty, empty, empty, empty, np.empty((0, 2)), None)
    assert identified_response(paper.PAYLOADS[0], track) is None


@pytest.mark.parametrize('arguments', [['--runs', '0'], ['--output', '/dev/null/x']])
def test_bad_arguments_are_one_line_and_exit_2(capsys, arguments):
    assert main(arguments) == 2
    assert capsys.readouterr().err.count('\n') == 1
