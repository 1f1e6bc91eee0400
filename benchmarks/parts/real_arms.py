"""Arms as they are and what they catch: friction, rotors, gains and offsets of the signals, bodies, floating bases.

The simulated arm has five sines a link beside the static shapes, the estimator's three; 40 dB, square waves of 10 and 5
N m, capture after 3 s, random object and start.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from flexmanip_ros.parameters import ArmParameters, ExcitationParameters, IdentifierParameters, PlantParameters
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import CaptureEvent, EventKind

IDEAL = ArmParameters(damping_ratio=0.003)
SINES = 5
SAMPLES = 6000
CAPTURE = CaptureEvent(3_000_000_000, EventKind.CAPTURE)
FRICTION = {'joint_viscous_friction': (0.8, 0.8), 'joint_coulomb_friction': (0.15, 0.15)}
ROTOR = {'rotor_inertia': (0.2, 0.2)}
GAINS = {'torque_gain': (1.04, 1.04), 'bend_gain': (0.98, 0.98), 'bend_offset': (5e-4, 5e-4)}
BASE = {'base_mass': 700.0, 'base_inertia': 180.0}

CASES: dict[str, tuple[dict[str, Any], bool, bool]] = {  # arm, whether the object is a body, whether it moves
    'ideal': ({}, False, False),
    'viscous': ({'joint_viscous_friction': (5.0, 3.0)}, False, False),
    'coulomb': ({'joint_coulomb_friction': (1.0, 0.5)}, False, False),
    'rotor': ({'rotor_inertia': (0.5, 0.5)}, False, False),
    'friction and rotor': ({**FRICTION, **ROTOR}, False, False),
    'gains and offset': (GAINS, False, False),
    'body': ({}, True, False),
    'moving body': ({}, True, True),
    'moving body, floating base': (BASE, True, True),
    'friction, rotor, gains, offset': ({**FRICTION, **ROTOR, **GAINS}, False, False),
    'friction, rotor, gains, offset, moving body': ({**FRICTION, **ROTOR, **GAINS}, True, True),
    'all': ({**FRICTION, **ROTOR, **GAINS, **BASE}, True, True),
}


def plant_of(case: str, seed: int) -> PlantParameters:
    """Return the arm, its object and its start."""
    own, body, moves = CASES[case]
    rng = np.random.default_rng(seed)
    plant = PlantParameters(
        arm=replace(IDEAL, modes=SINES, **own), seed=seed, payload_mass=rng.uniform(10.0, 40.0),
        initial_angles=(math.radians(rng.uniform(0.0, 90.0)), math.radians(rng.uniform(20.0, 100.0))))
    if body:
        direction, distance = rng.uniform(-np.pi, np.pi), rng.uniform(0.05, 0.15)
        plant = replace(plant, payload_com=(distance * math.cos(direction), distance * math.sin(direction)),
                        payload_inertia=rng.uniform(0.4, 1.5))
    if moves:
        plant = replace(plant, object_velocity=tuple(rng.uniform(-0.03, 0.03, 2).tolist()),
                        object_spin=rng.uniform(-0.15, 0.15))
    return plant


def simulate(plant: PlantParameters) -> simulator.Trajectory:
    """Return six seconds of it."""
    return simulator.simulate(plant, excitation.sequence(ExcitationParameters(), SAMPLES), (CAPTURE,))


def told(plant: PlantParameters) -> IdentifierParameters:
    """Return the parameters of an estimator that is told the ideal arm and the constants of the base."""
    base = {name: getattr(plant.arm, name) for name in ('base_mass', 'base_inertia', 'base_joint_offset')}
    return IdentifierParameters(arm=replace(IDEAL, **base), model_rate=0.1)
