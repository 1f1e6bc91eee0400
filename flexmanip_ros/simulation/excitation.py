"""Torques that excite the arm; the largest within an allowed angle, and the payload accuracy to expect from them."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
from scipy.linalg import qr
from scipy.optimize import brentq

from flexmanip_ros.arm.manipulator import manipulator
from flexmanip_ros.errors import ModelError, ParameterError
from flexmanip_ros.parameters import ExcitationParameters, PlantParameters
from flexmanip_ros.simulation import models, sensors, simulator, waveforms
from flexmanip_ros.types import Array

TIMES = (0.25, 1.0, 3.0)
"""Times after the capture at which the expected accuracy is given [s]."""
CLOSE = 0.02
"""Tolerance of the fitted motion: it stays below the allowed angle by no more than this share."""
NO_TORQUE = 1e-9
"""Peak torque [N m] below which a torque counts as zero: the motion of the arm is lost in rounding."""
BEYOND = 10.0
"""Logarithm of turn over allowed turn that stands for an arm that diverges."""


def torque(config: ExcitationParameters, k: int) -> Array:
    """Torque (L,) [N m] held from sample k on."""
    torques: Array = waveforms.scaled(config, amplitude(config), np.array([k]))[0]
    return torques


def sequence(config: ExcitationParameters, n: int) -> Array:
    """Torques (n, L) [N m] of samples 0 .. n - 1: the same numbers as ``torque``."""
    return waveforms.scaled(config, amplitude(config), np.arange(n))


def amplitude(config: ExcitationParameters) -> tuple[float, ...]:
    """Peak torques (L,) [N m]: as given, or scaled to the allowed angle."""
    if not config.allowed_angle:
        return config.amplitude
    return fitted_amplitude(config)


def plant_of(config: ExcitationParameters) -> PlantParameters:
    """Return the plant the design is made for: noise-free, with chord angles as outputs.

    With Coulomb friction, which needs many integration steps, it takes the fewest that are stable. The motion is then
    accurate to 0.2 %, and the expected payload accuracy to 12 %.
    """
    plant = PlantParameters(
        rate=config.rate, initial_angles=config.initial_angles, payload_mass=config.payload_mass,
        noise='none', arm=replace(config.arm, angle_convention='chord', effort_delay=0, bend_delay=0.0))
    if any(config.arm.joint_coulomb_friction):
        plant = replace(plant, substeps=models.fewest_substeps(manipulator(plant.arm), plant))
    return plant


@lru_cache(maxsize=16)
def fitted_amplitude(config: ExcitationParameters) -> tuple[float, ...]:
    """Scale the amplitudes so that the chords of the empty arm turn by allowed_angle within design_time.

    The linearized arm, on a fixed base, without gravity and Coulomb friction, gives the first guess. The nonlinear arm
    refines it. Raises ParameterError when no torque is asked for, or offset and gravity alone turn the arm further.
    """
    plain = replace(config, allowed_angle=0.0)
    plant = plant_of(config)
    if config.shape == 'zero' or max(config.amplitude) < NO_TORQUE:
        raise ParameterError("parameter 'allowed_angle' is set but the torque is zero",
                             'choose a shape and amplitudes whose ratio you want')
    target = (1.0 - CLOSE / 2) * config.allowed_angle
    if any((*config.offset, *config.arm.gravity)) and motion(replace(plain, shape='zero'), plant) > target:
        raise ParameterError("'offset' and 'arm.gravity' alone turn the arm beyond 'allowed_angle'",
                             'lower the offset; an arm that falls needs a controller')

    def excess(log_scale: float) -> float:
        turned = motion(_scaled(plain, float(np.exp(log_scale))), plant)
        return min(float(np.log(turned / target)), BEYOND)

    linear = replace(plant, model='linear', arm=replace(
        plant.arm, gravity=(0.0, 0.0), base_mass=0.0, joint_coulomb_friction=(0.0,) * len(plant.arm.link_length)))
    low = high = float(np.log(target / motion(plain, linear)))
    while excess(high) < 0.0:
        high += 1.0
    while excess(low) > 0.0:
        low -= 1.0
    fitted = low if low == high else brentq(excess, low, high, xtol=CLOSE / 10, rtol=1e-6)
    while excess(fitted) > np.log(config.allowed_angle / target):
        fitted -= CLOSE / 4
    return _scaled(plain, float(np.exp(fitted))).amplitude


def _scaled(config: ExcitationParameters, scale: float) -> ExcitationParameters:
    return replace(config, amplitude=tuple(peak * scale for peak in config.amplitude))


def motion(config: ExcitationParameters, plant: PlantParameters) -> float:
    """Largest turn [rad] of either chord from its start within design_time; inf when the arm diverges."""
    try:
        run = simulator.simulate(plant, sequence(config, round(config.design_time * config.rate)))
    except ModelError:
        return float('inf')
    links = len(config.amplitude)
    return float(np.max(np.abs(run.position[:, :links] - run.position[0, :links])))


@lru_cache(maxsize=16)
def expected_std(config: ExcitationParameters) -> dict[float, float]:
    """Smallest standard deviation [kg] of an unbiased payload estimate, by seconds after the capture.

    Cramer-Rao bound with the payload and the whole state after the capture unknown and the arm known; all
    signals measured with white noise at snr_db; capture half way through design_time.
    """
    plant = replace(plant_of(config), arm=replace(config.arm, bend_delay=0.0))
    efforts = sequence(config, round(config.design_time * config.rate))
    half = len(efforts) // 2
    start = simulator.init(plant)
    x, before = _run(start, start.x, start.payload, efforts[:half])
    state = simulator.attach(plant, start._replace(x=x))
    later = efforts[half:]
    step = 1e-4 * max(config.payload_mass, 1.0)
    payload = state.payload.copy()
    payload[0] = max(payload[0], step)
    after = _run(state, state.x, payload, later)[1]
    signal = np.vstack([before, after])
    half = signal.shape[1] // 2
    std = sensors.std_for_snr(signal[:, :half], signal[:, half:], config.snr_db)
    if not np.all(std > 0):
        return dict.fromkeys(_times(config), float('inf'))
    size = state.x.size
    moves = [(np.zeros(size), np.array([step, 0.0, 0.0, 0.0]), step)]
    moves += [(1e-6 * e, np.zeros(4), 1e-6) for e in np.eye(size)]
    slopes = []
    for dx, dp, h in moves:
        slopes.append((_run(state, state.x + dx, payload + dp, later)[1] - after) / (h * std))
    sensitivity = np.stack(slopes, axis=2)
    return {time: _bound(sensitivity[:round(time * config.rate)]) for time in _times(config)}


def _times(config: ExcitationParameters) -> tuple[float, ...]:
    return tuple(time for time in TIMES if time <= config.design_time / 2)


def _run(state: simulator.PlantState, x: Array, payload: Array, efforts: Array) -> tuple[Array, Array]:
    """Run the plant from x; return the state at the end and the signals (N, 4 L)."""
    x = x.copy()
    signals = [np.empty((len(efforts), 2 * efforts.shape[1])) for _ in range(2)]
    good = state.model.advance(x, payload, np.ascontiguousarray(efforts), *signals)
    if good < len(efforts):
        raise ModelError('the arm diverges under this torque', 'lower the amplitude')
    return x, np.hstack(signals)


def _bound(sensitivity: Array) -> float:
    """Cramer-Rao bound of the first parameter from whitened sensitivities (N, 4 L, parameters)."""
    rows = sensitivity.reshape(-1, sensitivity.shape[2])
    scale = np.linalg.norm(rows, axis=0)
    if not np.all(scale > 0):
        return float('inf')
    others_first = (rows / scale)[:, ::-1]
    R = qr(others_first, mode='r')[0]
    left = abs(float(R[rows.shape[1] - 1, -1]))  # what the other parameters cannot explain
    return float('inf') if left < 1e-12 else 1.0 / (left * float(scale[0]))


def describe(config: ExcitationParameters) -> str:
    """One line to print before the torque is used: amplitudes, motion and expected payload accuracy."""
    peak = amplitude(config)
    turn = np.degrees(motion(replace(config, allowed_angle=0.0, amplitude=peak), plant_of(config)))
    accuracy = ', '.join(
        f'{std:.2g} kg in {time:g} s' for time, std in expected_std(config).items()) or 'too short a run'
    return (f'{config.shape}: peaks {" and ".join(f"{value:.3g}" for value in peak)} N m turn the empty arm by up to '
            f'{turn:.2g} deg in {config.design_time:g} s; best standard deviation of a '
            f'{config.payload_mass:g} kg payload at {config.snr_db:g} dB: {accuracy}')
