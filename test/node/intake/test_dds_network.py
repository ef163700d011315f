"""Where a robot with Cyclone DDS finds its publishers, from its variables, and the equivalent Fast DDS profile."""

from __future__ import annotations

import socket
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest

from shadowhound_data_logger.node.intake import dds_network
from shadowhound_data_logger.node.intake.dds_network import Network, addresses, announced_to, profile, robot_network

HERE = [('lo', '127.0.0.1'), ('eth0', '10.0.0.2'), ('wlan0', '192.168.1.7')]
LOCAL = [7400 + 250 * 5 + 10 + 2 * index for index in range(33)]


@pytest.fixture(autouse=True)
def machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dds_network, 'addresses', lambda: HERE)


def general(inside: str, attributes: str = '') -> str:
    return f'<CycloneDDS><Domain{attributes}><General>{inside}</General></Domain></CycloneDDS>'


def discovery(inside: str) -> str:
    return f'<CycloneDDS><Domain id="any"><Discovery>{inside}</Discovery></Domain></CycloneDDS>'


def network(*, has_range: bool = True, **environ: str) -> Network:
    return robot_network(environ, 5, has_range=has_range)


def test_by_default_all_interfaces_and_multicast_are_used() -> None:
    """Then Fast DDS discovers all publishers with its defaults."""
    found = network()
    assert found == Network()
    assert announced_to(found, 5) == []


def test_localhost_only_is_the_loopback_interface_on_humble() -> None:
    """Discovery data is also sent by unicast to each address: Cyclone DDS 0.10 has no multicast there, and 11 has."""
    found = network(has_range=False, ROS_LOCALHOST_ONLY='1', ROS_AUTOMATIC_DISCOVERY_RANGE='SUBNET')
    assert (found.interfaces, found.multicast) == (('127.0.0.1',), True)
    assert announced_to(found, 5) == [('239.255.0.1', 8650), *(('127.0.0.1', port) for port in LOCAL)]
    assert network(has_range=False, ROS_AUTOMATIC_DISCOVERY_RANGE='LOCALHOST', ROS_STATIC_PEERS='10.0.0.9') == Network()


@pytest.mark.parametrize('environ', [{'ROS_LOCALHOST_ONLY': '1'}, {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}])
def test_localhost_uses_no_multicast_after_humble(environ: dict[str, str]) -> None:
    """All addresses of this machine are peers, and the static peers if the range includes them."""
    found = network(**environ, ROS_STATIC_PEERS='10.0.0.9:7777')
    assert (found.interfaces, found.multicast) == ((), False)
    expected = [(address, port) for _, address in HERE for port in LOCAL]
    assert announced_to(found, 5) == expected + ([] if 'ROS_LOCALHOST_ONLY' in environ else [('10.0.0.9', 7777)])


def test_every_discovery_range_is_translated() -> None:
    """OFF finds no publisher; SYSTEM_DEFAULT has no static peers, SUBNET has them in addition to multicast."""
    assert network(ROS_AUTOMATIC_DISCOVERY_RANGE='OFF').is_off
    assert network(ROS_AUTOMATIC_DISCOVERY_RANGE='SYSTEM_DEFAULT', ROS_STATIC_PEERS='10.0.0.9') == Network()
    found = network(ROS_STATIC_PEERS='10.0.0.9; 10.0.0.8')
    assert (found.multicast, found.peers) == (True, ('10.0.0.9', '10.0.0.8'))
    report = announced_to(found, 5)
    assert report[0] == ('239.255.0.1', 8650)
    assert {address for address, _ in report[1:]} == {'127.0.0.1', '10.0.0.2', '192.168.1.7', '10.0.0.9', '10.0.0.8'}


@pytest.mark.parametrize(
    ('uri', 'interfaces'),
    [
        (general('<Interfaces><NetworkInterface name="eth0"/></Interfaces>'), ('10.0.0.2',)),
        (general('<interfaces><networkinterface ADDRESS="10.0.0.2"></></>'), ('10.0.0.2',)),
        (general('<NetworkInterfaceAddress>wlan0,10.0.0.2</NetworkInterfaceAddress>'), ('192.168.1.7', '10.0.0.2')),
        (general('<NetworkInterfaceAddress>auto</NetworkInterfaceAddress>'), ()),
        (general('<Interfaces><NetworkInterface autodetermine="true"/></Interfaces>'), ()),
        (general('<!-- <Interfaces><NetworkInterface name="eth0"/></Interfaces> -->'), ()),
        (general('<Interfaces><NetworkInterface name="eth0"/></Interfaces>', ' id="7"'), ()),
        (general('<Interfaces><NetworkInterface name="eth0"/></Interfaces>', ' id="5"'), ('10.0.0.2',)),
    ],
)
def test_interfaces_of_cyclone_dds_are_used(uri: str, interfaces: tuple[str, ...]) -> None:
    """By name or address, in the old and the new syntax, for our domain."""
    assert network(CYCLONEDDS_URI=uri).interfaces == interfaces


