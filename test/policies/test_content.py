"""Versions that a robot refuses to run because of their content, with the reason for each."""

from __future__ import annotations

import json
from pathlib import Path

import onnx
import pytest
from onnx import helper
from policies.models import linear

from shadowhound_data_logger.core.errors import PolicyRefused
from shadowhound_data_logger.policies.content import check_content


def test_data_outside_of_the_model_is_refused(tmp_path: Path) -> None:
    """Tensors in other files, wherever in the model, and engines that the runtime would load."""
    path = tmp_path / 'model.onnx'
    whole = linear()
    path.write_bytes(whole.SerializeToString())
    check_content(path, 'model.onnx')
    outside = whole.graph.initializer[0]
    outside.ClearField('raw_data')
    outside.data_location = onnx.TensorProto.EXTERNAL
    entry = outside.external_data.add()
    entry.key, entry.value = 'location', '../../../etc/passwd'
    inside = helper.make_node('Constant', [], ['c'], value=outside)
    branch = helper.make_graph([inside], 'branch', [], [])
    nested = helper.make_node('If', ['x'], ['y'], then_branch=branch, else_branch=branch)
    deeper = helper.make_node('If', ['x'], ['y'], then_branch=helper.make_graph([nested], 'upper', [], []))
    several = helper.make_node('Several', [], [])
    several.attribute.append(onnx.AttributeProto(name='a', type=onnx.AttributeProto.TENSORS, tensors=[outside]))
    several.attribute.append(onnx.AttributeProto(name='b', type=onnx.AttributeProto.GRAPHS, graphs=[branch]))
    engine = helper.make_node('EPContext', [], ['e'], domain='com.microsoft', ep_cache_context='engine')
    sparse = onnx.SparseTensorProto(values=onnx.TensorProto(dims=[1], data_type=1, float_data=[1.0]), indices=outside, dims=[3])
    function = helper.make_function('local', 'f', [], ['c'], [inside], [helper.make_opsetid('', 17)])
    by_attribute = onnx.FunctionProto(name='g', attribute_proto=[onnx.AttributeProto(name='a', t=outside)])
    models = [_of(), *(_of(node) for node in (inside, nested, deeper, several, engine)), *(_of() for _ in range(6))]
    models[0].graph.initializer.append(outside)
    *_, a, b, c, d, e, f = models
    a.graph.sparse_initializer.append(sparse)
    b.functions.append(function)
    c.training_info.add().initialization.CopyFrom(branch)
    d.training_info.add().algorithm.CopyFrom(branch)
    for model, more in ((e, {'sparse_tensor': sparse}), (f, {'sparse_tensors': [sparse]})):
        model.graph.node.add(op_type='Constant').attribute.append(onnx.AttributeProto(name='s', **more))
    models.append(_of())
    models[-1].functions.append(by_attribute)
    for number, model in enumerate(models):
        path.write_bytes(model.SerializeToString())
        with pytest.raises(PolicyRefused) as raised:
            check_content(path, 'model.onnx')
        assert raised.value.reason == 'external', number


def _of(*nodes: onnx.NodeProto) -> onnx.ModelProto:
    return helper.make_model(helper.make_graph(nodes, 'g', [], []))


