"""Hostile messages through every encoder: accounted for, in bounded memory and time, and nothing but that."""

from __future__ import annotations

from typing import Any

from formats.hostile import TYPES, Fuzzer
from hypothesis import given, settings
from hypothesis import strategies as st
from profiles import examples

from shadowhound_data_logger.formats.types import header_frame_id, header_stamp_ns

ROUNDS = examples(1500)


def test_hostile_messages(ros: Any) -> None:
    """No batch of hostile messages raises, takes memory beyond its size, or leaves a message unaccounted."""
    fuzzer = Fuzzer(ros)
    for seed in range(ROUNDS):
        try:
            fuzzer.round(seed)
        except Exception as error:
            raise AssertionError(f'seed {seed}') from error
    assert {'encoded', 'malformed', 'wrong_type', 'unknown_type', 'size_mismatch'} <= fuzzer.outcomes.keys()
    assert fuzzer.outcomes['encoded'] > ROUNDS / 10


def test_false_lengths_at_every_word(ros: Any) -> None:
    """Each 4-byte word of a message of each type, replaced by the largest number, is refused or harmless at once."""
    fuzzer = Fuzzer(ros)
    for type_name in TYPES:
        for cdr in fuzzer._valid.get(type_name, []):
            for at in range(4, min(len(cdr) - 3, 400), 4):
                ros.encode(type_name, cdr[:at] + b'\xff\xff\xff\xff' + cdr[at + 4 :], sensor='imu', format='json')


@settings(derandomize=True, deadline=None, max_examples=examples(200))
@given(
    st.one_of(
        st.binary(max_size=40), st.builds(bytes.__add__, st.sampled_from([b'\0\1\0\0', b'\0\0\0\0']), st.binary(max_size=60))
    )
)
def test_a_header_of_any_bytes(cdr: bytes) -> None:
    """What the intake reads of a message is a number and a text, whatever the bytes are; text never exceeds them."""
    assert abs(header_stamp_ns(cdr)) < 2**63
    assert len(header_frame_id(cdr).encode(errors='surrogatepass')) <= 3 * len(cdr)
