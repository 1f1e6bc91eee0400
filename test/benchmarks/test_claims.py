"""The table of claims: what falls short is seen, and the documentation says what was measured."""

from __future__ import annotations

import importlib
import math
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from flexmanip_ros.types import Estimate, Mode, Status

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def claims(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / 'benchmarks'))
    return importlib.import_module('claims')


@pytest.mark.parametrize(('value', 'low', 'high', 'holds'), [
    (1.0, None, 1.0, True), (1.1, None, 1.0, False), (0.9, 0.95, None, False), (0.95, 0.95, 0.97, True),
    (math.nan, 0.0, None, False)])
def test_a_value_outside_its_bounds_falls_short(claims, value, low, high, holds):
    assert claims.Claim('value', value, low, high).holds is holds


@pytest.mark.parametrize(('runs', 'low', 'high'), [(1000, 0.93, 0.97), (100, 0.9064, 0.9936), (4, 0.7321, 1.0)])
def test_a_coverage_has_the_bounds_of_the_documents_or_of_chance_in_fewer_runs(claims, runs, low, high):
    claim = claims.covers('coverage', 0.95, runs)
    assert (claim.low, claim.high) == pytest.approx((low, high), abs=1e-4)


@pytest.mark.parametrize(('share', 'holds'), [(0.93, True), (0.929, False), (0.97, True), (0.971, False)])
def test_a_coverage_of_a_thousand_runs_outside_93_to_97_percent_falls_short(claims, share, holds):
    row = {'case': 'all', 'runs': 1000, 'samples_after_capture': [100], 'coverage': [share]}
    assert claims.claims_of('payload_coverage', [row])[0].holds is holds


@pytest.mark.parametrize('name', sorted(path.stem for path in (ROOT / 'benchmarks' / 'results').glob('*.json')
                                        if path.stem not in ('all', 'runs')))
def test_every_recorded_result_is_compared_and_every_claim_has_a_bound(claims, name):
    found = claims.recorded(name)
    assert found
    assert all(claim.low is not None or claim.high is not None for claim in found)
    assert len({claim.name for claim in found}) == len(found)


def test_every_benchmark_claims_something(claims):
    helpers = {'claims', 'run_all', 'tables', 'identification_peers'}
    names = {path.stem for path in (ROOT / 'benchmarks').glob('*.py')} - helpers
    assert names == set(claims.CLAIMS)


def test_a_run_with_a_claim_that_falls_short_is_no_success(claims, monkeypatch, tmp_path):
    run_all = importlib.import_module('run_all')
    monkeypatch.setattr(claims, 'RESULTS', tmp_path)
    (tmp_path / 'setup_time.json').write_text('{"seconds": 1000.0}')
    text, good = run_all.claims_table(['setup_time'])
    assert not good
    assert 'NO' in text


@pytest.mark.parametrize('content', [None, '{}', 'no JSON'])
def test_a_run_whose_result_cannot_be_compared_is_no_success(claims, monkeypatch, tmp_path, content):
    run_all = importlib.import_module('run_all')
    monkeypatch.setattr(claims, 'RESULTS', tmp_path)
    if content is not None:
        (tmp_path / 'setup_time.json').write_text(content)
    text, good = run_all.claims_table(['setup_time'])
    assert not good
    assert 'cannot be compared' in text


@pytest.mark.parametrize(('script', 'code'), [('print("measured")', 1), ('raise SystemExit(3)', 1)])
def test_the_program_ends_with_exit_code_1(claims, monkeypatch, tmp_path, script, code):
    """For a claim that falls short, and for a benchmark that fails."""
    run_all = importlib.import_module('run_all')
    (tmp_path / 'setup_time.py').write_text(f"if __name__ == '__main__':\n    {script}\n")
    (tmp_path / 'setup_time.json').write_text('{"seconds": 1000.0}' if 'print' in script else '{"seconds": 1.0}')
    for module, name in ((claims, 'RESULTS'), (run_all, 'RESULTS'), (run_all, 'HERE')):
        monkeypatch.setattr(module, name, tmp_path)
    monkeypatch.setattr('sys.argv', ['run_all.py'])
    assert run_all.main() == code


