from __future__ import annotations

import math

import pytest
from rcl_interfaces.srv import DescribeParameters, GetParameters, SetParametersAtomically
from rclpy.node import Node
from rclpy.parameter import Parameter
from ros_harness import Ros, overrides

from flexmanip_ros.errors import ParameterError
from flexmanip_ros.parameters import (
    ExcitationParameters,
    IdentifierParameters,
    PlantParameters,
    flatten,
    leaves,
)
from flexmanip_ros.parameters.document import NODES
from flexmanip_ros.ros.parameters import NodeParameters


@pytest.mark.parametrize('cls', NODES.values())
def test_every_parameter_is_declared_with_its_default_words_and_range(ros: Ros, cls: type) -> None:
    node = ros.add(Node('declaring', context=ros.context))
    assert flatten(NodeParameters(node, cls).config) == flatten(cls())
    for leaf in leaves(cls):
        described = node.describe_parameter(leaf.name)
        assert leaf.words in described.description
        assert leaf.unit in described.description
        assert described.read_only is not leaf.live
        if leaf.low is not None and not leaf.is_array:
            (limits,) = described.floating_point_range or described.integer_range
            assert limits.from_value == leaf.low
            assert limits.to_value == (leaf.high if leaf.high is not None else limits.to_value)


def test_overrides_reach_the_configuration_and_an_empty_text_list_is_written_as_ros_can(ros: Ros) -> None:
    node = ros.add(Node('declaring', context=ros.context, parameter_overrides=overrides(
        angles=[''], payload_method='none', arm__modes=2, outputs=['link1_bend/position'], order=4)))
    config = NodeParameters(node, IdentifierParameters).config
    assert config.angles == ()
    assert (config.payload_method, config.arm.modes, config.outputs) == ('none', 2, ('link1_bend/position',))
    assert node.get_parameter('angles').value == ['']


@pytest.mark.parametrize('given', [[0.1, -0.2], []])
def test_a_list_that_is_empty_by_default_may_be_given(ros: Ros, given: list[float]) -> None:
    empty = {leaf.name for cls in NODES.values() for leaf in leaves(cls)
             if leaf.default == () and leaf.kind is not str}
    assert empty == {'payload.working_point'}
    node = ros.add(Node('declaring', context=ros.context,
                        parameter_overrides=overrides(payload__working_point=given)))
    assert NodeParameters(node, IdentifierParameters).config.payload.working_point == tuple(given)
    described = node.describe_parameter('payload.working_point')
    assert described.type == Parameter.Type.DOUBLE_ARRAY.value
    assert described.read_only
    assert list(node.get_parameter('payload.working_point').value) == given


@pytest.mark.parametrize('given', [0, 0.0, False, '', 1])
def test_what_is_no_list_is_not_taken_for_an_empty_one(ros: Ros, given: object) -> None:
    node = ros.add(Node('declaring', context=ros.context,
                        parameter_overrides=overrides(payload__working_point=given)))
    with pytest.raises(ParameterError, match='give a list'):
        NodeParameters(node, IdentifierParameters)


@pytest.mark.parametrize(('name', 'value', 'said'), [
    ('order', 0, "'order' is 0; give a value from 1 to 60"),
    ('order', 4.0, "'order' is of type double; give a whole number"),
    ('arm.link_length', [3.0, -1.0], "'arm.link_length' is -1.0 m"),
    ('arm.link_length', [3.0, 3.0, 3.0], "'arm.link_length' has 3 elements; give 2"),
    ('arm.joint_mass', math.nan, "'arm.joint_mass'"),
    ('payload_method', 'magic', 'choose one of none, block, frequency, structured'),
    ('ordr', 4, "unknown parameter 'ordr'; did you mean 'order'?"),
    ('zzz', 4, 'known are angles, arm.*, base_frame'),
    ('payload.zzzzzzzzzzzz', 4, 'known are payload.'),
    ('publish_rate', '100', "'publish_rate' is of type string; give a number such as 100.0"),
    ('arm.link_length', 3, "'arm.link_length' is of type integer; give a list, each a number such as 100.0"),
    ('publish_rate', -100, "'publish_rate' is -100.0 Hz"),
    ('future_window', 11, 'cannot exceed past_window (10)'),
    ('inputs', ['joint1'], 'write NAME/FIELD'),
])
def test_a_wrong_parameter_is_named_with_the_way_out(ros: Ros, name: str, value: object, said: str) -> None:
    node = ros.add(Node('declaring', context=ros.context, parameter_overrides=[Parameter(name, value=value)]))
    with pytest.raises(ParameterError) as caught:
        NodeParameters(node, IdentifierParameters)
    assert said in str(caught.value)


