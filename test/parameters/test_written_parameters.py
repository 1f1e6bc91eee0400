"""Files made from the declared parameters."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest
import yaml

from flexmanip_ros.io.parameter_file import load
from flexmanip_ros.parameters.document import NODES, number, scalar, yaml_text

ROOT = Path(__file__).parents[2]


def _documents() -> list[tuple[str, str]]:
    spec = importlib.util.spec_from_file_location('write_parameters', ROOT / 'docs/write_parameters.py')
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return list(module.documents())


@pytest.mark.parametrize(('name', 'text'), _documents())
def test_what_is_written_from_the_declarations_is_current(name, text):
    assert (ROOT / name).read_text(encoding='utf-8') == text, \
        'stale: run python docs/write_parameters.py'


@pytest.mark.parametrize('node', list(NODES))
def test_the_written_defaults_are_the_defaults(node):
    assert load(NODES[node], node, ROOT / 'config' / f'{node}.yaml') == NODES[node]()


@pytest.mark.parametrize('value', [1.0, 1e-5, 1e300, -0.1, 100.0, 1e22])
def test_a_double_is_written_as_ros_needs_it(value):
    assert yaml.safe_load(number(value)) == value
    assert '.' in number(value)


@pytest.mark.parametrize('value', ['plain', '', 'yes', 'null', "it's", 'a: b', '1.0', 'link1/position', '#x'])
def test_a_text_stays_a_text(value):
    assert yaml.safe_load(scalar(value)) == value


@pytest.mark.parametrize('value', ['y', 'N', 'nan', 'Infinity'])
def test_a_text_that_ros_reads_as_another_value_is_quoted(value):
    assert scalar(value) == f"'{value}'"


def test_only_what_differs_is_written_on_request():
    text = yaml_text('rpbsid_identifier', {'order': 2, 'arm.modes': 1, 'angles': ()})
    assert yaml.safe_load(text) == {
        '/**': {'ros__parameters': {'order': 2, 'angles': [''], 'arm': {'modes': 1}}}}
