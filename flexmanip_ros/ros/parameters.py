"""A configuration class as ROS parameters: declared with descriptions and ranges, read, and changed together."""

import sys
from collections.abc import Callable, Collection, Iterable
from itertools import pairwise
from pathlib import Path
from typing import Any, Generic, TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter

from flexmanip_ros.errors import ParameterError
from flexmanip_ros.io.parameter_file import STANDARD
from flexmanip_ros.parameters import IdentifierParameters, Leaf, check, configure, flatten, leaves
from flexmanip_ros.parameters.document import limits, package_names, written
from flexmanip_ros.parameters.field import LINKS, suggestion
from flexmanip_ros.ros.rclpy_workarounds import declare, parameter_overrides

Config = TypeVar('Config')

_TYPES = {bool: 'BOOL', int: 'INTEGER', float: 'DOUBLE', str: 'STRING'}
_EXAMPLE = {bool: 'true or false', int: 'a whole number such as 100',
            float: 'a number such as 100.0', str: 'a text'}
_LARGEST = sys.float_info.max
_LARGEST_INT = 2**63 - 1


class NodeParameters(Generic[Config]):
    """The parameters of one node, kept as a valid configuration at all times.

    ``check_change`` is called with the configuration that a set of changes gives; it rejects them by a ParameterError.
    ``on_change`` is called when a set of changes was accepted, with the new configuration and the names that were set;
    ``config`` is still the old one then.
    """

    def __init__(
        self, node: Node, cls: type[Config], on_change: Callable[[Config, Collection[str]], None] | None = None,
        check_change: Callable[[Config], None] | None = None,
    ) -> None:
        """Declare every parameter of ``cls``; raises ParameterError naming the one that is wrong."""
        self._cls = cls
        self._leaves = {leaf.name: leaf for leaf in leaves(cls)}
        self._on_change = on_change
        self._check_change = check_change
        _reject_unknown(node, self._leaves)
        given = {leaf.name: _declare(node, leaf) for leaf in leaves(cls)}
        self.config: Config = configure(cls, given)
        cut = [f'{name} {written(self._leaves[name], value)}' for name, value in flatten(self.config).items()
               if name in parameter_overrides(node) and value != given[name]]
        if cut:  # lists that equal the default of two links, see ``fit_links``
            node.get_logger().info(f'one link: of each list the values of a second one are left out: {", ".join(cut)}')
        node.add_on_set_parameters_callback(self._validate)
        node.add_post_set_parameters_callback(self._apply)

    def _changed(self, changes: Iterable[Parameter]) -> dict[str, Any]:
        return {item.name: item.value for item in changes if item.name in self._leaves}

    def _candidate(self, changes: Iterable[Parameter]) -> Config:
        return configure(self._cls, {**flatten(self.config), **self._changed(changes)})

    def _validate(self, changes: list[Parameter]) -> SetParametersResult:
        try:
            candidate = self._candidate(changes)
            if self._check_change is not None and self._changed(changes):
                self._check_change(candidate)
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply(self, changes: list[Parameter]) -> None:
        names = self._changed(changes).keys()
        if not names:
            return
        changed = self._candidate(changes)
        if self._on_change is not None:
            self._on_change(changed, names)
        self.config = changed


def descriptor(leaf: Leaf) -> ParameterDescriptor:
    """Return the descriptor of a parameter: its description, range and type as ROS tools show them."""
    unit = f' [{leaf.unit}]' if leaf.unit else ''
    described = ParameterDescriptor(
        name=leaf.name, type=_type(leaf).value, description=leaf.words + unit, read_only=not leaf.live)
    notes = [limits(leaf)] if limits(leaf) else []
    if leaf.size is not None:
        notes.append(f'{leaf.size // LINKS} values a link' if leaf.per_link else f'{leaf.size} values')
    if not leaf.is_array and (leaf.low is not None or leaf.high is not None):
        if leaf.kind is float:
            described.floating_point_range = [FloatingPointRange(
                from_value=-_LARGEST if leaf.low is None else float(leaf.low),
                to_value=_LARGEST if leaf.high is None else float(leaf.high), step=0.0)]
        elif leaf.kind is int:
            described.integer_range = [IntegerRange(
                from_value=-_LARGEST_INT - 1 if leaf.low is None else int(leaf.low),
                to_value=_LARGEST_INT if leaf.high is None else int(leaf.high), step=1)]
    described.additional_constraints = '; '.join(notes)
    return described


