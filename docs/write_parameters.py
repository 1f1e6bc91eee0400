"""Write config/*.yaml and docs/parameters.md from the declared parameters.

Use: ``python docs/write_parameters.py`` (``make docs``).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from flexmanip_ros.parameters import Leaf, leaves
from flexmanip_ros.parameters.document import NODES, limits, written, yaml_text
from flexmanip_ros.parameters.field import LINKS

ROOT = Path(__file__).resolve().parents[1]


def kind(leaf: Leaf) -> str:
    """Return the type as ROS names it."""
    name = {bool: 'bool', int: 'integer', float: 'double', str: 'string'}[leaf.kind]
    if not leaf.is_array:
        return name
    if leaf.per_link and leaf.size is not None:
        return f'{name}[{leaf.size // LINKS} a link]'
    return f'{name}[{leaf.size}]' if leaf.size is not None else f'{name}[]'


def table(cls: type) -> str:
    """Return the parameters of a class as a Markdown table."""
    rows = ['| parameter | type | default | unit | range | live | meaning |', '|---|---|---|---|---|---|---|']
    for leaf in leaves(cls):
        cells = (f'`{leaf.name}`', kind(leaf), f'`{written(leaf, leaf.default)}`', leaf.unit, limits(leaf),
                 'yes' if leaf.live else '', leaf.words)
        rows.append('| ' + ' | '.join(cell.replace('|', '\\|') for cell in cells) + ' |')
    return '\n'.join(rows) + '\n'


def markdown() -> str:
    """Return the reference page of all parameters."""
    parts = ['# Parameters', '',
             'This page is written by `docs/write_parameters.py` (`make docs`) from the declarations in '
             '`flexmanip_ros/parameters/`. A test fails when it is out of date.', '',
             'A parameter marked `live` may be changed while the node runs.', '']
    for node in NODES:
        parts += [f'## {node}', '', table(NODES[node])]
    return '\n'.join(parts)


def documents() -> Iterator[tuple[str, str]]:
    """Yield (path below the repository, text) of every file made from the declarations."""
    for node in NODES:
        heading = f'Defaults of {node}, written by docs/write_parameters.py. Copy what you change.'
        yield f'config/{node}.yaml', yaml_text(node, heading=heading)
    yield 'docs/parameters.md', markdown()


def main() -> None:
    """Write the files that differ and print their names."""
    for name, text in documents():
        path = ROOT / name
        if not path.is_file() or path.read_text(encoding='utf-8') != text:
            path.write_text(text, encoding='utf-8')
            print(f'wrote {name}')


if __name__ == '__main__':
    main()
