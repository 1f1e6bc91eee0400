"""Compiled update of the structured estimator with a sample, and what its innovations say of the noise."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexmanip_ros.numerics.compiled import inner, separate
from flexmanip_ros.numerics.square_root import absorb_measurement, dot, project
from flexmanip_ros.payload import filter_state as mem
from flexmanip_ros.types import Array

OUTLIER = 4.0
"""Standard deviations beyond which an innovation has less weight (Huber)."""
BLOCK_MEMORY = 120
"""Number of blocks over which the noise of a sensor is averaged."""
BATCH = 8
"""Blocks in a batch: most of a period of the slowest vibration."""
MOVES_MEMORY = 400
"""Number of moves whose squares are averaged, so that their mean is known to 7 %: sqrt(2 / 400)."""
LEAST_FALL = 0.02
"""Least fall of a variance that is compared with a move, as a share of it. The move is then a seventh of a deviation;
smaller ones are of the size of what the linearization leaves out."""
SPECTRUM = 128
"""Samples of one spectrum. Hann's window of that length is 1.44 / 128 wide, the distance of the frequencies
``TONE``."""
SPECTRUM_MEMORY = 16
"""Spectra over which the power at each frequency is averaged: 2048 samples, as for the fourth differences."""
TONE = 0.16 + 0.01 * np.arange(mem.TONES)
"""Frequencies of the spectrum over the sample rate. Slow motion and the trace of a torque step in fourth differences
are below the first; the window keeps the mirror images above one half from the last."""
TURN = 2.0 * np.cos(2.0 * np.pi * TONE)
"""Coefficient of Goertzel's filter at each."""
HANN = np.sin(np.pi * (np.arange(SPECTRUM) + 0.5) / SPECTRUM) ** 2
"""Hann's window."""
SHARE = 1.0 / (np.sum(HANN ** 2) * (2.0 * np.sin(np.pi * TONE)) ** 8)
"""One over the mean power, at each frequency, of the fourth differences of white noise of unit variance."""
OVERLAP = 2.63
"""Samples for each independent fourth difference: 1 + 2 sum of r^2, r = 56, 28, 8 and 1 / 70 their correlation at lags
1 to 4. So the variance of white noise by N of them has the relative deviation sqrt(2 OVERLAP / N)."""
SHOWN = 10.0
"""Variance of a sensor over that of its white noise from which it shows a vibration. What is linearized about a noisy
vibration is biased by the noise's share of its power (errors in variables). With twice the noise 4.2 +- 1.0 kg were
found for 20 kg."""
FEWEST = 8
"""Measurements from which their variance is told from that of noise: noise exceeds ten times its own in 1 of 1e12."""
MEDIAN_STD = 1.25 / np.sqrt(mem.TONES)
"""Relative standard deviation of the median of the powers in one spectrum of white noise: sqrt(pi / 2) of a mean's."""


class MeasurementModel(NamedTuple):
    """How the signals follow from the state."""

    H: Array
    """(m, n) of q or qd."""
    period: float
    """Sample time [s]."""
    rate: NDArray[np.bool_]
    """(m,) whether H reads qd."""
    gain: NDArray[np.int64]
    """(m,) which state is the logarithm of the sensor's gain; -1: none."""
    offset: NDArray[np.int64]
    """(m,) which state is its offset; -1: none."""
    delay: NDArray[np.int64]
    """(m,) which state is its delay; -1: none."""
    vibration: NDArray[np.bool_]
    """(m,) whether a sensor is constant where the arm does not vibrate: that of a bend, but for gravity."""
    omitted: Array
    """(m, L) variance that the omitted modes add at a step of 1 N m of each torque, in units of the sensor."""
    waves: Array
    """(L, L) the same of the rate of each joint, over ``STICTION_RATE``^2."""
    turn: Array
    """(2,) real and imaginary part of exp((i w - 1 / 2 T) h): the phasor of these modes from one sample to the next."""
    reach: int
    """Efforts that a torque depends on."""
    block: int
    """Samples in a block: a tenth of the slowest vibration."""
    kicks_every: int
    """Samples after which the process noise of the torques is added: a fortieth of the slowest vibration, as they shake
    faster modes, too. After a tenth, the moves of mass and stiffness were three times what their variances say."""
    noise_every: int
    """Samples between additions of process noise, a hundredth of ``memory_time``: one costs as much as three
    samples."""
    diffusion: Array
    """(nx,) standard deviation that each state gains in the square root of a second."""
    noise: Array
    """(nx, nx) scratch for the process noise of each state."""
    kicks: Array
    """(nx, L) scratch for that of the torque of each joint."""
    f: Array
    """(nx,) scratch."""
    wide: Array
    """(2 nx + 1,) scratch."""
    L: Array
    """(nx, nx) scratch."""
    W: Array
    """(nx, 2 nx) scratch."""
    W_kicks: Array
    """(nx, nx + L) scratch."""


