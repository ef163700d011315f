"""The interfaces and peers of the robot's DDS, and a Fast DDS profile that uses the same ones.

Input: the variables of ROS and the configuration of Cyclone DDS. Output: XML for Fast DDS 2.6 to 3.x. Sources:
rmw_cyclonedds_cpp's ``check_create_domain``, Cyclone DDS's docs/manual/options.md, rcl's ``discovery_options.c``, and
DDSI-RTPS 2.2, 9.6.1.1, for the ports.
"""

from __future__ import annotations

import array
import fcntl
import re
import socket
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from html.parser import HTMLParser
from pathlib import Path
from typing import Final
from xml.sax.saxutils import escape

PORT_BASE, DOMAIN_GAIN, PARTICIPANT_GAIN, UNICAST_OFFSET = 7400, 250, 2, 10
SPDP_GROUP: Final = '239.255.0.1'
"""The multicast group in which participants announce themselves by default."""
MAX_INDEX: Final = 32
"""The highest participant index that is announced to without multicast; rmw_cyclonedds_cpp's own limit."""
LOOPBACK: Final = '127.0.0.1'
LOCALHOST_ONLY, RANGE, PEERS = 'ROS_LOCALHOST_ONLY', 'ROS_AUTOMATIC_DISCOVERY_RANGE', 'ROS_STATIC_PEERS'
CYCLONE_URI: Final = 'CYCLONEDDS_URI'
FOREIGN: Final = {
    'tag': 'Discovery/Tag', 'base': 'Discovery/Ports', 'domaingain': 'Discovery/Ports', 'participantgain': 'Discovery/Ports',
    'unicastmetaoffset': 'Discovery/Ports', 'unicastdataoffset': 'Discovery/Ports', 'multicastmetaoffset': 'Discovery/Ports',
    'multicastdataoffset': 'Discovery/Ports', 'spdpmulticastaddress': 'Discovery/SPDPMulticastAddress',
    'externaldomainid': 'Discovery/ExternalDomainId', 'externalnetworkaddress': 'General/ExternalNetworkAddress',
    'ignoredpartition': 'Partitioning/IgnoredPartitions', 'authentication': 'Security', 'keyfile': 'SSL',
}  # fmt: skip
"""Settings of Cyclone DDS without an equivalent in Fast DDS: a listener would find other publishers, or none."""
HARMLESS: Final = frozenset({'', 'auto', 'default', 'false', SPDP_GROUP})
"""Values of these that change nothing."""
SIOCGIFCONF: Final = 0x8912
IFREQ_BYTES: Final = 40
"""netdevice(7), on 64-bit machines: a name of 16 bytes, then an address with family, port and four bytes."""
_ADDRESS: Final = re.compile(r'(?P<host>[^\s:\[\]]+)(?::(?P<port>\d+))?')


@dataclass(frozen=True, slots=True)
class Network:
    """Where to look for publishers. ``interfaces`` are addresses of this machine; empty means all."""

    interfaces: tuple[str, ...] = ()
    multicast: bool = True
    peers: tuple[str, ...] = ()
    """``host`` or ``host:port``, as given."""
    max_index: int = MAX_INDEX
    is_off: bool = False
    """Discovery is off."""
    problem: str = ''
    """Why Fast DDS cannot use the robot's network; empty if it can."""

    def describe(self) -> str:
        """For a log line: ``on 127.0.0.1, without multicast, peers 10.0.0.5``."""
        where = f'on {" and ".join(self.interfaces)}' if self.interfaces else 'on all interfaces'
        parts = [where, *([] if self.multicast else ['without multicast'])]
        return ', '.join([*parts, *([f'peers {" ".join(self.peers)}'] if self.peers else [])])


def robot_network(environ: Mapping[str, str], domain: int, *, has_range: bool) -> Network:
    """The network of a robot with Cyclone DDS. ``has_range``: its ROS supports ROS_AUTOMATIC_DISCOVERY_RANGE (Iron and later)."""
    config = CycloneConfig(domain)
    for text in fragments(environ.get(CYCLONE_URI, '')):
        config.feed(text)
    only = environ.get(LOCALHOST_ONLY) == '1'
    scope = ('LOCALHOST' if only else environ.get(RANGE) or 'SUBNET') if has_range else ''
    peers = list(config.peers)
    if has_range and not only and scope in {'SUBNET', 'LOCALHOST'}:
        peers += [peer for each in environ.get(PEERS, '').split(';') if (peer := each.strip())]
    names = config.interfaces or (['localhost'] if only and not has_range else [])
    here = addresses()
    found = tuple(dict.fromkeys(address for name in names for address in _addresses_of(name, here)))
    problem = config.problem
    if names and not found and not problem:
        problem = f'{" and ".join(names)} of {CYCLONE_URI} has no IPv4 address here'
    multicast = scope != 'LOCALHOST' if config.multicast is None else config.multicast
    index = MAX_INDEX if config.max_index is None else max(config.max_index, MAX_INDEX)
    return Network(found, multicast, tuple(peers), index, scope == 'OFF', problem)


