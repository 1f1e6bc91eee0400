"""A study of monte_carlo interrupted, killed, damaged and continued: nothing is lost or done twice."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from quick_study import SCENARIO, rows_of, run, without_cost
from recordings import write
from rosbags.rosbag2 import StoragePlugin

from flexmanip_ros.io.outputs import Journal


def test_a_study_continues_where_a_kill_left_it(scenario_file, tmp_path, capsys):
    out = tmp_path / 'out.csv'
    assert run(scenario_file, '--runs', 2, '--workers', 0, '--output', out) == 0
    journal = tmp_path / 'out.csv.journal'
    content = journal.read_bytes()
    journal.write_bytes(content[:-30])  # a kill in the middle of the second row
    out.unlink()
    assert run(scenario_file, '--runs', 3, '--workers', 0, '--output', out) == 0
    assert 'continuing: 1 of 3' in capsys.readouterr().err
    assert [row['seed'] for row in rows_of(out)] == ['0', '1', '2']


def test_a_finished_study_is_not_done_again(scenario_file, tmp_path):
    out = tmp_path / 'out.csv'
    for _ in range(2):
        assert run(scenario_file, '--runs', 1, '--workers', 0, '--output', out) == 0
    assert len(rows_of(out)) == 1


def test_another_study_does_not_overwrite_this_one(scenario_file, tmp_path, capsys):
    out = tmp_path / 'out.csv'
    assert run(scenario_file, '--runs', 1, '--workers', 0, '--output', out) == 0
    scenario_file.write_text(SCENARIO.replace('0.2\n', '0.25\n', 1), encoding='utf-8')
    assert run(scenario_file, '--runs', 1, '--workers', 0, '--output', out) == 2
    assert 'another study' in capsys.readouterr().err


TWO = """
name: two
duration: 0.2
capture_time: 0.1
window: [0.15, 0.2]
identifier: {payload_method: none}
estimators: {a: {}, b: {}}
"""


def test_a_kill_between_the_rows_of_a_run_loses_none_of_them(scenario_file, tmp_path):
    scenario_file.write_text(TWO, encoding='utf-8')
    out, journal = tmp_path / 'out.csv', tmp_path / 'out.csv.journal'
    assert run(scenario_file, '--runs', 2, '--workers', 0, '--output', out) == 0
    whole, content = without_cost(rows_of(out)), journal.read_bytes()
    for cut in (10, len(content.splitlines()[-1]) // 2 + 5):
        journal.write_bytes(content[:-cut])
        assert run(scenario_file, '--runs', 2, '--workers', 0, '--output', out) == 0
        assert without_cost(rows_of(out)) == whole


@pytest.mark.parametrize(('damage', 'words'), [
    (lambda lines: b'\x80' * 300, 'no journal'),
    (lambda lines: lines[0] + b'{"run": garbage\n' + lines[1], 'damaged in line 2'),
    (lambda lines: lines[0] + lines[1] + b'[1]\n', 'damaged in line 3'),
    (lambda lines: lines[0] + lines[1] + b'\xff\xfe\n', 'damaged in line 3'),
    (lambda lines: b'5\n', 'another study'),
])
def test_a_damaged_journal_is_rejected_and_kept(scenario_file, tmp_path, capsys, damage, words):
    out, journal = tmp_path / 'out.csv', tmp_path / 'out.csv.journal'
    assert run(scenario_file, '--runs', 1, '--workers', 0, '--output', out) == 0
    capsys.readouterr()
    damaged = damage(journal.read_bytes().splitlines(keepends=True))
    journal.write_bytes(damaged)
    assert run(scenario_file, '--runs', 1, '--workers', 0, '--output', out) == 2
    err = capsys.readouterr().err
    assert words in err
    assert err.count('\n') == 1
    assert journal.read_bytes() == damaged


def test_a_journal_without_its_first_line_begins_again(scenario_file, tmp_path):
    out = tmp_path / 'out.csv'
    (tmp_path / 'out.csv.journal').write_text('{"study": {"para', encoding='utf-8')
    assert run(scenario_file, '--runs', 1, '--workers', 0, '--output', out) == 0
    assert len(rows_of(out)) == 1


def test_two_processes_do_not_write_one_study(scenario_file, tmp_path, capsys):
    out = tmp_path / 'out.csv'
    with Journal(out, {'a': 1}):
        assert run(scenario_file, '--runs', 1, '--workers', 0, '--output', out) == 2
    assert 'by another process' in capsys.readouterr().err


def test_a_journal_that_cannot_be_opened_is_one_line(scenario_file, tmp_path, capsys):
    (tmp_path / 'out.csv.journal').mkdir()
    assert run(scenario_file, '--runs', 1, '--workers', 0, '--output', tmp_path / 'out.csv') == 2
    assert 'cannot be written' in capsys.readouterr().err


def test_an_interrupt_keeps_what_was_done_and_the_same_command_goes_on(scenario_file, tmp_path):
    out = tmp_path / 'out.csv'
    command = [sys.executable, '-m', 'flexmanip_ros.cli.monte_carlo', str(scenario_file), '--workers', '1',
               '--output', str(out)]
    process = subprocess.Popen([*command, '--runs', '100000'], stdout=subprocess.DEVNULL,
                               stderr=subprocess.PIPE, text=True)
    try:
        deadline = time.monotonic() + 100.0
        journal = tmp_path / 'out.csv.journal'
        while not journal.exists() or journal.read_bytes().count(b'\n') < 3:
            assert time.monotonic() < deadline
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        assert 'the same command continues' in process.communicate(timeout=60)[1]
    finally:
        process.kill()  # nothing, where it has ended as it should
    assert process.returncode == 130
    done = len(rows_of(out))
    assert done >= 2
    assert run(scenario_file, '--runs', done + 2, '--workers', 0, '--output', out) == 0
    assert [row['seed'] for row in rows_of(out)] == [str(seed) for seed in range(done + 2)]


@pytest.mark.parametrize('storage', StoragePlugin)
def test_a_recording_or_a_truth_that_was_replaced_is_done_again_and_the_others_are_not(tmp_path, capsys, storage):
    folder = tmp_path / 'bags'
    folder.mkdir()
    settings = ['--set=payload_method=none', '--set=inputs=[joint1/effort]', '--set=outputs=[joint1/position]',
                '--workers', 0, '--output', tmp_path / 'out.csv']
    for name in ('kept', 'changed', 'weighed'):
        write(folder / name, 300, storage, event_at=None)
    assert run(folder, *settings) == 0
    shutil.rmtree(folder / 'changed')
    write(folder / 'changed', 200, storage, event_at=None)
    (folder / 'weighed.truth.json').write_text('{"payload_mass_kg": 20.0}', encoding='utf-8')
    for done in (1, 3):
        capsys.readouterr()
        assert run(folder, *settings) == 0
        assert f'continuing: {done} of 3 runs are done already' in capsys.readouterr().err
        rows = {Path(row['run']).name: row for row in rows_of(tmp_path / 'out.csv')}
        assert {name: row['samples'] for name, row in rows.items()} == {
            'kept': '300', 'changed': '200', 'weighed': '300'}
        assert rows['weighed']['payload_true_kg'] == '20.0'
        assert len(rows_of(tmp_path / 'out.csv')) == 3


def test_overlapping_seeds_are_done_once(scenario_file, tmp_path):
    out = tmp_path / 'out.csv'
    assert run(scenario_file, '--runs', 2, '--workers', 0, '--output', out) == 0
    assert run(scenario_file, '--runs', 2, '--first-seed', 1, '--workers', 0, '--output', out) == 0
    assert [row['seed'] for row in rows_of(out)] == ['0', '1', '2']