@inner
def look_back(sensors: MeasurementModel, i: int, n: int, x: Array, S: Array, f: Array, qdd: Array) -> float:
    """Return the change of a late sensor's reading by its delay, a Taylor series to second order; add it to f."""
    row = S[sensors.delay[i]]
    delay: float = x[sensors.delay[i]]
    opened = delay != 0.0
    for c in range(f.size):
        opened |= row[c] != 0.0
    if not opened:
        return 0.0
    rate: float = 0.0
    bend: float = 0.0
    for j in range(n):
        h = sensors.H[i, j]
        if h != 0.0:
            rate += h * x[n + j]
            bend += h * qdd[j]
            for c in range(f.size):
                f[c] -= delay * h * S[n + j, c]
    for c in range(f.size):
        f[c] += (delay * bend - rate) * row[c]
    return delay * (0.5 * delay * bend - rate)


@inner
def observe(sensors: MeasurementModel, i: int, n: int, x: Array, S: Array, f: Array, qdd: Array) -> float:
    """Return the predicted reading of sensor i; fill f (nx,) with S' h, h its derivative by the state.

    qdd: (n,) accelerations, used where the sensor is late.
    """
    predicted = project(x, S, sensors.H[i], n if sensors.rate[i] else 0, f)
    gain, offset = sensors.gain[i], sensors.offset[i]
    if sensors.delay[i] >= 0:
        predicted += look_back(sensors, i, n, x, S, f, qdd)
    if gain >= 0:
        factor = np.exp(x[gain])
        predicted *= factor
        for c in range(f.size):
            f[c] = factor * f[c] + predicted * S[gain, c]
    if offset >= 0:
        predicted += x[offset]
        for c in range(f.size):
            f[c] += S[offset, c]
    return predicted


@inner
def note_change(sensors: MeasurementModel, ringing: Array, efforts: Array) -> None:
    """Carry on the vibration of omitted modes (3, L), excited by the changes of the efforts (L,).

    Each phasor z (rows 0 and 1) becomes exp((i w - 1 / 2 T) h) z + change: its energy |z|^2 fades with T, and changes
    that undo each other within a period cancel. Row 2: the efforts.
    """
    for j in range(ringing.shape[1]):
        real, imaginary = ringing[0, j], ringing[1, j]
        ringing[0, j] = sensors.turn[0] * real - sensors.turn[1] * imaginary + efforts[j] - ringing[2, j]
        ringing[1, j] = sensors.turn[1] * real + sensors.turn[0] * imaginary
        ringing[2, j] = efforts[j]


@inner
def omitted_variance(of_step: Array, i: int, ringing: Array) -> float:
    """Return the variance of signal i that comes from modes that the shape functions leave out (``omitted_modes``).

    of_step: (m, L) that of each signal after a step of 1 N m of each torque; ringing: (3, L), see ``note_change``.
    """
    variance: float = 0.0
    for j in range(ringing.shape[1]):
        variance += of_step[i, j] * (ringing[0, j] * ringing[0, j] + ringing[1, j] * ringing[1, j])
    return variance


