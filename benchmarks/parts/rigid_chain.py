"""An independent arm: each link a chain of rigid rods with torsion springs, no dynamics of the package.

The payload benchmarks take their mismatched truth from here. Absolute rod angles p,
mass matrix a_ij cos(p_i - p_j), exact kinematics, momentum conserved at a capture.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.linalg import eigh

from flexmanip_ros.parameters import ArmParameters


class Record(NamedTuple):
    """Noise-free signals, one row a sample; columns joint1, joint2, link1_bend, link2_bend."""

    position: np.ndarray
    velocity: np.ndarray
    effort: np.ndarray


@njit(cache=True)
def _acceleration(a, K, beta, Q, p, pd, out, M, c, s):
    n = p.size
    for i in range(n):
        c[i] = np.cos(p[i])
        s[i] = np.sin(p[i])
    for i in range(n):
        f = Q[i]
        for j in range(n):
            f -= K[i, j] * (p[j] + beta * pd[j])
            f -= a[i, j] * (s[i] * c[j] - c[i] * s[j]) * pd[j] * pd[j]
        out[i] = f
        for j in range(i + 1):
            M[i, j] = a[i, j] * (c[i] * c[j] + s[i] * s[j])
    for j in range(n):
        for q in range(j):
            w = M[j, q]
            for r in range(j, n):
                M[r, j] -= M[r, q] * w
        d = np.sqrt(M[j, j])
        for r in range(j, n):
            M[r, j] /= d
    for r in range(n):
        for q in range(r):
            out[r] -= M[r, q] * out[q]
        out[r] /= M[r, r]
    for r in range(n - 1, -1, -1):
        for q in range(r + 1, n):
            out[r] -= M[q, r] * out[q]
        out[r] /= M[r, r]


@njit(cache=True)
def _run(a, K, beta, B, p, pd, efforts, dt, steps, P, PD):
    n = p.size
    k1, k2, k3, k4 = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    M, c, s = np.zeros((n, n)), np.zeros(n), np.zeros(n)
    h = dt / steps
    for k in range(efforts.shape[0]):
        P[k] = p
        PD[k] = pd
        Q = B[:, 0] * efforts[k, 0] + B[:, 1] * efforts[k, 1]
        for _ in range(steps):
            _acceleration(a, K, beta, Q, p, pd, k1, M, c, s)
            _acceleration(a, K, beta, Q, p + h / 2 * pd, pd + h / 2 * k1, k2, M, c, s)
            _acceleration(a, K, beta, Q, p + h / 2 * pd + h * h / 4 * k1, pd + h / 2 * k2, k3, M, c, s)
            _acceleration(a, K, beta, Q, p + h * pd + h * h / 2 * k2, pd + h * k3, k4, M, c, s)
            p += h * pd + h * h / 6 * (k1 + k2 + k3)
            pd += h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


class Chain:
    """The arm with ``hinges`` hinges a link, half rods at the ends: bending by the midpoint rule."""

    def __init__(self, arm: ArmParameters, hinges: int = 20) -> None:
        rods = hinges + 1
        self.arm, self.rods = arm, rods
        shares = np.full(rods, 1.0 / hinges)
        shares[[0, -1]] /= 2
        self.length = np.concatenate([L * shares for L in arm.link_length])
        rho = np.repeat(arm.linear_density, rods)
        EI = np.repeat(arm.bending_stiffness, rods)
        self.mass = rho * self.length
        n = 2 * rods
        self.K = np.zeros((n, n))
        for i in [*range(rods - 1), *range(rods, n - 1)]:
            k = EI[i] / max(self.length[i:i + 2])
            self.K[i:i + 2, i:i + 2] += k * np.array([[1.0, -1.0], [-1.0, 1.0]])
        first = max((np.pi / L) ** 2 * np.sqrt(e / r) for L, e, r in zip(
            arm.link_length, arm.bending_stiffness, arm.linear_density, strict=True))
        self.beta = 2 * arm.damping_ratio / first
        self.B = np.zeros((n, 2))
        self.B[0, 0] = self.B[rods, 1] = 1.0
        self.B[rods - 1, 1] = -1.0
        poles = eigh(self.K, self.inertia(0.0), eigvals_only=True)
        self.fastest = float(np.sqrt(poles[-1]) * (1 + self.beta * np.sqrt(poles[-1])))

    def inertia(self, payload: float) -> np.ndarray:
        """Coefficients a_ij of the mass matrix."""
        n, length = 2 * self.rods, self.length
        lumps = np.zeros(n)
        lumps[self.rods - 1], lumps[-1] = self.arm.joint_mass, self.arm.tip_mass + payload
        beyond = np.cumsum((self.mass + lumps)[::-1])[::-1] - self.mass
        a = np.zeros((n, n))
        for j in range(n):
            a[j, j] = self.mass[j] * length[j] ** 2 / 3 + length[j] ** 2 * beyond[j]
            a[:j, j] = a[j, :j] = length[:j] * length[j] * (self.mass[j] / 2 + beyond[j])
        return a

    def simulate(
        self, theta: tuple[float, float], effort: Callable[[float], np.ndarray], samples: int,
        events: dict[int, float], dt: float = 1e-3, rates: tuple[float, float] = (0.0, 0.0),
        object_velocity: tuple[float, float] = (0.0, 0.0),
    ) -> Record:
        """Run; events: sample index -> payload [kg] held from there on."""
        n = 2 * self.rods
        p = np.repeat(theta, self.rods).astype(float)
        pd = np.repeat(rates, self.rods).astype(float)
        efforts = np.array([effort(k * dt) for k in range(samples)])
        P, PD = np.zeros((samples, n)), np.zeros((samples, n))
        steps = int(np.ceil(self.fastest * dt / 1.8))
        held = 0.0
        marks = [0, *sorted(events), samples]
        for start, stop in pairwise(marks):
            if start in events:
                mass = events[start]
                before, after = self.inertia(held), self.inertia(max(mass, held))
                angle = np.cos(p[:, None] - p[None, :])
                along, across = object_velocity
                push = self.length * (np.cos(p) * across - np.sin(p) * along)
                if mass > held:
                    pd = np.linalg.solve(after * angle, (before * angle) @ pd + (mass - held) * push)
                held = mass
            if stop > start:
                _run(self.inertia(held), self.K, self.beta, self.B, p, pd, efforts[start:stop], dt, steps,
                     P[start:stop], PD[start:stop])
        return self.signals(P, PD, efforts)

    def signals(self, P: np.ndarray, PD: np.ndarray, efforts: np.ndarray) -> Record:
        """Angles of the first rods, the second against the last of link 1, and bends from the chords."""
        r = self.rods
        position = np.zeros((P.shape[0], 4))
        velocity = np.zeros_like(position)
        position[:, 0], velocity[:, 0] = P[:, 0], PD[:, 0]
        position[:, 1], velocity[:, 1] = P[:, r] - P[:, r - 1], PD[:, r] - PD[:, r - 1]
        for link in range(2):
            part = slice(link * r, (link + 1) * r)
            step = self.length[part] * np.exp(1j * P[:, part])
            rate = step * 1j * PD[:, part]
            end, end_d = step.sum(1), rate.sum(1)
            edges = np.concatenate([[0.0], np.cumsum(self.length[part])])
            share = np.clip(self.arm.sensor_position[link] * edges[-1] - edges[:-1], 0.0, self.length[part])
            point, point_d = step @ (share / self.length[part]), rate @ (share / self.length[part])
            unit = end / np.abs(end)
            local = point * np.conj(unit)
            turn = (end_d * np.conj(end)).imag / np.abs(end) ** 2
            position[:, 2 + link] = local.imag
            velocity[:, 2 + link] = (point_d * np.conj(unit)).imag - turn * local.real
        return Record(position, velocity, efforts)


def noisy(record: Record, snr_db: float, rng: np.random.Generator) -> Record:
    """White noise at a signal-to-noise ratio of every signal's variation."""
    share = 10 ** (-snr_db / 20)
    return Record(*(
        clean + rng.normal(size=clean.shape) * clean.std(axis=0) * share
        for clean in (record.position, record.velocity)), record.effort)