def test_a_whole_number_is_taken_for_a_double_as_the_programs_take_it(ros: Ros) -> None:
    node = ros.add(Node('declaring', context=ros.context, parameter_overrides=overrides(
        publish_rate=100, arm__link_length=[1, 2], payload__working_point=[0, 1])))
    config = NodeParameters(node, IdentifierParameters).config
    assert (config.publish_rate, config.arm.link_length) == (100.0, (1.0, 2.0))
    assert config.payload.working_point == (0.0, 1.0)
    assert node.get_parameter('publish_rate').type_ is Parameter.Type.DOUBLE


def test_a_parameter_of_another_node_of_the_package_is_let_pass(ros: Ros) -> None:
    node = ros.add(Node('declaring', context=ros.context, parameter_overrides=overrides(payload_mass=30.0)))
    NodeParameters(node, ExcitationParameters)


def test_a_set_of_changes_is_taken_as_a_whole_or_refused_with_the_reason(ros: Ros) -> None:
    node = ros.add(Node('declaring', context=ros.context))
    seen: list[tuple[ExcitationParameters, list[str]]] = []
    parameters = NodeParameters(node, ExcitationParameters, lambda config, names: seen.append((config, sorted(names))))
    good = [Parameter('amplitude', value=[1.0, 2.0]), Parameter('offset', value=[0.5, 0.5])]
    request = SetParametersAtomically.Request(parameters=[item.to_parameter_msg() for item in good])
    assert ros.call(SetParametersAtomically, 'declaring/set_parameters_atomically', request).result.successful
    assert (parameters.config.amplitude, parameters.config.offset) == ((1.0, 2.0), (0.5, 0.5))
    assert seen == [(parameters.config, ['amplitude', 'offset'])]
    bad = [Parameter('offset', value=[0.0, 0.0]), Parameter('amplitude', value=[-1.0, 2.0])]
    request = SetParametersAtomically.Request(parameters=[item.to_parameter_msg() for item in bad])
    result = ros.call(SetParametersAtomically, 'declaring/set_parameters_atomically', request).result
    assert not result.successful
    assert "'amplitude' is -1.0 N m; give a value from 0 to 1e+09 N m" in result.reason
    assert parameters.config.offset == (0.5, 0.5)
    assert ros.call(GetParameters, 'declaring/get_parameters', GetParameters.Request(
        names=['offset'])).values[0].double_array_value.tolist() == [0.5, 0.5]


def test_a_node_that_is_told_of_a_change_has_the_old_parameters_for_what_came_before_it(ros: Ros) -> None:
    node = ros.add(Node('declaring', context=ros.context))
    seen: list[tuple[float, float]] = []

    def changed(config: IdentifierParameters, names: object) -> None:
        seen.append((parameters.config.max_gap, config.max_gap))

    parameters = NodeParameters(node, IdentifierParameters, changed)
    (result,) = node.set_parameters([Parameter('max_gap', value=0.0)])
    assert result.successful
    assert seen == [(0.2, 0.0)]
    assert parameters.config.max_gap == 0.0


def test_what_may_not_change_at_run_time_is_read_only(ros: Ros) -> None:
    node = ros.add(Node('declaring', context=ros.context))
    parameters = NodeParameters(node, PlantParameters)
    (result,) = node.set_parameters([Parameter('rate', value=500.0)])
    assert not result.successful
    assert parameters.config.rate == 1000.0
    answer = ros.call(DescribeParameters, 'declaring/describe_parameters', DescribeParameters.Request(
        names=['payload_mass', 'rate']))
    assert [item.read_only for item in answer.descriptors] == [False, True]
