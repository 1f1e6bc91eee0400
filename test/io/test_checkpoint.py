from __future__ import annotations

import dataclasses
import json
import os
import shutil
import subprocess
import sys
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import flexmanip_ros
from flexmanip_ros import pipeline
from flexmanip_ros.errors import CheckpointError
from flexmanip_ros.io import checkpoint
from flexmanip_ros.parameters import ExcitationParameters, IdentifierParameters, PlantParameters
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import CaptureEvent, EventKind

CONFIG = IdentifierParameters()


def items(count: int = 500) -> list[Any]:
    event = CaptureEvent(250_000_000, EventKind.CAPTURE)
    run = simulator.simulate(PlantParameters(), excitation.sequence(ExcitationParameters(), count), (event,))
    return list(simulator.records(run, (event,)))


def stepped(state: pipeline.State, some: list[Any]) -> tuple[pipeline.State, list[Any]]:
    found: list[Any] = []
    for item in some:
        state, estimates = pipeline.step(CONFIG, state, item)
        found.extend(estimates)
    return state, found


def same(a: Any, b: Any) -> bool:
    """Compare two values to the last bit."""
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and (a.dtype, a.shape) == (b.dtype, b.shape) \
            and a.tobytes() == b.tobytes()
    if type(a) is not type(b):
        return False
    if isinstance(a, tuple):
        return len(a) == len(b) and all(map(same, a, b))
    if dataclasses.is_dataclass(a) and not isinstance(a, Enum):
        return all(same(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a))
    return bool(a == b) or a != a  # NaN


def test_an_identifier_goes_on_from_its_file_with_the_same_bits(tmp_path: Path) -> None:
    everything = items()
    state, _ = stepped(pipeline.init(), everything[:400])
    checkpoint.save(tmp_path / 'state', state)
    resumed = checkpoint.load(tmp_path / 'state')
    _, straight = stepped(state, everything[400:])
    _, after = stepped(resumed, everything[400:])
    assert len(straight) >= 5
    assert all(map(same, straight, after))


def test_no_file_is_no_state_and_a_save_leaves_no_scraps(tmp_path: Path) -> None:
    assert checkpoint.load(tmp_path / 'nothing') is None
    checkpoint.save(tmp_path / 'state', pipeline.init())
    assert [path.name for path in tmp_path.iterdir()] == ['state']
    assert same(checkpoint.load(tmp_path / 'state'), pipeline.init())


@pytest.mark.parametrize('name', [
    'os:system', 'builtins:eval', 'flexmanip_ros.io.checkpoint:save', 'flexmanip_ros.pipeline:step',
    'subprocess:Popen', 'flexmanip_ros.io.checkpoint:Path', 'flexmanip_ros.cli.identify_bag:main',
])
def test_a_file_can_name_nothing_but_values_of_this_package(tmp_path: Path, name: str) -> None:
    for kind, rest in (('named', {'items': ['true']}), ('data', {'parts': {}}), ('enum', {'member': 'x'})):
        text = json.dumps({'tree': {kind: name, **rest}})
        (tmp_path / 'bad').write_bytes(checkpoint.sealed(text, {}))
        with pytest.raises(CheckpointError, match='not written by this package'):
            checkpoint.load(tmp_path / 'bad')


def test_a_checkpoint_of_the_old_format_is_rejected_with_the_reason(tmp_path: Path) -> None:
    (tmp_path / 'old').write_bytes(b'flexmanip_ros checkpoint 1\n' + bytes(100))
    with pytest.raises(CheckpointError, match='another format'):
        checkpoint.load(tmp_path / 'old')


def test_a_checkpoint_that_other_sources_of_the_package_wrote_is_rejected(tmp_path: Path) -> None:
    path = tmp_path / 'copy'
    shutil.copytree(Path(flexmanip_ros.__file__).parent, path / 'flexmanip_ros',
                    ignore=shutil.ignore_patterns('__pycache__'))
    with (path / 'flexmanip_ros' / 'types.py').open('a') as file:
        file.write('# one line more\n')
    write = 'from flexmanip_ros import pipeline; from flexmanip_ros.io import checkpoint as c; import sys; ' \
            'c.save(sys.argv[1], pipeline.init())'
    subprocess.run([sys.executable, '-c', write, tmp_path / 'other'], check=True, cwd=path,
                   env={**os.environ, 'PYTHONPATH': str(path)})
    with pytest.raises(CheckpointError, match='other sources of this package wrote it'):
        checkpoint.load(tmp_path / 'other')


def test_arrays_and_the_sample_log_are_written_once(tmp_path: Path) -> None:
    state, _ = stepped(pipeline.init(), items(400))
    one, two = len(checkpoint.encode(state)), len(checkpoint.encode((state, state)))
    assert two < 1.2 * one
    loaded = checkpoint.decode(checkpoint.encode((state, state)))
    assert loaded[0].log is loaded[1].log


def test_a_save_that_fails_keeps_the_old_state_and_leaves_no_scraps(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / 'state'
    checkpoint.save(path, (1.0, 2.0))

    def full(source: Path, target: Path) -> None:
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr(os, 'replace', full)
    with pytest.raises(CheckpointError, match='No space left'):
        checkpoint.save(path, (3.0, 4.0))
    assert checkpoint.load(path) == (1.0, 2.0)
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize('place', ['no/such/folder', '.'])
def test_a_place_that_cannot_be_written_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(CheckpointError, match=f"'{place}' cannot be written"):
        checkpoint.save(place, 1)
    assert not list(tmp_path.iterdir())


WHOLE = checkpoint.encode(stepped(pipeline.init(), items(40))[0])


@settings(max_examples=150, deadline=None)
@given(st.integers(0, len(WHOLE) - 1), st.integers(1, 255), st.booleans())
def test_any_damage_is_rejected(at: int, change: int, cut: bool) -> None:
    data = WHOLE[:at] if cut else WHOLE[:at] + bytes([WHOLE[at] ^ change]) + WHOLE[at + 1:]
    with pytest.raises(CheckpointError):
        checkpoint.decode(data)
