"""The names of WiFi networks, as the system tells them."""

from __future__ import annotations

import array
import ctypes
import struct
from pathlib import Path

import pytest

from shadowhound_data_logger.node.keeping.upload_rules import wifi_networks


class Kernel:
    """Answers as ``ioctl`` does for ``SIOCGIWESSID``: writes where the request says."""

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


def test_networks_of_all_interfaces_with_a_radio(interfaces: Path) -> None:
    assert wifi_networks(interfaces, Kernel({'wlan0': b'lab', 'wlan1': 'Café'.encode()})) == {'lab', 'Café'}


def test_no_network(interfaces: Path, tmp_path: Path) -> None:
    assert wifi_networks(interfaces, Kernel({'wlan0': b'', 'wlan1': b''})) == set()
    (tmp_path / 'none').mkdir()
    assert wifi_networks(tmp_path / 'none') == set()


def test_a_system_that_does_not_tell(interfaces: Path) -> None:
    refused = OSError(95, 'Operation not supported')
    found = wifi_networks(interfaces, Kernel({'wlan0': refused, 'wlan1': refused}))
    assert found == 'the system does not tell the network of wlan1: Operation not supported'
    assert wifi_networks(interfaces, Kernel({'wlan0': refused, 'wlan1': b'lab'})) == {'lab'}
    assert isinstance(wifi_networks(interfaces / 'nowhere'), str)


def test_this_machine_tells_or_says_why() -> None:
    assert wifi_networks() is not None
