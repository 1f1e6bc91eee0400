"""What each benchmark claims: values out of its results, with the bounds that the documentation states.

``claims_of(name, result)`` compares the content of ``results/<name>.json`` with the bounds. ``run_all.py`` prints the
table and exits 1 when a claim falls short; ``tables.py`` writes the same table into docs/how_well.md. A share of n runs
may fall below its claim by chance: its bound is widened by two binomial standard deviations.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

RESULTS = Path(__file__).resolve().parent / 'results'


class Claim(NamedTuple):
    """A measured value and its bounds; None: no bound on that side."""

    name: str
    value: float
    low: float | None = None
    high: float | None = None
    unit: str = ''

    @property
    def holds(self) -> bool:
        """Whether the value is finite and within its bounds."""
        return (math.isfinite(self.value) and (self.low is None or self.value >= self.low)
                and (self.high is None or self.value <= self.high))

    @property
    def bounds(self) -> str:
        """Return the bounds in words."""
        if self.low is not None and self.high is not None:
            return f'{self.low:.4g} to {self.high:.4g}'
        return f'at least {self.low:.4g}' if self.low is not None else f'at most {self.high:.4g}'


Claims = Iterator[Claim]


def by_chance(share: float, runs: float) -> float:
    """Return two standard deviations of a share of independent runs."""
    return 2.0 * math.sqrt(share * (1.0 - share) / runs)


def covers(name: str, share: float, runs: float, low: float = 0.93, high: float = 0.97) -> Claim:
    """Claim the coverage of 95 % intervals."""
    return Claim(name, share, low - by_chance(0.95, runs), min(1.0, high + by_chance(0.95, runs)))


def control_payload(rows: list[dict[str, Any]]) -> Claims:
    """The controller that knows the estimate settles sooner, and bends the links no more."""
    for mass in sorted({row['mass_kg'] for row in rows}):
        by = {row['knows']: row for row in rows if row['mass_kg'] == mass}
        yield Claim(f'{mass:.0f} kg: settling with the estimate over without',
                    by['estimate']['settling_s'] / by['nothing']['settling_s'], high=1.0)
        yield Claim(f'{mass:.0f} kg: peak bend of the move with the estimate over without',
                    by['estimate']['peak_bend_move_mm'] / by['nothing']['peak_bend_move_mm'], high=1.02)


def detection_delay(rows: list[dict[str, Any]]) -> Claims:
    """20 kg is found within 50 ms with probability 0.95, at rest within 100 ms of torque; no false alarm."""
    for row in rows:
        if 'within_50_ms' in row:
            yield Claim('found within 50 ms', row['within_50_ms'], 0.95 - by_chance(0.95, row['runs']))
        if 'within_100_ms' in row:
            yield Claim('at rest, found within 100 ms of torque', row['within_100_ms'],
                        0.95 - by_chance(0.95, row['runs']))
        if 'alarms' in row:
            yield Claim(f'false alarms in {row["hours"]} h', row['alarms'], high=0.0)


def identification_coverage(rows: list[dict[str, Any]]) -> Claims:
    """95 % intervals of frequencies, damping ratios and payload cover 93-97 %; widths are the Cramer-Rao bound."""
    for row in rows:
        for name, percent, width in zip(row['names'], row['coverage_percent'], row['claimed_over_bound'], strict=True):
            yield covers(f'{row["snr_db"]:.0f} dB: coverage, {name}', percent / 100, row['runs'])
            yield Claim(f'{row["snr_db"]:.0f} dB: width over bound, {name}', width, high=1.1)


def identification_measured_arms(table: dict[str, Any]) -> Claims:
    """On the measured DaISy arm one recursive pass simulates the unseen half to 98 % or more."""
    for label, scores in table.get('daisy_robot_arm', {}).items():
        if label.startswith('ours'):
            yield Claim(f'DaISy arm, {label}: simulation VAF', scores['simulation'][0], 98.0, unit='%')


def identification_moving_arm(rows: list[dict[str, Any]]) -> Claims:
    """Default settings follow both frequencies of the moving arm."""
    for row in rows:
        if row['truth'] == 'lately' and row['case'] != 'all':
            yield Claim(f'{row["case"]}, f{row["frequency"]}: median error', row['median_error_percent'], high=0.2,
                        unit='%')


def identification_paper_settings(rows: list[dict[str, Any]]) -> Claims:
    """The paper's settings leave the payload tens of percent off; restart and long memory make it a few percent."""
    yield Claim("paper's settings: mean error", rows[0]['mean_percent'], 20.0, unit='%')
    yield Claim('one factor, long memory, restart: mean error', rows[-1]['mean_percent'], high=4.0, unit='%')


