"""Tokens, sign-ins and sign-outs of the page, without a server."""

from __future__ import annotations

import stat
from collections.abc import Callable
from pathlib import Path

import pytest

from shadowhound_data_logger.live import access as access_module
from shadowhound_data_logger.live.access import LASTS_S, MAX_FAILURES, SIGN_OUTS_FILE, Access, TokenRefused, make_tokens


class Door:
    """Tokens, and a clock set by the test."""

    def __init__(self, folder: Path) -> None:
        self.paths = access_module.make_tokens(folder)
        self.now_s = 1000.0
        self.access = access_module.Access(self.paths, is_open=False, monotonic=lambda: self.now_s)

    def guess(self, address: str) -> bool:
        """Whether the address may try at all, with a wrong token."""
        if self.access.wait_s(address):
            return False
        assert self.access.sign_in('a wrong token', address) is None
        return True

    def lets_in(self, address: str) -> bool:
        token = access_module.read_token(self.paths[access_module.OPERATOR])
        return not self.access.wait_s(address) and self.access.sign_in(token, address) is not None


def test_strangers_lock_out_only_themselves(tmp_path: Path) -> None:
    """Wrong tokens from many addresses, one per second and for an hour, do not keep the operator from signing in."""
    door = Door(tmp_path)
    for second in range(3600):
        door.now_s += 1.0
        door.guess(f'10.0.0.{second % 50}')
        assert door.lets_in('10.0.1.1'), second


def test_an_address_that_guesses_waits_a_minute_from_its_first_guess(tmp_path: Path) -> None:
    """It may try up to the limit in any minute; the wait is reported, and a valid token after it clears the record."""
    door = Door(tmp_path)
    assert [door.guess('10.0.0.1') for _ in range(MAX_FAILURES + 1)] == [True] * MAX_FAILURES + [False]
    assert door.access.wait_s('10.0.0.1') == access_module.FAILURES_S
    door.now_s += access_module.FAILURES_S
    assert door.lets_in('10.0.0.1')
    assert [door.guess('10.0.0.1') for _ in range(MAX_FAILURES + 1)] == [True] * MAX_FAILURES + [False]


def test_a_host_with_many_addresses_of_ipv6_is_one(tmp_path: Path) -> None:
    """All addresses of a /64 wait together, an IPv4 address is the same when mapped to IPv6, and other networks do not wait."""
    door = Door(tmp_path)
    assert [door.guess(f'fd00::{n:x}') for n in range(MAX_FAILURES + 1)] == [True] * MAX_FAILURES + [False]
    assert door.lets_in('fd00:0:0:1::1')
    assert [door.guess('::ffff:10.0.0.1') for _ in range(MAX_FAILURES)] == [True] * MAX_FAILURES
    assert not door.guess('10.0.0.1')


def test_the_memory_of_wrong_tokens_is_bounded(tmp_path: Path) -> None:
    """However many addresses guess, a bounded number of them is remembered, including those that guess now."""
    door = Door(tmp_path)
    for number in range(3 * access_module.MAX_ADDRESSES):
        door.guess(f'10.{number >> 16 & 255}.{number >> 8 & 255}.{number & 255}')
    failures = door.access._failures
    assert (len(failures), max(map(len, failures.values()))) == (access_module.MAX_ADDRESSES, 1)
    assert [door.guess('10.9.9.9') for _ in range(MAX_FAILURES + 1)] == [True] * MAX_FAILURES + [False]


@pytest.mark.parametrize(
    ('mode', 'text', 'why'), [(0o640, 'a' * 30, 'restricted to its owner'), (0o600, 'short', 'no token of at least')]
)
def test_a_token_that_others_can_read_is_refused(tmp_path: Path, mode: int, text: str, why: str) -> None:
    """The error names the file and the remedy."""
    paths = make_tokens(tmp_path)
    assert {stat.S_IMODE(path.stat().st_mode) for path in paths.values()} == {0o600}
    paths['viewer'].write_text(text)
    paths['viewer'].chmod(mode)
    with pytest.raises(TokenRefused, match=why):
        make_tokens(tmp_path)