def fragments(uri: str) -> Iterator[str]:
    """The pieces of configuration in or named by CYCLONEDDS_URI; unreadable files are skipped.

    It is a comma-separated list of XML and files (``file:///etc/cyclonedds.xml`` or a bare path).
    """
    for piece in re.split(r',(?=\s*(?:<|file:|/))', uri):
        text = piece.strip()
        if text.startswith('<'):
            yield text
        elif text:
            try:
                yield Path(text.removeprefix('file://')).read_text(encoding='utf-8')
            except (OSError, ValueError):  # Cyclone DDS itself then fails to start and reports it
                continue


class CycloneConfig(HTMLParser):
    """Parses a configuration of Cyclone DDS, which is case-insensitive and also closes elements with ``</>``."""

    def __init__(self, domain: int) -> None:
        super().__init__()
        self.interfaces: list[str] = []
        self.peers: list[str] = []
        self.multicast: bool | None = None
        self.max_index: int | None = None
        self.problem = ''
        self._domain = domain
        self._is_ours = True
        self._element = ''

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or '' for name, value in attrs}
        self._element = tag
        if tag == 'domain':
            self._is_ours = given.get('id', 'any').strip().lower() in {'any', str(self._domain)}
        if not self._is_ours:
            return
        if tag == 'networkinterface':
            self.interfaces += [word for word in (given.get('address') or given.get('name'),) if word]
        elif tag == 'peer' and given.get('address'):
            self.peers.append(given['address'].strip())

    def handle_endtag(self, tag: str) -> None:
        self._element = ''
        self._is_ours = self._is_ours or tag == 'domain'

    def handle_data(self, data: str) -> None:
        value = data.strip()
        if not value or not self._is_ours:
            return
        tag, lower = self._element, value.lower()
        if tag == 'networkinterfaceaddress' and lower != 'auto':
            self.interfaces += [word for each in value.split(',') if (word := each.strip())]
        elif tag == 'allowmulticast' and lower != 'default':
            self.multicast = not {'true', 'spdp', 'asm'}.isdisjoint(word.strip() for word in lower.split(','))
        elif tag == 'maxautoparticipantindex' and value.isdecimal():
            self.max_index = int(value)
        elif tag in {'transport', 'useipv6'} and lower not in {'default', 'udp', 'false'}:
            self.problem = f'{CYCLONE_URI} makes it use {value if tag == "transport" else "IPv6"}'
        elif tag in FOREIGN and lower not in HARMLESS:
            self.problem = f'{CYCLONE_URI} sets {FOREIGN[tag]}, which has no equivalent in Fast DDS'


def addresses() -> list[tuple[str, str]]:
    """(interface, IPv4 address) of each interface of this machine that is up."""
    room = 64
    while True:
        buffer = array.array('B', bytes(room * IFREQ_BYTES))
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asked:
            answer = fcntl.ioctl(asked, SIOCGIFCONF, struct.pack('iP', len(buffer), buffer.buffer_info()[0]))
        length = struct.unpack('iP', answer)[0]
        if length < len(buffer):
            break
        room *= 2
    rows = (bytes(buffer[start : start + IFREQ_BYTES]) for start in range(0, length, IFREQ_BYTES))
    return [(row[:16].split(b'\0', 1)[0].decode(errors='replace'), socket.inet_ntoa(row[20:24])) for row in rows]


def _outward() -> list[str]:
    """The addresses that other participants, also on this machine, use for this machine; loopback if there is no other."""
    own = [address for _, address in addresses()]
    return [address for address in own if not address.startswith('127.')] or own


def _addresses_of(given: str, here: Sequence[tuple[str, str]]) -> list[str]:
    """The addresses of this machine for the name of an interface, or an address."""
    wanted = LOOPBACK if given == 'localhost' else given
    return [address for name, address in here if wanted in {name.partition(':')[0], address}]


def _resolve(host: str) -> list[str]:
    """Its IPv4 addresses; empty if it cannot be resolved."""
    try:
        return list(dict.fromkeys(str(entry[4][0]) for entry in socket.getaddrinfo(host, None, socket.AF_INET)))
    except (OSError, UnicodeError):
        return []


def announced_to(network: Network, domain: int) -> list[tuple[str, int]]:
    """(address, port) of every participant that is announced to; empty if the default, multicast, is used."""
    is_inside = bool(network.interfaces) and all(address.startswith('127.') for address in network.interfaces)
    if network.is_off or (network.multicast and not network.peers and not is_inside):  # some machines have no local multicast
        return []
    base = PORT_BASE + DOMAIN_GAIN * domain
    ports = [base + UNICAST_OFFSET + PARTICIPANT_GAIN * index for index in range(network.max_index + 1)]
    found: list[tuple[str, int]] = [(SPDP_GROUP, base)] if network.multicast else []
    own = network.interfaces or tuple(address for _, address in addresses())
    for peer in (*own, *network.peers):
        match = _ADDRESS.fullmatch(peer)
        if match is not None:
            wanted = [int(match['port'])] if match['port'] else ports
            found += [(address, port) for address in _resolve(match['host']) for port in wanted]
    return list(dict.fromkeys(found))


