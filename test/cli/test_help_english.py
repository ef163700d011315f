"""The help of every verb and option is in plain English: idioms that this project had do not return."""

from __future__ import annotations

import re

import click
import pytest
from cli.test_main import VERBS
from test_docstring_english import IDIOMS

MORE = {
    r'\bpictures?\b': 'images',
    r'\beverybody\b': 'every user, all viewers',
    r'\bis away\b': 'is unreachable',
    r', else\b': 'otherwise',
    r'\bat once\b': 'immediately',
    r'\bTower\b|\bSpark\b': 'the store, the server',
}
"""Idioms in texts for users, in addition to those of docstrings."""


def texts(name: str) -> list[str]:
    verb = VERBS[name]
    options = [param.help or '' for param in verb.params if isinstance(param, click.Option)]
    return [verb.help or '', *options]


@pytest.mark.parametrize('name', VERBS)
def test_a_help_has_none_of_these_idioms(name: str) -> None:
    """Text in backticks is code."""
    found = []
    for text in texts(name):
        prose = ' '.join(re.sub(r'`[^`]*`', '', text).split())
        found += [f'{match[0]!r} in {text[:60]!r}: write {instead}' for pattern, instead in (IDIOMS | MORE).items()
                  for match in re.finditer(pattern, prose, re.IGNORECASE)]  # fmt: skip
    assert found == []


@pytest.mark.parametrize('name', VERBS)
def test_a_help_consists_of_sentences(name: str) -> None:
    """Each begins with a capital letter, a flag or a name, and ends with a period; an option has one line."""
    verb = VERBS[name]
    first = (verb.help or '').partition('\n')[0]
    assert re.fullmatch(r'[A-Z].*\.', first), first
    for param in verb.params:
        if isinstance(param, click.Option):
            text = (param.help or '').partition('  [default')[0]
            assert re.match(r'[A-Z0-9]', text), text
            assert '\n' not in text
