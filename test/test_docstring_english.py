"""Docstrings, comments and the help of every verb are in plain English: idioms that this project had do not return."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
from cli.test_main import VERBS

ROOT = Path(__file__).parents[1]
DONE = ('shadowhound_data_logger', 'bench', 'examples', 'sim', 'torture', 'tower')
"""The folders whose modules are checked."""
IDIOMS = {
    r'\b(un)?told\b|\btells?\b|\bsaid\b': 'reported, recorded, contains, states',
    r'\bmend(s|ed|ing)?\b': 'fix, repair',
    r'\b(is|are|was|were|been|be) (once |first )?asked for\b': 'requested, required',
    r'\banew\b|\bmade again\b': 'again, rebuilt',
    r'(?<!there )\b(is|are|was|were) (?-i:none)\b': 'does not exist, is not one',
    r'\b(lies|lie|stands?|stood) (in|at|there|behind|beside|side)\b': 'is in, is at',
    r'\b(leaves?|left) out\b': 'skips, omits, ignored',
    r'\b(nobody|somebody|someone|anybody|anyone else|whoever)\b': 'name the role: the operator, a client, another process',
    r'\bshall\b': 'should, must',
    r'\bto effect\b': 'effectively exactly once',
    r'\bas (it|they) (is|are|came|was|were)\b(?! (in|\w+ed)\b)': 'unchanged, verbatim, in arrival order',
    r'\bfor (good|ever)\b': 'permanently, indefinitely',
    r'\bby (itself|themselves)\b': 'automatically, on its own',
    r'\bof (its|their) own\b': 'its own X, a separate X',
    r'\bgreatest\b|(?<!at )\bleast\b': 'maximum, minimum',
    r'\bmeanwhile\b': 'until then, during that time',
    r'\bgoes on\b|\bgo on\b': 'continues',
    r'\bbeside\b': 'next to, in addition to',
    r'\ball the same\b': 'anyway, nevertheless',
    r'(?<!would )\b(has|have) to be\b|\b(is|are) to be\b': 'must be',
    r'\bof which\b|\bby which\b|\bfor whom\b': 'use a verb',
    r'\bLife:': 'Lifecycle:',
    r'\b(catalogue|colour|grey|metre|journalled|behaviour|centre|neighbour)\w*': 'the American spelling',
    r'\b(a row|a line|one) a (row|line|message|point|pixel|second|day|format|object)\b': 'per',
    r'\bis not judged\b|\bknows nothing of\b|\bis known of\b': 'is not checked, does not depend on, is known about',
}
"""A pattern -> what to write instead."""
CODE = re.compile(r'``.*?``|`[^`\n]*`')
FILES = sorted(path for folder in DONE for path in (ROOT / folder).rglob('*.py') if 'build' not in path.parts)


def prose(path: Path) -> Iterator[tuple[int, str]]:
    """(line, text) of each docstring and comment, without code in backticks and, in a module's docstring, indented code."""
    source = path.read_text(encoding='utf-8')
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            text = re.sub(r'\n {4}[^\n]*', '\n', node.value.value) if not node.col_offset else node.value.value
            yield node.lineno, CODE.sub('', text)
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], CODE.sub('', token.string)


@pytest.mark.parametrize('path', FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_a_module_has_none_of_these_idioms(path: Path) -> None:
    """The mechanical part of plain English: a sentence that passes may still deserve rewriting."""
    found = [
        f'line {line + text[: match.start()].count(chr(10))}: {match[0]!r}: write {instead}'
        for line, text in prose(path)
        for pattern, instead in IDIOMS.items()
        for match in re.finditer(pattern, text, re.IGNORECASE)
    ]
    assert found == []


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
