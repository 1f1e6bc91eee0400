"""The scenario of a study: arm, motion, payload, noise, faults, and the estimators to compare."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any
from zlib import crc32

import numpy as np

from flexmanip_ros.errors import ParameterError
from flexmanip_ros.parameters import (
    ExcitationParameters,
    IdentifierParameters,
    PlantParameters,
    configure,
    flatten,
    leaves,
)
from flexmanip_ros.parameters.field import check_all, dotted, parameter
from flexmanip_ros.simulation import simulator
from flexmanip_ros.types import CaptureEvent, events_at

GROUPS: Mapping[str, type] = {
    'plant': PlantParameters, 'excitation': ExcitationParameters, 'identifier': IdentifierParameters}
DISTRIBUTIONS = ('uniform', 'normal', 'choice')
CAPTURE_TIME = 'capture_time'
FOLLOWING = ('arm', 'rate', 'initial_angles', 'payload_mass', 'snr_db')
"""Parameters, or groups, of the torque whose values are those of the plant."""


@dataclass(frozen=True)
class Faults:
    """Faults between the arm and the estimator; probabilities are per message."""

    drop: float = parameter(0.0, 'probability that it never arrives', low=0.0, high=1.0)
    duplicate: float = parameter(0.0, 'probability that it arrives twice', low=0.0, high=1.0)
    swap: float = parameter(0.0, 'probability that it changes places with its neighbour', low=0.0, high=1.0)
    nan: float = parameter(0.0, 'probability that one of its values is NaN', low=0.0, high=1.0)
    gap: tuple[float, ...] = parameter((0.0, 0.0), 'from and to; every message between is lost', unit='s', size=2)
    event_delay: float = parameter(0.0, 'the event arrives this late', unit='s')

    def __post_init__(self) -> None:
        check_all(self)


@dataclass(frozen=True)
class Scenario:
    """One experiment; a seed turns it into one run.

    duration, capture_time, release_time: [s], a negative time means never; window: the mean relative error is
    taken between these times [s]; plant, excitation, identifier: dotted parameters; vary: what is drawn for each
    seed; bound: add the Cramer-Rao bound to each row; estimators: name -> identifier parameters of
    each estimator that sees the same samples.
    """

    name: str = 'study'
    duration: float = 6.0
    capture_time: float = 3.0
    release_time: float = -1.0
    window: tuple[float, float] = (4.0, 6.0)
    plant: Mapping[str, Any] = field(default_factory=dict)
    excitation: Mapping[str, Any] = field(default_factory=dict)
    identifier: Mapping[str, Any] = field(default_factory=dict)
    vary: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    faults: Faults = field(default_factory=Faults)
    bound: bool = True
    estimators: Mapping[str, Mapping[str, Any]] = field(default_factory=lambda: {'default': {}})

    def __post_init__(self) -> None:
        if not 0.0 < self.duration <= 1e5:
            raise ParameterError(f'duration is {self.duration!r}', 'give seconds above 0')
        if not self.window[0] < self.window[1]:
            raise ParameterError(f'window is {list(self.window)}', 'give [from, to], seconds')
        is_given = self.window != type(self).window
        if is_given and (self.window[1] <= 0.0 or self.window[0] >= self.duration):
            raise ParameterError(f'window is {list(self.window)} and the run lasts from 0 to {self.duration:g} s',
                                 'give a window in it')
        if not self.estimators:
            raise ParameterError('estimators is empty', 'name at least one')
        for name in self.vary:
            _check_varied(name, self.vary[name])
        for name in self.estimators:
            self.configuration(0, name)  # raises before the first run where a parameter is unknown or out of range

    def configuration(self, seed: int, estimator: str) -> Run:
        """Return everything one run needs; the same seed gives the same run."""
        # One random stream per name, so that a name's values do not depend on what else is varied.
        drawn = {name: _draw(how, np.random.default_rng([seed, crc32(name.encode('utf-8'))]))
                 for name, how in self.vary.items()}
        try:
            return self._run(seed, estimator, drawn)
        except ParameterError as err:
            named = [name for name in drawn if name.rpartition('.')[2] in re.findall(r'\w+', err.problem)]
            if not named:
                raise
            raise ParameterError(f"{err.problem}, as 'vary' drew {' and '.join(named)} for seed {seed}",
                                 err.remedy) from err

    def _run(self, seed: int, estimator: str, drawn: Mapping[str, Any]) -> Run:
        """Return what a run needs where these values are drawn."""
        groups: dict[str, dict[str, Any]] = {name: dict(getattr(self, name)) for name in GROUPS}
        capture = self.capture_time
        for name, value in drawn.items():
            group, _, rest = name.partition('.')
            if name == CAPTURE_TIME:
                capture = float(value)
            elif group == 'arm':  # the true arm and the one that the estimator knows
                groups['plant'][name] = groups['identifier'][name] = value
            else:
                groups[group][rest] = value
        groups['identifier'].update(self.estimators[estimator])
        groups['plant'].setdefault('seed', seed)
        plant = configure(PlantParameters, groups['plant'])
        arm = {name: value for name, value in groups['plant'].items() if name.startswith('arm.')}
        own = groups['excitation']
        torque = for_plant(configure(ExcitationParameters, {'rate': plant.rate, **arm, **own}), plant, own)
        identifier = configure(IdentifierParameters, groups['identifier'])
        if capture == type(self).capture_time >= self.duration:  # it was not given
            capture = -1.0
        events = events_in(plant, self.duration, capture, self.release_time)
        return Run(plant, torque, identifier, events, drawn)


def events_in(plant: PlantParameters, duration: float, capture: float, release: float, start_ns: int = 0,
              option: str = '{}_time') -> tuple[CaptureEvent, ...]:
    """Return the events of a simulated run, on its samples. Raises ParameterError for one that cannot happen in it.

    capture, release: after the first sample [s]; below 0: never. option: how the user writes the time of a kind.
    """
    for kind, at in (('capture', capture), ('release', release)):
        if at >= duration:
            raise ParameterError(f'{option.format(kind)} is {at:g} s and the run ends at {duration:g} s',
                                 'give an earlier time or a longer duration')
    if release >= 0.0 and not 0.0 <= capture < release:
        raise ParameterError(f'{option.format("release")} is {release:g} s and nothing is caught before',
                             f'give a {option.format("capture")} before it')
    events = simulator.on_samples(plant, events_at(start_ns, capture, release), start_ns)
    last_s = (max(round(duration * plant.rate), 1) - 1) / plant.rate
    for event in events:
        if event.stamp_ns > start_ns + round(last_s * 1e9):  # no sample would show it
            raise ParameterError(f'the {event.kind.value} comes after the last sample, which is at {last_s:g} s',
                                 'give an earlier time or a longer duration')
    return events


def for_plant(torque: ExcitationParameters, plant: PlantParameters, given: Iterable[str] = ()) -> ExcitationParameters:
    """Return the torque's parameters with those that follow the plant.

    Raises ParameterError where one of these was ``given`` another value.
    """
    made = replace(torque, **{name: getattr(plant, name) for name in FOLLOWING})
    before, after = flatten(torque), flatten(made)
    for name in given:
        if before[name] != after[name]:
            raise ParameterError(f"the torque's '{name}' follows the plant", f"give the plant's '{name}' instead")
    return made


@dataclass(frozen=True)
class Run:
    """The configurations of one run and what was drawn for it."""

    plant: PlantParameters
    excitation: ExcitationParameters
    identifier: IdentifierParameters
    events: tuple[CaptureEvent, ...]
    drawn: Mapping[str, Any]


def scenario(tree: Any) -> Scenario:
    """Return the scenario in a parsed YAML document. Raises ParameterError naming what is wrong."""
    if not isinstance(tree, Mapping):
        raise ParameterError('a scenario is a list of names and values', 'see config/scenarios/')
    known = {item.name for item in fields(Scenario)}
    for name in tree:
        if name not in known:
            raise ParameterError(f"a scenario has no '{name}'", f'known are {", ".join(sorted(known))}')
    given = dict(tree)
    if not isinstance(given.get('name', ''), (str, int)):
        raise _wrong('name', given['name'], 'give a word')
    if 'name' in given:
        given['name'] = str(given['name'])
    for name in GROUPS:
        given[name] = _flat(name, given.get(name) or {})
    if 'estimators' in given:
        given['estimators'] = {str(key): _flat(str(key), value or {})
                               for key, value in _mapping('estimators', given['estimators']).items()}
    given['vary'] = {str(key): _mapping(str(key), value)
                     for key, value in _mapping('vary', given.get('vary') or {}).items()}
    given['faults'] = configure(Faults, _flat('faults', given.get('faults') or {}))
    for name in ('duration', 'capture_time', 'release_time'):
        if name in given:
            given[name] = _number(name, given[name])
    if 'window' in given:
        window = given['window']
        if not isinstance(window, (list, tuple)) or len(window) != 2:
            raise _wrong('window', window, 'give [from, to] in seconds')
        given['window'] = tuple(_number('window', value) for value in window)
    if not isinstance(given.get('bound', True), bool):
        raise _wrong('bound', given['bound'], 'give true or false')
    return Scenario(**given)


def _wrong(name: str, value: Any, remedy: str) -> ParameterError:
    return ParameterError(f"'{name}' of a scenario is {value!r:.60}", remedy)


def _mapping(name: str, value: Any) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise _wrong(name, value, 'list names and values below it')
    return value


def _flat(name: str, tree: Any) -> dict[str, Any]:
    return dict(dotted(_mapping(name, tree)))


def _number(name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise _wrong(name, value, 'give a finite number')
    return float(value)


def _check_varied(name: str, how: Mapping[str, Any]) -> None:
    group, _, rest = name.partition('.')
    declared = {leaf.name for leaf in leaves(GROUPS[group])} if group in GROUPS else set()
    arm = {leaf.name for leaf in leaves(PlantParameters) if leaf.name.startswith('arm.')}
    if name != CAPTURE_TIME and rest not in declared and name not in arm:
        raise ParameterError(f"'{name}' cannot be varied",
                             'name capture_time, arm.NAME, plant.NAME, excitation.NAME or identifier.NAME')
    if len(how) != 1 or next(iter(how)) not in DISTRIBUTIONS:
        raise ParameterError(f"'{name}' is varied by {dict(how)!r:.60}",
                             'give one of uniform: [low, high], normal: [mean, std], choice: [...]')
    kind, values = next(iter(how.items()))
    if not isinstance(values, (list, tuple)) or not values or (kind != 'choice' and len(values) != 2):
        raise ParameterError(f"'{kind}' of '{name}' is {values!r:.60}", 'give a list of values')
    if kind != 'choice':
        _check_range(name, kind, values)
    elif name == CAPTURE_TIME:
        for value in values:
            _number(name, value)


def _check_range(name: str, kind: str, values: Sequence[Any]) -> None:
    """Raise ParameterError for ends (or mean and deviation) that are not finite, not of one size, or not in order."""
    try:
        first, second = (np.asarray(value, dtype=np.float64) for value in values)
        is_good = first.shape == second.shape and first.ndim <= 1 and bool(np.isfinite([first, second]).all())
    except (TypeError, ValueError):
        is_good = False
    if not is_good or (second < (first if kind == 'uniform' else 0.0)).any():
        raise ParameterError(f"'{kind}' of '{name}' is {values!r:.60}",
                             'give two numbers, or two lists as long as each other: '
                             + ('low, then high' if kind == 'uniform' else 'mean, then deviation from 0 up'))


def _draw(how: Mapping[str, Any], rng: np.random.Generator) -> Any:
    kind, values = next(iter(how.items()))
    if kind == 'choice':
        return values[int(rng.integers(len(values)))]
    low, high = np.asarray(values[0], dtype=np.float64), np.asarray(values[1], dtype=np.float64)
    drawn = rng.uniform(low, high) if kind == 'uniform' else rng.normal(low, high)
    return drawn.tolist() if isinstance(drawn, np.ndarray) else float(drawn)