def test_a_missing_interface_is_reported() -> None:
    """It is reported by name: with an empty white list nothing would be received."""
    found = network(CYCLONEDDS_URI=general('<Interfaces><NetworkInterface name="eth7"/></Interfaces>'))
    assert found.interfaces == ()
    assert 'eth7' in found.problem


def test_peers_of_cyclone_dds_are_used(tmp_path: Path) -> None:
    """From a file and from the variable itself, one after the other."""
    file = tmp_path / 'cyclone.xml'
    file.write_text(discovery('<ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>40</MaxAutoParticipantIndex>'
                              '<Peers><Peer address="10.0.0.9"/><Peer Address="127.0.0.1:7411"/></Peers>'))  # fmt: skip
    for reference in (f'file://{file}', str(file)):
        found = network(CYCLONEDDS_URI=f'{reference},{general("<AllowMulticast>false</AllowMulticast>")}')
        assert (found.peers, found.multicast, found.max_index) == (('10.0.0.9', '127.0.0.1:7411'), False, 40)
    report = announced_to(found, 5)
    assert ('127.0.0.1', 7411) in report
    assert ('10.0.0.9', 7400 + 250 * 5 + 10 + 80) in report
    assert ('10.0.0.2', 8660) in report, 'peers on this machine are notified as well'
    assert network(CYCLONEDDS_URI=f'file://{tmp_path}/none.xml') == Network()


@pytest.mark.parametrize(
    ('words', 'multicast'), [('true', True), ('spdp', True), ('asm, spdp', True), ('false', False), ('default', True)]
)
def test_multicast_settings_of_cyclone_dds_are_used(words: str, multicast: bool) -> None:
    """Whether participants are discovered by multicast."""
    assert network(CYCLONEDDS_URI=general(f'<AllowMulticast>{words}</AllowMulticast>')).multicast is multicast


@pytest.mark.parametrize(
    'uri',
    [
        discovery('<Tag>mine</Tag>'), discovery('<Ports><Base>8000</Base></Ports>'),
        discovery('<ExternalDomainId>3</ExternalDomainId>'),
        discovery('<SPDPMulticastAddress>239.255.0.9</SPDPMulticastAddress>'), general('<Transport>tcp</Transport>'),
        general('<UseIPv6>true</UseIPv6>'), general('<ExternalNetworkAddress>1.2.3.4</ExternalNetworkAddress>'),
    ],
)  # fmt: skip
def test_settings_that_fast_dds_lacks_are_reported(uri: str) -> None:
    """Discovery through Fast DDS would find different publishers, or none: this is reported."""
    assert 'CYCLONEDDS_URI' in network(CYCLONEDDS_URI=uri).problem


def test_settings_without_effect_are_not_reported() -> None:
    """The same elements with their default values."""
    uri = discovery('<Tag></Tag><ExternalDomainId>default</ExternalDomainId>') + general('<Transport>default</Transport>')
    assert network(CYCLONEDDS_URI=uri) == Network()


def parsed(text: str) -> ET.Element:
    root = ET.fromstring(text.encode())
    for element in root.iter():
        element.tag = element.tag.rpartition('}')[2]
    return root


def test_the_profile_has_buffer_interfaces_and_peers() -> None:
    """Buffer, interfaces and peers are where Fast DDS reads them; shared memory only if it has a size."""
    root = parsed(profile(4 << 20, Network(interfaces=('10.0.0.2',), multicast=False), 5))
    assert [each.text for each in root.iter('type')] == ['UDPv4']
    assert [each.text for each in root.iter('receiveBufferSize')] == [str(4 << 20)]
    assert [each.text for each in root.findall('.//interfaceWhiteList/address')] == ['10.0.0.2']
    assert [int(each.text or 0) for each in root.findall('.//initialPeersList//port')] == LOCAL
    assert root.find('.//metatrafficUnicastLocatorList') is not None, 'else it listens to multicast'
    root = parsed(profile(4 << 20, Network(multicast=False), 5))
    assert [each.text for each in root.findall('.//interfaceWhiteList/address')] == ['10.0.0.2', '192.168.1.7']
    root = parsed(profile(4 << 20, segment_bytes=1 << 25))
    assert [each.text for each in root.iter('type')] == ['UDPv4', 'SHM']
    assert [each.text for each in root.iter('segment_size')] == [str(1 << 25)]
    assert root.find('.//initialPeersList') is None
    assert root.find('.//interfaceWhiteList') is None


def test_the_addresses_of_this_machine_can_be_bound() -> None:
    """As the kernel lists them: each can be bound."""
    found = addresses()
    assert ('lo', '127.0.0.1') in found
    for _, address in found:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bound:
            bound.bind((address, 0))
