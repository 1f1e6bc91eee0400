"""Cramer-Rao bounds: the least standard deviation any unbiased payload estimate can have from given signals.

Three kinds of knowledge. ``structure_known``: the linear vibration model at a working point is known but for the
payload and the first state. ``structure_unknown``: nothing of (A, B) and the first state is known; the payload is read
from them by the block extraction, so the bound belongs to that formula (name it wherever it is quoted).
``nonlinear``: the moving arm, its stiffness, damping and rates as uncertain as the parameters say. Bounds of all that
is unknown of arm and object, from before the capture on, are in benchmarks/parts/all_bounds.py.
"""

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from flexmanip_ros.arm.linearization import blocks, discretize, vibration_model
from flexmanip_ros.errors import ModelError
from flexmanip_ros.identification.realization import to_continuous
from flexmanip_ros.parameters import ArmParameters, IdentifierParameters
from flexmanip_ros.payload import structured_model
from flexmanip_ros.payload.block_extraction import masses
from flexmanip_ros.payload.filter_state import FilterState, memory
from flexmanip_ros.payload.measurement_update import observe
from flexmanip_ros.payload.process_model import predict
from flexmanip_ros.payload.structured_model import Model, build, sensors
from flexmanip_ros.types import Array


def structure_known(
    arm: ArmParameters, theta: Array, payload: float, states: Array, efforts: Array, noise_std: Array,
    dt: float, counts: Sequence[int],
) -> Array:
    """Return the bound [kg] after each of ``counts`` samples from the capture on; all outputs y = x measured.

    theta: (2,) chords; states: (N, 4 kappa) true [eta; eta'], efforts: (N, 2), noise_std: (4 kappa,).
    """
    kappa = noise_std.size // 4
    step = 1e-4 * (payload + arm.tip_mass + arm.linear_density[-1] * arm.link_length[-1] / 3)
    (A_up, B_up), (A, _), (A_down, B_down) = (
        discretize(*vibration_model(arm, theta, payload + change, kappa), dt)
        for change in (step, 0.0, max(-step, -payload)))
    width = step + min(step, payload)
    driven = (states @ (A_up - A_down).T + efforts @ (B_up - B_down).T) / width
    return _linear(A, lambda k: driven[k, :, None], np.ones(1), noise_std, counts)


def structure_unknown(
    arm: ArmParameters, theta: Array, payload: float, states: Array, efforts: Array, noise_std: Array,
    dt: float, counts: Sequence[int], known_mb: bool = False,
) -> Array:
    """Return the bound [kg] of block extraction (eqs. 48-52) when A, B and the first state are unknown.

    Arguments as ``structure_known``; known_mb: the extraction takes M_b from the arm.
    """
    kappa = noise_std.size // 4
    A, B = discretize(*vibration_model(arm, theta, payload, kappa), dt)
    one = np.eye(len(A))

    def driven(k: int) -> Array:  # element i of A x + B u changes with row i of A by x, and with row i of B by u
        return np.hstack([np.kron(one, states[k]), np.kron(one, efforts[k])])

    return _linear(A, driven, _extraction_gradient(arm, theta, A, B, dt, kappa, known_mb), noise_std, counts)


def _linear(
    A: Array, driven: Callable[[int], Array], gradient: Array, noise_std: Array, counts: Sequence[int],
) -> Array:
    """Return the bound after each of ``counts`` samples of a plant with the state matrix A, all states measured.

    The bound is that of a quantity with the derivative ``gradient`` (c,) by the unknown parameters of the plant; the
    first state is unknown as well. driven(k): derivative (n, c) of state k + 1 by the parameters at fixed state k.
    """
    n, c = len(A), gradient.size
    S = np.hstack([np.zeros((n, c)), np.eye(n)])
    information = np.zeros((c + n, c + n))
    found = []
    for k in range(max(counts)):
        rows = S / noise_std[:, None]
        information += rows.T @ rows
        S = A @ S
        S[:, :c] += driven(k)
        if k + 1 in counts:
            found.append(_deviation(information, np.append(gradient, np.zeros(n))))
    return np.array(found)


