"""Claim: with the payload estimate a move settles sooner than without, and bends the links no more.

The nonlinear arm (3 modes a link, 40 dB) holds its angles, catches an object of 20, 50 or 100 kg that drifts
at 0.1 m/s, and 3 s later moves both joints by 0.1 rad. The same run three times: without the estimate, with
the identifier's own (run in the loop, as its node does), and with the true payload from the capture on. The
torque of the controller is all the excitation there is. Bends are told from the capture to the move, where
the estimate changes the gains, and from the move on.

Then a floating base whose arm catches a body of 60 kg that spins, its centre of mass 0.54 m from the tip; torques of 30
and 15 N m are added until the move. Once more with the mass of the estimate alone. Use: control_payload.py
"""

from __future__ import annotations

from typing import Any

import claims
import numpy as np

from flexmanip_ros import pipeline
from flexmanip_ros.arm.capture import free_object
from flexmanip_ros.control import controller
from flexmanip_ros.control.handover import PayloadEstimate
from flexmanip_ros.parameters import (
    ArmParameters,
    ControllerParameters,
    ExcitationParameters,
    IdentifierParameters,
    PlantParameters,
)
from flexmanip_ros.simulation import simulator, waveforms
from flexmanip_ros.types import CaptureEvent, EventKind

CAPTURE, MOVE, COUNT = 1000, 4000, 10000
STEP = np.array([0.1, -0.1])
BAND = 0.005
"""Settled: both angles stay within this of the goal [rad]."""
ARM = ArmParameters(damping_ratio=0.003)
FLOATING = ArmParameters(damping_ratio=0.003, base_mass=700.0, base_inertia=180.0, base_joint_offset=(0.4, 0.2))
BODY = PlantParameters(
    arm=FLOATING, payload_mass=60.0, payload_com=(0.5, 0.2), payload_inertia=10.0, object_velocity=(0.02, -0.03),
    object_spin=0.2)


def run(plant: PlantParameters, knows: str, added: np.ndarray) -> dict[str, Any]:
    """Return settling time after the move [s], peak bend [mm] of it, and the payload scheduled on.

    added: (COUNT, 2) torques beside those of the controller.
    """
    config, wanted = ControllerParameters(arm=plant.arm), IdentifierParameters(arm=plant.arm)
    state, body, torque = controller.init(config), simulator.init(plant), np.zeros(2)
    identifier = pipeline.init()
    positions = np.empty((COUNT, 4))
    for k in range(COUNT):
        if k == CAPTURE:
            body = simulator.attach(plant, body)
            event = CaptureEvent(simulator.stamp(plant, body), EventKind.CAPTURE)
            identifier, _ = pipeline.step(wanted, identifier, event)
            if knows == 'truth':
                state = state._replace(trusted=free_object(plant).payload)
        if k == MOVE:
            state = controller.goto(state, positions[:200, :2].mean(axis=0) + STEP)
        body, record = simulator.step(plant, body, torque)
        positions[k] = record.position
        if knows in ('estimate', 'mass'):
            identifier, estimates = pipeline.step(wanted, identifier, record)
            for found in estimates:
                if found.payload is not None:
                    believed = PayloadEstimate(*found.payload[:5])
                    if knows == 'estimate':
                        believed = believed._replace(com=found.payload.com[:2], inertia=found.payload.inertia[5])
                    state = controller.estimate(config, state, believed)
        measured = controller.Measured(record.position, record.velocity, added[k])
        state, torque = controller.step(config, state, measured)
    error = np.abs(smooth(positions[MOVE:, :2] - positions[:200, :2].mean(axis=0) - STEP)).max(axis=1)
    outside = np.flatnonzero(error > BAND)
    return {
        'mass_kg': plant.payload_mass, 'body': plant.payload_inertia > 0.0, 'knows': knows,
        'settling_s': float((outside[-1] + 1) / 1000.0) if outside.size else 0.0,
        'settled': bool(outside.size == 0 or outside[-1] + 1 < len(error)),
        'peak_bend_capture_mm': float(np.abs(positions[CAPTURE:MOVE, 2:]).max() * 1e3),
        'peak_bend_move_mm': float(np.abs(positions[MOVE:, 2:]).max() * 1e3),
        'end_bend_mm': float(np.abs(positions[-1000:, 2:]).max() * 1e3),
        'scheduled': state.payload.tolist(),
    }


def smooth(values: np.ndarray) -> np.ndarray:
    """Return the mean over 20 ms: the angle, not its noise."""
    kernel = np.ones(20) / 20
    return np.stack([np.convolve(values[:, k], kernel, 'valid') for k in range(values.shape[1])], axis=1)


def main() -> None:
    """Run every case; print a table and write JSON."""
    none, waves = np.zeros((COUNT, 2)), ExcitationParameters()
    waved = waveforms.scaled(waves, (30.0, 15.0), np.arange(COUNT)) * (np.arange(COUNT) < MOVE)[:, None]
    print('| payload kg | body | controller knows | scheduled kg | settling s | peak bend mm: capture | move | end |')
    print('|---|---|---|---|---|---|---|---|')
    rows = []
    points = [PlantParameters(payload_mass=mass, object_velocity=(0.1, 0.0), arm=ARM) for mass in (20.0, 50.0, 100.0)]
    for plant, knows in [*((plant, knows) for plant in points for knows in ('nothing', 'estimate', 'truth')),
                         *((BODY, knows) for knows in ('nothing', 'mass', 'estimate', 'truth'))]:
        row = run(plant, knows, waved if plant is BODY else none)
        rows.append(row)
        settling = f'{row["settling_s"]:.2f}' if row['settled'] else f'> {row["settling_s"]:.1f}'
        print(f'| {row["mass_kg"]:.0f} | {"yes" if row["body"] else "no"} | {knows} | {row["scheduled"][0]:.2f} | '
              f'{settling} | {row["peak_bend_capture_mm"]:.2f} | {row["peak_bend_move_mm"]:.2f} | '
              f'{row["end_bend_mm"]:.2f} |', flush=True)
    claims.write('control_payload', rows)


if __name__ == '__main__':
    main()
