"""Online identification of a flexible arm and of the payload it holds."""

import os

# Matrices here are small: BLAS threads would only wait for one another (100 times slower on a busy machine).
for _name in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'):
    os.environ.setdefault(_name, '1')

__version__ = '0.1.0'
