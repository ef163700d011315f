"""Run by lerobot's Python: writes a folder's images and numbers with its own writer, and reports the duration."""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path

os.environ |= {'HF_HUB_OFFLINE': '1', 'HF_DATASETS_OFFLINE': '1'}

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from PIL import Image


def main(source: Path, target: Path, fps: int, *, streaming: bool) -> None:
    files = sorted(source.glob('*.jpg'))
    state = np.load(source / 'state.npy').astype(np.float32)
    width, height = Image.open(files[0]).size
    vector = {'dtype': 'float32', 'shape': (state.shape[1],), 'names': [f'n{number}' for number in range(state.shape[1])]}
    picture = {'dtype': 'video', 'shape': (height, width, 3), 'names': ['height', 'width', 'channels']}
    features = {'observation.images.front': picture, 'observation.state': vector, 'action': vector}
    began = time.perf_counter()
    dataset = LeRobotDataset.create('local/bench', fps, features, root=target, streaming_encoding=streaming)
    for path, numbers in zip(files, state, strict=True):
        dataset.add_frame({'observation.images.front': np.asarray(Image.open(path)), 'observation.state': numbers,
                           'action': numbers, 'task': 'walk'})  # fmt: skip
    dataset.save_episode()
    dataset.finalize()
    print(json.dumps({'seconds': time.perf_counter() - began}))


if __name__ == '__main__':
    main(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), streaming=sys.argv[4] == 'streaming')
