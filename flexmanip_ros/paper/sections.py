"""What each figure of the paper's section 4 claims, what we measure, and how it is drawn."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from flexmanip_ros.io.html import plain, png
from flexmanip_ros.paper import case_run, experiments, figures, model_response, payload_figures, summary
from flexmanip_ros.paper.model_response import Response
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.studies import trial
from flexmanip_ros.types import Array, CaptureEvent, EventKind

RUNS = ' Line: median of the runs; band: 95 % of them.'


class Planned(NamedTuple):
    """A figure to be drawn: its numbers in the paper, what it shows, both claims, and the call."""

    numbers: str
    title: str
    claim: str
    measured: str
    draw: Callable[..., Figure]
    arguments: tuple[Any, ...]


def drawing(planned: Planned) -> bytes:
    """Draw a figure as PNG."""
    return png(planned.draw(*planned.arguments))


def without_results() -> list[Planned]:
    """Return the figures that need no estimate."""
    first, last = (simulation(case) for case in (experiments.PAYLOADS[0], experiments.FINITE_ELEMENT))
    angle = float(np.degrees(np.abs(first.position[:, :2] - first.position[0, :2]).max()))
    along, across = (float(1e3 * np.abs(figures.mid_span(last)[0][k, :, 1]).max()) for k in (0, 1))
    return [
        Planned('2', 'input torques', 'square waves, so that the arm stays near its working point.',
                '10 N m with a period of 1 s, 5 N m with 0.5 s.', figures.torques, (first,)),
        Planned('3', 'responses, 20 kg at 60/45 deg', 'angles below 3 deg and small vibration, so a linear '
                'model serves.', f'angles turn by up to {angle:.2f} deg.', figures.responses, (first,)),
        Planned('10', 'configurations', 'three configurations for 100 kg.', 'the same, drawn to scale.',
                figures.arms, (experiments.CONFIGURATIONS, model_response.arm())),
        Planned('17, 18', 'finite element plant, middles of the links, 20 kg at 45/0 deg',
                'link 2 hardly moves along X, because the signals are mainly lateral deflection.',
                f'link 2 deflects up to {across:.3f} mm along Y, {along:.4f} mm along X.',
                figures.finite_element, (last,))]


def payload_example(tracks: Mapping[str, figures.Tracks], rows: Sequence[trial.Row]) -> list[Planned]:
    """Return the figures of example 1: three payloads."""
    case = experiments.PAYLOADS[0]
    planned = []
    if any(tracks[case.name].values()):
        planned += [_response(case, '4, 5', tracks), _frequencies(case, '6', tracks, rows)]
    return planned + _payloads(
        experiments.PAYLOADS, ('7', '8', '9'), tracks, rows,
        ('between 4 and 6 s all three methods have settled; least squares reads slightly high: links bend.',
         'the proposed method identifies the payload stably.',
         'the error of the proposed method grows with the payload and stays acceptable.'))


def configuration_example(tracks: Mapping[str, figures.Tracks], rows: Sequence[trial.Row]) -> list[Planned]:
    """Return the figures of example 2: three configurations."""
    there = [case for case in experiments.CONFIGURATIONS if any(tracks[case.name].values())]
    return [*(_response(case, '11, 12', tracks) for case in there),
            *(_frequencies(case, '13', tracks, rows) for case in there),
            *_payloads(experiments.CONFIGURATIONS, ('14', '15', '16'), tracks, rows,
                       ('the proposed method reaches the original value fast in every configuration.',
                        'the same.', 'satisfactory accuracy.'))]


def finite_element_example(tracks: Mapping[str, figures.Tracks], rows: Sequence[trial.Row]) -> list[Planned]:
    """Return the figures of section 4.3."""
    return _payloads((experiments.FINITE_ELEMENT,), ('19', '19', '19'), tracks, rows,
                     ('the error is higher than with the mathematical model, the payload is still tracked.',
                      'no errors are shown.', 'no mean error is given.'))


def _response(case: experiments.Case, numbers: str, tracks: Mapping[str, figures.Tracks]) -> Planned:
    true = model_response.true_response(case)
    found: dict[str, Response] = {}
    for method in ('paper', experiments.BEST_MODEL):
        for track in tracks[case.name].get(method, ())[:1]:
            response = model_response.identified_response(case, track)
            if response is not None:
                found[method] = response
    said = [f'{method}: {_worst(response.bends, true.bends)} of the bends, '
            f'{_worst(response.angles, true.angles)} of the angles' for method, response in found.items()]
    return Planned(
        numbers, f'test response, {case.title}',
        'the responses of the identified and the original model agree in general.',
         'largest error, first run, in per cent of the largest response: '
        f'{"; ".join(said) or "no model"}.', figures.test_response, (true, found))


def _worst(found: Array, true: Array) -> str:
    return f'{plain(float(100.0 * np.abs(found - true).max() / np.abs(true).max()))} %'


def _frequencies(case: experiments.Case, numbers: str, tracks: Mapping[str, figures.Tracks],
                 rows: Sequence[trial.Row]) -> Planned:
    before, after = (case_run.true_frequencies(case, mass) for mass in (0.0, case.payload))
    said = [f'{line[1]}: {plain(line[2])} and {plain(line[3])} %'
            for line in summary.frequency_lines(rows, (case,))]
    return Planned(numbers, f'frequencies, {case.title}', 'the frequencies drop at the capture and are '
                   'tracked.', f'mean error of the two, 4 to 6 s: {"; ".join(said)}.{RUNS}',
                   figures.frequency_tracks, (tracks[case.name], before, after))


def _payloads(cases: Sequence[experiments.Case], numbers: tuple[str, str, str],
              tracks: Mapping[str, figures.Tracks], rows: Sequence[trial.Row], claims: tuple[str, str, str]
              ) -> list[Planned]:
    there = [case for case in cases if any(tracks[case.name].values())]
    if not there:
        return []
    kept = {case.name: tracks[case.name] for case in there}
    errors = summary.errors(rows)
    means = '; '.join(
        f'{method.name} {", ".join(_mean(errors.get((case.name, method.name), ())) for case in there)} %'
        for method in experiments.METHODS)
    bias = ', '.join(_bias(summary.of(rows, case, 'rigid RLS')) for case in there)
    own = '; '.join(
        f'{method} {", ".join(_held(summary.of(rows, case, method)) for case in there)}'
        for method in payload_figures.CLOSE)
    return [
        Planned(numbers[0], 'payload', claims[0],
                f'mean error in per cent ({_titles(there)}): {means}. Bias of least squares at 6 s: {bias} %.'
                f'{RUNS} Nothing is drawn while a method says that it knows nothing yet.',
                payload_figures.payload_tracks, (there, kept)),
        Planned(numbers[0], 'close up, with intervals', 'no intervals are given.', 'runs whose 95 % interval '
                f'holds the payload at 6 s ({_titles(there)}): {own}. Drawn: the first run.',
                payload_figures.interval_tracks, (there, kept)),
        Planned(numbers[1], 'absolute error', claims[1], f'from the capture on.{RUNS}',
                payload_figures.error_tracks, (there, kept)),
        Planned(numbers[2], 'average relative error', claims[2], 'mean of the runs (mark) and 95 % of them '
                '(line), 4 to 6 s.', payload_figures.error_points, (there, errors))]


def _titles(cases: Sequence[experiments.Case]) -> str:
    return '; '.join(case.title for case in cases)


def _mean(values: Sequence[float]) -> str:
    return plain(float(np.mean(values)) if values else None)


def _bias(rows: Sequence[trial.Row]) -> str:
    values = [100.0 * (row['payload_mass_kg'] / row['payload_true_kg'] - 1.0) for row in rows
              if row.get('payload_mass_kg') is not None]
    return _mean(values)


def _held(rows: Sequence[trial.Row]) -> str:
    return f'{sum(bool(row.get("covered")) for row in rows)} of {len(rows)}'


def simulation(case: experiments.Case, seed: int = 0) -> simulator.Trajectory:
    """Return one noisy run of a case."""
    made = experiments.scenario(case, experiments.METHODS[0])
    run = made.configuration(seed, experiments.METHODS[0].name)
    torque = excitation.sequence(run.excitation, round(made.duration * run.plant.rate))
    events = (CaptureEvent(round(made.capture_time * 1e9), EventKind.CAPTURE),)
    return simulator.simulate(run.plant, torque, events)
