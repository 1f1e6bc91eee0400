"""HTML pages in one file, with their pictures and tables inside."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Sequence
from html import escape
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from flexmanip_ros.types import Array

STYLE = """
body{font:16px/1.5 system-ui,sans-serif;color:#1a1a1a;max-width:1100px;margin:2rem auto;padding:0 1rem}
h1{font-size:1.6rem;margin-bottom:.2rem}h2{font-size:1.2rem;margin-top:2.2rem;border-bottom:1px solid #ddd}
img{width:100%;height:auto}iframe{width:100%;height:760px;border:1px solid #ddd}
table{border-collapse:collapse;margin:.6rem 0;font-size:.9rem}
th,td{padding:.2rem .7rem;text-align:left;border-bottom:1px solid #e6e6e6;vertical-align:top}
td.n{text-align:right;font-variant-numeric:tabular-nums;white-space:nowrap}
nav a{margin-right:1rem}.note{color:#555}.changed{background:#fff3d6}div.wide{overflow-x:auto}
.answer{font-size:1.25rem;font-weight:600}
caption{text-align:left;font-weight:600;padding:.3rem 0}
"""


class Section(NamedTuple):
    """A heading and the HTML below it."""

    title: str
    body: str


def page(title: str, lead: str, sections: Sequence[Section]) -> str:
    """Return a whole page with a contents list. ``title`` and ``lead`` are plain text."""
    links = ''.join(f'<a href="#s{k}">{escape(section.title)}</a>' for k, section in enumerate(sections))
    parts = ''.join(f'<h2 id="s{k}">{escape(section.title)}</h2>{section.body}' for k, section in enumerate(sections))
    return (f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
            f'<meta name="viewport" content="width=device-width"><style>{STYLE}</style></head><body>'
            f'<h1>{escape(title)}</h1><p class="note">{escape(lead)}</p><nav>{links}</nav>{parts}'
            '</body></html>\n')


def picture(drawn: Figure, words: str) -> str:
    """Return a figure as an inline image."""
    return image(png(drawn), words)


def png(drawn: Figure) -> bytes:
    """Return a figure as PNG."""
    buffer = io.BytesIO()
    drawn.savefig(buffer, format='png')
    return buffer.getvalue()


def image(data: bytes, words: str) -> str:
    """Return a PNG as an inline image. words: its description for readers who cannot see it."""
    text = base64.b64encode(data).decode('ascii')
    return f'<img alt="{escape(words)}" src="data:image/png;base64,{text}">'


def frame(page: str, words: str) -> str:
    """Return a whole page inside another, with scripts and styles of its own. words: its description."""
    return f'<iframe title="{escape(words)}" srcdoc="{escape(page)}"></iframe>'


def table(header: Sequence[str], rows: Iterable[Sequence[Any]], caption: str = '', digits: int = 5) -> str:
    """Return a table. Numbers are rounded to ``digits`` significant ones and right-aligned, texts are escaped."""
    head = ''.join(f'<th>{escape(name)}</th>' for name in header)
    body = ''.join('<tr>' + ''.join(_cell(value, digits) for value in row) + '</tr>' for row in rows)
    top = f'<caption>{escape(caption)}</caption>' if caption else ''
    return f'<div class="wide"><table>{top}<tr>{head}</tr>{body}</table></div>'


def number(value: Any, digits: int = 5) -> str:
    """Return a number as text for people; None and nan give a dash."""
    if value is None or (isinstance(value, float) and np.isnan(value)):
        return '\N{EN DASH}'
    return str(value) if isinstance(value, (int, str)) else f'{float(value):.{digits}g}'


def plain(value: float | None, digits: int = 2) -> str:
    """Return a number as text with few digits and without an exponent; None and nan give a dash."""
    if value is None or np.isnan(value):
        return '\N{EN DASH}'
    return np.format_float_positional(value, precision=digits, fractional=False, trim='-')


def _cell(value: Any, digits: int) -> str:
    if value is None or isinstance(value, (int, float, np.number)):
        return f'<td class="n">{number(value, digits)}</td>'
    return f'<td>{escape(str(value))}</td>'


def matrix(name: str, values: Array, rows: Sequence[str] = (), columns: Sequence[str] = ()) -> str:
    """Return a matrix as a table. rows, columns: names of its rows and columns, x1, x2, ... where there are none."""
    header = ['', *(columns or [f'x{k + 1}' for k in range(values.shape[1])])]
    labels = rows or [f'x{k + 1}' for k in range(values.shape[0])]
    return table(header, [[label, *row] for label, row in zip(labels, values.tolist(), strict=True)], name)
