"""The numbers of a few runs are those in golden.json (see make_golden.py)."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from typing import Any

import pytest

HERE = Path(__file__).parent
SMALL_CHANGE = 1e-4
"""Relative; what another processor or linear algebra library may change."""


def _made_now() -> dict[str, Any]:
    spec = importlib.util.spec_from_file_location('make_golden', HERE / 'make_golden.py')
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.results()


def test_the_numbers_are_those_that_were_reviewed():
    kept = json.loads((HERE / 'golden.json').read_text(encoding='utf-8'))
    now = _made_now()
    assert set(now) == set(kept)
    changed = []
    for run, columns in kept.items():
        for column, value in columns.items():
            found = now[run].get(column)
            same = found == pytest.approx(value, rel=SMALL_CHANGE, abs=1e-9) if isinstance(value, float) \
                else found == value
            if not same:
                changed.append(f'{run}: {column} was {value}, is {found}')
    advice = 'run python test/golden/make_golden.py and look at the difference:\n'
    assert not changed, advice + '\n'.join(changed)
