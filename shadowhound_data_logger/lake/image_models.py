"""Embeds images and texts as vectors, with a pair of ONNX models that the user supplies.

The layout of a model's folder is that of Hugging Face's exports of CLIP and SigLIP, such as Xenova/clip-vit-base-patch32:
``vision_model.onnx`` and, for queries in words, ``text_model.onnx``; next to them or one folder up ``preprocessor_config.json``
and ``tokenizer.json``. A model is identified by the SHA-256 over these files; vectors of different models are never compared.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from shadowhound_data_logger.core.durable_files import fingerprint
from shadowhound_data_logger.core.errors import LakeError, PolicyRefused
from shadowhound_data_logger.core.untrusted import MAX_DOCUMENT_BYTES, check_size, from_json
from shadowhound_data_logger.policies.content import check_content

Vectors = NDArray[np.float32]
IMAGE_MODELS: Final = ('vision_model.onnx', 'image.onnx', 'model.onnx')
TEXT_MODELS: Final = ('text_model.onnx', 'text.onnx')
FOLDERS: Final = ('.', 'onnx')
PREPROCESSOR, TOKENIZER = 'preprocessor_config.json', 'tokenizer.json'
MAX_DIMENSIONS: Final = 4096
"""Numbers in a vector."""
MAX_SIDE: Final = 2048
"""Pixels of a model's input."""
MAX_TOKENS: Final = 512
LAYOUT: Final = (
    'a folder with vision_model.onnx (or image.onnx) and, for queries in words, text_model.onnx and tokenizer.json, as Hugging '
    'Face exports CLIP and SigLIP'
)
EXTRA: Final = "pip install 'shadowhound_data_logger[likeness]'"


@dataclass(frozen=True, slots=True)
class _Preparation:
    """How an image is converted to the model's input (``preprocessor_config.json``)."""

    size: tuple[int, int]
    """Height and width of the input."""
    shortest: int | None = None
    """If set, the image is first resized so that its shorter side has this many pixels, and then cropped."""
    scale: float = 1 / 255
    mean: tuple[float, ...] = (0.0, 0.0, 0.0)
    std: tuple[float, ...] = (1.0, 1.0, 1.0)
    resample: int = 3

    def input(self, picture: Any) -> Vectors:
        """Convert an image to (3, height, width)."""
        rgb = picture.convert('RGB')
        height, width = self.size
        if self.shortest is None:
            rgb = rgb.resize((width, height), self.resample)
        else:
            ratio = self.shortest / min(rgb.size)
            if max(rgb.size) * ratio > 8 * MAX_SIDE:
                raise ValueError(f'an image of {rgb.width} x {rgb.height} is too elongated for the model')
            rgb = rgb.resize((max(width, round(rgb.width * ratio)), max(height, round(rgb.height * ratio))), self.resample)
            left, top = (rgb.width - width) // 2, (rgb.height - height) // 2
            rgb = rgb.crop((left, top, left + width, top + height))
        values = (np.asarray(rgb, np.float32) * np.float32(self.scale) - np.array(self.mean, np.float32)) / np.array(
            self.std, np.float32
        )
        return np.ascontiguousarray(values.transpose(2, 0, 1))


