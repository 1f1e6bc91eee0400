"""The payload against the modes of the identified model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexmanip_ros.identification.uncertainty import Identified
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.payload import filter_state as mem
from flexmanip_ros.payload.arm_modes import ArmModes, arm_modes, modal_participation
from flexmanip_ros.payload.interval import QUANTILE
from flexmanip_ros.payload.process_model import PARAMETERS
from flexmanip_ros.payload.structured import StructuredState
from flexmanip_ros.payload.structured_model import Model, Quantity
from flexmanip_ros.samples.sample_log import Rows
from flexmanip_ros.types import Array, Mode, Payload, Status

ANOTHER = 0.2
"""Relative distance beyond which an identified frequency is that of another mode."""
DEVIATIONS = 4.0
"""Standard deviations that the two may differ by, and beside them what no deviation knows:"""
FREQUENCY, DRIVE = 0.006, 0.035
"""relative errors of frequencies and drives of a few modes where an arm has many,"""
FREQUENCY_MOVED, DRIVE_MOVED, STILL = 0.1, 5.0, 0.045
"""and what is added for each radian that the arm turned, to drives beyond STILL [rad]."""
VAGUE = 0.02
"""Relative deviation of a drive beyond which it is not compared: it is biased by far more than that."""
STEP = 1e-4
"""Of derivatives by the logarithms of payload and stiffness."""
PAYLOADS = np.concatenate([[0.0], np.geomspace(1e-3, 1e4, 71)])
"""Payloads whose frequencies are looked at, over the lightest tip mass."""
AGREES = 0.5
"""Deviation below which a model ends what was found of the arm before."""


class Verdict(NamedTuple):
    """What a model says of the payload that was estimated without it."""

    at: int
    """Stamp at which the model was read [ns]."""
    since: int
    """Stamp of the event that model and payload date from [ns]."""
    held: bool
    """Whether the arm was to hold something."""
    deviation: float
    """Largest difference over what is tolerated: beyond 1 they disagree."""
    doubt: float = 0.0
    """Relative error of the arm's inertia that the drive of the modes shows; 0 where that agrees."""
    lower: float = math.inf
    upper: float = -math.inf
    """Payloads [kg] at which the arm has the frequencies; no limits where those agree."""
    clears: bool = False
    """Whether it agrees so well in all of it that what was found of the empty arm is over."""


class Known(NamedTuple):
    """What ``structured`` knows of the arm: its modes over all configurations, and how well.

    The first rows of ``arm`` are configurations, the first of them the one now; three more are the
    one now after a step of payload and stiffness factors, whose deviations stand in the rows of ``spread``.
    """

    arm: ArmModes
    cosines: Array
    spread: Array
    moved: float
    """Angle [rad] through which the arm turned."""

    @property
    def configurations(self) -> int:
        """How many configurations."""
        return int(self.cosines.size)

    def off(self, found: Array, values: Array) -> Array:
        """How far each of found (j,) is outside of what values (configurations + 3, j) are over these."""
        band = values[:self.configurations]
        return found - np.clip(found, band.min(axis=0), band.max(axis=0))

    def uncertain(self, values: Array, noise: Array) -> Array:
        """Deviations (j,) by what is learned and by the noise (j,) of the model; values: relative to now."""
        by_learned = (values[self.configurations:] - 1.0).T / STEP @ self.spread
        deviations: Array = np.hypot(noise, np.linalg.norm(by_learned, axis=1))
        return deviations


def compare(config: IdentifierParameters, model: Model, m: mem.FilterState, payload: Payload,
            configuration_range: Array,
            identified: Identified, modes: Sequence[Mode]) -> Verdict | None:
    """Compare frequencies and drives; None where the identified model has not the modes for it."""
    known = _known(config, model, m, payload, configuration_range)
    nearest = _matched(known.arm.frequency[0], modes)
    if nearest is None:
        return None
    deviation, lower, upper = _frequencies(config, model, m, known, [modes[k] for k in nearest])
    by_drives, doubt, whole = _drives(config, model, known, identified, np.array(nearest))
    deviation = max(deviation, by_drives)
    if not math.isfinite(deviation):
        return None
    return Verdict(0, 0, bool(m.counts[mem.HELD]), deviation, doubt, lower, upper,
                   clears=whole and deviation < AGREES)


