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
FOLDERS = ('shadowhound_data_logger', 'bench', 'examples', 'sim', 'test', 'torture', 'tower')
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
ANY = re.compile(rf'\b(?=\w)(?:{"|".join(IDIOMS)})', re.IGNORECASE)
"""Each begins with a word; to begin only there takes a quarter of the time."""


def files() -> dict[str, list[Path]]:
    """The modules by their folder, with the subfolders of large ones apart."""
    found: dict[str, list[Path]] = {}
    for path in sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob('*.py') if 'build' not in path.parts):
        found.setdefault('/'.join(path.relative_to(ROOT).parts[:-1][:2]), []).append(path)
    return found


FILES = files()


def prose(path: Path) -> Iterator[tuple[int, str]]:
    """(line, text) of each docstring and comment, without code in backticks and, in a module's docstring, indented code."""
    source = path.read_text(encoding='utf-8')
    if not ANY.search(source):
        return
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            text = re.sub(r'\n {4}[^\n]*', '\n', node.value.value) if not node.col_offset else node.value.value
            yield node.lineno, CODE.sub('', text)
    if not any(map(ANY.search, re.findall('#.*', source))):
        return
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], CODE.sub('', token.string)


@pytest.mark.parametrize('folder', FILES)
def test_modules_have_none_of_these_idioms(folder: str) -> None:
    """The mechanical part of plain English: a sentence that passes may still deserve rewriting."""
    found = [
        f'{path.relative_to(ROOT)}:{line + text[: match.start()].count(chr(10))}: {match[0]!r}: write {instead}'
        for path in FILES[folder]
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


def test_help_has_none_of_these_idioms() -> None:
    """Text in backticks is code."""
    found = []
    texts = (text for verb in VERBS.values() for text in (verb.help, *(getattr(param, 'help', '') for param in verb.params)))
    for text in filter(None, texts):
        prose = ' '.join(re.sub(r'`[^`]*`', '', text).split())
        found += [f'{match[0]!r} in {text[:60]!r}: write {instead}' for pattern, instead in (IDIOMS | MORE).items()
                  for match in re.finditer(pattern, prose, re.IGNORECASE)]  # fmt: skip
    assert found == []


def test_help_consists_of_sentences() -> None:
    """Each begins with a capital letter, a flag or a name, and ends with a period; an option has one line."""
    for name, verb in VERBS.items():
        first = (verb.help or '').partition('\n')[0]
        assert re.fullmatch(r'[A-Z].*\.', first), (name, first)
        for param in verb.params:
            if isinstance(param, click.Option):
                text = (param.help or '').partition('  [default')[0]
                assert re.match(r'[A-Z0-9]', text), (name, text)
                assert '\n' not in text
