"""The tables of docs/scale.md and docs/evidence/scale.md are what the program computes from the rates that it names."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

import pytest

from shadowhound_data_logger.node.keeping.keeping import PREVIEW_BYTES

PROGRAM = Path(__file__).parents[1] / 'bench' / 'scale.py'


@pytest.fixture(scope='module')
def scale() -> Any:
    spec = importlib.util.spec_from_file_location('bench_scale', PROGRAM)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules['bench_scale'] = module
    spec.loader.exec_module(module)
    return module


def test_the_pages_have_their_tables(scale: Any) -> None:
    """``python bench/scale.py --write`` would change nothing."""
    assert sorted(name for names in scale.PAGES.values() for name in names) == sorted(scale.TABLES)
    for path, names in scale.PAGES.items():
        page = path.read_text(encoding='utf-8')
        assert scale.filled(page, names) == page
        assert page.count('<!-- scale ') == len(names)


def test_the_rates_are_those_of_the_other_pages(scale: Any) -> None:
    """36 and 384 GB per day, 6 and 8 objects per second, as in docs/thor.md."""
    thor = (PROGRAM.parents[1] / 'docs' / 'thor.md').read_text(encoding='utf-8')
    default, _, full = scale.PROFILES
    assert f'**{default.bytes_s * 86_400 / 1e9:.0f} GB per day**' in thor
    assert f'**{full.bytes_s * 86_400 / 1e9:.0f} GB per day**' in thor
    assert f'| objects | {default.objects_s} per second | {full.objects_s} per second |' in thor


def test_it_is_arithmetic(scale: Any) -> None:
    """One robot by hand: 8 hours at 6 objects a second."""
    row = next(iter(scale.flow(scale.PROFILES[0])))
    assert row[:4] == ('1', '3 Mbit/s', '6.0', '12 GB')
    row = next(iter(scale.catalog(scale.PROFILES[0])))
    assert row[:3] == ('1', '172,800', '480')
    assert row[4] == '481'


def test_what_keeping_everything_takes(scale: Any) -> None:
    """The figures of a week of 8 hours a day are what its rates make."""
    seconds, page = 7 * 8 * 3600, scale.PAGE.read_text(encoding='utf-8')
    rate = scale.PROFILES[2].bytes_s
    assert f'about {8e-6 * rate:.0f} Mbit/s' in page
    assert f'{rate * seconds / 7e9:.0f} GB per day and {rate * seconds / 1e12:.1f} TB per week' in page
    assert f'{800e9 * 7 / (rate * seconds):.0f}' == '6'
    assert '800 GB holds six days' in page
    assert f'{8 * PREVIEW_BYTES / 1e3:.0f} kbit/s and {PREVIEW_BYTES * seconds / 1e9:.0f} GB of that week' in page
    assert f'{seconds // 10:,} objects' in page
    assert f'{30 * seconds / 1e6:.0f} million' in page
