"""docs/evidence/benchmarks.md is what bench/_page.py makes of docs/evidence/benchmarks.json."""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
PAGE, FIGURES = ROOT / 'docs/evidence/benchmarks.md', ROOT / 'docs/evidence/benchmarks.json'


@pytest.fixture
def page(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(ROOT / 'bench')
    return importlib.import_module('_page')


def test_the_page_has_the_measured_figures(page: Any) -> None:
    """``python bench/_page.py`` would change no figure of it."""
    text = PAGE.read_text(encoding='utf-8')
    assert page.filled(text, json.loads(FIGURES.read_text(encoding='utf-8'))) == text


def test_what_another_vendors_messages_cost_is_on_the_page(page: Any) -> None:
    """A line for each pair that was measured; the third, in the robot's own RMW, is not always there."""
    figures = {
        'bytes': {'large': 300_000, 'small': 324},
        'us': {'fast': {'small': [100.0, 140.0], 'large': [500.0]}, 'cyclone': {'small': [110.0], 'large': [480.0]}},
        'memory': {'fast': {'anon': 50.0, 'file': 40.0, 'shmem': 10.0}, 'cyclone': {'anon': 50.0, 'file': 20.4, 'shmem': 0.0}},
        'lost': {'fast': 0, 'cyclone': 2},
    }
    results = {'benches': {'vendors': {'figures': figures}}}
    lines = page.filled('<!-- bench vendors -->\n<!-- end vendors -->\n', results).splitlines()
    assert lines[1].startswith('| the node hears | CPU a message of 324 bytes | spread | CPU a message of 300,000 bytes |')
    assert lines[3:5] == [
        '| Fast DDS | 120 us | 100 to 140 us | 500 us | 500 to 500 us | 100 MB | 0 |',
        '| Cyclone DDS | 110 us | 110 to 110 us | 480 us | 480 to 480 us | 70 MB | 2 |',
    ]
    assert '<!-- bench vendors -->' in PAGE.read_text(encoding='utf-8')


def test_a_missing_measurement_is_marked(page: Any) -> None:
    assert '*not measured*' in page.filled('<!-- bench vendors -->\n<!-- end vendors -->\n', {'benches': {}})


def test_what_training_sets_cost_beside_lerobots_writer_is_on_the_page(page: Any) -> None:
    """A line a writer, with medians of the runs."""
    runs = {
        'ours': [{'frames_per_s': rate, 'cpu_s': 9.0, 'memory_mb': 400.0} for rate in (30.0, 50.0, 42.0)],
        'lerobot, streaming': [{'frames_per_s': 33.0, 'cpu_s': 15.0, 'memory_mb': 1000.0}],
    }
    results = {'benches': {'datasets': {'figures': {'runs': runs, 'frames': 300, 'frame_bytes': 101_000}}}}
    lines = page.filled('<!-- bench datasets -->\n<!-- end datasets -->\n', results).splitlines()
    assert lines[1] == '| 300 frames of 101 KB | frames a second | spread | CPU a frame | memory |'
    assert lines[3:5] == [
        '| `export lerobot` | 42 | 30 to 50 | 30 ms | 400 MB |',
        '| lerobot, `streaming_encoding` | 33 | 33 to 33 | 50 ms | 1000 MB |',
    ]
    assert '<!-- bench datasets -->' in PAGE.read_text(encoding='utf-8')


def test_what_rosbag2_costs_next_to_the_node_is_on_the_page(page: Any) -> None:
    """A line per rate and recorder, and one per recorder for the complete job; loss is a share of what was published."""

    def runs(us: list[float], lost: int, **more: list[float]) -> dict[str, Any]:
        return {'us': us, 'published': [500, 500], 'lost': [lost, 0], 'bytes': [400.0, 400.0], **more}

    late = {'late_p50_s': [6.0, 6.2], 'late_max_s': [11.0, 11.5]}
    figures = {
        'version': '0.26.5', 'job_hz': 260, 'split_s': 10,
        'rates': {'10000': {'rosbag2': runs([60.0, 60.0], 30), 'bag': runs([10.0, 14.0], 0)}},
        'job': {'rosbag2': runs([90.0, 90.0], 0, copy_us=[20.0, 20.0], **late), 'bag': runs([50.0, 50.0], 0, **late)},
    }  # fmt: skip
    block = '<!-- bench rosbag2 -->\n<!-- end rosbag2 -->\n'
    lines = page.filled(block, {'benches': {'rosbag2': {'figures': figures}}}).splitlines()
    assert lines[3:5] == [
        '| 10,000/s | rosbag2 0.26.5 | 60 us (60 to 60) | 3 % | 400 |',
        '| 10,000/s | the node, into a bag | 12 us (10 to 14) | 0 | 400 |',
    ]
    assert lines[8:10] == [
        '| rosbag2 0.26.5 and rclone | 90 us (90 to 90) | 20 us | 0 | 0 KB | 6.1 s | 11.5 s |',
        '| the node | 50 us (50 to 50) |  | 0 | 0 KB | 6.1 s | 11.5 s |',
    ]
    assert '*not measured*' in page.filled(block, {'benches': {}})
    assert '<!-- bench rosbag2 -->' in PAGE.read_text(encoding='utf-8')
