"""``make bench``: all benchmarks one after the other, then docs/evidence/benchmarks.md with their results.

About half an hour; ``--quick`` takes about three minutes and does not change docs/. Exit code 1 if a bar is missed, or a
benchmark fails (docs/ is then unchanged, too). Nothing else should run on the machine during that time.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import platform
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import _page
import _proc
from _report import FOLDER, LEROBOT, show, spread

HERE: Final = Path(__file__).resolve().parent
DOCS: Final = HERE.parent / 'docs' / 'evidence'
RESULTS: Final = 'benchmarks.json'
DRAIN_BAR: Final = 0.9


@dataclass(frozen=True, slots=True)
class Step:
    """A benchmark and its command."""

    name: str
    arguments: tuple[str, ...] = ()
    quick: tuple[str, ...] | None = ()
    """None: too long for ``--quick``."""


STEPS: Final = (
    Step('node_cpu', ('--seconds', '30'), ('--seconds', '8')),
    Step('node_least', ('--seconds', '60'), None),
    Step('intake', ('--seconds', '20'), ('--seconds', '5')),
    Step('take', ('--seconds', '20'), ('--seconds', '4')),
    Step('vendors', ('--seconds', '60'), ('--seconds', '10')),
    Step('small_messages', ('--seconds', '10'), ('--seconds', '3')),
    Step('full_rate', ('--seconds', '60', '--away', '300'), ('--seconds', '10', '--away', '10')),
    Step('backlog_memory', (), ('--seconds', '5', '--away', '10', '--back', '20')),
    Step('bag_recording', ('--seconds', '40'), ('--seconds', '10')),
    Step('rosbag2', ('--seconds', '20'), None),
    Step('latency', ('--seconds', '30'), ('--seconds', '8', '--away', '10')),
    Step('drain', ('--rounds', '5', '--scale', '0.3'), ('--rounds', '2', '--scale', '0.1')),
    Step('mission_calls', ('--seconds', '20'), ('--seconds', '3')),
    Step('missions', quick=('--points', '10000')),
    Step('lake', quick=('--days', '2', '--objects', '500')),
    Step('ask', quick=('--objects', '50000', '--missions', '5000')),
    Step('datasets', ('--frames', '300'), quick=None),
    Step('training_reads', quick=None),
    Step('dataset_index', quick=('--rows', '36000', '--rounds', '1')),
    Step('likeness', quick=('--vectors', '8640')),
    Step('encode_formats'),
    Step('spool_commits', quick=None),
    Step('keep', ('--seconds', '140'), None),
)
FOLDERLESS: Final = ('encode_formats',)
ABSENT: Final = {
    *(() if LEROBOT.is_file() else ('datasets', 'training_reads')),
    *(() if shutil.which('ros2') else ('rosbag2',)),
}
"""Benchmarks against programs that are not on this machine: the page keeps the earlier results."""


def run(step: Step, folder: Path, *, quick: bool) -> dict[str, Any] | None:
    """The output of a benchmark as JSON, with its command and duration; its progress is printed on standard error.

    None if it failed: the others are measured anyway.
    """
    arguments = [*((step.quick or ()) if quick else step.arguments), '--json']
    command = [f'bench/{step.name}.py', *arguments]
    if step.name not in FOLDERLESS:
        arguments += ['--folder', str(folder)]
    print(f'{step.name} ...', file=sys.stderr, flush=True)
    start = time.monotonic()
    program = [sys.executable, str(HERE / f'{step.name}.py'), *arguments]
    done = subprocess.run(program, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        print(f'{step.name} failed with exit code {done.returncode}', file=sys.stderr, flush=True)
        return None
    answers = [json.loads(line) for line in done.stdout.splitlines()]
    found: dict[str, Any] = answers[0] if len(answers) == 1 else {'rows': answers}
    if 'bars' not in found:
        found = {'bars': _bars(found), 'figures': found}
    return {'command': ' '.join(['scripts/with-env', 'python', *command]), 'took_s': round(time.monotonic() - start, 1), **found}


def _bars(found: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The bars of benchmarks that only give results: those of the drain."""
    return [
        {
            'what': f'drain of {row["objects"]} objects of {row["bytes"] / 1000:g} KB against {row["threads"]} threads of boto3',
            'bar': f'at least {DRAIN_BAR:g}', 'value': row['speed_ratio'], 'unit': 'of the speed',
            'holds': row['speed_ratio'] >= DRAIN_BAR, 'rounds': row['speed_ratios'],
        }
        for row in found.get('drain', ())
    ]  # fmt: skip


