"""Write config/*.yaml and docs/parameters.md from the declared parameters.

Use: ``python docs/write_parameters.py`` (``make docs``).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from flexmanip_ros.parameters.document import NODES, markdown, yaml_text

ROOT = Path(__file__).resolve().parents[1]


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
