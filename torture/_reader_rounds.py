"""Rounds over every reader of data that robots write: each makes an input from a seed, and reads it as Spark and Tower do.

A reader may answer, or raise an error of this package; it may write only into the folder that it was given. Used by
``python -m torture.fuzz --readers``.
"""

from __future__ import annotations

import io
import json
import os
import random
import shutil
import struct
import sys
import tarfile
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import lz4.frame
import numpy as np
from bags.real_bags import NAME, put_item, write_ours, write_rosbags
from lake import bad_parts
from lake.making import NOON_NS, row
from mcap.opcode import Opcode
from PIL import Image
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from stores.memory import MemoryStore

from shadowhound_data_logger.bags.cut import Choice, cut_folder
from shadowhound_data_logger.bags.description import describe_metadata
from shadowhound_data_logger.bags.fetch import fetch as fetch_bag
from shadowhound_data_logger.bags.info import info_folder
from shadowhound_data_logger.bags.manifest import Manifest
from shadowhound_data_logger.bags.overview import bag_overview
from shadowhound_data_logger.bags.remote import RemoteBag, RemoteFile
from shadowhound_data_logger.bags.verify import verify_folder
from shadowhound_data_logger.cli.output import shown_time
from shadowhound_data_logger.core.errors import DataLoggerError
from shadowhound_data_logger.core.options import StoreSettings
from shadowhound_data_logger.core.untrusted import csv_cell, visible
from shadowhound_data_logger.formats.mcap.format import CHUNK, RECORD, record, text
from shadowhound_data_logger.formats.mcap.index import records
from shadowhound_data_logger.formats.mcap.messages import unpack
from shadowhound_data_logger.formats.rows import catalog, parts
from shadowhound_data_logger.lake import decode
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.decode import table
from shadowhound_data_logger.lake.fetch import FetchRequest
from shadowhound_data_logger.lake.fetch import fetch as fetch_objects
from shadowhound_data_logger.lake.samples import Near, Samples, Selection, Window
from shadowhound_data_logger.lake.summaries import uploaded
from shadowhound_data_logger.lake.tables import narrow
from shadowhound_data_logger.lake.track import NEEDED, Track
from shadowhound_data_logger.stores.directory import DirectoryStore

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

Round = Callable[[random.Random], str]
"""One input, read; what came of it in a word."""
NUMBERS: Final = (
    0,
    1,
    -1,
    2,
    255,
    65_535,
    1 << 31,
    (1 << 31) - 1,
    1 << 32,
    (1 << 63) - 1,
    1 << 63,
    -(1 << 63),
    (1 << 64) - 1,
    10**30,
)
TEXTS: Final = (
    '', '.', '..', '../x', '/etc/passwd', 'a/../../x', 'a\0b', '\x1b]52;c;eA==\x07', '\u202e', '=1+1', '\ud800',
    'a' * 300, 'a\nb', '1' * 5000,
    'thor', 'tachi/x', '-1', '1e999', '{a: &a [*a]}',
)  # fmt: skip
FOLDER: Final = 'target'
"""The folder that a reader may write to; nothing else may change."""
WRITING: Final = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND


# -- damage --------------------------------------------------------------------------------------------------------------------


def damaged(body: bytes, rng: random.Random) -> bytes:
    """Bytes changed, cut, put in and put elsewhere; numbers that lie."""
    found = bytearray(body)
    for _ in range(rng.choice((1, 1, 1, 2, 5, 20))):
        place = rng.randrange(len(found) + 1)
        kind = rng.randrange(7)
        if kind == 0 and found:
            found[place % len(found)] ^= 1 << rng.randrange(8)
        elif kind == 1:
            found[place : place + 1] = rng.randbytes(1)
        elif kind == 2:
            wide = rng.choice((2, 4, 8))
            found[place : place + wide] = (rng.choice(NUMBERS) % (1 << 8 * wide)).to_bytes(wide, rng.choice(('little', 'big')))
        elif kind == 3:
            del found[place : place + rng.choice((1, 4, 100))]
        elif kind == 4:
            found[place:place] = rng.randbytes(rng.choice((1, 4, 60)))
        elif kind == 5:
            found[place:place] = found[(at := rng.randrange(len(found) + 1)) : at + rng.randrange(200)]
        elif rng.random() < 0.3:
            del found[place:]
    return bytes(found)


