"""One experiment of the paper: every method on the same samples, as rows and as tracks over time.

Work that several methods share is done once: methods that read the same identifier share one pass of it, and the two
baselines share the conversion of messages to samples.

The paper runs the algebraic method on a simulation of its own: link 2 alone on a fixed base, under gravity. The link is
rigid there. Its torque is the sum of a constant part that balances the known link, a proportional and a derivative part
that keep it near its working point, and the square wave of joint 2. This torque is measured. It does not know the
payload, so the link sags at the capture.
"""

import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from flexmanip_ros import pipeline
from flexmanip_ros.identification import rpbsid
from flexmanip_ros.paper import baselines, experiments
from flexmanip_ros.paper.experiments import GRAVITY, Case, Method
from flexmanip_ros.parameters import (
    ArmParameters,
    ExcitationParameters,
    IdentifierParameters,
    PlantParameters,
    configure,
)
from flexmanip_ros.payload import block_extraction, cramer_rao
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.simulation.sensors import std_for_snr
from flexmanip_ros.studies import trial
from flexmanip_ros.studies.scenario import Run, Scenario
from flexmanip_ros.types import Array, CaptureEvent, Estimate, EventKind, JointRecord, StateSpace, Status

RATE = 1000.0
COUNT, CAPTURE = round(experiments.WINDOW[1] * RATE), round(experiments.CAPTURE_TIME * RATE)
"""Number of samples of a run, and of those before the capture."""
STIFFNESS, DAMPING = 20000.0, 4000.0
"""Proportional and derivative gain of the joint [N m/rad, N m s/rad]."""
JOINT_NAMES = ('joint1', 'joint2')
Item = JointRecord | CaptureEvent


def single_link_messages(case: Case, seed: int) -> list[Item]:
    """Return joint states of link 2 (joint 1 at rest at 0), whose chord angle at the start is that of the case."""
    torques, clean = single_link_motion(case)
    noise = float(np.std(clean)) * 10.0 ** (-PlantParameters().snr_db / 20.0)
    angles = clean + noise * np.random.default_rng(seed).normal(size=clean.size)
    empty = np.empty(0)
    items: list[Item] = [
        JointRecord(round(k * 1e9 / RATE), JOINT_NAMES, np.array([0.0, angles[k]]), empty,
                    np.array([0.0, torques[k]])) for k in range(clean.size)]
    items.insert(CAPTURE, CaptureEvent(round(CAPTURE * 1e9 / RATE), EventKind.CAPTURE))
    return items


@cache
def single_link_motion(case: Case) -> tuple[Array, Array]:
    """Return the torque of the joint [N m] and its angle [rad], (N,) each; they are the same for all seeds."""
    arm, angle = configure(ArmParameters, experiments.ARM), math.radians(case.angles_deg[1])
    L, rho = arm.link_length[1], arm.linear_density[1]
    wave = excitation.sequence(ExcitationParameters(rate=RATE), COUNT)[:, 1]
    torques, angles = np.empty(COUNT), np.empty(COUNT)
    x = np.array([angle, 0.0])
    for k in range(COUNT):
        mass = case.payload if k >= CAPTURE else 0.0
        if k == CAPTURE:  # the object is at rest: momentum is shared
            x[1] *= inertia(arm, 0.0) / inertia(arm, mass)
        known = (rho * L / 2 + arm.tip_mass) * GRAVITY * L
        weight = known + mass * GRAVITY * L
        hold = -STIFFNESS * (x[0] - angle) - DAMPING * x[1]
        torques[k], angles[k] = wave[k] + known * math.cos(angle) + hold, x[0]
        x = _integrated(x, torques[k], weight, inertia(arm, mass))
    return torques, angles


def inertia(arm: ArmParameters, payload: float) -> float:
    """Return the link's inertia about its joint with the object at its end [kg m^2]."""
    L = arm.link_length[1]
    return arm.linear_density[1] * L**3 / 3 + (arm.tip_mass + payload) * L**2


def _integrated(x: Array, torque: float, weight: float, moment: float) -> Array:
    """One period of J theta'' + weight cos(theta) = torque by the classical Runge-Kutta method."""
    def slope(at: Array) -> Array:
        return np.array([at[1], (torque - weight * math.cos(at[0])) / moment])

    h = 1.0 / RATE
    a = slope(x)
    b = slope(x + h / 2 * a)
    c = slope(x + h / 2 * b)
    d = slope(x + h * c)
    return np.asarray(x + h / 6 * (a + 2 * b + 2 * c + d), dtype=np.float64)


class Track(NamedTuple):
    """One method over one run: time (T,) [s], mass, lower, upper (T,) [kg], frequencies (T, 2) [Hz]."""

    time: Array
    mass: Array
    lower: Array
    upper: Array
    frequencies: Array
    model: StateSpace | None


MethodResult = tuple[list[Estimate], float]
"""The estimates of a method, the last one at the last sample, and the time they took [s]."""


