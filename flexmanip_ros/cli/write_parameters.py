"""Write config/*.yaml and docs/parameters.md from the declared parameters.

Use: ``python -m flexmanip_ros.cli.write_parameters [REPOSITORY]``; it writes into a checkout only.
"""

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from flexmanip_ros.cli import console
from flexmanip_ros.parameters.document import NODES, markdown, yaml_text

PROG = 'write_parameters'


def documents() -> Iterator[tuple[str, str]]:
    """Yield (path below the repository, text) of every file made from the declarations."""
    for node in NODES:
        heading = f'Defaults of {node}, written by flexmanip_ros.cli.write_parameters. Copy what you change.'
        yield f'config/{node}.yaml', yaml_text(node, heading=heading)
    yield 'docs/parameters.md', markdown()


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the files that differ and print their names."""
    made = console.parser(PROG, 'Write config/*.yaml and docs/parameters.md from the declarations.', '')
    made.add_argument('repository', metavar='REPOSITORY', nargs='?', type=Path,
                      default=Path(__file__).resolve().parents[2], help='default: the checkout of this package')
    root: Path = made.parse_args(arguments).repository
    if not root.is_dir():
        made.error(f"directory '{root}' does not exist")
    for name, text in documents():
        path = root / name
        if path.is_file() and path.read_text(encoding='utf-8') == text:
            continue
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding='utf-8')
        print(f'wrote {name}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
