"""A recording as the page shows it: its messages, and what the identifier makes of them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

from flexmanip_ros import messages, pipeline
from flexmanip_ros.errors import BagError
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.types import CaptureEvent, Estimate, JointBlock
from flexmanip_ros.view.screen import Screen, Source, page

MOST_ROWS = 1_000_000
"""Samples that a page on this machine gets: a quarter of an hour at 1 kHz without thinning."""
EMBEDDED_ROWS = 40_000
"""Samples inside a report, which is to stay below some megabytes."""


def show(screen: Screen, estimate: Estimate) -> None:
    """Give an estimate to the screen as the messages that the node would publish."""
    for name, value in messages.outgoing(estimate, ''):
        if name == messages.STATUS and isinstance(value, messages.Diagnostics):
            screen.status(value)


def read(config: IdentifierParameters, items: Iterable[pipeline.Item], source: Source
         ) -> tuple[dict[str, Any], BagError | None]:
    """Identify a recording; return what the page shows of it, and what was wrong with it.

    Of a damaged recording everything before the damage is shown. Raises SignalError when no message can be used, and
    BagError when there is none.
    """
    screen = Screen(source)
    fault: BagError | None = None

    def tapped() -> Iterator[pipeline.Item]:
        nonlocal fault
        try:
            for item in items:
                if isinstance(item, CaptureEvent):
                    screen.event(item)
                else:
                    screen.joint_states(item if isinstance(item, JointBlock) else JointBlock.of(item))
                yield item
        except BagError as error:
            if not screen.samples:
                raise
            fault = error

    for _, estimate in pipeline.replay(config, tapped()):
        if estimate is not None:
            show(screen, estimate)
    return screen.frame(MOST_ROWS) or {}, fault


def embedded(screen: Screen, events: Iterable[CaptureEvent], estimates: Iterable[Estimate]) -> str:
    """Return a page with a recording inside, for a report. screen: it has the joint states already."""
    for event in events:
        screen.event(event)
    for estimate in estimates:
        show(screen, estimate)
    return page(screen.source, screen.frame(EMBEDDED_ROWS) or {}, playing=False)
