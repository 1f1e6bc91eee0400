"""The parameter-varying model at one configuration: matrices, their uncertainty and their status."""

import math
from typing import NamedTuple

import numpy as np

from flexmanip_ros.identification import parameter_varying as lpv
from flexmanip_ros.identification.batch_fit import BLOCK
from flexmanip_ros.identification.prediction_check import MOST_SKEW, vague
from flexmanip_ros.identification.uncertainty import Identified, Tangent, modes
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.samples.sample_log import Rows
from flexmanip_ros.samples.signals import relative_angle
from flexmanip_ros.types import Array, StateSpace, Status

TERMS = 12
"""Number of terms in the exponential series over one sample time, which is at most a sixteenth of a period."""
PERIODS = 1.5
"""Length of the latest samples that give the present configuration, in periods of the mean frequency. The angle then
has an error of 0.08 degrees (rms, default arm), with four times as many samples 0.15 degrees and with half of them 0.3
degrees."""
MISSED = 0.5
"""Largest share of an output's amplitude that the predictions of the last blocks may miss."""
EARLY = 16
"""Number of blocks below which a frequency that is ``vague`` means WARMING_UP, not POORLY_EXCITED."""


class Configurations(NamedTuple):
    """A model of every configuration; ``at`` returns the model at one of them."""

    config: IdentifierParameters
    varying: lpv.Varying
    dt: float
    excitation: float
    innovation_power: float
    singular_values: Array
    condition: float

    def at(self, angles: Array) -> Identified:
        """Return the model at measured angles (2,) [rad], see ``with_relative``."""
        return self.with_relative(float(relative_angle(self.config, angles)))

    def now(self, rows: Rows) -> Identified:
        """Return the model at the configuration at the end of the latest rows, see ``end_of_line``."""
        v, role = self.varying, lpv.shown(self.config)
        assert role is not None
        count = math.ceil(PERIODS * 2.0 * math.pi / (v.shift * self.dt))
        latest = rows.between(max(rows.first, rows.until - count), rows.until)
        longest = 1e9 * max(self.config.max_gap, 2.0 * self.dt)
        jumps = np.flatnonzero(np.diff(latest.stamp_ns) > longest)  # in such a gap the links may have turned
        rows = latest.since(latest.first + 1 + int(jumps[-1])) if jumps.size else latest
        here = rows.missing == 0
        Y, angles = rows.y[:, list(role.displacements)] - v.center, relative_angle(self.config, rows.angles)
        if np.count_nonzero(here) < count // 2:  # too few measured rows
            found = self.with_relative(v.angle)
            if len(rows) == len(latest) or found.status is not Status.TRACKING:
                return found
            return found._replace(status=Status.WARMING_UP, reason='the angle between the links since the last gap is '
                                                                   'not known yet')
        s = np.linspace(-1.0, 0.0, len(rows))
        return self.with_relative(*lpv.end_of_line(s[here], Y[here] * v.scale_y, angles[here]))

    def with_relative(self, angle: float, std: float = 0.0) -> Identified:
        """Return the model where link 2 makes this angle with link 1 [rad]; std: standard deviation of the angle [rad].

        The deviations of the parameters are multiplied by the Birge ratio of the predictions (root of chi square over
        degrees of freedom).
        """
        role = lpv.shown(self.config)
        assert role is not None
        ratio = math.sqrt(max(self.varying.chi2, 1.0))
        model, along = _matrices(self, math.cos(angle), role, ratio, std * math.sin(angle))
        v = self.varying
        rest = np.zeros(model.order)  # the state at rest: C = [I 0]
        rest[list(role.displacements)] = v.center + lpv.part(v.theta, 'b', len(v.scale_y), len(v.scale_u)) / v.scale_y
        found = Identified(
            model=model, constant=rest - model.A @ rest, spread=along.flat(),
            singular_values=self.singular_values, excitation=self.excitation,
            condition=self.condition, innovation_power=self.innovation_power, status=Status.TRACKING,
            refined=True, samples=float(v.blocks * BLOCK), configurations=self)
        status, reason = judge(found, v)
        return found._replace(status=status, reason=reason)


def judge(found: Identified, v: lpv.Varying) -> tuple[Status, str]:
    """Return status and reason, from the predictions of samples before they were fitted and from the deviations."""
    missed = float(v.share.max())
    if missed > MISSED:
        return Status.INCONSISTENT, f'predictions of new samples miss {100.0 * missed:.0f} % of the size of an output'
    oscillations = modes(found)
    if len(oscillations) < len(v.scale_y):
        return Status.INCONSISTENT, 'the model has fewer modes than there are displacements'
    if reason := vague(oscillations):
        return Status.WARMING_UP if v.blocks < EARLY else Status.POORLY_EXCITED, reason
    return Status.TRACKING, ''


