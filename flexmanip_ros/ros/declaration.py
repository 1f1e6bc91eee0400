"""Declaring a parameter whose default may be an empty array."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter


def overrides(node: Node) -> dict[str, Parameter]:
    """Return what was given at start by file, command line or code; rclpy has no public name for it."""
    given: dict[str, Parameter] = node._parameter_overrides
    return given


def declare(node: Node, name: str, default: Any, kind: Parameter.Type, descriptor: ParameterDescriptor
            ) -> Any:
    """Declare a parameter and return its value, from an override or the default; raises what rclpy raises.

    rclpy reads the type off the default, takes an empty array for one of bytes, and would refuse every
    override of it but an empty one (which has no type, and no value). So such a one is declared by its type
    alone, and set.
    """
    if not isinstance(default, list) or default:
        return node.declare_parameter(name, default, descriptor).value
    given = overrides(node).get(name)
    has_value = given is not None and not _is_empty(given.value)
    node.declare_parameter(name, kind, ignore_override=not has_value)
    if not has_value:
        node.set_parameters([Parameter(name, kind, [])])
    descriptor.type = kind.value
    node.set_descriptor(name, descriptor)
    return node.get_parameter(name).value


def _is_empty(value: Any) -> bool:
    return value is None or (isinstance(value, Sequence) and not isinstance(value, str) and not value)
