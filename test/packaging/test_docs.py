"""What the documentation names is there: pages, files, commands, options, parameters; and it keeps its limits."""

from __future__ import annotations

import importlib
import importlib.util
import re
from dataclasses import fields
from pathlib import Path

import pytest

from flexmanip_ros.io import outputs
from flexmanip_ros.parameters import DemoParameters, leaves
from flexmanip_ros.parameters.document import NODES
from flexmanip_ros.studies.results import Summary

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted(str(path.relative_to(ROOT)) for path in (ROOT / 'docs').rglob('*.md'))
ALL = ['README.md', 'CONTRIBUTING.md', *PAGES]
SETUP = (ROOT / 'setup.py').read_text(encoding='utf-8')
PROGRAMS = ('identify_bag', 'simulate_bag', 'live_view', 'monte_carlo', 'reproduce_paper', 'write_urdf')
"""Programs of ``cli/``; their --help is cheap."""
OF_EVERY_NODE = {'autostart', 'use_sim_time'}
PARAMETERS = {leaf.name for declared in NODES.values() for leaf in leaves(declared)}
FOLDERS = ('flexmanip_ros', 'config', 'docs', 'test', 'benchmarks', 'requirements', 'launch')
FILE = re.compile(r'`((?:[\w.-]+/)*[\w.-]+\.(?:py|md|yaml|xml|rst|toml))\b')
ENDINGS = ('py', 'md', 'yaml', 'xml', 'html', 'csv')
"""What stands behind the point in the name of a file."""
STARTED = re.compile(r"(?:^\.venv/bin/|^ros2 run (?:--prefix '[^']*' )?flexmanip_ros )([a-z]\w+)")
REMOVED = (
    'PM QoS', 'wake_latency', 'SCHED_FIFO', 'thread_priority', 'cpu_affinity', 'cpu_dma_latency', 'garbage collector',
    'pre-rendered', 'salvage',
)
"""Words of machinery that is gone: nothing here changes anything machine-wide."""


def text_of(page: str) -> str:
    return (ROOT / page).read_text(encoding='utf-8')


def commands(page: str) -> list[str]:
    """Return the lines of the code blocks, those that end in a backslash joined, comments taken off."""
    text = text_of(page)
    blocks = re.findall(r'^```\w*\n(.*?)^```', text, re.MULTILINE | re.DOTALL)
    blocks += re.findall(r'(?:^ {4}\S.*\n)+', text, re.MULTILINE)
    joined = '\n'.join(blocks).replace('\\\n', ' ')
    return [line.split(' #')[0].strip() for line in joined.splitlines() if line.strip()]


def inline(page: str) -> list[str]:
    return re.findall(r'`([^`\n]+)`', text_of(page))


@pytest.mark.parametrize('page', ALL)
def test_a_link_leads_to_a_file(page: str) -> None:
    for link in re.findall(r'\]\(([^)#\s]+)', text_of(page)):
        assert '://' in link or ((ROOT / page).parent / link).exists(), f'{page} links to {link}'


def test_every_page_is_in_the_contents() -> None:
    linked = {(ROOT / 'docs' / link).resolve() for link in re.findall(r'\]\(([^)#\s]+)', text_of('docs/index.md'))}
    missing = [page for page in PAGES if page != 'docs/index.md' and (ROOT / page) not in linked]
    assert missing == []


@pytest.mark.parametrize('page', ALL)
def test_a_file_that_is_named_exists(page: str) -> None:
    known = {path.name for folder in FOLDERS for path in (ROOT / folder).rglob('*.*')}
    for name in FILE.findall(text_of(page)):
        whole = name.split('/')[0] in FOLDERS
        if '/' in name and (whole or name.endswith('.py')):
            assert (ROOT / name).is_file() or (ROOT / 'flexmanip_ros' / name).is_file(), f'{page} names {name}'
        elif name.endswith('.py'):
            assert name in known or (ROOT / name).is_file(), f'{page} names {name}'


@pytest.mark.parametrize('page', ALL)
def test_a_function_that_is_named_exists(page: str) -> None:
    """As `folder/file.py` (`function`), `module.function` or `Class.attribute`."""
    files = {path.stem: path.read_text(encoding='utf-8') for path in (ROOT / 'flexmanip_ros').rglob('*.py')}
    everything = '\n'.join(files.values())
    text = text_of(page)
    for file, name in re.findall(r'`(?:[\w/]*/)?(\w+)\.py` \(`([\w.]+)`\)', text):
        assert re.search(rf'\b(?:def|class) {name.split(".")[-1]}\b', files[file]), f'{page}: {name} of {file}.py'
    for module, name in re.findall(r'`(\w+)\.(\w+)`', text):
        known = rf'\b(?:def|class) {name}\b|^ *{name}\b.*[:=]'
        if module in files and module not in parameter_groups() and name not in ENDINGS:
            assert re.search(known, files[module], re.MULTILINE), f'{page}: {module}.{name}'
        elif re.match(r'[A-Z][a-z]+\w*$', module) and f'class {module}' in everything:
            assert re.search(known, everything, re.MULTILINE), f'{page}: {module}.{name}'