def unmodelled(v: lpv.Varying, G: Array) -> tuple[Array, Array]:
    """Return deviations of G and D (h, h, h), one for each mode, that explain what predictions over a block miss.

    A relative frequency error e of a mode w gives the phase error w t e after a time t; over a block of duration T its
    root mean square is w T e / sqrt(3), as a share of the mode's own amplitude. Of the missed power the share 1 - 1 /
    chi2 is not that of white noise. Half of it counts as phase error, half as amplitude error, and either may come from
    any one mode. So a mode that has a hundredth of the power is ten times as uncertain as one that has all of it.
    """
    values, V = np.linalg.eig(G)
    if np.iscomplexobj(values) or not np.all(values > 0.0) or np.linalg.cond(V) > MOST_SKEW:
        values, V = np.ones(len(G)), np.eye(len(G))
    U = np.linalg.inv(V)
    size = np.einsum('kp,pq,kq->k', U, v.power, U)
    share = np.minimum(np.mean(V ** 2 * size / np.diag(v.power)[:, None], axis=0), 1.0)
    w = np.sqrt(values)
    missed = np.mean(v.share ** 2) * (1.0 - 1.0 / max(v.chi2, 1.0))
    error = np.sqrt(1.5 * missed / np.maximum(share, 1e-12)) / (w * v.shift * BLOCK * v.dt)
    shapes = np.einsum('ok,kp->kop', V, U)
    return 2.0 * (error * values)[:, None, None] * shapes, 2.0 * (error * w)[:, None, None] * shapes


def _matrices(read: Configurations, c: float, role: lpv.Roles, ratio: float, std: float) -> tuple[StateSpace, Tangent]:
    """Model at c in JointState units, and its tangent; ratio: factor on the parameters' deviations; std: of c."""
    v = read.varying
    h, r = len(v.scale_y), len(v.scale_u)
    m, n = len(role.states), 2 * h
    G, G1, H, H1, D, E, _ = lpv.local(v.theta, h, r, c, lpv.AT_REST)
    a, b, q = h * h, h * r, 2 * r + 1
    L = lpv.to_local(v.theta, h, r, c, lpv.AT_REST)[:, :len(v.theta)] @ (ratio * v.root[:len(v.theta)])
    of_G, of_D = unmodelled(v, G)
    more = np.zeros((len(L), 2 * h + 1))
    more[:a, :h] = of_G.reshape(h, -1).T
    more[2 * a + 2 * b:3 * a + 2 * b, h:2 * h] = of_D.reshape(h, -1).T
    more[:a, -1], more[2 * a:2 * a + b, -1] = std * G1.ravel(), std * H1.ravel()
    L = np.hstack([L, more])
    M = np.zeros((n + r, n + r))
    M[:h, h:n], M[h:n, :h], M[h:n, h:n], M[h:n, n:] = np.eye(h), -G, -D, H
    turns = np.zeros((2 * a + b, n + r, n + r))  # derivatives of M by the entries of G, D, H
    for i in range(h):
        for j in range(h):
            turns[i * h + j, h + i, j] = turns[a + i * h + j, h + i, h + j] = -1.0
        for j in range(r):
            turns[2 * a + i * r + j, h + i, n + j] = 1.0
    step, by_entry = _exponential(M * (read.dt * v.shift), turns * (read.dt * v.shift))
    entries = np.vstack([L[:a], L[2 * a + 2 * b:3 * a + 2 * b], L[2 * a:2 * a + b]])
    along = np.tensordot(entries.T, by_entry, 1)  # (s, n + r, n + r)
    at_e = 3 * a + 2 * b
    direct = L[[at_e + p * q + i for p in range(h) for i in range(r)]].T.reshape(-1, h, r)
    order = list(role.states) if m == n else list(range(n))
    unit = np.concatenate([1.0 / v.scale_y, v.shift / v.scale_y])[order]
    chosen = np.ix_(order, order)
    A, B = step[chosen], step[np.ix_(order, range(n, n + r))]
    dA, dB = along[:, :n, :n][:, chosen[0], chosen[1]], along[:, order, n:]
    C = np.eye(m, n)
    rows = [k for k, state in enumerate(role.states) if state < h]
    of = [role.states[k] for k in rows]
    feed, d_feed = np.zeros((m, r)), np.zeros((len(dA), m, r))
    feed[rows], d_feed[:, rows] = E[of, :r], direct[:, of]
    in_units = v.scale_u / v.scale_y[of][:, None]
    feed[rows] *= in_units
    d_feed[:, rows] *= in_units
    turned = unit[:, None] / unit
    model = StateSpace(A * turned, B * unit[:, None] * v.scale_u, C, feed, np.zeros((n, m)), read.dt)
    return model, Tangent(dA * turned, dB * unit[:, None] * v.scale_u, np.zeros((len(dA), m, n)), d_feed,
                          np.zeros((len(dA), n, m)))


def _exponential(M: Array, turns: Array) -> tuple[Array, Array]:
    """exp(M) (q, q) and its derivatives along ``turns`` (e, q, q), from their power series."""
    term, along = np.eye(len(M)), np.zeros_like(turns)
    total, by = term.copy(), along.copy()
    for j in range(1, TERMS + 1):
        along = (turns @ term + M @ along) / j
        term = M @ term / j
        total += term
        by += along
    return total, by
