"""The table of claims: what falls short is seen, and the documentation says what was measured."""

from __future__ import annotations

import importlib
import math
from pathlib import Path
from types import ModuleType

import pytest

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


def test_a_coverage_that_is_too_low_by_more_than_chance_falls_short(claims):
    rows = [{'outputs': 'all', 'runs': 1000, 'samples_after_capture': [100], 'coverage': [share]}
            for share in (0.95, 0.90)]
    assert [claims.claims_of('payload_coverage', [row])[0].holds for row in rows] == [True, False]


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


def test_the_documentation_has_the_values_measured_last(claims):
    tables = importlib.import_module('tables')
    assert tables.TARGET.read_text(encoding='utf-8') == tables.page(), 'run `make docs`'
