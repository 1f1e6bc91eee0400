"""Test responses of an identified model beside those of the true one (paper Figs. 4, 5, 11, 12)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.integrate import cumulative_trapezoid

from flexmanip_ros.arm import linearization
from flexmanip_ros.identification import validation
from flexmanip_ros.paper import case_run, experiments
from flexmanip_ros.parameters import ArmParameters, ExcitationParameters, configure
from flexmanip_ros.simulation import excitation
from flexmanip_ros.types import Array, StateSpace

RATE = 1000.0
DURATION = 3.0
TEST_INPUT = {
    'shape': 'multisine', 'band': [0.5, 10.0], 'repeat_time': 3.0, 'amplitude': [10.0, 5.0], 'seed': 4}
"""A signal the model was not identified on."""


class Response(NamedTuple):
    """time (N,) [s], angles (N, 2) [rad] and bends (N, 2) [m] from rest."""

    time: Array
    angles: Array
    bends: Array


def arm() -> ArmParameters:
    """Return the arm of the paper's cases."""
    return configure(ArmParameters, experiments.ARM)


def true_response(case: experiments.Case) -> Response:
    """Return what the linearized arm with its true payload does."""
    Ac, Bc = linearization.vibration_model(arm(), np.radians(case.angles_deg), case.payload)
    A, B = linearization.discretize(Ac, Bc, 1.0 / RATE)
    n, r = B.shape
    exact = StateSpace(A, B, np.eye(n), np.zeros((n, r)), np.zeros((n, n)), 1.0 / RATE)
    return _response(case, exact, case.payload)


def identified_response(case: experiments.Case, track: case_run.Track) -> Response | None:
    """Return what the last identified model does, its angles with the estimated payload; None without one."""
    mass = track.mass[-1] if track.mass.size else np.nan
    if track.model is None or not np.isfinite(mass):
        return None
    return _response(case, track.model, float(mass))


def _response(case: experiments.Case, model: StateSpace, payload: float) -> Response:
    """Bends from the model; angles by integrating theta'' = Ma^-1 (B_theta tau - Mb eta'') (eq. 14) twice."""
    source = configure(ExcitationParameters, {**TEST_INPUT, 'rate': RATE})
    torque = excitation.sequence(source, round(DURATION * RATE))
    outputs = validation.simulate(model, torque)
    parts = linearization.blocks(arm(), np.radians(case.angles_deg), payload)
    bend_acceleration = np.gradient(outputs[:, 2:], 1.0 / RATE, axis=0)
    acceleration = np.linalg.solve(parts.Ma, parts.B_theta @ torque.T - parts.Mb @ bend_acceleration.T).T
    rate = cumulative_trapezoid(acceleration, dx=1.0 / RATE, axis=0, initial=0)
    angles = cumulative_trapezoid(rate, dx=1.0 / RATE, axis=0, initial=0)
    return Response(np.arange(torque.shape[0]) / RATE, angles, outputs[:, :2])
