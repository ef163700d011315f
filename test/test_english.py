"""Pages for users are in plain English: idioms that this project used to have do not return."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DIARIES = {'reliability.md', 'performance.md', 'development.md'}
"""Records of campaigns and measurements."""
PAGES = [ROOT / 'README.md', *sorted(page for page in (ROOT / 'docs').glob('*.md') if page.name not in DIARIES)]
IDIOMS = {
    r'\banew\b': 'again, rebuilt',
    r'\b(somebody|someone|anybody|whoever)\b': 'the operator, a client, another process',
    r'\bnobody\b(?! publishes)': 'no user, no client, unknown',
    r'\bmeanwhile\b': 'during that time, until then',
    r'\basked for\b': 'requested, required',
    r'\bfor (good|ever)\b': 'permanently',
    r'\bmend(s|ed)?\b': 'fix, repair',
    r'\bgoes on\b': 'continues',
    r'\b(leaves?|left) out\b': 'skips, omits, ignored',
    r'\bby (itself|themselves)\b': 'automatically, on its own',
    r'\bas (it|they) came\b': 'unchanged, in arrival order',
    r'\bcatalogues?\b': 'catalog',
    r'\b(comes back|is away)\b': 'is reachable again, is unreachable',
}
"""A pattern -> what to write instead."""


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.name)
def test_a_page_has_none_of_these_idioms(page: Path) -> None:
    """Text in backticks is code, and Nobody publishes is a line of ``status``."""
    text = re.sub(r'`[^`]*`', '', page.read_text(encoding='utf-8'))
    found = [
        f'line {text[: match.start()].count(chr(10)) + 1}: {match[0]!r}: write {instead}'
        for pattern, instead in IDIOMS.items() for match in re.finditer(pattern, text, re.IGNORECASE)
    ]  # fmt: skip
    assert found == []
