"""What the arm and its load cannot be is kept out at the least cost, however alike two bounds are."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recording import event, record, run
from scipy.optimize import nnls

from flexmanip_ros.numerics.square_root import allocate_bounds, least_distance
from flexmanip_ros.parameters import ArmParameters, IdentifierParameters
from flexmanip_ros.payload import structured
from flexmanip_ros.payload.process_model import Kind


def shortest(rows: np.ndarray, least: np.ndarray) -> np.ndarray:
    bounds = allocate_bounds(*rows.shape)
    bounds.rows[:], bounds.least[:] = rows, least
    assert least_distance(bounds, len(rows))
    return bounds.shortest


@settings(deadline=None)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 9), size=st.integers(9, 30), alike=st.floats(1e-4, 1.0))
def test_the_shortest_way_within_bounds_is_that_of_nonnegative_least_squares(
        seed: int, count: int, size: int, alike: float) -> None:
    """Lawson and Hanson's least distance: u = -r / r_n, r the residual of least |E z - f|, z >= 0."""
    rng = np.random.default_rng(seed)
    rows = rng.standard_normal((count, size))
    if count > 1:  # as of viscous and Coulomb friction: what one takes the other gives
        rows[1] = alike * rows[1] - rows[0]
    rows *= 10.0 ** rng.uniform(-3.0, 3.0, (count, 1))
    lengths = np.linalg.norm(rows, axis=1)
    least = rng.standard_normal(count)
    found = shortest(rows, least * lengths)
    assert np.all(rows @ found / lengths >= least - 1e-7 * (1.0 + np.linalg.norm(found)))
    E, target = np.vstack([(rows / lengths[:, None]).T, least]), np.append(np.zeros(size), 1.0)
    residual = E @ nnls(E, target)[0] - target
    expected = np.linalg.norm(residual[:-1]) / abs(residual[-1])
    assert np.linalg.norm(found) == pytest.approx(expected, rel=1e-3, abs=1e-6)


@pytest.mark.parametrize('seed', [1, 2])
def test_wrong_gains_and_no_friction_do_not_lose_what_is_caught(seed: int) -> None:
    """Its friction and its delays are on their bounds; brought back one after the other they lost the object's fit."""
    rng = np.random.default_rng(seed)
    arm = ArmParameters(damping_ratio=0.003, modes=5, torque_gain=(1.04, 1.04), bend_gain=(0.98, 0.98),
                        bend_offset=(5e-4, 5e-4))
    mass, caught = rng.uniform(10.0, 40.0), event(3.0)
    config = IdentifierParameters()
    samples = record(5.0, (caught,), degrees=(rng.uniform(0.0, 90.0), rng.uniform(20.0, 100.0)), payload=mass, arm=arm,
                     seed=seed, outputs=config.outputs)
    state = run(config, samples, (caught,))
    found = structured.estimate(config, state)
    assert found.mass == pytest.approx(mass, rel=0.02)
    assert abs(found.mass - mass) < 3.5 * found.std
    m = state.memory
    kinds = state.model.motion.kind
    x, S = m.x[-kinds.size:], m.S[-kinds.size:]
    for kind in (Kind.VISCOUS, Kind.COULOMB, Kind.DAMPING, Kind.TORQUE_DELAY, Kind.TORQUE_LAG):
        deviations = np.linalg.norm(S[kinds == kind], axis=1)
        assert np.all(x[kinds == kind] >= -3.0 * deviations - 1e-12)
