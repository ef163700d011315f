"""Image similarity: stores vectors of images as Parquet next to the catalog, and searches for those nearest to a given vector.

A file is ``_vectors/<model>/<robot>/date=YYYY-MM-DD/<robot>_<random>.parquet`` in the catalog's bucket, where robots must not
write; ``<model>`` is the first 16 characters of the model's digest. It has two columns of fixed size, uncompressed and without
nulls, so that its size bounds its content: ``sha256`` (32 bytes), the image's content, and ``vector``, little-endian float16
numbers. Invalid files, and vectors whose length is not 1, are skipped and reported.
"""

from __future__ import annotations

import hashlib
import io
import secrets
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import islice
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from shadowhound_data_logger.core.clock import utc
from shadowhound_data_logger.core.errors import LakeError, ObjectRefused
from shadowhound_data_logger.core.progress import ProgressListener
from shadowhound_data_logger.core.untrusted import MAX_OBJECT_BYTES, is_path, open_image
from shadowhound_data_logger.lake import query
from shadowhound_data_logger.lake.bucket import THREADS, Bucket, put_part
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.image_models import MAX_DIMENSIONS, OnnxPair, Vectors
from shadowhound_data_logger.lake.pictures import IMAGES
from shadowhound_data_logger.stores.base import ObjectStore

FOLDER: Final = '_vectors'
ABOUT: Final = b'shadowhound.vectors'
MODEL: Final = b'shadowhound.model'
DIGEST_BYTES: Final = 32
PART_ROWS: Final = 1024
"""Rows per file: a kill loses at most this many vectors per robot and day."""
MAX_PART_BYTES: Final = 256 << 20
BATCH: Final = 16
"""Images that a model processes at a time."""
CHUNK: Final = 8192
"""Vectors that are converted to float32 at a time: 16 MB if they have 512 numbers."""
LENGTH_ERROR: Final = 0.02
"""Allowed difference of a vector's length from 1: a float16 has a precision of 11 bits."""
_SHA256: Final = r'^[0-9a-f]{64}$'


@dataclass(slots=True)
class Embedded:
    """The result of ``embed``."""

    pictures: int = 0
    known: int = 0
    """Images that already had a vector of this model, including images with the same content."""
    made: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    """Reason -> images without a vector: ``missing`` ``too_large`` ``changed`` ``unreadable``."""


@dataclass(frozen=True, slots=True)
class Likeness:
    """The images of a query, ordered by similarity."""

    rows: pa.Table
    """Rows of the catalog, the most similar first, with a column ``likeness``: the cosine of the vectors' angle, -1 to 1."""
    pictures: int
    without: int
    """How many of the images have no vector of this model."""


def embed(store: ObjectStore, source: Bucket, model: OnnxPair, *, findings: Findings | None = None,
          progress: ProgressListener | None = None, **flags: Any) -> Embedded:  # fmt: skip
    """Compute the missing vectors of all images that the flags select (``query.objects``).

    It can be killed, repeated, and run twice at the same time: files are uploaded atomically, and images with a vector are
    skipped. Raises LakeError, StoreError.
    """
    findings, progress = Findings() if findings is None else findings, progress or ProgressListener()
    rows = pictures(query.objects(source, findings=findings, **flags))
    found = Embedded(pictures=len(rows))
    known = {digest for part in _parts(source, model, rows, findings) for digest in part.digests}
    todo = []
    for row in rows.to_pylist():
        digest = bytes.fromhex(row['sha256'])
        if digest in known:
            found.known += 1
        else:
            known.add(digest)
            todo.append(row)
    pending: dict[tuple[str, str], list[tuple[bytes, NDArray[np.float16]]]] = {}
    progress.begin(len(todo))
    for some in _opened(source, todo, found, progress):
        try:
            vectors = [*model.embed_images([picture for _, picture in some]).astype('<f2')] if some else []
        except ValueError:
            vectors = _one_by_one(model, some, found)
        for (row, _), vector in zip(some, vectors, strict=True):
            if vector is not None:
                group = pending.setdefault((row['robot'], _date(row)), [])
                group.append((bytes.fromhex(row['sha256']), vector))
                found.made += 1
        for name in [name for name, group in pending.items() if len(group) >= PART_ROWS]:
            put_vectors(store, model, *name, pending.pop(name))
    for name, group in pending.items():
        put_vectors(store, model, *name, group)
    return found


