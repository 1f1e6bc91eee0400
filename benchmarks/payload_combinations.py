"""Claim: whatever the conventions, signals, rates and parameters, `structured` knows at 60 dB what the simulator holds.

Each arm is simulated by the estimator's own equations, so an error beyond the interval shows that the two do not mean
the same by a parameter. Once the arm is told as it is, once all that `payload.learn` names is learned too. Payloads
0.25 and 1 s after the capture, or the release, and at the end. Use: payload_combinations.py
"""

from __future__ import annotations

from typing import Any

import claims
import numpy as np
from parts import payload_trials as trials

from flexmanip_ros.parameters import ExcitationParameters, IdentifierParameters, PlantParameters, configure
from flexmanip_ros.payload import structured
from flexmanip_ros.samples.sample_log import log_of
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import CaptureEvent, EventKind, Status

BENDS, RATES = list(trials.BENDS), list(trials.RATES)
FLOATING = {'base_mass': 700.0, 'base_inertia': 180.0, 'base_joint_offset': [0.3, 0.1]}
BODY = {'payload_inertia': 2.0, 'payload_com': [0.1, 0.05], 'object_spin': 0.3, 'object_velocity': [0.05, 0.02]}
ONE: dict[str, Any] = {
    'link_length': [0.41], 'linear_density': [0.5], 'bending_stiffness': [5.0], 'tip_mass': 0.02,
    'joint_viscous_friction': [0.0], 'joint_coulomb_friction': [0.0], 'rotor_inertia': [0.0], 'hub_inertia': [0.0],
    'sensor_position': [0.5], 'torque_gain': [1.0], 'bend_gain': [1.0], 'bend_offset': [0.0], 'torque_lag': [0.0]}
LINEAR = {'plant': {'model': 'linear'}, 'given': {'payload.dynamics': 'linear'}}
PAPER = {'torque_convention': 'paper', 'angle_convention': 'chord', 'shape_functions': 'sines', 'shortening': False}
GAINS = {'torque_gain': [0.95, 1.04], 'bend_gain': [1.03, 0.97], 'bend_offset': [0.001, -0.002]}
ROTORS = {'joint_viscous_friction': [1.0, 0.5], 'rotor_inertia': [0.5, 0.2]}
COMBINATIONS: dict[str, dict[str, Any]] = {
    'default': {}, 'chord angles': {'arm': {'angle_convention': 'chord'}},
    "the paper's torques": {'arm': {'torque_convention': 'paper'}}, "the paper's arm": {'arm': PAPER},
    'three sines': {'arm': {'shape_functions': 'sines'}}, 'modal damping': {'arm': {'damping_model': 'modal'}},
    'no shortening': {'arm': {'shortening': False}}, 'sensors at 0.3 and 0.7': {'arm': {'sensor_position': [0.3, 0.7]}},
    'hubs': {'arm': {'hub_inertia': [0.3, 0.2]}}, 'gravity': {'arm': {'gravity': [0.0, -1.0]}},
    'floating base': {'arm': FLOATING}, 'gains, offsets': {'arm': GAINS}, 'viscous friction, rotors': {'arm': ROTORS},
    'Coulomb friction': {'arm': {**ROTORS, 'joint_coulomb_friction': [0.3, 0.1]}},
    'late signals': {'arm': {'torque_delay': 0.002, 'torque_lag': [0.003, 0.003], 'bend_delay': 0.001}},
    'bends alone': {'given': {'outputs': BENDS}}, 'rates of bends alone': {'given': {'outputs': RATES}},
    'one bend': {'given': {'outputs': BENDS[:1]}},
    'angles among the outputs': {'given': {'outputs': ['joint1/position', 'joint2/position', *BENDS]}},
    '200 Hz': {'rate': 200.0}, '500 Hz': {'rate': 500.0}, '2 kHz': {'rate': 2000.0},
    'a point': {'given': {'payload.object': 'point'}}, 'rates continuous': {'plant': {'capture_impact': 'continuous'}},
    'a body': {'plant': BODY}, 'a body, floating base': {'arm': FLOATING, 'plant': BODY},
    '0.2 kg': {'mass': 0.2}, '500 kg': {'mass': 500.0}, 'released after 1.5 s': {'plant': BODY, 'release_s': 4.5},
    'linear': LINEAR, 'linear, chord angles': {**LINEAR, 'arm': {'angle_convention': 'chord'}},
    "linear, the paper's arm": {**LINEAR, 'arm': PAPER}, 'linear, viscous friction, rotors': {**LINEAR, 'arm': ROTORS},
    'linear, gains, offsets': {**LINEAR, 'arm': GAINS}, 'linear, 200 Hz': {**LINEAR, 'rate': 200.0},
    'one link': {'arm': ONE, 'mass': 0.05}, 'one link, 200 Hz': {'arm': ONE, 'mass': 0.05, 'rate': 200.0},
    'one link, gravity': {'arm': {**ONE, 'gravity': [0.0, -9.81]}, 'mass': 0.05},
    'one link, linear': {**LINEAR, 'arm': ONE, 'mass': 0.05}}
