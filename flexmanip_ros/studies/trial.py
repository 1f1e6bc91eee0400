"""One run of a scenario: one row per estimator. The number of the run is its seed.

Faults of networks and publishers can be put into the messages of the simulation.
"""

import math
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from flexmanip_ros import pipeline
from flexmanip_ros.arm.capture import free_object
from flexmanip_ros.arm.linearization import bending_frequencies
from flexmanip_ros.errors import FlexmanipError
from flexmanip_ros.parameters import IdentifierParameters, PlantParameters
from flexmanip_ros.samples.sampling import collect
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.studies.results import payload_bound, relative_error_percent, summarize
from flexmanip_ros.studies.scenario import Faults, Run, Scenario
from flexmanip_ros.types import CaptureEvent, EventKind, JointRecord

Message = JointRecord | CaptureEvent


def inject(items: Iterable[Message], faults: Faults, rng: np.random.Generator) -> list[Message]:
    """Return the messages with the faults of a scenario; events are delayed, never lost."""
    given = list(items)
    records = [item for item in given if isinstance(item, JointRecord)]
    events = [item for item in given if isinstance(item, CaptureEvent)]
    if not records:
        return given
    start = records[0].stamp_ns
    begin, end = (start + round(edge * 1e9) for edge in faults.gap)
    arriving: list[tuple[int, Message]] = []
    for record in records:
        chances = rng.random(4)  # always drawn, so that the probability of one fault does not move another
        if chances[0] < faults.drop or begin <= record.stamp_ns < end:
            continue
        sent = _with_nan(record, rng) if chances[3] < faults.nan else record
        arriving.append((record.stamp_ns, sent))
        if chances[1] < faults.duplicate:
            arriving.append((record.stamp_ns, sent))
        if chances[2] < faults.swap and len(arriving) > 1:
            (earlier, first), (later, second) = arriving[-2:]
            arriving[-2:] = [(earlier, second), (later, first)]
    delay = round(faults.event_delay * 1e9)
    # An event without delay arrives before the sample of its own stamp, as in a recording.
    arriving += [(event.stamp_ns + delay - (delay == 0), event) for event in events]
    return [item for _, item in sorted(arriving, key=lambda pair: pair[0])]


def _with_nan(record: JointRecord, rng: np.random.Generator) -> JointRecord:
    position = record.position.copy()
    position[int(rng.integers(position.size))] = np.nan
    return record._replace(position=position)


Row = dict[str, Any]
"""Column name -> bool, int, float, str or None."""


def trial(scenario: Scenario, seed: int) -> list[Row]:
    """Simulate one run and run every estimator of the scenario on the same samples.

    An exception of one estimator becomes the ``error`` of its row; the others are run all the same.
    """
    rows = []
    for name in scenario.estimators:
        row: Row = {'scenario': scenario.name, 'seed': seed, 'estimator': name, 'error': ''}
        try:
            run = scenario.configuration(seed, name)
            row.update(drawn_columns(run.drawn))
            items = messages(scenario, run, seed)
            true_kg = held(run.events, run.plant.payload_mass)
            row.update(measure(run.identifier, items, true_kg, scenario.window, bound=scenario.bound))
            row.update(frequency_columns(run, row))
        except Exception as error:  # a defect in one estimator must not end a study of thousands
            row['error'] = describe(error)
        rows.append(row)
    return rows


def describe(error: BaseException) -> str:
    """Return an error as the text of a row; those of other packages with their type."""
    if isinstance(error, FlexmanipError):
        return str(error)
    return ' '.join(f'{type(error).__name__}: {error}'.split())


def messages(scenario: Scenario, run: Run, seed: int) -> list[JointRecord | CaptureEvent]:
    """Return the messages that the estimators of a run receive."""
    count = max(round(scenario.duration * run.plant.rate), 1)
    trajectory = simulator.simulate(run.plant, excitation.sequence(run.excitation, count), run.events)
    rng = np.random.default_rng([seed, 1 << 20])  # another random stream than those of `vary`
    return inject(simulator.records(trajectory, run.events), scenario.faults, rng)


