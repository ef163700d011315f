"""Run by lerobot's Python: reads random windows of frames with two workers, from our store or a set, and prints how long it took.

    _training_reader.py ours|lerobot WINDOWS SEED FRAMES PLACE

``PLACE`` is the folder of lerobot's set, or a robot in the store that ``AWS_ENDPOINT_URL`` and its credentials name. Both make
the same tensors: windows of eight images, channels first, float32 from 0 to 1.
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
from torch.utils.data import DataLoader

FRAMES, WORKERS, WINDOWS_PER_BATCH = 8, 2, 4
FPS = 30


def ours(robot: str, begins: Sequence[int]) -> Iterator[Any]:
    from shadowhound_data_logger.lake import MissionDataset  # noqa: PLC0415 - the other way has no need of it

    dataset = MissionDataset(robot=robot)
    batches = [[begin + number for begin in some for number in range(FRAMES)] for some in _batches(begins)]

    def tensors(samples: Sequence[Any]) -> torch.Tensor:
        images = torch.from_numpy(np.stack([sample['image'] for sample in samples]))
        return images.permute(0, 3, 1, 2).contiguous().float().div_(255).unflatten(0, (-1, FRAMES))

    yield from DataLoader(dataset, batch_sampler=batches, num_workers=WORKERS, collate_fn=tensors)


def theirs(folder: str, begins: Sequence[int]) -> Iterator[Any]:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset  # noqa: PLC0415 - the other way has no need of it

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
    seen, mean = 0, 0.0
    for images in (ours if way == 'ours' else theirs)(place, begins):
        assert tuple(images.shape[1:]) == (FRAMES, 3, 480, 640), images.shape
        seen += images.shape[0] * FRAMES
        mean += float(images.mean()) * images.shape[0] / windows
    print(json.dumps({'seconds': time.perf_counter() - begun, 'frames': seen, 'mean': mean}))


if __name__ == '__main__':
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]), sys.argv[5])
