"""The runs of a study as tasks that any worker can do."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flexmanip_ros.errors import BagError
from flexmanip_ros.io import bag
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.studies import trial
from flexmanip_ros.studies.scenario import Scenario
from flexmanip_ros.types import CaptureEvent, JointBlock

KEY = 'run'
"""Column that names a run; a study continues with the runs whose name it has not."""
SETTLED = 1.0
"""Seconds after a capture in a recording from which on the error counts, as in the paper."""


@dataclass(frozen=True)
class Simulated:
    """One seed of a scenario."""

    scenario: Scenario
    seed: int

    @property
    def key(self) -> str:
        """The name of the run."""
        return str(self.seed)


@dataclass(frozen=True)
class Recorded:
    """One recording. window: from and to [s] of the mean error."""

    path: str
    config: IdentifierParameters
    window: tuple[float, float]

    @property
    def key(self) -> str:
        """The name of the run."""
        return self.path


Task = Simulated | Recorded


def work(task: Task) -> list[trial.Row]:
    """Do one run; its rows, each with the run's name."""
    rows = trial.trial(task.scenario, task.seed) if isinstance(task, Simulated) else [_recorded(task)]
    return [{KEY: task.key, **row} for row in rows]


def failed(task: Task, error: BaseException) -> list[trial.Row]:
    """Return the row of a run that gave none."""
    return [{KEY: task.key, 'error': trial.describe(error)}]


def _recorded(task: Recorded) -> trial.Row:
    truth = true_payload(Path(task.path))
    items: list[JointBlock | CaptureEvent] = []
    fault = ''
    try:
        items.extend(bag.read_blocks(task.path))
    except BagError as error:  # what came before the fault is identified
        if not items:
            raise
        fault = str(error)
    row = trial.measure(task.config, items, truth, task.window, settled=SETTLED)
    return {'bag': task.path, 'estimator': task.config.payload_method, **row, 'error': fault}


def true_payload(path: Path) -> float | None:
    """Return the mass in NAME.truth.json beside a recording, None when there is none."""
    place = path.with_name(f'{path.stem if path.is_file() else path.name}.truth.json')
    try:
        found: Any = json.loads(place.read_text(encoding='utf-8'))
    except (OSError, ValueError):
        return None
    mass = found.get('payload_mass_kg') if isinstance(found, dict) else None
    return float(mass) if isinstance(mass, (int, float)) else None


def recordings(folder: Path) -> list[Path]:
    """Return every recording at or below a folder, in order."""
    found = {path.parent for path in folder.rglob('metadata.yaml')}
    loose = {path for suffix in ('*.mcap', '*.db3') for path in folder.rglob(suffix)
             if path.parent not in found}
    return sorted(found | loose)