def held(events: Iterable[CaptureEvent], mass: float) -> float:
    """Return the mass [kg] that is held after the latest of some events, where an object of this mass is caught."""
    last = max(events, key=lambda event: event.stamp_ns, default=None)
    return mass if last is not None and last.kind is EventKind.CAPTURE else 0.0


def measure(config: IdentifierParameters, items: Sequence[pipeline.Item], true_kg: float | None,
            window: tuple[float, float], *, bound: bool = False, settled: float = 0.0) -> Row:
    """Run the identifier and return the columns of a row.

    true_kg: mass that is held at the end [kg]; None when unknown. window: start and end [s] of the mean error. It
    starts at the earliest ``settled`` seconds after the event from which on the true mass holds. bound: add the least
    standard deviation that the samples after the capture allow.
    """
    started = time.perf_counter()
    state, estimates = pipeline.init(), []
    for now, estimate in pipeline.replay(config, items):
        state = now
        if estimate is not None:
            estimates.append(estimate)
    wall = time.perf_counter() - started
    last = pipeline.current(state)
    summary = summarize(state, last, wall)
    row: Row = summary.as_json()
    low, high = row.pop('payload_ci95_kg') or (None, None)
    for name in ('vaf_simulation_percent', 'vaf_prediction_percent', 'vaf_horizon_percent', 'wall_s'):
        row.pop(name)
    for kind in ('payload_com_m', 'payload_com_std_m'):
        row[f'{kind}_x'], row[f'{kind}_y'] = row.pop(kind) or (None, None)
    for kind in ('frequencies_hz', 'damping_ratios'):
        for k, value in enumerate(row.pop(kind)):
            row[f'{kind.split("_")[0]}_{k + 1}'] = value
    row.update(payload_lower_kg=low, payload_upper_kg=high, us_per_sample=1e6 * wall / max(state.counters.accepted, 1))
    is_loaded = summary.held_since_s is not None
    row['payload_true_kg'] = true_kg
    row['covered'] = None if true_kg is None or low is None or high is None else bool(low <= true_kg <= high)
    changed = row['capture_time_s'] if is_loaded else row['release_time_s']
    begin = window[0] if changed is None else max(window[0], changed + settled)
    masses = np.array([
        estimate.payload.mass for estimate in estimates if estimate.payload is not None
        and begin <= (estimate.stamp_ns - state.first_ns) * 1e-9 <= window[1]], dtype=np.float64)
    error = math.nan if true_kg is None else relative_error_percent(masses, true_kg)
    row['error_percent'] = None if math.isnan(error) else error
    if bound and is_loaded and config.payload_method != 'none':
        mass = row['payload_mass_kg'] if true_kg is None else true_kg
        row['bound_std_kg'] = None if mass is None else payload_bound(
            config, collect(config, items), row['capture_time_s'], mass, state.clock.dt)
    return row


def frequency_columns(run: Run, row: Mapping[str, Any]) -> Row:
    """Return the true frequencies at the working point and the largest relative error of those found [%]."""
    mass = row.get('payload_true_kg') or 0.0
    true = true_frequencies(run.plant, mass)
    found = [row[f'frequencies_{k + 1}'] for k in range(len(true)) if f'frequencies_{k + 1}' in row]
    columns: Row = {f'true_frequency_{k + 1}': value for k, value in enumerate(true)}
    if len(found) == len(true):
        columns['frequency_error_percent'] = max(
            100.0 * abs(value - known) / known for value, known in zip(found, true, strict=True))
    return columns


def true_frequencies(plant: PlantParameters, mass: float) -> list[float]:
    """Return the two lowest damped frequencies of the arm, linearized at its start, with the plant's object [Hz].

    mass: that of the object, or 0 for the empty arm [kg].
    """
    held = free_object(replace(plant, payload_mass=mass)).payload if mass else 0.0
    found = bending_frequencies(plant.arm, np.array(plant.initial_angles), held, locked=plant.locked)
    return [float(frequency) for frequency in found[:2]]


def drawn_columns(drawn: Mapping[str, Any]) -> Row:
    """Return the values drawn for a run, a column for each number."""
    columns: Row = {}
    for name, value in drawn.items():
        if isinstance(value, (list, tuple)):
            columns.update({f'{name}.{k + 1}': item for k, item in enumerate(value)})
        else:
            columns[name] = value
    return columns