def test_a_forged_cookie_is_rejected(tmp_path: Path) -> None:
    """With another role, a later end, or invalid contents it identifies no user."""
    now = [1000.0]
    access = Access(make_tokens(tmp_path), is_open=False, now=lambda: now[0])
    signed = access.sign_in((tmp_path / 'viewer.token').read_text().strip(), '10.0.0.1')
    assert signed is not None
    _, cookie = signed
    role, until, nonce, signature = cookie.split('.')
    assert access.who(cookie) is not None
    for forged in (f'operator.{until}.{nonce}.{signature}', f'{role}.{int(until) + 1}.{nonce}.{signature}',
                   f'{role}.{until}.x.{signature}', '', '...', 'viewer.²..', f'{role}.{"9" * 400}.{nonce}.{signature}',
                   'é.é.é.é'):  # fmt: skip
        assert access.who(forged) is None
    now[0] += 13 * 3600
    assert access.who(cookie) is None


class Signing:
    """Sign-ins with a clock set by the test; each ``Access`` acts as another process with the same tokens."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.now = [1_800_000_000.0]
        self.tokens = make_tokens(folder)

    def access(self) -> Access:
        return Access(self.tokens, is_open=False, now=lambda: self.now[0])

    def cookie(self, access: Access) -> str:
        signed = access.sign_in(self.tokens['viewer'].read_text().strip(), '10.0.0.1')
        assert signed is not None
        return signed[1]

    def sign_out(self, access: Access, cookie: str) -> None:
        who = access.who(cookie)
        assert who is not None
        access.sign_out(who)
        access.keep(who.role)

    @property
    def entries(self) -> int:
        """The entries of the file, one per line; the first two lines are not entries."""
        return len((self.folder / f'viewer.{SIGN_OUTS_FILE}').read_text().splitlines()) - 2


def test_a_sign_out_holds_at_every_page_that_has_the_tokens(tmp_path: Path) -> None:
    """With two processes neither forgets the other's sign-outs, even simultaneous ones."""
    it = Signing(tmp_path)
    first, second = it.access(), it.access()
    cookies = [it.cookie(first) for _ in range(6)]
    for done, access in enumerate((first, second, first), 1):
        it.sign_out(access, cookies[done - 1])
        for each in (first, second, it.access()):
            assert [each.who(cookie) is None for cookie in cookies] == [place < done for place in range(6)]
    for access, cookie in ((first, cookies[3]), (second, cookies[4])):
        who = access.who(cookie)
        assert who is not None
        access.sign_out(who)
    first.keep('viewer')
    second.keep('viewer')
    assert [it.access().who(cookie) is None for cookie in cookies] == [True] * 5 + [False]


def test_the_memory_of_sign_outs_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Above the limit the oldest are removed, and none of those cookies becomes valid again; expired entries are removed."""
    monkeypatch.setattr(access_module, 'MAX_SIGN_OUTS', 3)
    it = Signing(tmp_path)
    access = it.access()
    ended = []
    for _ in range(7):
        it.now[0] += 60.0
        ended.append(it.cookie(access))
        it.sign_out(access, ended[-1])
    assert it.entries == 3
    living = it.cookie(access)
    for each in (access, it.access()):
        assert [cookie for cookie in ended if each.who(cookie) is not None] == []
        assert each.who(living) is not None
    it.now[0] += LASTS_S + 60.0
    last = it.cookie(access)
    it.sign_out(access, last)
    assert it.entries == 1
    it.now[0] -= LASTS_S  # the robot's clock is set back: the expired entry is valid again
    assert [cookie for cookie in (*ended, last) if it.access().who(cookie) is not None] == []


def test_repeated_sign_outs_of_a_viewer_end_no_operators_sign_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Sign-outs above the limit count for the role alone."""
    monkeypatch.setattr(access_module, 'MAX_SIGN_OUTS', 3)
    it = Signing(tmp_path)
    access = it.access()
    operator = access.sign_in(it.tokens['operator'].read_text().strip(), '10.0.0.1')
    assert operator is not None
    it.now[0] += 1.0
    for _ in range(9):
        it.sign_out(access, it.cookie(access))
    for each in (access, it.access()):
        assert each.who(operator[1]) == operator[0]


