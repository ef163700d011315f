"""Image similarity: vectors are computed once, stored next to the catalog, and searched exactly; invalid ones are skipped."""

from __future__ import annotations

import hashlib
import io
import shutil
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as stn
from lake.image_pairs import SIDE, make_pair
from lake.making import DAY_NS, NOON_NS, add, add_part, folder_store, row
from PIL import Image

from shadowhound_data_logger.core.clock import SECOND
from shadowhound_data_logger.core.config import UploadSettings
from shadowhound_data_logger.core.errors import LakeError
from shadowhound_data_logger.lake import likeness
from shadowhound_data_logger.lake.bucket import Bucket
from shadowhound_data_logger.lake.findings import Findings
from shadowhound_data_logger.lake.image_models import OnnxPair
from shadowhound_data_logger.lake.likeness import embed, like, nearest
from shadowhound_data_logger.stores import open_store
from shadowhound_data_logger.stores.base import ObjectStore

COLOURS = {'red': (250, 10, 20), 'green': (10, 240, 30), 'blue': (20, 10, 230), 'dark red': (120, 20, 20)}


class Lake:
    """Images of one color each, half of them a day later, in a directory store."""

    def __init__(self, home: Path, store: ObjectStore) -> None:
        self.home = home
        self.store = store
        self.source = Bucket(folder_store(home), 'sensor-data')
        self.keys: dict[str, str] = {}
        for place, (name, colour) in enumerate(COLOURS.items()):
            self.add(name, picture(colour), NOON_NS + place * SECOND + place % 2 * DAY_NS)

    def add(self, name: str, body: bytes, stamp_ns: int, sha256: str | None = None) -> None:
        fields = {**row('camera', stamp_ns), 'bytes': len(body), 'sha256': sha256 or hashlib.sha256(body).hexdigest()}
        self.keys[name] = str(fields['key'])
        add(self.store, self.home / 'tmp', self.keys[name], body)
        add_part(self.store, [fields], name.replace(' ', ''), self.home / 'tmp')

    def parts(self) -> list[str]:
        return [info.key for info in self.store.list('sensor-data', '_vectors/')]

    def most_similar(self, model: Any, wanted: Any, **flags: Any) -> list[str]:
        rows = like(self.source, model, wanted, limit=10, **flags).rows.to_pylist()
        names = {key: name for name, key in self.keys.items()}
        return [names[each['key']] for each in rows]


def picture(colour: tuple[int, int, int], size: tuple[int, int] = (64, 48), kind: str = 'PNG') -> bytes:
    out = io.BytesIO()
    Image.new('RGB', size, colour).save(out, kind)
    return out.getvalue()


@pytest.fixture
def lake(tmp_path: Path) -> Iterator[Lake]:
    with closing(open_store(folder_store(tmp_path), UploadSettings())) as store:
        yield Lake(tmp_path, store)