def machine() -> dict[str, str]:
    """The machine of the results."""
    from rclpy.utilities import get_rmw_implementation_identifier  # noqa: PLC0415 - only here, and it takes a while

    models = [line.partition(':')[2].strip() for line in Path('/proc/cpuinfo').read_text(encoding='utf-8').splitlines()
              if line.startswith(('model name', 'Model'))]  # fmt: skip
    memory_kb = int(Path('/proc/meminfo').read_text(encoding='ascii').split()[1])
    return {
        'processor': f'{models[0] if models else platform.machine()} ({platform.machine()})',
        'cores': str(len(os.sched_getaffinity(0))), 'memory': f'{memory_kb / 1e6:.0f} GB',
        'kernel': f'{platform.system()} {platform.release()}', 'python': platform.python_version(), 'ros': _ros(),
        'middleware': get_rmw_implementation_identifier(), 'commit': _commit(),
        'when': time.strftime('%Y-%m-%d %H:%M UTC', time.gmtime()), 'load_before': f'{_proc.load():.2f}',
    }  # fmt: skip


def _earlier(name: str) -> dict[str, Any]:
    """The page's earlier results of a benchmark, with its commit and machine."""
    benches = json.loads((DOCS / RESULTS).read_text(encoding='utf-8'))['benches']
    return {name: benches[name]} if name in benches else {}


def _ros() -> str:
    if distribution := os.environ.get('ROS_DISTRO'):
        return distribution
    try:
        return f'rclpy {importlib.metadata.version("ros-rclpy")} (wheels)'
    except importlib.metadata.PackageNotFoundError:
        return 'unknown'


def _commit() -> str:
    """Of the checkout; empty if it is not one."""
    git = ['git', '-C', str(HERE)]
    head = subprocess.run([*git, 'rev-parse', '--short', 'HEAD'], capture_output=True, text=True, check=False).stdout.strip()
    changed = subprocess.run([*git, 'status', '--porcelain', '--untracked-files=no'], capture_output=True, text=True, check=False)
    return f'{head} with changes' if head and changed.stdout else head


def table(results: Mapping[str, Any]) -> str:
    """The bars for a terminal."""
    lines = []
    for found in results['benches'].values():
        for bar in found['bars']:
            state = 'holds ' if bar['holds'] else 'MISSED'
            lines.append(f'{state} {show(bar["value"]):>8} {bar["unit"]}, {bar["bar"]}: {bar["what"]} {spread(bar["rounds"])}')
    return '\n'.join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('--quick', action='store_true', help='shorter, and docs/ stays as it is: see whether all of it works')
    parser.add_argument('--only', nargs='+', choices=[step.name for step in STEPS], help='these alone; docs/ stays as it is')
    parser.add_argument('--folder', type=Path, default=FOLDER, help='where spools and servers lie (default .cache/bench)')
    parser.add_argument('--output', type=Path, help=f'where {RESULTS} and the page go (default docs, or the folder above)')
    options = parser.parse_args(arguments)
    whole = not options.quick and not options.only
    start = time.monotonic()
    results: dict[str, Any] = {'machine': machine(), 'quick': options.quick}
    steps = [step for step in STEPS if (step.name in options.only if options.only else step.quick is not None or whole)
             and step.name not in ABSENT]  # fmt: skip
    found = {step.name: run(step, options.folder, quick=options.quick) for step in steps}
    where = {name: results['machine'][name] for name in ('commit', 'processor')}
    results['benches'] = benches = {name: {**answer, **where} for name, answer in found.items() if answer is not None}
    results['took_s'] = round(time.monotonic() - start)
    is_complete = len(benches) == len(steps)
    held = all(bar['holds'] for answer in benches.values() for bar in answer['bars'])
    for name in ABSENT if whole else ():
        benches |= _earlier(name)
    whole = whole and is_complete
    output = options.output or (DOCS if whole else options.folder / 'page')
    output.mkdir(parents=True, exist_ok=True)
    (output / RESULTS).write_text(_page.dump(results), encoding='utf-8')
    _page.write(results, DOCS / 'benchmarks.md', output)
    print(f'{table(results)}\n\n{results["took_s"] / 60:.1f} minutes; {output}/benchmarks.md')
    return 0 if held and is_complete else 1


if __name__ == '__main__':
    sys.exit(main())