def work(task: tuple[Case, int | None]) -> Any:
    """Compute the bounds of a case, or one run of it where a seed is given."""
    case, seed = task
    return bounds(case) if seed is None else run(case, seed)


def run(case: Case, seed: int) -> tuple[list[trial.Row], dict[str, Track]]:
    """Simulate one experiment and run every method on the same samples; return rows and tracks.

    An exception of one method becomes the ``error`` of its row; the others are run all the same.
    """
    found: dict[str, MethodResult] = {}
    failures: dict[str, str] = {}
    alone = [method for method in experiments.METHODS if method.name == experiments.ALONE]
    others = [method for method in experiments.METHODS if method.name != experiments.ALONE]
    baselined = [method for method in others if method.baseline]
    items: list[Item] = []
    with _attempt(failures, others):
        items = _messages(case, seed)
    for name in experiments.IDENTIFIERS if items else ():
        readers = [method for method in others if method.identifier == name]
        with _attempt(failures, readers):
            found.update(_identify(case, name, readers, items))
    if items:
        with _attempt(failures, baselined):
            found.update(_compare(case, baselined, items))
    with _attempt(failures, alone):
        found.update(_compare(case, alone, single_link_messages(case, seed)))
    return _rows(case, seed, found, failures)


def failed(case: Case, seed: int, error: BaseException) -> tuple[list[trial.Row], dict[str, Track]]:
    """Return what ``run`` returns, for a run that ended with an error."""
    return _rows(case, seed, {}, {method.name: trial.describe(error) for method in experiments.METHODS})


@contextmanager
def _attempt(failures: dict[str, str], methods: Sequence[Method]) -> Iterator[None]:
    """Record an exception as the error of these methods, and go on."""
    try:
        yield
    except Exception as error:
        failures.update({method.name: trial.describe(error) for method in methods})


def _rows(case: Case, seed: int, found: dict[str, MethodResult], failures: dict[str, str]
          ) -> tuple[list[trial.Row], dict[str, Track]]:
    rows: list[trial.Row] = []
    tracks: dict[str, Track] = {}
    for method in experiments.METHODS:
        row: trial.Row = {'case': case.name, 'method': method.name, 'seed': seed,
                          'error': failures.get(method.name, '')}
        if method.name in found:
            estimates, wall = found[method.name]
            tracks[method.name] = track_of(estimates)
            row.update(_columns(estimates, tracks[method.name], case))
            row['us_per_sample'] = 1e6 * wall / (experiments.WINDOW[1] * PlantParameters().rate)
        rows.append(row)
    return rows, tracks


def _identify(case: Case, name: str, readers: Sequence[Method], items: Sequence[Item]) -> dict[str, MethodResult]:
    """Run one identifier once; the time of each method that reads it is that of the pass and its own reading.

    A method without settings of its own takes the identifier's estimates; the others read a block payload
    from its model, from the capture on.
    """
    configs = {method.name: _configured(case, method.name)[1].identifier for method in readers if method.settings}
    found: dict[str, list[Estimate]] = {method.name: [] for method in readers}
    walls = dict.fromkeys(found, 0.0)
    begun = time.perf_counter()
    for state, estimate in pipeline.replay(_identifier(case, name), items):
        now = estimate if estimate is not None else pipeline.current(state)  # the last one: at the last sample
        if now is None:
            continue
        captured = (now.stamp_ns - state.first_ns) * 1e-9 >= experiments.CAPTURE_TIME
        for method in found:
            started = time.perf_counter()
            if method not in configs:
                read = now
            elif captured:
                read = _with_block(configs[method], case, state, now)
            else:
                read = now._replace(payload=None)
            found[method].append(read)
            walls[method] += time.perf_counter() - started
    shared = time.perf_counter() - begun - sum(walls.values())
    return {method: (estimates, shared + walls[method]) for method, estimates in found.items()}


def _with_block(config: IdentifierParameters, case: Case, state: pipeline.State, now: Estimate) -> Estimate:
    """Return an estimate with the payload that the blocks of its model give at the case's working point."""
    assert state.identifier is not None
    identifier = state.identifier.estimator
    try:
        found = rpbsid.identified(config, identifier.rpbsid, state.clock.dt)
    except np.linalg.LinAlgError:  # no signal moves yet
        found = None
    if found is None:
        return now._replace(payload=None, status=now.model_status)
    payload = block_extraction.estimate(config, found, np.radians(case.angles_deg), identifier.configuration_range)
    status = payload.status if found.status is Status.TRACKING else found.status
    return now._replace(payload=payload, status=status)


def _compare(case: Case, methods: Sequence[Method], items: Sequence[Item]) -> dict[str, MethodResult]:
    """Run methods that are no part of the identifier over the same samples."""
    config = _configured(case, methods[0].name)[1].identifier
    begun = time.perf_counter()
    recorded = baselines.recorded(config, items)
    shared = time.perf_counter() - begun
    found = {}
    for method in methods:
        begun = time.perf_counter()
        estimates = list(baselines.run(method.baseline, config, recorded))
        found[method.name] = estimates, shared + time.perf_counter() - begun
    return found