def nonlinear(
    config: IdentifierParameters, theta: Array, payload: float, efforts: Array, noise_std: Array, dt: float,
    counts: Sequence[int], rates: Array | None = None,
) -> Array:
    """Return the bound [kg] for the moving arm, caught at rest (or at chord rates (2,) [rad/s]), unbent.

    efforts: (N, 2) held from each sample on; noise_std: one for each output and then each angle that is not
    among the outputs. The first state is as open as the estimator holds it, stiffness and damping as
    ``config.payload`` says. Raises ModelError where the configured signals cannot give a payload.
    """
    model, m = start(config, theta)
    n, p = model.motion.arm.stiffness.size, model.payload
    m.x[n:n + len(theta)] = 0.0 if rates is None else rates
    m.x[p] = payload
    m.S[p:p + model.body, p:p + model.body] = np.diag(10.0 * structured_model.body_std(config, model)[:model.body])
    found = []
    for k, information in gathered(config, model, m.x, m.S, efforts[:max(counts)], noise_std, dt):
        if k in counts:
            found.append(posterior(information, m.S[p]))
    return np.array(found)


def start(config: IdentifierParameters, theta: Array) -> tuple[Model, FilterState]:
    """Return the model and the estimator's first state, at rest at chords theta (L,)."""
    model = build(config)
    if model is None:
        raise ModelError('the configured signals cannot give a payload', 'name both torques and both angles')
    m = memory(2 * model.motion.arm.stiffness.size + model.motion.kind.size, len(model.roles), len(theta))
    structured_model.first(config, model, m, np.zeros(len(model.roles)))
    straight = theta if config.arm.angle_convention == 'chord' else np.diff(theta, prepend=0.0)
    structured_model.freeze(config, model, straight)
    m.x[:model.payload] = 0.0
    m.x[:len(theta)] = theta
    return model, m


def gathered(
    config: IdentifierParameters, model: Model, x: Array, S: Array, efforts: Array, noise_std: Array, dt: float,
) -> Iterator[tuple[int, Array]]:
    """Yield k and the information (c, c) of the first k samples on the unknowns, 0 <= k <= N.

    x (nx,) and S (nx, c), the derivative of the state by the unknowns, are carried on in place; between two
    samples they may be changed.
    """
    if len(noise_std) != len(config.outputs) + len(model.extra):
        raise ModelError(f'there are {len(noise_std)} deviations', 'give one for each output and each further angle')
    measured = np.asarray(noise_std)[[*model.kept, *range(len(config.outputs), len(noise_std))]]
    n, columns = model.motion.arm.stiffness.size, S.shape[1]
    seen = sensors(config, model, dt, np.zeros(efforts.shape[1]))
    rows = np.full((seen.reach, 1 + efforts.shape[1]), dt)
    padded = np.vstack([np.tile(efforts[0], (seen.reach - 1, 1)), efforts])
    information, F = np.zeros((columns, columns)), np.zeros((len(measured), columns))
    for k in range(len(efforts)):
        yield k, information
        for i, deviation in enumerate(measured):
            observe(seen, i, n, x, S, F[i], model.motion.k[0])
            F[i] /= deviation
        information += F.T @ F
        rows[:, 1:] = padded[k:k + seen.reach]
        if not predict(model.motion, x, S, columns, rows, dt, dt):
            raise ModelError('the arm diverges under these torques', 'use smaller torques')
    yield len(efforts), information


def posterior(information: Array, row: Array) -> float:
    """Return the least deviation of what is ``row`` (c,) times unknowns of unit prior deviation."""
    return float(np.sqrt(row @ np.linalg.solve(np.eye(len(row)) + information, row)))


def _extraction_gradient(
    arm: ArmParameters, theta: Array, A: Array, B: Array, dt: float, kappa: int, known_mb: bool,
) -> Array:
    """Derivative of the extracted payload by the elements of A, then B, row-major."""
    empty = blocks(arm, theta, kappa=kappa)
    both = np.hstack([A.ravel(), B.ravel()])
    steps = 1e-7 * np.repeat([1.0, float(np.abs(B).max())], [A.size, B.size])
    gradient = np.empty(both.size)
    for i, step in enumerate(steps):
        ends = []
        for sign in (1.0, -1.0):
            moved = both.copy()
            moved[i] += sign * step
            Ac, Bc = to_continuous(moved[:A.size].reshape(A.shape), moved[A.size:].reshape(B.shape), dt)
            ends.append(float(masses(arm, empty, Ac, Bc, known_mb)))
        gradient[i] = (ends[0] - ends[1]) / (2 * float(step))
    return gradient


def _deviation(information: Array, gradient: Array) -> float:
    """Square root of g' J^-1 g, J scaled to a unit diagonal; infinite where J is singular."""
    scale = np.sqrt(np.diag(information))
    if np.any(scale == 0.0):
        return float('inf')
    scaled = information / np.outer(scale, scale)
    if np.linalg.cond(scaled) > 1e14:
        return float('inf')
    g = gradient / scale
    return float(np.sqrt(max(float(g @ np.linalg.solve(scaled, g)), 0.0)))
