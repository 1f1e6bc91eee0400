"""The structured estimator before its first step: which signals it reads, its model of the arm, its first state."""

import math
import re
from dataclasses import replace
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
import scipy

from flexmanip_ros.arm.capture import tip_jacobian
from flexmanip_ros.arm.equations_of_motion import STICTION_RATE, assemble
from flexmanip_ros.arm.late_torque import efforts_needed
from flexmanip_ros.arm.linearization import mass_matrix, omitted_modes
from flexmanip_ros.arm.manipulator import (
    Manipulator,
    chords,
    fastest_mode,
    manipulator,
    modal,
    pinned_frequencies,
    workspace,
)
from flexmanip_ros.identification.prediction_check import white_noise
from flexmanip_ros.numerics.square_root import allocate_bounds
from flexmanip_ros.parameters import ArmParameters, IdentifierParameters
from flexmanip_ros.payload import filter_state as mem
from flexmanip_ros.payload.measurement_update import MeasurementModel, most_white
from flexmanip_ros.payload.moving_horizon import MEASURED_SHARE, MODELLED_SHARE
from flexmanip_ros.payload.process_model import (
    STEP_ANGLE,
    Kind,
    ProcessModel,
    predict,
    set_parameters,
    spread_scratch,
)
from flexmanip_ros.types import Array


class Quantity(IntEnum):
    """What a signal measures."""

    ANGLE = 0
    ANGLE_RATE = 1
    BEND = 2
    BEND_RATE = 3


class Role(NamedTuple):
    """One signal: what it measures, of which link or joint (0 or 1)."""

    quantity: Quantity
    link: int


class Signals(NamedTuple):
    """Roles of the configured outputs, in their order; whether angles and both torques are there."""

    outputs: tuple[Role, ...]
    angles: bool
    torques: bool


def signals(config: IdentifierParameters) -> Signals | None:
    """Return what the configured names mean, or None where they do not describe the arm.

    A name used in ``angles`` or ``inputs`` is a joint, in that order; any other is a bend sensor. Of two, each
    belongs to the link that the first number in its name says, else to the links in the order of appearance. A single
    one of a two-link arm needs that number.
    """
    joints, links = _names(config.angles) or _names(config.inputs), len(config.arm.link_length)
    bends = _in_order_of_links(_names(tuple(name for name in config.outputs
                                            if name.rpartition('/')[0] not in joints)), links)
    if bends is None:
        return None
    roles: list[Role] = []
    for output in config.outputs:
        name, _, field = output.rpartition('/')
        if field == 'effort':
            return None
        is_rate = field == 'velocity'
        if name in joints:
            roles.append(Role(Quantity.ANGLE_RATE if is_rate else Quantity.ANGLE, joints.index(name)))
        else:
            roles.append(Role(Quantity.BEND_RATE if is_rate else Quantity.BEND, bends.index(name)))
    torques = (len(config.inputs) == links and _names(config.inputs) == joints
               and all(name.endswith('/effort') for name in config.inputs))
    angles = len(config.angles) == links and all(name.endswith('/position') for name in config.angles)
    return Signals(tuple(roles), angles, torques)


def unobservable(config: IdentifierParameters) -> tuple[str, str]:
    """Return why these signals give no payload, and what to do about it, in words."""
    known, names = signals(config), 'name the torques, angles and bends of both links in inputs, angles and outputs'
    if known is None:
        return ('the outputs are not those of a two-link arm: a name that is in neither inputs nor angles is a bend '
                'sensor, of which there may be two, and no output may be an effort', names)
    if not known.angles:
        return 'angles does not name the position of two joints', names
    if not known.torques:
        return 'inputs does not name the effort of both joints, in the order of angles', names
    if config.payload_method == 'structured':
        rate = 1.0 / longest_sample_time(config.arm)
        return (f'samples come less than {rate:.3g} times a second, twice the lowest frequency of a link',
                'check the unit of their stamps, or sample faster')
    structured = 'set payload_method to structured'
    if config.arm.base_mass:  # beyond here the method is block
        return 'the payload method block needs a fixed base', structured
    states = 2 * len(config.arm.link_length)
    if config.order % states:
        return f'the payload method block needs an order that {states} divides', f'set order to a multiple of {states}'
    return 'the outputs are not bends that show every mode of the links', structured


def _names(of: tuple[str, ...]) -> tuple[str, ...]:
    """Return the distinct names before the slash, in order of appearance."""
    return tuple(dict.fromkeys(name.rpartition('/')[0] for name in of))


def _in_order_of_links(names: tuple[str, ...], links: int) -> tuple[str, ...] | None:
    """Return the bend sensors of link 1 and link 2; None when more than there are links or one of no known link."""
    if links == 1:
        return names if len(names) <= 1 else None
    numbers = [re.findall(r'\d+', name) for name in names]
    of = [int(found[0]) if found and found[0] in ('1', '2') else 0 for found in numbers]
    if len(names) == 2:
        return names[::-1] if of == [2, 1] else names
    if len(names) == 1:
        return {1: names, 2: ('', *names)}.get(of[0])
    return names if not names else None