def value(rng: random.Random, depth: int = 0) -> Any:
    """Anything that JSON can hold."""
    kind = rng.randrange(8 if depth < 3 else 6)
    if kind == 6:
        return [value(rng, depth + 1) for _ in range(rng.randrange(4))]
    if kind == 7:
        return {rng.choice(TEXTS): value(rng, depth + 1) for _ in range(rng.randrange(4))}
    return (rng.choice(NUMBERS), rng.choice(TEXTS), None, rng.random() < 0.5, float(rng.choice(NUMBERS)), float('nan'))[kind]


def twisted(document: Any, rng: random.Random) -> Any:
    """With some values, or names, that are others."""
    made = json.loads(json.dumps(document))
    for _ in range(rng.choice((1, 1, 2, 4))):
        inside: Any = made
        while isinstance(inside, (dict, list)) and inside:
            name = rng.choice(list(inside)) if isinstance(inside, dict) else rng.randrange(len(inside))
            if not isinstance(inside[name], (dict, list)) or rng.random() < 0.3:
                if rng.random() < 0.15:
                    del inside[name]
                else:
                    inside[name] = value(rng)
                break
            inside = inside[name]
    return made


def as_json(document: Any, rng: random.Random) -> bytes:
    body = json.dumps(twisted(document, rng)).encode()
    if rng.random() < 0.03:
        body = rng.choice((b'[', b'{"a":', b'[{}, ')) * rng.choice((900, 100_000))
    return damaged(body, rng) if rng.random() < 0.3 else body


def as_yaml(document: Any, rng: random.Random) -> bytes:
    """JSON is YAML; some of what only YAML has is in it."""
    text_ = json.dumps(twisted(document, rng), ensure_ascii=rng.random() < 0.5)
    if rng.random() < 0.3:
        text_ = text_.replace(
            '""',
            rng.choice(('&a [*a, *a]', '!!python/object/apply:os.system [x]', '*b', '2001-13-99', '? {', '- - -', '!!binary x')),
        )
    body = text_.encode(errors='replace')
    return damaged(body, rng) if rng.random() < 0.4 else body


# -- what is written where -----------------------------------------------------------------------------------------------------

_allowed: list[Path] = []
_wrong: list[str] = []


def _watch(event: str, arguments: tuple[Any, ...]) -> None:
    if not _allowed:
        return
    paths: tuple[tuple[Any, Any], ...] = ()
    if event == 'open' and isinstance(arguments[2], int) and arguments[2] & WRITING:
        paths = ((arguments[0], -1),)
    elif event in {'os.mkdir', 'os.remove', 'os.rmdir'}:
        paths = ((arguments[0], arguments[-1]),)
    elif event in {'os.truncate', 'os.chmod'}:
        paths = ((arguments[0], -1),)
    elif event in {'os.rename', 'os.link'}:
        paths = ((arguments[0], arguments[2]), (arguments[1], arguments[3]))
    elif event == 'os.symlink':
        paths = ((arguments[1], arguments[2]),)
    for path, folder in paths:
        if isinstance(path, (str, bytes, os.PathLike)):
            named = os.fsdecode(path) if folder in {-1, None} else f'/proc/self/fd/{folder}/{os.fsdecode(path)}'
            real = Path(os.path.realpath(named))
            if str(real) != os.devnull and not any(real.is_relative_to(each) for each in _allowed):
                _wrong.append(f'{event} {real}')


def watch_writes() -> None:
    """From here on, permanently: a process has its hooks until it ends."""
    sys.addaudithook(_watch)


@contextmanager
def writing_below(*folders: Path) -> Iterator[None]:
    """Raises AssertionError for anything that is written elsewhere during that time (after ``watch_writes``)."""
    _allowed[:] = [folder.resolve() for folder in folders]
    try:
        yield
    finally:
        _allowed.clear()
        wrong, _wrong[:] = [*_wrong], []
    assert not wrong, f'written outside: {wrong[:3]}'


