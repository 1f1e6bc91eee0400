"""Declaration of parameters: one dataclass field holds the default, description, unit and range of each."""

import dataclasses
import difflib
import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from flexmanip_ros.errors import ParameterError

Config = TypeVar('Config')

LINKS = 2
"""Largest number of links of an arm."""
WANTED = {
    bool: ('true or false', 'true/false values'), int: ('a whole number', 'whole numbers'),
    float: ('a number', 'numbers'), str: ('a text', 'texts'),
}
"""What an error message asks for, by type: one value, several values."""


@dataclass(frozen=True)
class Leaf:
    """One declared parameter: its dotted name, type (bool, int, float, str or a tuple of one) and words."""

    name: str
    kind: type
    is_array: bool
    default: Any
    words: str
    unit: str
    low: float | None
    high: float | None
    choices: tuple[str, ...]
    size: int | None
    live: bool
    per_link: bool = False
    """Whether the parameter has the same number of values for each link or joint; ``size`` is that of two links."""

    @property
    def range_words(self) -> str:
        """The inclusive range with its unit, as an error message asks for it."""
        if self.low is None and self.high is None:
            return 'a finite number'
        if self.high is None:
            return f'a value of at least {self.low:g} {self.unit}'.rstrip()
        low = 'up' if self.low is None else f'from {self.low:g}'
        return f'a value {low} to {self.high:g} {self.unit}'.rstrip()


def parameter(default: Any, words: str, *, unit: str = '', low: float | None = None, high: float | None = None,
              choices: tuple[str, ...] = (), size: int | None = None, live: bool = False,
              per_link: bool = False) -> Any:
    """Declare a parameter on a frozen dataclass.

    low, high: inclusive bounds (of every element of an array); size: fixed length of an array;
    live: may be changed while the node runs; per_link: values for each link or joint, see ``fit_links``.
    """
    return field(default=default, metadata={
        'words': words, 'unit': unit, 'low': low, 'high': high, 'choices': choices, 'size': size, 'live': live,
        'per_link': per_link})


def leaves(cls: type) -> tuple[Leaf, ...]:
    """List every parameter of a configuration class, nested groups flattened with dots."""
    return _leaves(cls, '')


@cache  # resolving the types takes 3 ms, each time that a configuration is made or changed
def _leaves(cls: type, prefix: str) -> tuple[Leaf, ...]:
    hints = get_type_hints(cls)
    found: list[Leaf] = []
    for item in dataclasses.fields(cls):
        hint = hints[item.name]
        if dataclasses.is_dataclass(hint):
            assert isinstance(hint, type)
            found.extend(_leaves(hint, f'{prefix}{item.name}.'))
            continue
        is_array = get_origin(hint) is tuple
        kind = get_args(hint)[0] if is_array else hint
        found.append(Leaf(prefix + item.name, kind, is_array, item.default, **item.metadata))
    return tuple(found)


def suggestion(name: str, declared: Collection[str]) -> str:
    """Return the hint for a name that is not declared: the nearest one, or those of its group, or all groups."""
    near = difflib.get_close_matches(name, declared, n=1)
    if near:
        return f"did you mean '{near[0]}'?"
    group = name.partition('.')[0] + '.'
    inside = [item for item in declared if item.startswith(group)]
    groups = {item if '.' not in item else item.partition('.')[0] + '.*' for item in declared}
    return f'known are {", ".join(sorted(inside or groups))}'


def configure(cls: type[Config], values: Mapping[str, Any]) -> Config:
    """Build a configuration from dotted names and values; names not given keep their default.

    Raises ParameterError naming the parameter that is unknown, mistyped, out of range or inconsistent.
    """
    declared = {leaf.name: leaf for leaf in leaves(cls)}
    for name in values:
        if name not in declared:
            raise ParameterError(f"unknown parameter '{name}'", suggestion(name, declared))
    checked = {name: check(declared[name], value) for name, value in values.items()}
    return _build(cls, checked, '')


def _build(cls: type[Config], values: Mapping[str, Any], prefix: str) -> Config:
    hints = get_type_hints(cls)
    arguments: dict[str, Any] = {}
    for item in dataclasses.fields(cls):  # type: ignore[arg-type]
        name = prefix + item.name
        if dataclasses.is_dataclass(hints[item.name]):
            arguments[item.name] = _build(hints[item.name], values, name + '.')
        elif name in values:
            arguments[item.name] = values[name]
    return cls(**arguments)