class Model(NamedTuple):
    """Constants of the estimator. Its scratch arrays hold nothing between calls, but see ``freeze``."""

    motion: ProcessModel
    roles: tuple[Role, ...]
    """Role of every measurement: the kept outputs, then the angles that are not among the outputs."""
    kept: tuple[int, ...]
    """Indices of the outputs that are measurements; the rate of a quantity that is measured itself is left out."""
    extra: tuple[int, ...]
    """Indices of the angles that are appended to the outputs."""
    slowest: float
    """Lowest pinned frequency of a link [Hz]."""
    rotor_error: Array
    """(L,) consider deviation of the rotor inertias [kg m^2]: the response of the shape functions that are left out."""

    @property
    def payload(self) -> int:
        """Index of the payload's mass in the state; first moments and inertia of a body follow it."""
        return 2 * self.motion.arm.stiffness.size

    @property
    def body(self) -> int:
        """Number of states that describe the payload: 1 for a point mass, 4 for a rigid body."""
        return int(np.count_nonzero(self.motion.kind <= int(Kind.INERTIA)))


def longest_sample_time(arm: ArmParameters) -> float:
    """Return the longest time between samples that show how the slowest link moves, half its period (Nyquist) [s]."""
    return 0.5 / min(pinned_frequencies(arm))


def sampled(config: IdentifierParameters, dt: float) -> IdentifierParameters:
    """Return the parameters without the sines that are faster than the sample rate; dt: sample time [s].

    Sine j of a pinned link has the frequency j^2 f_1, f_1 that of the slowest link. Samples show motion up to half
    their rate (Nyquist). Shapes up to twice the highest frequency of interest represent it, as the static shapes keep
    what the others add to slow motion (component mode synthesis, Craig and Bampton 1968). The filter takes fewer
    integration steps in a sample without these. A single link takes shapes up to four times that frequency: a step of
    its model costs a quarter, and what fewer shapes lack showed in its payload (0.2 % of it, interval 0.1).
    """
    arm = config.arm
    if arm.shape_functions != 'component_modes':
        return config
    highest = 1.0 if len(arm.link_length) > 1 else 2.0
    slower = math.isqrt(int(highest / (dt * min(pinned_frequencies(arm)))))
    return config if slower >= arm.modes else replace(config, arm=replace(arm, modes=max(slower, 1)))