class Shop:
    """Where one kind works: ``target`` may be written by readers, ``input`` has what they read."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.input = folder / 'input'
        self.target = folder / FOLDER
        self.temporary = folder / 'tmp'
        for each in (self.input, self.target, self.temporary):
            each.mkdir(parents=True, exist_ok=True)

    def clear(self) -> None:
        for each in (self.target, self.input):
            shutil.rmtree(each)
            each.mkdir()

    def reading(self) -> Any:
        return writing_below(self.target, self.temporary)


def said(ask: Callable[[], object]) -> str:
    """What became of it: an answer, or the name of our error."""
    try:
        ask()
    except DataLoggerError as error:
        visible(str(error))
        return type(error).__name__
    return 'answered'


# -- the catalog ---------------------------------------------------------------------------------------------------------------


def row_files_(shop: Shop) -> Round:
    """Row files as robots write them, damaged."""
    rows = [row(sensor, NOON_NS + number * 10**9) for number in range(20) for sensor in ('camera', 'odom')]
    bases = [parts.encode(rows), bad_parts.lines(rows), parts.encode(rows[:1]), bad_parts.lines(rows, key='tachi/a')]

    def one(rng: random.Random) -> str:
        base = rng.choice(bases)
        body = bad_parts.mutated(base, rng) if rng.random() < 0.8 else damaged(base, rng)
        if rng.random() < 0.4:
            body = bad_parts.lines([_row(each, rng) for each in rows[:5]])
        with shop.reading():
            found = parts.read_rows(body, 'thor')
        for each in found.rows.get('_catalog', []):
            assert each['key'].startswith('thor/')
            assert all(visible(str(csv_cell(cell))) for cell in each.values() if cell not in {None, ''})
        assert found.findings.isprintable()
        return 'left out' if found.findings else 'answered'

    return one


def _row(given: catalog.Row, rng: random.Random) -> catalog.Row:
    made = dict(given)
    for name in rng.sample(list(catalog.COLUMNS), 3):
        kind = catalog.COLUMNS[name]
        made[name] = (
            rng.choice(TEXTS).replace('\ud800', '?') if kind == 'string' else rng.choice((0, -1, 5, (1 << 63) - 1, -(1 << 63)))
        )
        if kind == 'int32':
            made[name] = rng.choice((0, -1, (1 << 31) - 1))
        if kind == 'double':
            made[name] = rng.choice((float('inf'), -1e308, 0.5))
    return made


def summaries(shop: Shop) -> Round:
    """How missions ended."""
    fine = {'mission_id': 'm', 'success': True, 'result': 'FINISHED', 'distance_m': 12.5, 'mission_type': 'patrol',
            'mission_command': 'go', 'duration_s': 600, 'start': '2026', 'end': '2026', 'battery_consumed_pct': 3.5}  # fmt: skip

    def one(rng: random.Random) -> str:
        shop.clear()
        root = shop.input / catalog.BUCKET / 'thor' / 'missions' / 'run'
        root.mkdir(parents=True)
        (root / 'summary.json').write_bytes(as_json(fine, rng))
        source = Bucket(StoreSettings(directory=shop.input), catalog.BUCKET)
        run = rng.choice(('run', 'run', 'run', *TEXTS))
        with shop.reading():
            found = uploaded(source, [(rng.choice(('thor', 'thor', *TEXTS)), run)])
        found.validate(full=True)
        return 'answered' if len(found) else 'nothing'

    return one


def fetched_objects(shop: Shop) -> Round:
    """Keys, sizes and checksums of rows, into a folder."""
    bodies = {'thor/camera/a.jpg': b'content', 'thor/camera/b.jpg': bytes(3000)}

    def one(rng: random.Random) -> str:
        shop.clear()
        for key, body in bodies.items():
            path = shop.input / catalog.BUCKET / key
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(body)
        settings = StoreSettings(directory=shop.input)
        requests = [
            FetchRequest(rng.choice((catalog.BUCKET, catalog.BUCKET, catalog.BUCKET, '..', '.')),
                 rng.choice((*bodies, *TEXTS, '../' * 5 + 'x')),
                 rng.choice((7, 3000, *NUMBERS)), rng.choice((None, 'ab', 64 * '0')))
            for _ in range(4)
        ] + [FetchRequest(catalog.BUCKET, key, len(body)) for key, body in bodies.items() if rng.random() < 0.5]  # fmt: skip
        with shop.reading():
            found = fetch_objects(requests, shop.target, DirectoryStore(settings.directory), threads=2)
        return f'{found.moved} moved'

    return one


# -- contents ------------------------------------------------------------------------------------------------------------------


def images(shop: Shop) -> Round:
    """JPEG, PNG and TIFF."""
    colours = np.random.default_rng(1).integers(0, 255, (60, 80, 3), np.uint8)
    depth = np.arange(4800, dtype=np.uint16).reshape(60, 80)
    metres = np.linspace(0, 5, 4800, dtype=np.float32).reshape(60, 80)
    bases = []
    for pixels, kind, how in (
        (colours, 'JPEG', {}), (colours, 'JPEG', {'progressive': True}), (colours, 'PNG', {}), (depth, 'PNG', {}),
        (metres, 'TIFF', {}), (colours, 'TIFF', {'compression': 'tiff_lzw'}),
        (colours, 'TIFF', {'compression': 'tiff_adobe_deflate'}),
        (colours, 'GIF', {}), (colours, 'BMP', {}), (colours, 'PPM', {}),
    ):  # fmt: skip
        file = io.BytesIO()
        Image.fromarray(pixels).save(file, kind, **how)
        bases.append(file.getvalue())

    def one(rng: random.Random) -> str:
        body = rng.choice(bases)
        low = body[: rng.choice((40, 200, 20_000))]
        body = damaged(low, rng) + body[len(low) :]
        with shop.reading():
            return said(lambda: decode.image(body, rng.choice((None, (30, 40)))))

    return one


HEADER: Final = (
    '# .PCD\nVERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n'
    'WIDTH 20\nHEIGHT 1\nPOINTS 20\nDATA binary\n'
)


def clouds(shop: Shop) -> Round:
    """PCD: what the header claims, and the points behind it."""

    def one(rng: random.Random) -> str:
        lines = HEADER.splitlines()
        for _ in range(rng.choice((0, 1, 1, 2))):
            place = rng.randrange(len(lines))
            words = lines[place].split()
            words[rng.randrange(len(words))] = rng.choice((*map(str, NUMBERS), *TEXTS, 'U', 'I', 'O', 'V', 'S', '8', '3'))
            lines[place] = ' '.join(words)
        body = '\n'.join(lines).encode(errors='replace') + b'\n' + rng.randbytes(rng.choice((0, 320, 400)))
        body = damaged(body, rng) if rng.random() < 0.3 else body
        with shop.reading():
            return said(lambda: decode.cloud(body))

    return one


SAMPLE: Final = {'stamp_ns': NOON_NS, 'angular_velocity': {'x': 1.0, 'y': 2, 'z': 3}, 'header': {'frame_id': 'imu'},
                 'linear_acceleration': {'x': 1.0, 'y': 2, 'z': 3}, 'orientation': {'w': 1, 'x': 0, 'y': 0, 'z': 0},
                 'list': [1, 2, 3]}  # fmt: skip
BATCH: Final = {'robot': 'thor', 'sensor': 'imu', 'topic': '/imu', 'type': 'sensor_msgs/msg/Imu', 'count': 2, 't_start_ns': 1,
                't_end_ns': 2, 'samples': [SAMPLE, {**SAMPLE, 'stamp_ns': NOON_NS + 1}]}  # fmt: skip


def records_(shop: Shop) -> Round:
    """Batches of JSON as tables of numbers."""

    def one(rng: random.Random) -> str:
        body = as_json(BATCH, rng)
        kind = rng.choice(('sensor_msgs/msg/Imu', 'a/msg/B', 'nav_msgs/msg/Odometry', 'sensor_msgs/msg/JointState', *TEXTS))
        fields = rng.choice(((), (), ('list',), ('angular_velocity.x', 'list'), ('header.frame_id',), TEXTS[:4]))
        with shop.reading():
            return said(lambda: table(decode.records(body), kind, fields, rng.choice((0, *NUMBERS[:8]))))

    return one


def archives(shop: Shop) -> Round:
    """Shards: tar and zip with images and their descriptions."""

    def make(kind: str, rng: random.Random) -> bytes:
        file = io.BytesIO()
        files = [(f'{NOON_NS}.jpg', b'\xff\xd8picture'),
                 (f'{NOON_NS}.json', as_json({'stamp_ns': NOON_NS, 'frame_id': 'a'}, rng)),
                 (f'{NOON_NS + 1}.json', as_json({'stamp_ns': NOON_NS + 1, 'repeat_of': f'{NOON_NS}.jpg'}, rng))]  # fmt: skip
        if kind == 'zip':
            how = rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA))
            with zipfile.ZipFile(file, 'w', how) as packed:
                for name, body in files:
                    packed.writestr(rng.choice((name, name, name, rng.choice(TEXTS).replace('\ud800', '?') or 'x')), body)
            return file.getvalue()
        with tarfile.open(
            fileobj=file, mode='w', format=rng.choice((tarfile.USTAR_FORMAT, tarfile.PAX_FORMAT, tarfile.GNU_FORMAT))
        ) as made:
            for name, body in files:
                entry = tarfile.TarInfo(name)
                entry.size = len(body)
                if rng.random() < 0.2:
                    entry.type, entry.linkname = (
                        rng.choice((tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.GNUTYPE_SPARSE, tarfile.CHRTYPE)),
                        name,
                    )
                if rng.random() < 0.1:
                    entry.pax_headers = {'GNU.sparse.major': '1', 'GNU.sparse.realsize': '99999999999', 'GNU.sparse.name': name}
                made.addfile(entry, io.BytesIO(body))
        return file.getvalue()

    def one(rng: random.Random) -> str:
        kind = rng.choice(('tar', 'zip'))
        body = make(kind, rng)
        body = damaged(body, rng) if rng.random() < 0.6 else body
        with shop.reading():
            return said(lambda: decode.members(body, kind))

    return one


def samples(shop: Shop) -> Round:
    """Samples of a data set whose rows and contents do not fit each other."""
    file = io.BytesIO()
    Image.new('RGB', (8, 6)).save(file, 'JPEG')

    def one(rng: random.Random) -> str:
        contents = [as_json(BATCH, rng) if rng.random() < 0.5 else json.dumps(BATCH).encode() for _ in range(3)]

        class Prefetch:
            def get(self, wanted: Any) -> bytes:
                return file.getvalue() if wanted.key.endswith('jpg') else contents[int(wanted.key[-6]) % 3]

        def track(sensor: str, kind: str, extension: str, number: int) -> Track:
            import pyarrow as pa  # noqa: PLC0415 - only this kind needs it

            wide = lambda: rng.choice((0, 1, 10**9, -1, *NUMBERS[8:10], -(1 << 63))) if rng.random() < 0.2 else 0  # noqa: E731 - twice below
            return Track.of(pa.Table.from_pylist([{
                'robot': 'thor', 'sensor': sensor, 'type': kind, 'bucket': 'b', 'key': f'k{each}.{extension}',
                'bytes': 10, 'sha256': None,
                't_start': None, 't_start_ns': max(-(1 << 63), min((1 << 63) - 1, NOON_NS + each + wide())),
                't_end_ns': max(-(1 << 63), min((1 << 63) - 1, NOON_NS + each + wide())),
                'count': rng.choice((None, 1, 2, -5, 20_000)),
                'x': 0.5, 'y': rng.choice((None, float('inf'), 1.0)), 'yaw': 1e308, 'battery_pct': None,
                'clock_offset_ns': rng.choice((None, None, 5, (1 << 63) - 1)),
            } for each in range(number)], schema=narrow(NEEDED)))  # fmt: skip

        frames, imu = track('camera', 'sensor_msgs/msg/CompressedImage', 'jpg', 3), track('imu', 'sensor_msgs/msg/Imu', 'json', 3)
        aligned = {'imu': rng.choice((Near(0.5), Window(0.5, 4), Near(0.5, ('list',)), Window(1e9, 2)))}
        made = Samples(Selection((frames,), aligned, {('thor', 'imu'): imu}, None), Prefetch())  # type: ignore[arg-type]
        with np.errstate(all='ignore'), shop.reading():
            return said(lambda: [made.sample(frames, number) for number in range(3)])

    return one


# -- bags ----------------------------------------------------------------------------------------------------------------------


def _repacked(body: bytes, compression: str) -> bytes:
    """A slice with its chunks in another compression; its index goes."""
    out = bytearray(body[:8])
    for kind, _, content in records(memoryview(body)[8:-8], 'x'):
        if kind == Opcode.CHUNK:
            start, end, size, crc = CHUNK.unpack_from(content)
            plain = bytes(unpack(content, 'x'))
            packed = {'zstd': zstd.compress, 'lz4': lz4.frame.compress, '': bytes}[compression](plain)
            out += record(
                Opcode.CHUNK, CHUNK.pack(start, end, size, crc), text(compression), struct.pack('<Q', len(packed)), packed
            )
        elif kind == Opcode.DATA_END:
            out += record(Opcode.DATA_END, bytes(4))
            break
        elif kind != Opcode.MESSAGE_INDEX:
            out += record(kind, bytes(content))
    return bytes(out + record(Opcode.FOOTER, struct.pack('<QQI', 0, 0, 0)) + body[:8])


def slices(shop: Shop) -> Round:
    """MCAP with chunks in zstd, in lz4 and uncompressed, with and without an index: described, verified, and cut."""
    write_ours(shop.folder / 'base' / NAME, slices=1, each=60, is_ended=False)
    body = next((shop.folder / 'base' / NAME).glob('*.mcap')).read_bytes()
    bases = [body, *(_repacked(body, compression) for compression in ('zstd', 'lz4', ''))]

    def one(rng: random.Random) -> str:
        shop.clear()
        base = rng.choice(bases)
        hurt = damaged(base, rng)
        if rng.random() < 0.5:  # only its summary, or the heads of its records
            place = len(base) - min(len(base), rng.choice((40, 2000)))
            hurt = base[:place] + damaged(base[place:-8], rng) + base[-8:]
        if rng.random() < 0.3:
            places = [place + 8 for _, place, _ in records(memoryview(base)[8:-8], 'x')]
            place = rng.choice(places)
            hurt = base[:place] + RECORD.pack(base[place], rng.choice(NUMBERS) % (1 << 64)) + base[place + RECORD.size :]
        folder = shop.input / NAME
        folder.mkdir()
        (folder / f'{NAME}_0.mcap').write_bytes(hurt)
        topics = rng.choice(((), ('/imu',)))
        with shop.reading():
            found = [said(lambda: info_folder(folder)), said(lambda: verify_folder(folder, deep=True)),
                     said(lambda: cut_folder(folder, shop.target / 'out', Choice(topics=topics)))]  # fmt: skip
        return ', '.join(found)

    return one


METADATA: Final = {'rosbag2_bagfile_information': {
    'version': 8, 'storage_identifier': 'mcap', 'duration': {'nanoseconds': 5},
    'starting_time': {'nanoseconds_since_epoch': NOON_NS}, 'message_count': 2, 'topics_with_message_count': [{'topic_metadata': {
        'name': '/imu', 'type': 'a/msg/B', 'serialization_format': 'cdr', 'offered_qos_profiles': '- history: 1\n  depth: 2\n',
        'type_description_hash': ''}, 'message_count': 2}], 'compression_format': '', 'compression_mode': '',
    'relative_file_paths': ['a_0.mcap'], 'files': [{'path': 'a_0.mcap', 'starting_time': {'nanoseconds_since_epoch': NOON_NS},
                                                    'duration': {'nanoseconds': 5}, 'message_count': 2}],
    'custom_data': {}, 'ros_distro': 'humble'}}  # fmt: skip
MANIFEST: Final = {
    'version': 1, 'bag': 'a', 'robot': 'thor', 'state': 'gaps', 'mission': {'type': 'patrol', 'mission_id': 'm', 'run_id': None},
    'event': {'name': 'x', 'pre_s': 30.0, 'held_s': 30.0, 'post_s': 10,
              'triggers': [{'name': 'x', 'by': 'y', 'at_ns': 1, 'detail': 'z'}]},
    'clock': {'known': 'set_later', 'boot_id': 'b', 'boot_ns': 1, 'wall_ns': 2, 'offset_ns': 3},
    'missing': [{'file': 'a_1.mcap', 'what': 'x', 'messages': 3, 'topic': '/a', 'reason': 'y'}],
    'topics': [{'topic': '/imu', 'type': 'a/msg/B', 'messages': 1}],
    'slices': [{'file': 'a_0.mcap', 'key': 'thor/rosbags/a/a_0.mcap', 'bytes': 7, 'sha256': 64 * '0', 'messages': 1,
                't_start_ns': 1, 't_end_ns': 2, 'counts': {'/imu': 1}, 'repeated': {}}],
}  # fmt: skip


def metadata(shop: Shop) -> Round:
    """metadata.yaml, alone and in a bag of a store that is listed."""
    store = DirectoryStore(shop.input)

    def one(rng: random.Random) -> str:
        shop.clear()
        body = as_yaml(METADATA, rng)
        folder = shop.input / 'sensor-data' / 'thor' / 'rosbags' / 'a'
        folder.mkdir(parents=True)
        (folder / 'metadata.yaml').write_bytes(body)
        with shop.reading():
            for each in bag_overview(store, 'thor', shop.input / 'home'):
                assert shown_time(each.t_start_ns)
            said(lambda: verify_folder(folder))
            return said(lambda: describe_metadata(body, 'x'))

    return one


def manifests(shop: Shop) -> Round:
    """manifest.json: read, listed, verified, and a bag fetched by it; names of files in the store that lead elsewhere."""

    def one(rng: random.Random) -> str:
        shop.clear()
        body = as_json(MANIFEST, rng)
        folder = shop.input / 'a'
        folder.mkdir()
        (folder / 'manifest.json').write_bytes(body)
        (folder / 'a_0.mcap').write_bytes(b'no mcap')
        store = MemoryStore()
        files = []
        for place, name in enumerate(('manifest.json', 'a_0.mcap')):
            store.put(put_item_of(folder / name, f'thor/rosbags/a/{name}', place))
            told = name if rng.random() < 0.7 else rng.choice(TEXTS)
            files.append(RemoteFile(told, f'thor/rosbags/a/{name}', rng.choice(((folder / name).stat().st_size, *NUMBERS[:5]))))
        bag = RemoteBag('thor', 'a' if rng.random() < 0.8 else rng.choice(TEXTS), tuple(files))
        with shop.reading():
            bag_overview(store, 'thor', shop.input / 'home')
            said(lambda: verify_folder(folder))
            said(lambda: fetch_bag(store, bag, shop.target, threads=2))
            return said(lambda: Manifest.from_json(body))

    return one


def put_item_of(path: Path, key: str, place: int) -> Any:
    """Without looking into it."""
    renamed = path.with_suffix('.x')
    shutil.copy(path, renamed)
    try:
        return replace(put_item(renamed, key, 'a', place), path=path)
    finally:
        renamed.unlink()


def packed_bags(shop: Shop) -> Round:
    """SQLite, and what is compressed outside the storage: verified and cut."""
    bases = {}
    for plugin in (StoragePlugin.SQLITE3, StoragePlugin.MCAP):
        for mode in (CompressionMode.NONE, CompressionMode.FILE, CompressionMode.MESSAGE):
            folder = shop.folder / 'base' / f'{plugin.name}{mode.name}'
            folder.parent.mkdir(exist_ok=True)
            write_rosbags(folder, plugin, mode, count=20)
            bases[folder.name] = {path.name: path.read_bytes() for path in folder.iterdir()}

    def one(rng: random.Random) -> str:
        shop.clear()
        folder = shop.input / 'bag'
        folder.mkdir()
        files = dict(bases[rng.choice(sorted(bases))])
        name = rng.choice(sorted(files))
        files[name] = damaged(files[name], rng)
        for each, body in files.items():
            (folder / each).write_bytes(body)
        with shop.reading():
            found = [
                said(lambda: verify_folder(folder, deep=True)),
                said(lambda: cut_folder(folder, shop.target / 'out', Choice())),
            ]
        return ', '.join(found)

    return one


KINDS: Final[Mapping[str, Callable[[Shop], Round]]] = {
    'row files': row_files_, 'summaries': summaries, 'fetched objects': fetched_objects,
    'images': images,
    'clouds': clouds, 'records': records_, 'archives': archives, 'samples': samples, 'slices': slices, 'metadata': metadata,
    'manifests': manifests, 'packed bags': packed_bags,
}  # fmt: skip