def dotted(tree: Mapping[str, Any], prefix: str = '') -> Iterator[tuple[str, Any]]:
    """Yield the dotted name and the value of each leaf of nested names and values."""
    for key, value in tree.items():
        if isinstance(value, Mapping) and value:
            yield from dotted(value, f'{prefix}{key}.')
        else:
            yield f'{prefix}{key}', value


def flatten(config: Any, prefix: str = '') -> dict[str, Any]:
    """Return the dotted names and values of a configuration; configure() takes them back."""
    return dict(dotted(dataclasses.asdict(config), prefix))


def check_all(config: Any) -> None:
    """Check every field of a configuration; for use in ``__post_init__`` (groups check themselves)."""
    for leaf in leaves(type(config)):
        if '.' not in leaf.name:
            object.__setattr__(config, leaf.name, check(leaf, getattr(config, leaf.name)))


def fit_links(config: Any, links: int, group: str = '') -> None:
    """Give each parameter that is declared per link as many values as links; for use in ``__post_init__``.

    A default of two links loses the values of the second one where there is no second link. Raises ParameterError where
    a list that was given has another size. group: such as 'arm.', before the names in an error.
    """
    for leaf in leaves(type(config)):
        if not leaf.per_link or '.' in leaf.name:
            continue
        value = getattr(config, leaf.name)
        wanted = len(leaf.default) // LINKS * links
        if value == leaf.default:
            value = of_links(value, links)
        if len(value) != wanted:
            raise ParameterError(f"parameter '{group}{leaf.name}' has {counted(len(value), 'elements')}, "
                                 f'but arm.link_length has {links}', f'give {counted(wanted, WANTED[leaf.kind][1])}')
        object.__setattr__(config, leaf.name, value)


def counted(count: int, what: str) -> str:
    """Return a count with its noun, such as '1 number' or '2 numbers'; what: the plural."""
    return f'{count} {what.removesuffix("s") if count == 1 else what}'


def of_links(values: tuple[Any, ...], links: int) -> tuple[Any, ...]:
    """Return the values of the first ``links`` links; values: those of two links, alternating."""
    return tuple(value for k, value in enumerate(values) if k % LINKS < links)


def check(leaf: Leaf, value: Any) -> Any:
    """Return the value in the declared type. Raises ParameterError naming the parameter."""
    if not leaf.is_array:
        return _check_one(leaf, value)
    wanted = WANTED[leaf.kind][1]
    if isinstance(value, (str, bytes, Mapping)) or not hasattr(value, '__iter__'):
        raise ParameterError(f"parameter '{leaf.name}' is {value!r}", f'give a list of {wanted}')
    items = tuple(_check_one(leaf, item) for item in value)
    if leaf.kind is str and items == ('',):
        items = ()  # ROS cannot write an empty list of a known type; [''] stands for it
    if leaf.size is not None and len(items) != leaf.size and not (
            leaf.per_link and len(items) * LINKS == leaf.size):
        raise ParameterError(f"parameter '{leaf.name}' has {counted(len(items), 'elements')}",
                             f'give {leaf.size} {wanted}')
    return items


def _check_one(leaf: Leaf, value: Any) -> Any:
    converted = _convert(leaf.kind, value)
    if converted is None:
        raise ParameterError(f"parameter '{leaf.name}' is {value!r}", f'give {WANTED[leaf.kind][leaf.is_array]}')
    if isinstance(converted, float) and not math.isfinite(converted):
        what = 'not a number' if math.isnan(converted) else 'infinite'
        raise ParameterError(f"parameter '{leaf.name}' is {what}", f'give {leaf.range_words}')
    if leaf.choices and converted not in leaf.choices:
        raise ParameterError(f"parameter '{leaf.name}' is {converted!r}", f'choose one of {", ".join(leaf.choices)}')
    below = leaf.low is not None and converted < leaf.low
    if below or (leaf.high is not None and converted > leaf.high):
        is_what = f'{converted!r} {leaf.unit}'.rstrip()
        raise ParameterError(f"parameter '{leaf.name}' is {is_what}", f'give {leaf.range_words}')
    return converted


def as_float(value: float) -> float:
    """Return a number as a float; a whole number beyond the range of floats becomes infinite."""
    try:
        return float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf


def _convert(kind: type, value: Any) -> Any:
    """Return the value as the declared type, None where it is of another one."""
    if kind is bool or isinstance(value, bool):
        return value if kind is bool and isinstance(value, bool) else None
    if kind is float and isinstance(value, (int, float)):
        return as_float(value)
    if kind is int and isinstance(value, int):
        return value
    if kind is str and isinstance(value, str):
        return value
    if hasattr(value, 'item'):  # a numpy scalar
        return _convert(kind, value.item())
    return None
