"""The control socket: who may use it, its limits, and that no client can harm the node or another client."""

from __future__ import annotations

import json
import os
import socket
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import pytest
from node.serving import Serving

from shadowhound_data_logger.core.errors import NodeUnavailable
from shadowhound_data_logger.node.reporting.control import MAX_CLIENTS
from shadowhound_data_logger.spool import control
from shadowhound_data_logger.spool.control import MAX_REQUEST_BYTES, Connection, address, connect

WAIT_S = 60.0
SHORT_S = 0.2


@pytest.fixture
def serve(tmp_path: Path) -> Iterator[Callable[..., Serving]]:
    """Creates sockets, and closes them at the end."""
    made: list[Serving] = []

    def make(spool: Path = tmp_path / 'spool', **given: Any) -> Serving:
        made.append(Serving(spool, **given))
        return made[-1]

    yield make
    for each in made:
        each.close()


def raw(serving: Serving, name: str = 'control.sock') -> socket.socket:
    """A client that sends raw bytes."""
    client = socket.socket(socket.AF_UNIX)
    client.settimeout(WAIT_S)
    with address(serving.spool, name) as there:
        client.connect(there)
    return client


def read_lines(client: socket.socket) -> list[dict[str, Any]]:
    """Everything that the node sends until it closes the connection."""
    report = b''
    with suppress(ConnectionResetError):
        while more := client.recv(1 << 16):
            report += more
    return [json.loads(line) for line in report.splitlines()]


def works(serving: Serving) -> bool:
    """Whether another client is served."""
    with closing(Connection(serving.spool, 'control.sock', WAIT_S)) as connection:
        return bool(connection.ask('flush')['message'] == 'flush is done')


def until(condition: Callable[[], bool]) -> None:
    end_s = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.01)


def test_a_request_is_done_and_answered(serve: Callable[..., Serving]) -> None:
    """One after the other on one connection, with arguments; long responses arrive complete."""
    serving = serve()
    with closing(connect(serving.spool)) as connection:
        assert connection.ask('flush') == {'ok': True, 'robot': 'thor', 'message': 'flush is done', 'long': ''}
        assert len(connection.ask('tell', long=1 << 20)['long']) == 1 << 20
    assert serving.asked == [{'do': 'describe'}, {'do': 'flush'}, {'do': 'tell', 'long': 1 << 20}]


@pytest.mark.parametrize('umask', [0o000, 0o077])
def test_the_socket_is_for_its_owner_alone(serve: Callable[..., Serving], umask: int) -> None:
    """With any umask; no temporary file is left next to it, and nothing after its end."""
    before = os.umask(umask)
    try:
        serving = serve()
        mode = (serving.spool / 'control.sock').stat().st_mode
    finally:
        os.umask(before)
    assert stat.S_ISSOCK(mode)
    assert stat.S_IMODE(mode) == 0o600
    assert sorted(path.name for path in serving.spool.iterdir()) == ['control.lock', 'control.sock']
    serving.close()
    assert [path.name for path in serving.spool.iterdir()] == ['control.lock']


@pytest.mark.skipif(os.geteuid() != 0, reason='only root can become another user')
@pytest.mark.parametrize(
    ('mode', 'said'), [(0o600, 'this user may not use control.sock (run this as the user of the node)'), (0o666, 'thor')]
)
def test_another_user_is_refused(serve: Callable[..., Serving], mode: int, said: str) -> None:
    """By the mode of the socket, also in an accessible folder; the error names the user to run as."""
    serving = serve()
    serving.spool.chmod(0o755)
    (serving.spool / 'control.sock').chmod(mode)
    program = """
import os
from pathlib import Path
from shadowhound_data_logger.core.errors import NodeUnavailable
from shadowhound_data_logger.spool.control import connect
os.setgroups([]); os.setgid(65534); os.setuid(65534)
try:
    print(connect(Path()).ask('flush')['robot'])
except NodeUnavailable as error:
    print(error)
"""
    ran = subprocess.run(
        [sys.executable, '-c', program], cwd=serving.spool, capture_output=True, text=True, check=True, timeout=WAIT_S,
        env={**os.environ, 'PYTHONPATH': str(Path(__file__).parents[2])},
    )  # fmt: skip
    assert ran.stdout.strip() == said
    assert bool(serving.asked) is (mode == 0o666)


