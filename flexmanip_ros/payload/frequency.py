"""Payload from the identified frequencies alone (``payload_method: frequency``; the paper's future work).

The frequencies f_i(m) of the arm at its working point fall as the payload m grows, ever more slowly. The payload is
where the misfit sum_i ((f_i(m) - f_i) / std_i)^2 is least. Its 95 % interval is the profile-likelihood interval: the
payloads whose misfit is at most 3.84 max(1, least / (modes - 1)) above the least. So it may reach to infinity on one
side.
"""

import math
from collections.abc import Sequence

import numpy as np

from flexmanip_ros.arm.linearization import mass_matrix, momentum
from flexmanip_ros.arm.manipulator import manipulator, payload_array
from flexmanip_ros.parameters import ArmParameters, IdentifierParameters
from flexmanip_ros.payload.block_extraction import unknown
from flexmanip_ros.payload.interval import POWER_LIMIT
from flexmanip_ros.payload.structured_model import working_point
from flexmanip_ros.types import Array, Mode, Payload, Status

GRID = 400
"""Payloads looked at."""
LARGEST = 300.0
"""Largest payload looked at, over the lightest tip mass."""
LEVEL = 3.841458820694124
"""95 % point of chi-square with one degree of freedom."""
MISFIT = 10.8
"""Least misfit beyond which the frequencies are not those of this arm (99.9 % with one degree of freedom)."""


def frequencies(arm: ArmParameters, theta: Array, payloads: Array, count: int) -> Array:
    """Return the lowest undamped frequencies [Hz], (payloads, count), at chords theta (L,)."""
    (Ma, Mb, Mc), (one, _, _) = (_inertia(arm, theta, payload) for payload in (0.0, 1.0))
    coupling = np.broadcast_to(Mb, (payloads.size, *Mb.shape))
    Mt = Mc - Mb.T @ np.linalg.solve(Ma + payloads[:, None, None] * (one - Ma), coupling)
    root = np.sqrt(manipulator(arm).stiffness[len(theta):len(theta) + len(Mc)])
    # Kc is diagonal: eigenvalues of Kc^-1/2 Mt Kc^-1/2 are 1 / omega^2
    periods = np.linalg.eigvalsh(Mt / np.outer(root, root))[:, ::-1]
    return np.asarray(1.0 / np.sqrt(periods[:, :count]) / (2 * np.pi))


def _inertia(arm: ArmParameters, theta: Array, payload: float) -> tuple[Array, Array, Array]:
    """Return the mass matrices of the rigid motion, its coupling with the bending (r, L k), and the bending (L k, L k).

    The rigid motion (r, r) is the turning of the links, with translation and turning of a floating base. So all are
    linear in the payload [kg].
    """
    own, body = manipulator(arm), payload_array(payload)
    L, n = len(theta), own.stiffness.size
    q = np.append(theta, np.zeros(n - L))
    M, bending = mass_matrix(own, body, q), np.arange(L, L * (1 + own.kappa))
    if own.floating:
        P, mass = momentum(own, body, q)
        M, bending = np.block([[mass * np.eye(2), P], [P.T, M + P.T @ P / mass]]), bending + 2
    rigid = np.delete(np.arange(len(M)), bending)
    return M[np.ix_(rigid, rigid)], M[np.ix_(rigid, bending)], M[np.ix_(bending, bending)]


def estimate(config: IdentifierParameters, modes: Sequence[Mode], angles: Array, configuration_range: Array) -> Payload:
    """Return the payload that fits the lowest two identified modes; never a NaN.

    angles: (L,) as measured [rad]; configuration_range: (2,) or (0,) smallest and largest cosine between the links
    since the last event. The modes are means over that range, so the interval covers what they mean at either end of
    it. Modes without a standard deviation give no interval, hence no estimate.
    """
    if angles.shape != (len(config.arm.link_length),):
        return unknown(Status.UNOBSERVABLE)
    usable = sorted(mode for mode in modes if mode.frequency_hz > 0.0 and math.isfinite(mode.frequency_std_hz)
                    and mode.frequency_std_hz > 0.0 and abs(mode.damping_ratio) < 1.0)[:2]
    if not usable:
        return unknown(Status.WARMING_UP)
    found = _at(config.arm, working_point(config, angles), usable)
    for turn in np.arccos(configuration_range):  # frequencies depend on the angle between the links
        other = _at(config.arm, np.array([0.0, turn]), usable)
        found = found._replace(lower=min(found.lower, other.lower), upper=max(found.upper, other.upper))
    return found


def _at(arm: ArmParameters, theta: Array, usable: Sequence[Mode]) -> Payload:
    """Return the payload that modes mean at chords theta (L,) [rad]."""
    lightest = arm.tip_mass + arm.linear_density[-1] * arm.link_length[-1] / 3
    payloads = lightest * LARGEST * np.linspace(0.0, 1.0, GRID) ** 3
    natural = np.array([mode.frequency_hz / math.sqrt(1.0 - mode.damping_ratio ** 2) for mode in usable])
    std = np.array([mode.frequency_std_hz for mode in usable])
    misfit = _misfit(frequencies(arm, theta, payloads, len(usable)), natural, std)
    best = int(np.argmin(misfit))
    near = np.linspace(payloads[max(best - 1, 0)], payloads[min(best + 1, GRID - 1)], GRID)
    fine = _misfit(frequencies(arm, theta, near, len(usable)), natural, std)
    mass, least = float(near[np.argmin(fine)]), float(fine.min())
    step = 1e-3 * (mass + lightest)
    up, down = frequencies(arm, theta, np.array([mass + step, max(mass - step, 0.0)]), len(usable))
    information = float(np.sum(((up - down) / (mass + step - max(mass - step, 0.0)) / std) ** 2))
    widening = math.sqrt(max(1.0, least / max(len(usable) - 1, 1)))
    deviation = widening / math.sqrt(information) if information > 0.0 else math.inf
    lower, upper = _bounds(payloads, misfit - least, LEVEL * widening ** 2, mass, near, fine - least)
    status = Status.TRACKING
    if least > MISFIT:
        status = Status.INCONSISTENT
    elif deviation > max(mass, lightest):
        status = Status.POORLY_EXCITED
    # as with the other methods, what is above ``POWER_LIMIT`` is INCONSISTENT
    return Payload(mass, deviation, lower, upper, max(POWER_LIMIT * least / MISFIT, 1.0), status)


def _misfit(model: Array, natural: Array, std: Array) -> Array:
    return np.asarray((((model - natural) / std) ** 2).sum(axis=1))


def _bounds(
    payloads: Array, rise: Array, level: float, mass: float, near: Array, fine: Array,
) -> tuple[float, float]:
    """Ends of the payloads whose misfit rises by less than ``level``; the grid is finer near the mass."""
    grid = np.concatenate([payloads, near])
    order = np.argsort(grid, kind='stable')
    grid, height = grid[order], np.concatenate([rise, fine])[order]
    inside = np.flatnonzero(height <= level)
    if inside.size == 0:
        return mass, mass
    first, last = int(inside[0]), int(inside[-1])
    lower = 0.0 if first == 0 else _crossing(grid, height, first - 1, first, level)
    upper = math.inf if last == grid.size - 1 else _crossing(grid, height, last + 1, last, level)
    return min(lower, mass), max(upper, mass)


def _crossing(grid: Array, height: Array, outside: int, inside: int, level: float) -> float:
    """Where the misfit crosses the level between two points."""
    share = (level - height[inside]) / (height[outside] - height[inside])
    return float(grid[inside] + share * (grid[outside] - grid[inside]))