def test_repeated_sign_ins_of_a_viewer_end_no_operators_sign_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only the newest of the viewer's sign-ins is valid, also if all were within a second."""
    monkeypatch.setattr(access_module, 'MAX_SIGN_OUTS', 3)
    it = Signing(tmp_path)
    access = it.access()
    tokens = {role: path.read_text().strip() for role, path in it.tokens.items()}
    operator = access.sign_in(tokens['operator'], '10.0.0.1')
    assert operator is not None
    cookies: list[str] = []
    for _ in range(9):
        signed = access.sign_in(tokens['viewer'], '10.0.0.1', over=access.who(cookies[-1] if cookies else None))
        assert signed is not None
        access.keep('viewer')
        cookies.append(signed[1])
    for each in (access, it.access()):
        assert each.who(operator[1]) == operator[0]
        assert [each.who(cookie) is not None for cookie in cookies] == [False] * 8 + [True]
    assert it.entries == 3


def test_a_clock_that_was_ahead_makes_no_cookie_for_years(tmp_path: Path) -> None:
    """The damage found then ends all sign-ins until that time; the remedy is reported, and new tokens help."""
    it = Signing(tmp_path)
    it.now[0] += 70 * 365 * 86400.0
    (tmp_path / f'viewer.{SIGN_OUTS_FILE}').write_bytes(b'damaged')
    it.cookie(it.access())
    it.now[0] -= 70 * 365 * 86400.0
    with pytest.raises(TokenRefused, match='the clock was ahead'):
        it.cookie(it.access())
    it.tokens = make_tokens(tmp_path, replace=True)
    access = it.access()
    found = access.who(it.cookie(access))
    assert found is not None
    assert found.expires == it.now[0] + LASTS_S


@pytest.mark.parametrize('damage', [
    lambda content: content[:0], lambda content: content[:-9], lambda content: content + b'\n', lambda content: b'\xff' + content,
    lambda content: content[:-5] + bytes([content[-5] ^ 1]) + content[-4:], lambda content: content.replace(b'1', b'2'),
], ids=['empty', 'cut', 'longer', 'noise', 'a bit of a nonce', 'other times'])  # fmt: skip
def test_a_damaged_file_ends_sign_ins_but_allows_new_ones(
    tmp_path: Path, damage: Callable[[bytes], bytes], caplog: pytest.LogCaptureFixture
) -> None:
    """It could have named any user: all must sign in again, immediately, with the same tokens; the log has the reason once."""
    it = Signing(tmp_path)
    access = it.access()
    ended, living = it.cookie(access), it.cookie(access)
    it.sign_out(access, ended)
    path = tmp_path / f'viewer.{SIGN_OUTS_FILE}'
    path.write_bytes(damage(path.read_bytes()))
    after = it.access()
    again = it.cookie(after)  # the first request, within the same second
    for each in (after, it.access()):
        assert [each.who(cookie) is not None for cookie in (ended, living, again)] == [False, False, True]
    assert [record.levelname for record in caplog.records] == ['WARNING']
    assert 'sign in again with the token' in caplog.text


def test_a_sign_in_continues_while_its_token_is_valid(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """If other users can read the other role's file, its token is invalid, which is logged once."""
    it = Signing(tmp_path)
    access = it.access()
    viewer = it.cookie(access)
    it.tokens['viewer'].chmod(0o640)
    operator = access.sign_in(it.tokens['operator'].read_text().strip(), '10.0.0.1')
    assert operator is not None
    for _ in range(3):
        assert access.who(operator[1]) == operator[0]
        assert access.who(viewer) is None
        assert access.sign_in(it.tokens['viewer'].read_text().strip(), '10.0.0.1') is None
    assert ['not restricted to its owner' in record.getMessage() for record in caplog.records] == [True]
    it.tokens['viewer'].chmod(0o600)
    assert access.who(viewer) is not None
