"""What the latest estimate is worth, for the identifier's diagnostics."""

from __future__ import annotations

import math

from flexmanip_ros.identification.realization import suggested_order
from flexmanip_ros.ros.diagnostics import WARN, Report
from flexmanip_ros.types import Estimate, Status


def report_estimate(report: Report, estimate: Estimate | None, order: int) -> None:
    """Add status, excitation, conditioning, order and payload to a report; order: the one configured."""
    status = Status.WARMING_UP if estimate is None else estimate.status
    payload = None if estimate is None else estimate.payload
    report.values['status'] = status.name
    model = Status.WARMING_UP if estimate is None else estimate.model_status
    report.values['model_status'] = model.name
    report.values['converged'] = status in (Status.TRACKING, Status.NO_PAYLOAD_METHOD)
    report.values['consistent'] = payload is None or payload.status is not Status.INCONSISTENT
    if status not in (Status.TRACKING, Status.WARMING_UP, Status.NO_PAYLOAD_METHOD):
        report.worse(WARN, status.value)
    if estimate is None:
        return
    report.values.update(
        excitation=estimate.excitation, condition=estimate.condition,
        innovation_power=estimate.innovation_power, modes_deviation=estimate.modes_deviation)
    if estimate.singular_values is not None:
        report.values['order'] = order
        report.values['suggested_order'] = suggested_order(estimate.singular_values)
        report.values['singular_values'] = ' '.join(f'{value:.4g}' for value in estimate.singular_values)
    if payload is not None:
        report.values.update(
            payload_mass_kg=payload.mass, payload_std_kg=payload.std,
            consistency=payload.consistency if payload.consistency is not None else math.nan)
