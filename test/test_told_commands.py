"""Commands that documents, remedies and messages tell somebody to type: verbs, options, services and parameters exist."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import click

from shadowhound_data_logger.cli.main import cli
from shadowhound_data_logger.core.config import Settings
from shadowhound_data_logger.core.options import GROUPS

ROOT: Final = Path(__file__).resolve().parent.parent
COMMAND: Final = re.compile(r'shadowhound-data (?P<verb>[a-z]+)(?P<rest>[^`#|;)\n\']*)')
"""As far as it is surely still the command: to the end of a code span, a comment, a pipe, a string or the line."""
SERVICE: Final = re.compile(r'service call (?:/\w+)?/sensor_logger_node/(?P<name>[\w/]+) std_srvs/srv/(?P<type>\w+)')
PARAMETER: Final = re.compile(r'param set (?:/\w+)?/sensor_logger_node (?P<name>[\w.]+)')
SERVICES: Final = {
    'flush': 'Trigger', 'pause': 'SetBool', 'bag/start': 'Trigger', 'bag/stop': 'Trigger', 'bag/split': 'Trigger',
    'bag/pause': 'SetBool', 'event/trigger': 'Trigger',
}  # fmt: skip
"""What the node serves; test/e2e calls each."""


def told(pattern: re.Pattern[str]) -> Iterator[tuple[str, re.Match[str]]]:
    """Each match, with where it stands."""
    pages = [page for page in ROOT.glob('docs/**/*.md') if page.parent.name != 'evidence']  # records of what was run then
    files = [ROOT / 'README.md', *pages, *ROOT.glob('launch_configs/*'), *ROOT.glob('tower/*')]
    for path in (*files, *ROOT.glob('shadowhound_data_logger/**/*.py')):
        if path.is_file():
            text = path.read_text(encoding='utf-8')
            for match in pattern.finditer(text):
                yield f'{path.relative_to(ROOT)}:{text.count(chr(10), 0, match.start()) + 1}', match


def test_every_verb_and_option_exists() -> None:
    """Also those of a verb's verbs, and each option with the verb it is given to."""
    wrong, seen = [], set()
    for where, match in told(COMMAND):
        command: click.Command | None = cli.commands.get(match['verb'])
        words = match['rest'].split()
        if isinstance(command, click.Group) and words and re.fullmatch('[a-z][a-z0-9-]*', words[0]):
            command = command.commands.get(words[0])
        if command is None:
            wrong.append(f'{where}: {match[0]}')
            continue
        options = {name for each in command.params for name in (*each.opts, *each.secondary_opts)} | {'--help'}
        words = re.findall(r'(?<=\s)--[a-z][a-z0-9-]*', match['rest'])
        wrong += [f'{where}: {word} of {match[0]}' for word in words if word not in options]
        seen.add(match['verb'])
    assert wrong == []
    assert seen == set(cli.commands)


def test_every_service_exists() -> None:
    """By its name and type."""
    calls = [(where, match['name'], match['type']) for where, match in told(SERVICE)]
    assert [call for call in calls if SERVICES.get(call[1]) != call[2]] == []
    assert calls


def test_every_parameter_that_is_set_is_live() -> None:
    """`ros2 param set` of another one would be refused."""
    settings = Settings.load({}, {}, '/')
    owners = {name: getattr(settings, name) for name in GROUPS} | {sensor.name: sensor for sensor in settings.sensors}
    live = {f'{name}.{key}' for name, owner in owners.items() for key, spec in type(owner).__dataclass_fields__.items()
            if spec.metadata and spec.metadata['live']}  # fmt: skip
    sets = [(where, match['name']) for where, match in told(PARAMETER)]
    assert [each for each in sets if each[1] not in live] == []
    assert sets


def test_every_link_leads_somewhere() -> None:
    """In the README and the docs: the file is there, and so is the heading, by the anchor that GitHub gives it."""
    wrong, seen = [], 0
    for page in (ROOT / 'README.md', *ROOT.glob('docs/**/*.md')):
        for target in re.findall(r'\]\((?!https?://)([^)\s]+)\)', page.read_text(encoding='utf-8')):
            path, _, anchor = target.partition('#')
            file = (page.parent / path).resolve() if path else page
            seen += 1
            if not file.exists() or (anchor and anchor not in _anchors(file)):
                wrong.append(f'{page.relative_to(ROOT)}: {target}')
    assert wrong == []
    assert seen > 100


def _anchors(page: Path) -> set[str]:
    headings = re.findall(r'^#+ (.+)$', page.read_text(encoding='utf-8'), re.MULTILINE)
    return {re.sub(r'[^\w\- ]', '', heading.lower()).replace(' ', '-') for heading in headings}
