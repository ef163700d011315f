"""The spool's index is lost under everything that uses it: what that may cost is bounded, and everything goes on."""

from __future__ import annotations

from pathlib import Path

import pytest

from torture import lost_index


@pytest.mark.slow
@pytest.mark.long('two minutes of damage')
def test_everything_goes_on_without_its_index(tmp_path: Path) -> None:
    """Deleted, cut and overwritten, with kills after it: nothing is stored twice or overwritten, and every claim is true.

    What it costs in messages depends on the machine's load; the campaign judges that.
    """
    found, happened = lost_index.campaign(tmp_path / 'lost', lost_index.SHORT_ROUNDS, 14)
    assert {what: lines for what, lines in found.wrong.items() if lines and not what.startswith('lost: ')} == {}
    assert len(happened.damages) == lost_index.SHORT_ROUNDS
