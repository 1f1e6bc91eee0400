"""The SROS 2 policy against what the nodes really open: too wide or too narrow fails."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from ros_harness import Ros, overrides

from flexmanip_ros.ros.nodes.capture_trigger import CaptureTrigger
from flexmanip_ros.ros.nodes.excitation import Excitation
from flexmanip_ros.ros.nodes.live_view import LiveView
from flexmanip_ros.ros.nodes.payload_adapter import PayloadAdapter
from flexmanip_ros.ros.nodes.payload_controller import PayloadController
from flexmanip_ros.ros.nodes.plant_simulator import PlantSimulator
from flexmanip_ros.ros.nodes.rpbsid_identifier import RpbsidIdentifier

POLICY = Path(__file__).resolve().parents[2] / 'config' / 'sros2' / 'policy.xml'
NODES = (PlantSimulator, Excitation, CaptureTrigger, RpbsidIdentifier, PayloadController, PayloadAdapter,
         LiveView)
FREE_DOMAIN = 101
"""The domain that no other test uses."""
DRIVER = 'io_and_status_controller/set_payload'


def allowed(name: str) -> dict[str, set[str]]:
    """Return what the policy lets a node do, as full names."""
    (profile,) = ElementTree.parse(POLICY).findall(f".//enclave[@path='/flexmanip_ros/{name}']//profile")
    assert profile.attrib == {'ns': '/', 'node': name}
    found: dict[str, set[str]] = {'publish': set(), 'subscribe': set(), 'reply': set(), 'request': set()}
    for group in profile:
        ((kind, verdict),) = group.attrib.items()
        assert verdict == 'ALLOW'
        for item in group:
            assert item.text is not None
            assert '*' not in item.text
            found[kind].add('/' + item.text.replace('~', name))
    return found


def opened(node: Any) -> dict[str, set[str]]:
    """Return what a node has open on the graph."""
    name = node.get_name()
    lists = {
        'publish': node.get_publisher_names_and_types_by_node,
        'subscribe': node.get_subscriber_names_and_types_by_node,
        'reply': node.get_service_names_and_types_by_node,
        'request': node.get_client_names_and_types_by_node,
    }
    return {kind: {topic for topic, _ in look(name, '/')} for kind, look in lists.items()}


@pytest.fixture
def alone(surroundings: None) -> Iterator[Ros]:
    """A graph of its own: other tests reuse their domains, and the graph finds a node by its name alone."""
    made = Ros(FREE_DOMAIN)
    try:
        yield made
    finally:
        made.close()


@pytest.mark.parametrize('cls', NODES)
def test_the_policy_allows_exactly_what_a_node_opens(alone: Ros, cls: Any) -> None:
    # The driver's service type is not installed here; a parameter service stands at its place.
    given = {PayloadAdapter: overrides(target_node='driver'), LiveView: overrides(port=0)}.get(cls)
    node = alone.managed(cls(context=alone.context, overrides=given))
    expected = allowed(node.get_name())
    if cls is PayloadAdapter:
        expected['request'] = {name.replace('/' + DRIVER, '/driver/set_parameters') for name in expected['request']}
    alone.wait(lambda: opened(node) == expected, what=f'the graph showing {expected}')


def test_every_node_has_an_enclave_of_its_own() -> None:
    paths = [item.attrib['path'] for item in ElementTree.parse(POLICY).findall('.//enclave')]
    assert len(paths) == len(set(paths)) == len(NODES)
