from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
from quick_study import SCENARIO

from flexmanip_ros.identification import rpbsid
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.samples.sample_log import log_of


@pytest.fixture(scope='session', autouse=True)
def paper_kernels() -> None:
    """Compile the paper's recursion, which a program would do at its first use, and say so on stderr."""
    config = IdentifierParameters(estimator='paper', payload_method='none')
    rows = log_of(np.ones((30, 2)), np.ones((30, 4))).rows(0, 30)
    rpbsid.advance(config, rpbsid.init(config), rows)


@pytest.fixture
def scenario_file(tmp_path: Path) -> Path:
    """The quick study as a file."""
    path = tmp_path / 'quick.yaml'
    path.write_text(SCENARIO, encoding='utf-8')
    return path