@separate
def measure(sensors: MeasurementModel, m: mem.FilterState, y: Array, qdd: Array, opened: NDArray[np.int64]) -> None:
    """Update the filter with one sample; gather the power of its innovations and their information on the payload.

    qdd: (n,) accelerations; opened: see ``ProcessModel``.
    """
    x, S, f = m.x, m.S, sensors.f[:m.counts[mem.USED]]
    n = sensors.H.shape[1]
    payload = 2 * n
    for i in range(y.size):
        r = m.noise[i, mem.EFFECTIVE] + omitted_variance(sensors.omitted, i, m.ringing[0])
        e = y[i] - observe(sensors, i, n, x, S, f, qdd)
        spread = dot(f, f)
        variance = spread + r
        square = e * e / variance
        m.innovation[i, 0], m.innovation[i, 1] = e, variance
        m.power[i] += (min(square, 25.0) - m.power[i]) / min(m.counts[mem.SINCE_EVENT] + 100, 1000)
        residual = min(max(e / np.sqrt(variance), -5.0), 5.0) * np.sqrt(m.noise[i, mem.EFFECTIVE])
        m.noise[i, mem.BLOCK_SUM] += residual
        m.noise[i, mem.BLOCK_POWER] += residual * residual
        if square > OUTLIER * OUTLIER:
            r += e * e / (OUTLIER * OUTLIER) - variance
            variance = spread + r
        gain = dot(f, S[payload]) / variance
        m.noise[i, mem.WEIGHT] += gain * gain * variance
        absorb_measurement(x, S, opened, f, e, r, variance)
        white_noise(m, i, y[i])
    count_spectrum(m)
    m.counts[mem.SEEN] = min(m.counts[mem.SEEN] + 1, 2000)
    m.counts[mem.IN_A_ROW] += 1


@inner
def white_noise(m: mem.FilterState, i: int, y: float) -> None:
    """Update the variance of sensor i's white noise by a fourth difference, in which slow motion has no part."""
    recent = m.recent[i]
    if m.counts[mem.IN_A_ROW] >= 4:
        difference = y - 4.0 * recent[0] + 6.0 * recent[1] - 4.0 * recent[2] + recent[3]
        square = difference * difference / 70.0
        if m.counts[mem.SEEN] > 50:
            most = 16.0 * m.noise[i, mem.WHITE] + 1e-300
            if square > most:
                difference *= np.sqrt(most / square)
                square = most
        m.noise[i, mem.WHITE] += (square - m.noise[i, mem.WHITE]) / max(m.counts[mem.SEEN] - 3, 1)
        take_spectrum(m, i, difference)
    for p in range(3, 0, -1):
        recent[p] = recent[p - 1]
    recent[0] = y


