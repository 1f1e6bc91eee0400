"""The program reproduce_paper."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from flexmanip_ros import pipeline
from flexmanip_ros.arm.linearization import discretize, vibration_model
from flexmanip_ros.cli.reproduce_paper import main
from flexmanip_ros.paper import case_run, experiments, report
from flexmanip_ros.paper.figures import RATE, arm, identified_response, true_response
from flexmanip_ros.studies import trial
from flexmanip_ros.types import StateSpace

PAGE_OF_ONE_CASE = ('Fig. 2:', 'Fig. 3:', 'Figs. 4, 5:', 'Fig. 6:', 'Fig. 7:', 'Fig. 8:', 'Fig. 9:',
                    'Fig. 10:', 'Figs. 17, 18:')
COST = 'us_per_sample'
CASE = experiments.PAYLOADS[0]
Result = tuple[list[trial.Row], dict[str, case_run.Track]]


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding='utf-8') as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope='module')
def reproduced(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Result]:
    """The folder that the program wrote about one run of one case, and the rows and tracks of this run."""
    folder, runs, whole = tmp_path_factory.mktemp('paper'), [], case_run.run

    def kept(case: experiments.Case, seed: int) -> Result:
        assert (case, seed) == (CASE, 0)
        runs.append(whole(case, seed))
        return runs[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(case_run, 'run', kept)
        assert main(['--runs', '1', '--case', CASE.name, '--workers', '0', '--output', str(folder)]) == 0
    (result,) = runs
    return folder, result


@pytest.fixture
def output(reproduced: tuple[Path, Result]) -> Path:
    return reproduced[0]


def test_every_method_has_its_row_and_nothing_failed(output):
    rows = _rows(output / 'runs.csv')
    assert [row['method'] for row in rows] == [method.name for method in experiments.METHODS]
    assert all(row['error'] == '' for row in rows)
    errors = {row['method']: float(row['error_percent']) for row in rows}
    assert errors['structured'] < 0.5
    assert errors['restart'] < errors['paper']


def test_two_workers_give_the_bits_of_one(output, tmp_path, monkeypatch):
    planned = report.planned
    monkeypatch.setattr(report, 'planned', lambda *arguments: planned(*arguments)[:1])  # the rows are the claim
    assert main(['--runs', '1', '--case', CASE.name, '--workers', '2', '--output', str(tmp_path)]) == 0
    alone, together = _rows(output / 'runs.csv'), _rows(tmp_path / 'runs.csv')
    assert [row | {COST: ''} for row in alone] == [row | {COST: ''} for row in together]


@pytest.mark.parametrize('name', ['paper', 'structured'])
def test_methods_that_share_an_identifier_get_what_a_pass_of_their_own_gives(reproduced, name):
    shared = reproduced[1][1][name]
    made = experiments.scenario(CASE, next(known for known in experiments.METHODS if known.name == name))
    run = made.configuration(0, name)
    own = case_run.track_of(list(pipeline.run(run.identifier, trial.messages(made, run, 0))))
    held = own.time >= experiments.CAPTURE_TIME
    np.testing.assert_array_equal(own.mass[held], shared.mass[:-1][held])  # the last: at the last sample
    np.testing.assert_array_equal(own.frequencies, shared.frequencies[:-1])


def test_every_figure_of_the_paper_is_on_the_page(reproduced):
    _, (rows, tracks) = reproduced
    everywhere = {case.name: {name: [track] for name, track in tracks.items()} for case in experiments.CASES}
    all_rows = [row | {'case': case.name} for case in experiments.CASES for row in rows]
    planned = report.planned(everywhere, all_rows)
    numbers = {int(number) for one in planned for number in one.numbers.split(',')}
    assert numbers == set(range(2, 20))
    assert all(one.claim and one.measured for one in planned)


def test_the_working_point_of_a_linear_plant_leaves_known_coupling_unbiased(reproduced):
    row = next(row for row in reproduced[1][0] if row['method'] == 'known M_b')
    assert abs(row['payload_mass_kg'] / 20.0 - 1.0) < 0.02
    assert row['covered']


def test_the_summary_has_error_coverage_and_cost(output):
    for line in _rows(output / 'summary.csv'):
        assert line['case'] == '20 kg at 60/45 deg'
        assert 0.0 <= float(line['95 % interval holds [%]']) <= 100.0
        assert float(line['time per sample [us]']) > 0.0


def test_intervals_without_an_end_count_in_their_median_width():
    rows = [{'case': CASE.name, 'method': 'paper', 'error': '', 'error_percent': 1.0, 'payload_mass_kg': 20.0,
             'payload_lower_kg': 19.0, 'payload_upper_kg': upper, 'covered': True, COST: 1.0}
            for upper in (21.0, None, None)]
    (line,) = report.summary(rows, {})
    assert line['half width [%]'] == np.inf
    (line,) = report.summary(rows[:2], {(CASE.name, 'paper'): 0.2})
    assert line['half width [%]'] == np.inf  # the mean of 5 % and of one without an end
    (line,) = report.summary([rows[0], rows[0], rows[1]], {})
    assert line['half width [%]'] == pytest.approx(5.0)


def test_the_page_has_every_figure_and_needs_nothing_else(output):
    text = (output / 'report.html').read_text(encoding='utf-8')
    for title in (*PAGE_OF_ONE_CASE, 'Table 1:', 'Table 2:', 'Deviations'):
        assert title in text
    assert 'http' not in text


def test_the_exact_model_answers_the_test_input_as_the_arm_does():
    A, B = discretize(*vibration_model(arm(), np.radians(CASE.angles_deg), CASE.payload), 1.0 / RATE)
    exact = StateSpace(A, B, np.eye(4), np.zeros((4, 2)), np.zeros((4, 4)), 1.0 / RATE)
    mass = np.array([CASE.payload])
    track = case_run.Track(mass, mass, mass, mass, np.empty((1, 2)), exact)
    found, true = identified_response(CASE, track), true_response(CASE)
    np.testing.assert_allclose(found.angles, true.angles, atol=1e-12)
    np.testing.assert_allclose(found.bends, true.bends, atol=1e-12)
    assert np.abs(true.angles).max() > 1e-4


def test_a_run_without_a_model_has_no_test_response():
    empty = np.empty(0)
    track = case_run.Track(empty, empty, empty, empty, np.empty((0, 2)), None)
    assert identified_response(CASE, track) is None


def test_what_cannot_be_drawn_or_computed_is_said(tmp_path, capsys, monkeypatch):
    def fails(*_):
        raise ValueError('a reason')

    monkeypatch.setattr(report, 'drawing', fails)
    monkeypatch.setattr(case_run, 'bounds', fails)
    monkeypatch.setattr(case_run, 'run', fails)
    assert main(['--runs', '1', '--case', CASE.name, '--workers', '0', '--output', str(tmp_path)]) == 0
    told = capsys.readouterr().err.splitlines()
    assert 'reproduce_paper: the bounds of payload_20 could not be computed: ValueError: a reason' in told
    assert 'reproduce_paper: figure 2 could not be drawn: ValueError: a reason' in told
    assert 'could not be drawn' in (tmp_path / 'report.html').read_text(encoding='utf-8')
    assert all(row['error'] == 'ValueError: a reason' for row in _rows(tmp_path / 'runs.csv'))


@pytest.mark.parametrize('arguments', [['--runs', '0'], ['--output', '/dev/null/x']])
def test_bad_arguments_are_one_line_and_exit_2(capsys, arguments):
    assert main(arguments) == 2
    assert capsys.readouterr().err.count('\n') == 1
