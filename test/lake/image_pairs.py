"""Pairs of small ONNX models in the layout of Hugging Face's exports: the colors of an image, and words for them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper
from tokenizers import Tokenizer, models, pre_tokenizers

SIDE = 32
WORDS = {'[UNK]': 0, 'red': 1, 'green': 2, 'blue': 3}
COLOURS = np.array([[0.3, 0.3, 0.3], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)


def make_pair(folder: Path, *, scale: float = 1.0, with_text: bool = True) -> Path:
    """``image_embeds`` is the image's mean color, ``text_embeds`` that of the words; another ``scale`` makes another model."""
    (folder / 'onnx').mkdir(parents=True)
    pixels = helper.make_tensor_value_info('pixel_values', TensorProto.FLOAT, ['batch', 3, SIDE, SIDE])
    embeds = helper.make_tensor_value_info('image_embeds', TensorProto.FLOAT, ['batch', 3])
    nodes = [helper.make_node('GlobalAveragePool', ['pixel_values'], ['mean']), helper.make_node('Flatten', ['mean'], ['flat']),
             helper.make_node('Mul', ['flat', 'scale'], ['image_embeds'])]  # fmt: skip
    factor = numpy_helper.from_array(np.array(scale, np.float32), 'scale')
    _save(helper.make_graph(nodes, 'vision', [pixels], [embeds], [factor]), folder / 'onnx' / 'vision_model.onnx')
    fields = {
        'do_resize': True,
        'size': {'shortest_edge': SIDE},
        'do_center_crop': True,
        'crop_size': {'height': SIDE, 'width': SIDE},
    }
    fields |= {'do_rescale': True, 'rescale_factor': 1 / 255, 'do_normalize': False}
    (folder / 'preprocessor_config.json').write_text(json.dumps(fields))
    if with_text:
        ids = helper.make_tensor_value_info('input_ids', TensorProto.INT64, ['batch', 'length'])
        report = helper.make_tensor_value_info('text_embeds', TensorProto.FLOAT, ['batch', 3])
        nodes = [helper.make_node('Gather', ['table', 'input_ids'], ['each']),
                 helper.make_node('ReduceMean', ['each'], ['text_embeds'], axes=[1], keepdims=0)]  # fmt: skip
        table = numpy_helper.from_array(COLOURS, 'table')
        _save(helper.make_graph(nodes, 'text', [ids], [report], [table]), folder / 'onnx' / 'text_model.onnx')
        tokenizer = Tokenizer(models.WordLevel(WORDS, unk_token='[UNK]'))
        tokenizer.pre_tokenizer = pre_tokenizers.Whitespace()
        tokenizer.save(str(folder / 'tokenizer.json'))
    return folder


def _save(graph: onnx.GraphProto, path: Path) -> None:
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid('', 13)], ir_version=8)
    onnx.checker.check_model(model)
    onnx.save(model, str(path))