def profile(receive_bytes: int, network: Network | None = None, domain: int = 0, *, segment_bytes: int = 0) -> str:
    """A Fast DDS profile: a receive buffer, shared memory if it has a size, and the interfaces and peers of a network."""
    udp = [f'<receiveBufferSize>{receive_bytes}</receiveBufferSize>']
    builtin: list[str] = []
    if network is not None:
        allowed = network.interfaces or ([] if network.multicast else _outward())
        if allowed:
            udp.append(_wrap('interfaceWhiteList', (f'<address>{address}</address>' for address in allowed)))
        if not network.multicast:  # keeps it from listening to multicast; Fast DDS 2 completes it from the whitelist
            builtin.append('<metatrafficUnicastLocatorList><locator><udpv4/></locator></metatrafficUnicastLocatorList>')
        peers = announced_to(network, domain)
        if peers:
            builtin.append(_wrap('initialPeersList', (_locator(*peer) for peer in peers)))
    shared = f'<segment_size>{segment_bytes}</segment_size>'
    kinds = {'udp': ('UDPv4', ''.join(udp)), **({'shm': ('SHM', shared)} if segment_bytes else {})}
    return TEMPLATE.format(
        transports=''.join(TRANSPORT.format(name=name, kind=kind, rest=rest) for name, (kind, rest) in kinds.items()),
        announcement='<sec>0</sec><nanosec>200000000</nanosec>' if not builtin else '<sec>3</sec>',
        builtin=''.join(builtin),
        properties=PROPERTIES if network is not None else '',
        used=''.join(f'<transport_id>shadowhound_{name}</transport_id>' for name in reversed(kinds)),
    )


def _locator(address: str, port: int) -> str:
    return f'<locator><udpv4><address>{escape(address)}</address><port>{port}</port></udpv4></locator>'


def _wrap(name: str, inside: Iterable[str]) -> str:
    return f'<{name}>{"".join(inside)}</{name}>'


PROPERTIES: Final = """
        <propertiesPolicy><properties>
          <property><name>fastdds.type_propagation</name><value>disabled</value></property>
        </properties></propertiesPolicy>"""
"""Types match by name. Fast DDS 3 also exchanges type descriptions, and so do drivers without ROS; types that cannot be compared
(sensor_msgs/Image, for one) never match.
"""
TRANSPORT: Final = """
      <transport_descriptor><transport_id>shadowhound_{name}</transport_id><type>{kind}</type>{rest}</transport_descriptor>"""
TEMPLATE: Final = """\
<?xml version="1.0" encoding="UTF-8"?>
<dds xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <profiles>
    <transport_descriptors>{transports}
    </transport_descriptors>
    <participant profile_name="shadowhound_listener" is_default_profile="true">
      <rtps>
        <builtin>
          <discovery_config>
            <leaseDuration><sec>20</sec></leaseDuration>
            <leaseAnnouncement>{announcement}</leaseAnnouncement>
            <initialAnnouncements><count>30</count><period><sec>0</sec><nanosec>100000000</nanosec></period></initialAnnouncements>
          </discovery_config>
          {builtin}
          <readerHistoryMemoryPolicy>PREALLOCATED_WITH_REALLOC</readerHistoryMemoryPolicy>
          <writerHistoryMemoryPolicy>PREALLOCATED_WITH_REALLOC</writerHistoryMemoryPolicy>
        </builtin>
        <userTransports>{used}</userTransports>
        <useBuiltinTransports>false</useBuiltinTransports>{properties}
      </rtps>
    </participant>
    <data_writer profile_name="shadowhound_writer" is_default_profile="true">
      <historyMemoryPolicy>PREALLOCATED_WITH_REALLOC</historyMemoryPolicy>
      <qos><data_sharing><kind>OFF</kind></data_sharing></qos>
    </data_writer>
    <data_reader profile_name="shadowhound_reader" is_default_profile="true">
      <topic><resourceLimitsQos><allocated_samples>1</allocated_samples></resourceLimitsQos></topic>
      <historyMemoryPolicy>PREALLOCATED_WITH_REALLOC</historyMemoryPolicy>
      <qos><data_sharing><kind>OFF</kind></data_sharing></qos>
    </data_reader>
  </profiles>
</dds>
"""
"""Announcements: docs/decisions/0004-announce-often.md; with many ports there are fewer of them.

A reader starts with memory for one message; with rmw_fastrtps's default, each takes 88 KB before its first.
Its policy is not DYNAMIC: with Fast DDS 3.2.3 a take then crashed the process, mostly after it had been stopped and continued.
"""