def parameter_groups() -> set[str]:
    """Return the groups of parameters, some of which have the name of a module: ``arm``, ``payload``."""
    return {name.split('.')[0] for name in PARAMETERS if '.' in name} | {'plant', 'excitation', 'identifier'}


@pytest.mark.parametrize('page', ALL)
def test_a_folder_that_is_named_exists(page: str) -> None:
    for name in re.findall(r'`((?:[\w.-]+/)+)`', text_of(page)):
        made = name.startswith(('demo_output/', '.venv/'))  # by the demo and by make setup
        there = (ROOT / name).is_dir() or (ROOT / 'flexmanip_ros' / name).is_dir()
        assert made or there, f'{page} names the folder {name}'


@pytest.mark.parametrize('page', ALL)
def test_a_command_starts_something_that_exists(page: str) -> None:
    targets = set(re.findall(r'^(\w+):', (ROOT / 'Makefile').read_text(encoding='utf-8'), re.MULTILINE))
    for command in [*commands(page), *inline(page)]:
        for target in re.findall(r'^make (\w+)', command):
            assert target in targets, f'{page}: {command}'
        for program in STARTED.findall(command):
            assert re.search(rf"'{program}(?:'| = )", SETUP), f'{page}: {command}'
        for file, rest in re.findall(r'^ros2 launch flexmanip_ros (\S+)(.*)', command):
            assert (ROOT / 'launch' / file).is_file(), f'{page}: {command}'
            launch = (ROOT / 'launch' / file).read_text(encoding='utf-8')
            assert all(f"'{name}'" in launch for name in re.findall(r'(\w+):=', rest)), f'{page}: {command}'
        for module in re.findall(r'python3? -m (flexmanip_ros[\w.]+)', command):
            assert importlib.util.find_spec(module) is not None, f'{page}: {command}'


@pytest.mark.parametrize('program', PROGRAMS)
def test_an_option_that_is_named_is_one_of_the_program(program: str, capsys: pytest.CaptureFixture[str]) -> None:
    main = importlib.import_module(f'flexmanip_ros.cli.{program}').main
    with pytest.raises(SystemExit):
        main(['--help'])
    known = set(re.findall(r'--[a-z][\w-]*', capsys.readouterr().out))
    for page in ALL:
        for command in commands(page):
            if re.match(rf'(?:\.venv/bin/)?{program}\b', command):
                assert set(re.findall(r'(?<!\S)(--[a-z][\w-]*)', command)) <= known, f'{page}: {command}'


def test_every_column_and_key_that_identify_bag_writes_is_explained() -> None:
    written = [*outputs.columns([]), *(field.name for field in fields(Summary)
                                           if field.name not in ('model_status', 'reason', 'horizon_reason'))]
    assert [name for name in written if f'`{name}`' not in text_of('docs/recordings.md')] == []


@pytest.mark.parametrize('page', ALL)
def test_a_parameter_that_is_named_is_declared(page: str) -> None:
    demo = {leaf.name for leaf in leaves(DemoParameters)}
    for command in [*commands(page), *inline(page)]:
        if command.startswith(('ros2 run flexmanip_ros', 'demo ')):
            for name in re.findall(r'-p (?:\w+:)?([a-z][\w.]+):=', command):
                assert name in PARAMETERS | demo | OF_EVERY_NODE, f'{page}: {command}'
        for name in re.findall(r'^((?:arm|payload|sensors|actuators)\.[a-z]\w+)\b(?!\.)', command):
            assert name in PARAMETERS, f'{page}: {command}'


def test_the_architecture_names_every_room_and_module_of_the_top_level() -> None:
    text = text_of('docs/architecture.md')
    for path in (ROOT / 'flexmanip_ros').iterdir():
        if path.is_dir() and path.name != '__pycache__':
            assert f'`{path.name}/`' in text, path.name
        elif path.suffix == '.py' and path.stem != '__init__':
            assert f'`{path.stem}`' in text or f'`{path.name}`' in text, path.name


@pytest.mark.parametrize('page', ['docs/payload.md', 'docs/identification.md'])
def test_a_reference_has_at_most_a_thousand_words(page: str) -> None:
    assert len(text_of(page).split()) <= 1000


@pytest.mark.parametrize('page', ALL)
def test_no_page_speaks_of_machinery_that_is_gone(page: str) -> None:
    text = text_of(page).lower()
    assert [word for word in REMOVED if word.lower() in text] == []
