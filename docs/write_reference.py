"""Write docs/reference.md: nodes, topics, services, programs, launch files and configuration files.

Use: ``python docs/write_reference.py`` (``make docs``). Everything is read from the files themselves: topics from the
first docstring of a node, arguments from the parser of a program, the purpose of a configuration file from its first
comment. No ROS is needed.
"""

from __future__ import annotations

import ast
import importlib
import itertools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from flexmanip_ros.parameters.document import NODES
from flexmanip_ros.types import Status

ROOT = Path(__file__).resolve().parents[1]
TARGET = ROOT / 'docs' / 'reference.md'
VERBS = ('subscribes', 'publishes', 'services', 'calls')
ROW = re.compile(r'(\S+?(?:, \S+)*)\s+([a-z_]+/[A-Z]\w+)\s*(.*)')
"""Name or names, type, words."""
PARAMETERS = re.compile(r'\n\n?parameters (?:of|\()')
"""Where the list of the parameters begins in the help of a program."""
LAUNCH = re.compile(r"\(\s*'(\w+)',\s*'([^']*)',\s*(?:'([^']*)'|\"([^\"]*)\")\)")


class Edge(NamedTuple):
    """A topic or service of a node."""

    verb: str
    name: str
    kind: str
    words: str


def docstring(path: Path) -> str:
    """Return the docstring of a file."""
    return ast.get_docstring(ast.parse(path.read_text(encoding='utf-8'))) or ''


def edges(text: str) -> Iterator[Edge]:
    """Yield the topics and services that the docstring of a node lists."""
    verb = ''
    for line in text.splitlines():
        first = line.split(' ')[0]
        if first in VERBS:
            verb, line = first, line[len(first):]
        elif not line.startswith(' '):
            verb = ''
        found = ROW.match(line.strip()) if verb else None
        if found is not None:
            for name in found[1].split(', '):
                yield Edge(verb, name, found[2], found[3])


def nodes() -> Iterator[str]:
    """Yield the sections of the nodes."""
    for node in NODES:
        text = docstring(ROOT / f'flexmanip_ros/ros/nodes/{node}.py')
        what = text.splitlines()[0].partition(': ')[2]
        yield f'### {node}\n\n{what[0].upper()}{what[1:]} [Its parameters](parameters.md#{node}).\n'
        yield '| | name | type | |\n|---|---|---|---|'
        for edge in edges(text):
            yield f'| {edge.verb} | `{edge.name}` | {edge.kind} | {cell(edge.words)} |'
        yield ''


def topics() -> Iterator[str]:
    """Yield a table of the topics: who publishes, who subscribes."""
    found: dict[tuple[str, str], dict[str, list[str]]] = {}
    for node in NODES:
        for edge in edges(docstring(ROOT / f'flexmanip_ros/ros/nodes/{node}.py')):
            name = edge.name.replace('~/', f'{node}/')
            found.setdefault((name, edge.kind), {}).setdefault(edge.verb, []).append(f'`{node}`')
    yield '| topic | type | published by | subscribed by |\n|---|---|---|---|'
    for (name, kind), who in sorted(found.items()):
        if 'services' not in who:
            out, into = (', '.join(who.get(verb, [])) for verb in ('publishes', 'subscribes'))
            yield f'| `{name}` | {kind} | {out} | {into} |'
    yield ''


def programs() -> Iterator[str]:
    """Yield what the programs take; the parameters have a page of their own."""
    for path in sorted((ROOT / 'flexmanip_ros/cli').glob('*.py')):
        if '\ndef _parser(' in path.read_text(encoding='utf-8'):
            made = importlib.import_module(f'flexmanip_ros.cli.{path.stem}')._parser()
            yield f'### {path.stem}\n\n{made.description}\n\n| argument | meaning |\n|---|---|'
            expanded = made._get_formatter()._expand_help
            for action in made._actions[1:]:  # all but --help
                name = ' '.join([*action.option_strings[-1:], *([action.metavar] if action.metavar else [])])
                yield f'| `{cell(name)}` | {cell(expanded(action))} |'
            yield f'\n```text\n{PARAMETERS.split(made.epilog or "")[0].rstrip()}\n```\n'


