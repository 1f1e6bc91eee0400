"""Parameters of the recursive subspace identifier (node ``rpbsid_identifier``, program ``identify_bag``)."""

from __future__ import annotations

from dataclasses import dataclass, field

from flexmanip_ros.errors import ParameterError
from flexmanip_ros.parameters.arm import ArmParameters
from flexmanip_ros.parameters.field import check_all, parameter
from flexmanip_ros.parameters.payload import PayloadParameters

FIELDS = ('position', 'velocity', 'effort')


@dataclass(frozen=True)
class IdentifierParameters:
    """What to identify, with which memory, and how the payload is read from it."""

    inputs: tuple[str, ...] = parameter(
        ('joint1/effort', 'joint2/effort'), 'input signals, each NAME/FIELD of JointState')
    outputs: tuple[str, ...] = parameter(
        ('link1_bend/position', 'link2_bend/position', 'link1_bend/velocity', 'link2_bend/velocity'),
        'output signals, each NAME/FIELD of JointState')
    angles: tuple[str, ...] = parameter(
        ('joint1/position', 'joint2/position'), "the configuration of the arm; [''] when there is none")
    order: int = parameter(4, 'order n of the model', low=1, high=60)
    past_window: int = parameter(10, 'past window p', unit='samples', low=1, high=200)
    future_window: int = parameter(5, 'future window f', unit='samples', low=1, high=200)
    forgetting_factor: tuple[float, ...] = parameter(
        (0.99, 0.99, 0.99), 'forgetting factors beta 1..3 of the three least squares', low=0.5, high=1.0,
        size=3, live=True)
    regularization: tuple[float, ...] = parameter(
        (0.1, 0.1, 0.1), 'regularization alpha 1..3 on internally scaled signals',
        low=1e-12, high=1e12, size=3)
    direct_feedthrough: bool = parameter(
        False, 'identify D from the first sample on; a refined fit frees it where the likelihood pays for it')
    estimator: str = parameter(
        'factor', 'factor: moments in one triangular factor, solved when a model is asked for; '
        'paper: three recursive least squares at every sample', choices=('factor', 'paper'))
    state_basis: str = parameter(
        'singular', 'selection S of the state from observability x controllability: leading singular vectors '
        '(estimator paper: as fixed); fixed, S = [I 0]; tracked, followed sample by sample (paper only)',
        choices=('singular', 'fixed', 'tracked'))
    weighted_observability: bool = parameter(
        True, 'select the state from the observability of the system (A) instead of the predictor (A - K C)')
    kalman_gain: str = parameter(
        'riccati', 'gain K: riccati, of the stationary Kalman filter of the residuals (stable predictor); '
        'regression, estimated like A and B (the paper; the only way of estimator paper)',
        choices=('riccati', 'regression'))
    forgetting: str = parameter(
        'innovation', 'when old information is let go: innovation, only while the model does not fit; '
        'excitation, as fast as new comes in; constant, at every sample (the paper)',
        choices=('excitation', 'constant', 'innovation'))
    refinement: str = parameter(
        'output_error', 'maximum-likelihood fit started from the subspace model and kept up to date (needs '
        'estimator factor, forgetting innovation): output_error, K = 0 while the system is fitted, dropped '
        'if that does not simulate; prediction_error, K free where the likelihood asks for it; none',
        choices=('output_error', 'prediction_error', 'none'))
    stable_model: bool = parameter(
        False, 'publish no pole outside the unit circle: draw it back onto it')
    decimation: int = parameter(
        1, 'identify on every so many-th sample, all signals behind one anti-alias filter (the model then '
        'steps as many sample times; set direct_feedthrough with it)', low=1, high=1000)
    restart_on_event: bool = parameter(
        True, 'restart the covariances of the least squares at a capture or release', live=True)
    payload_method: str = parameter(
        'structured', 'how the payload is read', choices=('none', 'block', 'structured'))
    publish_rate: float = parameter(
        50.0, 'estimates a second, on the grid of the stamps', unit='Hz', low=0.01, high=10000.0,
        live=True)
    model_rate: float = parameter(
        5.0, 'how often a second model and modes are read anew (they are costly); just after an event with '
        'every estimate, as the structured payload always is', unit='Hz', low=0.01, high=10000.0, live=True)
    gap_factor: float = parameter(
        1.5, 'a step between stamps longer than this many sample times is a gap (so is one as much shorter)',
        low=1.05, high=1000.0, live=True)
    max_time_jump: float = parameter(
        1.0, 'a jump back of the stamps by more than this resets the identifier', unit='s', low=0.001,
        live=True)
    rewind_time: float = parameter(
        0.2, 'samples kept so that a late event is applied at its own stamp', unit='s', low=0.0, high=10.0)
    event_merge_time: float = parameter(
        0.1, 'a second event of the same kind within this time of the first is the same event', unit='s',
        low=0.0, high=60.0, live=True)
    payload_frame: str = parameter('link2_tip', 'frame_id of the published payload', live=True)
    checkpoint_file: str = parameter(
        '', 'the live node saves what it knows here, and resumes from it when it starts; empty: never')
    checkpoint_period: float = parameter(
        5.0, 'seconds between two saves; one more is made on deactivation', unit='s', low=0.1, high=86400.0)
    checkpoint_max_age: float = parameter(
        60.0, 'a saved state is used only when the first sample is no further than this from its last one',
        unit='s', low=0.0, high=1e9)
    arm: ArmParameters = field(default_factory=ArmParameters)
    payload: PayloadParameters = field(default_factory=PayloadParameters)

    def __post_init__(self) -> None:
        check_all(self)
        for group in ('inputs', 'outputs', 'angles'):
            _check_signals(group, getattr(self, group))
        for group in ('inputs', 'outputs'):
            if not getattr(self, group):
                raise ParameterError(f"parameter '{group}' is empty", 'name at least one NAME/FIELD')
        if self.angles and len(self.angles) != 2:
            raise ParameterError(
                f"parameter 'angles' names {len(self.angles)} signals", "name two, or [''] for none")
        if self.state_basis == 'tracked' and self.estimator != 'paper':
            raise ParameterError(
                "parameter 'state_basis' is 'tracked'",
                "set estimator to 'paper', or choose singular or fixed")
        if self.future_window > self.past_window:
            raise ParameterError(
                f"parameter 'future_window' is {self.future_window}",
                f'it cannot exceed past_window ({self.past_window})')
        if self.future_window * len(self.outputs) < self.order:
            raise ParameterError(
                f"parameter 'order' is {self.order}",
                f'it cannot exceed future_window x outputs ({self.future_window * len(self.outputs)})')


def _check_signals(group: str, names: tuple[str, ...]) -> None:
    for name in names:
        joint, _, what = name.rpartition('/')
        if not joint or what not in FIELDS:
            raise ParameterError(
                f"parameter '{group}' names '{name}'",
                f'write NAME/FIELD with FIELD one of {", ".join(FIELDS)}')
    if len(set(names)) != len(names):
        raise ParameterError(f"parameter '{group}' names a signal twice", 'name each signal once')
