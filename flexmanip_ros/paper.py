"""Section 4 of the paper as cases and methods: what is simulated, and which estimators look at it.

Linear plant at a fixed working point, one mode a link, the paper's torque convention (torque 2 does no work
on bending), chord angles, rates continuous at the capture, 40 dB, 1 kHz, square waves, capture at 3 s,
errors averaged over 4 to 6 s. Its Table 1 is lost: the arm is the reference arm of the parameters.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from flexmanip_ros import paper_single_link as single_link
from flexmanip_ros import pipeline, rivals, study
from flexmanip_ros.parameters import ArmParameters, PlantParameters, configure
from flexmanip_ros.payload import bounds
from flexmanip_ros.plant import excitation, simulator
from flexmanip_ros.plant.noise import std_for_snr
from flexmanip_ros.scenario import Run, Scenario
from flexmanip_ros.types import Array, CaptureEvent, Estimate, EventKind, StateSpace

ARM: Mapping[str, Any] = {
    'modes': 1, 'torque_convention': 'paper', 'angle_convention': 'chord', 'shortening': False,
    'slope_correction': False}
WINDOW = (4.0, 6.0)
CAPTURE_TIME = 3.0
TRACK_RATE = 5.0
"""Estimates a second: enough for the tracks, and thirty runs stay quick."""


@dataclass(frozen=True)
class Case:
    """One simulation of the paper. angles_deg: chord angles; payload [kg]; model: of the plant."""

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
    """One estimator: identifier parameters over the defaults, and who proposed it."""

    name: str
    words: str
    settings: Mapping[str, Any]
    rival: str = ''
    """Name in ``rivals`` of a method that is no part of the identifier."""


PAYLOADS = (Case('payload_20', 20.0, (60.0, 45.0)), Case('payload_50', 50.0, (60.0, 45.0)),
            Case('payload_100', 100.0, (60.0, 45.0)))
CONFIGURATIONS = (Case('configuration_0_0', 100.0, (0.0, 0.0)),
                  Case('configuration_45_0', 100.0, (45.0, 0.0)),
                  Case('configuration_-45_45', 100.0, (-45.0, 45.0)))
FINITE_ELEMENT = Case('finite_element', 20.0, (45.0, 0.0), 'finite_element')
CASES = (*PAYLOADS, *CONFIGURATIONS, FINITE_ELEMENT)

_LONG = {'payload_method': 'block', 'forgetting_factor': [0.9995, 0.9995, 0.9995]}
_WEIGHED = {'payload.gravity': single_link.GRAVITY, 'outputs': ['joint2/position'], 'order': 1}
METHODS = (
    Method('paper', "the paper's settings: beta 0.99, no restart, block extraction", {
        'payload_method': 'block', 'estimator': 'paper', 'forgetting': 'constant',
        'restart_on_event': False}),
    Method('restart', 'ours: restart at the capture, beta 0.9995, block extraction', _LONG),
    Method('known M_b', 'ours: the same with the coupling block taken from the arm',
           {**_LONG, 'payload.known_coupling': True}),
    Method('rigid RLS', "the paper's rival: recursive least squares on two rigid links", {}, 'rigid_rls'),
    Method('algebraic', "the paper's rival on the same run: link 2, its moving base left out", {},
           'algebraic'),
    Method('algebraic, 1 link', 'as the paper runs it: a run of its own, link 2 alone on a fixed base under '
           'gravity, which weighs the object', _WEIGHED, 'algebraic'),
    Method('structured', "ours: the arm's equations of motion (the default)", {
        'payload_method': 'structured', 'payload.dynamics': 'linear', 'refinement': 'none'}),
)
ALONE = 'algebraic, 1 link'
BEST_MODEL = 'restart'
"""The method whose state-space model is shown in the test responses and frequency tracks."""


@lru_cache(maxsize=32)
def bound(case: Case, method: str) -> float | None:
    """Return the Cramer-Rao bound of the payload [kg] at the end of a run; None where a method has none.

    ``structured`` knows the structure; the block extractions know nothing of (A, B), and theirs is the bound
    of their own formula (docs of ``payload.bounds``).
    """
    if case.model != 'linear' or any(known.rival for known in METHODS if known.name == method):
        return None
    run = scenario(case, METHODS[0]).configuration(0, METHODS[0].name)
    quiet = replace(run.plant, noise='none')
    torque = excitation.sequence(run.excitation, round(WINDOW[1] * quiet.rate))
    clean = simulator.simulate(quiet, torque, (CaptureEvent(round(CAPTURE_TIME * 1e9), EventKind.CAPTURE),))
    noise = std_for_snr(clean.position, clean.velocity, run.plant.snr_db)
    first = round(CAPTURE_TIME * quiet.rate)
    states = np.hstack([clean.position[first:, 2:], clean.velocity[first:, 2:]])
    given = (quiet.arm, np.radians(case.angles_deg), case.payload, states, torque[first:],
             np.concatenate([noise[2:4], noise[6:8]]), 1.0 / quiet.rate, (len(states),))
    if method == 'structured':
        return float(bounds.structure_known(*given)[0])
    return float(bounds.structure_unknown(*given, known_mb=method == 'known M_b')[0])


class Track(NamedTuple):
    """One method over one run: time (T,) [s], mass, lower, upper (T,) [kg], frequencies (T, 2) [Hz]."""

    time: Array
    mass: Array
    lower: Array
    upper: Array
    frequencies: Array
    model: StateSpace | None


def scenario(case: Case, method: Method) -> Scenario:
    """Return the scenario of a case for one method."""
    modes = 3 if case.model != 'linear' and method.name == 'structured' else 1
    identifier: dict[str, Any] = {f'arm.{name}': value for name, value in ARM.items()}
    identifier |= {'arm.modes': modes}
    identifier |= {'publish_rate': TRACK_RATE, 'model_rate': TRACK_RATE, **method.settings}
    return Scenario(
        name=case.name, capture_time=CAPTURE_TIME, window=WINDOW,
        plant={**{f'arm.{name}': value for name, value in ARM.items()}, 'model': case.model,
               'capture_impact': 'continuous', 'payload_mass': case.payload,
               'initial_angles': [math.radians(angle) for angle in case.angles_deg]},
        identifier=identifier, estimators={method.name: {}})


def run(case: Case, seed: int) -> tuple[list[study.Row], dict[str, Track]]:
    """Simulate one experiment and put every method over the same samples; rows and tracks."""
    rows: list[study.Row] = []
    tracks: dict[str, Track] = {}
    items = None
    for method in METHODS:
        row: study.Row = {'case': case.name, 'method': method.name, 'seed': seed, 'error': ''}
        try:
            made = scenario(case, method)
            configured = made.configuration(seed, method.name)
            if items is None:
                items = study.messages(made, configured, seed)
            seen = _own_run(case, seed) if method.name == ALONE else items
            columns, tracks[method.name] = _measure(configured, seen, case, method.rival)
            row.update(columns)
        except Exception as error:  # a defect in one method must not hide the others
            row['error'] = study.describe(error)
        rows.append(row)
    return rows, tracks


def _own_run(case: Case, seed: int) -> list[Any]:
    return single_link.messages(
        configure(ArmParameters, ARM), math.radians(case.angles_deg[1]), case.payload, seed,
        duration=WINDOW[1], capture_time=CAPTURE_TIME, snr_db=PlantParameters().snr_db)


def _measure(configured: Run, items: list[Any], case: Case, rival: str = '') -> tuple[study.Row, Track]:
    started = time.perf_counter()
    if rival:
        estimates = list(rivals.run(rival, configured.identifier, items))
    else:
        estimates = list(pipeline.run(configured.identifier, items))
    wall = time.perf_counter() - started
    row, track = _columns(estimates, case, configured)
    row['us_per_sample'] = 1e6 * wall / sum(1 for item in items if hasattr(item, 'names'))
    return row, track


def _columns(estimates: list[Estimate], case: Case, configured: Run) -> tuple[study.Row, Track]:
    track = follow(estimates)
    inside = (track.time >= WINDOW[0]) & (track.time <= WINDOW[1])
    true = np.array(study.true_frequencies(configured, case.payload))
    relative = 100.0 * np.abs(track.mass - case.payload) / case.payload
    frequency = 100.0 * np.abs(track.frequencies - true) / true
    held = (track.lower <= case.payload) & (case.payload <= track.upper)
    row: study.Row = {
        'payload_true_kg': case.payload, 'payload_mass_kg': _last(track.mass),
        'payload_lower_kg': _last(track.lower), 'payload_upper_kg': _last(track.upper),
        'covered': bool(held[-1]) if held.size else None,
        'error_percent': _mean(relative[inside]), 'status': estimates[-1].status.name if estimates else '',
    }
    for k in range(true.size):
        row[f'true_frequency_{k + 1}'] = float(true[k])
        row[f'frequency_error_percent_{k + 1}'] = _mean(frequency[inside, k])
    return row, track


def follow(estimates: list[Estimate]) -> Track:
    """Return estimates as arrays; what there was not is nan."""
    count = len(estimates)
    table = np.full((count, 3), np.nan)
    frequencies = np.full((count, 2), np.nan)
    for k, estimate in enumerate(estimates):
        if estimate.payload is not None:
            table[k] = estimate.payload.mass, estimate.payload.lower, estimate.payload.upper
        found = [mode.frequency_hz for mode in estimate.modes[:2]]
        frequencies[k, :len(found)] = found
    start = estimates[0].stamp_ns if estimates else 0
    stamps = np.array([(estimate.stamp_ns - start) / 1e9 for estimate in estimates], dtype=np.float64)
    return Track(stamps, table[:, 0], table[:, 1], table[:, 2], frequencies,
                 estimates[-1].model if estimates else None)


def _mean(values: Array) -> float | None:
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else None


def _last(values: Array) -> float | None:
    return float(values[-1]) if values.size and math.isfinite(values[-1]) else None