@pytest.mark.parametrize(
    'line',
    [b'', b'flush', b'[]', b'"flush"', b'17', b'null', b'{"do": "flush"', b'\xff\xfe\x00', b'\x00' * 100, b'[' * 60_000,
     b'{"do": "\\ud800"}', b'1' * 50_000],
    ids=lambda line: repr(line[:16]),
)  # fmt: skip
def test_an_invalid_request_gets_an_error(serve: Callable[..., Serving], line: bytes) -> None:
    """Nothing is done, and the next line of the same client is handled."""
    serving = serve()
    with raw(serving) as client:
        client.sendall(line + b'\n{"do": "flush"}\n')
        client.shutdown(socket.SHUT_WR)
        refused, done = read_lines(client)
    assert (refused['ok'], refused['robot']) == (False, 'thor')
    assert 'a line such as {"do": "flush"}' in refused['error']
    assert done['message'] == 'flush is done'
    assert serving.asked == [{'do': 'flush'}]


@pytest.mark.parametrize('content', [b'{"do": "' + b'x' * 10_000_000 + b'"}\n', os.urandom(10_000_000).replace(b'\n', b'\r')])
def test_a_line_has_a_maximum_length(serve: Callable[..., Serving], content: bytes) -> None:
    """A longer line is refused while it is read, and the client is disconnected."""
    serving = serve()
    with raw(serving) as client:
        with pytest.raises((BrokenPipeError, ConnectionResetError)):
            client.sendall(content)
        (refused,) = read_lines(client)
    assert refused['error'] == f'a request has at most {MAX_REQUEST_BYTES} bytes'
    assert works(serving)
    assert serving.asked == [{'do': 'flush'}]


def test_a_line_of_maximum_length_is_accepted(serve: Callable[..., Serving]) -> None:
    """The limit is the documented one."""
    serving = serve()
    line = b'{"do": "tell"' + b' ' * (MAX_REQUEST_BYTES - 14) + b'}\n'
    with raw(serving) as client:
        client.sendall(line)
        client.shutdown(socket.SHUT_WR)
        (done,) = read_lines(client)
    assert done['ok']


def test_an_incomplete_line_is_not_a_request(serve: Callable[..., Serving]) -> None:
    """A client that disconnects in the middle of a request has requested nothing."""
    serving = serve()
    with raw(serving) as client:
        client.sendall(b'{"do": "flush"}')
        client.shutdown(socket.SHUT_WR)
        (refused,) = read_lines(client)
    assert 'must end with a newline' in refused['error']
    assert serving.asked == []


@pytest.mark.parametrize('drips', [False, True])
def test_a_client_must_send_a_line(serve: Callable[..., Serving], drips: bool) -> None:
    """One that sends nothing, or a byte now and then, is disconnected after a while."""
    serving = serve(idle_s=SHORT_S)
    with raw(serving) as client:
        if drips:
            with suppress(BrokenPipeError, ConnectionResetError):
                while True:
                    client.sendall(b' ')
                    time.sleep(SHORT_S / 20)
        (refused,) = read_lines(client)
    assert f'no complete line was received for {SHORT_S:g} s' in refused['error']
    assert works(serving)


def test_a_client_must_read_its_answer(serve: Callable[..., Serving]) -> None:
    """One that does not is disconnected after a while; others are served during that time, and its response is freed."""
    serving = serve(read_s=SHORT_S)
    with raw(serving) as client:
        client.sendall(b'{"do": "tell", "long": 9000000}\n')
        until(lambda: len(serving.asked) == 1)
        assert works(serving)
        until(lambda: not serving.control._clients)
        assert works(serving)


