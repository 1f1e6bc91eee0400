"""Launch files against the package: executables, parameters, arguments. `launch` itself is not on PyPI."""

from __future__ import annotations

import runpy
import sys
import types
from pathlib import Path
from typing import Any

import pytest
import yaml

from flexmanip_ros.io.parameter_file import load_arm
from flexmanip_ros.parameters import leaves
from flexmanip_ros.parameters.document import NODES

ROOT = Path(__file__).resolve().parents[2]
FILES = [ROOT / 'launch' / name for name in ('demo.launch.py', 'identify.launch.py')]


class Call:
    """Stands for any class of the launch packages and keeps what it was made with."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.args, self.kwargs = args, kwargs


class Node(Call):
    """A launched node."""


class DeclareLaunchArgument(Call):
    """An argument that is declared."""


class LaunchConfiguration(Call):
    """An argument that is used."""

    def perform(self, context: dict[str, str]) -> str:
        return context[self.args[0]]


class OpaqueFunction(Call):
    """A function that is called while launching."""


@pytest.fixture
def described(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Return what a launch file describes."""
    classes = {
        'launch': ['LaunchDescription'], 'launch.actions': ['DeclareLaunchArgument', 'OpaqueFunction'],
        'launch.conditions': ['IfCondition'], 'launch.substitutions': ['LaunchConfiguration'],
        'launch_ros': [], 'launch_ros.actions': ['Node'],
        'launch_ros.parameter_descriptions': ['ParameterFile', 'ParameterValue'],
        'ament_index_python': [], 'ament_index_python.packages': [],
    }
    known = {'Node': Node, 'DeclareLaunchArgument': DeclareLaunchArgument,
             'LaunchConfiguration': LaunchConfiguration, 'OpaqueFunction': OpaqueFunction}
    for name, members in classes.items():
        module: Any = types.ModuleType(name)
        for member in members:
            setattr(module, member, known.get(member, Call))
        monkeypatch.setitem(sys.modules, name, module)
    packages: Any = sys.modules['ament_index_python.packages']
    packages.get_package_share_directory = lambda package: str(ROOT)
    return list(runpy.run_path(str(request.param))['generate_launch_description']().args[0])


def everything(value: Any) -> list[Any]:
    """Return a value and all that is inside it."""
    if isinstance(value, Call):
        return [value, *everything(value.args), *everything(list(value.kwargs.values()))]
    if isinstance(value, dict):
        return everything(list(value.values()))
    if isinstance(value, (list, tuple)):
        return [item for part in value for item in everything(part)]
    return [value]


@pytest.mark.parametrize('described', FILES, indirect=True, ids=lambda path: path.name)
def test_every_node_and_parameter_is_of_the_package(described: list[Any]) -> None:
    nodes = [item for item in described if isinstance(item, Node)]
    assert nodes
    for node in nodes:
        assert node.kwargs['package'] == 'flexmanip_ros'
        declared = {leaf.name: leaf for leaf in leaves(NODES[node.kwargs['executable']])}
        for group in node.kwargs['parameters']:
            for name, value in (group.items() if isinstance(group, dict) else ()):
                if name == 'use_sim_time':  # every node has it
                    continue
                assert name in declared
                wanted = list if declared[name].is_array else declared[name].kind
                assert isinstance(value, (Call, wanted))
                if isinstance(value, Call):
                    assert value.kwargs['value_type'] is wanted


@pytest.mark.parametrize('described', FILES, indirect=True, ids=lambda path: path.name)
def test_a_word_that_no_node_takes_ends_the_launch_before_the_first_node(described: list[Any]) -> None:
    """The node alone would end, and the others go on."""
    offered = {item.args[0]: item.kwargs.get('choices') for item in described
               if isinstance(item, DeclareLaunchArgument)}
    for node in (item for item in described if isinstance(item, Node)):
        choices = {leaf.name: leaf.choices for leaf in leaves(NODES[node.kwargs['executable']])}
        for group in node.kwargs['parameters']:
            for name, value in (group.items() if isinstance(group, dict) else ()):
                for used in everything(value):
                    if isinstance(used, LaunchConfiguration) and choices.get(name):
                        assert offered[used.args[0]] == choices[name]


@pytest.mark.parametrize('described', FILES, indirect=True, ids=lambda path: path.name)
def test_every_argument_is_declared_described_and_used(described: list[Any]) -> None:
    arguments = [item for item in described if isinstance(item, DeclareLaunchArgument)]
    names = {item.args[0] for item in arguments}
    used = {item.args[0] for item in everything(described) if isinstance(item, LaunchConfiguration)}
    assert names == used
    assert all(item.kwargs['description'] for item in arguments)


