"""A payload is printed with what it is worth: nobody takes a number for a mass that is not known."""

from __future__ import annotations

from dataclasses import replace

import pytest

from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.studies.results import ADVICE, Summary, result_rows, status_text
from flexmanip_ros.types import Status


def summary(status: Status, mass: float | None, low: float | None, high: float | None) -> Summary:
    return Summary(
        samples=100, gaps=0, sample_time_s=0.001, wall_s=0.1, status=status.name, frequencies_hz=(), damping_ratios=(),
        payload_mass_kg=mass, payload_std_kg=None, payload_ci95_kg=(low, high), consistency=1.0, capture_time_s=None,
        release_time_s=None)


def test_a_payload_that_is_tracked_is_its_mass_and_interval():
    assert summary(Status.TRACKING, 20.0, 19.5, 20.5).payload_text() == '20 kg, 95 % interval 19.5 .. 20.5 kg'


def test_an_empty_arm_holds_none_and_a_caught_object_has_its_instant():
    empty = summary(Status.TRACKING, 0.0, 0.0, 0.2)
    assert empty.payload_text() == 'none: the arm is taken as empty, 95 % interval 0 .. 0.2 kg'
    assert empty.held_since_s is None
    assert replace(empty, capture_time_s=3.0).held_since_s == 3.0
    assert replace(empty, capture_time_s=3.0, release_time_s=4.0).held_since_s is None
    assert replace(empty, capture_time_s=5.0, release_time_s=4.0).held_since_s == 5.0
    assert replace(empty, capture_time_s=4.0, release_time_s=4.0).held_since_s == 4.0, 'a release comes first'


@pytest.mark.parametrize('status', Status)
def test_every_status_is_a_sentence_with_what_to_do_next(status):
    meaning, _, advice = status_text(status).partition('; ')
    assert status.value.startswith(meaning)
    assert advice


def test_the_advice_for_a_model_without_a_payload_is_about_the_model():
    assert 'arm.' not in status_text(Status.INCONSISTENT, IdentifierParameters(payload_method='none'))


def test_signals_that_give_no_payload_are_said_with_the_reason():
    config = IdentifierParameters(angles=())
    assert 'angles does not name the position of two joints' in status_text(Status.UNOBSERVABLE, config)


def test_the_reason_of_a_model_s_status_is_said_where_the_status_is_that_of_the_model():
    reason = 'the frequency of the mode at 40 Hz has a standard deviation of 3 %'
    model = replace(summary(Status.POORLY_EXCITED, 0.0, 0.0, None), payload_ci95_kg=None, reason=reason,
                    model_status='POORLY_EXCITED')
    config = IdentifierParameters(payload_method='none')
    assert dict(result_rows(model, config, ()))['status'].startswith(
        f'POORLY_EXCITED: the signals carry too little information: {reason}; ')
    rows = dict(result_rows(replace(model, status='UNOBSERVABLE'), IdentifierParameters(angles=()), ()))
    assert reason not in rows['status']
    assert reason in rows['model']
    assert 'reason' not in model.as_json()


@pytest.mark.parametrize('status', Status)
def test_a_payload_without_an_upper_bound_is_not_known_and_no_number_is_shown(status):
    text = summary(status, 0.0, 0.0, None).payload_text()
    assert text.startswith('not known: ')
    assert not any(character.isdigit() for character in text)
    assert '; ' in text


@pytest.mark.parametrize('status', [status for status in ADVICE if status is not Status.TRACKING])
def test_a_payload_of_any_other_status_is_not_reliable_with_the_reason_and_what_to_do(status):
    text = summary(status, 20.0, 10.0, 30.0).payload_text()
    reason = status.value.partition(';')[0]
    assert text == f'not reliable: 20 kg, 95 % interval 10 .. 30 kg; {reason}; {ADVICE[status]}'


def test_every_status_has_an_advice():
    assert set(Status) == set(ADVICE)


def test_a_run_without_a_payload_method_has_no_payload():
    run = summary(Status.TRACKING, None, None, None)
    assert Summary(**{**vars(run), 'payload_ci95_kg': None}).payload_text() == 'not estimated'