def test_the_number_of_clients_is_limited(serve: Callable[..., Serving]) -> None:
    """Of a hundred the excess ones are refused immediately, and there is room again when some have disconnected."""
    serving = serve()
    clients = [raw(serving) for _ in range(100)]
    for client in clients:
        with suppress(BrokenPipeError, ConnectionResetError):
            client.sendall(b'{"do": "flush"}\n')
    answers = [json.loads(client.makefile().readline()) for client in clients]
    assert [answer['ok'] for answer in answers].count(True) == MAX_CLIENTS
    assert {answer['error'] for answer in answers if not answer['ok']} == {
        f'{MAX_CLIENTS} clients are connected, which is the maximum'
    }
    for client in clients:
        client.close()
    until(lambda: not serving.control._clients)
    assert works(serving)


def test_an_answer_has_a_deadline(serve: Callable[..., Serving]) -> None:
    """A client gets an error while the node hangs, and requests not started by then are not executed."""
    serving = serve(answer_s=SHORT_S)
    with serving.hold, closing(Connection(serving.spool, 'control.sock', WAIT_S)) as connection:
        answer = connection.ask('flush')
    assert not answer['ok']
    assert f'did not finish it within {SHORT_S:g} s' in answer['error']
    assert works(serving)
    assert len(serving.asked) == 1


def test_clients_are_notified_on_close(serve: Callable[..., Serving]) -> None:
    """Those waiting for a response, and the others; no client waits for a node that has stopped."""
    serving = serve()
    with serving.hold, raw(serving) as waits, raw(serving) as idles:
        waits.sendall(b'{"do": "flush"}\n')
        until(lambda: len(serving.control._waiting) + len(serving.asked) > 0)
        until(lambda: len(serving.control._clients) == 2)
        closes = threading.Thread(target=serving.control.close)
        closes.start()
        assert [answer['error'] for answer in (*read_lines(waits), *read_lines(idles))] == ['the node is closing'] * 2
        closes.join()
    with pytest.raises(NodeUnavailable, match='no node is running with the spool'):
        connect(serving.spool)


def test_the_socket_can_be_closed_during_an_answer(serve: Callable[..., Serving], caplog: pytest.LogCaptureFixture) -> None:
    """Also if the response and the close coincide."""
    serving = serve()
    gate, client = threading.Event(), raw(serving)
    with closing(client):
        with serving.hold:
            client.sendall(b'{"do": "flush"}\n')
            while not serving.control._waiting:
                time.sleep(0.01)
            assert serving.control._loop is not None
            serving.control._loop.call_soon_threadsafe(gate.wait)
        while not serving.asked:
            time.sleep(0.01)
        threading.Timer(SHORT_S, gate.set).start()
        serving.control.close()
        assert read_lines(client)[0]['ok']
    assert not caplog.records


def test_a_killed_node_is_detected(tmp_path: Path) -> None:
    """A client gets an error if its node is killed during a response."""
    with socket.socket(socket.AF_UNIX) as listener:
        with address(tmp_path, 'control.sock') as there:
            listener.bind(there)
        listener.listen()
        for report in (b'', b'{"ok": tr', b'nonsense\n', b'[]\n'):
            with closing(Connection(tmp_path, 'control.sock', WAIT_S)) as connection:
                node, _ = listener.accept()
                node.sendall(report)
                node.shutdown(socket.SHUT_WR)
                with pytest.raises(NodeUnavailable, match='no longer answers'):
                    connection.ask('flush')
                node.close()
        with (
            closing(Connection(tmp_path, 'control.sock', SHORT_S)) as connection,
            pytest.raises(NodeUnavailable, match='did not answer'),
        ):
            connection.ask('flush')


