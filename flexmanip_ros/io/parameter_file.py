"""Read ROS parameter files and ``name=value`` overrides as dotted names and values."""

import difflib
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import yaml

from flexmanip_ros.errors import ParameterError
from flexmanip_ros.parameters import ArmParameters, IdentifierParameters, configure
from flexmanip_ros.parameters.document import NODES, package_names, scalar
from flexmanip_ros.parameters.field import as_float, dotted, leaves

Config = TypeVar('Config')
STANDARD = re.compile(r'^(use_sim_time|start_type_description_service|autostart|qos_overrides\..*)$')
"""Parameters that every node has and that have no meaning offline."""
LARGEST_FILE = 1 << 20
"""Size of a file above which it is rejected [bytes]; a parameter file is a page of text."""


class _Loader(yaml.SafeLoader):
    """Safe YAML as ROS reads it: 1e-3 and -.5 are numbers, y is true; a repeated name and an alias are errors."""

    yaml_implicit_resolvers: ClassVar[dict[Any, Any]] = {}
    bool_values: ClassVar[dict[str, bool]] = yaml.SafeLoader.bool_values | {'y': True, 'n': False}

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.events.AliasEvent):
            problem = 'ROS parameter files have no aliases (*name)'
            parser: Any = self
            raise yaml.composer.ComposerError(None, None, problem, parser.peek_event().start_mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if isinstance(key.value, str):
                key.tag = 'tag:yaml.org,2002:str'  # a name is a text, even 'y' or '1'
                if key.value in seen:
                    problem = f"'{key.value}' is given twice"
                    raise yaml.constructor.ConstructorError(None, None, problem, key.start_mark)
                seen.add(key.value)
        mapping: dict[Any, Any] = super().construct_mapping(node, deep)
        return mapping


for _kind, _form in (
        ('bool', '|'.join(f'{word}|{word.title()}|{word.upper()}' for word in _Loader.bool_values)),
        ('int', r'[-+]?(0x[\da-fA-F]+|0[0-7]*|[1-9]\d*)'),
        ('float', r'[-+]?((\d+\.?\d*|\.\d+)([eE][-+]?\d+)?|\.(inf|Inf|INF))|\.(nan|NaN|NAN)')):
    _Loader.add_implicit_resolver(f'tag:yaml.org,2002:{_kind}', re.compile(f'^({_form})$', re.ASCII), None)


def parse(text: str, what: str) -> Any:
    """Return a YAML document as plain values. Raises ParameterError naming ``what`` and the line."""
    try:
        return yaml.load(text, _Loader)
    except (yaml.YAMLError, ValueError, RecursionError, OverflowError) as err:
        reason = getattr(err, 'problem', None) or str(err) or type(err).__name__
        mark = getattr(err, 'problem_mark', None)
        place = f' in line {mark.line + 1}' if mark is not None else ''
        raise ParameterError(f'{what} is not valid YAML{place}: {reason}', 'correct that line') from err


def sections(path: str | Path) -> dict[str, Any]:
    """Return the parameters in each section of a file by the name of the section, nested; an empty file has none.

    Raises ParameterError naming the file; also for a list such as [1, 2.0] in any section, with which no node starts.
    """
    where = f"parameter file '{path}'"
    try:
        if Path(path).stat().st_size > LARGEST_FILE:
            raise ParameterError(f'{where} is larger than 1 MiB', 'give a ROS parameter file')
        text = Path(path).read_text(encoding='utf-8')
    except FileNotFoundError as err:
        raise ParameterError(f'{where} does not exist', 'check the path') from err
    except (OSError, ValueError) as err:
        reason = getattr(err, 'strerror', None) or 'it is not UTF-8 text'
        raise ParameterError(f'{where} cannot be read: {reason}', 'give a readable YAML file') from err
    document = parse(text, where)
    if document is None:
        return {}
    found = dict(_sections(document, '', where))
    if not found:
        raise ParameterError(f"{where} has no 'ros__parameters'", "write '/**: {ros__parameters: {...}}'")
    for section in found.values():
        _reject_mixed(section, where)
    return found


def read(path: str | Path, node: str, *, optional: bool = False) -> dict[str, Any]:
    """Return the parameters a file gives to ``node``, nested groups flattened with dots.

    Sections named ``/**``, ``node``, ``/ns/node`` or with wildcards apply; later ones win. Sections of other nodes are
    ignored, and so are parameters of other nodes in a section for every node. An empty file gives no values. A file
    without any section for ``node`` is an error unless ``optional``. Raises ParameterError naming the file.
    """
    found = sections(path)
    chosen = [name for name in found if name.rpartition('/')[2] in (node, '*', '**')]
    if found and not chosen and not optional:
        raise _of_others(path, found, node)
    values: dict[str, Any] = {}
    for name in chosen:
        flat = _flatten(found[name], f"parameter file '{path}'")
        foreign = package_names() - {leaf.name for leaf in leaves(NODES[node])} if name.endswith('*') else ()
        values.update((key, value) for key, value in flat.items() if not STANDARD.match(key) and key not in foreign)
    return values


def check_names(path: str | Path, node: str) -> None:
    """Raise ParameterError where a file has sections, but none that ROS gives to the node of this full name."""
    found = sections(path)
    patterns = (re.escape('/' + name.removeprefix('/')) for name in found)
    if found and not any(re.fullmatch(name.replace(r'/\*\*', r'(/\w+)*').replace(r'/\*', r'/\w+'), node)
                         for name in patterns):
        raise _of_others(path, found, node)


def _of_others(path: str | Path, found: Iterable[str], node: str) -> ParameterError:
    near = difflib.get_close_matches(node.rpartition('/')[2], [name.rpartition('/')[2] for name in found], n=1)
    hint = f" ('{near[0]}' is close)" if near else ''
    return ParameterError(f"parameter file '{path}' is for {', '.join(sorted(found))}, not for {node}{hint}",
                          f"add a section '{node}' or '/**'")


def _sections(tree: Any, prefix: str, where: str) -> Iterable[tuple[str, Any]]:
    if not isinstance(tree, Mapping):
        name = prefix.rpartition('/')[2]
        raise ParameterError(f"{where} has {f'{name}: ' if name else ''}{tree!r:.60} in place of a node",
                             "write 'NODE: {ros__parameters: {...}}', with the parameters of a node inside")
    for key, value in tree.items():
        if prefix and key == 'ros__parameters':
            yield prefix, value or {}
        else:
            yield from _sections(value, f'{prefix}/{key}'.replace('//', '/') if prefix else str(key), where)


def _flatten(tree: Any, where: str) -> dict[str, Any]:
    if not isinstance(tree, Mapping):
        raise ParameterError(f"{where}: 'ros__parameters' is {tree!r:.60}", 'list the parameters below it')
    flat: dict[str, Any] = {}
    for name, value in dotted(tree):
        if name in flat:
            raise ParameterError(f"{where} gives '{name}' twice", 'keep one of them')
        flat[name] = value
    return flat


def _reject_mixed(tree: Any, where: str) -> None:
    """Raise ParameterError for a list with integers and doubles: rcl refuses the whole file for it."""
    for name, value in dotted(tree if isinstance(tree, Mapping) else {}):
        if isinstance(value, list) and {int, float} <= set(map(type, value)):
            items = ', '.join(scalar(as_float(item) if type(item) is int else item) for item in value)
            raise ParameterError(
                f"{where}: the list '{name}' has numbers with and without a point, which ROS cannot read",
                f'write [{items}]')


def parse_overrides(items: Iterable[str]) -> dict[str, Any]:
    """Return the names and values of ``name=value`` texts; the value is YAML. Later ones win."""
    values: dict[str, Any] = {}
    for item in items:
        name, equals, text = item.partition('=')
        if not equals or not name.strip():
            raise ParameterError(f"--set got '{item}'", 'write name=value, for example --set order=4')
        values[name.strip()] = parse(text, f'the value of --set {name.strip()}')
    return values


def load(cls: type[Config], node: str, path: str | Path | None, overrides: Iterable[str] = (), *,
         optional: bool = False) -> Config:
    """Return the configuration of ``node`` from a parameter file (or none) and ``name=value`` overrides."""
    from_file = {} if path is None else read(path, node, optional=optional)
    from_line = parse_overrides(overrides)
    try:
        return configure(cls, {**from_file, **from_line})
    except ParameterError as err:
        if path is None or any(f"'{name}'" in err.problem for name in from_line):
            raise
        where = f" in parameter file '{path}'"
        if from_line and _stands(cls, from_file):
            where = f": parameter file '{path}' does not go with --set {', '.join(from_line)}"
        raise ParameterError(err.problem + where, err.remedy) from err


def _stands(cls: type[Config], values: dict[str, Any]) -> bool:
    """Whether the parameters of a file are valid without the overrides."""
    try:
        configure(cls, values)
    except ParameterError:
        return False
    return True


def load_arm(path: str | Path | None, overrides: Iterable[str] = ()) -> ArmParameters:
    """Return the arm in a parameter file of the plant or of the identifier, whatever else stands there."""
    found: dict[str, Any] = {}
    if path is not None:
        for node in ('plant_simulator', 'rpbsid_identifier'):
            found.update(item for item in read(path, node, optional=True).items() if item[0].startswith('arm.'))
        if not found:
            raise ParameterError(f"parameter file '{path}' has no parameters arm.* of the plant or the identifier",
                                 "write the arm's measures there, in a section '/**'")
    return configure(IdentifierParameters, {**found, **parse_overrides(overrides)}).arm
