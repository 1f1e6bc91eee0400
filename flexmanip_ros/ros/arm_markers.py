"""Markers of the arm and of the object that it holds, for RViz, Lichtblick and Foxglove."""

import math
from collections.abc import Sequence

import numpy as np
from geometry_msgs.msg import Point
from visualization_msgs.msg import Marker, MarkerArray

from flexmanip_ros.parameters import ArmParameters, IdentifierParameters
from flexmanip_ros.payload.structured_model import Quantity, signals
from flexmanip_ros.ros.conversions import time_message
from flexmanip_ros.ros.diagnostics import ADVICE
from flexmanip_ros.types import Array, JointRecord, Payload, Status

POINTS = 13
"""Number of points of the line strip that draws one link."""


def draw(arm: ArmParameters, angles: Array, bends: Array, points: int = POINTS) -> tuple[Array, float]:
    """Return the links (L, N, 2) [m], in points from root to tip, and the direction of the last tip's tangent [rad].

    The origin is joint 1. angles: of the joints (L,) [rad]; bends: deflections of the bend sensors (L,) [m].
    The deflection from the chord is the first shape function, w(x) = b sin(pi x / L) / sin(pi s), with b the reading of
    the sensor at s L. An encoder reads the slope of a link's root: link 1 from the base, link 2 from the tip of link 1.
    """
    x = np.linspace(0.0, 1.0, points)
    links = np.empty((len(arm.link_length), points, 2))
    root = np.zeros(2)
    tip = 0.0
    for k, L in enumerate(arm.link_length):
        amplitude = float(bends[k]) / np.sin(np.pi * arm.sensor_position[k])
        slope = float(np.arctan(np.pi * amplitude / L))  # of the root from the chord; that of the tip is -slope
        chord = float(angles[k]) if arm.angle_convention == 'chord' else tip + float(angles[k]) - slope
        c, s = np.cos(chord), np.sin(chord)
        w = amplitude * np.sin(np.pi * x)
        links[k, :, 0] = root[0] + c * L * x - s * w
        links[k, :, 1] = root[1] + s * L * x + c * w
        root, tip = links[k, -1], chord - slope
    return links, tip


LINK_COLOURS = (0.0, 0.45, 0.70), (0.84, 0.37, 0.0)
TRUSTED, DOUBTFUL, JOINT = (0.0, 0.45, 0.33), (0.70, 0.40, 0.0), (0.3, 0.3, 0.3)
"""Colours as red, green and blue. Those of the links are Okabe and Ito's; text is darker, legible on light grey."""
DENSITY = 1000.0
"""Density of the ball that is drawn for the object [kg/m^3]; it is that of water."""
THICKNESS = 1.0 / 60.0
"""Width of a link and radius of a joint, as a fraction of the arm's length."""


class ArmMarkers:
    """Makes the markers of one arm: links, joints, the object, its mass as text."""

    def __init__(self, config: IdentifierParameters) -> None:
        self._config = config
        known = signals(config)
        self.drawn = known is not None and known.angles
        """Whether the configured signals have the angles of the arm."""
        self._bends: list[str | None] = [None] * len(config.arm.link_length)
        if known is not None:
            for role, name in zip(known.outputs, config.outputs, strict=True):
                if role.quantity is Quantity.BEND:
                    self._bends[role.link] = name.rpartition('/')[0]
        self._joints = [name.rpartition('/')[0] for name in config.angles]
        self._width = THICKNESS * sum(config.arm.link_length)

    def message(self, record: JointRecord, payload: Payload | None) -> MarkerArray | None:
        """Return the markers; None where the record lacks an angle or has a value that is not finite."""
        found = {name: k for k, name in enumerate(record.names) if k < record.position.size}
        if any(name not in found for name in self._joints):
            return None
        angles = record.position[[found[name] for name in self._joints]]
        bends = np.array([record.position[found[name]] if name in found else 0.0 for name in self._bends])
        if not (np.isfinite(angles).all() and np.isfinite(bends).all()):
            return None
        shapes, tip_angle = draw(self._config.arm, angles, bends)
        width, tips = self._width, shapes[:, -1].tolist()
        links = [_marker('link', k, Marker.LINE_STRIP, (width, 0.0, 0.0), LINK_COLOURS[k], points=line)
                 for k, line in enumerate(shapes.tolist())]
        ends = _marker('joint', 0, Marker.SPHERE_LIST, (2.0 * width,) * 3, JOINT, points=[[0.0, 0.0], *tips])
        held = self._held(payload, tips[-1], tip_angle)
        made = MarkerArray(markers=[*links, ends, *held])
        for marker in made.markers:
            marker.header.stamp = time_message(record.stamp_ns)
            marker.header.frame_id = self._config.base_frame
        return made

    def _held(self, payload: Payload | None, tip: Sequence[float], angle: float) -> tuple[Marker, Marker]:
        """Return the object, where its mass is known, and what is known of the payload as text. angle: of the tip."""
        x, y = tip
        known = payload is not None and math.isfinite(payload.std)
        trusted = payload is not None and known and payload.status is Status.TRACKING
        colour = TRUSTED if trusted else DOUBTFUL
        mass, (com_x, com_y, _) = (payload.mass, payload.com) if payload is not None and known else (0.0, (0.0,) * 3)
        size = (6.0 * max(mass, 0.0) / (math.pi * DENSITY)) ** (1.0 / 3.0)
        ball = _marker('object', 0, Marker.SPHERE, (size,) * 3, colour)
        ball.action = Marker.ADD if mass > 0.0 else Marker.DELETE
        ball.pose.position.x = x + math.cos(angle) * com_x - math.sin(angle) * com_y
        ball.pose.position.y = y + math.sin(angle) * com_x + math.cos(angle) * com_y
        # scale.z: height of the letters; RViz makes a space as wide as half of scale.x, or that of letters of 1 m
        text = _marker('payload', 0, Marker.TEXT_VIEW_FACING, (self._width, 0.0, 2.0 * self._width), colour)
        text.pose.position.x, text.pose.position.y = x, y + 4.0 * self._width
        text.text = words(payload)
        # RViz never draws a text marker that was empty at first, and keeps the old text of one that becomes empty
        text.action = Marker.ADD if text.text else Marker.DELETE
        return ball, text


def words(payload: Payload | None) -> str:
    """Return the text about the payload beside the arm; it has numbers only where the payload is known."""
    if payload is None:
        return ''
    if not math.isfinite(payload.std):
        return f'payload not known: {ADVICE[payload.status]}'
    text = f'{payload.mass:.2f} kg (95 %: {payload.lower:.2f} to {payload.upper:.2f})'
    return text if payload.status is Status.TRACKING else f'not reliable: {text}'


def _marker(space: str, number: int, kind: int, size: tuple[float, ...], colour: tuple[float, ...],
            points: Sequence[Sequence[float]] = ()) -> Marker:
    made = Marker(ns=space, id=number, type=kind, action=Marker.ADD, points=[Point(x=x, y=y) for x, y in points])
    made.pose.orientation.w = 1.0
    made.scale.x, made.scale.y, made.scale.z = size
    made.color.r, made.color.g, made.color.b = colour
    made.color.a = 1.0
    return made