def like(source: Bucket, model: OnnxPair, wanted: Vectors, *, limit: int, findings: Findings | None = None,
         **flags: Any) -> Likeness:  # fmt: skip
    """The images that the flags select, by the similarity of their vectors to a given one (d,). Raises LakeError, StoreError."""
    findings = Findings() if findings is None else findings
    rows = pictures(query.objects(source, findings=findings, **flags))
    digests, vectors = _collected(_parts(source, model, rows, findings))
    if len(vectors) and vectors.shape[1] != len(wanted):
        raise LakeError(f'{model.name} computes vectors of {len(wanted)} numbers, but those in the store have {vectors.shape[1]}')
    at = {digest: index for index, digest in enumerate(digests)}
    places = np.array([at.get(bytes.fromhex(each), -1) for each in rows['sha256'].to_pylist()], np.intp)
    have = np.flatnonzero(places >= 0)
    best, scores = nearest(vectors[places[have]], wanted, limit)
    chosen = rows.take(pa.array(have[best], pa.int64()))
    chosen = chosen.append_column('likeness', pa.array(np.asarray(scores, np.float64), pa.float64()))
    return Likeness(chosen, len(rows), len(rows) - len(have))


def nearest(vectors: NDArray[np.float16], wanted: Vectors, limit: int) -> tuple[NDArray[np.intp], Vectors]:
    """The indices and dot products of the ``limit`` vectors (n, d) most similar to a given one (d,), in descending order.

    Exact: all products are computed, in float32. The sort is stable.
    """
    scores = np.empty(len(vectors), np.float32)
    for start in range(0, len(vectors), CHUNK):
        scores[start : start + CHUNK] = vectors[start : start + CHUNK].astype(np.float32) @ wanted
    count = min(limit, len(scores))
    threshold = np.partition(scores, -count)[-count] if count else np.inf
    candidates = np.flatnonzero(scores >= threshold)
    order = candidates[np.argsort(-scores[candidates], kind='stable')][:count]
    return order, scores[order]


def pictures(rows: pa.Table) -> pa.Table:
    """The rows of images whose SHA-256 is known."""
    lower = pc.utf8_lower(rows['key'])
    is_image = pc.match_substring_regex(lower, '(' + '|'.join(IMAGES).replace('.', r'\.') + ')$')
    is_known = pc.fill_null(pc.match_substring_regex(rows['sha256'], _SHA256), fill_value=False)
    is_known = pc.and_(is_known, pc.is_valid(rows['robot']))
    return rows.filter(pc.and_(is_image, is_known))


# -- making -------------------------------------------------------------------------------------------------------------------


def _opened(
    source: Bucket, rows: Sequence[Mapping[str, Any]], found: Embedded, progress: ProgressListener
) -> Iterator[list[tuple[Mapping[str, Any], Any]]]:
    """Batches of decoded images with their rows; unreadable ones are counted."""

    def body(row: Mapping[str, Any]) -> bytes | str:
        try:
            got = Bucket(source.settings, row['bucket']).get(row['key'], MAX_OBJECT_BYTES)
        except ObjectRefused as error:
            return 'missing' if error.data.get('reason') == 'missing' else 'too_large'
        return got if hashlib.sha256(got).hexdigest() == row['sha256'] else 'changed'

    left = iter(rows)
    with ThreadPoolExecutor(THREADS, 'lake-embed') as pool:
        while some := list(islice(left, BATCH)):
            batch = []
            for row, got in zip(some, pool.map(body, some), strict=True):
                if isinstance(got, str):
                    found.refused[got] += 1
                    continue
                try:
                    with open_image(got) as opened:
                        opened.load()
                        batch.append((row, opened.convert('RGB')))
                except (OSError, ValueError, SyntaxError):
                    found.refused['unreadable'] += 1
            yield batch
            progress.have(len(some))


def _one_by_one(model: OnnxPair, some: Sequence[tuple[Mapping[str, Any], Any]], found: Embedded) -> list[Any]:
    """Embed images one by one, so that an invalid one does not affect the others; None for an invalid one."""
    made: list[Any] = []
    for _, picture in some:
        try:
            made.append(model.embed_images([picture]).astype('<f2')[0])
        except ValueError:
            found.refused['unreadable'] += 1
            made.append(None)
    return made


def put_vectors(
    store: ObjectStore, model: OnnxPair, robot: str, date: str, rows: Sequence[tuple[bytes, NDArray[np.float16]]]
) -> None:
    """Upload a file with vectors of one model and the SHA-256 of their images; returns when it is stored. Raises StoreError."""
    digests = b''.join(digest for digest, _ in rows)
    vectors = np.stack([vector for _, vector in rows])
    width = 2 * vectors.shape[1]
    fields = [pa.field(name, pa.binary(size), nullable=False) for name, size in (('sha256', DIGEST_BYTES), ('vector', width))]
    schema = pa.schema(fields, metadata={ABOUT: b'1', MODEL: model.digest.encode()})
    columns = [pa.FixedSizeBinaryArray.from_buffers(kind, len(rows), [None, pa.py_buffer(content)])
               for kind, content in ((pa.binary(DIGEST_BYTES), digests), (pa.binary(width), vectors.tobytes()))]  # fmt: skip
    out = io.BytesIO()
    pq.write_table(pa.table(columns, schema=schema), out, compression='none', use_dictionary=False, write_statistics=False)
    name = secrets.token_hex(8)  # a damaged file is not overwritten but replaced by new ones
    put_part(store, f'{_prefix(model, robot)}date={date}/{robot}_{name}.parquet', robot, out.getvalue(), len(rows))