def ros_value(leaf: Leaf, value: Any) -> Any:
    """Return a value as ROS stores it; an empty list of texts becomes [''] (ROS cannot infer its type)."""
    if not leaf.is_array:
        return value
    return [''] if leaf.kind is str and not value else list(value)


def _type(leaf: Leaf) -> Parameter.Type:
    return Parameter.Type[_TYPES[leaf.kind] + ('_ARRAY' if leaf.is_array else '')]


def _declare(node: Node, leaf: Leaf) -> Any:
    """Declare one parameter and return its value, from an override or the default."""
    _widen(parameter_overrides(node), leaf)
    try:
        value = declare(node, leaf.name, ros_value(leaf, leaf.default), _type(leaf), descriptor(leaf))
    except InvalidParameterTypeException as error:
        given = parameter_overrides(node)[leaf.name].type_.name.lower().replace('_', ' ')
        raise ParameterError(
            f"parameter '{leaf.name}' is of type {given}",
            f'give {"a list, each " if leaf.is_array else ""}{_EXAMPLE[leaf.kind]}') from error
    except InvalidParameterValueException as error:
        given = parameter_overrides(node)[leaf.name].value
        check(leaf, given)  # raises the message of this package
        raise ParameterError(f"parameter '{leaf.name}' is {given!r}", str(error)) from error
    return check(leaf, value)


def _widen(overrides: dict[str, Parameter], leaf: Leaf) -> None:
    """Turn the integers that are given for a parameter of type double into doubles, as programs read them."""
    given = overrides.get(leaf.name)
    if leaf.kind is not float or given is None:
        return
    if given.type_ is Parameter.Type.INTEGER and not leaf.is_array:
        overrides[leaf.name] = Parameter(leaf.name, value=float(given.value))
    elif given.type_ is Parameter.Type.INTEGER_ARRAY and leaf.is_array:
        overrides[leaf.name] = Parameter(leaf.name, value=[float(item) for item in given.value])


def _reject_unknown(node: Node, known: dict[str, Leaf]) -> None:
    """Raise ParameterError for an override that no node of this package declares, such as a misspelt name."""
    for name in parameter_overrides(node):
        if name in known or STANDARD.match(name) or name in package_names():
            continue
        raise ParameterError(f"unknown parameter '{name}'", suggestion(name, known))


def given_files() -> list[str]:
    """Return the parameter files of the command line."""
    # launch_ros writes the parameters that stand in a launch file into temporary files named launch_params_*
    return [path for option, path in pairwise(sys.argv)
            if option == '--params-file' and not Path(path).name.startswith('launch_params_')]


def arm_line(node: Any) -> tuple[str, bool]:
    """Return a log line on the arm parameters of a node and where they come from; empty where no arm plays a part.

    The second value: whether a parameter file was given that sets none of them.
    rclpy keeps the overrides given at start by name, not by origin: parameter files and ``-p`` look the same.
    """
    config = node.config
    arm = getattr(config, 'arm', None)
    given = any(name.startswith('arm.') for name in parameter_overrides(node))
    is_idle = isinstance(config, IdentifierParameters) and config.payload_method == 'none'
    if arm is None or (is_idle and not given):  # a file of --suggest is for any machine and names no arm
        return '', False
    defaults = flatten(type(arm)(arm.link_length)) | {'link_length': type(arm).link_length}  # of as many links
    changed = [f'arm.{name}' for name, value in flatten(arm).items() if value != defaults[name]]
    files = given_files()
    if given:
        origin = f'set at start: {", ".join(changed) or "the defaults"}'
        origin += f' (parameter files: {", ".join(files)})' if files else ''
    elif files:
        origin = (f'all defaults: {", ".join(files)} sets no parameter arm.* of {node.get_fully_qualified_name()} '
                  '(write the section /**, or the name of the node)')
    else:
        origin = 'all defaults'

    def both(values: Iterable[float]) -> str:
        return ' and '.join(f'{value:g}' for value in values)

    links, masses = 'link', f'mass {arm.tip_mass:g} kg at the tip'
    if len(arm.link_length) > 1:
        links, masses = 'links', f'masses {arm.joint_mass:g} kg at joint 2 and {arm.tip_mass:g} kg at the tip'
    return (f'arm: {links} of {both(arm.link_length)} m, {both(arm.linear_density)} kg/m, '
            f'{both(arm.bending_stiffness)} N m^2, {masses}; {origin}', bool(files) and not given)
