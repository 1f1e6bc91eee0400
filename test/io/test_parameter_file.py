"""ROS parameter files and overrides."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from flexmanip_ros.errors import ParameterError
from flexmanip_ros.io.parameter_file import load, parse_overrides, read
from flexmanip_ros.parameters import IdentifierParameters

NODE = 'rpbsid_identifier'


def _file(folder: Path, text: str) -> Path:
    path = folder / 'params.yaml'
    path.write_text(text, encoding='utf-8')
    return path


@pytest.mark.parametrize('section', [NODE, f'/{NODE}', f'/arm/{NODE}', '/**', '/*', f'/**/{NODE}'])
def test_every_way_to_name_the_node_is_understood(tmp_path, section):
    values = '{order: 6, arm: {modes: 2}, arm.tip_mass: 3}'
    path = _file(tmp_path, f'"{section}": {{ros__parameters: {values}}}')
    assert read(path, NODE) == {'order': 6, 'arm.modes': 2, 'arm.tip_mass': 3}


def test_a_namespace_may_hold_the_node(tmp_path):
    path = _file(tmp_path, f'/left:\n  {NODE}:\n    ros__parameters: {{order: 6}}\n')
    assert read(path, NODE) == {'order': 6}


def test_sections_of_other_nodes_and_standard_parameters_are_left_alone(tmp_path):
    path = _file(tmp_path, f'''
plant_simulator: {{ros__parameters: {{rate: 500.0}}}}
/**: {{ros__parameters: {{use_sim_time: true, order: 2}}}}
{NODE}: {{ros__parameters: {{order: 6, qos_overrides: {{/joint_states: {{subscription: {{depth: 3}}}}}}}}}}
''')
    assert read(path, NODE) == {'order': 6}


@pytest.mark.parametrize(('text', 'words'), [('order: {}', "parameter 'order' is {}"),
                                             ('inputs: {}', "parameter 'inputs' is {}"),
                                             ('arm: {}', "unknown parameter 'arm'")])
def test_a_name_with_nothing_below_it_is_an_error_as_it_is_for_a_node(tmp_path, text, words):
    with pytest.raises(ParameterError, match=words):
        load(IdentifierParameters, NODE, _file(tmp_path, f'{NODE}: {{ros__parameters: {{{text}}}}}'))


def test_numbers_are_read_as_ros_reads_them():
    assert parse_overrides(['a=1e-3', 'b=[1e3, -2E+2]', 'c=5', 'd=none', 'e=[]', 'f=[-.5, +.5, 08]', 'g=[y, Off]',
                            'h=[1_000, 1:30, 0b1, 2001-01-01, ~]', 'y=010']) == {
        'a': 0.001, 'b': [1000.0, -200.0], 'c': 5, 'd': 'none', 'e': [], 'f': [-0.5, 0.5, 8.0], 'g': [True, False],
        'h': ['1_000', '1:30', '0b1', '2001-01-01', '~'], 'y': 8}


def test_an_override_wins_over_the_file(tmp_path):
    path = _file(tmp_path, f'{NODE}: {{ros__parameters: {{order: 6, past_window: 12}}}}')
    config = load(IdentifierParameters, NODE, path, ['order=2', 'order=4'])
    assert (config.order, config.past_window) == (4, 12)


def test_an_override_that_does_not_go_with_the_file_is_named(tmp_path):
    path = _file(tmp_path, f'{NODE}: {{ros__parameters: {{arm: {{linear_density: [0.5, 0.4]}}}}}}')
    with pytest.raises(ParameterError, match=r"yaml' does not go with --set arm\.link_length; give 1"):
        load(IdentifierParameters, NODE, path, ['arm.link_length=[0.4]'])


@pytest.mark.parametrize(('text', 'words'), [
    ('order: 4', 'ros__parameters'),
    ('just words', 'in place of a node'),
    ('[1, 2]', 'in place of a node'),
    ('rpbsid_identifer: {ros__parameters: {order: 4}}', 'is close'),
    (f'{NODE}: {{ros__parameters: {{order: 4}}, past_window: 12}}', 'past_window: 12 in place of a node'),
    ('ros__parameters: {order: 4}', 'order: 4 in place of a node'),
    (f'{NODE}: {{ros__parameters: [1]}}', 'list the parameters below it'),
    (f'{NODE}: {{ros__parameters: {{order: 4, order: 5}}}}', 'given twice'),
    (f'{NODE}: {{ros__parameters: {{arm.modes: 4, arm: {{modes: 5}}}}}}', "'arm.modes' twice"),
    (f'{NODE}: {{ros__parameters: {{ordre: 4}}}}', "did you mean 'order'"),
    (f'{NODE}: {{ros__parameters: {{order: 1000}}}}', 'from 1 to 60'),
    (f'{NODE}: {{ros__parameters: {{order: .nan}}}}', 'whole number'),
    (f'{NODE}: {{ros__parameters: {{max_gap: {"9" * 400}}}}}', "'max_gap' is infinite"),
    (f'{NODE}: {{ros__parameters: {{arm.link_length: [{"9" * 400}, 1.0]}}}}', 'write [.inf, 1.0]'),
    (f'{NODE}: {{ros__parameters: {{order: 4', 'not valid YAML in line 1'),
    (f'a: &x {{b: 1}}\n{NODE}: {{ros__parameters: *x}}', 'aliases'),
    (f'{NODE}: !!python/object/apply:os.system ["true"]', 'not valid YAML'),
])
def test_a_fault_in_the_file_is_one_clear_line_naming_the_file(tmp_path, text, words):
    path = _file(tmp_path, text)
    with pytest.raises(ParameterError) as caught:
        load(IdentifierParameters, NODE, path)
    assert words in str(caught.value)
    assert str(path) in str(caught.value)
    assert '\n' not in str(caught.value)


def test_missing_and_unreadable_files_are_named(tmp_path):
    with pytest.raises(ParameterError, match='does not exist'):
        read(tmp_path / 'none.yaml', NODE)
    (tmp_path / 'bytes.yaml').write_bytes(b'\xff\xfe\x00')
    with pytest.raises(ParameterError, match='UTF-8'):
        read(tmp_path / 'bytes.yaml', NODE)
    with pytest.raises(ParameterError, match='cannot be read'):
        read(tmp_path, NODE)


@pytest.mark.parametrize('section', [NODE, 'plant_simulator'])
def test_a_list_that_ends_every_node_is_rejected_with_what_to_write(tmp_path, section):
    path = _file(tmp_path, f'{{/**: {{ros__parameters: {{order: 4}}}},\n'
                           f'{section}: {{ros__parameters: {{arm: {{link_length: [1, 2.0]}}}}}}}}')
    with pytest.raises(ParameterError, match=r"the list 'arm\.link_length' has numbers .* write \[1\.0, 2\.0\]"):
        load(IdentifierParameters, NODE, path)


@pytest.mark.parametrize('written', ['[1, 2]', '[1.0, 2.0]'])
def test_numbers_of_a_list_are_read_with_a_point_and_without(tmp_path, written):
    path = _file(tmp_path, f'{NODE}: {{ros__parameters: {{arm: {{link_length: {written}, joint_mass: 3}}}}}}')
    arm = load(IdentifierParameters, NODE, path).arm
    assert (arm.link_length, arm.joint_mass) == ((1.0, 2.0), 3.0)


@pytest.mark.parametrize('item', ['order', '=4', ''])
def test_an_override_without_a_name_or_value_is_rejected(item):
    with pytest.raises(ParameterError, match='name=value'):
        parse_overrides([item])


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.binary(max_size=200) | st.text('ab:{}[]&*!-#|>%@`"\' \n0129.e', max_size=80).map(str.encode))
def test_whatever_is_in_the_file_only_our_error_comes_out(tmp_path, content):
    path = tmp_path / 'fuzz.yaml'
    path.write_bytes(content)
    with suppress(ParameterError):
        load(IdentifierParameters, NODE, path)


def test_a_section_for_every_node_may_hold_what_only_another_one_has(tmp_path):
    path = _file(tmp_path, '/**: {ros__parameters: {payload_mass: 20.0, autostart: false, order: 6}}')
    assert read(path, NODE) == {'order': 6}
    with pytest.raises(ParameterError, match='payload_mas'):
        load(IdentifierParameters, NODE, _file(tmp_path, '/**: {ros__parameters: {payload_mas: 20.0}}'))