def build(config: IdentifierParameters) -> Model | None:
    """Return the model, or None when the configured signals cannot give a payload."""
    known = signals(config)
    if known is None or not known.torques or not known.angles:
        return None
    extra = tuple(i for i in range(len(config.arm.link_length)) if Role(Quantity.ANGLE, i) not in known.outputs)
    # a torque step sends waves through the links, which rates show and few shape functions do not have
    measured = {role.link + 2 * (role.quantity // 2) for role in known.outputs
                if role.quantity in (Quantity.ANGLE, Quantity.BEND)} | set(extra)
    kept = tuple(i for i, role in enumerate(known.outputs) if role.quantity in (Quantity.ANGLE, Quantity.BEND)
                 or role.link + 2 * (role.quantity // 2) not in measured)
    roles = tuple(known.outputs[i] for i in kept) + tuple(Role(Quantity.ANGLE, i) for i in extra)
    without = (0.0,) * len(config.arm.link_length)
    links_alone = manipulator(replace(config.arm, hub_inertia=without, rotor_inertia=without))
    return Model(motion(config), roles, kept, extra, min(pinned_frequencies(config.arm)),
                 ROTOR_ERROR * _inertias_at_joints(links_alone, straight(links_alone)))


LEARNED = {
    'stiffness': Kind.STIFFNESS, 'damping': Kind.DAMPING, 'viscous_friction': Kind.VISCOUS,
    'coulomb_friction': Kind.COULOMB, 'rotor_inertia': Kind.ROTOR, 'torque_gain': Kind.TORQUE_GAIN,
    'bend_gain': Kind.BEND_GAIN, 'bend_offset': Kind.BEND_OFFSET, 'mode_stiffness': Kind.MODE,
    'torque_delay': Kind.TORQUE_DELAY, 'torque_lag': Kind.TORQUE_LAG, 'bend_delay': Kind.BEND_DELAY,
    'tip_inertia': Kind.TIP_INERTIA}
"""What ``payload.learn`` may name."""


def learned(config: IdentifierParameters) -> tuple[tuple[Kind, int], ...]:
    """Return kind and link of each entry of p: first the payload, then what is learned of the arm."""
    body = (Kind.MASS,) if config.payload.object == 'point' else (Kind.MASS, Kind.FIRST_X, Kind.FIRST_Y, Kind.INERTIA)
    known = signals(config)
    bends = {role.link for role in known.outputs if role.quantity in (Quantity.BEND, Quantity.BEND_RATE)} \
        if known else set()
    entries = [(kind, 0) for kind in body]
    if config.payload.dynamics == 'linear' and not config.payload.working_point and len(config.arm.link_length) == 2:
        entries.append((Kind.POINT, 0))
    entries += [(Kind.CONSTANT, axis) for axis in range(len(constant_errors(config)))]
    given = {name for name, neutral in (('torque_gain', 1.0), ('bend_gain', 1.0), ('bend_offset', 0.0),
                                        ('torque_delay', 0.0), ('torque_lag', 0.0), ('bend_delay', 0.0))
             if np.any(np.array(getattr(config.arm, name)) != neutral)}
    wanted = set(config.payload.learn)
    if 'mode_stiffness' in wanted:  # a factor on the stiffness of its link, which must come before it
        wanted.add('stiffness')
    for name in (*(name for name in LEARNED if name in wanted), *sorted(given - wanted)):
        kind = LEARNED[name]
        if kind is Kind.MODE:  # static shapes are no modes
            k = config.arm.modes if config.arm.shape_functions == 'sines' else 0
            entries += [(kind, i * k + j) for i in range(len(config.arm.link_length)) for j in range(1, k)]
            continue
        alike = kind in (Kind.TORQUE_DELAY, Kind.BEND_DELAY, Kind.TIP_INERTIA)  # one for all joints, bends, links
        for i in range(1 if alike else len(config.arm.link_length)):
            if kind not in (Kind.BEND_GAIN, Kind.BEND_OFFSET) or i in bends:
                entries.append((kind, i))
    return tuple(entries)


def motion(config: IdentifierParameters) -> ProcessModel:
    """Allocate the arm for the compiled functions; ``freeze`` sets the mass matrices of a working point later."""
    nominal = manipulator(config.arm)
    n, links = nominal.torque.shape
    kinds = learned(config)
    size = len(kinds)
    nx = 2 * n + size
    unit = manipulator(replace(config.arm, damping_ratio=0.5)).damping / 0.5
    arm = nominal._replace(**{name: getattr(nominal, name).copy() for name in (
        'mass', 'length', 'gravity', 'stiffness', 'damping', 'viscous', 'coulomb', 'rotary')})
    M, frozen = straight(nominal), config.payload.dynamics == 'linear'
    if frozen:  # no forces of higher order than the displacements
        arm = arm._replace(along=np.zeros_like(arm.along))
    lightest = config.arm.tip_mass + config.arm.linear_density[-1] * config.arm.link_length[-1] / 3
    made = ProcessModel(
        arm=arm, work=workspace(nominal), kind=np.array([kind for kind, _ in kinds], dtype=np.int64),
        link=np.array([link for _, link in kinds], dtype=np.int64), prior=np.zeros(size), given=np.zeros(size),
        frozen=frozen, M0=np.zeros((n, n)), Mp=np.zeros((4, n, n)), Mt=np.zeros((5, n, n)), point=np.zeros(1),
        stiffness=nominal.stiffness, damping=unit, rotary=nominal.rotary, scale=lightest,
        considered=config.payload.model_error * lightest,
        masses=nominal.mass, lengths=nominal.length, gravity=nominal.gravity, constants=constant_errors(config),
        least=_least(nominal, M, lightest), least_rotor=-0.25 * _inertias_at_joints(nominal, M),
        substeps=STEP_ANGLE / fastest_mode(config.arm),
        payload=np.zeros(4), effort=np.zeros(links), gain=np.ones(links), late=np.zeros((links, 2)),
        slope=np.zeros((links, 2)), driven=np.zeros(links), coulomb=nominal.coulomb.copy(),
        share=np.full(links, np.nan), rate=np.full(links, np.nan),
        modelled=np.zeros(links, dtype=np.bool_), opened=np.array([size, *range(size)]),
        bounds=allocate_bounds(size, nx), p=np.zeros(size), a=np.zeros(n), k=np.zeros((26, n)), dq=np.zeros((n, n)),
        dqd=np.zeros((n, n)), dp=np.zeros((n, 4)), G=np.zeros((n, 2 * size)), F=np.zeros((n, 2 * n)),
        X=np.zeros((2 * n, 2 * n)), Y=np.zeros((n, n)), scratch=spread_scratch(n, size, 2 * nx + 1))
    return made._replace(prior=priors(config, made, M), given=_given(config.arm, made))


def sensors(config: IdentifierParameters, model: Model, dt: float, angles: Array) -> MeasurementModel:
    """Return how each measurement follows from the state; dt: sample time [s], angles: (L,) first ones [rad]."""
    output = model.motion.arm.output
    links, count = len(config.arm.link_length), len(model.roles)
    H = np.empty((count, output.shape[1]))
    rate = np.zeros(count, dtype=np.bool_)
    # a damping ratio of zero is one that was not given
    damping = config.arm.damping_ratio or min(config.payload.damping_std, MOST_DAMPING)
    beyond = omitted_modes(replace(config.arm, damping_ratio=damping), working_point(config, angles))
    turn = np.exp((1j * beyond.frequency - 0.5 / beyond.duration) * dt)
    omitted = np.empty((count, links))
    gain, offset, delay = (np.full(count, -1) for _ in range(3))
    bends = [role.quantity in (Quantity.BEND, Quantity.BEND_RATE) for role in model.roles]
    vibration = np.array(bends) & (not np.any(config.arm.gravity))
    for i, role in enumerate(model.roles):
        H[i] = output[role.link + links * bends[i]]
        rate[i] = role.quantity in (Quantity.ANGLE_RATE, Quantity.BEND_RATE)
        omitted[i] = beyond.variance[int(rate[i]), role.link + links * bends[i]]
        if bends[i]:
            gain[i] = _state(model.motion, Kind.BEND_GAIN, role.link)
            if not rate[i]:
                offset[i] = _state(model.motion, Kind.BEND_OFFSET, role.link)
                delay[i] = _state(model.motion, Kind.BEND_DELAY, 0)
    nx = model.payload + model.motion.kind.size
    block = max(2, round(0.1 / (model.slowest * dt)))
    return MeasurementModel(H=H, period=dt, rate=rate, gain=gain, offset=offset, delay=delay,
                            vibration=vibration, omitted=omitted, waves=beyond.variance[1, :links] / STICTION_RATE ** 2,
                            turn=np.array([turn.real, turn.imag]), reach=torque_reach(model, dt), block=block,
                            kicks_every=max(1, block // 4),
                            noise_every=max(1, round(0.01 * config.payload.memory_time / dt)),
                            diffusion=diffusion(config, model), noise=np.zeros((nx, nx)), kicks=np.zeros((nx, links)),
                            f=np.zeros(nx), wide=np.zeros(2 * nx + 1), L=np.zeros((nx, nx)), W=np.zeros((nx, 2 * nx)),
                            W_kicks=np.zeros((nx, nx + links)))


def torque_reach(model: Model, dt: float) -> int:
    """Return how many efforts, one a sample time dt [s], the torques may depend on: those of the prior, at most."""
    motion = model.motion
    latest = {kind: float(np.max((motion.given + 3.0 * motion.prior)[motion.kind == kind], initial=0.0))
              for kind in (Kind.TORQUE_DELAY, Kind.TORQUE_LAG)}
    return min(efforts_needed(latest[Kind.TORQUE_DELAY], latest[Kind.TORQUE_LAG], dt), MOST_EFFORTS)


def _state(motion: ProcessModel, kind: Kind, link: int) -> int:
    """Return the index of the state of this kind and link; -1: there is none."""
    found = np.flatnonzero((motion.kind == kind) & (motion.link == link))
    return 2 * motion.arm.stiffness.size + int(found[0]) if found.size else -1


DRIFT_SHARE = 3e-3
"""Drift of a parameter of the arm in the square root of a second, times ``memory_time``, over its prior deviation."""
CERTAIN = 1e-9
"""Standard deviation of a coordinate that is taken as known."""
EMPTY_STD = 0.05
"""Standard deviation of the payload of an empty arm, over the mass at its tip (``ProcessModel.scale``)."""
PAYLOAD_STD = 3.0
"""Standard deviation of an unknown payload, over the mass at the tip, which is its prior mean."""
COM_STD = 0.1
"""The same of its centre of mass and of its radius of gyration, over the length of the last link."""
TIP_STD = 0.05
"""Prior deviation of the radius of gyration of the tip mass, over the length of the last link: half that of objects."""
ROTOR_STD = 0.003
"""Prior deviation of a rotor inertia, over the inertia of the straight empty arm beyond its joint."""
ROTOR_ERROR = 0.15
"""Consider deviation of a rotor inertia, over the inertia that a fast torque meets at the joint of bare links. More
shape functions would make that inertia less, so a rotor that is learned stands for those that are left out as well.
On 53 random arms with two sines more than the estimator this error was 0.14 rms at joint 1, 0.07 at joint 2."""
FEWEST = 9
"""Least number of samples whose fourth differences tell the noise of a signal."""
LONGEST_PERIOD = 1.5e-3
"""Longest sample time [s] at which fourth differences of a joint's rate tell its noise. Vibrations add up to 0.1 mrad/s
at 1 ms, 0.7 at 2 ms, 10 at 5 ms (default arm with rotors of 0.2 and 0.5 kg m^2)."""
VISCOUS_STD = 0.01394
"""Prior deviation of a viscous friction: the rate at which it alone would slow down that inertia, over the frequency w
of the arm, w^2 = EI / (L J) of link 1. It is 0.02/s on the default arm; with that rate for all arms the friction of a
light one was 70 deviations."""
COULOMB_STD = 0.00243
"""Prior deviation of a Coulomb friction: the deceleration that it alone would give that inertia, over w^2."""
FRICTION_SHARE = 0.5
"""Least prior deviation of a friction over its given value, which is rough: frictions change with warmth and load."""
POINT_STD = 0.01
"""Prior deviation of the angle between the links at which a linear plant stays, about that of the first samples [rad]:
while these come an encoder already turns by some mrad with the bending of its link."""
GAIN_STD = 0.03
"""Prior deviation of the logarithm of the gains of torques and bends, which are calibrated to a few percent."""
LATE_STD = 2e-3
"""Prior deviation of delays and lags [s]: a few samples of a bus, the lag of a drive."""
MOST_DAMPING = 0.99
"""Largest damping ratio with which the modes that are left out are computed, the largest one of ``arm``."""
MOST_EFFORTS = 1000
"""Largest number of efforts that a torque depends on; before them the effort is taken as constant."""
OFFSET_STD = 1e-3
"""Prior deviation of the offset of a bend, over the length of its link."""
BASE_RATE_STD = 0.05
"""Prior deviation of the rate of a floating base before the first sample [rad/s]: it is nearly at rest."""
SPIN = 0.3
"""Expected spin of the object relative to the tip at a capture [rad/s]."""
ANGLE_STD, RATE_STD = 0.03, 1.0
"""Prior deviations of the chords [rad] and of their rates [rad/s] before the first sample."""
BEND_STD = 0.01
"""Prior deviation of the bending before the first sample, over the length of the link."""
OTHER_JUMP = 0.01
"""Share of the rate jump at a capture that an impulse at the tip does not explain, as the shape functions are few."""
FLOORS = {Quantity.ANGLE: 1e-6, Quantity.ANGLE_RATE: 1e-5, Quantity.BEND: 1e-7, Quantity.BEND_RATE: 1e-6}
"""Least standard deviations of a sensor [rad, rad/s, m, m/s], as no signal is exact."""


def priors(config: IdentifierParameters, motion: ProcessModel, M: Array) -> Array:
    """Return the prior standard deviation (np,) of each entry of p; of the payload that of an empty arm.

    M: (n, n) mass matrix of the straight empty arm.
    """
    L = np.array(config.arm.link_length)
    J = np.array([M[i:L.size, i:L.size].sum() for i in range(L.size)])  # inertia beyond each joint, about it
    alike = {Kind.MASS: EMPTY_STD * motion.scale, Kind.POINT: POINT_STD, Kind.CONSTANT: 1.0,
             Kind.STIFFNESS: config.payload.stiffness_std,
             Kind.DAMPING: config.payload.damping_std, Kind.TORQUE_GAIN: GAIN_STD, Kind.BEND_GAIN: GAIN_STD,
             Kind.TORQUE_DELAY: LATE_STD, Kind.TORQUE_LAG: LATE_STD, Kind.BEND_DELAY: LATE_STD,
             Kind.TIP_INERTIA: config.arm.tip_mass * (TIP_STD * L[-1]) ** 2}
    w = np.sqrt(config.arm.bending_stiffness[0] / (L[0] * J[0]))
    viscous, coulomb = (np.maximum(scale * J, FRICTION_SHARE * np.array(given)) for scale, given in (
        (VISCOUS_STD * w, config.arm.joint_viscous_friction),
        (COULOMB_STD * w * w, config.arm.joint_coulomb_friction)))
    by_joint = {Kind.VISCOUS: viscous, Kind.COULOMB: coulomb, Kind.ROTOR: ROTOR_STD * J,
                Kind.BEND_OFFSET: OFFSET_STD * L}
    # shear, rotary inertia and coarse elements all move a mode the farther the higher it is, as j^2 or faster
    modes = config.payload.model_error * (np.arange(1, motion.arm.kappa + 1) ** 2 - 1) / 3
    by_joint[Kind.MODE] = np.tile(modes, len(L))
    fixed = {kind for name, kind in LEARNED.items() if name not in config.payload.learn}
    return np.array([0.0 if kind in fixed else by_joint[kind][link] if kind in by_joint else alike.get(kind, 0.0)
                     for kind, link in zip(map(Kind, motion.kind), motion.link, strict=True)])


def constant_errors(config: IdentifierParameters) -> Array:
    """Return errors of the arm (c, L, 4), one for a deviation along each principal axis of those of its constants.

    Of each link: relative error of its density, error of the mass at its end [kg], relative error of its length where
    the next link is mounted, and that of the gravity that it feels. The constants are independent, with the relative
    deviations ``payload.length_std`` and ``payload.mass_std``.

    A link that is longer by e moves as one of the given length whose displacements are smaller by 1 + e: by similarity
    its density is larger by (1 + e)^3 and the mass at its end by (1 + e)^2; the length of the link before and the
    gravity that it feels are smaller by 1 + e. Its stiffness is smaller by 1 + e and the gain of its bends larger by
    1 + e; these are learned.
    """
    arm, length, mass = config.arm, config.payload.length_std, config.payload.mass_std
    links = len(arm.link_length)
    ends = [*[arm.joint_mass] * (links - 1), arm.tip_mass]
    errors = np.zeros((3, links, links, 4))
    for i, end in enumerate(ends):
        errors[0, i, i] = (3.0 * length, 2.0 * length * end, length if i + 1 < links else 0.0,
                           -length if any(arm.gravity) else 0.0)
        if i:
            errors[0, i, i - 1, 2] = -length
        errors[1, i, i, 0], errors[2, i, i, 1] = mass, mass * end
    flat = errors.reshape(3 * links, 4 * links)
    _, size, direction = np.linalg.svd(flat, full_matrices=False)
    kept = size > 1e-9 * size.max()
    axes: Array = size[kept, None] * direction[kept]
    return axes.reshape(-1, links, 4)


def _given(arm: ArmParameters, motion: ProcessModel) -> Array:
    """Return the prior mean (np,) of each entry of p, the value of its parameter."""
    values: dict[Kind, Any] = {
        Kind.DAMPING: (arm.damping_ratio,) * len(arm.link_length), Kind.VISCOUS: arm.joint_viscous_friction,
        Kind.COULOMB: arm.joint_coulomb_friction, Kind.TORQUE_GAIN: np.log(arm.torque_gain),
        Kind.BEND_GAIN: np.log(arm.bend_gain), Kind.BEND_OFFSET: arm.bend_offset,
        Kind.TORQUE_DELAY: (arm.torque_delay,), Kind.TORQUE_LAG: arm.torque_lag, Kind.BEND_DELAY: (arm.bend_delay,)}
    return np.array([values[kind][link] if kind in values else 0.0
                     for kind, link in zip(map(Kind, motion.kind), motion.link, strict=True)])


def body_std(config: IdentifierParameters, model: Model) -> Array:
    """Return the prior deviations (4,) of a captured body's mass, first moments and inertia."""
    mass, reach = PAYLOAD_STD * model.motion.scale, COM_STD * config.arm.link_length[-1]
    return np.array([mass, mass * reach, mass * reach, mass * reach ** 2])


def body_mean(config: IdentifierParameters, model: Model) -> Array:
    """Return the prior mean (4,) of a captured body; its inertia is above zero, as a point mass is on the bound."""
    mass, _, _, inertia = body_std(config, model) / PAYLOAD_STD
    return np.array([mass, 0.0, 0.0, inertia])


def straight(arm: Manipulator) -> Array:
    """Return the mass matrix (n, n) of the straight empty arm."""
    return mass_matrix(arm, np.zeros(4), np.zeros(arm.stiffness.size))


def _least(arm: Manipulator, M: Array, mass: float) -> Array:
    """Return the least mass and inertia of a payload with which the mass matrix stays positive: half the arm's own."""
    J = tip_jacobian(arm, np.zeros(4), np.zeros(len(M)))[2]
    turning = 1.0 / float(J @ np.linalg.solve(M, J))
    return np.array([-0.5 * mass, -0.5 * turning])


def _inertias_at_joints(arm: Manipulator, M: Array) -> Array:
    """Return the inertia (L,) [kg m^2] that a fast torque meets at each joint, 1 / (b' M^-1 b) with b its row.

    With a rotor inertia of minus this the mass matrix M (n, n) is singular.
    """
    return np.array([1.0 / float(row @ np.linalg.solve(M, row)) for row in arm.joint])


def rate_noise(rates: Array, dt: float) -> Array:
    """Return the variance w (L,) of the white noise of the measured rates (N, L) over ``STICTION_RATE``^2.

    dt: sample time [s]; beyond ``LONGEST_PERIOD`` the noise is not known, and 0 is returned. Infinity: the rates tell
    less of the Coulomb friction than those of the model at any time. Where the measured rate is v, the true share
    tanh(rate / s) of the friction has the mean tanh(v / r) nearly, r^2 = s^2 (1 + pi w / 2) (MacKay 1992). So its
    variance at v = 0 is 1 - s / r. To that the waves in the rate add ``MEASURED_SHARE``^2; with the model's rates they
    are ``MODELLED_SHARE``^2.
    """
    w = np.zeros(rates.shape[1])
    for joint in range(w.size if dt <= LONGEST_PERIOD else 0):
        known = rates[~np.isnan(rates[:, joint]), joint:joint + 1]  # a message may have the rate of one joint alone
        if len(known) >= FEWEST:
            w[joint] = white_noise(known)[0] / STICTION_RATE ** 2
    by_noise = 1.0 - 1.0 / np.sqrt(1.0 + np.pi / 2.0 * w)
    return np.where(by_noise + MEASURED_SHARE ** 2 > MODELLED_SHARE ** 2, np.inf, w)


def noise(model: Model, Y: Array) -> Array:
    """Return what the first samples Y (N, m) tell of the white noise of every sensor, as ``FilterState.noise``."""
    differences = np.diff(Y, n=4, axis=0)
    white = (1.4826 * np.median(np.abs(differences), axis=0)) ** 2 / 70
    rows = np.zeros((len(model.roles), 11))
    rows[:, mem.LEVEL] = np.inf  # no spectrum yet
    rows[:, mem.FLOOR] = [FLOORS[role.quantity] ** 2 for role in model.roles]
    rows[:, mem.WHITE] = np.maximum(white, rows[:, mem.FLOOR])
    return rows


def guess_noise(m: mem.FilterState, count: int) -> None:
    """Assume of every sensor the most that its white noise may vary, by ``count`` samples, as before any innovation."""
    m.counts[mem.BLOCKS] = 0
    for row in m.noise:
        row[[mem.POWER, mem.SLOW, mem.EFFECTIVE, mem.AT_EVENT]] = most_white(row, count)


def first(config: IdentifierParameters, model: Model, m: mem.FilterState, y: Array) -> None:
    """Fill x and S from the first measurement of an empty arm that may move."""
    arm = model.motion.arm
    n, k, links = arm.stiffness.size, arm.kappa, arm.length.size
    m.x[:] = 0.0
    angles = np.zeros(links)
    for i, role in enumerate(model.roles):
        if role.quantity is Quantity.ANGLE:
            angles[role.link] = y[i]
        elif role.quantity is Quantity.BEND:
            shape = arm.output[links + role.link, links + role.link * k]
            m.x[links + role.link * k] = y[i] * shape / (shape ** 2 + 0.1)
    m.x[:links] = chords(config.arm, angles)
    m.x[2 * n:] = model.motion.given
    std = np.zeros(m.x.size)
    std[:links], std[n:n + links] = ANGLE_STD, RATE_STD
    if arm.floating:  # only angles relative to the base are seen
        std[n - 1], std[2 * n - 1] = CERTAIN, BASE_RATE_STD
    for link, (L, EI, rho) in enumerate(zip(config.arm.link_length, config.arm.bending_stiffness,
                                            config.arm.linear_density, strict=True)):
        part = modal(links, k, link)
        std[part] = BEND_STD * L / np.arange(1, k + 1) ** 2
        # a mode's rate is its bending times its frequency, which grows as j^2
        std[n + part.start:n + part.stop] = BEND_STD * L * (np.pi / L) ** 2 * np.sqrt(EI / rho)
    std[2 * n:] = np.where(model.motion.kind == Kind.TIP_INERTIA, 0.0, model.motion.prior)  # see open_tip_inertia
    m.S[:] = np.diag(std)


def expect_rotors_and_friction(model: Model, m: mem.FilterState) -> None:
    """Begin with rotors and friction that are a prior deviation above those given, once the simplest arm has failed.

    From a rotor of zero the effect of one is steep and soon saturates, so a fit may end in a minimum without it.
    """
    raised = np.isin(model.motion.kind, (Kind.VISCOUS, Kind.COULOMB, Kind.ROTOR))
    m.x[model.payload:][raised] += model.motion.prior[raised]


def take_as_known(model: Model, m: mem.FilterState, beyond: Kind = Kind.DAMPING) -> None:
    """Take the entries of p beyond a kind as given, where an unknown object hides them; modes stay uncertain.

    So do the gains where lengths and masses are unsure: torques and masses have one factor in common, and a link of
    another length has another gain of its bends (``constant_errors``).
    """
    kind = model.motion.kind
    taken = (kind > beyond) & (kind != Kind.MODE)
    if Kind.CONSTANT in kind:
        taken &= ~np.isin(kind, (Kind.TORQUE_GAIN, Kind.BEND_GAIN))
    m.x[model.payload:][taken] = model.motion.given[taken]
    m.S[model.payload:][taken] = 0.0


def working_point(config: IdentifierParameters, angles: Array) -> Array:
    """Return the chord angles (L,) that a model belongs to: measured ones, or where a linear plant stays."""
    given = config.payload.working_point
    if config.payload.dynamics == 'linear' and given:
        return np.array(given, dtype=np.float64)
    return chords(config.arm, angles)


def freeze(config: IdentifierParameters, model: Model, angles: Array) -> None:
    """Set the mass matrices of a linear plant at its unbent working point, given or at the measured angles (L,).

    An element of M is a + b cos(t) + c sin(t), t the angle between the links. So its derivative by t is half the
    difference of its values at t + pi / 2 and t - pi / 2. The Jacobians in the scratch of the motion are those of that
    point too: the detector reads them, and no step of a linear plant writes them.
    """
    nominal, motion = manipulator(config.arm), model.motion
    rest = np.zeros(nominal.stiffness.size)
    rest[:len(angles)] = working_point(config, angles)
    turn = np.zeros(rest.size)
    turn[len(angles) - 1] = np.pi / 2.0
    unit = np.eye(4)
    here, ahead, behind = ([mass_matrix(nominal, payload, q) for payload in (np.zeros(4), *unit)]
                           for q in (rest, rest + turn, rest - turn))
    motion.M0[:], motion.Mp[:] = here[0], np.array(here[1:]) - here[0]
    motion.Mt[:] = 0.5 * (np.array(ahead) - np.array(behind))
    motion.Mt[1:] -= motion.Mt[0]
    assemble(nominal, np.zeros(4), rest, np.zeros_like(rest), motion.work.M, motion.work.E, motion.work)


def widen(S: Array, columns: Array) -> Array:
    """Return a square root of S S' + columns columns'."""
    return triangular(np.hstack([S, columns]))


def triangular(S: Array) -> Array:
    """Return the lower triangular square root of S S' (nx, nx), without the columns of states that are taken as known.

    The row of such a state is zero. The columns from the rank on are zero.
    """
    unknown = S.any(axis=1)
    rank = int(unknown.sum())
    root = np.zeros((len(S), len(S)))
    root[unknown, :rank] = np.linalg.qr(S[unknown].T)[1].T
    return root


def _mass(motion: ProcessModel, q: Array) -> Array:
    """Return the mass matrix (n, n) at q, with what ``set_parameters`` wrote last; of a linear plant see ``freeze``."""
    if not motion.frozen:
        return mass_matrix(motion.arm, motion.payload, q)
    rotors: Array = motion.arm.rotary - motion.rotary
    turned = motion.Mt[0] + np.tensordot(motion.payload, motion.Mt[1:], 1)
    frozen: Array = motion.M0 + np.tensordot(motion.payload, motion.Mp, 1) + motion.point[0] * turned + rotors
    return frozen


def jump(config: IdentifierParameters, model: Model, m: mem.FilterState, instant_std: float) -> Array:
    """Return columns (nx, c) by which an event widens the rates: an impulse at the tip (force, moment), and the rest.

    A body of unknown mass changes the rates by an impulse p at the tip of the arm as it was: q' jumps by M^-1 J' p,
    with p the expected mass times the expected speed, and the moment likewise. If the impulse is later than the stamp
    by t, q is off by t M^-1 J' p. t and p are independent, so the variance of q is that of these rates times
    instant_std^2 [s^2].
    """
    motion = model.motion
    n, links = motion.arm.stiffness.size, motion.arm.length.size
    set_parameters(motion, m.x)
    q = m.x[:n]
    M = _mass(motion, q)
    if motion.frozen:
        q = np.concatenate([q[:links], np.zeros(n - links)])
    J = tip_jacobian(motion.arm, motion.payload, q)
    if model.body == 1:
        J = J[:2]
    speed = np.hypot(config.payload.capture_speed, np.linalg.norm(J[:2] @ m.x[n:2 * n]))
    mass, _, moment, inertia = body_std(config, model) / PAYLOAD_STD
    impulse = np.array([mass * speed, mass * speed, moment * speed + inertia * SPIN])[:len(J)]
    rates = np.linalg.solve(M, J.T) * impulse
    other = OTHER_JUMP * np.sqrt((rates ** 2).sum(axis=1))
    columns = np.zeros((m.x.size, rates.shape[1] + n))
    columns[n:2 * n] = np.hstack([rates, np.diag(other)])
    if instant_std == 0.0:
        return columns
    moved = np.zeros((m.x.size, rates.shape[1]))
    moved[:n] = instant_std * rates
    return np.hstack([columns, moved])


def unknown_torque(model: Model, m: mem.FilterState, change: Array, count: int, dt: float) -> Array:
    """Return columns (nx, c) by which torques widen the state that change by ``change`` (L,) [N m] over a gap.

    Each torque jumped at one of the ``count`` missing samples, all equally likely, and was interpolated linearly. The
    difference in interval i has the covariance of a Brownian bridge, change^2 (min(p, q) - p q) with p, q = i / (count
    + 1). A column is the effect of one of its principal components (Karhunen and Loeve) on the arm at its present
    state. The last interval ends at the sample that follows the state, so the columns are carried back over it.
    """
    motion = model.motion
    n = motion.arm.stiffness.size
    predict(motion, m.x, m.S, 0, np.zeros((1, 1 + change.size)), dt, 0.0)
    flow = np.zeros((2 * n + change.size, 2 * n + change.size))
    flow[:n, n:2 * n], flow[n:2 * n, :2 * n] = np.eye(n), motion.F
    flow[n:2 * n, 2 * n:] = np.linalg.solve(_mass(motion, m.x[:n]), motion.arm.torque * (motion.gain * change))
    step = scipy.linalg.expm(flow * dt)
    p = np.arange(1, count + 1) / (count + 1)
    power, shape = np.linalg.eigh(np.minimum.outer(p, p) - np.outer(p, p))
    profiles = shape * np.sqrt(np.maximum(power, 0.0))
    state = np.zeros((2 * n, change.size, profiles.shape[1]))
    for profile in profiles:
        state = np.tensordot(step[:2 * n, :2 * n], state, 1) + step[:2 * n, 2 * n:, None] * profile
    back = -dt * flow[:2 * n, :2 * n]  # what is damped within a sample cannot be carried back over one
    back[n:, n:] /= max(1.0, dt * float(np.linalg.norm(motion.F[:, n:], 2)))
    found = scipy.linalg.expm(back) @ state.reshape(2 * n, -1)
    columns = np.zeros((m.x.size, found.shape[1]))
    columns[:2 * n] = found
    return columns


def diffusion(config: IdentifierParameters, model: Model) -> Array:
    """Return the standard deviation (nx,) that process noise adds in the square root of a second: memory is finite."""
    arm = model.motion.arm
    n, links = arm.stiffness.size, arm.length.size
    T = config.payload.memory_time
    gained = np.zeros(model.payload + model.motion.kind.size)
    # a rate is then forgotten over T: what it gains in T equals what T seconds of samples tell of it
    gained[n:n + links] = 1e-4 / T
    gained[n + links:2 * n] = 1e-5 / T * np.array(config.arm.link_length).max()
    gained[2 * n:] = DRIFT_SHARE / T * model.motion.prior
    body = body_std(config, model)[:model.body] / PAYLOAD_STD
    gained[model.payload:model.payload + model.body] = 1e-3 / T * body
    return gained
