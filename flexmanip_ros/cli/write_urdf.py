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
from collections.abc import Sequence
from typing import TYPE_CHECKING

from flexmanip_ros.cli import console
from flexmanip_ros.errors import ModelError
from flexmanip_ros.io.parameter_file import load_arm
from flexmanip_ros.parameters import ArmParameters

if TYPE_CHECKING:
    from flexmanip_ros.types import Array

PROG = 'write_urdf'
EXAMPLES = """examples:
  write_urdf --params config/arms/reference.yaml --output arm.urdf
  write_urdf --set 'arm.link_length=[1.0, 0.8]' --segments 20 > arm.urdf

exit status: 0 on success; 2 on bad arguments, with one line on stderr.
"""


def _parser() -> console.Parser:
    made = console.parser(
        PROG, 'Write the arm as URDF. Its links are chains of segments that bend with the joint states.', EXAMPLES)
    console.add_parameters(made, 'plant_simulator or rpbsid_identifier')
    made.add_argument('--segments', metavar='N', type=int, default=12, help='segments of each link; default: 12')
    made.add_argument('--output', metavar='FILE', help='file to write; default: standard output')
    return made


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; return its exit status."""
    given = _parser().parse_args(arguments)
    return console.run(PROG, lambda: _main(given))


def _main(given: argparse.Namespace) -> int:
    from flexmanip_ros.io.outputs import check_apart, write_text

    check_apart({'--output': given.output}, given.params)
    text = urdf(load_arm(given.params, given.set), given.segments)
    if given.output:
        write_text(given.output, text)
    else:
        print(text, end='')
    return console.SUCCESS


COLOURS = ('0.20 0.45 0.70 1', '0.85 0.50 0.15 1')


def urdf(arm: ArmParameters, segments: int = 12) -> str:
    """Return the description as XML text, for encoder angles. segments: number of segments of each link.

    Raises ModelError for fewer than two segments.
    """
    if segments < 2:
        raise ModelError(f'{segments} segments cannot bend', 'draw at least two segments a link')
    robot = ET.Element('robot', name='flexible_arm')
    _link(robot, 'base_link')
    parent, offset = 'base_link', 0.0
    for link in range(len(arm.link_length)):
        parent, offset = _flexible_link(robot, arm, link, segments, parent, offset)
    _body(robot, f'link{len(arm.link_length)}_tip', parent, offset, arm.tip_mass, arm.tip_inertia, '0.3 0.3 0.3 1', arm)
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


def _flexible_link(
    robot: ET.Element, arm: ArmParameters, link: int, segments: int, parent: str, offset: float,
) -> tuple[str, float]:
    """Add joint, sensor and segments of a link; return its last frame and the offset of the next link in it [m]."""
    number = link + 1
    L, rho = arm.link_length[link], arm.linear_density[link]
    bend, h = f'link{number}_bend', L / segments
    root = f'link{number}_root'
    _link(robot, root)
    _joint(robot, f'joint{number}', 'continuous', parent, root, offset)
    turns = segment_angles(arm, link, segments)
    chord = f'link{number}_chord'
    _link(robot, chord)
    _joint(robot, f'{chord}_turn', 'continuous', root, chord, 0.0,
           mimic=(bend, -math.pi / L / math.sin(math.pi * arm.sensor_position[link])))
    _link(robot, f'{bend}_sensor')
    _joint(robot, bend, 'prismatic', chord, f'{bend}_sensor', arm.sensor_position[link] * L, limit=L / 2)
    parent, offset = root, 0.0
    for index in range(segments):
        child = f'link{number}_segment{index + 1}'
        element = _link(robot, child)
        _inertial(element, rho * h, rho * h**3 / 12, h / 2)
        _visual(element, h / 2, COLOURS[link], box=(h, L / 60, L / 40))
        _joint(robot, f'{child}_turn', 'continuous', parent, child, offset, mimic=(bend, turns[index]))
        parent, offset = child, h
    end = f'link{number}_end'
    mass, inertia = (arm.joint_mass, arm.joint_inertia) if link < len(arm.link_length) - 1 else (0.0, 0.0)
    _body(robot, end, parent, offset, mass, inertia, COLOURS[link], arm, mimic=(bend, turns[-1]))
    return end, 0.0


def _body(
    robot: ET.Element, name: str, parent: str, offset: float, mass: float, inertia: float, colour: str,
    arm: ArmParameters, mimic: tuple[str, float] | None = None,
) -> None:
    element = _link(robot, name)
    if mass:
        _inertial(element, mass, inertia, 0.0)
        _visual(element, 0.0, colour, radius=min(arm.link_length) / 30)
    kind = 'continuous' if mimic else 'fixed'
    _joint(robot, f'{name}_turn' if mimic else f'{name}_mount', kind, parent, name, offset, mimic=mimic)


def _link(robot: ET.Element, name: str) -> ET.Element:
    return ET.SubElement(robot, 'link', name=name)


def _inertial(link: ET.Element, mass: float, inertia: float, centre: float) -> None:
    element = ET.SubElement(link, 'inertial')
    ET.SubElement(element, 'origin', xyz=f'{centre:.9g} 0 0')
    ET.SubElement(element, 'mass', value=f'{mass:.9g}')
    turning = f'{max(inertia, 1e-9):.9g}'
    ET.SubElement(element, 'inertia', ixx=turning, ixy='0', ixz='0', iyy=turning, iyz='0', izz=turning)


def _visual(
    link: ET.Element, centre: float, colour: str, box: tuple[float, float, float] | None = None,
    radius: float = 0.0,
) -> None:
    element = ET.SubElement(link, 'visual')
    ET.SubElement(element, 'origin', xyz=f'{centre:.9g} 0 0')
    geometry = ET.SubElement(element, 'geometry')
    if box:
        ET.SubElement(geometry, 'box', size=' '.join(f'{side:.6g}' for side in box))
    else:
        ET.SubElement(geometry, 'sphere', radius=f'{radius:.6g}')
    material = ET.SubElement(element, 'material', name=f'colour_{COLOURS.index(colour)}'
                             if colour in COLOURS else 'colour_body')
    ET.SubElement(material, 'color', rgba=colour)


def _joint(
    robot: ET.Element, name: str, kind: str, parent: str, child: str, offset: float,
    mimic: tuple[str, float] | None = None, limit: float | None = None,
) -> None:
    element = ET.SubElement(robot, 'joint', name=name, type=kind)
    ET.SubElement(element, 'parent', link=parent)
    ET.SubElement(element, 'child', link=child)
    ET.SubElement(element, 'origin', xyz=f'{offset:.9g} 0 0')
    if kind != 'fixed':
        ET.SubElement(element, 'axis', xyz='0 1 0' if kind == 'prismatic' else '0 0 1')
    if limit is not None:
        ET.SubElement(element, 'limit', lower=f'{-limit:.9g}', upper=f'{limit:.9g}', effort='0', velocity='0')
    if mimic:
        ET.SubElement(element, 'mimic', joint=mimic[0], multiplier=f'{mimic[1]:.9g}', offset='0')


if __name__ == '__main__':
    sys.exit(main())
