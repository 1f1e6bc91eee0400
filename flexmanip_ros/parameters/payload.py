"""Parameters of the payload estimators (group ``payload`` of the identifier)."""

from __future__ import annotations

from dataclasses import dataclass

from flexmanip_ros.parameters.field import check_all, parameter


@dataclass(frozen=True)
class PayloadParameters:
    """What is known beforehand of the arm and of the object, and how the payload is read from it."""

    known_coupling: bool = parameter(
        False, '`block`: use the coupling M_b of the arm model instead of identifying it (2-8 times tighter)')

    def __post_init__(self) -> None:
        check_all(self)
