"""The program monte_carlo: resumable, and a failed run is a row."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from quick_study import SCENARIO, rows_of, run, without_cost
from recordings import record, write

from flexmanip_ros.cli import identify_bag, simulate_bag, workers
from flexmanip_ros.io import bag
from flexmanip_ros.types import JointRecord


def test_one_row_a_run_and_the_same_bits_for_the_same_seed(scenario_file, tmp_path):
    for name in ('a.csv', 'b.csv'):
        assert run(scenario_file, '--runs', 3, '--workers', 0, '--output', tmp_path / name) == 0
    first, second = rows_of(tmp_path / 'a.csv'), rows_of(tmp_path / 'b.csv')
    assert [row['seed'] for row in first] == ['0', '1', '2']
    assert len({row['plant.payload_mass'] for row in first}) == 3
    assert without_cost(first) == without_cost(second)


def test_a_failed_run_is_a_row_with_its_error(scenario_file, tmp_path, capsys):
    scenario_file.write_text(SCENARIO + 'excitation: {amplitude: [1.0e+9, 1.0e+9]}\n', encoding='utf-8')
    out = tmp_path / 'out.csv'
    assert run(scenario_file, '--runs', 1, '--workers', 0, '--output', out) == 0
    assert 'diverged' in rows_of(out)[0]['error']


def test_the_report_shows_scores_runs_and_failures(tmp_path):
    from flexmanip_ros.io.report import study_report as report

    rows = [{'run': str(k), 'estimator': 'a', 'error': '', 'status': 'TRACKING', 'payload_true_kg': 20.0 + k,
             'payload_mass_kg': 20.1 + k, 'payload_lower_kg': 19.9 + k, 'payload_upper_kg': 20.2 + k,
             'covered': k > 0, 'error_percent': 0.5, 'us_per_sample': 50.0} for k in range(3)]
    report(tmp_path / 'page.html', 'name', [*rows, {'run': '3', 'estimator': 'a', 'error': 'it <broke>'}])
    text = (tmp_path / 'page.html').read_text(encoding='utf-8')
    assert text.count('data:image/png') == 1
    assert 'it &lt;broke&gt;' in text
    assert 'Failed: 1' in text


@pytest.mark.parametrize(('option', 'value'), [
    ('--runs', '100000000000'), ('--runs', '-1'), ('--workers', '9' * 400), ('--first-seed', '9' * 400)])
def test_numbers_beyond_all_use_are_refused_in_one_line(scenario_file, capsys, option, value):
    with pytest.raises(SystemExit, match='2'):
        run(scenario_file, option, value)
    error = capsys.readouterr().err
    assert f'{option}: ' in error
    assert 'is not a whole number from 0 to' in error
    assert error.count('\n') == 1
    assert len(error) < 200


@pytest.mark.parametrize('name', ['study.csv', 'quick.yaml'], ids=['the table', 'the scenario'])
def test_a_report_is_written_over_no_table_and_no_scenario(scenario_file, tmp_path, capsys, name):
    scenario = scenario_file.read_text(encoding='utf-8')
    assert run(scenario_file, '--runs', 1, '--workers', 0, '--output', tmp_path / 'study.csv',
               '--report', tmp_path / name) == 2
    assert 'does not end in .html' in capsys.readouterr().err
    assert scenario_file.read_text(encoding='utf-8') == scenario
    assert not (tmp_path / 'study.csv').exists()


def test_a_folder_of_recordings_is_a_study_and_a_broken_one_a_row(tmp_path):
    folder = tmp_path / 'bags'
    folder.mkdir()
    for name in ('one', 'two'):
        rng = np.random.default_rng(1)
        record(folder / name, [JointRecord(k * 1_000_000, ('a',), *rng.normal(size=(3, 1))) for k in range(300)])
    (folder / 'three.mcap').write_bytes(b'not a recording')
    (folder / 'one.truth.json').write_text(json.dumps({'payload_mass_kg': 20.0}), encoding='utf-8')
    out = tmp_path / 'out.csv'
    settings = ['--set=payload_method=none', '--set=inputs=[a/effort]', '--set=outputs=[a/position]',
                '--set=order=1']
    assert run(folder, '--workers', 0, '--output', out, *settings) == 0
    rows = {Path(row['run']).name: row for row in rows_of(out)}
    assert set(rows) == {'one', 'two', 'three.mcap'}
    assert 'cannot be read' in rows['three.mcap']['error']
    assert rows['one']['samples'] == '300'
    assert workers.true_payload(folder / 'one') == 20.0


def test_a_capture_that_nobody_announced_is_found_as_by_identify_bag_and_a_known_truth_stays(tmp_path, capsys):
    assert simulate_bag.main([str(tmp_path / 'source'), '--duration', '4.5', '--set', 'arm.damping_ratio=0.003']) == 0
    samples = [item for item in bag.read(tmp_path / 'source') if isinstance(item, JointRecord)]
    folder = tmp_path / 'bags'
    folder.mkdir()
    for name, count in (('silent', 4500), ('before', 1500)):  # in the second one no estimator can see the object
        record(folder / name, samples[:count])
        (folder / f'{name}.truth.json').write_text('{"payload_mass_kg": 20.0}', encoding='utf-8')
    arm = '--set=arm.damping_ratio=0.003'
    assert run(folder, '--workers', 0, '--output', tmp_path / 'out.csv', arm) == 0
    rows = {Path(row['run']).name: row for row in rows_of(tmp_path / 'out.csv')}
    capsys.readouterr()
    assert identify_bag.main([str(folder / 'silent'), '--json', arm]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found['capture_time_s'] == pytest.approx(3.0, abs=0.01)
    assert [float(rows['silent'][name]) for name in ('capture_time_s', 'payload_mass_kg', 'payload_std_kg')] == [
        found[name] for name in ('capture_time_s', 'payload_mass_kg', 'payload_std_kg')]
    assert rows['silent']['covered'] == 'True'
    assert (rows['before']['payload_true_kg'], rows['before']['covered']) == ('20.0', 'False')


@pytest.mark.parametrize('option', ['--runs', '--first-seed'])
def test_what_is_for_a_scenario_alone_is_refused_with_a_folder(tmp_path, capsys, option):
    (tmp_path / 'one.mcap').write_bytes(b'not a recording')
    assert run(tmp_path, option, 100, '--output', tmp_path / 'out.csv') == 2
    assert f'{option} is for a scenario; leave it away' in capsys.readouterr().err
    assert not (tmp_path / 'out.csv.journal').exists()


def test_a_file_of_a_recording_is_told_from_a_scenario(tmp_path, capsys):
    path = next(write(tmp_path / 'one').glob('*.mcap'))
    assert run(path, '--output', tmp_path / 'out.csv') == 2
    assert capsys.readouterr().err == (
        f"monte_carlo: '{path}' is a recording; give its folder; each recording in it is identified\n")


@pytest.mark.parametrize('place', ['.', ''])
def test_a_table_without_a_name_is_one_line(scenario_file, capsys, place):
    assert run(scenario_file, '--output', place) == 2
    assert capsys.readouterr().err == f"monte_carlo: '{place}' is a directory; give a file name\n"


FRAGILE = '''
import os
from flexmanip_ros.errors import FlexmanipError

def square(task):
    if task == 2:
        raise FlexmanipError('two', 'another number')
    if task == 3:
        os._exit(1)
    return task * task
'''


def test_a_worker_that_dies_costs_only_its_run(tmp_path, monkeypatch):
    (tmp_path / 'fragile_work.py').write_text(FRAGILE, encoding='utf-8')
    monkeypatch.syspath_prepend(tmp_path)
    square = importlib.import_module('fragile_work').square
    outcomes = {outcome.task: outcome for outcome in workers.processes(square, range(5), 2)}
    assert {task: outcome.result for task, outcome in outcomes.items()} == {
        0: 0, 1: 1, 2: None, 3: None, 4: 16}
    assert 'another number' in str(outcomes[2].error)
    assert 'the worker died' in str(outcomes[3].error)


@pytest.mark.parametrize(('text', 'words'), [
    ('duration: -1', 'duration'),
    ('runs: 3', "no 'runs'"),
    ('vary: {plant.payload: {uniform: [1, 2]}}', 'cannot be varied'),
    ('vary: {plant.payload_mass: {gauss: [1, 2]}}', 'uniform'),
    ('plant: {ordre: 3}', "unknown parameter 'ordre'"),
    ('estimators: {}', 'estimators'),
    ('faults: {drop: 2}', "'drop' is 2.0; give a value from 0 to 1"),
    ('vary: {plant.payload_mass: {uniform: [a, b]}}', 'two numbers'),
    ('vary: {plant.payload_mass: {uniform: [100, 12]}}', 'low, then high'),
    ('vary: {plant.payload_mass: {normal: [20, -1]}}', 'deviation from 0'),
    ('vary: {plant.payload_mass: {uniform: [.nan, 12]}}', 'two numbers'),
    ('vary: {plant.initial_angles: {uniform: [[0, 0], [1]]}}', 'two lists'),
    ('vary: {capture_time: {choice: [soon]}}', 'finite number'),
    ('vary: {capture_time: {choice: [7]}}', "the run ends at 6 s, as 'vary' drew capture_time for seed 0"),
    ('vary: {plant.payload_mass: {normal: [-9, 0]}}', "-9.0 kg, as 'vary' drew plant.payload_mass for seed 0; give a"),
    ('{vary: {plant.payload_mass: {normal: [9, 0]}}, plant: {snr_db: 999}}', "'snr_db' is 999.0 dB; give"),
    ('capture_time: .nan', 'finite number'),
    ('window: [6, 4]', 'window'),
    ('window: [6, 8]', 'window is [6.0, 8.0] and the run lasts from 0 to 6 s'),
    ('capture_time: 9', 'capture_time is 9 s and the run ends at 6 s'),
    ('capture_time: 5.9995', 'the capture comes after the last sample, which is at 5.999 s'),
    ('release_time: 2', 'release_time is 2 s and nothing is caught before'),
    ('release_time: 6', 'release_time is 6 s and the run ends at 6 s'),
    ('name: [1]', 'a word'),
    ('excitation: {rate: 500.0}', "the torque's 'rate' follows the plant; give the plant's 'rate' instead"),
    ('excitation: {arm: {tip_mass: 3.0}}', "the torque's 'arm.tip_mass' follows the plant"),
    ('vary: {excitation.payload_mass: {uniform: [1, 2]}}', "the torque's 'payload_mass' follows the plant"),
    ('- a', 'names and values'),
])
def test_a_bad_scenario_is_one_line_and_exit_2(scenario_file, tmp_path, capsys, text, words):
    scenario_file.write_text(text, encoding='utf-8')
    assert run(scenario_file, '--output', tmp_path / 'out.csv') == 2
    err = capsys.readouterr().err
    assert words in err
    assert str(scenario_file) in err
    assert err.count('\n') == 1


@pytest.mark.parametrize('path', sorted((Path(__file__).parents[2] / 'config' / 'scenarios').glob('*.yaml')))
def test_the_scenarios_in_config_are_valid(path):
    from flexmanip_ros.cli.monte_carlo import read_scenario

    assert read_scenario(path).name == path.stem


def test_the_same_work_goes_to_a_dask_cluster(scenario_file, tmp_path, capsys, monkeypatch):
    pytest.importorskip('distributed')
    here = tmp_path / 'scheduler.json'
    common = [sys.executable, '-m', 'dask']
    quiet = {'stdout': subprocess.DEVNULL, 'stderr': subprocess.DEVNULL}
    started = [subprocess.Popen([*common, 'scheduler', '--host', '127.0.0.1', '--port', '0', '--no-dashboard',
                                 '--scheduler-file', str(here)], **quiet)]
    try:
        deadline = time.monotonic() + 60.0
        while not here.exists() or not here.read_text():
            assert time.monotonic() < deadline
            time.sleep(0.05)
        address = json.loads(here.read_text())['address']
        with monkeypatch.context() as hurry:
            hurry.setattr(workers, 'ANSWER_TIME', 2.0)
            assert run(scenario_file, '--scheduler', address, '--output', tmp_path / 'none.csv') == 2
        assert 'has no workers' in capsys.readouterr().err
        started += [subprocess.Popen([*common, 'worker', address, '--nthreads', '1', '--no-nanny',
                                      '--no-dashboard', '--host', '127.0.0.1',
                                      '--death-timeout', '20'], **quiet)]
        far, near = tmp_path / 'far.csv', tmp_path / 'near.csv'
        assert run(scenario_file, '--runs', 2, '--scheduler', address, '--output', far) == 0
        assert run(scenario_file, '--runs', 2, '--workers', 0, '--output', near) == 0
        assert without_cost(rows_of(far)) == without_cost(rows_of(near))
    finally:
        for process in reversed(started):
            process.terminate()
        for process in started:
            try:
                process.wait(timeout=20)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def test_a_cluster_that_is_not_there_is_one_clear_line(scenario_file, tmp_path, capsys, monkeypatch):
    pytest.importorskip('distributed')
    monkeypatch.setattr(workers, 'ANSWER_TIME', 0.5)
    assert run(scenario_file, '--scheduler', 'tcp://127.0.0.1:9', '--output', tmp_path / 'out.csv') == 2
    assert 'no Dask scheduler answers' in capsys.readouterr().err