@pytest.mark.parametrize('described', [ROOT / 'launch' / 'demo.launch.py'], indirect=True, ids=['demo.launch.py'])
def test_an_argument_that_is_no_number_ends_the_launch_before_the_first_node(described: list[Any]) -> None:
    """launch itself would leave the nodes running that it has started by then."""
    given = {item.args[0]: item.kwargs['default_value'] for item in described
             if isinstance(item, DeclareLaunchArgument)}
    kinds = [type(item) for item in described]
    assert kinds.index(OpaqueFunction) < kinds.index(Node)
    (check,) = [item.kwargs['function'] for item in described if isinstance(item, OpaqueFunction)]
    assert check(given) == []
    for name in ('rate', 'payload_mass', 'capture_time', 'release_time', 'view_port'):
        with pytest.raises(RuntimeError, match=f'{name}:=heavy is no number'):
            check({**given, name: 'heavy'})


@pytest.mark.parametrize('described', [ROOT / 'launch' / 'view.launch.py'], indirect=True, ids=['view.launch.py'])
def test_the_view_has_the_arm_of_the_parameters_and_a_layout_that_is_installed(described: list[Any]) -> None:
    arguments = {item.args[0]: item.kwargs for item in described if isinstance(item, DeclareLaunchArgument)}
    assert all(item['description'] for item in arguments.values())
    assert Path(arguments['layout']['default_value']) == ROOT / 'config' / 'layouts' / 'arm.rviz'
    (describe,) = [item.kwargs['function'] for item in described if isinstance(item, OpaqueFunction)]
    given = {name: item['default_value'] for name, item in arguments.items()}
    nodes = describe(given)
    used = {item.args[0] for item in everything(nodes) if isinstance(item, LaunchConfiguration)}
    assert used | {'params_file', 'namespace', 'layout'} == set(arguments)
    assert '<robot name' in nodes[0].kwargs['parameters'][0]['robot_description']
    assert [node.kwargs['package'] for node in nodes] == ['robot_state_publisher', 'rviz2']


@pytest.mark.parametrize('described', [ROOT / 'launch' / 'view.launch.py'], indirect=True, ids=['view.launch.py'])
def test_a_small_arm_in_a_namespace_fills_the_view(described: list[Any]) -> None:
    arguments = {item.args[0]: item.kwargs for item in described if isinstance(item, DeclareLaunchArgument)}
    (describe,) = [item.kwargs['function'] for item in described if isinstance(item, OpaqueFunction)]
    given = {name: item['default_value'] for name, item in arguments.items()}
    small = {**given, 'params_file': str(ROOT / 'config' / 'arms' / 'quanser.yaml'), 'namespace': 'left'}
    widths = []
    for chosen in (given, small):
        publisher, viewer = describe(chosen)
        layout = Path(viewer.kwargs['arguments'][1])
        camera = yaml.safe_load(layout.read_text(encoding='utf-8'))['Visualization Manager']['Views']['Current']
        reach = sum(load_arm(chosen['params_file'] or None).link_length)
        widths.append((camera['Scale'] * reach, camera['X'] / reach))
        layout.unlink()
    assert widths[1] == pytest.approx(widths[0])
    assert publisher.kwargs['namespace'] == 'left'
    assert ('/rpbsid_identifier/arm', '/left/rpbsid_identifier/arm') in viewer.kwargs['remappings']


@pytest.mark.parametrize('described', FILES, indirect=True, ids=lambda path: path.name)
def test_what_the_nodes_log_is_seen_on_the_terminal(described: list[Any]) -> None:
    """The payload is logged when it is first trusted."""
    assert {item.kwargs['output'] for item in described if isinstance(item, Node)} == {'screen'}


@pytest.mark.parametrize('described', FILES, indirect=True, ids=lambda path: path.name)
def test_the_identifier_alone_may_be_started_behind_another_command(described: list[Any]) -> None:
    prefixed = [item.kwargs['executable'] for item in described if isinstance(item, Node) and 'prefix' in item.kwargs]
    (default,) = [item.kwargs['default_value'] for item in described
                  if isinstance(item, DeclareLaunchArgument) and item.args[0] == 'prefix']
    assert (prefixed, default) == (['rpbsid_identifier'], '')


@pytest.mark.parametrize('described', FILES[1:], indirect=True, ids=lambda path: path.name)
def test_identifier_and_trigger_get_the_same_parameter_file(described: list[Any]) -> None:
    nodes = {item.kwargs['executable']: item.kwargs['parameters'] for item in described if isinstance(item, Node)}
    files = {name: [one.args[0].args[0] for one in given if isinstance(one, Call)] for name, given in nodes.items()}
    assert files == {'rpbsid_identifier': ['params_file'], 'capture_trigger': ['params_file']}


@pytest.mark.parametrize('described', FILES[1:], indirect=True, ids=lambda path: path.name)
def test_a_parameter_file_that_is_not_there_stops_the_launch(described: list[Any]) -> None:
    (check,) = [item.kwargs['function'] for item in described if isinstance(item, OpaqueFunction)]
    with pytest.raises(RuntimeError, match=r"params_file 'nowhere\.yaml' does not exist"):
        check({'params_file': 'nowhere.yaml'})
    (default,) = [item.kwargs['default_value'] for item in described
                  if isinstance(item, DeclareLaunchArgument) and item.args[0] == 'params_file']
    assert check({'params_file': default}) == []
