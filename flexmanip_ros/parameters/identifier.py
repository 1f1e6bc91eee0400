"""Parameters of the identifier and its payload estimators (node ``rpbsid_identifier``, program ``identify_bag``)."""

from dataclasses import dataclass, field, fields
from typing import Any

from flexmanip_ros.errors import ParameterError
from flexmanip_ros.parameters.arm import ArmParameters
from flexmanip_ros.parameters.field import check_all, counted, of_links, parameter

FIELDS = ('position', 'velocity', 'effort')
"""Arrays of a JointState that a signal NAME/FIELD may name."""


LEARNABLE = (
    'stiffness', 'damping', 'viscous_friction', 'coulomb_friction', 'rotor_inertia', 'torque_gain', 'bend_gain',
    'bend_offset', 'mode_stiffness', 'torque_delay', 'torque_lag', 'bend_delay', 'tip_inertia')
"""Arm parameters that can be learned while the arm is empty."""


@dataclass(frozen=True)
class PayloadParameters:
    """What is known beforehand of the arm and of the object; group ``payload`` of the identifier."""

    known_coupling: bool = parameter(
        False, 'method block: take the coupling block M_b from the arm model instead of identifying it (2 to 8 times '
        'smaller deviation)')
    dynamics: str = parameter(
        'nonlinear', 'method structured: nonlinear, the mass matrix follows the configuration; linear, it stays at '
        'working_point', choices=('nonlinear', 'linear'))
    working_point: tuple[float, ...] = parameter(
        (), 'chord angles of the working point of dynamics linear; []: about the first measured ones, and learned',
        unit='rad')
    stiffness_std: float = parameter(
        0.03, 'prior relative standard deviation of the stiffnesses; the empty arm refines them', low=0.0, high=1.0)
    damping_std: float = parameter(
        0.005, 'prior standard deviation of the damping ratios; the empty arm refines them', low=0.0, high=1.0)
    capture_speed: float = parameter(
        0.3, 'expected speed of the object relative to the tip at a capture', unit='m/s', low=0.0, high=100.0)
    event_time_std: float = parameter(
        0.001, 'method structured: standard deviation of the stamps of events; a gripper driver that reports within a '
        'millisecond or two; those found in the signals have one of their own besides', unit='s', low=0.0, high=0.02)
    model_error: float = parameter(
        0.003, "relative error of the arm's inertia that widens the interval where a sensor shows more than its noise",
        low=0.0, high=1.0)
    length_std: float = parameter(
        0.0, 'method structured: relative standard deviation to which the lengths of the links are known; 0: exactly',
        low=0.0, high=0.1)
    mass_std: float = parameter(
        0.0, 'method structured: the same of the densities of the links and of the masses at the joint and the tip; '
        'the empty arm refines them', low=0.0, high=0.1)
    object: str = parameter(
        'body', 'method structured: point, the object is a mass at the tip; body, it has a centre of mass and an '
        'inertia, which are estimated too', choices=('point', 'body'))
    learn: tuple[str, ...] = parameter(
        LEARNABLE, "method structured: what the empty arm teaches, beside the motion; [''] for nothing")
    use_joint_rates: bool = parameter(
        True, 'method structured: Coulomb friction follows the measured rates of the joints where messages carry them; '
        'false, or at samples of 1.5 ms and less where their noise is above 1.4 mrad/s or above the vibration of modes '
        'that the model omits: those of the model (false is for rates that are late or smoothed by more than a sample)')
    memory_time: float = parameter(
        20.0, 'time over which the structured filter forgets old samples', unit='s', low=0.1, high=1e6)

    def __post_init__(self) -> None:
        check_all(self)
        unknown = [name for name in self.learn if name not in LEARNABLE]
        if unknown:
            raise ParameterError(f"parameter 'payload.learn' names {', '.join(map(repr, unknown))}",
                                 f"choose from {', '.join(LEARNABLE)}")
        if self.dynamics == 'linear' and (self.length_std or self.mass_std):
            raise ParameterError("payload.length_std and payload.mass_std need payload.dynamics 'nonlinear'",
                                 'leave them at 0: a linear plant takes its lengths and masses as exact')


