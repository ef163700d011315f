"""What tests of several folders share: the embedded Tower, started once."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from shadowhound_data_logger.sim.tower import Tower


@pytest.fixture(scope='session')
def seaweed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Tower]:
    """A running Tower with the S3 server only; its user ``limited`` may use the bucket ``allowed``, not create it."""
    from shadowhound_data_logger.sim.tower import Tower

    actions = ('Read:allowed', 'Write:allowed', 'List:allowed')
    with Tower(tmp_path_factory.mktemp('seaweed'), users={'limited': actions}) as tower:
        yield tower


@pytest.fixture(scope='session')
def tower(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Tower]:
    """A running Tower with S3 and MLflow; the latter takes some ten seconds to start."""
    from shadowhound_data_logger.sim.tower import Tower

    with Tower(tmp_path_factory.mktemp('tower'), mlflow=True) as tower:
        yield tower
