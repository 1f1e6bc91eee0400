"""Torques that excite the arm: square waves, multisines, and their design from the arm."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
from scipy.linalg import qr
from scipy.optimize import brentq

from flexmanip_ros.arm.manipulator import manipulator
from flexmanip_ros.errors import ModelError, ParameterError
from flexmanip_ros.parameters import ExcitationParameters, PlantParameters
from flexmanip_ros.simulation import models, sensors, simulator
from flexmanip_ros.types import Array

CREST_PASSES = 200
"""Passes of the crest-factor optimization; a further one changes the peak by less than 0.1 %."""


def torque(config: ExcitationParameters, k: int) -> Array:
    """Torque (2,) [N m] held from sample k on."""
    peak = amplitude(config)
    return np.array([config.offset[i] + peak[i] * _unit(config, i, k) for i in range(2)])


def sequence(config: ExcitationParameters, n: int) -> Array:
    """Torques (n, 2) [N m] of samples 0 .. n - 1: the same numbers as ``torque``."""
    columns = []
    peak = amplitude(config)
    for i in range(2):
        table = _table(config.rate, config.shape, config.period[i], config.band, config.repeat_time,
                       config.bit_time, config.seed, i)
        columns.append(config.offset[i] + peak[i] * table[np.arange(n) % table.size])
    return np.stack(columns, axis=1)


def amplitude(config: ExcitationParameters) -> tuple[float, ...]:
    """Peak torques (2,) [N m]: as given, or scaled to the allowed angle."""
    if not config.allowed_angle:
        return config.amplitude
    return fitted_amplitude(config)


def crest_factor(signal: Array) -> float:
    """Peak over root mean square of one period."""
    return float(np.max(np.abs(signal)) / np.sqrt(np.mean(signal**2)))


def _unit(config: ExcitationParameters, joint: int, k: int) -> float:
    table = _table(config.rate, config.shape, config.period[joint], config.band, config.repeat_time,
                   config.bit_time, config.seed, joint)
    return float(table[k % table.size])


@lru_cache(maxsize=64)
def _table(
    rate: float, shape: str, period: float, band: tuple[float, float], repeat: float, bit: float,
    seed: int, joint: int,
) -> Array:
    """One period of the unit signal of a joint, (samples,); read only."""
    if shape == 'square':
        n = max(round(period * rate), 2)
        table = np.where(np.arange(n) < n / 2, 1.0, -1.0)
    elif shape == 'multisine':
        table = _multisine(rate, band, repeat, seed, joint)
    elif shape == 'prbs':
        n = max(round(repeat * rate), 2)
        hold = max(round(bit * rate), 1)
        bits = np.random.default_rng((seed, joint)).integers(0, 2, -(-n // hold)) * 2.0 - 1.0
        table = np.repeat(bits, hold)[:n]
    elif shape == 'chirp':
        t = np.arange(max(round(repeat * rate), 2)) / rate
        low, high = band if joint == 0 else band[::-1]  # down where the other goes up
        table = np.sin(2 * np.pi * (low + (high - low) * t / (2 * repeat)) * t)
    else:
        table = np.zeros(1)
    table.flags.writeable = False
    return table


def _multisine(rate: float, band: tuple[float, float], repeat: float, seed: int, joint: int) -> Array:
    """Flat spectrum over the band, phases optimized for a low peak; joints share no line.

    Clipping algorithm of Van der Ouderaa, Schoukens and Renneboog (IEEE Trans. IM 37, 1988): clip in
    time, keep the phases of the clipped signal and the amplitudes wanted, repeat.
    """
    n = max(round(repeat * rate), 2)
    lines = np.arange(int(np.ceil(band[0] * repeat)), int(band[1] * repeat) + 1)
    if lines.size > 1:
        lines = lines[joint::2]
    phases = -np.pi * np.arange(lines.size) ** 2 / lines.size  # Schroeder's phases to start with
    phases = phases + np.random.default_rng((seed, joint)).uniform(-0.1, 0.1, lines.size)
    best = np.zeros(n)
    lowest = np.inf
    for step in range(CREST_PASSES):
        spectrum = np.zeros(n // 2 + 1, dtype=np.complex128)
        spectrum[lines] = np.exp(1j * phases)
        signal = np.fft.irfft(spectrum, n)
        peak = float(np.max(np.abs(signal)))
        if peak < lowest:
            lowest, best = peak, signal / peak
        level = peak * (0.75 + 0.2 * step / CREST_PASSES)
        phases = np.angle(np.fft.rfft(np.clip(signal, -level, level))[lines])
    return best


TIMES = (0.25, 1.0, 3.0)
"""Seconds after the capture for which the accuracy is told."""
COARSER = 5
"""Integration steps are this much longer than the plant's: half a radian of the fastest mode."""
CLOSE = 0.02
"""The fitted motion ends within this share below the allowed angle."""
BEYOND = 10.0
"""Logarithm that stands for an arm that diverges."""