@pytest.mark.parametrize(('name', 'content'), [
    ('m.onnx', b'\x80\x04pickle'), ('m.onnx', b''), ('m.onnx', b'\x3a\xff\xff\xff\xff\x7f'), ('m.onnx', b'\x3a\x02' * 40),
    ('m.onnx', b'\xfa\x80\x80\x80\x10\x00'),
    ('m.onnx', b'\x12\x80\x08\x00ORTM' + bytes(1024 - 5) + b'\x08\x09'), ('m.safetensors', b'\x80\x04'),
    ('m.safetensors', b'\xff' * 16),
    ('a.json', b'{'), ('a.json', b'[' * 100_000), ('a.npy', b'\x80\x04'), ('a.npy', b''),
])  # fmt: skip
def test_a_file_with_a_wrong_extension_is_refused(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(PolicyRefused) as raised:
        check_content(tmp_path / name, name)
    assert raised.value.reason == 'file_type'


def safetensors(header: object, size: int = 8) -> bytes:
    body = header if isinstance(header, bytes) else json.dumps(header).encode()
    return len(body).to_bytes(8, 'little') + body + bytes(size)


@pytest.mark.parametrize('header', [
    {'a': {'dtype': 'F32', 'shape': [2], 'data_offsets': [0, 8]}},
    {'__metadata__': {'format': 'pt'}, 'b': {'dtype': 'F32', 'shape': [], 'data_offsets': [4, 8]},
     'a': {'dtype': 'BF16', 'shape': [1, 2], 'data_offsets': [0, 4]},
     'none': {'dtype': 'U8', 'shape': [0], 'data_offsets': [4, 4]}},
])  # fmt: skip
def test_safetensors_written_by_the_library_are_accepted(tmp_path: Path, header: object) -> None:
    (tmp_path / 'm.safetensors').write_bytes(safetensors(header))
    check_content(tmp_path / 'm.safetensors', 'm.safetensors')


@pytest.mark.parametrize('header', [
    b'[]', b'{}', b'null', b'{"a": NaN}', b'{"a": {"dtype": "F32", "shape": [2], "data_offsets": [0, 8]}, "a": {}}',
    b'[' * 100_000,
    {'a': {'dtype': 'F32', 'shape': [2]}},
    {'a': {'dtype': 'object', 'shape': [1], 'data_offsets': [0, 8]}}, {'a': {'dtype': 'F32', 'shape': 2, 'data_offsets': [0, 8]}},
    {'a': {'dtype': 'F32', 'shape': [-1, -2], 'data_offsets': [0, 8]}},
    {'a': {'dtype': 'F32', 'shape': [2.0], 'data_offsets': [0, 8]}},
    {'a': {'dtype': 'F32', 'shape': [3], 'data_offsets': [0, 8]}},
    {'a': {'dtype': 'F32', 'shape': [1], 'data_offsets': [4, 8]}}, {'a': {'dtype': 'F32', 'shape': [1], 'data_offsets': [0, 4]}},
    {'a': {'dtype': 'F32', 'shape': [4], 'data_offsets': [0, 16]}}, {'a': {'dtype': 'F32', 'shape': [2], 'data_offsets': [8, 0]}},
    {'a': {'dtype': 'F32', 'shape': [2], 'data_offsets': [0, 8]}, 'b': {'dtype': 'F32', 'shape': [1], 'data_offsets': [4, 8]}},
    {'a': {'dtype': 'F32', 'shape': [1], 'data_offsets': [0, 4]}, 'b': {'dtype': 'U8', 'shape': [2], 'data_offsets': [6, 8]}},
    {'a': {'dtype': 'F32', 'shape': [2], 'data_offsets': [0, 8]}, '__metadata__': {'a': 1}},
    {'a': {'dtype': 'F32', 'shape': [2], 'data_offsets': [False, 8]}},
    {'a': {'dtype': 'U8', 'shape': [1 << 62, 4, 1 << 62, 0], 'data_offsets': [0, 8]}},
    json.dumps({'a': {'dtype': 'F32', 'shape': [2], 'data_offsets': [0, 8]}}).encode() + b' ' * (2 << 20),
])  # fmt: skip
def test_invalid_safetensors_are_refused(tmp_path: Path, header: object) -> None:
    """Another type, shape or place of a tensor than the format allows, overlaps and gaps, or a header of megabytes."""
    (tmp_path / 'm.safetensors').write_bytes(safetensors(header))
    with pytest.raises(PolicyRefused) as raised:
        check_content(tmp_path / 'm.safetensors', 'm.safetensors')
    assert raised.value.reason == 'file_type'
