"""A study of fractions of a second, and how the tests run one and read what it leaves."""

from __future__ import annotations

import csv
from pathlib import Path

from flexmanip_ros.cli.monte_carlo import main

SCENARIO = """
name: quick
duration: 0.2
capture_time: 0.1
window: [0.15, 0.2]
identifier: {payload_method: none}
vary:
  plant.payload_mass: {uniform: [12.0, 100.0]}
"""


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(encoding='utf-8') as file:
        return list(csv.DictReader(file))


def run(*arguments: object) -> int:
    return main([str(argument) for argument in arguments])


def without_cost(rows: list[dict[str, str]]) -> list[dict[str, str]]:
    return [{name: value for name, value in row.items() if name != 'us_per_sample'} for row in rows]
