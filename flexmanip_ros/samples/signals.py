"""Position of the configured signals in a message: matched by name, in any order, extra joints ignored."""

import math
from dataclasses import dataclass, replace

import numpy as np

from flexmanip_ros.arm.equations_of_motion import STICTION_RATE
from flexmanip_ros.parameters import IdentifierParameters, TriggerParameters
from flexmanip_ros.parameters.field import of_links
from flexmanip_ros.samples.sample_log import Friction, Rows
from flexmanip_ros.types import Array, JointBlock, JointRecord, Sample


@dataclass(frozen=True)
class Channels:
    """Index and field of each signal for messages that carry exactly ``names``."""

    names: tuple[str, ...]
    outputs: tuple[str, ...]
    """Output signals in use: the configured ones, or those of the default set that are there."""
    u: tuple[tuple[str, int], ...]
    y: tuple[tuple[str, int], ...]
    angles: tuple[tuple[str, int], ...]
    places: tuple[tuple[str, int], ...]
    """The places of u, y and angles, in this order."""
    rates: tuple[int, ...]
    """Indices of the joints whose rates are read; a message may lack them."""


@dataclass(frozen=True)
class Rejection:
    """Why a message cannot be used: a counter's name, and the sentence for the user."""

    reason: str
    problem: str
    remedy: str


def resolve(
    config: IdentifierParameters, record: JointRecord | JointBlock, outputs: tuple[str, ...] | None = None
) -> Channels | Rejection:
    """Find every configured signal in a record.

    outputs: the signals settled on by an earlier record; None lets the default outputs shrink to what
    this one carries (velocities are never invented). A signal set by the user and missing is refused.
    """
    fault = wrong_size(record)
    if fault is not None:
        return fault
    wanted = config.outputs if outputs is None else outputs
    if outputs is None and _is_default('outputs', config):
        # A joint that is there without this field has no such sensor; one that is not there has a wrong name.
        kept = (name for name in wanted if (_find(name, record) and not _lacks_rate(name, record))
                or name.rpartition('/')[0] not in record.names)
        wanted = tuple(kept) or wanted
    groups: list[tuple[tuple[str, int], ...]] = []
    angles = config.angles if reads_angles(config) else ()
    for group, names in (('inputs', config.inputs), ('outputs', wanted), ('angles', angles)):
        places = []
        for name in names:
            place = _find(name, record)
            if place is None:
                return _missing(group, name, record)
            places.append(place)
        groups.append(tuple(places))
    rates = tuple(index for _, index in groups[2]) if reads_rates(config) else ()
    return Channels(record.names, wanted, groups[0], groups[1], groups[2], sum(groups, start=()), rates)


def joints(config: IdentifierParameters | TriggerParameters) -> tuple[str, ...]:
    """Return the names of the joints, and of the bends, whose signals are configured."""
    return tuple(dict.fromkeys(name.rpartition('/')[0] for name in (*config.inputs, *config.outputs, *config.angles)))


def reads_angles(config: IdentifierParameters) -> bool:
    """Whether the angles are read: for a payload, where the user names them, and beside the default inputs.

    A machine with other inputs may have a joint of a default angle's name that is no joint of the arm.
    """
    needed = config.payload_method != 'none' or not _is_default('angles', config)
    return bool(config.angles) and (needed or _is_default('inputs', config))


def reads_rates(config: IdentifierParameters) -> bool:
    """Whether the joints' rates are read: where the friction of a joint does work on the angle that is measured.

    Friction is learned with the payload (``structured``), or given.
    """
    arm = config.arm
    return (config.payload.use_joint_rates and reads_angles(config)
            and (config.payload_method == 'structured' or any(arm.joint_coulomb_friction))
            and arm.angle_convention == 'encoder' and arm.torque_convention == 'joint')


def without_friction(config: IdentifierParameters, rows: Rows) -> Rows:
    """Return the rows with the inputs less the Coulomb friction of their joints, where the rates are measured.

    The friction is the one that the log has for the first row (``SampleLog.friction``), else the given one. A linear
    model has no such friction. With the whole torques as inputs its frequencies are off by 1 % where friction is a
    tenth of the torque. An input and an angle belong to the same joint where they have its name.
    """
    if not rows.log.width.rates or not len(rows):
        return rows
    arm, first_ns = config.arm, int(rows.stamp_ns[0])
    given = tuple(torque / gain for torque, gain in zip(arm.joint_coulomb_friction, arm.torque_gain, strict=True))
    torques = next((one.torques for one in reversed(rows.log.friction) if one.stamp_ns <= first_ns), given)
    if not any(torques):
        return rows
    inputs, angles = ([name.rpartition('/')[0] for name in names] for names in (config.inputs, config.angles))
    return replace(rows, friction=tuple(
        Friction(inputs.index(name), joint, torques[joint], STICTION_RATE)
        for joint, name in enumerate(angles) if name in inputs))


