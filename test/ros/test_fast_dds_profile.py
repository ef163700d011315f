"""Who does not load our profile of Fast DDS."""

from __future__ import annotations

import pytest

from shadowhound_data_logger.ros.fast_dds_profile import PROFILE_FILES, SHIPPED, TRANSPORTS, without_our_profile


@pytest.mark.parametrize('name', PROFILE_FILES)
@pytest.mark.parametrize(
    ('given', 'is_hidden'),
    [
        ({'': f'/opt/share/{SHIPPED}'}, True),
        ({'': '/home/go2/mine.xml'}, False),
        ({'': f'/opt/share/{SHIPPED}', TRANSPORTS: 'UDPv4'}, False),
    ],
    ids=['ours', 'of an operator', 'beside transports of an operator'],
)
def test_our_profile_is_hidden_for_a_while(name: str, given: dict[str, str], is_hidden: bool) -> None:
    environ = {key or name: value for key, value in given.items()}
    before = dict(environ)
    with without_our_profile(environ):
        assert environ == {key: value for key, value in before.items() if key != name or not is_hidden}
    assert environ == before