@pytest.fixture(scope='module')
def pair(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_pair(tmp_path_factory.mktemp('models') / 'colours')


def test_the_most_similar_come_first(lake: Lake, pair: Path) -> None:
    """By an image and by words, among those selected by the flags."""
    model = OnnxPair.open(pair)
    found = embed(lake.store, lake.source, model)
    assert (found.pictures, found.known, found.made, dict(found.refused)) == (4, 0, 4, {})
    assert len(lake.parts()) == 2, 'one a day'
    reddish = model.embed_images([Image.new('RGB', (100, 40), (200, 30, 30))])[0]
    assert set(lake.most_similar(model, reddish)[:2]) == {'red', 'dark red'}
    assert lake.most_similar(model, model.embed_text('blue'))[0] == 'blue'
    assert lake.most_similar(model, reddish, until='2026-10-29') == ['red', 'blue']
    answer = like(lake.source, model, model.embed_text('green'), limit=1)
    assert answer.rows['likeness'].to_pylist() == pytest.approx([0.99], abs=0.02)
    assert (answer.pictures, answer.without, len(answer.rows)) == (4, 0, 1)


def test_images_with_a_vector_are_not_embedded_again(lake: Lake, pair: Path) -> None:
    model = OnnxPair.open(pair)
    embed(lake.store, lake.source, model)
    before = lake.parts()
    shutil.rmtree(lake.home / 'store' / 'sensor-data' / 'thor' / 'camera')
    found = embed(lake.store, lake.source, model)
    assert (found.known, found.made, dict(found.refused)) == (4, 0, {})
    assert lake.parts() == before


def test_each_model_has_separate_vectors(lake: Lake, pair: Path, tmp_path: Path) -> None:
    """A changed model is another one, and its results never use vectors of the old one."""
    embed(lake.store, lake.source, OnnxPair.open(pair))
    changed = OnnxPair.open(make_pair(tmp_path / 'colours', scale=2.0))
    assert changed.digest != OnnxPair.open(pair).digest
    answer = like(lake.source, changed, changed.embed_text('red'), limit=10)
    assert (answer.pictures, answer.without, len(answer.rows)) == (4, 4, 0)
    assert embed(lake.store, lake.source, changed).made == 4


def test_invalid_images_are_counted_by_reason(lake: Lake, pair: Path) -> None:
    lake.add('torn', picture((1, 2, 3))[:60], NOON_NS + 100 * SECOND)
    lake.add('changed', picture((1, 2, 4)), NOON_NS + 101 * SECOND, sha256='0' * 64)
    lake.add('gone', picture((1, 2, 5)), NOON_NS + 102 * SECOND)
    (lake.home / 'store' / 'sensor-data' / lake.keys['gone']).unlink()
    lake.add('black', picture((0, 0, 0)), NOON_NS + 103 * SECOND)
    found = embed(lake.store, lake.source, OnnxPair.open(pair))
    assert found.made == 4
    assert dict(found.refused) == {'unreadable': 2, 'changed': 1, 'missing': 1}, 'the model makes a zero of a black picture'


@pytest.mark.parametrize(
    'fault', ['truncated', 'of another model', 'nan', 'half the numbers', 'other columns', 'too many rows', 'noise']
)
def test_invalid_parts_are_skipped_and_named(lake: Lake, pair: Path, fault: str) -> None:
    model = OnnxPair.open(pair)
    embed(lake.store, lake.source, model)
    first, second = lake.parts()
    path = lake.home / 'store' / 'sensor-data' / first
    spoil(path, fault)
    findings = Findings(lambda _: None)
    answer = like(lake.source, model, model.embed_text('red'), limit=10, findings=findings)
    assert [each.key for each in findings] == [first]
    assert (len(answer.rows), answer.without) == (2, 2)
    again = embed(lake.store, lake.source, model, findings=Findings(lambda _: None))
    assert (again.known, again.made) == (2, 2)
    answer = like(lake.source, model, model.embed_text('red'), limit=10, findings=findings)
    assert (len(answer.rows), answer.without) == (4, 0)
    assert second in lake.parts()


def spoil(path: Path, fault: str) -> None:
    body = path.read_bytes()
    table = pq.read_table(io.BytesIO(body))
    digests, vectors = table['sha256'].to_pylist(), [np.frombuffer(each, '<f2') for each in table['vector'].to_pylist()]
    values = dict(table.schema.metadata)
    if fault == 'nan':
        vectors = [np.full_like(each, np.nan) for each in vectors]
    elif fault == 'half the numbers':
        vectors = [each[:1] * 0.5 for each in vectors]
    elif fault == 'of another model':
        values[likeness.MODEL] = b'0' * 64
    elif fault == 'too many rows':
        digests, vectors = digests * 5000, [vectors[0]] * len(vectors) * 5000
    width = 2 * len(vectors[0])
    fields = [
        pa.field('sha256', pa.binary(32), nullable=False),
        pa.field('vector', pa.binary(width), nullable=fault == 'other columns'),
    ]
    columns = [pa.array(digests, pa.binary(32)), pa.array([each.astype('<f2').tobytes() for each in vectors], pa.binary(width))]
    out = io.BytesIO()
    many = fault == 'too many rows'
    pq.write_table(pa.table(columns, schema=pa.schema(fields, metadata=values)), out, compression='zstd' if many else 'none',
                   use_dictionary=many)  # fmt: skip
    path.write_bytes({'truncated': body[:-9], 'noise': b'PAR1' + bytes(200) + b'PAR1'}.get(fault, out.getvalue()))


def test_folders_without_a_model_are_refused(tmp_path: Path, pair: Path) -> None:
    with pytest.raises(LakeError, match='has no image model'):
        OnnxPair.open(tmp_path)
    noise = tmp_path / 'noise'
    noise.mkdir()
    (noise / 'image.onnx').write_bytes(b'\xff' * 100)
    with pytest.raises(LakeError, match='is refused'):
        OnnxPair.open(noise)
    outside = shutil.copytree(pair, tmp_path / 'outside')
    refer_outside(outside / 'onnx' / 'vision_model.onnx')
    with pytest.raises(LakeError, match='is refused'):
        OnnxPair.open(outside)
    silent = make_pair(tmp_path / 'silent', with_text=False)
    with pytest.raises(LakeError, match='has no text model'):
        OnnxPair.open(silent).embed_text('red')
    strange = shutil.copytree(pair, tmp_path / 'strange')
    (strange / 'preprocessor_config.json').write_text('{"size": 999999}')
    with pytest.raises(LakeError, match='does not define how images are prepared'):
        OnnxPair.open(strange).embed_images([Image.new('RGB', (8, 8))])


def refer_outside(path: Path) -> None:
    model = onnx.load(str(path))
    tensor = model.graph.initializer[0]
    tensor.ClearField('raw_data')
    tensor.data_location = onnx.TensorProto.EXTERNAL
    tensor.external_data.add(key='location', value='../../secret')
    path.write_bytes(model.SerializeToString())


def test_a_model_without_a_description_is_used(tmp_path: Path) -> None:
    """SqueezeNet as in the onnx package, without a document about images: its input determines their size."""
    shipped = Path(onnx.__file__).parent / 'backend' / 'test' / 'data' / 'light' / 'light_squeezenet.onnx'
    folder = tmp_path / 'squeezenet'
    folder.mkdir()
    model = onnx.load(str(shipped))
    shape = model.graph.output[0].type.tensor_type.shape
    assert [each.dim_value for each in shape.dim][:2] == [1, 1000]
    if len(shape.dim) == 4:  # (1, 1000, 1, 1)
        model.graph.node.append(onnx.helper.make_node('Flatten', [model.graph.output[0].name], ['flat']))
        model.graph.output.remove(model.graph.output[0])
        model.graph.output.append(onnx.helper.make_tensor_value_info('flat', onnx.TensorProto.FLOAT, [1, 1000]))
    (folder / 'image.onnx').write_bytes(model.SerializeToString())
    found = OnnxPair.open(folder).embed_images([Image.new('RGB', (320, 240), 'teal'), Image.new('RGB', (50, 500), 'red')])
    assert found.shape == (2, 1000)
    assert np.linalg.norm(found, axis=1) == pytest.approx([1, 1])


def test_an_oversized_image_is_refused_before_it_is_decoded(pair: Path) -> None:
    with pytest.raises(ValueError, match='too elongated'):
        OnnxPair.open(pair).embed_images([Image.new('RGB', (SIDE * 8192, 1))])


finite = st.floats(-1, 1, width=16, allow_subnormal=False)


rows_of_six = stn.arrays(np.float16, st.tuples(st.integers(0, 40), st.just(6)), elements=finite)


@given(rows_of_six, stn.arrays(np.float32, 6, elements=st.floats(-1, 1, width=32)), st.integers(1, 50))
def test_the_answer_agrees_with_numpy(vectors: Any, wanted: Any, limit: int) -> None:
    found, scores = nearest(vectors, wanted, limit)
    whole = vectors.astype(np.float32) @ wanted
    expected = np.argsort(-whole, kind='stable')[:limit]
    assert found.tolist() == expected.tolist()
    assert scores.tolist() == whole[expected].tolist()


def test_images_with_the_same_content_are_all_found(lake: Lake, pair: Path) -> None:
    lake.add('red again', picture(COLOURS['red']), NOON_NS + 300 * SECOND)
    model = OnnxPair.open(pair)
    found = embed(lake.store, lake.source, model)
    assert (found.pictures, found.made, found.known) == (5, 4, 1)
    assert set(lake.most_similar(model, model.embed_text('red'))[:2]) == {'red', 'red again'}


def test_a_killed_run_loses_no_vector(lake: Lake, pair: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Vectors stored by then are there, and the next run computes the rest."""
    monkeypatch.setattr(likeness, 'PART_ROWS', 1)
    model, put = OnnxPair.open(pair), likeness.put_part
    done: list[str] = []

    def mortal(*arguments: Any) -> None:
        if len(done) == 1:
            raise KeyboardInterrupt
        put(*arguments)
        done.append(arguments[1])

    monkeypatch.setattr(likeness, 'put_part', mortal)
    with pytest.raises(KeyboardInterrupt):
        embed(lake.store, lake.source, model)
    monkeypatch.setattr(likeness, 'put_part', put)
    found = embed(lake.store, lake.source, model)
    assert 1 <= found.known < 4
    assert found.known + found.made == 4
    assert replace(found, made=4, known=0).pictures == 4