@inner
def take_spectrum(m: mem.FilterState, i: int, difference: float) -> None:
    """Take a fourth difference of sensor i into its spectrum; after the last, bound its white noise by the median.

    Fast undamped modes enter the fourth differences as noise does. In the spectrum they are lines with white noise
    between them. The median over the frequencies is the power of that noise while lines fill less than half of the
    frequencies. Power by Goertzel's filter with Hann's window, its mean over ``SPECTRUM_MEMORY`` spectra by Welch's
    method.
    """
    first, second, power = m.spectrum[i, 0], m.spectrum[i, 1], m.spectrum[i, 2]
    k = m.counts[mem.IN_SPECTRUM]
    if k == 0:
        first[:], second[:] = 0.0, 0.0
    windowed = HANN[k] * difference
    for j in range(mem.TONES):
        now = windowed + TURN[j] * first[j] - second[j]
        second[j] = first[j]
        first[j] = now
    if k < SPECTRUM - 1:
        return
    count = min(m.counts[mem.SPECTRA] + 1, SPECTRUM_MEMORY)
    for j in range(mem.TONES):
        now = SHARE[j] * (first[j] * first[j] + second[j] * second[j] - TURN[j] * first[j] * second[j])
        power[j] += (now - power[j]) / count
    for j in range(mem.TONES):  # sorted, in what the next spectrum clears
        place = j
        while place > 0 and first[place - 1] > power[j]:
            first[place] = first[place - 1]
            place -= 1
        first[place] = power[j]
    median = 0.5 * (first[mem.TONES // 2 - 1] + first[mem.TONES // 2])
    # a mean of N powers is chi-square with 2 N degrees of freedom, whose median is below its mean (Wilson and Hilferty)
    level = median / (1.0 - 1.0 / (9.0 * count)) ** 3
    m.noise[i, mem.LEVEL] = level * np.exp(3.0 * MEDIAN_STD / np.sqrt(count))


@inner
def count_spectrum(m: mem.FilterState) -> None:
    """Count a sample of the spectra; begin them again after a sample that was missing."""
    if m.counts[mem.IN_A_ROW] < 4:
        m.counts[mem.IN_SPECTRUM] = 0
        return
    m.counts[mem.IN_SPECTRUM] += 1
    if m.counts[mem.IN_SPECTRUM] == SPECTRUM:
        m.counts[mem.IN_SPECTRUM] = 0
        m.counts[mem.SPECTRA] = min(m.counts[mem.SPECTRA] + 1, SPECTRUM_MEMORY)


@inner
def learn_noise(sensors: MeasurementModel, m: mem.FilterState) -> None:
    """At the end of a block update the variance of each sensor, larger where the innovations are not white.

    While the horizon is open the moving-horizon estimation does so instead, as the filter may not have converged.
    """
    m.counts[mem.IN_BLOCK] += 1
    if m.counts[mem.STORED] < mem.HORIZON:
        m.counts[mem.IN_BLOCK] = 0
        m.noise[:, mem.BLOCK_SUM] = 0.0
        m.noise[:, mem.BLOCK_POWER] = 0.0
    if m.counts[mem.IN_BLOCK] < sensors.block:
        return
    m.counts[mem.IN_BLOCK] = 0
    m.counts[mem.BLOCKS] = min(m.counts[mem.BLOCKS] + 1, BLOCK_MEMORY)
    blocks = m.counts[mem.BLOCKS]
    doubt = 3.0 * np.sqrt(2.0 / blocks)
    for i in range(m.noise.shape[0]):
        row = m.noise[i]
        row[mem.POWER] += (row[mem.BLOCK_POWER] / sensors.block - row[mem.POWER]) / blocks
        row[mem.SLOW] += (row[mem.BLOCK_SUM] * row[mem.BLOCK_SUM] / sensors.block - row[mem.SLOW]) / blocks
        row[mem.BLOCK_SUM] = 0.0
        row[mem.BLOCK_POWER] = 0.0
        # white noise has SLOW = POWER; a slow part that is no chance makes samples worth less
        # trust comes back slowly: the first guess, or a shock, may have been right
        row[mem.EFFECTIVE] = max(
            row[mem.POWER], row[mem.SLOW] - doubt * row[mem.POWER], row[mem.FLOOR], 0.7 * row[mem.EFFECTIVE])


@inner
def white_variance(sensor: Array, most: int) -> float:
    """Return the variance of a sensor's white noise; sensor: (11,) its row, most: column above which it is not."""
    variance: float = max(min(sensor[mem.WHITE], sensor[most]), sensor[mem.FLOOR])
    return variance


@inner
def most_white(sensor: Array, count: int) -> float:
    """Return the most that a sensor's white noise may vary, by ``count`` samples: three deviations above the estimate.

    sensor: (11,) its row. See ``OVERLAP`` for the deviation.
    """
    most: float = (1.0 + 3.0 * np.sqrt(2.0 * OVERLAP / count)) * white_variance(sensor, mem.LEVEL)
    return most


@inner
def misfit(noise: Array, rate: NDArray[np.bool_], most: int) -> float:
    """Innovation power over white noise, sensors weighted by their information on the payload; nan: there is none yet.

    noise: (m, 11), see ``filter_state``; rate: (m,) whether a sensor measures a rate. Rates are left out: they show the
    modes that the model leaves out, and have a larger noise for that. most: the column that bounds the white noise from
    above, WHITE or LEVEL.
    """
    total = sum_of_weights = 0.0
    for i in range(noise.shape[0]):
        if not rate[i]:
            total += noise[i, mem.WEIGHT] * noise[i, mem.POWER] / white_variance(noise[i], most)
            sum_of_weights += noise[i, mem.WEIGHT]
    return total / sum_of_weights if sum_of_weights > 0.0 else np.nan


@inner
def note_swing(m: mem.FilterState, y: Array) -> None:
    """Add measurements y (m,) to the sums of ``FilterState.swing``."""
    for i in range(y.size):
        if m.swing[i, 1] == 0.0:
            m.swing[i, 0] = y[i]
        difference = y[i] - m.swing[i, 0]
        m.swing[i, 1] += 1.0
        m.swing[i, 2] += difference
        m.swing[i, 3] += difference * difference


@inner
def vibrates(sensors: MeasurementModel, m: mem.FilterState) -> bool:
    """Whether a sensor has shown a vibration since the event, see ``SHOWN``; True where none shows that alone.

    Of a mass that is not accelerated nothing can be told. A fit to noise tells of it all the same, as it is linearized
    about a vibration that is not there.
    """
    shows = False
    for i in range(m.swing.shape[0]):
        count = m.swing[i, 1]
        shows |= sensors.vibration[i]
        if sensors.vibration[i] and count >= FEWEST:
            squares = m.swing[i, 3] - m.swing[i, 2] * m.swing[i, 2] / count
            if squares > SHOWN * (count - 1.0) * white_variance(m.noise[i], mem.LEVEL):
                return True
    return not shows


@inner
def judge_moves(sensors: MeasurementModel, m: mem.FilterState) -> None:
    """Compare the moves of payload and arm parameters with the fall of their variances, at the end of each batch.

    Covariance matching (Mehra, 1972): over some samples the mean of a Kalman filter moves by d. If the model is right,
    d has the variance P0 + Q - P1: the fall of the variance from P0 to P1, and the process noise Q between. So the mean
    of d^2 over that variance is 1. Larger, it is the factor by which the variances are too small. A quantity whose
    variance has hardly fallen waits for a later batch. While the horizon is open the step of the last iteration (SHIFT)
    says this instead, as the fit replaces the filter.
    """
    if m.counts[mem.RESTS] == mem.RESTING:
        return
    if m.counts[mem.STORED] < mem.HORIZON:
        m.counts[mem.IN_BATCH] = 0
        return
    m.counts[mem.IN_BATCH] += 1
    begins = m.counts[mem.IN_BATCH] == 1
    if not begins and m.counts[mem.IN_BATCH] <= BATCH * sensors.block:
        return
    m.counts[mem.IN_BATCH] = 1
    total, known = 0.0, 0
    for i in range(2 * sensors.H.shape[1], m.x.size):
        variance = dot(m.S[i], m.S[i])
        fall = m.moved[i, 1] - variance
        told = fall > LEAST_FALL * m.moved[i, 1]
        if told and not begins:
            move = m.x[i] - m.moved[i, 0]
            total += move * move / fall
            known += 1
        if told or begins:
            m.moved[i, 0] = m.x[i]
            m.moved[i, 1] = variance
    if known > 0:
        m.counts[mem.MOVED] = min(m.counts[mem.MOVED] + known, MOVES_MEMORY)
        m.score[mem.MOVES] += (total - known * m.score[mem.MOVES]) / m.counts[mem.MOVED]
