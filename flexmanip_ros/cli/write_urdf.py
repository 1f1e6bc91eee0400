"""write_urdf: describe the arm as URDF, for robot_state_publisher and RViz.

Each link is a chain of segments that bends with its deflection in JointState. robot_state_publisher needs no more than
the plant's ``joint_states``: the segments' joints mimic ``link1_bend`` and ``link2_bend``, whose values [m] times a
constant give the angles of the first sine shape. joint2 turns against the tip tangent of link 1, as the encoder does.
"""

from __future__ import annotations

import argparse
import math
import sys
import xml.etree.ElementTree as ET
from functools import partial
from typing import TYPE_CHECKING

from flexmanip_ros.cli import console
from flexmanip_ros.errors import ModelError
from flexmanip_ros.io.parameter_file import load_arm
from flexmanip_ros.parameters import ArmParameters

if TYPE_CHECKING:
    from flexmanip_ros.types import Array

PROG = 'write_urdf'
MOST_SEGMENTS = 10_000
"""Largest number of segments of a link; the file has 0.7 kB each, and a viewer draws every one."""
EXAMPLES = """examples:
  write_urdf --params config/arms/reference.yaml --output arm.urdf
  write_urdf --set 'arm.link_length=[1.0, 0.8]' --segments 20 > arm.urdf

exit status: 0 on success; 2 on bad arguments, with one line on stderr.
"""


def _parser() -> console.Parser:
    made = console.parser(
        PROG, 'Write the arm as URDF. Its links are chains of segments that bend with the joint states.', EXAMPLES)
    console.add_parameters(made, 'plant_simulator or rpbsid_identifier')
    made.add_argument('--segments', metavar='N', type=lambda text: console.whole(text, MOST_SEGMENTS), default=12,
                      help='segments of each link; default: 12')
    made.add_argument('--output', metavar='FILE', help='file to write; default: standard output')
    return made


def _main(given: argparse.Namespace) -> int:
    from flexmanip_ros.io.outputs import check_apart, check_place, write_text

    if given.output is not None:
        check_place(given.output)
    check_apart({'--output': given.output}, given.params)
    text = urdf(load_arm(given.params, given.set), given.segments)
    if given.output is not None:
        write_text(given.output, text)
    else:
        print(text, end='')
    return console.SUCCESS


COLOURS = ('0.20 0.45 0.70 1', '0.85 0.50 0.15 1')


def urdf(arm: ArmParameters, segments: int = 12) -> str:
    """Return the description as XML text, for encoder angles. segments: number of segments of each link.

    Raises ModelError for fewer than two segments and for chord angles.
    """
    if arm.angle_convention == 'chord':
        raise ModelError("the joints of a URDF turn by encoder angles, and arm.angle_convention is 'chord'",
                         'publish encoder angles and give arm.angle_convention encoder; chord angles are drawn by '
                         'live_view, and in RViz by the markers of the identifier')
    if segments < 2:
        raise ModelError(f'{segments} segments cannot bend', 'draw at least two segments a link')
    robot = ET.Element('robot', name='flexible_arm')
    _link(robot, 'base_link')
    parent = 'base_link'
    for link in range(len(arm.link_length)):
        parent = _flexible_link(robot, arm, link, segments, parent)
    tip = f'link{len(arm.link_length)}_tip'
    _link(robot, tip, arm.tip_mass, arm.tip_inertia, 'body', '0.3 0.3 0.3 1', radius=min(arm.link_length) / 30)
    _joint(robot, f'{tip}_mount', 'fixed', parent, tip)
    ET.indent(robot)
    return '<?xml version="1.0"?>\n' + ET.tostring(robot, encoding='unicode') + '\n'


def segment_angles(arm: ArmParameters, link: int, segments: int) -> Array:
    """Return the turn of each piece against the one before per metre of measured deflection, (segments + 1,) [rad/m].

    The directions are the root tangent, the secants of the segments and the tip tangent of
    w = b sin(pi x / L) / sin(pi s).
    """
    import numpy as np  # not before the arguments are parsed

    L = arm.link_length[link]
    x = np.linspace(0.0, L, segments + 1)
    scale = 1.0 / np.sin(np.pi * arm.sensor_position[link])
    secants = np.diff(np.sin(np.pi * x / L)) * scale / np.diff(x)
    end = np.pi / L * scale
    return np.diff(np.concatenate([[end], secants, [-end]]))


