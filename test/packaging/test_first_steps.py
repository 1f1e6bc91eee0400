"""Every command of the first pages of the documentation runs, in a fresh environment, and shows what the page shows."""

from __future__ import annotations

import re
import subprocess

import pytest
from fresh_environment import Fresh, blocks

WORD = 'compiling the kernels for this machine'
Done = list[tuple[str, subprocess.CompletedProcess[str]]]

pytestmark = pytest.mark.timeout(2400)  # libraries are downloaded and kernels compiled, on a machine that may be busy


def carried_out(fresh: Fresh, commands: list[str]) -> Done:
    """Run blocks one after the other, as a reader does; the first that fails ends the test."""
    done: Done = []
    for block in commands:
        done.append((block, fresh.sh(block)))
        assert done[-1][1].returncode == 0, f'{block}\n{done[-1][1].stdout[-2000:]}{done[-1][1].stderr[-2000:]}'
    return done


@pytest.fixture(scope='module')
def start_here(fresh: Fresh) -> Done:
    """Run the blocks of Start here but the first, which installed, and the last, which needs ROS."""
    first, *middle, last = blocks('start_here.md')
    assert 'pip install' in first
    assert '[ros]' in last
    return carried_out(fresh, middle)


@pytest.fixture(scope='module')
def your_own_arm(fresh: Fresh, start_here: Done) -> Done:
    """Run the blocks of Your own arm, with the file that it shows; ros2 itself needs a full installation."""
    (fresh.folder / 'my_arm.yaml').write_text(blocks('your_own_arm.md', 'yaml')[0], encoding='utf-8')
    return carried_out(fresh, [block for block in blocks('your_own_arm.md') if not block.startswith('ros2 ')])


def words(text: str) -> list[str]:
    """Return the lines, with # for each number."""
    return [re.sub(r'-?\d+(?:\.\d+)?(?:e-?\d+)?', '#', line) for line in text.splitlines() if line.strip()]


def output_of(done: Done, beginning: str) -> str:
    return next(one.stdout for block, one in done if block.startswith(beginning))


def payload(text: str) -> tuple[float, float]:
    """Return the 95 % interval of the payload [kg]."""
    found = re.search(r'^payload .* interval (\S+) \.\. (\S+) kg', text, re.MULTILINE)
    assert found is not None, text
    return float(found[1]), float(found[2])


def test_the_first_program_says_once_that_kernels_are_compiled_and_later_ones_are_silent(start_here: Done) -> None:
    told = [one.stderr.count(WORD) for _, one in start_here]
    assert told[0] == 1
    assert told[2:] == [0] * len(told[2:])


def test_start_here_finds_what_was_caught(start_here: Done) -> None:
    low, high = payload(output_of(start_here, 'identify_bag catch --report'))
    assert low - 0.05 < 20.0 < high + 0.05
    assert high - low < 0.5


def test_start_here_shows_what_is_printed(start_here: Done) -> None:
    printed = words(output_of(start_here, 'identify_bag catch --report'))
    assert printed == words(blocks('start_here.md', 'text')[0])


def test_start_here_writes_what_it_says(fresh: Fresh, start_here: Done) -> None:
    for name in ('catch', 'catch.truth.json', 'catch.html', 'catch.csv', 'study.csv'):
        assert (fresh.folder / name).exists(), name


def test_your_own_arm_is_empty_then_holds_the_object(your_own_arm: Done) -> None:
    low, high = payload(output_of(your_own_arm, 'identify_bag empty --params'))
    assert low == 0.0
    assert high < 0.01
    low, high = payload(output_of(your_own_arm, 'simulate_bag caught'))
    assert low - 0.001 < 0.3 < high + 0.001


def test_your_own_arm_shows_lines_that_are_printed(your_own_arm: Done) -> None:
    printed = {line for _, one in your_own_arm for line in words(one.stdout)}
    shown = {line for block in blocks('your_own_arm.md', 'text') for line in words(block)}
    assert shown - printed == set()


def test_the_paper_is_reproduced(fresh: Fresh, start_here: Done) -> None:
    done = fresh.sh('reproduce_paper --runs 1 --case payload_20 --output paper')
    assert done.returncode == 0, done.stderr
    assert (fresh.folder / 'paper/report.html').is_file()


def test_with_the_extra_the_demo_runs(fresh: Fresh, start_here: Done, your_own_arm: Done) -> None:
    done = carried_out(fresh, blocks('start_here.md')[-1:])
    assert (fresh.folder / 'demo_output/run_001').is_dir(), done[0][1].stdout
    assert WORD not in done[0][1].stderr  # the same installation, compiled already