def identification_soak(rows: list[dict[str, Any]]) -> Claims:
    """Millions of samples with silences, saturation and faults: finite, bounded."""
    yield Claim('samples', max(row['samples'] for row in rows), 10_000_000)
    yield Claim('states that are not finite', sum(row['not_finite'] for row in rows), high=0)
    yield Claim('worst error of a pole (factor, innovation forgetting)', rows[0]['worst_pole_error'], high=1e-4)


def identification_speed(result: dict[str, Any]) -> Claims:
    """The identifier's update costs a few times a bare covariance update of the same size."""
    us = result['microseconds']
    yield Claim('update over a bare covariance update', us['identifier, update'] / us['bare 60 x 60 covariance update'],
                high=8.0)


def io_bag_reading(result: dict[str, Any]) -> Claims:
    """Our decoder is faster than the library's."""
    for name, ratio in (result['ratio'].items() if isinstance(result['ratio'], dict) else [('ratio', result['ratio'])]):
        yield Claim(f'library over ours: {name}', ratio, 1.0)


def payload_block(rows: list[dict[str, Any]]) -> Claims:
    """`block`, restarted at the capture, is within 2.5 x its bound at 1 s and 1.7 x at 3 s."""
    for row in rows:
        for mark, ratio, most in zip((1, 3), row['ratio'], (2.5, 1.7), strict=True):
            yield Claim(f'{row["payload"]:.0f} kg, {row["formula"]}, {mark} s: error over bound', ratio, high=most)


def payload_coverage(rows: list[dict[str, Any]]) -> Claims:
    """On matched plants the 95 % intervals of `structured` cover 93-97 %."""
    for row in rows:
        for after, share in zip(row['samples_after_capture'], row['coverage'], strict=True):
            yield covers(f'{row["outputs"]}, {after} ms: coverage', share, row['runs'])


def payload_elements(rows: list[dict[str, Any]]) -> Claims:
    """On nine in ten arms of finite elements `structured` is within 1 % after a second."""
    for row in rows:
        second = row['samples_after_capture'].index(1000)
        yield Claim('share beyond 1 % after 1 s', row['share_beyond_1_percent'][second],
                    high=0.1 + by_chance(0.1, row['runs']))
        yield Claim('coverage after 1 s', row['coverage'][second], 0.93 - by_chance(0.95, row['runs']))


def payload_linear(rows: list[dict[str, Any]]) -> Claims:
    """On the paper's linear plant `structured` is within 1.5 x the Cramer-Rao bound."""
    for arm in ('known', 'learned'):
        ratios = [row['ratio'] for row in rows if row['arm'] == arm]
        runs = sum(row.get('runs', 10) for row in rows if row['arm'] == arm)
        chance = 2.0 / math.sqrt(2.0 * runs)  # two deviations of a root mean square of so many runs
        for mark, column in enumerate(zip(*ratios, strict=True)):
            yield Claim(f'arm {arm}, instant {mark + 1}: mean error over bound', sum(column) / len(column),
                        high=1.5 * (1.0 + chance))


def payload_mismatched(rows: list[dict[str, Any]]) -> Claims:
    """On arms that are not the model the 95 % intervals cover."""
    runs = sum(row['runs'] for row in rows)
    share = sum(row['runs'] * row['coverage'][-1] for row in rows) / runs
    yield Claim('coverage of all cases, 3 s', share, 0.95 - by_chance(0.95, runs))


def payload_model_check(rows: list[dict[str, Any]]) -> Claims:
    """No interval of an arm that is as told changes because of the model check."""
    told = [row for row in rows if row['group'] == 'as told']
    yield Claim('runs of arms as told whose interval changed', sum(row['runs_changed'] for row in told), high=0)


def payload_speed(rows: list[dict[str, Any]]) -> Claims:
    """The payload's filter costs about as much as a step of the simulated plant."""
    for row in rows:
        yield Claim(f'kappa {row["kappa"]}: filter over a step of the plant', row['ratio_filter_to_plant'], high=3.0)