def _flexible_link(robot: ET.Element, arm: ArmParameters, link: int, segments: int, parent: str) -> str:
    """Add joint, sensor and segments of a link to its parent's frame; return its last frame."""
    name = f'link{link + 1}'
    L, rho = arm.link_length[link], arm.linear_density[link]
    bend, h = f'{name}_bend', L / segments
    turns = segment_angles(arm, link, segments)
    root, chord, sensor, end = (f'{name}_{part}' for part in ('root', 'chord', 'bend_sensor', 'end'))
    _link(robot, root)
    _joint(robot, f'joint{link + 1}', 'continuous', parent, root)
    _link(robot, chord)
    _joint(robot, f'{chord}_turn', 'continuous', root, chord,
           mimic=(bend, -math.pi / L / math.sin(math.pi * arm.sensor_position[link])))
    _link(robot, sensor)
    _joint(robot, bend, 'prismatic', chord, sensor, arm.sensor_position[link] * L, limit=L / 2)
    parent, offset = root, 0.0
    for index in range(segments):
        child = f'{name}_segment{index + 1}'
        _link(robot, child, rho * h, rho * h**3 / 12, str(link), COLOURS[link], box=(h, L / 60, L / 40))
        _joint(robot, f'{child}_turn', 'continuous', parent, child, offset, mimic=(bend, turns[index]))
        parent, offset = child, h
    is_last = link == len(arm.link_length) - 1
    _link(robot, end, 0.0 if is_last else arm.joint_mass, arm.joint_inertia, str(link), COLOURS[link],
          radius=min(arm.link_length) / 30)
    _joint(robot, f'{end}_turn', 'continuous', parent, end, offset, mimic=(bend, turns[-1]))
    return end


def _link(robot: ET.Element, name: str, mass: float = 0.0, inertia: float = 0.0, material: str = '', colour: str = '',
          *, box: tuple[float, float, float] | None = None, radius: float = 0.0) -> None:
    """Add a link; one with a mass is drawn as a box that begins at its frame, or else as a sphere around it."""
    link = ET.SubElement(robot, 'link', name=name)
    if not mass:
        return
    centre = f'{box[0] / 2 if box else 0.0:.9g} 0 0'
    inertial = ET.SubElement(link, 'inertial')
    ET.SubElement(inertial, 'origin', xyz=centre)
    ET.SubElement(inertial, 'mass', value=f'{mass:.9g}')
    turning = f'{max(inertia, 1e-9):.9g}'
    ET.SubElement(inertial, 'inertia', ixx=turning, ixy='0', ixz='0', iyy=turning, iyz='0', izz=turning)
    visual = ET.SubElement(link, 'visual')
    ET.SubElement(visual, 'origin', xyz=centre)
    geometry = ET.SubElement(visual, 'geometry')
    if box:
        ET.SubElement(geometry, 'box', size=' '.join(f'{side:.6g}' for side in box))
    else:
        ET.SubElement(geometry, 'sphere', radius=f'{radius:.6g}')
    ET.SubElement(ET.SubElement(visual, 'material', name=f'colour_{material}'), 'color', rgba=colour)


def _joint(robot: ET.Element, name: str, kind: str, parent: str, child: str, offset: float = 0.0, *,
           mimic: tuple[str, float] | None = None, limit: float = 0.0) -> None:
    """Add a joint at an offset along the parent [m]. mimic: joint whose position it follows, and the factor."""
    joint = ET.SubElement(robot, 'joint', name=name, type=kind)
    ET.SubElement(joint, 'parent', link=parent)
    ET.SubElement(joint, 'child', link=child)
    ET.SubElement(joint, 'origin', xyz=f'{offset:.9g} 0 0')
    if kind != 'fixed':
        ET.SubElement(joint, 'axis', xyz='0 1 0' if kind == 'prismatic' else '0 0 1')
    if limit:
        ET.SubElement(joint, 'limit', lower=f'{-limit:.9g}', upper=f'{limit:.9g}', effort='0', velocity='0')
    if mimic:
        ET.SubElement(joint, 'mimic', joint=mimic[0], multiplier=f'{mimic[1]:.9g}', offset='0')


main = partial(console.start, _parser, _main)

if __name__ == '__main__':
    sys.exit(main())