@dataclass(frozen=True)
class IdentifierParameters:
    """What is identified, with which memory, and how the payload is estimated."""

    inputs: tuple[str, ...] = parameter(
        ('joint1/effort', 'joint2/effort'), 'input signals, each NAME/FIELD of JointState')
    outputs: tuple[str, ...] = parameter(
        ('link1_bend/position', 'link2_bend/position', 'link1_bend/velocity', 'link2_bend/velocity'),
        'output signals, each NAME/FIELD of JointState')
    angles: tuple[str, ...] = parameter(
        ('joint1/position', 'joint2/position'), "the signals of the arm's configuration, one a joint; ['']: none")
    order: int = parameter(
        4, 'order n of the model; the model of every configuration has two states a displacement', low=1, high=60)
    past_window: int = parameter(10, 'past window p', unit='samples', low=1, high=200)
    future_window: int = parameter(5, 'future window f', unit='samples', low=1, high=200)
    forgetting_factor: tuple[float, ...] = parameter(
        (0.99, 0.99, 0.99), 'forgetting factors beta 1..3 of the three least squares', low=0.5, high=1.0, size=3,
        live=True)
    regularization: tuple[float, ...] = parameter(
        (0.1, 0.1, 0.1), 'regularization alpha 1..3 of the three least squares, on signals of unit peak', low=1e-12,
        high=1e12, size=3)
    direct_feedthrough: bool = parameter(
        False, 'identify D from the first sample on; false: a refined model has a D where the likelihood asks for it')
    estimator: str = parameter(
        'factor', 'factor: one triangular factor of the moments, solved when a model is read; paper: three recursive '
        'least squares at every sample', choices=('factor', 'paper'))
    state_basis: str = parameter(
        'singular', 'selection S of the state: singular, leading singular vectors (estimator paper: as fixed); fixed, '
        'S = [I 0]; tracked, subspace tracking at every sample (estimator paper)',
        choices=('singular', 'fixed', 'tracked'))
    weighted_observability: bool = parameter(
        True, 'select the state from the observability of the system (A) instead of the predictor (A - K C)')
    kalman_gain: str = parameter(
        'riccati', 'gain K: riccati, of the stationary Kalman filter of the residuals (A - K C is stable); '
        'regression, least squares as for A and B (the paper; always with estimator paper)',
        choices=('riccati', 'regression'))
    forgetting: str = parameter(
        'innovation', 'when old samples are forgotten: innovation, while the model does not fit; excitation, as fast '
        'as new information comes; constant, at every sample (the paper)',
        choices=('excitation', 'constant', 'innovation'))
    refinement: str = parameter(
        'output_error', 'maximum-likelihood fit started from the subspace model (needs estimator factor, forgetting '
        'innovation): output_error, K = 0 while the system is fitted, rejected if the model does not simulate; '
        'prediction_error, K is fitted too where the likelihood asks for it; none',
        choices=('output_error', 'prediction_error', 'none'))
    stable_model: bool = parameter(False, 'move poles outside the unit circle onto it before publishing')
    decimation: int = parameter(
        1, 'identify on every n-th sample, behind one anti-alias filter for all signals; the model then steps n sample '
        'times (set direct_feedthrough with it)', low=1, high=1000)
    restart_on_event: bool = parameter(
        True, 'restart the covariances of the least squares at a capture or release', live=True)
    payload_method: str = parameter(
        'structured', "estimator of the payload: structured, the arm's equations; block or frequency, the matrices or "
        'frequencies of the model; none', choices=('none', 'block', 'frequency', 'structured'))
    publish_rate: float = parameter(
        50.0, 'estimates a second, on the grid of the stamps', unit='Hz', low=0.01, high=10000.0, live=True)
    model_rate: float = parameter(
        5.0, 'models and modes a second; just after an event one comes with every estimate', unit='Hz', low=0.01,
        high=10000.0, live=True)
    gap_factor: float = parameter(
        1.5, 'an interval between stamps longer than this many sample times is a gap, and so is one shorter than 2 '
        'minus this many', low=1.05, high=1000.0, live=True)
    max_gap: float = parameter(
        0.2, 'samples that are missing for longer than this begin the motion anew; over fewer the estimators go on',
        unit='s', low=0.0, high=10.0, live=True)
    max_time_jump: float = parameter(
        1.0, 'stamps that jump back by more than this restart the identifier', unit='s', low=0.001, live=True)
    rewind_time: float = parameter(
        0.2, 'a late event is applied at its own stamp when it is at most this late', unit='s', low=0.0, high=10.0)
    event_merge_time: float = parameter(
        0.1, 'an event this close to the last one of its kind, none of the other between, is the same', unit='s',
        low=0.0, high=60.0, live=True)
    payload_frame: str = parameter('link2_tip', 'frame_id of the published payload', live=True)
    base_frame: str = parameter(
        'base_link', 'frame_id of the drawn arm (~/arm): joint 1 at its origin, angles from its x axis')
    checkpoint_file: str = parameter(
        '', 'file in which the live node saves its state and from which it resumes at start; empty: none')
    checkpoint_period: float = parameter(
        5.0, 'time between two saves; one more is made at deactivation', unit='s', low=0.1, high=86400.0)
    checkpoint_max_age: float = parameter(
        60.0, 'longest time from the last saved sample to the first new one', unit='s', low=0.0, high=1e9)
    arm: ArmParameters = field(default_factory=ArmParameters)
    payload: PayloadParameters = field(default_factory=PayloadParameters)

    def __post_init__(self) -> None:
        check_all(self)
        links = len(self.arm.link_length)
        fit_signals(self, links)
        if len(self.payload.working_point) not in (0, links):
            raise ParameterError(
                f"parameter 'payload.working_point' has {counted(len(self.payload.working_point), 'elements')}",
                f'give {links}, or [] for the measured ones')
        if self.payload.dynamics == 'linear' and self.arm.base_mass:
            raise ParameterError("parameter 'payload.dynamics' is 'linear', but arm.base_mass is set",
                                 'choose nonlinear: a linear plant has no floating base')
        for group in ('inputs', 'outputs'):
            if not getattr(self, group):
                raise ParameterError(f"parameter '{group}' is empty", 'name at least one NAME/FIELD')
        if self.angles and len(self.angles) != links:
            raise ParameterError(f"parameter 'angles' names {counted(len(self.angles), 'signals')}",
                                 f"name one for each joint ({links}), or [''] for none")
        if self.state_basis == 'tracked' and self.estimator != 'paper':
            raise ParameterError("parameter 'state_basis' is 'tracked'",
                                 "set estimator to 'paper', or choose singular or fixed")
        if self.future_window > self.past_window:
            raise ParameterError(f"parameter 'future_window' is {self.future_window}",
                                 f'it cannot exceed past_window ({self.past_window})')
        if self.future_window * len(self.outputs) < self.order:
            raise ParameterError(
                f"parameter 'order' is {self.order}",
                f'it cannot exceed future_window x outputs ({self.future_window * len(self.outputs)})')


def fit_signals(config: Any, links: int) -> None:
    """Leave the signals of the second link out of the default inputs, outputs and angles of an arm of one link.

    Raises ParameterError for a signal that is not NAME/FIELD, or named twice in a group.
    """
    for item in fields(config):
        if item.name in ('inputs', 'outputs', 'angles'):
            names = getattr(config, item.name)
            if names == item.default:
                object.__setattr__(config, item.name, of_links(names, links))
            _check_signals(item.name, names)


def _check_signals(group: str, names: tuple[str, ...]) -> None:
    for name in names:
        joint, _, what = name.rpartition('/')
        if not joint or what not in FIELDS:
            raise ParameterError(f"parameter '{group}' names '{name}'",
                                 f'write NAME/FIELD with FIELD one of {", ".join(FIELDS)}')
    if len(set(names)) != len(names):
        raise ParameterError(f"parameter '{group}' names a signal twice", 'name each signal once')