@dataclass(slots=True)
class OnnxPair:
    """A vision model and, if present, its text model; similar images have similar vectors. Not thread-safe."""

    folder: Path
    _files: dict[str, Path]
    digest: str
    _preparation: _Preparation | None = None
    _sessions: dict[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The name for messages."""
        return f'the model {self.folder.name} ({self.digest[:12]})'

    @classmethod
    def open(cls, folder: Path) -> OnnxPair:
        """Open a model's folder. Raises LakeError if it has no model, or if its files refer to other files."""
        folder = folder.absolute()
        files = {role: path for role, names in (('image', IMAGE_MODELS), ('text', TEXT_MODELS), ('preprocessor', (PREPROCESSOR,)),
                                                ('tokenizer', (TOKENIZER,))) if (path := _find(folder, names))}  # fmt: skip
        if 'image' not in files:
            raise LakeError(f'{folder} has no image model', remedy=f'--model is {LAYOUT}')
        digest = hashlib.sha256()
        try:
            for role, path in sorted(files.items()):
                check_content(path, path.name)
                digest.update(f'{role} {fingerprint(path)[1]}\n'.encode())
        except (PolicyRefused, OSError) as error:
            raise LakeError(f'the model in {folder} is refused: {error}', remedy=f'--model is {LAYOUT}') from error
        return cls(folder, files, digest.hexdigest())

    def embed_images(self, pictures: Sequence[Any]) -> Vectors:
        """Vectors (n, d), of length 1, of n Pillow images. Raises LakeError, ValueError."""
        session = self._session('image')
        preparation = self._preparation or self._prepare(session)
        self._preparation = preparation
        batch = np.stack([preparation.input(each) for each in pictures])
        is_single = session.get_inputs()[0].shape[0] == 1
        pieces = [batch[i : i + 1] for i in range(len(batch))] if is_single else [batch]
        name = session.get_inputs()[0].name
        return _unit(np.concatenate([self._run('image', {name: piece}) for piece in pieces]), self.name)

    def embed_text(self, text: str) -> Vectors:
        """The vector (d,) of a text. Raises LakeError if there is no text model."""
        if 'text' not in self._files or 'tokenizer' not in self._files:
            raise LakeError(f'{self.folder} has no text model', remedy=f'for queries in words --model is {LAYOUT}')
        try:
            from tokenizers import Tokenizer  # type: ignore[import-not-found, unused-ignore] # noqa: PLC0415 - of the extra
        except ModuleNotFoundError as error:
            raise LakeError('tokenizers is not installed', remedy=EXTRA) from error
        try:
            tokens = Tokenizer.from_str(self._files['tokenizer'].read_text('utf-8')).encode(text)
        except Exception as error:
            raise LakeError(f'{self._files["tokenizer"]} is not a tokenizer: {error}') from error
        ids = np.array([tokens.ids[:MAX_TOKENS]], np.int64)
        values = {'input_ids': ids, 'attention_mask': np.array([tokens.attention_mask[:MAX_TOKENS]], np.int64),
                  'token_type_ids': np.zeros_like(ids)}  # fmt: skip
        names = {each.name for each in self._session('text').get_inputs()}
        if not names <= values.keys():
            raise LakeError(f'the text model of {self.folder} has unsupported inputs: {", ".join(sorted(names - values.keys()))}')
        found: Vectors = _unit(self._run('text', {name: values[name] for name in names}), self.name)[0]
        return found

    def _session(self, role: str) -> Any:
        if role not in self._sessions:
            try:
                import onnxruntime  # type: ignore[import-untyped, unused-ignore] # noqa: PLC0415 - of the extra
            except ModuleNotFoundError as error:
                raise LakeError('onnxruntime is not installed', remedy=EXTRA) from error
            options = onnxruntime.SessionOptions()
            options.log_severity_level = 4
            try:
                content = self._files[role].read_bytes()
                self._sessions[role] = onnxruntime.InferenceSession(content, options, providers=['CPUExecutionProvider'])
            except Exception as error:
                raise LakeError(f'{self._files[role]} cannot be loaded: {_short(error)}') from error
        return self._sessions[role]

    def _prepare(self, session: Any) -> _Preparation:
        inputs = session.get_inputs()
        shape = list(inputs[0].shape) if len(inputs) == 1 else []
        if len(shape) != 4 or (isinstance(shape[1], int) and shape[1] != 3):
            raise LakeError(
                f'the image model of {self.folder} does not accept images', remedy='its only input must be (n, 3, height, width)'
            )
        sides = tuple(side if isinstance(side, int) and 0 < side <= MAX_SIDE else None for side in shape[2:])
        config: Mapping[str, Any] = {}
        try:
            if 'preprocessor' in self._files:
                path = self._files['preprocessor']
                check_size(path.stat().st_size, MAX_DOCUMENT_BYTES)
                config = from_json(path.read_bytes())
            return _preparation(config, sides)
        except (ValueError, TypeError, KeyError, AttributeError, OSError) as error:
            raise LakeError(f'{self.folder} does not define how images are prepared: {error}',
                            remedy=f'{PREPROCESSOR} as Hugging Face exports it') from error  # fmt: skip

    def _run(self, role: str, values: Mapping[str, Any]) -> Vectors:
        session = self._session(role)
        outputs = [each.name for each in session.get_outputs()]
        wanted = next((name for name in outputs if name in {f'{role}_embeds', 'embeds', 'pooler_output'}), outputs[0])
        try:
            found = np.asarray(session.run([wanted], dict(values))[0], np.float32)
        except Exception as error:
            raise LakeError(f'{self._files[role]} cannot be run: {_short(error)}') from error
        if found.ndim != 2 or not 0 < found.shape[1] <= MAX_DIMENSIONS:
            raise LakeError(
                f'{wanted} of {self._files[role]} has the shape {found.shape}, expected (n, up to {MAX_DIMENSIONS:,})'
            )
        return found


def _find(folder: Path, names: Sequence[str]) -> Path | None:
    places = (folder / inner / name for name in names for inner in FOLDERS)
    above = (folder.parent / name for name in names if folder.name == 'onnx' and name in {PREPROCESSOR, TOKENIZER})
    return next((path for path in (*places, *above) if path.is_file()), None)


def _preparation(config: Mapping[str, Any], sides: Sequence[int | None]) -> _Preparation:
    """Raises ValueError, TypeError or KeyError for an invalid document, or one without the size."""
    size, crop = config.get('size'), config.get('crop_size')
    shortest = size.get('shortest_edge') if isinstance(size, dict) else size if config.get('do_center_crop') else None
    if shortest is not None and not config.get('do_center_crop', crop is not None):
        raise ValueError('images are resized by their shorter side but not cropped')
    whole = crop if shortest is not None else size
    if isinstance(whole, dict):
        height, width = whole['height'], whole['width']
    elif whole is not None:
        height = width = whole
    else:
        height, width = sides
    for side in (height, width, *([shortest] if shortest is not None else [])):
        if type(side) is not int or not 0 < side <= MAX_SIDE:
            raise ValueError(f'a side has {side!r} pixels, allowed are 1 to {MAX_SIDE}')
    if any(own not in {None, side} for own, side in zip(sides, (height, width), strict=True)):
        raise ValueError(f'images are {height} x {width}, but the model expects {sides[0]} x {sides[1]}')
    scale = float(config.get('rescale_factor', 1 / 255)) if config.get('do_rescale', True) else 1.0
    mean, std = (tuple(map(float, config[name])) if config.get('do_normalize', name in config) and name in config else default
                 for name, default in (('image_mean', (0.0,) * 3), ('image_std', (1.0,) * 3)))  # fmt: skip
    resample = config.get('resample', 3)
    if (
        len(mean) != 3
        or len(std) != 3
        or not all(std)
        or resample not in range(6)
        or (shortest is not None and shortest < max(height, width))
    ):
        raise ValueError('mean, standard deviation or size is invalid')
    return _Preparation((height, width), shortest, scale, mean, std, resample)


def _unit(found: Vectors, model: str) -> Vectors:
    lengths = np.linalg.norm(found, axis=1, keepdims=True)
    if not np.isfinite(lengths).all() or not lengths.all():
        raise ValueError(f'{model} returned a vector that is zero or not finite')
    unit: Vectors = found / lengths
    return unit


def _short(error: BaseException) -> str:
    return ' '.join(str(error).split())[:200] or type(error).__name__