def plant_convergence(result: dict[str, Any]) -> Claims:
    """Assumed modes converge to the finite-element plant as kappa grows."""
    first, last = result['rows'][0], result['rows'][-1]
    yield Claim('worst response at the largest kappa over that of kappa 1',
                max(last['response']) / max(first['response']), high=0.5)


def plant_hour(result: dict[str, Any]) -> Claims:
    """Memory stays flat over an hour of simulated time."""
    yield Claim(f'growth of memory in {result["minutes"]} min', result['grown_mb'], high=5.0, unit='MB')


def plant_live(result: dict[str, Any]) -> Claims:
    """The plant node keeps 1 kHz with no stamp lost."""
    yield Claim('stamps lost', result['stamps_lost_between'], high=0)
    yield Claim('stamps out of order', result['stamps_out_of_order'], high=0)


def plant_segment_chain(rows: list[dict[str, Any]]) -> Claims:
    """Kappa = 3 with shortening and slope correction follows a chain of 40 segments within 0.5 %."""
    full = [row for row in rows if row['second_order_and_slopes'] and row['tail_modes'] > 0]
    yield Claim('worst relative difference, residual modes included',
                max(max(row['relative_rms_percent'].values()) for row in full), high=0.5, unit='%')


def plant_speed(rows: list[dict[str, Any]]) -> Claims:
    """The compiled plant is faster than scipy's integrator."""
    for row in rows:
        if row.get('times_faster_than_scipy'):
            yield Claim(f'{row["plant"]}: times faster than scipy', row['times_faster_than_scipy'], 1.0)


def replay_speed(result: dict[str, Any]) -> Claims:
    """A replay takes at most 4 times what rosbags needs to read the recording; memory is constant."""
    yield Claim('identify_bag over reading and deserializing by rosbags', result['ratio'], high=4.0)
    yield Claim('peak memory of four times the recording', result['memory_ratio'], high=1.1)
    yield Claim('identify_bag --help', result['help_s'], high=0.25, unit='s')
    yield Claim('import of identify_bag', result['import_s'], high=0.4, unit='s')


def ros_fuzz(rows: list[dict[str, Any]]) -> Claims:
    """No message ends a node."""
    yield Claim('nodes that failed', sum(bool(row['problem']) for row in rows), high=0)


def ros_latency(result: dict[str, Any]) -> Claims:
    """What a controller needs: the payload within 3 ms, nothing lost, a fifth of a core."""
    limits = {'sample to payload, 99 of 100 [ms]': 3.0, 'samples lost at 1 kHz': 0.0,
              'identifier at 1 kHz [% of a core]': 20.0, 'samples lost at 4 kHz by the identifier alone': 0.0}
    for name, most in limits.items():
        if name in result:
            yield Claim(name, result[name], high=most)


def ros_signals(rows: list[dict[str, Any]]) -> Claims:
    """Every program ends at a signal without a problem."""
    yield Claim('programs that did not end well', sum(bool(row['problem']) for row in rows), high=0)


def setup_time(result: dict[str, Any]) -> Claims:
    """All kernels compile in 50 s on two cores."""
    yield Claim('compiling all kernels', result['seconds'], high=50.0, unit='s')


def study_scaling(result: dict[str, Any]) -> Claims:
    """Two processes run a study almost twice as fast as one."""
    yield Claim('two processes over one', result['processes']['ratio'], 1.7)


CLAIMS: dict[str, Callable[[Any], Claims]] = {
    function.__name__: function for function in (
        control_payload, detection_delay, identification_coverage, identification_measured_arms,
        identification_moving_arm, identification_paper_settings, identification_soak, identification_speed,
        io_bag_reading, payload_block, payload_coverage, payload_elements, payload_linear, payload_mismatched,
        payload_model_check, payload_speed, plant_convergence, plant_hour, plant_live, plant_segment_chain, plant_speed,
        replay_speed, ros_fuzz, ros_latency, ros_signals, setup_time, study_scaling)}


def claims_of(name: str, result: Any) -> list[Claim]:
    """Return the claims of a benchmark with the values of a result; none for a name that claims nothing."""
    return list(CLAIMS[name](result)) if name in CLAIMS else []


def recorded(name: str) -> list[Claim]:
    """Return the claims of a benchmark with the values that it measured last."""
    path = RESULTS / f'{name}.json'
    return claims_of(name, json.loads(path.read_text(encoding='utf-8'))) if path.exists() else []
