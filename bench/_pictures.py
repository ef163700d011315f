"""The plots of docs/evidence/benchmarks.md, drawn only from the results of the benchmarks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from shadowhound_data_logger.missions.plots import AMBER, BLUE, DPI, INK, STYLE, TEAL

GREY: Final = '#9aa7b2'
Figures = Mapping[str, Any]


def draw(figures: Mapping[str, Figures], folder: Path) -> None:
    """Write the PNG files that have results."""
    folder.mkdir(parents=True, exist_ok=True)
    with mpl.rc_context(STYLE):
        if 'node_cpu' in figures and 'intake' in figures:
            cpu(figures['node_cpu'], figures['intake'], folder / 'performance_cpu.png')
        if 'memory' in figures.get('full_rate', {}):
            memory(figures['full_rate'], folder / 'performance_memory.png')
        if 'latency' in figures:
            latency(figures['latency'], folder / 'performance_latency.png')


def cpu(node_cpu: Figures, intake: Figures, path: Path) -> None:
    """CPU of the node next to the plain node, and of its intake next to a callback; whiskers span the rounds."""
    figure = Figure(figsize=(9, 3.8), dpi=DPI, layout='constrained')
    left, right = figure.subplots(1, 2, width_ratios=(1.6, 1))
    words = {'guide': "beside the guide's sketch", 'kinder': 'beside the same with\nodometry at 1 Hz'}
    for place, found in enumerate(node_cpu.values()):
        for who, offset, color in (('baseline', -0.2, GREY), ('node', 0.2, BLUE)):
            _bar(left, place + offset, [100 * used / found['round_s'] for used in found['cpu_s'][who]], color, '{:.1f} %')
    left.set_xticks(range(len(node_cpu)), [words[variant] for variant in node_cpu])
    left.set(ylabel='% of a core')
    left.set_title('CPU at the default profile, whole process tree')
    _bar(right, 0.0, intake['callback_us'], GREY, '{:.0f} us')
    _bar(right, 1.0, intake['node_us'], BLUE, '{:.0f} us')
    right.set_xticks([0, 1], ['raw callback', 'this node'])
    right.set(ylabel='us of CPU a message')
    right.set_title(f'Intake, {intake["rate_hz"]:,} Imu a second')
    for axes in (left, right):
        axes.margins(x=0.15, y=0.15)
        axes.grid(visible=False, axis='x')
    left.legend(handles=[Patch(color=GREY, label='plain rclpy node'), Patch(color=BLUE, label='this node')], loc='upper right')
    left.set_ylim(0, 1.2 * left.get_ylim()[1])
    figure.savefig(path)


def _bar(axes: Any, place: float, rounds: Sequence[float], color: str, label: str) -> None:
    """The mean of the rounds, and their span."""
    mean = sum(rounds) / len(rounds)
    span = [[mean - min(rounds)], [max(rounds) - mean]]
    axes.bar(place, mean, color=color, width=0.36, yerr=span, capsize=3, error_kw={'ecolor': INK, 'elinewidth': 1})
    axes.annotate(label.format(mean), (place, max(rounds)), xytext=(0, 4), textcoords='offset points', ha='center',
                  fontweight='bold')  # fmt: skip


def memory(full_rate: Figures, path: Path) -> None:
    """Resident memory by kind, and the spool's backlog, over the three phases."""
    samples = full_rate['samples']
    times = samples['t']
    figure = Figure(figsize=(9, 4.6), dpi=DPI, layout='constrained')
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(2.2, 1))
    begin, end = full_rate['phases']['away']['span']
    for axes in (above, below):
        axes.axvspan(begin, end, color=AMBER, alpha=0.16, lw=0)
    words = {'anon': 'own', 'file': 'files: libraries', 'shmem': "the middleware's shared memory"}
    above.stackplot(times, *(samples[name] for name in words), labels=list(words.values()), colors=[BLUE, '#7fb2d9', '#c9dcea'])
    above.axhline(200.0, color='#b23a3a', lw=1.2, ls='--')
    above.text(times[0], 203.0, ' the bar: 200 MB', color='#b23a3a', ha='left', va='bottom')
    above.text((begin + end) / 2, 0.985, 'S3 server away', transform=above.get_xaxis_transform(), ha='center', va='top',
               color=AMBER, fontweight='bold')  # fmt: skip
    above.set(ylabel='resident, MB', ylim=(0, max(260.0, 1.3 * full_rate['memory']['peak_after_mb'])))
    above.set_title('Memory of the node at full rate')
    above.legend(loc='lower right', ncols=3, frameon=True, framealpha=0.9, edgecolor='none')
    below.fill_between(times, samples['waiting_mb'], color=TEAL, alpha=0.75, lw=0)
    below.set(xlabel='time [s]', ylabel='in the spool, MB', ylim=(0, None), xlim=(times[0], times[-1]))
    figure.savefig(path)


def latency(figures: Figures, path: Path) -> None:
    """Cumulative distribution of the messages' delay."""
    curve = figures['curve']
    figure = Figure(figsize=(9, 3.4), dpi=DPI, layout='constrained')
    axes = figure.add_subplot()
    for name, word, color in (('durable', 'durable on disk', BLUE), ('confirmed', 'confirmed by the S3 server', TEAL)):
        axes.plot(curve[name], curve['percent'], color=color, lw=2, label=word)
        axes.axvline(figures['ms'][name]['p99'], color=color, lw=1, ls=':')
    axes.set(xlabel='ms since the stamp of the message (dotted: p99)', ylabel='% of the messages', xlim=(0, None), ylim=(0, 101))
    axes.set_title(f'Unbatched, {figures["rate_hz"]} a second, beside the default profile')
    axes.legend(loc='lower right')
    figure.savefig(path)
