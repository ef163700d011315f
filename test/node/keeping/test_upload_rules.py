"""Rules for uploads: networks as the system reports them, and topics without a publisher."""

from __future__ import annotations

import array
import ctypes
import struct
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from shadowhound_data_logger.core.config import Settings
from shadowhound_data_logger.core.status import MissionStatus
from shadowhound_data_logger.formats.types import MessageTypes
from shadowhound_data_logger.node.keeping import upload_rules
from shadowhound_data_logger.node.keeping.upload_rules import STALE_S, UploadRules, wifi_networks


class Kernel:
    """Responds as ``ioctl`` does to ``SIOCGIWESSID``: writes to the address in the request."""

    def __init__(self, networks: dict[str, bytes | OSError]) -> None:
        self._networks = networks

    def __call__(self, _: int, number: int, request: array.array[int], mutate: bool) -> int:
        assert (number, mutate) == (0x8B1B, True)
        name, pointer, length, _ = struct.unpack('16sPHH', request.tobytes())
        found = self._networks[name.rstrip(b'\0').decode()]
        if isinstance(found, OSError):
            raise found
        assert len(found) < length
        ctypes.memmove(pointer, found, len(found))
        return 0


@pytest.fixture
def interfaces(tmp_path: Path) -> Path:
    for name in ('eth0', 'wlan0/wireless', 'wlan1/phy80211'):
        (tmp_path / name).mkdir(parents=True)
    return tmp_path


def test_networks_of_all_wireless_interfaces_are_known(interfaces: Path) -> None:
    assert wifi_networks(interfaces, Kernel({'wlan0': b'lab', 'wlan1': 'Café'.encode()})) == {'lab', 'Café'}


def test_without_a_network_the_value_is_false(interfaces: Path, tmp_path: Path) -> None:
    assert wifi_networks(interfaces, Kernel({'wlan0': b'', 'wlan1': b''})) == set()
    (tmp_path / 'none').mkdir()
    assert wifi_networks(tmp_path / 'none') == set()


def test_an_unknown_network_has_a_reason(interfaces: Path) -> None:
    refused = OSError(95, 'Operation not supported')
    found = wifi_networks(interfaces, Kernel({'wlan0': refused, 'wlan1': refused}))
    assert found == 'the system does not report the network of wlan1: Operation not supported'
    assert wifi_networks(interfaces, Kernel({'wlan0': refused, 'wlan1': b'lab'})) == {'lab'}
    assert isinstance(wifi_networks(interfaces / 'nowhere'), str)


def test_networks_of_this_machine_are_read() -> None:
    assert wifi_networks() is not None


def test_a_rule_that_waits_for_an_unpublished_topic_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    """After a minute, with a remedy; not before, and not once the topic has a publisher."""
    now_s, publishers = [1000.0], {'/lowstate': 0}
    monkeypatch.setattr(upload_rules, 'time', SimpleNamespace(monotonic=lambda: now_s[0]))
    node: Any = SimpleNamespace(resolve_topic_name=lambda topic: f'/{topic}', count_publishers=publishers.__getitem__)
    settings = Settings.load({'upload.when': 'lowstate:bms_state.soc > 30'}, {})
    rules = UploadRules(node, settings, MessageTypes([]), SimpleNamespace(is_set=True), MissionStatus)  # type: ignore[arg-type]
    for passed_s, is_told in ((0.0, False), (STALE_S - 1, False), (STALE_S, True), (STALE_S + 1, True)):
        now_s[0] = 1000.0 + passed_s
        assert 'upload.when' in rules.poll()
        assert bool(rules.stuck) is is_told
    text = rules.stuck['upload.when']
    assert text == ('upload.when waits for /lowstate, which nobody publishes: start what publishes it, or change upload.when')
    publishers['/lowstate'] = 1
    rules.poll()
    assert rules.stuck == {}