CAPTURE_S, END_S, MARKS_S = 3.0, 6.0, (0.25, 1.0)


def efforts(rate: float, count: int, links: int) -> np.ndarray:
    """The paper's square waves; for a short link two of its own [N m]."""
    if links == 2:
        return excitation.sequence(configure(ExcitationParameters, {'rate': rate}), count)
    t = np.arange(count) / rate
    return np.where(t % 1.0 < 0.5, 0.05, -0.05)[:, None] + np.where(2.7 * t % 1.0 < 0.5, 0.03, -0.03)[:, None]


def run(name: str, learned: bool, arm: dict[str, Any] | None = None, plant: dict[str, Any] | None = None,
        given: dict[str, Any] | None = None, mass: float = 20.0, rate: float = 1000.0, release_s: float = 0.0,
        ) -> dict[str, Any]:
    """Follow one capture, and a release; errors and half widths in per cent of the mass."""
    of_arm = {f'arm.{key}': value for key, value in {'damping_ratio': 0.003, **(arm or {})}.items()}
    links = len((arm or {}).get('link_length', (3.0, 3.0)))
    angles = np.radians([60.0, 45.0])[:links].tolist()
    config = configure(PlantParameters, {
        **of_arm, 'rate': rate, 'payload_mass': mass, 'snr_db': 60.0, 'initial_angles': angles, **(plant or {})})
    events = [CaptureEvent(round(CAPTURE_S * 1e9), EventKind.CAPTURE)]
    if release_s:
        events.append(CaptureEvent(round(release_s * 1e9), EventKind.RELEASE))
    record = simulator.simulate(config, efforts(rate, round(END_S * rate), links), tuple(events))
    joints = {} if links == 2 else {'inputs': ['joint1/effort'], 'angles': ['joint1/position'],
                                    'outputs': ['link1_bend/position', 'link1_bend/velocity']}
    told = configure(IdentifierParameters, {
        'outputs': BENDS + RATES, **joints, **of_arm, 'order': 4, **(given or {}),
        **({} if learned else {'payload.learn': ['']})})
    columns = {'position': record.position, 'velocity': record.velocity}
    Y = np.column_stack([columns[field][:, record.names.index(joint)] for joint, _, field in
                         (output.partition('/') for output in told.outputs)])
    rows = log_of(record.effort[:, :links], Y, record.position[:, :links], record.stamp_ns,
                  rates=record.velocity[:, :links]).rows(0, len(Y))
    state, start, found = structured.init(told), 0, []
    last = events[-1].stamp_ns
    for event in events:
        stop = rows.log.row_at(event.stamp_ns, start)
        state = structured.event(told, structured.advance(told, state, rows.between(start, stop)), event)
        start = stop
    for stop in (*(rows.log.row_at(last + round(mark * 1e9), start) for mark in MARKS_S), len(Y)):
        state, start = structured.advance(told, state, rows.between(start, stop)), stop
        found.append(structured.estimate(told, state))
    truth = 0.0 if release_s else mass
    return {'combination': name, 'learned': learned,
            'error_percent': trials.numbers([100.0 * (one.mass - truth) / mass for one in found]),
            'half_width_percent': trials.numbers([50.0 * (min(one.upper, 1e6) - one.lower) / mass for one in found]),
            'tracking': [one.status is Status.TRACKING for one in found],
            'inside': [one.lower <= truth <= one.upper for one in found]}


def main() -> None:
    rows = []
    for name, changed in COMBINATIONS.items():
        for learned in (False, True):
            rows.append(run(name, learned, **changed))
            print(name, 'learned' if learned else 'told', *list(rows[-1].values())[2:], flush=True)
    claims.write('payload_combinations', rows)


if __name__ == '__main__':
    main()
