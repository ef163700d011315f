"""Writes the results of the benchmarks into docs/evidence/benchmarks.md: tables between its markers, and the plots.

``python bench/_page.py`` does so from docs/evidence/benchmarks.json, without measuring. No number of the page is typed by hand.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any, Final

import _pictures
from _report import show, spread

DOCS: Final = Path(__file__).resolve().parents[1] / 'docs' / 'evidence'
_BLOCK: Final = re.compile(r'(<!-- bench (\w+) -->\n).*?(<!-- end \2 -->)', re.DOTALL)
_MACHINE: Final = {
    'when': 'measured', 'processor': 'processor', 'cores': 'cores', 'memory': 'memory', 'kernel': 'kernel', 'python': 'Python',
    'ros': 'ROS 2', 'middleware': 'middleware', 'commit': 'commit', 'load_before': 'load average before',
}  # fmt: skip
_YES, _NO = 'yes', '**no**'
Figures = Mapping[str, Any]


def write(results: Figures, template: Path, output: Path) -> None:
    """The page and its plots."""
    (output / 'benchmarks.md').write_text(filled(template.read_text(encoding='utf-8'), results), encoding='utf-8')
    _pictures.draw({name: found['figures'] for name, found in results['benches'].items()}, output / 'images')


def filled(page: str, results: Figures) -> str:
    """The page with these results; a block whose benchmark was not run is marked as not measured."""
    return _BLOCK.sub(lambda match: f'{match[1]}{_block(match[2], results)}\n{match[3]}', page)


def dump(results: Figures) -> str:
    """JSON with one line per benchmark."""
    benches = ',\n'.join(f'{json.dumps(name)}: {json.dumps(found)}' for name, found in results['benches'].items())
    rest = json.dumps({name: value for name, value in results.items() if name != 'benches'})
    return f'{rest[:-1]}, "benches": {{\n{benches}\n}}}}\n'


def _block(name: str, results: Figures) -> str:
    if name in _WHOLE:
        return _WHOLE[name](results)
    bench, make = _PARTS[name]
    found = results['benches'].get(bench)
    return make(found['figures']) if found else '*not measured*'


def _table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    lines = [head, ['---'] * len(head), *rows]
    return '\n'.join('| ' + ' | '.join(str(cell) for cell in line) + ' |' for line in lines)


def _bars(results: Figures) -> str:
    rows = [
        (bar['what'], bar['bar'], f'{show(bar["value"])} {bar["unit"]}', spread(bar['rounds']), _YES if bar['holds'] else _NO)
        for found in results['benches'].values()
        for bar in found['bars']
    ]
    return _table(('what', 'bar', 'measured', 'spread', 'holds'), rows)


def _machine(results: Figures) -> str:
    return _table(('', ''), [(_MACHINE[name], value) for name, value in results['machine'].items() if name in _MACHINE])


def _commands(results: Figures) -> str:
    """A benchmark that was measured separately, later, has its own commit, and maybe another machine."""
    machine = results['machine']
    rows = []
    for found in results['benches'].values():
        processor = found.get('processor', machine['processor'])
        where = f', on {processor}' if processor != machine['processor'] else ''
        rows.append((f'`{found["command"]}`', f'{found["took_s"]:.0f} s', f'{found.get("commit", machine["commit"])}{where}'))
    total = f'All of it took {results["took_s"] / 60:.1f} minutes.'
    return _table(('command', 'took', 'commit'), rows) + '\n\n' + total


def _node_cpu(figures: Figures) -> str:
    words = {'guide': "the guide's sketch", 'kinder': 'the same, odometry at 1 Hz'}
    rows = []
    for name, found in figures.items():
        seconds = found['round_s'] * len(found['cpu_s']['node'])
        core = {who: 100 * sum(used) / seconds for who, used in found['cpu_s'].items()}
        heard, plain = sum(found['baseline']['received'].values()), found['baseline']
        rows.append((words[name], f'{core["baseline"]:.1f} %', f'{core["node"]:.1f} %', f'**{found["ratio"]:.2f}**',
                     f'{min(found["ratios"]):.2f} to {max(found["ratios"]):.2f}', f'{core["sim"]:.0f} %',
                     f'{heard:,} / {found["node"]["received"]:,}', f'{plain["puts"]:,}, {found["baseline_objects"]:,} left',
                     f'{found["node"]["objects"]["delivered"]:,}'))  # fmt: skip
    head = ('baseline', 'its CPU', 'node', 'ratio', 'spread', 'simulator', 'messages received, baseline / node',
            'objects put by the baseline', 'by the node')  # fmt: skip
    return _table(head, rows)


def _intake(figures: Figures) -> str:
    def row(words: str, values: Sequence[float], lost: object) -> tuple[str, str, str, object]:
        return words, f'{sum(values) / len(values):.0f} us', f'{min(values):.0f} to {max(values):.0f} us', lost

    return _table(('', 'CPU a message', 'spread', 'messages lost'), [
        row('raw callback, SingleThreadedExecutor', figures['callback_us'], figures['callback_lost']),
        row('the node', figures['node_us'], figures['node_lost']),
        row('(the publisher)', figures['publisher_us'], ''),
    ])  # fmt: skip


def _vendors(figures: Figures) -> str:
    words = {'fast': 'Fast DDS', 'cyclone': 'Cyclone DDS', 'robot': "Cyclone DDS, in the robot's own RMW"}
    kinds = sorted(figures['bytes'], key=figures['bytes'].__getitem__)
    rows = []
    for name, us in figures['us'].items():
        used = [(f'{sum(us[kind]) / len(us[kind]):.0f} us', f'{min(us[kind]):.0f} to {max(us[kind]):.0f} us') for kind in kinds]
        rows.append((words[name], *(cell for pair in used for cell in pair), f'{sum(figures["memory"][name].values()):.0f} MB',
                     figures['lost'].get(name, 'not known')))  # fmt: skip
    head = [cell for kind in kinds for cell in (f'CPU a message of {figures["bytes"][kind]:,} bytes', 'spread')]
    return _table(('the node hears', *head, 'resident memory', 'messages lost'), rows)


def _small(figures: Figures) -> str:
    return _table(
        ('asked for', 'reached', 'for', 'lost', 'ledger', 'node', 'publisher', 'cores busy'),
        [(f'{run["asked_hz"]:,}/s', f'{run["reached_hz"]:,.0f}/s', f'{run["seconds"]:.0f} s', run['lost'],
          f'{"balanced" if run["balanced"] else "not balanced"}, {run["accounting"]}', f'{run["node_us"]:.0f} us a message',
          f'{run["publisher_us"]:.0f} us a message', f'{run["cores_busy"]:.1f}') for run in figures['runs']],
    )  # fmt: skip


def _full_rate(figures: Figures) -> str:
    topics = [(f'`{name}`', row['published'], row['received'], row['stored'], row['missed'], row['dropped'], row['accounting'])
              for name, row in figures['topics'].items() if row['published']]  # fmt: skip
    words = {'there': 'store there', 'away': 'store away', 'back': 'store back, backlog leaving'}
    phases = [(words[name], f'{phase["span"][1] - phase["span"][0]:.0f} s', f'{100 * phase["cores"]["node"]:.1f} %',
               f'{100 * phase["cores"]["sim"]:.0f} %', f'{phase["cores_busy"]:.2f}')
              for name, phase in figures['phases'].items()]  # fmt: skip
    volume = f'{figures["bytes"]["spooled"] / 1e9:.2f} GB went through the spool.'
    return '\n\n'.join((
        _table(('topic', 'published', 'received', 'stored', 'missed', 'dropped', 'accounting'), topics),
        _table(('phase', 'length', 'node, of a core', 'simulator', 'cores busy, all processes'), phases), volume,
    ))  # fmt: skip


def _memory(figures: Figures) -> str:
    if 'memory' not in figures:
        return '*not measured*'
    found, samples = figures['memory'], figures['samples']
    last = {name: samples[name][-1] for name in ('anon', 'file', 'shmem')}
    return _table(('resident memory, MB', ''), [
        ('store away: median', show(found['median_mb'])), ('store away: greatest', show(found['peak_mb'])),
        ('store away: rise of a line through its last four fifths', f'{found["rise_mb_per_min"]:.2f} a minute'),
        ('store back: greatest', show(found['peak_after_mb'])),
        ('at the end: own / files (libraries) / shared memory (the middleware)', ' / '.join(map(show, last.values()))),
    ])  # fmt: skip


def _backlog_memory(figures: Figures) -> str:
    words = {'there': 'store there', 'away': 'store away', 'back': 'store back, backlog leaving'}
    rows = [(words[name], f'{figures["greatest_mb"][name]:.0f} MB', f'{100 * figures["cores"][name]:.0f} %') for name in words]
    backlog = f'{figures["backlog_objects"]:,} objects of {figures["backlog_mb"]:.0f} MB waited as the store came back.'
    level = f'The level, the median with the store there, is {figures["level_mb"]:.0f} MB. {backlog}'
    return _table(('phase', 'resident memory, greatest', 'node, of a core'), rows) + '\n\n' + level


def _rosbag2(figures: Figures) -> str:
    version = f'rosbag2 {figures.get("version", "")}'.strip()
    words = {'rosbag2': version, 'bag': 'the node, into a bag', 'objects': 'the node, as objects'}

    def us(found: Figures) -> str:
        values = found['us']
        return f'{sum(values) / len(values):.0f} us ({min(values):.0f} to {max(values):.0f})'

    def lost(found: Figures) -> str:
        share = 100 * sum(found['lost']) / sum(found['published'])
        return f'{show(share)} %' if share else '0'

    rows = [(f'{int(rate):,}/s', words[who], us(found), lost(found), f'{median(found["bytes"]):.0f}' if 'bytes' in found else '')
            for rate, recorders in figures['rates'].items() for who, found in recorders.items()]  # fmt: skip
    parts = [_table(('messages', 'recorder', 'CPU per recorded message', 'lost', 'bytes per message'), rows)]
    if 'job' in figures:
        words = {'rosbag2': f'{version} and rclone', 'bag': 'the node'}
        jobs = [(words[who], us(found), f'{median(found["copy_us"]):.0f} us' if who == 'rosbag2' else '', lost(found),
                 f'{median(found["bytes"]) / 1000:,.0f} KB', f'{median(found["late_p50_s"]):.1f} s',
                 f'{max(found["late_max_s"]):.1f} s') for who, found in figures['job'].items()]  # fmt: skip
        head = (f'recording and delivering, {figures["job_hz"]:,}/s, files of {figures["split_s"]} s', 'CPU per stored message',
                'of it rclone', 'lost', 'on the disk at the end', 'from publication to the store, median', 'maximum')  # fmt: skip
        parts.append(_table(head, jobs))
    return '\n\n'.join(parts)


def _latency(figures: Figures) -> str:
    words = {'durable': 'durable: the group commit returned', 'confirmed': 'confirmed: the put returned',
             'created_ns': 'index: `created_ns`', 'settled_ns': 'index: `settled_ns`'}  # fmt: skip
    names = ('p50', 'p90', 'p99', 'max')
    report = [(words[name], row) for name, row in figures['ms'].items()]
    if leaving := figures.get('leaving'):
        waiting = ', then '.join(f'{count:,}' for count in leaving['waiting'])
        report.append((f'durable while a backlog leaves ({waiting} objects)', leaving['ms']))
    return _table(('from the stamp until', *names), [(what, *(f'{row[each]:.0f} ms' for each in names)) for what, row in report])


def _encode(figures: Figures) -> str:
    times = [(row['name'], f'{row["decode_us"]:.1f} us', f'{row["encode_us"]:.1f} us') for row in figures['rows']]
    sizes = [(f'{row["bytes_in"]:,}', f'{row["bytes_out"]:,}') for row in figures['rows']]
    rows = [(*time, *size) for time, size in zip(times, sizes, strict=True)]
    return _table(('format and message', 'decode', 'all', 'bytes in', 'bytes out'), rows)


def _spool(figures: Figures) -> str:
    def words(row: Figures) -> str:
        return ', '.join(f'{what.replace("_", " ")} {show(value)}' for what, value in row.items())

    return _table(('', 'figures'), [(name, words(row)) for name, row in figures.items()])


def _drain(figures: Figures) -> str:
    return _table(('backlog', 'drain', 'boto3', 'speed, drain : boto3', 'spread', 'CPU an object, drain / boto3'), [
        (f'{row["objects"]} x {row["bytes"] / 1000:g} KB', f'{row["drain_per_s"]:.0f}/s', f'{row["bare_per_s"]:.0f}/s',
         f'{row["speed_ratio"]:.2f}', spread(row['speed_ratios']), f'{row["drain_cpu_ms"]:.2f} / {row["bare_cpu_ms"]:.2f} ms')
        for row in figures['drain']
    ])  # fmt: skip


def _mission_calls(figures: Figures) -> str:
    words = {'up': 'Tower there', 'away': 'Tower away', 'hung': 'Tower hangs'}
    calls = ('log_robot_state', 'log_camera_frame', 'start_mission', 'end_mission')
    rows = [(words[name], *(_ms(figures[name][call]) for call in calls)) for name in words if name in figures]
    plain = f"MLflow's own `log_metric`, Tower there: {_ms(figures['mlflow_log_metric'])}."
    return '\n\n'.join([_table(('', *(f'`{call}`' for call in calls)), rows), *_starts(figures), plain])


def _starts(figures: Figures) -> Iterator[str]:
    """``start_mission`` right after the constructor, next to a bare request for a run."""
    words = {'start_idle': 'nothing else running', 'start_busy': 'ten busy processes'}
    head = ('`start_mission` 10 ms after the constructor', 'median', 'maximum', 'bare `runs/create`, median', 'ratio')
    rows = [(words[name], f'{median(figures[name]["start_mission_ms"]):.0f} ms',
             f'{max(figures[name]["start_mission_ms"]):.0f} ms', f'{median(figures[name]["bare_ms"]):.0f} ms',
             f'{figures[name]["ratio"]:.1f}') for name in words if name in figures]  # fmt: skip
    if rows:
        yield _table(head, rows)


def _ms(found: Figures) -> str:
    """Median and p99; a single call has only the former."""
    single = found.get('calls') == 1
    return f'{found["median_ms"]:.2f} ms' if single else f'{found["median_ms"]:.2f} ms, p99 {found["p99_ms"]:.2f} ms'


def _missions(figures: Figures) -> str:
    ours, theirs = figures['replayed_per_s'], figures['log_batch_per_s']
    return _table((f'{figures["points"]:,} points to one run', 'points a second'), [
        ('the replay of a journal', f'{ours:,.0f}'), ('`log_batch` of 1,000, nothing else', f'{theirs:,.0f}'),
    ])  # fmt: skip


def _keep(figures: Figures) -> str:
    words = {'_previews': 'previews', '_kept': 'rows of what is kept'}
    rows = [(words[name], f'{late["count"]:,}', *(f'{late[each]:.1f} s' for each in ('p50', 'p95', 'max')))
            for name, late in figures['late_s'].items()]  # fmt: skip
    cores, kept, memory = figures['cores'], figures['bytes']['kept'], figures['memory_mb']
    reported = (
        f'The node that keeps all: {100 * cores["kept"]:.1f} % of a core; the one beside it: {100 * cores["1 Hz"]:.1f} %.'
        f' In {figures["seconds"]:.0f} s {kept["kept"] / 1e6:,.0f} MB were kept and {kept["delivered"] / 1e6:.1f} MB delivered;'
        f' {figures["missed"]:,} messages were missed. The first second of the video was in the store'
        f' {figures["begin_s"]:.1f} s after it was asked for.'
    )
    parts = [
        *((f'{words[name]}, p95', *(f'{late:.1f} s' for late in each)) for name, each in figures['late_p95_s'].items()),
        *((f'memory of its own, the node that {does}', *(f'{each:.1f} MB' for each in memory[name]))
          for name, does in (('kept', 'keeps all'), ('1 Hz', 'uploads 1 Hz'))),
    ]  # fmt: skip
    before, after = figures['load']
    load = f'The load average was {before:.1f} at the beginning and {after:.1f} at the end.'
    return '\n\n'.join((
        _table(('oldest message to the store', 'objects', 'p50', 'p95', 'worst'), rows), reported,
        _table(('before the video is asked for', 'first third', 'second', 'last'), parts), load,
    ))  # fmt: skip


def _ask(figures: Figures) -> str:
    def took(row: Figures) -> tuple[str, str, str]:
        command = f'{median(row["command_s"]):.2f} s' if 'command_s' in row else ''
        return f'{1000 * median(row["s"]):.0f} ms', spread([1000 * each for each in row['s']]), command

    head = ('took', 'spread, ms', 'as a command')
    values = [(f'`{row["question"].replace("|", "")}`', *took(row), f'{row["times"]:,}',
               f'{row["opened"]:,} of {row["objects"]:,} ({show(100 * row["opened"] / row["objects"])} %)')
              for row in figures['values']]  # fmt: skip
    words = [(f'`{row["question"]}`', *took(row), f'{row["found"]:,}') for row in figures['words']]
    sizes = f'{figures["catalog_bytes"] / 1e6:.0f} MB of catalog, {figures["statistics_bytes"] / 1e6:.0f} MB of statistics'
    return '\n\n'.join((
        _table((f'by value, {figures["objects"]:,} objects', *head, 'times', 'objects opened'), values),
        _table((f'by words, {figures["missions"]:,} missions', *head, 'documents, at most 20'), words), f'{sizes}.',
    ))  # fmt: skip


def _datasets(figures: Figures) -> str:
    words = {'ours': '`export lerobot`', 'lerobot': 'lerobot, by default', 'lerobot, streaming': 'lerobot, `streaming_encoding`'}
    rows = []
    for name, runs in figures['runs'].items():
        speed, cpu_s, memory = ([run[key] for run in runs] for key in ('frames_per_s', 'cpu_s', 'memory_mb'))
        cpu_ms = 1000 * median(cpu_s) / figures['frames']
        rows.append((words[name], f'{median(speed):.0f}', f'{min(speed):.0f} to {max(speed):.0f}', f'{cpu_ms:.0f} ms',
                     f'{median(memory):.0f} MB'))  # fmt: skip
    head = f'{figures["frames"]} frames of {figures["frame_bytes"] / 1000:.0f} KB'
    return _table((head, 'frames a second', 'spread', 'CPU a frame', 'memory'), rows)


_WHOLE: Final[Mapping[str, Callable[[Figures], str]]] = {'bars': _bars, 'machine': _machine, 'commands': _commands}
_PARTS: Final[Mapping[str, tuple[str, Callable[[Figures], str]]]] = {
    'node_cpu': ('node_cpu', _node_cpu), 'intake': ('intake', _intake), 'vendors': ('vendors', _vendors),
    'small_messages': ('small_messages', _small), 'full_rate': ('full_rate', _full_rate), 'memory': ('full_rate', _memory),
    'backlog_memory': ('backlog_memory', _backlog_memory), 'rosbag2': ('rosbag2', _rosbag2),
    'latency': ('latency', _latency), 'encode_formats': ('encode_formats', _encode), 'spool_commits': ('spool_commits', _spool),
    'keep': ('keep', _keep),
    'drain': ('drain', _drain), 'mission_calls': ('mission_calls', _mission_calls), 'missions': ('missions', _missions),
    'datasets': ('datasets', _datasets), 'ask': ('ask', _ask),
}  # fmt: skip

if __name__ == '__main__':
    write(json.loads((DOCS / 'benchmarks.json').read_text(encoding='utf-8')), DOCS / 'benchmarks.md', DOCS)
