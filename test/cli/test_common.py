"""An option has the same meaning in every verb, and one meaning has one name."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator

import click
import pytest
from cli.test_main import LEAVES

from shadowhound_data_logger.cli.common import DAY_NS, Age, Size

TWO_MEANINGS = {
    '--robot': 'the robot that a verb is about, which has a default, or a filter of results',
    '--robot-type': 'a version may be for several types, a robot is of one',
    '--topic': 'a filter of results, or several topics of one bag',
    '--key': 'keys of the root sign together, other keys alone',
}
"""Options with two help texts -> the reason."""


def options() -> Iterator[tuple[str, str, click.Option]]:
    """Verb, name and option."""
    for verb, command in LEAVES.items():
        for param in command.params:
            if isinstance(param, click.Option):
                for name in (*param.opts, *param.secondary_opts):
                    yield verb, name, param


def meaning(option: click.Option) -> str:
    """The help without the default, which may differ between verbs."""
    return (option.help or '').partition('  [default')[0].rstrip('.')


def shape(option: click.Option) -> tuple[object, ...]:
    """The kind of the option's value; limits and choices may differ."""
    return option.is_flag, option.multiple, option.nargs, option.metavar if not isinstance(option.type, click.Choice) else None


def test_an_option_means_the_same_in_every_verb() -> None:
    """Each name has one help text, except for those listed with a reason."""
    found: dict[str, dict[str, list[str]]] = defaultdict(lambda: defaultdict(list))
    for verb, name, option in options():
        found[name][meaning(option)].append(verb)
    several = {name: dict(texts) for name, texts in found.items() if len(texts) > 1}
    assert {name: texts for name, texts in several.items() if name not in TWO_MEANINGS} == {}
    assert {name for name, texts in several.items() if len(texts) == 2} == set(TWO_MEANINGS)


def test_an_option_takes_the_same_in_every_verb() -> None:
    """An option is a flag, or repeatable, in all verbs or in none."""
    found: dict[tuple[str, str], dict[tuple[object, ...], list[str]]] = defaultdict(lambda: defaultdict(list))
    for verb, name, option in options():
        found[name, meaning(option)][shape(option)].append(verb)
    assert {name: dict(shapes) for (name, _), shapes in found.items() if len(shapes) > 1 and name not in SHAPES} == {}


SHAPES = {'--to': 'a file, a folder, or a place in a store'}
"""Options whose values differ -> why."""


def test_what_means_the_same_has_one_name() -> None:
    """No two options have the same help; -v is short for --verbose."""
    found: dict[str, set[str]] = defaultdict(set)
    for _, name, option in options():
        if name.startswith('--'):
            found[meaning(option)].add(name)
    assert {text: names for text, names in found.items() if len(names) > 1} == {}


def test_every_option_has_help() -> None:
    """And a name for its value instead of click's TEXT."""
    assert [f'{verb} {name}' for verb, name, option in options() if not option.help] == []


@pytest.mark.parametrize(
    ('text', 'size'), [('2TB', 2 * 10**12), ('500 GB', 5 * 10**11), ('1TiB', 1 << 40), ('1.5kB', 1500), ('7', 7)]
)
def test_sizes_are_read(text: str, size: int) -> None:
    """In decimal and binary units."""
    assert Size().convert(text, None, None) == size


def test_ages_are_read() -> None:
    """Up to a limit."""
    assert Age().convert('0h', None, None) == 0
    assert Age(DAY_NS).convert('90min', None, None) == 5400 * 10**9
    for text in ('much', '-1h', '0h', '2d', '2026-11-20'):
        with pytest.raises(click.BadParameter, match='is not an age'):
            Age(DAY_NS).convert(text, None, None)
    with pytest.raises(click.BadParameter, match='is not a size'):
        Size().convert('much', None, None)