def test_a_date_is_shown_for_the_result_that_it_was_recorded_with(claims, monkeypatch, tmp_path):
    tables = importlib.import_module('tables')
    monkeypatch.setattr(claims, 'RESULTS', tmp_path)
    (tmp_path / 'setup_time.json').write_text('{"seconds": 40.0}')
    assert tables.when('setup_time') == ''
    claims.record_run('setup_time', date='2026-11-21', cores=2, processor='x86_64', python='3.12.0')
    assert tables.when('setup_time') == ' Measured on 2026-11-21, 2 cores (x86_64), Python 3.12.0.'
    (tmp_path / 'setup_time.json').write_text('{"seconds": 41.0}')
    assert tables.when('setup_time') == ''


def test_the_documentation_has_the_values_measured_last(claims):
    tables = importlib.import_module('tables')
    assert tables.TARGET.read_text(encoding='utf-8') == tables.page(), 'run `make docs`'
    readme = tables.README.read_text(encoding='utf-8')
    assert readme == tables.readme(readme), 'run `make docs`'


@pytest.fixture
def benchmark(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], ModuleType]:
    monkeypatch.syspath_prepend(str(ROOT / 'benchmarks'))
    return importlib.import_module


def test_a_reading_without_both_modes_is_not_found(benchmark, monkeypatch):
    arm = benchmark('identification_moving_arm')
    both = (Mode(5.6, 0.0, 0.01, 0.01), Mode(6.5, 0.0, 0.01, 0.01))
    estimates = [Estimate(4_000_000_000, Status.TRACKING, None, modes, None, model_is_new=True)
                 for modes in (both, both[:1], ())]
    monkeypatch.setattr(arm.pipeline, 'run', lambda *_: estimates)
    rows = np.array(arm.readings(20.0, (60.0, 45.0), 1))
    assert arm.row_of('', rows, 0, 'lately')['found_percent'] == pytest.approx(100.0 / 3.0)


@pytest.mark.parametrize(('std', 'missed'), [(0.1, False), (0.01, True), (math.nan, True)])
def test_a_band_that_is_off_or_unknown_misses_the_frequency(benchmark, std, missed):
    assert benchmark('identification_status').misses([Mode(5.0, 0.0, std, 0.01)], np.array([5.1])) is missed


@pytest.mark.parametrize(('told_ms', 'share'), [(500.0, 0.0), (1500.0, 1.0), (2050.0, 1.0), (2150.0, 0.0)])
def test_an_alarm_before_the_capture_has_found_nothing(benchmark, monkeypatch, told_ms, share):
    detection = benchmark('detection_delay')
    monkeypatch.setattr(detection, 'samples_of', lambda *_: None)
    monkeypatch.setattr(detection, 'told', lambda *_: [(None, round(told_ms * 1e6))])
    assert detection.at_rest(2)['within_100_ms'] == share


def test_wrong_models_are_a_share_of_those_that_are_trusted(claims):
    row = {'case': 'pick and place', 'estimates': 10, 'trusted': 10, 'outside': 0, 'readings': 1000, 'tracking': 50,
           'wrong': 1}
    (found,) = (claim for claim in claims.claims_of('identification_missions', [row]) if 'models' in claim.name)
    assert found.value == pytest.approx(2.0)
    assert not found.holds


@pytest.mark.parametrize(('answer', 'problem'), [
    ("print('a defect of this program', file=sys.stderr); sys.exit(1)", 'exit code 1'), ('sys.exit(130)', ''),
    ('signal.default_int_handler(2, None)', '')])
def test_a_program_that_ends_a_signal_with_a_defect_has_a_problem(benchmark, monkeypatch, answer, problem):
    signals = benchmark('ros_signals')
    code = f"""
import signal, sys, time
def answer(*_):
    {answer}
signal.signal(signal.SIGINT, answer)
time.sleep(20.0)"""
    monkeypatch.setattr(signals, 'command', lambda _: [sys.executable, '-c', code])
    trial = signals.attempt(signals.Program('a', 'a', (), 1.0), signal.SIGINT, 0.5, {})
    assert trial.problem == problem
