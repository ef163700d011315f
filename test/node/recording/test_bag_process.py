"""The bag process's reports about its bag; the real recordings are in test/bags/test_record.py."""

from __future__ import annotations

from pathlib import Path

from shadowhound_data_logger.bags.manifest import COMPLETE, RECOVERED, ClockOf, Manifest
from shadowhound_data_logger.bags.naming import unsynced_name
from shadowhound_data_logger.core.clock import SECOND, SystemClock
from shadowhound_data_logger.core.config import SpoolSettings
from shadowhound_data_logger.core.model import DataObject
from shadowhound_data_logger.node.recording.bag_process import ManifestWriter
from shadowhound_data_logger.spool.spool import Spool


def _writer(folder: Path, *ended: Manifest) -> ManifestWriter:
    """A writer that accepted these slices, in this order; it is not open."""
    writer = ManifestWriter(Spool(folder, SpoolSettings(), SystemClock('a-boot'), 'thor'))
    for manifest in ended:
        writer.put(DataObject(
            bucket='sensor-data', key=f'thor/rosbags/{manifest.bag}/manifest.json', body=manifest.to_json(), sensor='_bag',
            content_type='application/json', topic=None, type='', samples=0, t_start_ns=0, t_end_ns=0,
        ))  # fmt: skip
    return writer


def _manifest(bag: str, state: str = COMPLETE, clock: ClockOf | None = None) -> Manifest:
    return Manifest(bag, 'thor', None, state, (), (), (), clock=clock)


def test_an_older_bag_is_not_mistaken_for_the_new_one(tmp_path: Path) -> None:
    """A bag left by an earlier process is repaired during that time, before our bag ends or after it."""
    ours, older = _manifest('patrol_20251018_120000'), _manifest('patrol_20251018_110000', RECOVERED)
    assert _writer(tmp_path, older, ours).manifest_of(ours.bag) == ours
    assert _writer(tmp_path, ours, older).manifest_of(ours.bag) == ours
    assert _writer(tmp_path, older).manifest_of(ours.bag) is None


def test_a_bag_is_found_after_the_clock_was_set(tmp_path: Path) -> None:
    """It has another name then, and its manifest has the start time."""
    began_as = unsynced_name('patrol', 'b-boot', 12 * SECOND, lambda _: False)
    ours = _manifest('patrol_20251018_120000', clock=ClockOf('set_later', 'b-boot', 12 * SECOND + 5, 7, 8))
    older = _manifest('patrol_20251018_110000', clock=ClockOf('set_later', 'a-boot', 12 * SECOND, 7, 8))
    assert _writer(tmp_path, older, ours).manifest_of(began_as) == ours
    assert _writer(tmp_path, older).manifest_of(began_as) is None
