"""All parameters of the package. Defaults, units, ranges and descriptions are declared here only."""

from flexmanip_ros.parameters.arm import (
    ActuatorParameters,
    ArmParameters,
    DemoParameters,
    ExcitationParameters,
    PlantParameters,
    SensorParameters,
)
from flexmanip_ros.parameters.field import Leaf, check, configure, flatten, leaves
from flexmanip_ros.parameters.identifier import IdentifierParameters, PayloadParameters
from flexmanip_ros.parameters.nodes import AdapterParameters, ControllerParameters, TriggerParameters, ViewParameters

__all__ = [
    'ActuatorParameters', 'AdapterParameters', 'ArmParameters', 'ControllerParameters', 'DemoParameters',
    'ExcitationParameters', 'IdentifierParameters', 'Leaf', 'PayloadParameters', 'PlantParameters', 'SensorParameters',
    'TriggerParameters', 'ViewParameters', 'check', 'configure', 'flatten', 'leaves',
]
