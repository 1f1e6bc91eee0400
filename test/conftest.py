"""For every test: one thread for BLAS, before numpy is loaded; the matrices are small and cores are few."""

import os

for name in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'):
    os.environ.setdefault(name, '1')
