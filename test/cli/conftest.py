from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from quick_study import SCENARIO


@pytest.fixture
def scenario_file(tmp_path: Path) -> Path:
    """The quick study as a file."""
    path = tmp_path / 'quick.yaml'
    path.write_text(SCENARIO, encoding='utf-8')
    return path
