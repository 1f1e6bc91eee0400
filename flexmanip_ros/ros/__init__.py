"""The nodes: each converts, makes one core call and publishes."""

import os

# Before numpy is loaded: matrices here are small, and BLAS threads that wait for each other on a busy machine
# make an estimate ten times slower (28 ms instead of 2 ms with two other nodes on two cores).
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
os.environ.setdefault('OMP_NUM_THREADS', '1')