def _known(config: IdentifierParameters, model: Model, m: mem.FilterState, payload: Payload, configuration_range: Array
           ) -> Known:
    """Gather what is known of the arm."""
    learned = m.x.size - PARAMETERS + np.arange(3)
    cosines = _configurations(config, model, m, configuration_range)
    arm = _predicted(config, model, m, np.append(cosines, cosines[:1].repeat(3)),
                     np.vstack([np.zeros((cosines.size, 3)), STEP * np.eye(3)]))
    spread = m.S[learned].copy()
    deviation = float(np.linalg.norm(spread[0]))
    if m.counts[mem.HELD] and deviation > 0.0 and payload.mass > 0.0:
        spread[0] *= max(1.0, payload.std / payload.mass / deviation)
    turned = math.acos(max(configuration_range[0], -1.0)) - math.acos(min(configuration_range[1], 1.0))
    return Known(arm, cosines, spread, max(turned, float(configuration_range[3] - configuration_range[2])))


def _frequencies(config: IdentifierParameters, model: Model, m: mem.FilterState, known: Known,
                 modes: Sequence[Mode]) -> tuple[float, float, float]:
    """Return by how much the lowest two frequencies disagree, and between which payloads they would not."""
    here = known.arm.frequency[0, :2]
    found = np.array([mode.frequency_hz / math.sqrt(1.0 - mode.damping_ratio ** 2) for mode in modes])
    noise = np.array([mode.frequency_std_hz for mode in modes]) / here
    off = known.off(found, known.arm.frequency[:, :2]) / here
    allowed = FREQUENCY + FREQUENCY_MOVED * known.moved + DEVIATIONS * known.uncertain(
        known.arm.frequency[:, :2] / here, noise)
    deviation = float(np.max(np.abs(off) / allowed))
    if deviation > 1.0:
        outside = np.flatnonzero(np.abs(off) > allowed)
        return deviation, *_payloads(config, model, m, known.cosines, found, allowed, outside)
    return deviation, math.inf, -math.inf


def _drives(config: IdentifierParameters, model: Model, known: Known, identified: Identified,
            nearest: Array) -> tuple[float, float, bool]:
    """Return by how much the drives of the modes disagree, the doubt of them, whether all were compared."""
    rows = _bend_rows(model, len(config.outputs))
    if rows is None:
        return 0.0, 0.0, False
    index, links, rates = rows
    # sums over modes and bend sensors, weighted so that those of the arm here are one
    parts = known.arm.drive[:, links]
    seen = parts.sum(axis=2)
    weights = seen[0] / np.maximum((seen[0] ** 2).sum(axis=0), np.finfo(float).tiny)
    sums = (weights * seen).sum(axis=1)
    cancelled = (np.abs(weights) * np.abs(parts[0]).sum(axis=1)).sum(axis=0)  # 1: no part against another
    value, noise = modal_participation(identified, nearest, index, rates, weights)
    off = known.off(value, sums)
    tolerated = DRIVE + DRIVE_MOVED * max(0.0, known.moved - STILL)
    allowed = cancelled * tolerated + DEVIATIONS * known.uncertain(sums, noise)
    excess = np.where(noise < VAGUE, np.abs(off) / allowed, 0.0)
    doubt = float(np.max(np.abs(off)[excess > 1.0])) if excess.max() > 1.0 else 0.0
    return float(excess.max()), doubt, bool(np.all(noise < VAGUE))


def _configurations(config: IdentifierParameters, model: Model, m: mem.FilterState, configuration_range: Array
                    ) -> Array:
    """Return cosines between the links: now, and those between which the arm was since the event."""
    point = config.payload.working_point
    if model.motion.frozen and len(point) == 2:
        return np.array([math.cos(point[1] - point[0])])
    between = [0.0] if configuration_range[0] < 0.0 < configuration_range[1] else []  # frequencies depend on the square
    return np.array([math.cos(m.x[1] - m.x[0]), configuration_range[0], configuration_range[1], *between])