def launch_files() -> Iterator[str]:
    """Yield the launch files with their arguments."""
    for path in sorted((ROOT / 'launch').glob('*.launch.py')):
        yield f'### {path.name}\n\n{docstring(path).splitlines()[0]}\n'
        text = path.read_text(encoding='utf-8')
        rows = [(name, f'`{default}`' if default else '', one or two)
                for name, default, one, two in LAUNCH.findall(text)]
        rows += declared(text)
        yield '| argument | default | meaning |\n|---|---|---|'
        yield from (f'| `{name}` | {default} | {cell(words)} |' for name, default, words in rows)
        yield ''


def declared(text: str) -> Iterator[tuple[str, str, str]]:
    """Yield name, default (where it is a plain text) and words of each DeclareLaunchArgument of a launch file."""
    for call in ast.walk(ast.parse(text)):
        if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == 'DeclareLaunchArgument':
            plain = {item.arg: item.value.value for item in call.keywords if isinstance(item.value, ast.Constant)}
            if isinstance(call.args[0], ast.Constant):
                default = plain.get('default_value')
                yield call.args[0].value, f'`{default}`' if default else '', plain['description']


def files() -> Iterator[str]:
    """Yield a table of the files in config/."""
    yield '| file | what it is |\n|---|---|'
    for path in sorted((ROOT / 'config').rglob('*.*')):
        if path.suffix in ('.yaml', '.xml'):
            yield f'| `{path.relative_to(ROOT)}` | {cell(first_words(path))} |'
    yield ''


def first_words(path: Path) -> str:
    """Return the first sentence of the comment that a file begins with."""
    text = path.read_text(encoding='utf-8')
    if path.suffix == '.xml':
        found = re.search(r'<!--(.*?)-->', text, re.DOTALL)
        comment = found[1] if found else ''
    else:
        lines = text.splitlines()
        comment = ' '.join(line.lstrip('#') for line in itertools.takewhile(lambda line: line.startswith('#'), lines))
    return re.split(r'(?<=[.:;]) ', ' '.join(comment.split()))[0].rstrip(':;')


def statuses() -> Iterator[str]:
    """Yield the statuses and what a user reads."""
    yield '| status | in words |\n|---|---|'
    yield from (f'| `{status.name}` | {cell(status.value)} |' for status in Status)
    yield ''


def cell(text: str) -> str:
    """Return a text as the cell of a table."""
    return text.replace('|', '\\|')


def page() -> str:
    """Return the page."""
    return '\n'.join([
        '# Reference\n',
        'This page is written by `docs/write_reference.py` (`make docs`) from the code. A test fails when it is out of '
        'date. [Parameters](parameters.md) has every parameter with default, unit and range; '
        '[the nodes](nodes.md) explains life cycle, quality of service and diagnostics; [recordings](recordings.md) '
        'explains what the programs read and write.\n',
        '## Nodes\n', *nodes(),
        '## Topics\n',
        'Names are relative to the namespace of the node. `~/` is the name of the node.\n', *topics(),
        '## Statuses\n', '[Concepts](concepts.md) says what each means for the number beside it.\n', *statuses(),
        '## Programs\n', *programs(),
        '## Launch files\n', *launch_files(),
        '## Configuration files\n',
        'They lie in `share/flexmanip_ros` of the workspace or of the Python environment.\n', *files(),
    ]).rstrip() + '\n'


def main() -> None:
    """Write the page."""
    if not TARGET.is_file() or TARGET.read_text(encoding='utf-8') != page():
        TARGET.write_text(page(), encoding='utf-8')
        print(f'wrote docs/{TARGET.name}')


if __name__ == '__main__':
    main()