def plant_of(config: ExcitationParameters) -> PlantParameters:
    """Return the plant the design is made for: noise-free, chord angles seen, stepped coarsely."""
    plant = PlantParameters(
        rate=config.rate, initial_angles=config.initial_angles, payload_mass=config.payload_mass,
        noise='none', arm=replace(config.arm, angle_convention='chord', effort_delay=0))
    steps = models.substeps(manipulator(plant.arm), plant)
    return replace(plant, substeps=-(-steps // COARSER))


@lru_cache(maxsize=16)
def fitted_amplitude(config: ExcitationParameters) -> tuple[float, ...]:
    """Scale the amplitudes so that the chords turn by allowed_angle within design_time, the arm empty.

    A linear run gives the first guess, the nonlinear arm the rest. Raises ParameterError when no torque
    is asked for or a constant offset alone turns the arm further.
    """
    plain = replace(config, allowed_angle=0.0)
    plant = plant_of(config)
    if config.shape == 'zero' or not any(config.amplitude):
        raise ParameterError("parameter 'allowed_angle' is set but the torque is zero",
                             'choose a shape and amplitudes whose ratio you want')
    if any(config.offset) and motion(replace(plain, shape='zero'), plant) > config.allowed_angle:
        raise ParameterError(
            "parameter 'offset' alone turns the arm beyond 'allowed_angle'", 'lower the offset')
    target = (1.0 - CLOSE / 2) * config.allowed_angle

    def excess(log_scale: float) -> float:
        turned = motion(_scaled(plain, float(np.exp(log_scale))), plant)
        return min(float(np.log(turned / target)), BEYOND)

    low = high = float(np.log(target / motion(plain, replace(plant, model='linear'))))
    while excess(high) < 0.0:
        high += 1.0
    while excess(low) > 0.0:
        low -= 1.0
    fitted = low if low == high else brentq(excess, low, high, xtol=CLOSE / 10, rtol=1e-6)
    while excess(fitted) > np.log(config.allowed_angle / target):
        fitted -= CLOSE / 4
    return _scaled(plain, float(np.exp(fitted))).amplitude


def _scaled(config: ExcitationParameters, scale: float) -> ExcitationParameters:
    first, second = config.amplitude
    return replace(config, amplitude=(first * scale, second * scale))


def motion(config: ExcitationParameters, plant: PlantParameters) -> float:
    """Largest turn [rad] of either chord from its start within design_time; inf when the arm diverges."""
    try:
        run = simulator.simulate(plant, sequence(config, round(config.design_time * config.rate)))
    except ModelError:
        return float('inf')
    return float(np.max(np.abs(run.position[:, :2] - run.position[0, :2])))


@lru_cache(maxsize=16)
def expected_std(config: ExcitationParameters) -> dict[float, float]:
    """Smallest standard deviation [kg] of an unbiased payload estimate, by seconds after the capture.

    Cramer-Rao bound with the payload and the whole state after the capture unknown and the arm known; all
    eight signals measured with white noise at snr_db; capture half way through design_time.
    """
    plant = replace(plant_of(config), arm=config.arm)
    efforts = sequence(config, round(config.design_time * config.rate))
    half = len(efforts) // 2
    start = simulator.init(plant)
    x, before = _run(start, start.x, start.payload, efforts[:half])
    state = simulator.attach(plant, replace(start, x=x))
    later = efforts[half:]
    step = 1e-4 * max(config.payload_mass, 1.0)
    payload = state.payload.copy()
    payload[0] = max(payload[0], step)
    after = _run(state, state.x, payload, later)[1]
    signal = np.vstack([before, after])
    std = sensors.std_for_snr(signal[:, :4], signal[:, 4:], config.snr_db)
    if not np.all(std > 0):
        return dict.fromkeys(_times(config), float('inf'))
    size = state.x.size
    moves = [(np.zeros(size), np.array([step, 0.0, 0.0, 0.0]), step)]
    moves += [(1e-6 * e, np.zeros(4), 1e-6) for e in np.eye(size)]
    slopes = []
    for dx, dp, h in moves:
        ahead, behind = (_run(state, state.x + s * dx, payload + s * dp, later)[1] for s in (1, -1))
        slopes.append((ahead - behind) / (2 * h * std))
    sensitivity = np.stack(slopes, axis=2)
    return {time: _bound(sensitivity[:round(time * config.rate)]) for time in _times(config)}


def _times(config: ExcitationParameters) -> tuple[float, ...]:
    return tuple(time for time in TIMES if time <= config.design_time / 2)


def _run(state: simulator.PlantState, x: Array, payload: Array, efforts: Array) -> tuple[Array, Array]:
    """Run the plant from x; return the state at the end and the eight signals (N, 8)."""
    x = x.copy()
    signals = np.empty((len(efforts), 4)), np.empty((len(efforts), 4))
    good = state.model.advance(x, payload, state.memory.copy(), np.ascontiguousarray(efforts), *signals)
    if good < len(efforts):
        raise ModelError('the arm diverges under this torque', 'lower the amplitude')
    return x, np.hstack(signals)


def _bound(sensitivity: Array) -> float:
    """Cramer-Rao bound of the first parameter from whitened sensitivities (N, 8, parameters)."""
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
    return (f'{config.shape}: peaks {peak[0]:.3g} and {peak[1]:.3g} N m turn the empty arm by up to '
            f'{turn:.2g} deg in {config.design_time:g} s; best standard deviation of a '
            f'{config.payload_mass:g} kg payload at {config.snr_db:g} dB: {accuracy}')
