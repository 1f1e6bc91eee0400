"""Files made from the declared parameters."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from flexmanip_ros.cli.write_parameters import documents, main
from flexmanip_ros.io.parameter_file import load
from flexmanip_ros.parameters.document import NODES, number, scalar, yaml_text

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize(('name', 'text'), list(documents()))
def test_what_is_written_from_the_declarations_is_current(name, text):
    assert (ROOT / name).read_text(encoding='utf-8') == text, \
        'stale: run python -m flexmanip_ros.cli.write_parameters'


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


def test_only_what_differs_is_written_on_request():
    text = yaml_text('rpbsid_identifier', {'order': 2, 'arm.modes': 1, 'angles': ()})
    assert yaml.safe_load(text) == {
        '/**': {'ros__parameters': {'order': 2, 'angles': [''], 'arm': {'modes': 1}}}}


def test_the_files_are_written_once(tmp_path, capsys):
    assert main([str(tmp_path)]) == 0
    assert 'config/rpbsid_identifier.yaml' in capsys.readouterr().out
    assert main([str(tmp_path)]) == 0
    assert capsys.readouterr().out == ''


@pytest.mark.parametrize('argument', ['--help', '--unknown', 'no/such/folder'])
def test_an_argument_that_is_no_checkout_writes_nothing(argument, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main([argument])
    assert ended.value.code == (0 if argument == '--help' else 2)
    assert list(tmp_path.iterdir()) == []
    assert capsys.readouterr()
