"""What ``shadowhound-data live`` decides before it serves: the kind of page, and which URLs are valid."""

from __future__ import annotations

from pathlib import Path

import pytest

from shadowhound_data_logger.cli.common import BadUsage
from shadowhound_data_logger.cli.live import as_it_is, check_urls
from shadowhound_data_logger.live.server import LiveSettings

TILES = 'https://tile.example/{z}/{x}/{y}.png'


@pytest.mark.parametrize('tiles', ['https://tile.example/', 'file:///{z}/{x}/{y}', "https://a b;'x/{z}/{x}/{y}", '{z}{x}{y}'])
def test_tiles_are_a_url_with_places(tmp_path: Path, tiles: str) -> None:
    """Other text must not get into the page's content security policy."""
    check_urls(tmp_path / 'none', None, None, TILES, None)
    with pytest.raises(BadUsage, match='--tiles'):
        check_urls(tmp_path / 'none', None, None, tiles, None)


def test_a_relayed_robot_is_on_another_machine(tmp_path: Path) -> None:
    """Its page needs a folder without a spool, a complete URL, and serves no cameras over RTSP."""
    check_urls(tmp_path / 'none', 'http://thor:8765/', None, '', None)
    for folder, url, rtsp in (
        (tmp_path, 'http://thor:8765/', None),
        (tmp_path / 'none', 'http://thor:8765/', 8554),
        (tmp_path / 'none', 'thor', None),
    ):
        with pytest.raises(BadUsage):
            check_urls(folder, url, rtsp, '', None)


def test_the_kind_of_page_is_detected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The store's page if no node has run and nothing names a robot; otherwise the robot's."""
    monkeypatch.setenv('SHADOWHOUND_HOME', str(tmp_path))
    for name in ('AWS_ENDPOINT_URL', 'SHADOWHOUND_ROBOT'):
        monkeypatch.delenv(name, raising=False)
    given = LiveSettings(spool=tmp_path / 'spool', robot='', tokens=tmp_path / 'live')
    assert not as_it_is(given, is_robot=False).is_of_store  # there is no store either
    (tmp_path / 'store').mkdir()
    assert as_it_is(given, is_robot=False).is_of_store
    assert not as_it_is(given, is_robot=True).is_of_store
    (tmp_path / 'spool').mkdir()
    found = as_it_is(given, is_robot=False)
    assert (found.is_of_store, found.waits) == (False, '')
