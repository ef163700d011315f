"""Run by lerobot's Python: reads random windows of frames with two workers, from our store or a set, and prints how long it took.

    _training_reader.py float|bytes|lerobot WINDOWS SEED FRAMES PLACE

``PLACE`` is the folder of lerobot's set, or a robot in the store that ``AWS_ENDPOINT_URL`` and its credentials name. ``float``
makes the same tensors as lerobot: windows of eight images, channels first, float32 from 0 to 1; ``bytes`` leaves them uint8, as
``MissionDataset`` returns them, to be converted where the model runs.
"""

from __future__ import annotations

import json
import os
import random
import sys
import time
from collections.abc import Iterator, Sequence
from typing import Any

os.environ |= {'HF_HUB_OFFLINE': '1', 'HF_DATASETS_OFFLINE': '1'}

import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch.utils.data import DataLoader

from shadowhound_data_logger.lake import MissionDataset

FRAMES, WORKERS, WINDOWS_PER_BATCH = 8, 2, 4
FPS = 30


def ours(robot: str, begins: Sequence[int], *, as_float: bool) -> Iterator[Any]:
    dataset = MissionDataset(robot=robot)
    batches = [[begin + number for begin in some for number in range(FRAMES)] for some in _batches(begins)]

    def tensors(samples: Sequence[Any]) -> torch.Tensor:
        images = torch.from_numpy(np.stack([sample['image'] for sample in samples])).permute(0, 3, 1, 2)
        return (images.contiguous().float().div_(255) if as_float else images).unflatten(0, (-1, FRAMES))

    yield from DataLoader(dataset, batch_sampler=batches, num_workers=WORKERS, collate_fn=tensors)


def theirs(folder: str, begins: Sequence[int]) -> Iterator[Any]:
    deltas = {'observation.images.front': [number / FPS for number in range(FRAMES)]}
    dataset = LeRobotDataset('local/bench', root=folder, delta_timestamps=deltas)
    for batch in DataLoader(dataset, batch_sampler=list(_batches(begins)), num_workers=WORKERS):
        yield batch['observation.images.front']


def _batches(begins: Sequence[int]) -> Iterator[list[int]]:
    for place in range(0, len(begins), WINDOWS_PER_BATCH):
        yield list(begins[place : place + WINDOWS_PER_BATCH])


def main(way: str, windows: int, seed: int, frames: int, place: str) -> None:
    begins = [random.Random(seed + number).randrange(frames - FRAMES) for number in range(windows)]
    torch.set_num_threads(1)
    begun = time.perf_counter()
    seen = 0
    for images in theirs(place, begins) if way == 'lerobot' else ours(place, begins, as_float=way == 'float'):
        assert tuple(images.shape[1:]) == (FRAMES, 3, 480, 640), images.shape
        seen += images.shape[0] * FRAMES
    print(json.dumps({'seconds': time.perf_counter() - begun, 'frames': seen}))


if __name__ == '__main__':
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]), sys.argv[5])
