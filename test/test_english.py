"""Pages for users are in plain English: idioms that this project used to have do not return."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / 'README.md', *sorted((ROOT / 'docs').glob('*.md')), *sorted((ROOT / 'docs/api').glob('*.md'))]
PAGES.remove(ROOT / 'docs/commands.md')  # generated from the help of the commands
"""All but decisions and evidence, which are records."""
IDIOMS = {
    r'\banew\b': 'again, rebuilt',
    r'\b(somebody|someone|anybody|whoever|no one)\b': 'the operator, a client, another process',
    r'\bnobody\b(?! publishes)': 'no user, no client, unknown',
    r'\bmeanwhile\b': 'during that time, until then',
    r'\basked for\b': 'requested, required',
    r'\bfor (good|ever)\b': 'permanently',
    r'\bmend(s|ed)?\b': 'fix, repair',
    r'\bgo(es)? on\b': 'continues',
    r'\b(leaves?|left) out\b': 'skips, omits, ignored',
    r'\bby (itself|themselves)\b': 'automatically, on its own',
    r'\bas (it|they) came\b': 'unchanged, in arrival order',
    r'\b(comes? back|(is|are|stays?) away)\b': 'is reachable again, is unreachable',
    r'\bof (its|their|your|our|my) own\b': 'its own X, a separate X',
    r'\b(told|tells)\b': 'reports, recorded, states',
    r'\bshall\b': 'must',
    r'\b(lies|stands) (in|at|on|there|below)\b': 'is in',
    r'\b(nothing of|all that|what came|that which)\b(?! (is|are|it)\b)': 'none of, everything, the messages received',
    r'\b(at once|again and again)\b': 'immediately, at the same time, repeatedly',
    r'\bbeside\b': 'next to, in addition to',
    r'\bpictures?\b': 'image, plot',
    r'\b(greatest|likest)\b': 'maximum, most similar',
    r'\b(is|are) (whole|rotten)\b|\bwhole (slice|file|bag|version|spool)s?\b': 'complete, intact, corrupt',
    r'\bhear[sd]?\b': 'receives',
    r'\bhanded (to|on)\b|\bthrown away\b|\bput together\b': 'passed to, discarded, assembled',
    r'\bsees? to\b|\bmakes? way\b|\bh(olds?|eld) up\b': 'ensures, yields, delays',
    r'\bprove[sd]\b': 'verified, tested',
    r'\b(dies|died|dying|outlives?)\b': 'exits, crashes, is killed, keeps running after',
    r'\bweighs?\b': 'takes, uses',
    r'\bto effect\b': 'effectively',
    r'\bunless told\b': 'by default',
    r'\b(bytes|files|frames|hours|images|messages|objects|points|requests|rows|samples|times|[GTMK]B|[GM]?bit|once|row) an? '
    r'(second|minute|hour|day|week|month|year)\b': 'per second',
    r'\b(has|have|is|are) to be\b': 'must be',
    r', else\b|\belse (by|from|the|those|it|with|in|as|to|an?)\b': 'otherwise',
    r'\bknows? nothing\b|\b(is|are|was|be) (not known|known of)\b': 'unknown, known about',
    r'\bin (force|little)\b': 'valid, present, short',
    r'\bobeys?\b|\bruling\b': 'handles, decision',
    r'\b(catalogues?|colours?|greys?|metres?|journalled|data sets?|licences?|honours?|behaviours?)\b': 'American spelling',
}
"""A pattern -> what to write instead."""


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_a_page_has_none_of_these_idioms(page: Path) -> None:
    """Except in code and link targets; ``Nobody publishes`` is a line of ``status``."""
    text = page.read_text(encoding='utf-8')
    for code in (r'(?s)^```.*?^```', r'^(    |\t).*$', r'`[^`\n]*`', r'\]\([^)]*\)'):
        text = re.sub(code, lambda found: '\n' * found[0].count('\n'), text, flags=re.MULTILINE)
    found = [
        f'line {text[: match.start()].count(chr(10)) + 1}: {match[0]!r}: write {instead}'
        for pattern, instead in IDIOMS.items() for match in re.finditer(pattern, text, re.IGNORECASE)
    ]  # fmt: skip
    assert found == []
