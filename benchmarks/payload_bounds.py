"""Claim: 3 s after a capture, each parameter of an arm as it is and of the body is known to 2.5 Cramer-Rao bounds.

Friction, rotors, gains and offsets that `structured` is not told, a floating base, a body that spins and drifts; 40 dB,
square waves of 10 and 5 N m, capture after 3 s. The simulated arm has the estimator's shape functions, so that its
bound is that of the estimator's model. Bounds and rms errors over the runs (noise of another seed each): of the arm's
parameters just before the capture and 3 s after it, of the body 3 s after it, of its spin 1 s after it (from the fit of
the moving horizon; `structured` does not estimate it). Efficiency: rms error over bound; 1 is the best. The bound has
the estimator's priors; where it is no less than the prior, the signals do not tell.

Use: python benchmarks/payload_bounds.py [--runs 10]
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Any

import claims
import numpy as np
from parts import payload_trials as trials
from parts.all_bounds import everything

from flexmanip_ros.arm.capture import body_jacobian, tip_angle, tip_jacobian
from flexmanip_ros.arm.linearization import mass_matrix
from flexmanip_ros.parameters import (
    ArmParameters,
    ExcitationParameters,
    IdentifierParameters,
    PayloadParameters,
    PlantParameters,
)
from flexmanip_ros.payload import structured
from flexmanip_ros.payload.arm_parameters import taught
from flexmanip_ros.payload.process_model import set_parameters
from flexmanip_ros.simulation import excitation, sensors, simulator
from flexmanip_ros.types import CaptureEvent, EventKind, Status

TOLD = ArmParameters(modes=2, damping_ratio=0.003, base_mass=700.0, base_inertia=180.0)
TRUE = replace(
    TOLD, bending_stiffness=(5100.0, 4900.0), joint_viscous_friction=(0.8, 0.5), joint_coulomb_friction=(0.15, 0.1),
    rotor_inertia=(0.2, 0.1), torque_gain=(1.04, 0.97), bend_gain=(0.98, 1.03), bend_offset=(5e-4, -3e-4))
PLANT = PlantParameters(
    arm=TRUE, payload_mass=25.0, payload_com=(0.1, 0.06), payload_inertia=1.0, object_velocity=(0.02, -0.03),
    object_spin=0.15)
CAPTURE, SPIN, END = 3000, 4000, 6000
EVENT = CaptureEvent(CAPTURE * 1_000_000, EventKind.CAPTURE)


def truth() -> dict[str, float]:
    """Return the true value of each quantity."""
    names = {'bending_stiffness': 'link{}_bending_stiffness', 'joint_viscous_friction': 'joint{}_viscous_friction',
             'joint_coulomb_friction': 'joint{}_coulomb_friction', 'rotor_inertia': 'joint{}_rotor_inertia',
             'torque_gain': 'joint{}_torque_gain', 'bend_gain': 'link{}_bend_gain', 'bend_offset': 'link{}_bend_offset'}
    values = {name.format(i + 1): getattr(TRUE, field)[i] for field, name in names.items() for i in range(2)}
    values |= {f'link{i + 1}_damping_ratio': TRUE.damping_ratio for i in range(2)}
    values |= dict.fromkeys(('torque_delay', 'joint1_torque_lag', 'joint2_torque_lag', 'bend_delay'), 0.0)
    return values | {'payload_mass': PLANT.payload_mass, 'payload_com_x': PLANT.payload_com[0],
                     'payload_com_y': PLANT.payload_com[1], 'payload_inertia': PLANT.payload_inertia,
                     'object_spin': PLANT.object_spin}


def spin(state: structured.StructuredState, before: np.ndarray) -> float:
    """Return the spin of the body before its capture [rad/s], which `structured` does not estimate itself.

    before: (nx,) its state just before; just after stands in the fit of the moving horizon. An impulse at the centre of
    mass changed the rates (least squares in the metric of kinetic energy), and gave the body those of the tip.
    """
    motion, m = state.model.motion, state.memory
    n = motion.arm.stiffness.size
    x, rates = m.x0 + m.S0 @ m.accepted, slice(n, 2 * n)
    q, mass, hx, hy, inertia = x[:n], *x[2 * n:2 * n + 4]
    set_parameters(motion, x)
    J = body_jacobian(tip_jacobian(motion.arm, np.zeros(4), q), tip_angle(motion.arm, q), (hx / mass, hy / mass))
    response = np.linalg.solve(mass_matrix(motion.arm, np.zeros(4), q), J.T)
    impulse = np.linalg.solve(J @ response, J @ (x[rates] - before[rates]))
    return float(J[2] @ x[rates] + impulse[2] / (inertia - (hx * hx + hy * hy) / mass))


def run(seed: int, noise: np.ndarray) -> tuple[list[dict[str, float]], bool]:
    """Return what is found before the capture, 1 s and 3 s after it, and whether it is TRACKING at the end."""
    plant = replace(PLANT, noise='std', noise_std=tuple(noise.tolist()), seed=seed)
    record = simulator.simulate(plant, excitation.sequence(ExcitationParameters(), END), (EVENT,))
    rows = trials.as_samples(record.position, record.velocity, record.effort, 1e-3)
    config = IdentifierParameters(arm=TOLD, payload=PayloadParameters(event_time_std=0.0))  # as the bounds
    state = structured.advance(config, structured.init(config), rows.between(0, CAPTURE))
    found = [{one.name: one.value for one in taught(config, state)}]
    state = structured.event(config, state, EVENT)
    assert state.memory is not None
    before = state.memory.x0.copy()
    state = structured.advance(config, state, rows.between(CAPTURE, SPIN))
    begun = state.horizon is not None and state.horizon.row == CAPTURE
    found.append({'object_spin': spin(state, before) if begun else np.nan})
    state = structured.advance(config, state, rows.between(SPIN, END))
    payload = structured.estimate(config, state)
    found.append({one.name: one.value for one in taught(config, state)})
    found[-1] |= {'payload_mass': payload.mass, 'payload_com_x': payload.com[0], 'payload_com_y': payload.com[1],
                  'payload_inertia': payload.inertia[5]}
    return found, payload.status is Status.TRACKING


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--runs', type=int, default=10)
    runs = parser.parse_args().runs
    efforts, config, true = excitation.sequence(ExcitationParameters(), END), IdentifierParameters(arm=TOLD), truth()
    quiet = simulator.simulate(replace(PLANT, noise='none'), efforts, (EVENT,))
    noise = sensors.std_for_snr(quiet.position, quiet.velocity, 40.0)
    counts = (0, CAPTURE, SPIN, END)
    bounds = everything(config, PLANT, efforts, CAPTURE, noise[[2, 3, 6, 7, 0, 1]], counts)
    done = [run(seed, noise) for seed in range(runs)]
    tracking = [found for found, good in done if good]
    rows: list[dict[str, Any]] = []
    print(f'{len(tracking)} of {runs} runs TRACKING; errors of those')
    print('quantity                        after     value     prior     bound       rms  efficiency')
    for k, count in enumerate(counts[1:]):
        for name, values in bounds.items():
            if not any(name in found[k] for found in tracking):
                continue
            errors = np.array([found[k].get(name, np.nan) for found in tracking]) - true[name]  # only some learn delays
            errors = errors[np.isfinite(errors)]
            rms = float(np.sqrt(np.mean(errors ** 2))) if errors.size else np.nan
            of_arm = not name.startswith(('payload', 'object'))
            row = {'quantity': name, 'samples': count, 'value': true[name], 'runs': int(errors.size),
                   'prior': float(values[0]) if of_arm else None, 'bound': float(values[k + 1]), 'rms': rms,
                   'efficiency': rms / float(values[k + 1])}
            rows.append(row)
            print(f'{name:28}{count:9d}{true[name]:10.4g}' + (f"{row['prior']:10.3g}" if of_arm else ' ' * 10)
                  + f"{row['bound']:10.3g}{rms:10.3g}{row['efficiency']:10.2f}", flush=True)
    claims.write('payload_bounds', [{'runs': runs, 'tracking': len(tracking)}, *rows])


if __name__ == '__main__':
    main()
