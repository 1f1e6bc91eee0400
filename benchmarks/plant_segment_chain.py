"""Component modes with shortening follow a chain of 40 segments a link within 2 %, sines alone do not.

Bends and encoder angles, 3 s at large angles under the same torques; the chain is simulated by MuJoCo.
Relative root-mean-square differences over the run, each signal by its own deviation from the mean. The
chain: pieces of length L / 40 (half ones at the ends) joined by hinges of stiffness EI / (L / 40), so that
bending is summed by the midpoint rule, damping proportional to stiffness as in the plant. MuJoCo's implicit
integrator is of first order: at steps of 20 us its own drift is 0.4 % of joint 2 in the largest motion, at
the 10 us taken here half of that.

Use: python benchmarks/plant_segment_chain.py [--time SECONDS]
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import claims
import mujoco
import numpy as np

from flexmanip_ros.parameters import ArmParameters, ExcitationParameters, PlantParameters
from flexmanip_ros.simulation import excitation, simulator

SEGMENTS = 40
STEP = 1e-5
ARM = ArmParameters(damping_ratio=0.003)
CASES = {  # chord angles [deg], torque scale on 10 / 5 N m square waves
    '20/80 deg, small': ((20.0, 80.0), 1.0),
    '20/80 deg, large': ((20.0, 80.0), 6.0),
    '0/0 deg, large': ((0.0, 0.0), 4.0),
}


def piece(link: int, index: int, arm: ArmParameters) -> tuple[float, float, float, float]:
    """Length, mass, centre and inertia of a piece; the last one carries the body at the link's end."""
    L, rho = arm.link_length[link], arm.linear_density[link]
    h = L / SEGMENTS
    length = h / 2 if index in (0, SEGMENTS) else h
    mass, centre, inertia = rho * length, length / 2, rho * length**3 / 12
    end = arm.joint_mass if link == 0 else arm.tip_mass
    if index == SEGMENTS and end:
        total = mass + end
        joined = (mass * centre + end * length) / total
        inertia += mass * (centre - joined) ** 2 + end * (length - joined) ** 2
        mass, centre = total, joined
    return length, mass, centre, inertia


def chain(arm: ArmParameters, theta: tuple[float, float]) -> mujoco.MjModel:
    """Both links as one tree of planar hinges."""
    text, close, offset = [], 0, 0.0
    for link in range(2):
        L, EI, rho = arm.link_length[link], arm.bending_stiffness[link], arm.linear_density[link]
        k = EI / (L / SEGMENTS)
        beta = 2 * arm.damping_ratio / ((np.pi / L) ** 2 * np.sqrt(EI / rho))
        for index in range(SEGMENTS + 1):
            length, mass, centre, inertia = piece(link, index, arm)
            name = f'link{link + 1}_{index}'
            turn = 0.0 if index else (theta[0] if link == 0 else theta[1] - theta[0])
            spring = f'stiffness="{k}" damping="{beta * k}"' if index else ''
            text.append(
                f'<body name="{name}" pos="{offset} 0 0" euler="0 0 {turn}">'
                f'<joint name="{name}" type="hinge" axis="0 0 1" {spring}/>'
                f'<inertial pos="{centre} 0 0" mass="{mass}" diaginertia="{inertia} {inertia} {inertia}"/>')
            close += 1
            offset = length
    text.append(f'<site name="tip" pos="{offset} 0 0"/>')
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><compiler angle="radian"/><option gravity="0 0 0" timestep="{STEP}" integrator="implicit"/>'
        f'<worldbody>{"".join(text)}{"</body>" * close}</worldbody></mujoco>')


def simulate_chain(
    arm: ArmParameters, theta: tuple[float, float], efforts: np.ndarray, dt: float,
) -> np.ndarray:
    """Positions (N, 4) of the chain: encoder angles, then mid-span deflections from the chords."""
    model = chain(arm, theta)
    data = mujoco.MjData(model)
    first, second = 0, SEGMENTS + 1
    middle = [model.body(f'link{i}_{SEGMENTS // 2}').id for i in (1, 2)]
    elbow, tip = model.body('link2_0').id, model.site('tip').id
    h = [L / SEGMENTS for L in arm.link_length]
    rows = np.empty((len(efforts), 4))
    steps = round(dt / STEP)
    for k, torque in enumerate(efforts):
        mujoco.mj_kinematics(model, data)
        roots = (np.zeros(3), data.xpos[elbow])
        ends = (data.xpos[elbow], data.site_xpos[tip])
        for i in range(2):
            chord = (ends[i] - roots[i])[:2]
            along = chord / np.linalg.norm(chord)
            centre = data.xmat[middle[i]].reshape(3, 3)[:, 0] * h[i] / 2
            point = (data.xpos[middle[i]] + centre - roots[i])[:2]
            rows[k, 2 + i] = along[0] * point[1] - along[1] * point[0]
        rows[k, 0] = theta[0] + data.qpos[first]
        rows[k, 1] = theta[1] - theta[0] + data.qpos[second]
        data.qfrc_applied[first], data.qfrc_applied[second] = torque
        mujoco.mj_step(model, data, steps)
    return rows


def difference(a: np.ndarray, b: np.ndarray) -> list[float]:
    """Relative root-mean-square difference of each column [%]."""
    return (100 * np.sqrt(np.mean((a - b) ** 2, axis=0)) / b.std(axis=0)).tolist()


def main() -> None:
    """Run the cases, print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--time', type=float, default=3.0, help='seconds simulated a case')
    options = parser.parse_args()
    results = []
    names = ' '.join(f'{name:>10}' for name in simulator.joint_names(2))
    print(f'{"case":18} {"model":40} {"peak bend":>10} {names}  [%]')
    for name, (degrees, scale) in CASES.items():
        theta = tuple(np.radians(degrees))
        efforts = scale * excitation.sequence(ExcitationParameters(), round(1000 * options.time))
        truth = simulate_chain(ARM, theta, efforts, 1e-3)
        for shapes, second in (('sines', False), ('sines', True), ('component_modes', True)):
            arm = replace(ARM, shape_functions=shapes, shortening=second)
            config = PlantParameters(arm=arm, noise='none', initial_angles=theta)
            run = simulator.simulate(config, efforts)
            row = difference(run.position, truth)
            peak = 1e3 * float(np.abs(truth[:, 2:]).max())
            model = f'{shapes}, {"second order" if second else "the paper"}'
            print(f'{name:18} {model:40} {peak:7.1f} mm ' + ' '.join(f'{value:10.3f}' for value in row))
            results.append({'case': name, 'shape_functions': shapes, 'second_order': second,
                            'peak_bend_mm': peak,
                            'relative_rms_percent': dict(zip(simulator.joint_names(2), row, strict=True))})
    claims.write('plant_segment_chain', results)


if __name__ == '__main__':
    main()
