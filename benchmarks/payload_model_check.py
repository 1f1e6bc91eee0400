"""Claim: a payload that the identified model contradicts is told so, its interval widens; no other changes.

Random captures through the whole pipeline, default settings, estimates from 0.1 to 3 s after the capture.
Arms that are as told: matched, turning, finite elements, rigid-rod chains, the recorded bags (skipped where
absent): no interval may change. Arms that are not: lengths, masses, torques, sensors off by a tenth or a
twentieth, at 40 and 25 dB. Beside it how noise levels of both estimators compare with the true ones.

Use: python benchmarks/payload_model_check.py [--runs 24] [--mismatched 3]
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from parts import payload_trials as trials
from parts.rigid_chain import Chain, noisy

from flexmanip_ros import pipeline
from flexmanip_ros.io import bag
from flexmanip_ros.parameters import (
    ArmParameters,
    ExcitationParameters,
    IdentifierParameters,
    PayloadParameters,
    PlantParameters,
)
from flexmanip_ros.payload import filter_state as mem
from flexmanip_ros.payload import structured
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import CaptureEvent, EventKind, JointRecord, Payload, Status

ARM = ArmParameters(damping_ratio=0.003)
SHORT = ArmParameters(
    link_length=(2.0, 1.5), linear_density=(3.0, 2.0), bending_stiffness=(1500.0, 600.0), joint_mass=5.0,
    tip_mass=3.0, damping_ratio=0.01)
CAPTURE, LAST = 2000, 5000
DATA = Path(os.environ.get('FLEXMANIP_DATA', Path(__file__).resolve().parents[2] / 'shared' / 'data'))
Torque = Callable[[float], np.ndarray]


class Signals(NamedTuple):
    """Rows as a JointState has them; the true white noise of the outputs, where known."""

    position: np.ndarray
    velocity: np.ndarray
    effort: np.ndarray


class Seen(NamedTuple):
    """One estimate: since the capture [s], payload by itself, as published, deviation of the modes."""

    after: float
    alone: Payload
    published: Payload
    deviation: float


def squares(first: float, second: float) -> Torque:
    """The paper's square waves of other amplitudes."""
    return lambda t: np.array([first if t % 1.0 < 0.5 else -first, second if t % 0.5 < 0.25 else -second])


def slewing(t: float) -> np.ndarray:
    """A manoeuvre of about 30 degrees of both joints under the square waves."""
    return np.array([60.0, 25.0]) * np.sin(2 * np.pi * t / 6.0) + squares(10.0, 5.0)(t)


def simulated(plant: PlantParameters, torque: Torque | None = None, **shape: object) -> Signals:
    """A run with the capture at ``CAPTURE``."""
    efforts = (excitation.sequence(ExcitationParameters(**shape), LAST) if torque is None
               else np.array([torque(k * 1e-3) for k in range(LAST)]))
    run = simulator.simulate(plant, efforts, (CaptureEvent(CAPTURE * 1_000_000, EventKind.CAPTURE),))
    return Signals(run.position, run.velocity, run.effort[:, :2])


def random_plant(seed: int, **more: object) -> PlantParameters:
    """A random capture."""
    rng = np.random.default_rng(seed)
    first = rng.uniform(-np.pi, np.pi)
    return PlantParameters(
        initial_angles=(first, first + rng.uniform(-2.0, 2.0)), payload_mass=10 ** rng.uniform(0.0, 2.3),
        snr_db=float(rng.choice([20.0, 30.0, 40.0])), seed=seed, arm=ARM, **more)


def random_arm(rng: np.random.Generator) -> ArmParameters:
    """Half to one and a quarter the reference size."""
    size = 10 ** rng.uniform(-0.3, 0.1)
    return ArmParameters(
        link_length=(3.0 * size * rng.uniform(0.8, 1.1), 3.0 * size * rng.uniform(0.7, 1.0)),
        linear_density=(5.0 * rng.uniform(0.5, 1.2), 5.0 * rng.uniform(0.4, 1.0)),
        bending_stiffness=(5000.0 * rng.uniform(0.4, 1.5), 5000.0 * rng.uniform(0.3, 1.0)),
        joint_mass=10.0 * rng.uniform(0.3, 1.2), tip_mass=10.0 * rng.uniform(0.2, 1.2),
        damping_ratio=float(rng.choice([0.0, 0.001, 0.003, 0.01])))


