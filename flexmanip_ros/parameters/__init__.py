"""Every parameter of the package: the only place of defaults, units, ranges and words."""

from flexmanip_ros.parameters.arm import ArmParameters
from flexmanip_ros.parameters.controller import ControllerParameters
from flexmanip_ros.parameters.excitation import ExcitationParameters
from flexmanip_ros.parameters.field import Leaf, check, configure, flatten, leaves, parameter
from flexmanip_ros.parameters.identifier import IdentifierParameters
from flexmanip_ros.parameters.payload import PayloadParameters
from flexmanip_ros.parameters.plant import PlantParameters
from flexmanip_ros.parameters.trigger import TriggerParameters

__all__ = [
    'ArmParameters', 'ControllerParameters', 'ExcitationParameters', 'IdentifierParameters', 'Leaf',
    'PayloadParameters', 'PlantParameters', 'TriggerParameters', 'check', 'configure', 'flatten', 'leaves',
    'parameter',
]