def _is_default(group: str, config: IdentifierParameters) -> bool:
    """Whether the signals of a group are the default ones for the arm's number of links."""
    default = getattr(IdentifierParameters, group)
    return getattr(config, group) in (default, of_links(default, len(config.arm.link_length)))


def relative_angle(config: IdentifierParameters, angles: Array) -> Array:
    """Return the angle of link 2 seen from link 1 [rad] (...,) of measured angles (..., 2)."""
    is_absolute = config.arm.angle_convention == 'chord'
    return np.asarray(angles[..., 1] - angles[..., 0] if is_absolute else angles[..., 1], dtype=np.float64)


def wrong_size(record: JointRecord | JointBlock) -> Rejection | None:
    """Reject a record whose arrays have neither the length of its names nor zero."""
    count = len(record.names)
    for field in ('position', 'velocity', 'effort'):
        size = getattr(record, field).shape[-1]
        if size not in (0, count):
            return Rejection(
                'unequal_sizes', f"a JointState has {count} names but {size} values in '{field}'",
                'make the publisher fill every array for every name, or leave it empty')
    if len(set(record.names)) != count:
        return Rejection('unequal_sizes', 'a JointState names a joint twice', 'publish each joint once')
    return None


def extract(channels: Channels, record: JointRecord) -> Sample | None:
    """Return the configured signals of a record with the names of ``channels``; None where one is not finite."""
    fields = {'position': record.position.tolist(), 'velocity': record.velocity.tolist(),
              'effort': record.effort.tolist()}
    values = [fields[field][index] for field, index in channels.places]
    if not all(map(math.isfinite, values)):  # a check of their sum would reject finite values whose sum overflows
        return None
    row = np.array(values, dtype=np.float64)
    r, m = len(channels.u), len(channels.y)
    measured = fields['velocity']
    rates = [measured[k] if measured and measured[k] and math.isfinite(measured[k]) else math.nan
             for k in channels.rates]
    return Sample(record.stamp_ns, row[:r], row[r:r + m], row[r + m:], np.array(rates, dtype=np.float64))


def not_finite(channels: Channels, record: JointRecord) -> Rejection:
    """Return why ``extract`` rejects a record: the first configured signal that is NaN or infinite."""
    field, index = next(place for place in channels.places if not math.isfinite(getattr(record, place[0])[place[1]]))
    what = 'NaN' if math.isnan(getattr(record, field)[index]) else 'infinite'
    is_spare = field == 'velocity' and (field, index) in channels.y  # positions suffice as outputs
    return Rejection('not_finite', f"'{channels.names[index]}/{field}' is {what}",
                     ('leave it out of outputs, or ' if is_spare else '') + 'check the publisher of the joint states')


def joint_rates(channels: Channels, block: JointBlock, taken: slice) -> Array:
    """Return measured rates of the joints, as in ``extract``, of the messages ``taken``, (N, a) [rad/s]; NaN: unknown.

    A rate of exactly zero counts as unknown: drivers that measure no rates report that.
    """
    if not block.velocity.shape[1]:
        return np.full((taken.stop - taken.start, len(channels.rates)), np.nan)
    rates = block.velocity[taken, list(channels.rates)]
    return np.where(np.isfinite(rates) & (rates != 0.0), rates, np.nan)


def columns(block: JointBlock, places: tuple[tuple[str, int], ...], taken: slice) -> Array:
    """Return signals of the messages ``taken``, (N, len(places)): places as in ``Channels``."""
    if not places:
        return np.zeros((taken.stop - taken.start, 0))
    return np.column_stack([getattr(block, field)[taken, index] for field, index in places])


def _find(signal: str, record: JointRecord | JointBlock) -> tuple[str, int] | None:
    joint, _, field = signal.rpartition('/')
    if joint not in record.names or getattr(record, field).size == 0:
        return None
    return field, record.names.index(joint)


def _lacks_rate(signal: str, record: JointRecord | JointBlock) -> bool:
    """Whether the first message has a NaN for the rate of a joint whose position it has: ros2_control does so."""
    joint, _, field = signal.rpartition('/')
    if field != 'velocity' or not record.position.size:
        return False
    index = record.names.index(joint)
    rate, position = (np.atleast_2d(values)[0, index] for values in (record.velocity, record.position))
    return bool(np.isnan(rate) and np.isfinite(position))


def _missing(group: str, signal: str, record: JointRecord | JointBlock) -> Rejection:
    joint, _, field = signal.rpartition('/')
    if joint not in record.names:
        return Rejection(
            'missing_signal', f"'{signal}' of parameter '{group}' is not in the messages",
            f'the joints there are: {", ".join(record.names) or "none"}; set {group} to match. All signals come in one '
            'JointState: merge those of several publishers')
    return Rejection(
        'missing_signal', f"'{signal}' of parameter '{group}': the messages carry no {field}",
        f'set {group} to the fields that are there')