def follow(config: IdentifierParameters, seen: Signals, capture: int = CAPTURE
           ) -> tuple[list[Seen], np.ndarray]:
    """Run the pipeline; also the noise that each estimator believes in at the end, (2, m) deviations."""
    state, found = pipeline.init(), []
    for k, (position, velocity, effort) in enumerate(zip(*seen, strict=True)):
        items: list[JointRecord | CaptureEvent] = [JointRecord(
            k * 1_000_000, simulator.JOINT_NAMES, position, velocity, np.append(effort[:2], [0.0, 0.0]))]
        if k == capture:
            items.insert(0, CaptureEvent(k * 1_000_000, EventKind.CAPTURE))
        for item in items:
            state, estimates = pipeline.step(config, state, item)
            for estimate in estimates:
                held = None if state.payload is None else state.payload.estimator.structured
                if held is None or held.memory is None or estimate.payload is None or not estimate.payload_is_new:
                    continue
                after = estimate.stamp_ns * 1e-9 - 1e-3 * capture
                if after >= 0.1:
                    found.append(Seen(after, structured.estimate(config, held), estimate.payload,
                                      estimate.modes_deviation))
    return found, noise_ratio(config, state)


def noise_ratio(config: IdentifierParameters, state: pipeline.State) -> np.ndarray:
    """Standard deviations of the outputs' noise: structured's white noise, RPBSID's innovations."""
    assert state.payload is not None
    assert state.identifier is not None
    refined = state.identifier.estimator.rpbsid.refined
    recursion = refined.recursion if refined is not None else None
    held = state.payload.estimator.structured
    if recursion is None or held is None or held.memory is None:
        return np.full((2, len(config.outputs)), np.nan)
    r, m = len(config.inputs), len(config.outputs)
    scale = recursion.scale[r:]
    return np.sqrt([held.memory.noise[:m, mem.WHITE], np.diag(recursion.covariance) / scale ** 2])


def settings(arm: ArmParameters, **payload: object) -> IdentifierParameters:
    """Default settings."""
    return IdentifierParameters(arm=arm, payload=PayloadParameters(**payload))