def test_an_endless_answer_is_abandoned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A faulty server cannot fill the memory of a client."""
    monkeypatch.setattr(control, 'MAX_ANSWER_BYTES', 1 << 16)
    with socket.socket(socket.AF_UNIX) as listener:
        with address(tmp_path, 'control.sock') as there:
            listener.bind(there)
        listener.listen()
        with closing(Connection(tmp_path, 'control.sock', WAIT_S)) as connection:
            node, _ = listener.accept()
            node.sendall(b'x' * (1 << 17))
            with pytest.raises(NodeUnavailable, match='has more than 65536 bytes'):
                connection.ask('flush')
            node.close()


def test_the_socket_of_a_killed_node_is_replaced(serve: Callable[..., Serving], tmp_path: Path) -> None:
    """A socket without a listener, and one that was not completely set up."""
    spool = tmp_path / 'spool'
    spool.mkdir(mode=0o700)
    for name in ('control.sock', 'control.sock.part', 'control-thor.sock'):
        with socket.socket(socket.AF_UNIX) as left, address(spool, name) as there:
            left.bind(there)
    with pytest.raises(NodeUnavailable, match=r'no node is running with the spool .* \(start one: .*SHADOWHOUND_HOME'):
        connect(spool)
    serving = serve(spool)
    assert works(serving)
    assert sorted(path.name for path in spool.iterdir()) == ['control.lock', 'control.sock']


def test_several_nodes_of_one_spool_have_separate_sockets(serve: Callable[..., Serving]) -> None:
    """The first has the usual name of the socket, each other one its robot's; clients find them by robot."""
    first, second = serve(robot='thor'), serve(robot='tachi')
    assert sorted(path.name for path in first.spool.glob('*.sock')) == ['control-tachi.sock', 'control.sock']
    with closing(connect(first.spool, 'thor')) as thor, closing(connect(first.spool, 'tachi')) as tachi:
        assert (thor.ask('flush')['robot'], tachi.ask('flush')['robot']) == ('thor', 'tachi')
    with pytest.raises(NodeUnavailable, match=r'several nodes are running here: tachi, thor \(name one: --robot NAME\)'):
        connect(first.spool)
    with pytest.raises(NodeUnavailable, match='no node of odin is running here, only those of tachi, thor'):
        connect(first.spool, 'odin')
    first.close()
    with closing(connect(first.spool)) as alone:
        assert alone.ask('flush')['robot'] == 'tachi'
    second.close()
    again = serve(robot='tachi')
    assert [path.name for path in again.spool.glob('*.sock')] == ['control.sock']


def test_the_path_of_the_spool_may_be_long(serve: Callable[..., Serving], tmp_path: Path) -> None:
    """Longer than the maximum address of a socket (107 bytes)."""
    spool = tmp_path.joinpath(*['a' * 100] * 5) / 'spool'
    serving = serve(spool)
    assert works(serving)
    assert len(str(spool)) > 500


def test_a_socket_that_cannot_be_created_is_tried_again(serve: Callable[..., Serving], tmp_path: Path,
                                                    monkeypatch: pytest.MonkeyPatch) -> None:  # fmt: skip
    """The thread fails, which is reported as for any other; the socket is created once that is possible."""
    may = threading.Event()
    replace = os.replace

    def refused(source: Path, target: Path) -> None:
        if target.name == 'control.sock' and not may.is_set():
            raise PermissionError('no sockets here')
        replace(source, target)

    monkeypatch.setattr('shadowhound_data_logger.node.reporting.control.OPEN_S', SHORT_S)
    monkeypatch.setattr('shadowhound_data_logger.node.reporting.control.os.replace', refused)
    serving = serve()
    until(lambda: serving.control.worker.status().failing)
    assert 'no sockets here' in serving.control.worker.status().last_error
    may.set()
    until((serving.spool / 'control.sock').exists)
    assert works(serving)
