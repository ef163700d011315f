"""Unknown names in a query, and the suggested ones."""

from __future__ import annotations

import pytest

from shadowhound_data_logger.core.errors import UnknownName
from shadowhound_data_logger.lake.names import check_name_of, misspelled

KNOWN = ('objects', 'sensor', 'battery_pct', 't_start', 'x')


@pytest.mark.parametrize(('query', 'error', 'remedy'), [
    ('batery_pct < 30', 'FieldNotFound Column col(batery_pct) not found.', "is 'batery_pct' 'battery_pct'?"),
    ('SELECT o.sensr FROM objects o', 'Column sensr not found in o', "is 'sensr' 'sensor'?"),
    ('SELECT "sensr"', 'Binder Error: Referenced column "sensr" not found in FROM clause!', "is 'sensr' 'sensor'?"),
    ('SELECT * FROM objcts', 'Catalog Error: Table with name objcts does not exist!', "is 'objcts' 'objects'?"),
    ('SENSR = 1', "No field named 'SENSR'", "is 'SENSR' 'sensor'?"),
    ('zzzz < 30', 'Column zzzz not found', ''), ('z < 30', 'Column z not found', ''),
    ('sensor < <', 'syntax error near <', ''), ('1', 'sensr', ''), ('', '', ''),
])  # fmt: skip
def test_a_misspelled_column_or_view_has_its_nearest_names(query: str, error: str, remedy: str) -> None:
    """With any engine: the name in both the query and the error counts."""
    assert misspelled(query, error, KNOWN) == remedy


def test_a_name_is_checked_only_where_some_are_known() -> None:
    check_name_of('sensor', 'camra', ())
    check_name_of('sensor', 'camera', ('camera', None))
    with pytest.raises(UnknownName, match="no sensor 'camra'") as raised:
        check_name_of('sensor', 'camra', ('camera', 'lidar'))
    assert raised.value.remedy == "is it 'camera'?"
    with pytest.raises(UnknownName) as raised:
        check_name_of('sensor', 'zzz', map(str, range(12)))
    assert raised.value.remedy.endswith('and 2 more')
