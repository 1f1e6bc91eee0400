"""Write golden.json: the numbers of a few runs, so that a change of numbers is seen in review.

Use: ``python test/golden/make_golden.py``, then look at the difference before committing it.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from flexmanip_ros.paper import case_run, experiments
from flexmanip_ros.parameters import ExcitationParameters, PlantParameters, configure
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.studies import trial
from flexmanip_ros.studies.scenario import scenario
from flexmanip_ros.types import CaptureEvent, EventKind

PLACE = Path(__file__).with_name('golden.json')
NOT_NUMBERS_OF_OURS = ('us_per_sample',)
NONLINEAR = {
    'name': 'nonlinear', 'duration': 4.0, 'window': [3.5, 4.0], 'plant': {'arm.damping_ratio': 0.003},
    'identifier': {'arm.damping_ratio': 0.003},
    'vary': {'plant.payload_mass': {'uniform': [12.0, 100.0]}}}
PLANTS = ('nonlinear', 'linear', 'finite_element')


def results() -> dict[str, Any]:
    """Return run -> column -> number, computed now."""
    rows: dict[str, trial.Row] = {f'plant {model}': _plant(model) for model in PLANTS}
    for row in case_run.run(experiments.PAYLOADS[0], 0)[0]:
        rows[f'paper 20 kg, {row["method"]}'] = row
    rows['nonlinear'] = trial.trial(scenario(NONLINEAR), 0)[0]
    return {name: {key: value for key, value in row.items() if key not in NOT_NUMBERS_OF_OURS}
            for name, row in rows.items()}


def _plant(model: str) -> trial.Row:
    """Return where a plant is after a capture."""
    config = configure(PlantParameters, {'model': model, 'seed': 7})
    event = CaptureEvent(150_000_000, EventKind.CAPTURE)
    run = simulator.simulate(config, excitation.sequence(ExcitationParameters(), 300), (event,))
    names = [f'{name}.{what}' for what in ('position', 'velocity') for name in run.names]
    return dict(zip(names, [*run.position[-1].tolist(), *run.velocity[-1].tolist()], strict=True))


def main() -> None:
    """Write the file."""
    PLACE.write_text(json.dumps(results(), indent=1, sort_keys=True) + '\n', encoding='utf-8')


if __name__ == '__main__':
    main()
