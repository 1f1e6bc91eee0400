"""Colours of lines and of statuses, for figures and for the live page.

They are those of Okabe and Ito, which people with any colour vision can tell apart.
"""

from __future__ import annotations

from flexmanip_ros.types import Status

COLOURS = ('#0072B2', '#D55E00', '#009E73', '#CC79A7', '#E69F00', '#56B4E9', '#7F7F7F', '#000000')
PAYLOAD_COLOUR = '#009E73'
EVENT_COLOUR = '#AA0000'
STATUS_LOOKS: dict[Status, tuple[str, str]] = {
    Status.WARMING_UP: ('#C8C8C8', '..'), Status.TRACKING: ('#009E73', ''), Status.POORLY_EXCITED: ('#E69F00', '//'),
    Status.ILL_CONDITIONED: ('#CC79A7', 'xx'), Status.INCONSISTENT: ('#D55E00', '\\\\'),
    Status.UNOBSERVABLE: ('#7F7F7F', '++'), Status.DIVERGED: ('#000000', 'OO'), Status.ORDER_TOO_LOW: ('#F0E442', '**'),
}
"""Colour and hatch of each status, so that they differ by more than their colour."""
MODES_APART = 4.0
"""Ratio to the lowest frequency above which a mode does not set the range of a plot [-]."""
