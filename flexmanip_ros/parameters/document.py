"""YAML files and the text of --help, made from the declared parameters so that they cannot go stale."""

import re
import textwrap
from collections.abc import Mapping
from typing import Any

import yaml

from flexmanip_ros.parameters.arm import ExcitationParameters, PlantParameters
from flexmanip_ros.parameters.field import Leaf, leaves
from flexmanip_ros.parameters.identifier import IdentifierParameters
from flexmanip_ros.parameters.nodes import AdapterParameters, ControllerParameters, TriggerParameters, ViewParameters

NODES: Mapping[str, type] = {
    'plant_simulator': PlantParameters,
    'excitation': ExcitationParameters,
    'capture_trigger': TriggerParameters,
    'rpbsid_identifier': IdentifierParameters,
    'payload_controller': ControllerParameters,
    'payload_adapter': AdapterParameters,
    'live_view': ViewParameters,
}
"""Each node and the class that declares its parameters."""

WIDTH = 100
"""Largest number of characters in a line of a comment or of --help."""


def package_names() -> frozenset[str]:
    """Return the names of all nodes' parameters, all of which a section for every node (``/**``) may contain."""
    return frozenset(leaf.name for cls in NODES.values() for leaf in leaves(cls))


def number(value: float) -> str:
    """Write a float so that ROS reads a double and YAML a number: always with a point."""
    text = repr(float(value))
    if text in ('inf', '-inf', 'nan'):
        return text.replace('inf', '.inf').replace('nan', '.nan')
    mantissa, exponent, power = text.partition('e')
    return (mantissa if '.' in mantissa else mantissa + '.0') + exponent + power


def scalar(value: Any) -> str:
    """Write one bool, int, float or str as YAML."""
    if isinstance(value, bool):
        return 'true' if value else 'false'
    if isinstance(value, float):
        return number(value)
    if isinstance(value, str):
        plain = (re.fullmatch(r'[A-Za-z_][\w/.-]*', value) and yaml.safe_load(value) == value
                 and value.lower() not in ('y', 'n', 'inf', 'infinity', 'nan'))  # ROS reads these as no text
        return value if plain else "'" + value.replace("'", "''") + "'"
    return str(value)


def written(leaf: Leaf, value: Any) -> str:
    """Write the value of a parameter as YAML; an empty list of texts becomes [''], as ROS needs."""
    if not leaf.is_array:
        return scalar(value)
    items = [scalar(item) for item in value]
    return f'[{", ".join(items or ["" if leaf.kind is not str else repr("")])}]'


def limits(leaf: Leaf) -> str:
    """Return the range or the choices in words; empty when there is neither."""
    if leaf.choices:
        return ' | '.join(leaf.choices)
    if leaf.low is not None and leaf.high is not None:
        return f'{leaf.low:g} .. {leaf.high:g}'
    return f'>= {leaf.low:g}' if leaf.low is not None else '' if leaf.high is None else f'<= {leaf.high:g}'


def _comment(leaf: Leaf) -> str:
    extras = [part for part in (leaf.unit, limits(leaf)) if part]
    return leaf.words + (' (' + ', '.join(extras) + ')' if extras else '')


def yaml_text(node: str, values: Mapping[str, Any] | None = None, heading: str = '') -> str:
    """Return a ROS parameter file of a node, for any name and namespace: each parameter with words, unit and range.

    values: dotted name -> value of each parameter to be written; None: all parameters with their defaults.
    """
    lines = [f'# {line}' for line in textwrap.wrap(heading, WIDTH)]
    lines += ['/**:', '  ros__parameters:']
    group: tuple[str, ...] = ()
    for leaf in leaves(NODES[node]):
        if values is not None and leaf.name not in values:
            continue
        *path, name = leaf.name.split('.')
        for depth, part in enumerate(path):
            if tuple(path[:depth + 1]) != group[:depth + 1]:
                lines.append('    ' + '  ' * depth + f'{part}:')
        group = tuple(path)
        indent = '    ' + '  ' * len(path)
        lines += [f'{indent}# {line}' for line in textwrap.wrap(_comment(leaf), WIDTH - len(indent))]
        value = leaf.default if values is None else values[leaf.name]
        text = written(leaf, value)
        # An empty list of numbers has no type in a ROS parameter file: it can only be left out.
        lines.append(f'{indent}# {name}: []' if text == '[]' else f'{indent}{name}: {text}')
    return '\n'.join(lines) + '\n'


def help_text(cls: type) -> str:
    """Return the parameters as a list for --help."""
    lines = []
    for leaf in leaves(cls):
        words = f'{leaf.name} = {written(leaf, leaf.default)}'
        lines.append('  ' + words)
        lines += textwrap.wrap(_comment(leaf), WIDTH - 8, initial_indent=' ' * 8, subsequent_indent=' ' * 8)
    return '\n'.join(lines)
