"""For every test: what a machine with few and busy cores needs."""

import os

# Before numpy is loaded: the matrices are small, and threads of BLAS would only wait for one another.
for name in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'):
    os.environ.setdefault(name, '1')

from hypothesis import HealthCheck, settings  # noqa: E402

# A slow example says something about the machine, not about the claim. In CI they are the same each time.
settings.register_profile(
    'flexmanip_ros', deadline=None, suppress_health_check=[HealthCheck.too_slow],
    derandomize=bool(os.environ.get('CI')),
)
settings.load_profile('flexmanip_ros')
