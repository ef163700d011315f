"""Run by lerobot's own Python: loads data sets offline, with no socket, and writes what lerobot makes of them.

``with_lerobot.py OUT.npz FOLDER`` has every frame of it; ``with_lerobot.py --merge OUT FOLDER FOLDER`` merges two.
"""

from __future__ import annotations

import os
import socket
import sys
from pathlib import Path

os.environ |= {'HF_HUB_OFFLINE': '1', 'HF_DATASETS_OFFLINE': '1', 'TOKENIZERS_PARALLELISM': 'false'}


def refuse(*_: object) -> None:
    raise OSError('this test has no network')


socket.socket.connect = refuse  # type: ignore[method-assign,assignment]
socket.socket.connect_ex = refuse  # type: ignore[method-assign,assignment]

import numpy as np  # noqa: E402
from lerobot.datasets.aggregate import aggregate_datasets  # noqa: E402
from lerobot.datasets.lerobot_dataset import LeRobotDataset  # noqa: E402
from lerobot.utils.feature_utils import dataset_to_policy_features  # noqa: E402
from torch.utils.data import DataLoader  # noqa: E402


def load(out: str, folder: str) -> None:
    plain = LeRobotDataset('local/set', root=folder)
    camera, fps = 'observation.images.front', plain.fps
    found: dict[str, list[object]] = {}
    for number in range(len(plain)):
        for name, value in plain[number].items():
            found.setdefault(name, []).append(value if isinstance(value, str) else np.asarray(value))
    delta = {'action': [0.0, 1 / fps, 2 / fps], camera: [-1 / fps, 0.0], 'observation.state': [-1 / fps, 0.0]}
    windows = LeRobotDataset('local/set', root=folder, delta_timestamps=delta)
    batches = DataLoader(windows, batch_size=16, shuffle=False)
    actions = [np.asarray(batch['action']) for batch in batches]
    kinds = {name: feature.type.value for name, feature in dataset_to_policy_features(plain.meta.features).items()}
    told = {name: np.array(values) for name, values in found.items() if name != camera}
    pictures = (np.array(found[camera]) * 255).round().astype(np.uint8)
    np.savez(out, pictures=pictures.transpose(0, 2, 3, 1), windows=np.concatenate(actions), episodes=plain.num_episodes,
             kinds=np.array([f'{name}={kind}' for name, kind in kinds.items()]), **told)  # fmt: skip


def merge(out: str, *folders: str) -> None:
    aggregate_datasets([f'local/{number}' for number in range(len(folders))], 'local/all', roots=[Path(each) for each in folders],
                       aggr_root=Path(out))  # fmt: skip


if __name__ == '__main__':
    if sys.argv[1] == '--merge':
        merge(*sys.argv[2:])
    else:
        load(*sys.argv[1:])
