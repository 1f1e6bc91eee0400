"""Declared parameters: each accepts its default, rejects what is wrong by name, and is declared once."""

from __future__ import annotations

import contextlib
import math
import pickle
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexmanip_ros import parameters
from flexmanip_ros.errors import FlexmanipError, ParameterError
from flexmanip_ros.parameters import IdentifierParameters, configure, flatten, leaves

GROUPS = [getattr(parameters, name) for name in parameters.__all__ if name.endswith('Parameters')]
PACKAGE = Path(parameters.__file__).parent


@pytest.mark.parametrize('cls', GROUPS)
def test_every_parameter_says_what_it_is_and_accepts_its_own_default(cls: type) -> None:
    for leaf in leaves(cls):
        assert leaf.words, leaf.name
        assert parameters.check(leaf, leaf.default) == leaf.default


def test_every_declared_class_is_offered_by_the_package() -> None:
    text = '\n'.join(path.read_text(encoding='utf-8') for path in PACKAGE.glob('*.py'))
    assert {cls.__name__ for cls in GROUPS} == set(re.findall(r'^class (\w+Parameters)', text, re.MULTILINE))


@pytest.mark.parametrize('cls', GROUPS)
def test_a_choice_is_explained_or_names_itself(cls: type) -> None:
    """A text with choices that are not plain words of the field says what each of them does."""
    plain = {'shape'}
    for leaf in leaves(cls):
        for choice in leaf.choices if leaf.name.rpartition('.')[2] not in plain else ():
            assert choice in leaf.words, f'{leaf.name}: {choice}'


@pytest.mark.parametrize('cls', GROUPS)
def test_flat_names_and_values_rebuild_the_same_configuration(cls: type) -> None:
    assert configure(cls, flatten(cls())) == cls()


@pytest.mark.parametrize(('values', 'words'), [
    ({'ordr': 4}, "did you mean 'order'"),
    ({'order': 0}, 'order'),
    ({'order': 4.5}, 'whole number'),
    ({'order': True}, 'whole number'),
    ({'arm.link_length': [3.0, 3.0, 3.0]}, 'arm.link_length'),
    ({'arm.link_length': [3.0, -1.0]}, 'arm.link_length'),
    ({'arm.link_length': [3.0, math.nan]}, 'arm.link_length'),
    ({'arm.link_length': 3.0}, 'list of numbers'),
    ({'outputs': ['link1_bend']}, 'NAME/FIELD'),
    ({'outputs': ['a/position', 'a/position']}, 'twice'),
    ({'inputs': ['']}, 'inputs'),
    ({'angles': ['joint1/position']}, 'angles'),
    ({'payload_method': 'magic'}, 'structured'),
    ({'future_window': 11}, 'past_window'),
    ({'order': 21}, 'order'),
])
def test_a_wrong_parameter_is_named_with_the_way_out(values: dict[str, object], words: str) -> None:
    with pytest.raises(ParameterError, match=words) as caught:
        configure(IdentifierParameters, values)
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize('cls', [parameters.TriggerParameters, parameters.ViewParameters])
@pytest.mark.parametrize(('signals', 'words'), [(['joint1'], 'NAME/FIELD'), (['a/effort', 'a/effort'], 'twice')])
def test_each_node_refuses_a_signal_that_is_none(cls: type, signals: list[str], words: str) -> None:
    with pytest.raises(ParameterError, match=words):
        configure(cls, {'inputs': signals})


@pytest.mark.parametrize(('values', 'words'), [
    ({'arm.link_length': [1.0], 'arm.hub_inertia': [1.0, 2.0]},
     "parameter 'arm.hub_inertia' has 2 elements, but arm.link_length has 1; give 1 number"),
    ({'arm.hub_inertia': [1.0]}, "'arm.hub_inertia' has 1 element, but arm.link_length has 2; give 2 numbers"),
    ({'sensors.bias': [0.1] * 4}, "'sensors.bias' has 4 elements, but arm.link_length has 2; give 8 numbers"),
    ({'arm.base_mass': 1.0}, "'arm.base_mass' is 1.0 kg, but 'arm.base_inertia' is 0"),
    ({'arm.gravity': [1.0]}, "'arm.gravity' has 1 element; give 2 numbers"),
    ({'arm.base_mass': 1.0, 'arm.base_inertia': 1.0, 'arm.gravity': [0.0, 1.0]},
     "parameters 'arm.base_mass' and 'arm.gravity' are both set"),
])
def test_an_error_names_a_parameter_with_its_group_and_counts_in_plain_english(
        values: dict[str, object], words: str) -> None:
    with pytest.raises(ParameterError, match=re.escape(words)):
        configure(parameters.PlantParameters, values)


@pytest.mark.parametrize(('times', 'words'), [
    ({'capture_time': 1e300}, "'capture_time' is 1e+300 s; give a value from -1 to 1e+09 s"),
    ({'release_time': 1e300}, "'release_time' is 1e+300 s; give a value from -1 to 1e+09 s"),
    ({'capture_time': 2.0, 'release_time': 2.0}, "'release_time' is 2 s; it must come after the capture (2 s)"),
])
def test_a_time_that_no_stamp_holds_or_a_release_that_does_not_follow_its_capture_is_refused(
        times: dict[str, float], words: str) -> None:
    with pytest.raises(ParameterError, match=re.escape(words)):
        configure(parameters.TriggerParameters, {'mode': 'time', **times})


def test_an_empty_text_stands_for_the_empty_list_that_ros_cannot_write() -> None:
    assert configure(IdentifierParameters, {'angles': ['']}).angles == ()


@given(st.dictionaries(
    st.sampled_from([leaf.name for leaf in leaves(IdentifierParameters)] + ['nonsense']),
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5),
              st.lists(st.one_of(st.floats(), st.text(max_size=3)), max_size=4)), max_size=4))
def test_any_values_give_a_configuration_or_one_of_our_errors(values: dict[str, object]) -> None:
    with contextlib.suppress(FlexmanipError):
        configure(IdentifierParameters, values)


def test_an_error_keeps_its_words_through_a_worker_process() -> None:
    error = ParameterError('it is wrong', 'do this')
    again = pickle.loads(pickle.dumps(error))
    assert str(again) == 'it is wrong; do this'