def _predicted(config: IdentifierParameters, model: Model, m: mem.FilterState, cosines: Array, steps: Array,
               masses: Array | None = None) -> ArmModes:
    """Return the modes of the arm as learned; steps: (j, 3) away from what is known, as logarithms."""
    n, h = model.motion.q.size, model.motion.q.size - 2
    p = m.x.size - PARAMETERS
    deviations = np.zeros((2, h // 2))
    deviations[:, 1:] = m.x[2 * n:p].reshape(2, -1)
    stiffness = np.exp((m.x[p + 1:p + 3] + steps[:, 1:])[:, :, None] + deviations).reshape(len(steps), h)
    held = bool(m.counts[mem.HELD])
    if masses is None:
        here = m.x[p] + steps[:, 0] * (1.0 if held else model.motion.scale)
        masses = (model.motion.scale * np.exp(np.minimum(here, 12.0)) if held
                  else np.maximum(here, model.motion.least))
    inertia = model.motion.inertia * math.exp(min(m.x[-1], 12.0)) if held else 0.0
    return arm_modes(config.arm, cosines, masses, np.full(cosines.size, inertia), stiffness)


def _matched(frequency: Array, modes: Sequence[Mode]) -> list[int] | None:
    """Return which identified modes are the lowest two of the arm, in order; None when they are not there."""
    usable = [k for k, mode in enumerate(modes) if mode.frequency_hz > 0.0 and abs(mode.damping_ratio) < 0.5
              and math.isfinite(mode.frequency_std_hz)]
    found = np.array([modes[k].frequency_hz for k in usable])
    away = np.abs(np.log(found[:, None] / frequency[:3]))
    pairs = [(away[i, 0] + away[j, 1], i, j) for i in range(len(usable)) for j in range(i + 1, len(usable))]
    if not pairs:
        return None
    _, i, j = min(pairs)
    if max(away[i, 0], away[j, 1]) > ANOTHER or (frequency.size > 2 and away[j, 2] < away[j, 1]):
        return None
    return [usable[i], usable[j]]


def _payloads(config: IdentifierParameters, model: Model, m: mem.FilterState, cosines: Array, found: Array,
              allowed: Array, which: NDArray[np.int64]) -> tuple[float, float]:
    """Return between which payloads the arm has the frequencies found, each mode by itself."""
    masses = model.motion.scale * PAYLOADS
    many = _predicted(config, model, m, np.repeat(cosines, masses.size),
                      np.zeros((cosines.size * masses.size, 3)), np.tile(masses, cosines.size))
    frequency = many.frequency[:, :2].reshape(cosines.size, masses.size, 2)
    lower, upper = math.inf, -math.inf
    for k in which:
        low = frequency[:, :, k].min(axis=0) * (1.0 - allowed[k])
        high = frequency[:, :, k].max(axis=0) * (1.0 + allowed[k])
        fits = np.flatnonzero((low <= found[k]) & (found[k] <= high))
        if fits.size == 0:  # higher than empty, or lower than with anything
            fits = np.array([0 if found[k] > high.max() else masses.size - 1])
        lower = min(lower, float(masses[max(fits[0] - 1, 0)]))
        upper = max(upper, float(masses[fits[-1] + 1]) if fits[-1] + 1 < masses.size else math.inf)
    return lower, upper


def _bend_rows(model: Model, outputs: int) -> tuple[Array, Array, Array] | None:
    """Return outputs that are bends (their rates where no displacement is), of which link, and if rates."""
    for quantity in (Quantity.BEND, Quantity.BEND_RATE):
        rows = [k for k, role in enumerate(model.roles[:outputs]) if role.quantity is quantity]
        if rows:
            links = np.array([model.roles[k].link for k in rows])
            return np.array(rows), links, np.full(len(rows), quantity is Quantity.BEND_RATE)
    return None


EVERY = 32
"""Of so many samples one tells where the arm is."""
LEAST = 1000.0
"""Samples behind a fit that is compared."""
BELIEVED = (Status.TRACKING, Status.POORLY_EXCITED, Status.INCONSISTENT)


def extend_range(before: Array, rows: Rows, relative: bool) -> Array:
    """Return where the arm was since the event, after more rows; relative: angle 2 is from link 1 on.

    (5,) smallest and largest cosine of the angle between the links, then angle of joint 1 [rad]; samples.
    """
    count = int(before[4]) if before.size else 0
    after = before.copy() if before.size else np.array([1.0, -1.0, math.inf, -math.inf, 0.0])
    angles = rows.angles
    if angles.shape[1] != 2:
        return before
    for first, second in angles[-count % EVERY::EVERY].tolist():
        cosine = math.cos(second if relative else second - first)
        after[0], after[1] = min(after[0], cosine), max(after[1], cosine)
        after[2], after[3] = min(after[2], first), max(after[3], first)
    after[4] = count + len(rows)
    return after


def remember(verdicts: tuple[Verdict, ...], new: Verdict | None, reach: int) -> tuple[Verdict, ...]:
    """Return the verdicts that may still be asked for: of the arm when it was empty, and the latest.

    reach: time [ns] that an event may come late; what was read meanwhile may turn out to date from after it.
    """
    if new is None:
        return verdicts
    kept = [old for old in verdicts if not old.held and old.at < new.at
            and (old.at < new.since or old.since == new.since)]
    while len(kept) > 1 and kept[1].at < new.at - reach:
        kept = kept[1:]
    return (*kept, new)


def check(config: IdentifierParameters, state: StructuredState | None, payload: Payload | None,
          configuration_range: Array,
          identified: Identified, modes: Sequence[Mode], at: int = 0, since: int = 0) -> Verdict | None:
    """Compare an identified model with the arm as ``structured`` knows it; None where nothing can be said.

    payload: as estimated without the model; configuration_range: see ``extend_range``; modes: of the identified model;
    at, since:
    stamps now and of the last event [ns]. Only a refined fit of some length is compared, and only with an
    estimate that claims something.
    """
    if state is None or state.model is None or state.memory is None or payload is None or configuration_range.size == 0:
        return None
    if (identified.status is not Status.TRACKING or not identified.refined or identified.samples < LEAST
            or payload.status not in BELIEVED):
        return None
    try:
        found = compare(config, state.model, state.memory, payload, configuration_range, identified, modes)
    except np.linalg.LinAlgError:
        return None
    return found if found is None else found._replace(at=at, since=since)


def apply(state: StructuredState, payload: Payload, verdicts: tuple[Verdict, ...], since: int) -> Payload:
    """Return the payload with the interval that the latest verdict leaves it. since: stamp of the last event.

    One that dates from the same event counts. So does what was found of the arm when it was last empty,
    until a model since the event agrees well.
    """
    if not verdicts or state.memory is None or state.model is None or payload.status not in BELIEVED:
        return payload
    m = state.memory
    own = verdicts[-1] if verdicts[-1].since == since else None
    empty = next((one for one in reversed(verdicts) if one.at < since and not one.held), None)
    disagree = own is not None and own.deviation > 1.0
    doubt = own.doubt if own is not None else 0.0
    if empty is not None and (own is None or not own.clears):
        doubt = max(doubt, empty.doubt)
    if not disagree and doubt == 0.0:
        return payload
    if not m.counts[mem.HELD]:  # an arm that does not move as an empty one may hold anything
        return payload._replace(lower=0.0, upper=math.inf, std=math.inf, status=Status.INCONSISTENT)
    std = math.hypot(payload.std, doubt * (payload.mass + state.model.motion.scale))
    lower, upper = payload.mass - QUANTILE * std, payload.mass + QUANTILE * std
    if own is not None:
        lower, upper = min(lower, own.lower), max(upper, own.upper)
    return payload._replace(std=std, status=Status.INCONSISTENT,
                            lower=max(0.0, min(payload.lower, lower)), upper=max(payload.upper, upper))
