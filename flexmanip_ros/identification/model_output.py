"""From the estimator's memory to a published model: units, basis, uncertainty and status."""

from dataclasses import replace
from functools import cache

import numpy as np
import scipy

from flexmanip_ros.identification import realization, uncertainty
from flexmanip_ros.identification.batch_fit import Recursion
from flexmanip_ros.identification.factor import POWER, WEIGHT, WEIGHT2
from flexmanip_ros.identification.moments import Realized, realize_orders, regress, triangle
from flexmanip_ros.identification.pbsid import observability_controllability, open_loop_weight
from flexmanip_ros.identification.uncertainty import Identified, Tangent
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.types import Array, StateSpace, Status

LARGEST_SPREAD = 4_000_000
"""Largest number of elements of the spread; beyond it (very long windows with many outputs and states) none is
computed."""
UNEXPLAINED = 0.9
"""Share of an output's power in the innovations; if every output exceeds it, the model is POORLY_EXCITED."""
WORST_CONDITION = 1e12
NEGLECTED = 0.005
"""Largest share of an innovation's variance that may come from the limited order; beyond it the order is too low."""
SIGNIFICANT = 25.0
"""Twice the logarithm of the likelihood ratio above which the variance from the limited order is not chance."""


def at_unit_power(R: Array, width: int) -> tuple[Array, Array]:
    """Return the factor R of the moments for signals of unit power, and the scales (width,) of the signals."""
    power = np.linalg.norm(R[:, -width:], axis=0)
    unit = np.divide(1.0, power, out=np.ones(width), where=power > 0.0)
    return R * np.tile(unit, R.shape[1] // width), unit


def from_factor(config: IdentifierParameters, R: Array, scale: Array) -> tuple[Realized | None, Array, Array]:
    """Compute the model from the factor R of the moments; return it with R and scale for signals of unit power."""
    r, m = len(config.inputs), len(config.outputs)
    R, unit = at_unit_power(R, r + m)
    realized, = realize_orders(
        R, r, m, (config.order,), config.future_window, feedthrough=config.direct_feedthrough,
        weighted=config.weighted_observability, fixed=config.state_basis == 'fixed',
        riccati=config.kalman_gain == 'riccati')
    return realized, R, scale * unit


def from_recursion(
    config: IdentifierParameters, memory: tuple[Array, ...], mean: Array,
) -> tuple[Realized | None, Array]:
    """Form the model from the paper's three recursions, and the factor of the moments from their covariance.

    mean: see ``RpbsidState``. A tracked state selection was scaled by the outputs' peaks in it.
    """
    S1, xi, _, _, _, theta_x, _, _, theta_y, _, W = memory[:11]
    if config.state_basis == 'tracked':
        peaks = np.tile(mean[1, len(config.inputs):], config.future_window)
        W = np.divide(W, peaks, out=np.zeros_like(W), where=peaks > 0.0)
    r, m, n, f = len(config.inputs), len(config.outputs), config.order, config.future_window
    width = r + m
    past = config.past_window * width
    d = S1.shape[0]
    Xi = xi[:, :past]
    xi_u = xi[:, past:] if d > past else np.zeros((m, r))
    G = observability_controllability(Xi, f, r, config.weighted_observability)
    S = W @ open_loop_weight(Xi, f, r) if config.weighted_observability else W
    T = S @ observability_controllability(Xi, f, r, False)
    if not np.all(np.isfinite(theta_x)) or not np.all(np.isfinite(theta_y)) or not np.diag(S1).all():
        return None, S1
    # a square root of the information: root' root = (S S')^-1
    root: Array = np.asarray(np.linalg.inv(S1), dtype=np.float64)
    R = np.zeros((d + width, past + width))
    R[:d, :past] = root[:, :past]
    if d > past:
        R[:d, past:past + r] = root[:, past:]
    else:  # from the window one sample later, as its moments are the same: the older samples predict the newest input
        older, newest = root[:, :past - width], root[:, past - width:past - m]
        weights = regress(older, newest)
        R[:d, past:past + r] = root[:, width:] @ weights.T
        R[d:d + r, past:past + r] = triangle(newest - older @ weights.T)
    R[:d, past + r:] = root @ xi.T
    head = triangle(root)
    values = np.asarray(np.linalg.svd(G @ root[:, :past].T, compute_uv=False), dtype=np.float64)
    return Realized(
        A=theta_x[:, :n], B=theta_x[:, n:n + r], C=theta_y[:, :n],
        D=theta_y[:, n:] if d > past else np.zeros((m, r)), K=theta_x[:, n + r:], Xi=Xi, xi_u=xi_u, S=S, T=T,
        state=R[:, :past] @ T.T, residual=np.zeros((m, m)), regression=head,
        singular_values=values, neglected=np.zeros(m)), R


def from_fit(
    config: IdentifierParameters, recursion: Recursion, scalars: Array, excited: float, dt: float,
) -> Identified:
    """Return the model of the prediction-error fit with the covariance of that fit."""
    r, m, n = len(config.inputs), len(config.outputs), config.order
    theta, structure, P = recursion.theta, recursion.structure, recursion.P
    su, sy = recursion.scale[:r], recursion.scale[r:]
    su, sy = np.where(su > 0.0, su, 1.0), np.where(sy > 0.0, sy, 1.0)
    k = P.shape[1] - n
    known = recursion.widening * np.exp(0.5 * recursion.drift) * recursion.root[:k]
    spread = (P[:-n, :k] @ np.hstack([known, recursion.trend_lag * recursion.trend[:k, None]])).T
    free = (True, True, structure.free_gain, structure.free_output, structure.free_direct)
    shapes = ((n, n), theta.B.shape, (n, m), (m, n), (m, r))
    sizes = [a * b if is_free else 0 for (a, b), is_free in zip(shapes, free, strict=True)]
    parts = np.split(spread, np.cumsum(sizes)[:-1], axis=1)
    dA, dB, dK, dC, dD = (
        (part if part.size else np.zeros((len(spread), a * b))).reshape(-1, a, b)
        for part, (a, b) in zip(parts, shapes, strict=True))
    along = Tangent(*in_units(dA, dB[:, :, :r], dC, dD, dK, su, sy))
    model = StateSpace(*in_units(theta.A, theta.B[:, :r], theta.C, theta.D, recursion.gain, su, sy), dt=dt)
    model, moved_along, W = based(model, along, config.stable_model)
    assert moved_along is not None
    constant = W @ theta.B[:, r:].sum(axis=1)  # the last column, if there is one
    return Identified(
        model=model, constant=constant, spread=moved_along.flat(),
        singular_values=recursion.singular_values,
        excitation=excited, condition=recursion.condition, innovation_power=float(scalars[POWER]),
        status=Status.TRACKING, refined=True, samples=recursion.weight)


def publish(
    config: IdentifierParameters, realized: Realized, R: Array, scale: Array, scalars: Array, variance: Array,
    used: int, d: int, dt: float,
) -> Identified | None:
    """Model, spread and status in JointState units. scale: (r + m,) of the signals, 0 for a silent signal."""
    r, m = len(config.inputs), len(config.outputs)
    model, su, sy = raw_model(config, realized, scale, dt)
    if model is None:
        return None
    effective = scalars[WEIGHT] ** 2 / scalars[WEIGHT2]
    free = max(effective - d, 0.05 * effective)
    if realized.residual.any():
        innovation = realized.residual / np.sqrt(scalars[WEIGHT] * free / effective)
    else:
        innovation = np.diag(np.sqrt(variance))
    parameters = m * d
    entries = model.order * (model.order + r + 2 * m) + m * r
    along = None
    if parameters * entries <= LARGEST_SPREAD:
        along = uncertainty.tangent(R, realized, r, innovation * np.sqrt(scalars[WEIGHT2] / scalars[WEIGHT]))
        along = Tangent(*in_units(*along, su, sy))
    model, along, _ = based(model, along, config.stable_model)
    spread = along.flat() if along is not None else np.zeros((entries, 0))
    ratio = float(effective * np.log1p(realized.neglected).sum())
    too_low = ratio > SIGNIFICANT and float(realized.neglected.max()) > NEGLECTED
    if too_low:  # the error from missing dynamics exceeds that from noise
        spread = spread * np.sqrt(ratio)
    condition = float(np.linalg.cond(realized.state / np.linalg.norm(realized.state, axis=0)))
    power = float(scalars[POWER])
    covariance = innovation.T @ innovation
    total = np.einsum('ij,ij->j', R[:, -m:], R[:, -m:]) / scalars[WEIGHT]
    if not realized.residual.any():  # the moments of the paper's recursion are those that it explains
        total += variance
    unexplained = float(np.min(np.diag(covariance) / np.where(total > 0.0, total, np.inf)))
    status, reason = Status.TRACKING, ''
    if used < 2 * d:
        status, reason = Status.WARMING_UP, f'{used} samples were learned of the {2 * d} that {d} regressors need'
    elif not condition < WORST_CONDITION:
        status = Status.ILL_CONDITIONED
    elif unexplained > UNEXPLAINED:
        status, reason = Status.POORLY_EXCITED, 'one step ahead the model explains less than a tenth of every output'
    elif too_low:
        added = 100.0 * float(realized.neglected.max())
        status, reason = Status.ORDER_TOO_LOW, f'the order adds {added:.2g} % to the variance of an innovation'
    return Identified(
        model=model, spread=spread, singular_values=realized.singular_values,
        excitation=excitation(realized.regression), condition=condition, innovation_power=power,
        status=status, samples=float(effective), reason=reason)


def raw_model(config: IdentifierParameters, realized: Realized, scale: Array, dt: float
              ) -> tuple[StateSpace | None, Array, Array]:
    """Return the model in JointState units, in the basis it was found in, and the scales (r,), (m,) of the signals.

    The model is None where it is not finite.
    """
    r = len(config.inputs)
    su = np.where(scale[:r] > 0.0, scale[:r], 1.0)
    sy = np.where(scale[r:] > 0.0, scale[r:], 1.0)
    parts = in_units(realized.A, realized.B, realized.C, realized.D, realized.K, su, sy)
    model = StateSpace(*parts, dt=dt)
    return model if all(np.all(np.isfinite(part)) for part in parts) else None, su, sy


def in_units(
    A: Array, B: Array, C: Array, D: Array, K: Array, su: Array, sy: Array,
) -> tuple[Array, Array, Array, Array, Array]:
    """Convert matrices (or stacks of them) for scaled signals su u, sy y to matrices for u, y."""
    return A, B * su, C / sy[:, None], D * su / sy[:, None], K * sy


def based(model: StateSpace, along: Tangent | None, stable: bool = False) -> tuple[StateSpace, Tangent | None, Array]:
    """Bring model and tangent to the published basis: y = C x with the known C, else balanced.

    Return with them the matrix (n, n) that takes the old state to the new one. stable: poles outside the unit circle
    are moved onto it.
    """
    if stable:
        model = replace(model, A=realization.stabilized(model.A))
    W = realization.known_output_basis(model)
    known = W is not None
    if W is None:
        W = realization.balancing(model)
    moved = realization.transform(model, W)
    if along is not None:
        dW = uncertainty.known_basis_tangent(model, along) if known else None
        along = uncertainty.move(model, along, W, dW)
    return moved, along, W


def excitation(regression: Array) -> float:
    """Smallest over largest eigenvalue of the regressors' information, each regressor at unit power.

    Computed to about 10 % by four steps of power and inverse iteration on the triangular factor (d, d).
    """
    length: Array = np.sqrt(np.einsum('ij,ij->j', regression, regression))
    if not np.all(length > 0.0) or not np.all(np.diag(regression)) or not np.all(np.isfinite(length)):
        return 0.0
    F = np.asfortranarray(regression / length)
    high = low = _anywhere(F.shape[0])
    for _ in range(4):
        high = F.T @ (F @ high)
        high = high / np.sqrt(high @ high)
        low = scipy.linalg.lapack.dtrtrs(F, scipy.linalg.lapack.dtrtrs(F, low, trans=1)[0])[0]
        norm = float(np.sqrt(low @ low))
        if not np.isfinite(norm) or norm == 0.0:
            return 0.0
        low = low / norm
    smallest, largest = F @ low, F @ high
    return float(smallest @ smallest / (largest @ largest))


@cache
def _anywhere(size: int) -> Array:
    """Return the constant random start vector (size,) of these iterations."""
    direction: Array = np.random.default_rng(0).standard_normal((size,))
    direction.flags.writeable = False
    return direction
