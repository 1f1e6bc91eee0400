"""Online identification of a flexible arm and of the payload it holds."""

import os
import sys
import warnings

_LIMITS = 'OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'
if 'numpy' in sys.modules and not any(name in os.environ for name in _LIMITS):
    warnings.warn('numpy was imported before flexmanip_ros, so its BLAS has a thread for each core: on a busy machine '
                  'fits take two to ten times as long. Import flexmanip_ros first, or set OMP_NUM_THREADS=1.',
                  RuntimeWarning, stacklevel=2)
# Matrices here are small: BLAS threads would only wait for one another. Processes of a study inherit this.
for _name in _LIMITS:
    os.environ.setdefault(_name, '1')

__version__ = '0.1.0'
