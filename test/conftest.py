"""For every test: what a machine with few and busy cores needs."""

import os
from collections.abc import Generator
from typing import Any

# Before numpy is loaded: the matrices are small, and threads of BLAS would only wait for one another.
for name in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'):
    os.environ.setdefault(name, '1')

import pytest  # noqa: E402
from hypothesis import HealthCheck, settings  # noqa: E402

from flexmanip_ros.errors import ModelError  # noqa: E402

# A slow example says something about the machine, not about the claim. In CI they are the same each time.
settings.register_profile(
    'flexmanip_ros', deadline=None, suppress_health_check=[HealthCheck.too_slow],
    derandomize=bool(os.environ.get('CI')),
)
settings.load_profile('flexmanip_ros')


def skip_without_extra(item: pytest.Item) -> Generator[None, Any, Any]:
    """Skip a test that reaches an extra which is not installed; the error says which."""
    try:
        return (yield)
    except ModelError as error:
        if error.problem.endswith('which is not installed'):
            pytest.skip(str(error))
        raise


pytest_runtest_setup = pytest.hookimpl(wrapper=True)(skip_without_extra)
pytest_runtest_call = pytest.hookimpl(wrapper=True)(skip_without_extra)
