"""Compiled part of the modes beyond kappa: whether the arm has them, what they show, how they push.

A real arm has them, an arm of exactly kappa modes a link has not, and the filter's equations have none. At
every step of the torque they ring; what the innovations have in common with that tells the two kinds of arm
apart (a score test) long before their power does. And they push the other coordinates aside.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexmanip_ros.arm.acceleration import solve
from flexmanip_ros.numerics.compiled import inlined
from flexmanip_ros.payload.filter_state import ODDS, SHOWN, TOLD
from flexmanip_ros.types import Array

if TYPE_CHECKING:
    from flexmanip_ros.payload.filter_state import Memory
    from flexmanip_ros.payload.process_model import Motion


class Tail(NamedTuple):
    """a oscillators z'' + damping z' + square z = load . torque, read by m sensors; n kept coordinates."""

    square: Array
    """(a,) squared frequency."""
    damping: Array
    """(a,) below critical."""
    load: Array
    """(a, 2)."""
    output: Array
    """(m, a) of z, or of z' where the sensor reads rates."""
    row: NDArray[np.int64]
    """(m,) 0: z, 1: z'."""
    push: Array
    """(2, n, 2) momentum of the kept coordinates by the torques held, M_rt K_t^-1 B_t: with joint 2 at a
    right angle, and what the cosine of its angle adds."""


@inlined
def ring(tail: Tail, m: Memory, duration: float, effort: Array) -> None:
    """Carry the departure of each oscillator from where the torque holds it over a time, exactly."""
    first, second = effort[0] - m.torque[0], effort[1] - m.torque[1]
    for i in range(tail.square.size):
        z = m.tail[0, i] - (tail.load[i, 0] * first + tail.load[i, 1] * second) / tail.square[i]
        v = m.tail[1, i]
        half = tail.damping[i] / 2.0
        omega = np.sqrt(tail.square[i] - half * half)
        shrink = np.exp(-half * duration)
        c = shrink * np.cos(omega * duration)
        s = shrink * np.sin(omega * duration) / omega
        m.tail[0, i] = z * c + (v + half * z) * s
        m.tail[1, i] = v * c - (half * v + tail.square[i] * z) * s


@inlined
def ringing(tail: Tail, m: Memory, i: int) -> float:
    """What sensor i would read more if the arm had these modes; where the torque holds them is known."""
    value = 0.0
    for a in range(tail.square.size):
        value += tail.output[i, a] * m.tail[tail.row[i], a]
    return value


@inlined
def believed(score: Array) -> float:
    """Probability that the arm has modes beyond kappa that matter.

    Either their amplitude a is 0, or it is of the prior N(0, 1); SHOWN ~ N(a TOLD, TOLD): the Bayes factor.
    """
    told = score[TOLD]
    shown = max(score[SHOWN], 0.0)
    evidence = score[ODDS] + 0.5 * (shown * shown / (1.0 + told) - np.log(1.0 + told))
    return float(1.0 / (1.0 + np.exp(-min(max(evidence, -50.0), 50.0))))


@inlined
def amplitude(score: Array) -> float:
    """How much of the ringing to expect: 0 of none, 1 of all. Frequencies a little off show less of it."""
    shown: float = max(score[SHOWN], 0.0) / (1.0 + score[TOLD])
    return believed(score) * min(shown, 1.0)


@inlined
def push(motion: Motion, tail: Tail, x: Array, before: Array, effort: Array, share: float) -> None:
    """Set the kept coordinates aside at a step of the torque from ``before``, by a share of what a tail does.

    Seen from the slow motion, the tail goes at once where the torque holds it, and no momentum comes from
    outside: M_rr dq_r = -M_rt deta_t. Right after ``predict``, which leaves the factor of M_rr.
    """
    first, second = share * (effort[0] - before[0]), share * (effort[1] - before[1])
    if first == 0.0 and second == 0.0:
        return
    c = np.cos(x[1] - x[0])
    moved = motion.a
    for i in range(moved.size):
        moved[i] = -((tail.push[0, i, 0] + c * tail.push[1, i, 0]) * first
                     + (tail.push[0, i, 1] + c * tail.push[1, i, 1]) * second)
    solve(motion.work.M, moved)
    for i in range(moved.size):
        x[i] += moved[i]