def _prefix(model: OnnxPair, robot: str) -> str:
    return f'{FOLDER}/{model.digest[:16]}/{robot}/'


def _date(row: Mapping[str, Any]) -> str:
    return f'{utc(row["t_start_ns"] or 0):%Y-%m-%d}'


# -- reading ------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _VectorPart:
    digests: Sequence[bytes]
    vectors: NDArray[np.float16]


def _parts(source: Bucket, model: OnnxPair, rows: pa.Table, findings: Findings) -> Iterator[_VectorPart]:
    """All files of vectors for the robots and days of these rows. Raises StoreError."""
    days = set(
        zip(rows['robot'].to_pylist(), (f'{utc(each or 0):%Y-%m-%d}' for each in rows['t_start_ns'].to_pylist()), strict=True)
    )

    def read(entry: Any) -> tuple[Any, bytes | str]:
        if entry.size > MAX_PART_BYTES or not is_path(entry.key):
            return entry, 'it is too large, or its name is not a path'
        try:
            return entry, source.get(entry.key, entry.size)
        except ObjectRefused as error:
            return entry, str(error)

    entries = [entry for robot, date in sorted(days) for entry in source.list(f'{_prefix(model, robot)}date={date}/')]
    with ThreadPoolExecutor(THREADS, 'lake-vectors') as pool:
        for start in range(0, len(entries), THREADS):
            for entry, body in pool.map(read, entries[start : start + THREADS]):
                if isinstance(body, str):
                    findings.add(entry.key, body)
                    continue
                try:
                    part = _decoded(body, model)
                except (pa.ArrowException, OSError, ValueError, MemoryError, LookupError, TypeError, OverflowError) as error:
                    findings.add(entry.key, f'it is not a file of vectors ({" ".join(str(error).split())[:200]})')
                    continue
                yield _checked(part, entry.key, findings)


def _decoded(body: bytes, model: OnnxPair) -> _VectorPart:
    """Raises ValueError, or various errors of pyarrow, for an invalid file."""
    file = pq.ParquetFile(io.BytesIO(body))
    schema, metadata = file.schema_arrow, file.metadata.metadata or {}
    if metadata.get(ABOUT) != b'1' or metadata.get(MODEL) != model.digest.encode():
        raise ValueError('it belongs to another model')
    if schema.names != ['sha256', 'vector'] or any(
        each.nullable or not pa.types.is_fixed_size_binary(each.type) for each in schema
    ):
        raise ValueError('it has other columns')
    width = schema.field('vector').type.byte_width
    if schema.field('sha256').type.byte_width != DIGEST_BYTES or width % 2 or not 0 < width <= 2 * MAX_DIMENSIONS:
        raise ValueError('its columns have other sizes')
    if file.metadata.num_rows * (DIGEST_BYTES + width) > len(body):
        raise ValueError('it claims more rows than it has bytes for')
    table = file.read().combine_chunks()
    digests = table['sha256'].to_pylist()
    vectors = np.frombuffer(b''.join(table['vector'].to_pylist()), '<f2').reshape(len(digests), width // 2)
    return _VectorPart(digests, vectors)


def _checked(part: _VectorPart, key: str, findings: Findings) -> _VectorPart:
    """The file without invalid vectors."""
    squares = np.einsum('ij,ij->i', part.vectors, part.vectors, dtype=np.float32)
    with np.errstate(invalid='ignore'):
        good = np.abs(np.sqrt(squares) - 1) <= LENGTH_ERROR
    if not good.all():
        left = int(len(good) - good.sum())
        findings.add(key, f'{left:,} of its {len(good):,} vectors are not of length 1', left)
        return _VectorPart([each for each, is_good in zip(part.digests, good, strict=True) if is_good], part.vectors[good])
    return part


def _collected(parts: Iterator[_VectorPart]) -> tuple[list[bytes], NDArray[np.float16]]:
    """All vectors in one array; a file whose vectors have another size than the first ones is invalid and skipped."""
    digests: list[bytes] = []
    vectors: list[NDArray[np.float16]] = []
    for part in parts:
        if len(part.digests) and (not vectors or part.vectors.shape[1] == vectors[0].shape[1]):
            digests += part.digests
            vectors.append(part.vectors)
    return digests, np.concatenate(vectors) if vectors else np.empty((0, 0), '<f2')