def as_told(runs: int) -> Iterable[tuple[str, float, list[Seen]]]:
    """Arms that are as the parameters say."""
    for seed in range(runs):
        plant = random_plant(seed)
        yield 'matched', plant.payload_mass, follow(settings(ARM), simulated(plant))[0]
    for seed in range(runs // 2):
        plant = random_plant(seed)
        yield 'turning', plant.payload_mass, follow(settings(ARM), simulated(plant, slewing))[0]
    for seed in range(runs // 3):
        plant = random_plant(seed, model='finite_element')
        config = settings(ARM, dynamics='linear', working_point=plant.initial_angles)
        yield 'finite elements', plant.payload_mass, follow(config, simulated(plant))[0]
    for seed in range(runs // 2):
        shape = {'shape': ('prbs', 'multisine', 'chirp', 'square')[seed % 4], 'amplitude': (25.0, 12.0)}
        plant = random_plant(100 + seed)
        yield 'other torques', plant.payload_mass, follow(settings(ARM), simulated(plant, **shape))[0]
    for seed in range(runs):
        rng = np.random.default_rng(1000 + seed)
        arm, model = random_arm(rng), str(rng.choice(['nonlinear', 'finite_element']))
        plant = replace(random_plant(seed, model=model), arm=arm)
        fixed = {'dynamics': 'linear', 'working_point': plant.initial_angles} if model != 'nonlinear' else {}
        yield 'other arms', plant.payload_mass, follow(settings(arm, **fixed), simulated(plant))[0]
    for arm, degrees, payload, torque in (
            (ARM, (60.0, 45.0), 20.0, squares(10.0, 5.0)), (ARM, (0.0, 0.0), 100.0, squares(10.0, 5.0)),
            (SHORT, (20.0, 90.0), 8.0, squares(6.0, 3.0)), (ARM, (30.0, 80.0), 12.0, slewing),
            (ARM, (30.0, 80.0), 50.0, slewing), (ARM, (-20.0, 40.0), 100.0, slewing)):
        clean = Chain(arm, 22).simulate(np.radians(degrees), torque, LAST, {CAPTURE: payload})
        for seed in range(max(1, runs // 12)):
            seen = noisy(clean, 40.0 if torque is not slewing else 30.0, np.random.default_rng(seed))
            yield 'chain', payload, follow(settings(arm), Signals(*seen))[0]
    for name, payload in (('physics_20kg_60_45', 20.0), ('physics_100kg_0_0', 100.0)):
        if (DATA / name).exists():
            records = [item for item in bag.read(DATA / name) if isinstance(item, JointRecord)]
            seen = Signals(*(np.array([getattr(record, field) for record in records])
                             for field in ('position', 'velocity', 'effort')))
            yield 'bags', payload, follow(settings(ARM), seen, 3000)[0]
        else:
            print(f'{name}: not there, skipped')


def scaled(seen: Signals, torque: Sequence[float] = (1.0, 1.0), sensor: Sequence[float] = (1.0,) * 4,
           offset: float = 0.0) -> Signals:
    """Torques and sensors as they are read with another scale; offset [rad] of the second encoder."""
    return Signals(seen.position * np.array(sensor) + np.array([0.0, offset, 0.0, 0.0]),
                   seen.velocity * np.array(sensor), seen.effort[:, :2] * np.array(torque))


ARMS = {
    'length 1 +10 %': replace(ARM, link_length=(3.3, 3.0)),
    'length 2 +10 %': replace(ARM, link_length=(3.0, 3.3)),
    'density 1 +10 %': replace(ARM, linear_density=(5.5, 5.0)),
    'density 2 +10 %': replace(ARM, linear_density=(5.0, 5.5)),
    'densities -10 %': replace(ARM, linear_density=(4.5, 4.5)),
    'joint mass +20 %': replace(ARM, joint_mass=12.0),
    'tip mass +20 %': replace(ARM, tip_mass=12.0),
    'hubs left out': replace(ARM, hub_inertia=(0.5, 0.5)),
    'torques, paper': replace(ARM, torque_convention='paper'),
}
READINGS: dict[str, Callable[[Signals], Signals]] = {
    'torques +5 %': lambda seen: scaled(seen, torque=(1.05, 1.05)),
    'torques -5 %': lambda seen: scaled(seen, torque=(0.95, 0.95)),
    'torques +10 %': lambda seen: scaled(seen, torque=(1.1, 1.1)),
    'torques -10 %': lambda seen: scaled(seen, torque=(0.9, 0.9)),
    'torque 1 +10 %': lambda seen: scaled(seen, torque=(1.1, 1.0)),
    'torque 2 +10 %': lambda seen: scaled(seen, torque=(1.0, 1.1)),
    'bends +10 %': lambda seen: scaled(seen, sensor=(1.0, 1.0, 1.1, 1.1)),
    'encoder 2 reversed': lambda seen: scaled(seen, sensor=(1.0, -1.0, 1.0, 1.0)),
    'encoder 2 +5 deg': lambda seen: scaled(seen, offset=np.radians(5.0)),
}
POSES = ((60.0, 45.0), (10.0, 80.0), (0.0, 20.0), (-30.0, 40.0), (90.0, 30.0))


def otherwise(runs: int, snr_db: float) -> Iterable[tuple[str, float, list[Seen]]]:
    """Arms that are not as the parameters say, holding 20 kg."""
    for seed in range(runs):
        degrees = POSES[seed % len(POSES)]
        plant = PlantParameters(initial_angles=tuple(np.radians(degrees)), payload_mass=20.0, snr_db=snr_db,
                                seed=seed, arm=ARM)
        seen = simulated(plant)
        for name, arm in ARMS.items():
            yield name, 20.0, follow(settings(arm), seen)[0]
        for name, read in READINGS.items():
            yield name, 20.0, follow(settings(ARM), read(seen))[0]
        yield 'capture not announced', 20.0, follow(settings(ARM), seen, -1)[0][-100:]


def row(name: str, done: Sequence[tuple[float, list[Seen]]]) -> dict[str, object]:
    """Shares [%] of the estimates of a case, alone and as published."""
    alone, told = ([(truth, part(one)) for truth, seen in done for one in seen]
                   for part in (lambda one: one.alone, lambda one: one.published))
    deviation = [max((one.deviation for one in seen if np.isfinite(one.deviation)), default=0.0)
                 for _, seen in done]
    changed = sum(any(one.alone != one.published and one.alone.upper != one.published.upper for one in seen)
                  for _, seen in done)
    row: dict[str, object] = {'case': name, 'runs': len(done), 'runs_changed': changed,
                              'largest_deviation': round(max(deviation), 2)}
    for label, payloads in (('alone', alone), ('published', told)):
        outside = [not one.lower <= truth <= one.upper for truth, one in payloads]
        flagged = [one.status is Status.INCONSISTENT for _, one in payloads]
        wrong = [out and not flag for out, flag in zip(outside, flagged, strict=True)]
        row[label] = {'inconsistent': percent(flagged), 'outside': percent(outside),
                      'outside_untold': percent(wrong)}
    return row


def percent(flags: Sequence[bool]) -> float:
    """Share in percent."""
    return round(100.0 * float(np.mean(flags)), 1)


def table(title: str, cases: Iterable[tuple[str, float, list[Seen]]]) -> list[dict[str, object]]:
    """Print and return a row a case."""
    grouped: dict[str, list[tuple[float, list[Seen]]]] = {}
    for name, truth, seen in cases:
        grouped.setdefault(name, []).append((truth, seen))
        largest = max((one.deviation for one in seen if np.isfinite(one.deviation)), default=0.0)
        print(f'  {name}, {truth:.1f} kg: {largest:.2f}', file=sys.stderr)
    print(f'{title:24} runs  changed  deviation   alone: INCONSISTENT, outside, outside untold %   published')
    rows = []
    for name, done in grouped.items():
        one = row(name, done)
        rows.append(one | {'group': title})
        print(f"{name:24} {one['runs']:4}  {one['runs_changed']:7}  {one['largest_deviation']:9}  ",
              *one['alone'].values(), '  ', *one['published'].values(), flush=True)
    return rows


def noise_levels(runs: int) -> list[dict[str, object]]:
    """Noise that each estimator believes in over the true one: median over runs, for each kind of output."""
    rows = []
    ratios = []
    for seed in range(runs):
        plant = replace(random_plant(seed), noise='std')
        ratios.append(follow(settings(ARM), simulated(plant))[1]
                      / np.array(plant.noise_std)[[2, 3, 6, 7]])
    for name, ratio in zip(('structured, white', 'RPBSID, innovations'),
                           np.nanmedian(np.array(ratios), axis=0), strict=True):
        rows.append({'group': 'noise over the true one', 'case': name, 'runs': runs,
                     'bends': trials.numbers(ratio[:2], 2), 'rates': trials.numbers(ratio[2:], 2)})
        print(rows[-1])
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--runs', type=int, default=24)
    parser.add_argument('--mismatched', type=int, default=3)
    given = parser.parse_args()
    rows = table('as told', as_told(given.runs))
    for snr_db in (40.0, 25.0):
        rows += table(f'otherwise, {snr_db:g} dB', otherwise(given.mismatched, snr_db))
    rows += noise_levels(max(2, given.runs // 4))
    trials.write('payload_model_check', rows)


if __name__ == '__main__':
    main()
