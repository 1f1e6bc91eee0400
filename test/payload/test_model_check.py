"""The payload of the arm's equations against the modes of the identified model."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from recording import ARM, config, event, record

from flexmanip_ros import pipeline
from flexmanip_ros.arm import linearization
from flexmanip_ros.identification import uncertainty
from flexmanip_ros.identification.uncertainty import Identified
from flexmanip_ros.parameters import (
    ArmParameters,
    ExcitationParameters,
    IdentifierParameters,
    PlantParameters,
)
from flexmanip_ros.payload import model_check, structured
from flexmanip_ros.payload.arm_modes import arm_modes, modal_participation
from flexmanip_ros.payload.model_check import Verdict
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import CaptureEvent, Estimate, JointRecord, Payload, StateSpace, Status

THETA = np.radians([60.0, 45.0])
EVENT = 1500


def model_of(arm: ArmParameters, payload: float, torque: float = 1.0, std: float = 1e-7) -> Identified:
    """The model that a perfect identifier would find: two modes, mid-span bends and their rates."""
    one = replace(arm, modes=1)
    Ac, Bc = linearization.vibration_model(one, THETA, payload)
    A, B = linearization.discretize(Ac, torque * Bc, 1e-3)
    model = StateSpace(A, B, np.eye(4), np.zeros((4, 2)), np.zeros((4, 4)), 1e-3)
    return Identified(
        model=model, spread=std * np.eye(16 + 8 + 16 + 8 + 16), singular_values=np.ones(4), excitation=1.0,
        condition=1.0, innovation_power=1.0, status=Status.TRACKING, innovation_covariance=np.eye(4),
        refined=True, samples=2000.0)


@cache
def holding_20_kg() -> tuple[IdentifierParameters, structured.StructuredState]:
    """A state that knows the arm and 20 kg, an estimate of one mode a link."""
    arm = replace(ARM, modes=1)
    settings = config(arm)
    samples = record(2.5, (event(1.5),), arm=arm)
    state = structured.advance(settings, structured.init(settings), samples.between(0, 1500))
    state = structured.event(settings, state, event(1.5))
    return settings, structured.advance(settings, state, samples.since(1500))


def compared(identified: Identified) -> tuple[Verdict, Payload, Payload]:
    settings, state = holding_20_kg()
    alone = structured.estimate(settings, state)
    configuration_range = np.array([*np.repeat(np.cos(THETA[1] - THETA[0]), 2), THETA[0], THETA[0], 0.0])
    found = model_check.check(
        settings, state, alone, configuration_range, identified, uncertainty.modes(identified), 2500, EVENT)
    assert found is not None
    return found, alone, model_check.apply(state, alone, (found,), EVENT)


@pytest.mark.parametrize('payload', [0.0, 20.0, 300.0])
@pytest.mark.parametrize('degrees', [(0.0, 0.0), (60.0, 45.0), (-10.0, 110.0)])
def test_the_arm_has_the_frequencies_of_its_linear_model(payload, degrees):
    arm = ArmParameters(modes=3, hub_inertia=(0.2, 0.1), tip_inertia=0.3)
    theta = np.radians(degrees)
    known = linearization.frequencies(linearization.vibration_model(arm, theta, payload)[0])
    found = arm_modes(arm, np.cos(theta[1:] - theta[0]), np.array([payload]), np.zeros(1), np.ones((1, 6)))
    assert found.frequency[0] == pytest.approx(known, rel=1e-9)


def test_rotary_inertia_and_stiffness_enter_the_modes_as_they_enter_the_arm():
    arm = ArmParameters(modes=2)
    stiffer = replace(arm, tip_inertia=0.4, bending_stiffness=(5500.0, 4500.0))
    known = linearization.frequencies(linearization.vibration_model(stiffer, THETA, 20.0)[0])
    found = arm_modes(arm, np.cos(THETA[1:] - THETA[0]), np.array([20.0]), np.array([0.4]),
                      np.array([[1.1, 1.1, 0.9, 0.9]]))
    assert found.frequency[0] == pytest.approx(known, rel=1e-9)


@pytest.mark.parametrize('rates', [False, True])
def test_an_exact_model_is_driven_as_the_arm_is(rates):
    arm = replace(ARM, modes=1, damping_ratio=0.0)
    known = arm_modes(arm, np.cos(THETA[1:] - THETA[0]), np.array([20.0]), np.zeros(1), np.ones((1, 2)))
    rows = np.array([2, 3] if rates else [0, 1])
    value, _ = modal_participation(model_of(arm, 20.0), np.arange(2), rows, np.full(2, rates), np.ones((2, 2)))
    assert value == pytest.approx(known.drive[0].sum(axis=(0, 1)), rel=1e-4)


def test_the_deviation_of_a_drive_is_that_of_models_drawn_from_the_spread():
    exact = model_of(replace(ARM, modes=1), 20.0)
    rng = np.random.default_rng(0)
    spread = 1e-6 * rng.standard_normal((64, 20))
    args = np.arange(2), np.arange(2), np.zeros(2, dtype=bool), np.ones((2, 2))
    _, std = modal_participation(exact._replace(spread=spread), *args)
    drawn = []
    for _ in range(400):
        change = spread @ rng.standard_normal(20)
        dA, dB, dC = change[:16].reshape(4, 4), change[16:24].reshape(4, 2), change[24:40].reshape(4, 4)
        model = exact.model
        moved = replace(model, A=model.A + dA, B=model.B + dB, C=model.C + dC)
        drawn.append(modal_participation(exact._replace(model=moved, spread=spread), *args)[0])
    assert std == pytest.approx(np.std(drawn, axis=0), rel=0.15)


def test_a_model_that_agrees_changes_nothing():
    found, alone, published = compared(model_of(ARM, 20.0))
    assert found.deviation < 0.5
    assert found.clears
    assert published is alone


def test_frequencies_of_another_payload_are_inside_the_interval_and_said():
    found, alone, published = compared(model_of(ARM, 60.0))
    assert found.deviation > 1.0
    assert alone.status is Status.TRACKING
    assert alone.upper < 21.0
    assert published.status is Status.INCONSISTENT
    assert published.lower <= 20.0
    assert published.upper >= 60.0
    assert published.mass == alone.mass


def test_frequencies_of_no_payload_open_the_interval():
    low = replace(ARM, bending_stiffness=(4000.0, 4000.0))
    high = replace(ARM, bending_stiffness=(6200.0, 6200.0))
    assert compared(model_of(low, 20.0))[2].upper == np.inf
    assert compared(model_of(high, 20.0))[2].lower == 0.0


def test_torques_of_another_scale_widen_by_the_inertia_they_would_be_the_torques_of():
    found, alone, published = compared(model_of(ARM, 20.0, torque=1.1))
    assert found.doubt == pytest.approx(0.1, abs=0.02)
    assert published.status is Status.INCONSISTENT
    assert published.std > 0.08 * (20.0 + ARM.tip_mass)
    assert alone.std < 0.01 * 20.0


def test_a_vague_model_says_nothing():
    found, alone, published = compared(model_of(ARM, 60.0, torque=1.1, std=1e-3))
    assert found.deviation < 1.0
    assert not found.clears
    assert published is alone


@pytest.mark.parametrize('change', [{'refined': False}, {'samples': 512.0}, {'status': Status.WARMING_UP}])
def test_only_a_refined_fit_of_some_length_is_heard(change):
    settings, state = holding_20_kg()
    identified = model_of(ARM, 60.0)._replace(**change)
    assert model_check.check(settings, state, structured.estimate(settings, state), np.zeros(5), identified,
                             uncertainty.modes(identified)) is None


def test_a_verdict_counts_until_the_next_event():
    _, state = holding_20_kg()
    found, alone, published = compared(model_of(ARM, 60.0))
    assert published is not alone
    assert model_check.apply(state, alone, (found,), EVENT + 100) is alone


def test_what_was_found_of_the_empty_arm_holds_after_the_capture_until_a_model_agrees_well():
    _, state = holding_20_kg()
    own, alone, _ = compared(model_of(ARM, 20.0))
    empty = Verdict(at=EVENT - 1, since=0, held=False, deviation=1.5, doubt=0.06)

    def published(*verdicts: Verdict) -> Payload:
        return model_check.apply(state, alone, verdicts, EVENT)

    assert published(empty).status is Status.INCONSISTENT
    assert published(empty, own._replace(deviation=0.8, clears=False)).std > 0.05 * 20.0
    assert published(empty, own) is alone
    assert published(empty._replace(at=EVENT)) is alone  # read before an event that came late: of another arm


def test_few_verdicts_are_kept_and_that_of_the_empty_arm_among_them():
    kept: tuple[Verdict, ...] = ()
    for at in range(0, 100_000, 200):
        since = 0 if at < 50_000 else 50_000
        kept = model_check.remember(kept, Verdict(at, since, at >= 50_000, 0.1), 400)
    assert len(kept) <= 6
    assert [one.at for one in kept if not one.held][-1] == 49_800
    assert kept[-1].at == 99_800


@pytest.mark.parametrize('sizes', [(1,), (7,), (250,), (3, 64, 1)])
def test_where_the_arm_was_does_not_depend_on_how_samples_are_grouped(sizes):
    samples = record(0.5)
    whole = model_check.extend_range(np.empty(0), samples, True)
    at, k, found = 0, 0, np.empty(0)
    while at < len(samples):
        size = sizes[k % len(sizes)]
        found = model_check.extend_range(found, samples.between(at, min(at + size, len(samples))), True)
        at, k = at + size, k + 1
    assert found.tobytes() == whole.tobytes()


@cache
def torques_read_too_high(seconds: float = 3.9) -> list[JointRecord]:
    plant = PlantParameters(payload_mass=20.0, snr_db=25.0, arm=ARM, seed=3, initial_angles=(0.2, 1.4))
    torque = excitation.sequence(ExcitationParameters(), round(1000 * seconds))
    made = simulator.simulate(plant, torque, (event(2.0),))
    return [one._replace(effort=1.1 * one.effort) for one in simulator.records(made, ())]


def followed(late: int = 0, replayed: bool = False) -> list[Estimate]:
    items: list[JointRecord | CaptureEvent] = list(torques_read_too_high())
    items.insert(2000 + late, event(2.0))
    settings = IdentifierParameters(arm=ARM)
    if replayed:
        return list(pipeline.run(settings, items))
    state, out = pipeline.init(), []
    for item in items:
        state, ready = pipeline.step(settings, state, item)
        out.extend(ready)
    _, last = pipeline.finish(settings, state)
    return list(pipeline.one_a_stamp([*out, *last]))


def test_torques_read_a_tenth_too_high_are_found_out_from_the_first_estimates_on():
    found = [one for one in followed(replayed=True) if one.stamp_ns > 2_100_000_000]
    assert all(one.payload.status is Status.INCONSISTENT for one in found)
    assert all(one.payload.lower <= 20.0 <= one.payload.upper for one in found)
    assert found[-1].modes_deviation > 1.0


def test_verdicts_are_the_same_live_replayed_and_of_an_event_that_comes_late():
    live, again, late = followed(), followed(replayed=True), followed(late=90)
    assert [repr((one.stamp_ns, one.payload, one.modes_deviation)) for one in live] == [
        repr((one.stamp_ns, one.payload, one.modes_deviation)) for one in again]
    heard = [repr((one.stamp_ns, one.payload, one.modes_deviation)) for one in late
             if one.stamp_ns > 2_100_000_000]
    assert heard == [repr((one.stamp_ns, one.payload, one.modes_deviation)) for one in live
                     if one.stamp_ns > 2_100_000_000]


def test_the_last_estimate_of_a_recording_has_heard_its_own_model():
    items: list[JointRecord | CaptureEvent] = list(torques_read_too_high())
    items.insert(2000, event(2.0))
    *_, (state, _) = pipeline.replay(IdentifierParameters(arm=ARM), items)
    last = pipeline.current(state)
    assert last is not None
    assert last.model_is_new
    assert last.modes_deviation > 1.0
    assert last.payload.status is last.status is Status.INCONSISTENT
    assert last.payload.lower <= 20.0 <= last.payload.upper
