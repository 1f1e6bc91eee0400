"""Unit waveforms of the torques: square wave, multisine, pseudo-random binary sequence, chirp."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from flexmanip_ros.parameters import ExcitationParameters
from flexmanip_ros.types import Array

CREST_PASSES = 200
"""Passes of the crest-factor optimization; a further one changes the peak by less than 0.1 %."""


def scaled(config: ExcitationParameters, peak: tuple[float, ...], k: NDArray[np.int64]) -> Array:
    """Torques (n, L) [N m] of samples number k (n,) with peak torques (L,) [N m] about the offset."""
    tables = [unit(config, i) for i in range(len(peak))]
    return np.stack([config.offset[i] + peak[i] * table[k % table.size] for i, table in enumerate(tables)], axis=1)


def unit(config: ExcitationParameters, joint: int) -> Array:
    """One period of the unit waveform of a joint, (samples,); read only."""
    return _table(config.rate, config.shape, config.period[joint], config.band, config.repeat_time,
                  config.bit_time, config.seed, joint)


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
    """Flat spectrum over the band, phases optimized for a low peak; joints share no spectral line.

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
