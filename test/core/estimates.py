"""Estimates of ``pipeline.step`` as a replay gives them."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import groupby

from flexmanip_ros.types import Estimate


def one_a_stamp(estimates: Iterable[Estimate]) -> list[Estimate]:
    """Return payload and model of one stamp in one estimate; it tells the arm's parameters if either does."""
    found = []
    for _, group in groupby(estimates, key=lambda estimate: estimate.stamp_ns):
        *before, last = group
        arms = (one.arm_parameters for one in (last, *before))
        found.append(last._replace(payload_is_new=True, arm_parameters=next(filter(None, arms), ())))
    return found


def bits(estimate: Estimate | None) -> tuple[object, ...]:
    """All that an estimate says, to the bit."""
    if estimate is None:
        return ()
    parts = () if estimate.model is None else tuple(
        getattr(estimate.model, name).tobytes() for name in ('A', 'B', 'C', 'D', 'K'))
    return estimate.stamp_ns, estimate.status, parts, repr(estimate.modes), repr(estimate.payload)