@cache
def _identifier(case: Case, name: str) -> IdentifierParameters:
    """Return the configuration of one of the identifiers."""
    return experiments.scenario(case, Method(name, '', name)).configuration(0, name).identifier


@cache
def _configured(case: Case, name: str) -> tuple[Scenario, Run]:
    """Return the scenario of a method and its configurations for seed 0."""
    made = experiments.scenario(case, next(method for method in experiments.METHODS if method.name == name))
    return made, made.configuration(0, name)


def _messages(case: Case, seed: int) -> list[Item]:
    made, configured = _configured(case, experiments.METHODS[0].name)
    return trial.messages(made, replace(configured, plant=replace(configured.plant, seed=seed)), seed)


@cache
def true_frequencies(case: Case, mass: float) -> tuple[float, ...]:
    """Return the two lowest frequencies of a case's arm with a payload [Hz]."""
    return tuple(trial.true_frequencies(_configured(case, experiments.METHODS[0].name)[1].plant, mass))


def _columns(estimates: Sequence[Estimate], track: Track, case: Case) -> trial.Row:
    inside = (track.time >= experiments.WINDOW[0]) & (track.time <= experiments.WINDOW[1])
    true = np.array(true_frequencies(case, case.payload))
    relative = 100.0 * np.abs(track.mass - case.payload) / case.payload
    frequency = 100.0 * np.abs(track.frequencies - true) / true
    covered = (track.lower <= case.payload) & (case.payload <= track.upper)
    row: trial.Row = {
        'payload_true_kg': case.payload, 'payload_mass_kg': _last(track.mass),
        'payload_lower_kg': _last(track.lower), 'payload_upper_kg': _last(track.upper),
        'covered': bool(covered[-1]) if covered.size else None,
        'error_percent': _mean(relative[inside]), 'status': estimates[-1].status.name if estimates else '',
    }
    for k in range(true.size):
        row[f'true_frequency_{k + 1}'] = float(true[k])
        row[f'frequency_error_percent_{k + 1}'] = _mean(frequency[inside, k])
    return row


def track_of(estimates: Sequence[Estimate]) -> Track:
    """Return estimates as arrays. Missing values are nan, and so is a mass whose standard deviation is infinite."""
    count = len(estimates)
    table = np.full((count, 3), np.nan)
    frequencies = np.full((count, 2), np.nan)
    for k, estimate in enumerate(estimates):
        payload = estimate.payload
        if payload is not None:
            table[k] = payload.mass if math.isfinite(payload.std) else np.nan, payload.lower, payload.upper
        found = [mode.frequency_hz for mode in estimate.modes[:2]]
        frequencies[k, :len(found)] = found
    start = estimates[0].stamp_ns if estimates else 0
    stamps = np.array([(estimate.stamp_ns - start) / 1e9 for estimate in estimates], dtype=np.float64)
    return Track(stamps, table[:, 0], table[:, 1], table[:, 2], frequencies, estimates[-1].model if estimates else None)


def bounds(case: Case) -> dict[str, float]:
    """Return method -> Cramer-Rao bound of the payload [kg] at the end of a run, where a method has one.

    ``structured`` knows the structure of the equations of motion. The block extractions know nothing of (A, B);
    theirs is the bound of their own formula (``payload.cramer_rao.structure_unknown``).
    """
    if case.model != 'linear':
        return {}
    run = _configured(case, experiments.METHODS[0].name)[1]
    quiet = replace(run.plant, noise='none')
    torque = excitation.sequence(run.excitation, round(experiments.WINDOW[1] * quiet.rate))
    clean = simulator.simulate(quiet, torque, (CaptureEvent(round(experiments.CAPTURE_TIME * 1e9), EventKind.CAPTURE),))
    noise = std_for_snr(clean.position, clean.velocity, run.plant.snr_db)
    first = round(experiments.CAPTURE_TIME * quiet.rate)
    states = np.hstack([clean.position[first:, 2:], clean.velocity[first:, 2:]])
    given = (quiet.arm, np.radians(case.angles_deg), case.payload, states, torque[first:],
             np.concatenate([noise[2:4], noise[6:8]]), 1.0 / quiet.rate, (len(states),))
    structure = float(cramer_rao.structure_known(*given)[0])
    trace, known = (float(cramer_rao.structure_unknown(*given, known_mb=known)[0]) for known in (False, True))
    return {'paper': trace, 'restart': trace, 'known M_b': known, 'structured': structure}


def _mean(values: Array) -> float | None:
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else None


def _last(values: Array) -> float | None:
    return float(values[-1]) if values.size and math.isfinite(values[-1]) else None
