"""Cramer-Rao bounds of all that is unknown of arm and object, from before the capture on.

The filter's own Jacobians carry the derivative of the state; see ``flexmanip_ros.payload.cramer_rao``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from flexmanip_ros.arm.capture import Body, body_jacobian, free_object, rates_after, tip_angle, tip_jacobian
from flexmanip_ros.arm.linearization import mass_matrix, momentum
from flexmanip_ros.parameters import IdentifierParameters, PlantParameters
from flexmanip_ros.payload import structured_model
from flexmanip_ros.payload.arm_parameters import NAMES
from flexmanip_ros.payload.cramer_rao import gathered, posterior, start
from flexmanip_ros.payload.interval import about_com
from flexmanip_ros.payload.process_model import Kind, set_parameters, spread_scratch
from flexmanip_ros.payload.structured_model import Model
from flexmanip_ros.types import Array

DIFFERENCE = 1e-4
"""Step of a difference, in prior standard deviations."""


def everything(
    config: IdentifierParameters, plant: PlantParameters, efforts: Array, capture: int, noise_std: Array,
    counts: Sequence[int],
) -> dict[str, Array]:
    """Return a bound after each of ``counts`` samples of all that is unknown, by name, in SI units.

    First what ``payload.learn`` names, as ``arm_parameters.taught`` names it, then payload_mass, payload_com_x,
    payload_com_y, payload_inertia (about the centre of mass), and object_spin before the capture. The arm of
    ``plant`` begins at rest and takes the plant's object before sample ``capture``, momentum conserved. What is
    unknown has the estimator's priors (posterior Cramer-Rao bound, Van Trees). efforts: (N, L) reported; noise_std
    as for ``nonlinear``. Raises ModelError where the configured signals cannot give a payload.
    """
    config = replace(config, arm=plant.arm)
    model, m = start(config, np.array(plant.initial_angles))
    n, size = model.motion.arm.stiffness.size, m.x.size
    body, caught = slice(model.payload, model.payload + model.body), free_object(plant)
    model = model._replace(motion=model.motion._replace(scratch=spread_scratch(n, size - 2 * n, size + 3)))
    x, w = m.x, np.array([*caught.velocity, caught.spin])
    # rows of S: the state; rows of V: velocity and spin of the object, unknown too; columns: independent unknowns
    S, V = np.zeros((size, size + 3)), np.zeros((3, size + 3))
    S[:, :size] = m.S
    S[body] = 0.0
    V[:, size:] = np.diag([config.payload.capture_speed, config.payload.capture_speed, structured_model.SPIN])
    quantities, found = quantities_of(config, model, x, caught.payload), []
    for k, information in gathered(config, model, x, S, efforts[:max(counts)], noise_std, 1.0 / plant.rate):
        if k in counts:
            found.append([posterior(information, g @ np.vstack([S, V])) for g in quantities.values()])
        if k == capture:
            x[body] = caught.payload[:model.body]
            S[body, body] = np.diag(structured_model.body_std(config, model)[:model.body])
            ahead, behind = (np.array([caught_rates(model, x + e * S[:, c], w + e * V[:, c]) for c in range(size + 3)])
                             for e in (DIFFERENCE, -DIFFERENCE))
            x[n:2 * n] = caught_rates(model, x, w)
            S[n:2 * n] = (ahead - behind).T / (2.0 * DIFFERENCE)
    return dict(zip(quantities, np.array(found).T, strict=True))


def caught_rates(model: Model, x: Array, w: Array) -> Array:
    """Return the rates (n,) just after the empty arm has caught the body in x (nx,), of velocity and spin w (3,)."""
    motion = model.motion
    n, empty = motion.arm.stiffness.size, np.zeros(4)
    q, qd = x[:n], x[n:2 * n]
    m, *rest = x[model.payload:model.payload + model.body]
    hx, hy, about_tip = rest or (0.0, 0.0, 0.0)
    body = Body(m, about_tip - (hx * hx + hy * hy) / m, (hx / m, hy / m), (w[0], w[1]), w[2])
    set_parameters(motion, x)
    mass = momentum(motion.arm, empty, q)[1] if motion.arm.floating else np.inf
    J = body_jacobian(tip_jacobian(motion.arm, empty, q), tip_angle(motion.arm, q), body.com)
    return rates_after(mass_matrix(motion.arm, empty, q), J, qd, body, mass)


def quantities_of(config: IdentifierParameters, model: Model, x: Array, body: Array) -> dict[str, Array]:
    """Return the gradient (nx + 3,), by state and object velocity, of each quantity with a bound, by name."""
    motion, first = model.motion, 2 * model.motion.arm.stiffness.size
    unit, found = np.eye(x.size + 3), {}
    for c, (kind, link) in enumerate(zip(map(Kind, motion.kind), motion.link.tolist(), strict=True)):
        if kind in NAMES and model.motion.prior[c]:
            scale = {Kind.STIFFNESS: config.arm.bending_stiffness, Kind.TORQUE_GAIN: config.arm.torque_gain,
                     Kind.BEND_GAIN: config.arm.bend_gain}.get(kind, (1.0, 1.0))[link]
            found[NAMES[kind].format(link + 1)] = scale * unit[first + c]
    rows = unit[first:first + model.body]
    if model.body > 1:
        rows = about_com(body) @ rows
    names = ('payload_mass', 'payload_com_x', 'payload_com_y', 'payload_inertia')
    found.update(zip(names[:model.body], rows, strict=True))
    found['object_spin'] = unit[-1]
    return found
