"""Section 4 of the paper as cases (what is simulated) and methods (how the payload is estimated).

Most plants are linear at a fixed working point, with one mode per link. All have the paper's torque convention (torque
2 does no work on bending) and chord angles. Rates are continuous at the capture at 3 s. The signal-to-noise ratio is 40
dB, the sample rate 1 kHz. The torques are square waves. Errors are averaged over 4 to 6 s. Table 1 of the paper is
lost: the arm is the reference arm of the parameters.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from flexmanip_ros.studies.scenario import Scenario

ARM: Mapping[str, Any] = {
    'modes': 1, 'torque_convention': 'paper', 'angle_convention': 'chord', 'shortening': False,
    'shape_functions': 'sines'}
WINDOW = (4.0, 6.0)
"""Begin and end of the time over which errors are averaged [s]."""
CAPTURE_TIME = 3.0
GRAVITY = 9.81
"""Gravity in the run of link 2 alone [m/s^2]; the arm itself moves in a horizontal plane."""
TRACK_RATE = 5.0
"""Rate of the estimates [Hz]: enough for the tracks, and low enough that thirty runs stay quick."""


@dataclass(frozen=True)
class Case:
    """One simulation of the paper. angles_deg: chord angles; payload [kg]; model: that of the plant."""

    name: str
    payload: float
    angles_deg: tuple[float, float]
    model: str = 'linear'

    @property
    def title(self) -> str:
        """The case in words."""
        plant = ', finite element plant' if self.model == 'finite_element' else ''
        return f'{self.payload:g} kg at {self.angles_deg[0]:g}/{self.angles_deg[1]:g} deg{plant}'


@dataclass(frozen=True)
class Method:
    """One method to estimate the payload."""

    name: str
    words: str
    identifier: str = ''
    """The one of ``IDENTIFIERS`` whose state it reads; several methods may read the same one."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Identifier parameters that replace those of ``identifier`` when its state is read."""
    baseline: str = ''
    """Name in ``paper.baselines`` of a method that is no part of the identifier."""


PAYLOADS = (Case('payload_20', 20.0, (60.0, 45.0)), Case('payload_50', 50.0, (60.0, 45.0)),
            Case('payload_100', 100.0, (60.0, 45.0)))
CONFIGURATIONS = (Case('configuration_0_0', 100.0, (0.0, 0.0)),
                  Case('configuration_45_0', 100.0, (45.0, 0.0)),
                  Case('configuration_-45_45', 100.0, (-45.0, 45.0)))
FINITE_ELEMENT = Case('finite_element', 20.0, (45.0, 0.0), 'finite_element')
CASES = (*PAYLOADS, *CONFIGURATIONS, FINITE_ELEMENT)

IDENTIFIERS: Mapping[str, Mapping[str, Any]] = {
    'paper': {'payload_method': 'none', 'estimator': 'paper', 'forgetting': 'constant',
              'restart_on_event': False},
    'ours': {'payload_method': 'structured', 'forgetting_factor': [0.9995, 0.9995, 0.9995]},
}
"""The identifiers that are run: parameters that differ from the defaults."""
_BLOCK = {'payload_method': 'block'}
_WEIGHED = {'arm.gravity': [0.0, -GRAVITY], 'outputs': ['joint2/position'], 'order': 1}
METHODS = (
    Method('paper', "the paper's settings: beta 0.99, no restart, block extraction", 'paper', _BLOCK),
    Method('restart', 'ours: restart at the capture, beta 0.9995, maximum-likelihood refinement; block '
           'extraction', 'ours', _BLOCK),
    Method('known M_b', 'ours: the same model, the coupling block taken from the arm', 'ours',
           {**_BLOCK, 'payload.known_coupling': True}),
    Method('rigid RLS', "the paper's baseline: recursive least squares on two rigid links", baseline='rigid_rls'),
    Method('algebraic', "the paper's baseline on the same run: link 2, its moving base left out",
           baseline='algebraic'),
    Method('algebraic, 1 link', 'as the paper runs it: a run of its own, link 2 alone on a fixed base under '
           'gravity, which weighs the object', settings=_WEIGHED, baseline='algebraic'),
    Method('structured', "ours: the arm's equations of motion (the default)", 'ours'),
)
ALONE = 'algebraic, 1 link'
BEST_MODEL = 'restart'
"""The method whose state-space model is shown in the test responses and frequency tracks."""


def scenario(case: Case, method: Method) -> Scenario:
    """Return the scenario of a case for one method."""
    from flexmanip_ros.studies.scenario import Scenario  # it imports numpy, which the arguments need not wait for

    arm = {f'arm.{name}': value for name, value in ARM.items()}
    angles = [math.radians(angle) for angle in case.angles_deg]
    return Scenario(
        name=case.name, capture_time=CAPTURE_TIME, window=WINDOW,
        plant={**arm, 'model': case.model, 'capture_impact': 'continuous', 'payload_mass': case.payload,
               'initial_angles': angles},
        identifier={**arm, 'arm.modes': 1 if case.model == 'linear' else 3, 'publish_rate': TRACK_RATE,
                    'model_rate': TRACK_RATE, 'payload.dynamics': 'linear', 'payload.working_point': angles,
                    **IDENTIFIERS.get(method.identifier, {}), **method.settings},
        estimators={method.name: {}})
